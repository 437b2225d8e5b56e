"""The project's robots in MuJoCo, a simulator that the diagnosis was not written on."""
