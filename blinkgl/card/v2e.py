"""V2E on the card (``shaders/compute/v2e_*.glsl``): the events of :class:`~blinkgl.events.v2e.V2e`, bit for bit.

A step is eleven dispatches. *Blocks*: the shot noise of every block of 1024 pixels, whose clock runs by itself, in
chains by pixel and time. *Mark*: what each photoreceptor holds, and a bit for each comparator that has met a level.
*List*: those pixels, in raster order, their places found by prefix sums. *Fire*, twice: how many events each has, and,
at places found by prefix sums again, the events and what becomes of the pixel, which nothing has touched until then: it
may be repeated with more room.

Photoreceptors are single precision, crossing times, dead times, leak and draws are double; every operation is one of
IEEE 754 and none is contracted. :mod:`blinkgl.card.proof` asks the card which of them it rounds so, and the others are
done in whole numbers. Logarithms and exponentials are the processor's own polynomials (:mod:`blinkgl.events.arith`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from blinkgl.card.arith import words
from blinkgl.card.emulator import CardEmulator, Flight
from blinkgl.card.kernels import PIXELS_AT, PIXELS_PER_GROUP, UNUSABLE, Kernels, Rounding, refuse_without_compute
from blinkgl.card.memory import refuse_too_large
from blinkgl.card.room import Buffers
from blinkgl.config.events import V2eConfig
from blinkgl.events.emulator import BLOCK, INTENSITY_LIMIT_BITS
from blinkgl.events.v2e import V2e
from blinkgl.types.events import Events

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext

FEW_SHOTS = 16
SIZES = 256
"""Entries of a table of the photoreceptor noise's sizes."""
_GO = 128
"""Candidates of noise that a block draws in a go: processors that draw stop a loop after so many turns."""


class V2eRoom(Buffers):
    """The buffers of a V2E. `now`, `before` and `state` have a plane of 4 bytes a pixel for each of the names that they
    are given.

    signal, state : names of planes.   shots : room for events of noise in a block; None: there is no noise.
    tiles : of a batch, which has both halves of the signal in `now`, and a table of the noise's sizes a tile."""

    def __init__(
        self,
        gl: GLContext,
        pixels: int,
        what: str,
        size: tuple[int, int],
        signal: Iterable[str],
        state: Iterable[str],
        shots: int | None,
        tiles: int = 0,
    ):
        self.signal, self.state = ({name: k for k, name in enumerate(names)} for names in (signal, state))
        padded = -(-pixels // BLOCK) * BLOCK
        self.blocks, self.shots = padded // BLOCK, shots or 0
        self.held = 4 * padded * len(self.signal) + 16 * self.blocks
        sizes = {
            **({"now": 2 * self.held} if tiles else {"now": self.held, "before": self.held}),
            "state": 4 * padded * len(self.state),
            "farthest": 4 * self.blocks,
            "sizes": 4 * SIZES * max(1, tiles),
        }
        if shots is not None:
            sizes |= {"shots": self._shot_bytes(shots), "table": 8 * padded}
        super().__init__(gl, pixels, sizes, what, size, tiles)

    def _shot_bytes(self, shots: int) -> int:
        return 16 * self.blocks * (shots + 1)

    def bytes_per_pixel(self, name: str) -> int:
        return 4 if name in ("now", "before", "state") else super().bytes_per_pixel(name)

    def put_plane(self, buffer: str, plane: str, array: np.ndarray) -> None:
        """Of all pixels: 4 bytes each, or, in this plane and the next, 8."""
        first = self.planes(buffer)[plane] * self.padded
        parts = array.view(np.uint32).reshape(self._pixels, -1).T
        for k, part in enumerate(parts):
            self.put(buffer, part, first + k * self.padded)

    def get_plane(self, buffer: str, plane: str, dtype: type) -> np.ndarray:
        """What :meth:`put_plane` has put there, or a kernel."""
        first, many = self.planes(buffer)[plane] * self.padded, np.dtype(dtype).itemsize // 4
        parts = [self.get(buffer, np.uint32, first + k * self.padded) for k in range(many)]
        return np.ascontiguousarray(np.stack(parts, axis=1)).view(dtype)[:, 0]

    def planes(self, buffer: str) -> dict[str, int]:
        """Their numbers, by name."""
        return self.state if buffer == "state" else self.signal

    @property
    def clocks_at(self) -> int:
        """Bytes: where they stand, behind the planes of the signal."""
        return 4 * self.padded * len(self.signal)

    def put_clocks(self, clocks: np.ndarray) -> None:
        """(blocks, 2) int64: time and number of the next candidate of noise."""
        self._buffers["now"].write(np.ascontiguousarray(clocks), self.clocks_at)

    def get_clocks(self) -> np.ndarray:
        return np.frombuffer(self._buffers["now"].read(16 * self.blocks, offset=self.clocks_at), np.int64).reshape(
            -1, 2
        )

    def put_table(self, table: np.ndarray) -> None:
        """(blocks, 2048) float32: see ``v2e_model.shot_tables``."""
        self._buffers["table"].write(table)

    def put_sizes(self, sizes: np.ndarray) -> None:
        """(SIZES,) float32 at most: see ``noise.noise_table``."""
        self._buffers["sizes"].write(np.ascontiguousarray(sizes))

    def make_room_for_shots(self, shots: int) -> None:
        """In every block."""
        refuse_too_large(self._gl, {"shots": self._shot_bytes(shots)}, f"{shots} events of noise in a block")
        self._buffers["shots"].release()
        self._buffers["shots"], self.shots = self._gl.ctx.buffer(reserve=self._shot_bytes(shots)), shots


class Layout(NamedTuple):
    """features : defines of the shaders.   signal, state : names of planes."""

    features: tuple[str, ...]
    signal: tuple[str, ...]
    state: tuple[str, ...]


class V2eStages:
    """The eleven dispatches of a step, over the buffers of one emulator or of a batch.   features : see
    :class:`Layout`."""

    def __init__(self, kernels: Kernels, room: V2eRoom, features: Iterable[str]):
        self._kernels, self._room = kernels, room
        numbers = {**room.signal, **room.state}
        self._batch = {"BATCH": 1, "TILES": room.tiles} if room.tiles else {}
        self._defines = {
            **self._batch,
            **dict.fromkeys(features, 1),
            **{name: f"{k}u" for name, k in numbers.items()},
            "PLANES": f"{len(room.signal)}u",
        }

    def _all(self, values: Mapping[str, Any]) -> dict[str, Any]:
        room = self._room
        return {
            **values,
            "words": room.words,
            "blocks": room.blocks,
            "padded": room.padded,
            "length_of_half": room.held // 4,
            "room": room.shots,
            "capacity": room.capacity,
        }

    def fire(self, values: Mapping[str, Any], *, checked: bool) -> None:
        """Noise, marks, list, and the events as far as there is room.

        values : of uniforms; "candidates" : of noise in a block.   checked : looks for values that cannot be used: then
        nothing fires, and the head says so."""
        room, kernels, values = self._room, self._kernels, self._all(values)
        before = {} if room.tiles else {4: room["before"]}
        noise = {3: room["shots"], **before, 5: room["now"], 6: room["table"]} if room.shots else {}
        goes = 1 + values["candidates"] // _GO
        for go in range(goes):
            kernels.run(
                "compute/v2e_blocks.glsl",
                self._defines,
                {0: room["listed"], 1: room["marks"], 2: room["farthest"], **noise},
                {**values, "goes_on": go > 0, "last": go == goes - 1},
                items=room.blocks,
            )
        kernels.run(
            "compute/v2e_mark.glsl",
            {**self._defines, **({"CHECKED": 1} if checked else {})},
            {
                1: room["now"],
                **({} if room.tiles else {2: room["before"]}),
                3: room["state"],
                4: room["marks"],
                5: room["farthest"],
                6: room["listed"],
                **({7: room["sizes"]} if "HUMS" in self._defines else {}),
            },
            values,
            items=room.padded,
            local=PIXELS_PER_GROUP,
        )
        kernels.prefix_of_bits(room["listed"], room["marks"], room["sums"], room["places"], room.words)
        kernels.run(
            "compute/events_list.glsl",
            {"V2E": 1, **self._batch, **({"SHOTS": 1} if room.shots else {})},
            {
                0: room["marks"],
                1: room["places"],
                2: room["sums"],
                3: room["listed"],
                4: room["farthest"],
                **({5: room["shots"]} if room.shots else {}),
            },
            values,
            items=room.words,
        )
        self._run_pixels({}, {}, values)
        self.emit(values)

    def emit(self, values: Mapping[str, Any]) -> None:
        """The events, and what becomes of their pixels, where there is room for all."""
        room = self._room
        self._kernels.prefix_of_counts(room["listed"], room["counts"], room["sums"], room["places"], room.capacity)
        self._run_pixels({"EMIT": 1}, {6: room["places"], 7: room["packed"]}, self._all(values))

    def _run_pixels(
        self, defines: Mapping[str, int], buffers: Mapping[int, moderngl.Buffer], values: Mapping[str, Any]
    ) -> None:
        room = self._room
        common = {0: room["listed"], 1: room["counts"], 2: room["now"], 4: room["state"]}
        if not room.tiles:
            common[3] = room["before"]
        if room.shots:
            common[5] = room["shots"]
        self._kernels.run(
            "compute/v2e_fire.glsl",
            {**self._defines, **defines},
            {**common, **buffers},
            values,
            indirect=(room["listed"], PIXELS_AT),
        )


class CardV2e(CardEmulator, V2e):
    """See the module and :class:`~blinkgl.card.emulator.CardEmulator`.   gl, owns_gl, rounding, late, sorts : see
    :class:`~blinkgl.card.esim.CardEsim`.

    State on the card: 24 bytes per pixel; 8 more each with the low-pass, photoreceptor noise and where light is asked
    for, 16 with the second low-pass, 4 with leak (8 with jitter), 8 with the dead time and 12 with causes.
    Raises as CardEsim does."""

    def __init__(
        self,
        height: int,
        width: int,
        config: V2eConfig | None = None,
        seed: int = 0,
        reconstruction: str = "linear",
        *,
        gl: GLContext,
        owns_gl: bool = False,
        rounding: Rounding | None = None,
        late: bool | None = None,
        sorts: bool | None = None,
    ):
        config = config or V2eConfig()
        if problem := self.unfit(config, reconstruction):
            raise problem
        refuse_without_compute(gl)
        super().__init__(height, width, config, seed, reconstruction)
        self._set_up(gl, owns_gl, rounding, late, sorts)
        layout = self._layout()
        self._room = V2eRoom(
            gl,
            self.height * self.width,
            f"{width}x{height} pixels",
            (width, height),
            layout.signal,
            layout.state,
            FEW_SHOTS if self._clock_ns.size else None,
        )
        self._stages = V2eStages(self._kernels, self._room, layout.features)
        self._put_constants()

    def _layout(self) -> Layout:
        """Which planes there are, and what the shaders are compiled for; the configuration alone decides it."""
        self._brightness: dict[int, float | None] = {}
        """Of the last two frames, by their numbers: DN of the brightest pixel; None: to be looked up."""
        self._due_ns: int | None = None  # when leaks are to begin anew, which waits until the last frame is known good
        # What is in `_state` of the processor's class and lies in a plane: its array, buffer, plane.
        self._planes = [
            (array, buffer, plane)
            for array, buffer, plane in (
                (self._x, "now", "X"),
                (self._intensity, "now", "LIGHT"),
                (self._lag, "now", "LAG"),
                (self._before_second, "now", "FIRST_X"),
                (self._second_lag, "now", "SECOND_LAG"),
                (self._noise, "now", "NOISE"),
                (self._upper, "state", "UPPER"),
                (self._lower, "state", "LOWER"),
                (self._leak, "state", "LEAK"),
                (self._release, "state", "RELEASE"),
                (self._since_ns, "state", "SINCE"),
                (self._noise_then if self._noise.size else self._noise, "state", "NOISE_THEN"),
            )
            if array.size
        ]
        self._fixed: dict[str, np.ndarray] = {"ON": self._on, "OFF": self._off}
        if self._leak_jitter:
            self._fixed["MEAN_LEAK"] = np.ascontiguousarray(self._constants[:, 2])
        if self._tells and self.config.hot_pixel_fraction > 0:
            self._fixed["HOT"] = self._hot.astype(np.uint32)
        features = tuple(
            name
            for name, there in (
                ("LOW_PASS", self._lag.size),
                ("SECOND", self._second_lag.size),
                ("LEAKS", self._leak.size),
                ("LEAK_JITTER", self._leak_jitter),
                ("HUMS", self._noise.size),
                ("SHOTS", self._clock_ns.size),
                ("DEAD_TIME", self._release.size),
                ("CAUSES", self._tells),
                ("HOT", "HOT" in self._fixed),
            )
            if there
        )
        planes = {"now": ["FRAME"], "state": []}
        if self._clock_ns.size:
            planes["now"] += ["FIRST_SHOT", "LAST_SHOT"]
        for array, buffer, plane in self._planes:
            planes[buffer] += [plane] if array.itemsize == 4 else [plane, plane + "_HIGH"]
        return Layout(features, tuple(planes["now"]), (*planes["state"], *self._fixed))

    def _put_constants(self) -> None:
        for plane, array in self._fixed.items():
            self._room.put_plane("state", plane, array)
        if self._shot_table.size:
            self._room.put_table(np.ascontiguousarray(self._shot_table))

    @property
    def _tells(self) -> bool:
        """Whether pixels remember what moved them. (Without any noise and low-pass they need not.)"""
        there = self._lag, self._leak, self._noise, self._release, self._clock_ns
        return self.causes and any(array.size for array in there)

    @classmethod
    def trial(cls, config: V2eConfig) -> V2eConfig:
        asked = lambda key, value: value if getattr(config, key) else 0.0
        return V2eConfig(
            threshold_sigma=0.03,
            cutoff_hz=asked("cutoff_hz", 300.0),
            second_cutoff_hz=asked("second_cutoff_hz", 500.0),
            leak_rate_hz=asked("leak_rate_hz", 20.0),
            leak_jitter=asked("leak_jitter", 0.1),
            shot_noise_rate_hz=asked("shot_noise_rate_hz", 50.0),
            photoreceptor_noise=config.photoreceptor_noise,
            refractory_us=asked("refractory_us", 150.0),
            hot_pixel_fraction=asked("hot_pixel_fraction", 0.02),
            causes=config.causes,
        )

    # -- steps ----------------------------------------------------------------------------------------------
    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        events = super()._start(frame, t_ns, rate)
        self._brightness = {self.frames: float(self._brightest[0])}
        return events

    def _advance(self, frame: np.ndarray | moderngl.Texture, t_ns: int, rate: np.ndarray | None) -> Events:
        assert self.t_ns is not None
        self._refuse_shots(t_ns - self.t_ns)
        events = super()._advance(frame, t_ns, rate)
        self._seen(frame, t_ns)
        return events

    def _seen(self, frame: np.ndarray | moderngl.Texture, t_ns: int) -> None:
        """Takes note of the frame of a step."""
        before = self.frames
        codes = isinstance(frame, np.ndarray) and frame.dtype == np.uint8
        self._brightness = {
            before - 1: self._brightness.get(before - 1),
            before: float(self._table.max()) if codes else None,
        }
        if t_ns - int(self._epoch_ns[0]) >= self._rebase_ns:
            self._due_ns = t_ns

    def _landed(self) -> Events:
        events = super()._landed()
        self._begin_due_leaks()
        return events

    def _undone(self, flight: Flight) -> None:
        self._due_ns = None

    def _begin_due_leaks(self) -> None:
        """Of the last step, now that its frame is known to be one."""
        if self._due_ns is not None:
            t_ns, self._due_ns = self._due_ns, None
            for array, buffer, plane in self._planes:
                if plane in ("UPPER", "LOWER", "LEAK"):
                    array[...] = self._room.get_plane(buffer, plane, array.dtype.type)
            self._begin_leaks_anew(t_ns)
            self._room.put_plane("state", "UPPER", self._upper)
            self._room.put_plane("state", "LOWER", self._lower)

    def _values(self, t_ns: int) -> dict[str, Any]:
        likely = self._likely_shots(t_ns)
        if self._clock_ns.size and likely > self._room.shots:
            self._room.make_room_for_shots(likely)
        return {
            "candidates": likely,
            "pixels": self.height * self.width,
            "width": self.width,
            "limit": int(INTENSITY_LIMIT_BITS),
            **self._own_values(t_ns),
        }

    def _likely_shots(self, t_ns: int) -> int:
        """Candidates of noise that no block is likely to have more of, up to ``t_ns``."""
        dt_ns = t_ns - (self.t_ns or 0)
        most = self._shot_unit * float(self._shot_table[:, -1].max()) * dt_ns if self._clock_ns.size else 0.0
        return int(most + 6.0 * most**0.5) + FEW_SHOTS

    def _own_values(self, t_ns: int) -> dict[str, Any]:
        """What sequences of one size do not share, as shaders/include/v2e_tiles.glsl names it."""
        v = self._interval(t_ns, 0.0)
        self._make_noise_sizes(v.dt_ns)
        if self._noise.size:
            self._room.put_sizes(self._noise_sizes)
        single = lambda value: int(np.float32(value).view(np.uint32))
        double = lambda value: words(int(np.float64(value).view(np.uint64)))
        return {
            "share": max(BLOCK, self.config.max_events_per_step // self._blocks),
            "bound": min(v.bound_per_pixel, 2**31),
            "inverse_threshold": double(v.inverse_threshold),
            "scale": single(v.scale),
            "seed": words(int(self.seed)),
            "number": v.step,
            "since": single(v.since_epoch_1),
            "kappa": single(v.kappa),
            "kappa_double": double(v.kappa),
            "second_keep": single(v.second_keep),
            "second_ramp": single(v.second_ramp),
            "start": words(v.t0_ns),
            "start_ns": v.t0_ns - 1000 * v.base_us,
            "dt_ns": words(v.dt_ns),
            "dt_whole": double(v.dt_ns),
            "dt_s": double(v.dt_ns * 1e-9),
            "since_0": double(v.since_epoch_0),
            "since_1": double(v.since_epoch_1),
            "leak_jitter": double(v.leak_jitter),
            "refractory_ns": words(v.refractory_ns),
            "shot_unit": double(v.shot_unit_per_ns),
        }

    # -- kernels --------------------------------------------------------------------------------------------
    def _fire(self, flight: Flight, checked: bool) -> None:
        self._stages.fire(flight.values, checked=checked)

    def _emit(self, flight: Flight) -> None:
        self._stages.emit(flight.values)

    def _with_room(self, head: np.ndarray, flight: Flight) -> np.ndarray:
        candidates = flight.values.get("candidates", 0)
        while head[UNUSABLE]:  # more noise than was likely: nothing has fired
            candidates = max(2 * candidates, self._room.shots)
            self._room.make_room_for_shots(max(candidates, 2 * self._room.shots))
            self._room.clear_head()
            self._fire(flight._replace(values={**flight.values, "candidates": candidates}), checked=False)
            head = self._head()
        return head

    # -- state ----------------------------------------------------------------------------------------------
    def _put_state(self) -> None:
        for array, buffer, plane in self._planes:
            self._room.put_plane(buffer, plane, array)
        if self._clock_ns.size:
            self._room.put_clocks(np.stack([self._clock_ns, self._clock_index], axis=1))
        self._due_ns = None
        self._brightness = {self.frames - 1: float(self._brightest[0])}

    def _get_state(self) -> None:
        self._begin_due_leaks()
        for array, buffer, plane in self._planes:
            array[...] = self._room.get_plane(buffer, plane, array.dtype.type)
        if self._clock_ns.size:
            self._clock_ns[...], self._clock_index[...] = self._room.get_clocks().T
        brightest = self._brightness.get(self.frames - 1)
        if brightest is None:
            brightest = float(self._room.get("now", np.float32).max() * self._scale)
        self._brightest[0] = brightest
