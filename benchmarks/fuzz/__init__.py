"""An attack on the commands: damaged, malicious and merely wrong files of every kind."""
