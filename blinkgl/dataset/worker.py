"""A worker process of the local executor: ``python -m blinkgl.dataset.worker FD``.

The job, then task numbers, come as lines of JSON on standard input; messages (:mod:`blinkgl.dataset.work`) leave on FD the
same way. When standard input ends, the driver is dead: whatever is being made is thrown away.
"""

from __future__ import annotations

import faulthandler
import json
import os
import queue
import signal
import sys
import threading

_GRACE_S = 20.0


def main() -> int:
    faulthandler.enable()
    signal.signal(signal.SIGTERM, _interrupt)
    channel = os.fdopen(int(sys.argv[1]), "w", encoding="utf-8")
    tasks: queue.Queue = queue.Queue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()

    def tell(message: dict) -> None:
        try:
            channel.write(json.dumps(message) + "\n")
            channel.flush()
        except OSError:  # nobody listens any more
            raise KeyboardInterrupt from None

    try:
        from blinkgl.dataset.work import Job, Maker
        from blinkgl.errors import BlinkGLError

        start = tasks.get()
        if start is None:
            return 0
        with Maker(Job(**start["job"]), start["device"]) as maker:
            try:
                tell(maker.open())
            except BlinkGLError as error:
                tell({"kind": "refused", "error": str(error)})
                return 2
            while (order := tasks.get()) is not None:
                tell(maker.make(order["task"], order["attempt"], tell))
        return 0
    except KeyboardInterrupt:
        return 130


def _listen(tasks: queue.Queue) -> None:
    for line in sys.stdin:
        tasks.put(json.loads(line))
    tasks.put(None)
    # Idle workers leave by the None. One that is at work gets the signal; one that hangs must not outlive the driver either.
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(_GRACE_S)
    os._exit(1)


def _interrupt(*_) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
