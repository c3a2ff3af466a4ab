"""The console scripts, and ``python -m blinkgl``. Libraries are imported here, where a signal is one line already."""

from __future__ import annotations

import os
import signal
from importlib import import_module


def main(commands: str = "blinkgl.cli") -> None:
    """Run the command line of a module."""
    leave = lambda number, _: os.write(2, b"interrupted\n") and os._exit(128 + number)
    heard = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, leave) for number in heard}
    run = import_module(commands).main
    for number, handler in before.items():
        signal.signal(number, handler)
    run()


def eflow() -> None:
    """Run the command line of eflow."""
    main("eflow.cli")


if __name__ == "__main__":
    main()
