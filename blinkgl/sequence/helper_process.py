"""What :mod:`blinkgl.sequence.helper` starts: ``python -m blinkgl.sequence.helper_process MEMORY ORDERS CHANNEL``.

Sequences come as lines of JSON on standard input, frames to be drawn as records in the pipe ORDERS, from which the
driver takes, too; pictures go into the shared MEMORY, and a line of JSON on CHANNEL says so. When standard input ends,
the driver is gone.
"""

from __future__ import annotations

import json
import mmap
import os
import select
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from blinkgl.config.reader import parse_yaml
from blinkgl.config.sequence import RunTemplate
from blinkgl.gl import GLContext, create_context
from blinkgl.render.canvas import Frame
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene
from blinkgl.sequence.helper import AHEAD, ORDER, digest, planes_at
from blinkgl.sequence.rendered import timeline_of


class Sequence:
    """A sequence that is drawn. opening : as :meth:`~blinkgl.sequence.helper.Helper.sequence` says.   gl : what it is
    drawn with. Raises BlinkGLError, and ValueError where it would not be the driver's sequence."""

    def __init__(self, opening: dict[str, Any], gl: GLContext):
        if (own := f"{gl.renderer}, {gl.version}") != opening["opengl"]:
            raise ValueError(f"the driver draws with {opening['opengl']}, this process with {own}")
        template = RunTemplate(parse_yaml(opening["text"], "helper"), Path(opening["base"]))
        self._config = template.sequence(opening["index"])
        if digest(self._config) != opening["digest"]:
            raise ValueError("the configuration does not come back from its text")
        self._gl, self._stack = gl, ExitStack()
        self._scene = sequence_scene(self._config, opening["index"], template.base)
        self._renderers: dict[int, Renderer] = {}
        self._before: dict[int, Frame] = {}

    def draw(self, memory: mmap.mmap, sensor: int, rate: bool, place: int, t_ns: int) -> tuple[int, int] | None:
        """A frame into the memory; the rows that have changed since its sensor's frame before, as of EventFrame."""
        renderer = self._renderer(sensor)
        names = ("", "rate") if rate else ("",)
        before, frame = self._before.get(sensor), renderer.luminance(t_ns, rate=rate)
        for name, plane in zip(names, planes_at(memory, place, len(names), renderer.height, renderer.width)):
            plane[...] = frame.view(name)
        self._gl.check()  # before anybody takes it for what was drawn
        self._before[sensor] = frame
        return frame.rows_changed_since(before)

    def _renderer(self, sensor: int) -> Renderer:
        if sensor not in self._renderers:
            scene = self._scene if self._config.sensors is None else self._scene.seen_by(sensor)
            beside = next(iter(self._renderers.values()), None)
            made = Renderer(self._gl, scene, self._config.render, beside=beside)
            self._renderers[sensor] = self._stack.enter_context(made)
        return self._renderers[sensor]

    def times(self, after_ns: int) -> Iterator[int]:
        """Those of the only sensor's frames after one of them, ns."""
        scene = self._scene
        return timeline_of(self._config, scene, self._renderer(0), (scene.t0_ns, scene.t1_ns)).after(after_ns)

    def close(self) -> None:
        self._stack.close()


def main() -> int:
    """Draws until standard input ends; the exit status."""
    memory_file, orders, channel = map(int, sys.argv[1:4])
    memory: mmap.mmap | None = None
    gl: GLContext | None = None
    sequence: Sequence | None = None
    number, rest = 0, b""
    times: Iterator[int] | None = None
    decided = drawn = 0  # how far times and frames are, by the frames' numbers

    def tell(**message: Any) -> None:
        data = json.dumps({"number": number, "cpu_s": time.process_time(), **message}).encode() + b"\n"
        while data:
            data = data[os.write(channel, data) :]

    tell(here=True)
    waiting = select.poll()
    waiting.register(0, select.POLLIN)
    waiting.register(orders, select.POLLIN)
    while True:
        ready = [end for end, _ in waiting.poll(None if times is None else 0)]
        if 0 in ready:
            data = os.read(0, 1 << 20)
            if not data:
                return 0
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                message = json.loads(line)
                if "after" in message:
                    if sequence is not None and message["number"] == number:
                        times, decided, drawn = sequence.times(message["after"]), message["count"], message["count"]
                    continue
                times = None
                if sequence is not None:
                    sequence.close()
                    sequence = None
                if "over" in message:
                    continue
                number = message["number"]
                try:
                    gl = gl or create_context(message["backend"], message["device"])
                    sequence = Sequence(message, gl)
                except Exception:  # noqa: BLE001 - the driver meets it itself, or goes on alone
                    traceback.print_exc()
                tell(ready=sequence is not None)
        elif times is not None and (orders not in ready or decided - drawn < 2 * AHEAD):
            t_ns, decided = next(times, None), decided + 1
            tell(time=t_ns)
            if t_ns is None:
                times = None
        elif orders in ready:
            try:
                of, sensor, count, rate, place, t_ns = ORDER.unpack(os.read(orders, ORDER.size))
            except BlockingIOError:  # the driver was faster
                continue
            if of != number or sequence is None:
                continue
            size = os.fstat(memory_file).st_size
            if memory is None or len(memory) < size:
                memory = mmap.mmap(memory_file, size)
            drawn = count
            rows = sequence.draw(memory, sensor, bool(rate), place, t_ns)
            tell(done=(sensor, count), rows=rows)


if __name__ == "__main__":
    sys.exit(main())
