"""`python -m fbse_drake` is the `fbse` command."""

from fbse_drake.entry import entry

entry()
