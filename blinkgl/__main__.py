"""Run the ``blinkgl`` command by ``python -m blinkgl``."""

from blinkgl.cli import main

main()
