"""A plug-in: an emulator, a label, a primitive and an event format in one file (docs/extending.md).

blinkgl --plugin mine.py generate mine.yaml --out out
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from blinkgl import AssetError, Events
from blinkgl.config.events import EmulatorConfig
from blinkgl.events import Emulator, register as register_emulator
from blinkgl.events.response import Response
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CheckedWriter, events_of
from blinkgl.io.formats import EventFormat, register as register_format
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.labels import Label, register as register_label
from blinkgl.scene.geometry.primitives import Surface, join, register as register_primitive, square

# --- events: {emulator: toy} ------------------------------------------------------------------------------------------


@register_emulator
class Toy(Emulator):
    """An ideal threshold with a fixed dead time: at most one event per pixel and frame, where
    ln(I + 0.01) has moved far enough."""

    class Config(EmulatorConfig):
        """A toy: an ideal threshold with a fixed dead time."""

        emulator: Literal["toy"] = "toy"
        contrast_threshold: float = Field(0.2, ge=0.01, le=10, description="ln units.")
        dead_us: float = Field(1000.0, ge=0, le=1e9, description="Dead time of a pixel after an event, microseconds.")

        @classmethod
        def from_sensor(cls, sensor):
            return {"contrast_threshold": sensor.contrast_threshold, "dead_us": sensor.refractory_us}

    _state = ("_level", "_free_ns")

    def __init__(self, height, width, config, seed=0):
        super().__init__(height, width, seed)
        self.config = config
        self._level, self._free_ns = np.zeros(height * width, np.float32), np.zeros(height * width, np.int64)

    @classmethod
    def response(cls, config):
        return Response(config.contrast_threshold, 1.0, 0.01)

    @classmethod
    def noiseless(cls, config):
        return config

    def _start(self, frame, t_ns):
        self._level[:], self._free_ns[:] = self._signal(frame), t_ns
        return Events.empty()

    def _advance(self, frame, t_ns):
        moved = self._signal(frame) - self._level
        fires = np.flatnonzero((np.abs(moved) >= self.config.contrast_threshold) & (self._free_ns <= t_ns))
        self._level[fires] += moved[fires]
        self._free_ns[fires] = t_ns + round(1000 * self.config.dead_us)
        y, x = np.divmod(fires, self.width)
        times, polarity = np.full(len(fires), t_ns // 1000), (moved[fires] > 0).astype(np.uint8)
        return Events(x.astype(np.uint16), y.astype(np.uint16), times, polarity)

    def _signal(self, frame):
        return np.log((self._decode[frame] if frame.dtype == np.uint8 else frame) + np.float32(0.01))


# --- labels: {height: true} -------------------------------------------------------------------------------------------


class Height(Label):
    """Height of the surface above z = 0, (H, W) float32 world units; 0 where nothing is hit."""

    name, about = "height", "height of the surface above z = 0, world units, float32 .npy"
    unit, buffer, varyings, tolerance = "world units", "R32F", ("local",), 1e-4
    glsl = """uniform mat4x3 world_from_local;
    float label_height() { return (world_from_local * vec4(local, 1.0)).z; }"""

    def uniforms(self, shot):
        return {"world_from_local": shot.moment.T_world_obj[:, :3]}

    def reference(self, scene, frame):
        pose = scene.camera_path.pose(frame.t_ns)
        rays = scene.camera.rays(frame.xy.reshape(-1, 2)).reshape(*frame.hit.shape, 3)
        points = rays / rays[..., 2:] * np.where(frame.hit, frame.depth, 0.0)[..., None]
        return np.where(frame.hit, points @ pose[2, :3] + pose[2, 3], 0.0)


register_label(Height())

# --- meshes: {ramp: {primitive: wedge}} -------------------------------------------------------------------------------


@register_primitive
def wedge(width: float = 1.0, height: float = 0.5) -> Surface:
    """Ramp that rises along x from 0 to ``height``, ``width`` long and wide; the texture once on each side."""
    w, up = width / 2, np.array([0, 0, height])
    low, high = np.array([[-w, -w, 0], [-w, w, 0]]), np.array([[w, -w, 0], [w, w, 0]])
    quads = [
        square(low[0], high[0] + up - low[0], low[1] - low[0], 1, 1),  # the ramp
        square(low[1], high[1] - low[1], low[0] - low[1], 1, 1),  # below
        square(high[0], high[1] - high[0], up, 1, 1),  # behind
    ]
    sides, uvs, face = [], np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]), np.array([[0, 1, 2]])
    for corners, out in (((low[0], high[0], high[0] + up), -1.0), ((low[1], high[1] + up, high[1]), 1.0)):
        sides.append((np.array(corners), np.tile([0.0, out, 0.0], (3, 1)), uvs, face))
    return join([*quads, *sides])


# --- convert events.h5 events.nine ------------------------------------------------------------------------------------

HEADER = np.dtype([("magic", "S4"), ("height", "<u2"), ("width", "<u2")])
ROW = np.dtype([("t", "<u4"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])


class NineReader:
    """height, width : px, or None where a file does not say.   chunks() : the events from the beginning, in pieces."""

    def __init__(self, path: str | Path, reading: EventReading = AS_FILE):
        self.path = Path(path)
        head = np.fromfile(self.path, HEADER, 1)
        if len(head) != 1 or head["magic"][0] != b"NINE":
            raise AssetError("no file of nine bytes an event", where=str(path))
        if (self.path.stat().st_size - HEADER.itemsize) % ROW.itemsize:
            raise AssetError("the file is truncated", where=str(path))
        self.height, self.width = int(head["height"][0]), int(head["width"][0])

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        """Yield events; ``events_of`` checks what the file claims."""
        count = (self.path.stat().st_size - HEADER.itemsize) // ROW.itemsize
        for i in range(0, count, size):
            part = np.fromfile(self.path, ROW, size, offset=HEADER.itemsize + i * ROW.itemsize)
            yield events_of(*(part[name] for name in "xytp"), str(self.path), first=i)


class NineWriter(CheckedWriter):
    """append(events)…, then close(), or abort(), which never raises. The caller makes the file appear whole."""

    kind = "nine"  # refuses causes

    def __init__(self, path: str | Path, height: int, width: int):
        super().__init__(path, height, width)
        with output_errors(self.path):
            self._file = open(self.path, "wb")  # noqa: SIM115 - CheckedWriter closes it
            self._file.write(np.array([(b"NINE", height, width)], HEADER).tobytes())

    def _write(self, events: Events) -> None:
        rows = np.empty(len(events), ROW)
        for name in "xytp":
            rows[name] = getattr(events, name)
        self._file.write(rows.tobytes())


register_format(EventFormat("nine", (".nine",), reader=NineReader, writer=NineWriter, sized=True))
