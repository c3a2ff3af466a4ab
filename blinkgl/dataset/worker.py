"""A worker process of the local executor: ``python -m blinkgl.dataset.worker FD``.

The job, then task numbers, come as lines of JSON on standard input; messages (:mod:`blinkgl.dataset.work`) are sent on
FD in the same form. When standard input ends, the driver is dead: the sequence in progress is discarded.
"""

from __future__ import annotations

import faulthandler
import json
import os
import queue
import signal
import sys
import threading

from blinkgl.machine.interrupts import interruptible

_GRACE_S = 2.0


def main() -> int:
    """Make tasks until the driver closes standard input; return the exit status."""
    faulthandler.enable()
    try:
        with interruptible(signal.SIGTERM):
            return _work()
    except KeyboardInterrupt:
        return 130


def _work() -> int:
    channel = int(sys.argv[1])
    tasks: queue.Queue = queue.Queue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()

    one_at_a_time = threading.Lock()

    def tell(message: dict) -> None:
        data = json.dumps(message).encode() + b"\n"
        try:
            with one_at_a_time:
                while data:  # not a buffered file: a thread that reads one at exit is a fatal error in Python
                    data = data[os.write(channel, data) :]
        except OSError:  # nobody reads any more
            raise KeyboardInterrupt from None

    from blinkgl.dataset.work import maker_of
    from blinkgl.errors import BlinkGLError

    start = tasks.get()
    if start is None:
        return 0
    with maker_of(start["maker"], start["job"], start["device"]) as maker:
        try:
            tell(maker.open())
        except BlinkGLError as error:
            tell({"kind": "refused", "error": str(error)})
            return 2
        while (order := tasks.get()) is not None:
            tell(maker.make(order["task"], order["attempt"], tell))
    return 0


def _listen(tasks: queue.Queue) -> None:
    for line in sys.stdin:
        tasks.put(json.loads(line))
    tasks.put(None)
    # Idle workers end at the None. A busy one gets the signal; one that hangs must not outlive the driver either.
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(_GRACE_S)
    os.killpg(0, signal.SIGKILL)  # with what it started: it leads a group of its own


if __name__ == "__main__":
    sys.exit(main())
