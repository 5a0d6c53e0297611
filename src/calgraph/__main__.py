"""``python -m calgraph``, where the command is not on the path."""

from calgraph.cli import main

main()
