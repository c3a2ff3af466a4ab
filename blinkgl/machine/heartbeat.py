"""A line every half minute from a command that shows nothing else, as in a log: "still at work: 0:01:30, sequence 340
of 2,000". On a terminal there are bars and spinners."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator

EVERY_S = 30.0


class Heartbeat:
    """When a command last showed something, and where it is."""

    def __init__(self) -> None:
        self._shown, self._place, self._done = time.monotonic(), "", threading.Event()

    def heard(self) -> None:
        """Note that a line was shown just now."""
        self._shown = time.monotonic()

    def at(self, place: str) -> None:
        """Note where the command is: "sequence 340 of 2,000"."""
        self._place = place

    def rest(self) -> None:
        """Print no more lines: from now on the command waits for somebody who looks at a page."""
        self._done.set()

    @contextlib.contextmanager
    def beating(self, quiet: bool) -> Iterator[None]:
        """Print the line to standard error, every 30 s in which nothing else was shown; not at all where ``quiet``, or
        on a terminal."""
        self._done, began = (done := threading.Event()), time.monotonic()
        self._place = ""
        self.heard()

        def beat() -> None:
            # Sleeps until 30 s after the last line; one that is shown meanwhile puts the next one off.
            while not done.wait(max(self._shown + EVERY_S - time.monotonic(), 0.01)):
                if time.monotonic() < self._shown + EVERY_S:
                    continue
                self.heard()
                whole = int(self._shown - began)
                since = f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
                with contextlib.suppress(OSError, ValueError):  # nobody reads it any more
                    place = f", {self._place}" if self._place else ""
                    print(f"still at work: {since}{place}", file=sys.stderr, flush=True)  # noqa: T201

        thread = threading.Thread(target=beat, name="heartbeat", daemon=True)
        if not (quiet or sys.stderr.isatty()):
            thread.start()
        try:
            yield
        finally:
            done.set()
            if thread.is_alive():
                thread.join()


heartbeat = Heartbeat()
"""This process's."""
