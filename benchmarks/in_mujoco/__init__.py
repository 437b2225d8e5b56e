"""The project's robots in MuJoCo, another simulator than the one that the diagnosis was written on."""
