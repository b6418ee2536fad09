"""`python -m gesturekit`, the same as the command `gesturekit`."""

from gesturekit.cli import main

main()
