"""``python -m blinkgl`` is ``blinkgl``."""

from blinkgl.cli import main

main()
