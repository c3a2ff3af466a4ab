"""A second process that draws frames of the same sequences, where this one has a core to spare.

    with Helper(log) as helper:
        with helper.sequence(config, text, index, base, gl) as hand:
            for frame in hand.drawn(renderer, 0, timeline, rates): ...     # the frames that renderer alone would give

Most of a sequence is drawing, most of drawing is Python and OpenGL's driver in one thread, and frames do not depend on
one another. So the times of a few frames more than are needed now are put into a pipe; either process takes the next of
them whenever it has nothing better to do, and draws it. The times themselves, each of which follows from the one
before, are the helper's affair as soon as it has overtaken this process (those of a rig's sensors, and those that hang
on frames, are not). Events, labels, pictures and files stay here, in order. Both make the same pixels of the same
scene, so who did what leaves no trace.

Nobody depends on the helper. It is started once a run has lasted long enough for that to pay, takes part when it has
built the scene, and if it fails, hangs or is killed this process draws what it had taken: an error is then met here,
in the words that it has without a helper. It owns nothing but memory, and ends when this process's end of its standard
input closes, however that came about.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import mmap
import os
import select
import struct
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.events.camera import EventFrame
from blinkgl.events.truth import Surfaces

if TYPE_CHECKING:
    from blinkgl.config.sequence import SequenceConfig
    from blinkgl.gl import GLContext
    from blinkgl.render.canvas import Frame
    from blinkgl.render.renderer import Renderer
    from blinkgl.timeline import Timeline

ORDER = struct.Struct("<6q")
"""What lies in the pipe: the sequence's number with this helper, the sensor's, the frame's own, 1 with its rate, where
it goes in the shared memory (bytes), its time (ns). So small that it is written and read whole."""
AHEAD = 8
"""Frames of a sensor whose times are decided before they are needed: what bounds memory, and how long a label may
keep this process from drawing before the helper runs out of work."""
PATIENCE_S = 10.0
"""Processor seconds that a run has to take before a helper is started, which takes three to five until it draws."""
SILENT_S = 60.0
"""After so long without a word it is given up."""
_END_S = 5.0

Rows = tuple[int, int] | None


class Helper:
    """The process, from one sequence to the next. Use as a context manager.

    log : file that its errors go to; None: nowhere.   patience_s : see :data:`PATIENCE_S`.
    cores : that it draws with."""

    def __init__(self, log: Path | None = None, patience_s: float | None = None, cores: int = 1):
        self._log, self._cores = log, cores
        self._due_s = time.process_time() + (PATIENCE_S if patience_s is None else patience_s)
        self._popen: subprocess.Popen | None = None
        self._gone, self._here, self._rest, self._number = False, False, b"", 0
        self.cpu_s = 0.0
        """Processor seconds of the process, as it last said."""
        self.frames = 0
        """That it has drawn."""

    def __enter__(self) -> Helper:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def sequence(self, config: SequenceConfig, text: str, index: int, base: Path, gl: GLContext) -> Hand:
        """Its part in one sequence. text : the configuration, every value as drawn, as YAML.   base : folder that
        relative paths in it start from.   gl : what this process draws with."""
        self._number += 1
        opengl = f"{gl.renderer}, {gl.version}"
        return Hand(
            self,
            {
                "number": self._number,
                "text": text,
                "digest": digest(config),
                "index": index,
                "base": str(base.resolve()),
                "backend": gl.backend,
                "device": gl.device,
                "opengl": opengl,
            },
            alone=config.sensors is None,
        )

    # ---- the process ---------------------------------------------------------------------------------------------

    @property
    def here(self) -> bool:
        """Whether the process has said that it listens."""
        if not self._here:
            self.messages()
        return self._here

    @property
    def works(self) -> bool:
        """Whether the process runs; starts it when it is time."""
        if self._popen is None and not self._gone and time.process_time() >= self._due_s:
            self._start()
        return self._popen is not None and not self._gone

    def _start(self) -> None:
        self.memory = os.memfd_create("blinkgl frames")
        self.orders, self.write_orders = os.pipe()
        os.set_blocking(self.orders, False)  # for both processes: it is one pipe, and each takes what there is
        self.channel, write_channel = os.pipe()
        threads = {"LP_NUM_THREADS": "0" if self._cores == 1 else str(self._cores)}
        passed = (self.memory, self.orders, write_channel)
        with open(os.devnull, "ab") if self._log is None else _opened(self._log) as output:
            try:
                self._popen = subprocess.Popen(
                    [sys.executable, "-m", "blinkgl.sequence.helper_process", *map(str, passed)],
                    stdin=subprocess.PIPE,
                    bufsize=0,
                    stdout=output,
                    stderr=output,
                    pass_fds=passed,
                    env={**threads, **os.environ},
                    start_new_session=True,
                )
                assert self._popen.stdin is not None
                os.set_blocking(self._popen.stdin.fileno(), False)
            except OSError:  # no memory for another process: then there is none
                self._gone = True
        os.close(write_channel)
        if self._gone:
            self._close_ends()

    def send(self, message: dict[str, Any]) -> None:
        """A line on its standard input."""
        assert self._popen is not None and self._popen.stdin is not None
        end, data = self._popen.stdin.fileno(), json.dumps(message).encode() + b"\n"
        waiting = select.poll()
        waiting.register(end, select.POLLOUT)
        with contextlib.suppress(OSError):
            while data and waiting.poll(SILENT_S * 1000):
                data = data[os.write(end, data) :]
        if data:
            self.lose()

    def messages(self, timeout_s: float = 0.0) -> list[dict[str, Any]]:
        """What it has said since. A timeout: waits so long for a word, and gives it up when there is none."""
        if not self.works:
            return []
        waiting = select.poll()
        waiting.register(self.channel, select.POLLIN)
        if not waiting.poll(timeout_s * 1000):
            if timeout_s:
                self.lose()
            return []
        data = os.read(self.channel, 1 << 16)
        if not data:
            self.lose()
            return []
        *lines, self._rest = (self._rest + data).split(b"\n")
        said = [json.loads(line) for line in lines]
        for message in said:
            self._here = True
            self.cpu_s = max(self.cpu_s, message.get("cpu_s", 0.0))
        return said

    def lose(self) -> None:
        """Ends it; the sequence goes on without."""
        if self._popen is not None and not self._gone:
            self._gone = True
            self._popen.kill()
            self._popen.wait()

    def close(self) -> None:
        """Ends the process. Harmless when repeated."""
        popen, self._popen = self._popen, None
        if popen is not None:
            assert popen.stdin is not None
            with contextlib.suppress(OSError):
                popen.stdin.close()
            if not self._gone:
                popen.terminate()
            try:
                popen.wait(_END_S)
            except subprocess.TimeoutExpired:
                popen.kill()
                popen.wait()
            self._close_ends()
        self._gone = True

    def _close_ends(self) -> None:
        for end in (self.memory, self.orders, self.write_orders, self.channel):
            os.close(end)


class _Order:
    """A frame to be drawn. rows : as of :class:`EventFrame`, beside the frame that the same process drew before;
    follows : whether that was the frame before this one."""

    def __init__(self, member: _Member, count: int, t_ns: int):
        self.member, self.count, self.t_ns = member, count, t_ns
        self.given_out = self.done = self.follows = False
        self.rows: Rows = None


class _Member:
    """A sensor: what draws it here, and where its frames lie in the shared memory.

    planes : luminance, and its rate where it is asked for.   start : bytes."""

    def __init__(self, number: int, renderer: Renderer, rates: bool, start: int):
        self.number, self.renderer, self.rates, self.start = number, renderer, rates, start
        self._before: Frame | None = None
        self._count = -1

    @property
    def planes(self) -> tuple[str, ...]:
        return ("", "rate") if self.rates else ("",)

    @property
    def size(self) -> int:
        """Bytes of a frame."""
        return len(self.planes) * self.renderer.height * self.renderer.width * 4

    def place(self, order: _Order) -> int:
        """Where a frame goes: the one that is looked at has a place, too."""
        return self.start + order.count % (AHEAD + 1) * self.size

    def draw(self, order: _Order) -> Frame:
        """Here and now."""
        frame = self.renderer.luminance(order.t_ns, rate=self.rates)
        order.rows, order.follows = frame.rows_changed_since(self._before), self._count + 1 == order.count
        order.done, self._before, self._count = True, frame, order.count
        return frame


class Hand:
    """What a helper does for one sequence; see :meth:`Helper.sequence`. Use as a context manager: at its end nothing of
    the sequence is left with the helper.

    alone : it has a single camera.   waited_s : wall seconds that this process had nothing to do but to wait for a
    sensor's frames, by its number."""

    def __init__(self, helper: Helper, opening: dict[str, Any], alone: bool):
        self.alone = alone
        self._helper, self._opening, self._number = helper, opening, opening["number"]
        self._told = False
        self.ready: bool | None = None
        """Whether the helper has built the scene; None: not yet, False: it cannot."""
        self._out: dict[tuple[int, int], _Order] = {}
        self._held: list[mmap.mmap] = []
        self._end = 0
        self.times: deque[int | None] = deque()
        """Frame times that the helper has decided, ns; None: there are no more."""
        self.waited_s: dict[int, float] = {}

    def __enter__(self) -> Hand:
        return self

    def __exit__(self, *_: object) -> None:
        self._take_back()
        if self._told and self._helper.works:
            self._helper.send({"over": self._number})
        self._out.clear()

    def drawn(
        self,
        renderer: Renderer,
        number: int,
        timeline: Timeline,
        rates: bool = False,
        shown: Callable[[int], Surfaces] | None = None,
    ) -> Iterator[EventFrame]:
        """The frames of a sensor's event pass at the timeline's times, as they are drawn by ``renderer`` alone. Times
        are asked for before the frames before them are there, so it must be none that looks at frames.

        number : of the sensor on its rig.   rates : with d(luminance)/dt.   shown : surfaces at a time."""
        member, times = _Member(number, renderer, rates, self._end), _Times(self, timeline)
        self._end += (AHEAD + 1) * member.size
        ahead: deque[_Order] = deque()
        rows: Rows = None  # of the frame before
        while True:
            shared = self._shares()
            while len(ahead) < (AHEAD if shared else 1):
                if (t_ns := times.next(shared, wait=not ahead)) is None:
                    break
                ahead.append(_Order(member, times.count - 1, t_ns))
                if shared:
                    self._give_out(ahead[-1])
            if not ahead:
                return
            order = ahead.popleft()
            planes = self._fetch(order)
            # Either process knows what has changed since its own frame before: all that moves in this frame, and more.
            union, rows = order.rows if order.follows else _both(rows, order.rows), order.rows
            luminance, rate = planes[0], planes[1] if rates else None
            yield EventFrame(order.t_ns, luminance, rate, union, shown(order.t_ns) if shown is not None else None)

    # ---- orders --------------------------------------------------------------------------------------------------

    @property
    def works(self) -> bool:
        """Whether the helper is there."""
        return self._helper.works

    def lead(self, count: int, t_ns: int) -> None:
        """Has the helper decide the times after t_ns, that of frame ``count``; they arrive in :attr:`times`."""
        self._helper.send({"number": self._number, "after": t_ns, "count": count})

    def _shares(self) -> bool:
        """Whether the helper takes part by now."""
        if not (self._helper.works and self._helper.here):
            return False
        if not self._told:
            self._told = True
            self._helper.send(self._opening)
        self.listen(0.0)
        return bool(self.ready) and self._helper.works

    def listen(self, timeout_s: float) -> None:
        """Takes note of what the helper has said."""
        for message in self._helper.messages(timeout_s):
            if message["number"] != self._number:
                continue
            if "ready" in message:
                self.ready = message["ready"]
            elif "time" in message:
                self.times.append(message["time"])
            elif (order := self._out.pop(tuple(message["done"]), None)) is not None:
                rows = message["rows"]
                order.done, order.rows = True, None if rows is None else tuple(rows)
                self._helper.frames += 1

    def _give_out(self, order: _Order) -> None:
        member = order.member
        if os.fstat(self._helper.memory).st_size < self._end:
            os.ftruncate(self._helper.memory, self._end)
        place = member.place(order)
        self._out[member.number, order.count] = order
        order.given_out = True
        os.write(
            self._helper.write_orders,
            ORDER.pack(self._number, member.number, order.count, int(member.rates), place, order.t_ns),
        )

    def _taken(self) -> _Order | None:
        """The next order that nobody has taken; None: there is none."""
        while self._helper.works:
            try:
                number, *key = ORDER.unpack(os.read(self._helper.orders, ORDER.size))[:3]
            except BlockingIOError:
                return None
            if number == self._number and (order := self._out.pop(tuple(key), None)) is not None:
                return order
        return None

    def _take_back(self) -> None:
        while self._taken() is not None:
            pass

    def _fetch(self, order: _Order) -> list[np.ndarray]:
        """The pictures of a frame, drawn by whoever took it; others are drawn while it is not there."""
        member = order.member
        while order.given_out and not order.done and self._helper.works:
            taken = self._taken()
            if taken is order:
                break
            if taken is not None:
                frame = taken.member.draw(taken)
                for name, plane in zip(taken.member.planes, self._planes(taken), strict=True):
                    plane[...] = frame.view(name)
                self.listen(0.0)
                continue
            began = time.perf_counter()
            self.listen(SILENT_S)
            waited_s = self.waited_s.get(member.number, 0.0)
            self.waited_s[member.number] = waited_s + time.perf_counter() - began
        if order.done:
            planes = self._planes(order)
            for plane in planes:
                plane.flags.writeable = False
            return planes
        self._out.pop((member.number, order.count), None)
        frame = member.draw(order)
        return [frame.view(name) for name in member.planes]

    def _planes(self, order: _Order) -> list[np.ndarray]:
        """A frame's pictures in the shared memory."""
        member, renderer = order.member, order.member.renderer
        return planes_at(self._memory, member.place(order), len(member.planes), renderer.height, renderer.width)

    @property
    def _memory(self) -> mmap.mmap:
        if not self._held or len(self._held[-1]) < self._end:
            self._held.append(mmap.mmap(self._helper.memory, self._end))  # those before are still looked at
        return self._held[-1]


class _Times:
    """The times of a timeline, decided by whoever is further. count : given so far."""

    def __init__(self, hand: Hand, timeline: Timeline):
        self._hand, self._timeline, self._own = hand, timeline, iter(timeline)
        self._repeats = timeline.repeats and hand.alone
        self._last: int | None = None
        self._asked = self._led = self._over = False
        self.count = 0

    def next(self, shared: bool, wait: bool) -> int | None:
        """The next; None: there is none, or, unless somebody waits for it, none yet.
        shared : whether the helper takes part."""
        if self._over:
            return None
        if shared and not self._asked and self._repeats and self._last is not None:
            self._asked = True
            self._hand.lead(self.count - 1, self._last)
        told, last = self._hand.times, self._last
        while told and (first := told[0]) is not None and last is not None and first <= last:
            told.popleft()  # it was behind when it began
        while self._led and not told and self._hand.works:
            if not wait:
                return None
            self._hand.listen(SILENT_S)
        if told:
            self._led, t_ns = True, told.popleft()
        else:
            if self._led:  # and is gone
                self._led, self._own = False, self._timeline.after(self._last)
            t_ns = next(self._own, None)
        if t_ns is None:
            self._over = True
            return None
        self._last, self.count = t_ns, self.count + 1
        return t_ns


def planes_at(memory: mmap.mmap, start: int, count: int, height: int, width: int) -> list[np.ndarray]:
    """``count`` pictures of float32 (height, width), one after the other from byte ``start`` on."""
    whole = np.frombuffer(memory, np.float32, count * height * width, start)
    return list(whole.reshape(count, height, width))


def digest(config: SequenceConfig) -> str:
    """Of all values of a configuration."""
    return hashlib.sha256(config.model_dump_json().encode()).hexdigest()


def _both(one: Rows, other: Rows) -> Rows:
    """Rows that hold both; None: all."""
    if one is None or other is None:
        return None
    there = [rows for rows in (one, other) if rows[0] < rows[1]]
    return (min(rows[0] for rows in there), max(rows[1] for rows in there)) if there else (0, 0)


def _opened(log: Path) -> Any:
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        return open(log, "ab")
    except OSError:
        return open(os.devnull, "ab")
