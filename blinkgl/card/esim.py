"""ESIM on the card (``shaders/compute/events_*.glsl``): the events of :class:`~blinkgl.events.esim.Esim`, bit for bit.

A step is ten dispatches. *Mark*: the logarithm of every pixel against its two levels, a bit each. *List*: the pixels
that fire, in raster order, their places found by prefix sums. *Fire*: how many events each has, its next levels, and a
record. *Emit*: the events, from the records alone, at places found by prefix sums again. No place comes of an unordered
atomic, so the order is that of the kernels on the processor before they sort, and the state has moved when events are
written: a buffer that is too small is made again and *emit* repeated, nothing is lost.

Logarithms and levels are whole numbers of 2^-25, times are divided exactly in 64 bits made of pairs of 32, the draws
of jitter are doubles made of whole numbers (:file:`shaders/include/soft_double.glsl`). What is left are sums and
products of floats in the logarithm; :mod:`blinkgl.card.proof` asks the card whether it rounds them as IEEE 754 says,
and where it does not, they are whole numbers, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.card.arith import words
from blinkgl.card.kernels import (
    HEAD_BYTES,
    PIXELS_AT,
    PIXELS_PER_GROUP,
    WORD,
    Kernels,
    refuse_without_compute,
)
from blinkgl.card.proof import rounds_like_ieee
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError, GLError
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.emulator import BLOCK
from blinkgl.events.esim import Esim
from blinkgl.events.types import Events

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext

_FAR = 2**30  # a level that no logarithm reaches: of the pixels that fill up the last block
_LARGEST_STEP = 22.0
"""Thresholds beyond that, ln units, do not fit into 32 bits with a logarithm; normal numbers stay below 8.6."""


class CardEsim(Esim):
    """See the module and :class:`~blinkgl.events.emulator.Emulator`; straight lines between frames alone.

    gl : where it runs; made current at every step.   soft_float : logarithms in whole numbers; None: where the card's
    own rounding is not that of IEEE 754.
    owns_gl : release the context with it.
    State on the card: 16 bytes per pixel, spread thresholds 8 more, jitter or a refractory period 16.
    Raises EventDataError for a configuration that it does not do, GLError: no compute shaders, or not enough memory."""

    device = "gl"

    def __init__(
        self,
        height: int,
        width: int,
        config: EsimConfig | None = None,
        seed: int = 0,
        reconstruction: str = "linear",
        *,
        gl: GLContext,
        owns_gl: bool = False,
        soft_float: bool | None = None,
    ):
        config = config or EsimConfig()
        if problem := self.unfit(config, reconstruction):
            raise problem
        refuse_without_compute(gl)
        super().__init__(height, width, config, seed, reconstruction)
        self.gl, self._owns_gl = gl, owns_gl
        gl.resume()
        self._kernels = Kernels(gl, not rounds_like_ieee(gl) if soft_float is None else soft_float)
        self._room = _Room(gl, self.height, self.width, self._on.size > 0, self._has_more)
        self._defines = {
            name: 1
            for name, there in (
                ("SPREAD", self._on.size),
                ("JITTER", self._fired.size),
                ("REFRACTORY", self._last_ns.size),
            )
            if there
        }
        if self._on.size:
            self._room.put("thresholds", np.stack([self._on, self._off], axis=1))
        self._before_is_log, self._stays = False, False
        self._made = 0, 0  # events of the last step, and the microsecond before it

    @classmethod
    def unfit(cls, config: EsimConfig, reconstruction: str = "linear") -> EventDataError | None:
        """Why the card's kernel does not do this, naming the key; None: it does."""
        if reconstruction != "linear":
            return EventDataError(
                "the card follows straight lines between frames only",
                where="timeline.reconstruction",
                value=reconstruction,
                accepted="linear, or events.device: cpu",
            )
        largest = max(config.contrast_threshold, config.contrast_threshold_off or 0.0)
        largest = 10.0 if config.threshold_sigma else largest
        if config.threshold_jitter and largest + 8.6 * config.threshold_jitter > _LARGEST_STEP:
            return EventDataError(
                "thresholds with so much jitter do not fit the card's whole numbers",
                where="events.threshold_jitter",
                value=config.threshold_jitter,
                accepted=f"at most {(_LARGEST_STEP - largest) / 8.6:.3g}, or events.device: cpu",
            )
        return None

    @classmethod
    def trial(cls, config: EsimConfig) -> EsimConfig:
        """What tells whether a card runs the same kernels as for this configuration right."""
        return EsimConfig(
            threshold_sigma=0.03 if config.threshold_sigma else 0.0,
            threshold_jitter=0.03 if config.threshold_jitter else 0.0,
            refractory_us=150.0 if config.refractory_us else 0.0,
        )

    @property
    def _has_more(self) -> bool:
        return bool(self._fired.size or self._last_ns.size)

    def release(self) -> None:
        """Frees what lies on the card. Harmless when repeated."""
        if not self.gl.released:
            with self.gl.borrowed():
                self._room.release()
            if self._owns_gl:
                self.gl.release()

    # -- steps ----------------------------------------------------------------------------------------------
    def advance(self, luminance: np.ndarray, t_ns: int) -> int:
        """As ``step``, but the events stay on the card, for :mod:`blinkgl.card.sinks`; how many there are."""
        self._stays = True
        try:
            self.step(luminance, t_ns)
        finally:
            self._stays = False
        return self._made[0]

    @property
    def on_card(self) -> tuple[moderngl.Buffer, int, int]:
        """Packed events of the last step as they were emitted, not sorted by time; how many; the microsecond that their
        times count from."""
        return self._room["packed"], *self._made

    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        events = super()._start(frame, t_ns, rate)
        self._made = 0, t_ns // 1000
        self.gl.resume()
        self._room.turn()
        self._room.put("now", self._intensity(frame))
        self._before_is_log = False
        self._put_state()
        return events

    def _intensity(self, frame: np.ndarray) -> np.ndarray:
        return self._decode[frame] if frame.dtype == np.uint8 else frame

    def _advance(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        self.gl.resume()
        room, before_us = self._room, self.t_ns // 1000
        room.turn()
        room.put("now", self._intensity(frame))
        self._fire(t_ns)
        self._before_is_log = False
        head = np.frombuffer(room["listed"].read(HEAD_BYTES), np.uint32)
        count, cut = int(head[7]), int(head[8])
        self.saturated += cut
        self._made = count, before_us
        if count > room.capacity:
            room.grow(count)
            self._emit(t_ns)
        if not count or self._stays:
            return Events.empty()
        return self._sorted(count, before_us, t_ns // 1000 - before_us)

    def _fire(self, t_ns: int) -> None:
        """Marks, lists, fires, and emits as far as there is room."""
        room, kernels, values = self._room, self._kernels, self._values(t_ns)
        kernels.run(
            "compute/events_mark.glsl",
            {},
            {0: room["now"], 1: room["levels"], 2: room["marks"]},
            values,
            items=room.words,
        )
        kernels.prefix_of_bits(room["listed"], room["marks"], room["sums"], room["places"], room.words)
        kernels.run(
            "compute/events_list.glsl",
            {},
            {0: room["marks"], 1: room["places"], 2: room["sums"], 3: room["listed"]},
            values,
            items=room.words,
        )
        buffers = {
            4: room["now"],
            5: room["before"],
            6: room["levels"],
            **({7: room["more"]} if self._has_more else {}),
        }
        self._run_fire({}, buffers, t_ns, values)
        kernels.prefix_of_counts(room["listed"], room["counts"], room["sums"], room["places"])
        self._emit(t_ns)

    def _emit(self, t_ns: int) -> None:
        buffers = {4: self._room["places"], 5: self._room["packed"]}
        self._run_fire({"EMIT": 1}, buffers, t_ns, self._values(t_ns))

    def _run_fire(
        self, defines: dict[str, int], buffers: dict[int, moderngl.Buffer], t_ns: int, values: dict[str, Any]
    ) -> None:
        room = self._room
        common = {0: room["listed"], 1: room["records"], 2: room["counts"]}
        if self._on.size:
            common[3] = room["thresholds"]
        long = {"LONG": 1} if t_ns - self.t_ns >= 2**31 else {}
        self._kernels.run(
            "compute/events_fire.glsl",
            {**self._defines, **long, **defines},
            {**common, **buffers},
            values,
            indirect=(room["listed"], PIXELS_AT),
        )

    def _values(self, t_ns: int) -> dict[str, Any]:
        jitter = np.float64(self.config.threshold_jitter * Q_ONE)
        return {
            "words": self._room.words,
            "eps": float(np.float32(self.config.log_eps)),
            "share": max(BLOCK, self.config.max_events_per_step // self._blocks),
            "before_is_log": self._before_is_log,
            "width": self.width,
            "steps": (self._on_all, self._off_all),
            "start_ns": self.t_ns % 1000,
            "dt_ns": words(t_ns - self.t_ns),
            "base_ns": words(self.t_ns - self.t_ns % 1000),
            "refractory_ns": words(self._refractory_ns),
            "floors": (self._floor_on, self._floor_off),
            "jitter": words(int(jitter.view(np.uint64))),
            "seed": words(int(self.seed)),
            "capacity": self._room.capacity,
        }

    def _sorted(self, count: int, base_us: int, span_us: int) -> Events:
        rows = self._buffer.rows(1, count)
        self._room["packed"].read_into(rows[0, :count], 8 * count)
        return self._buffer.to_events(np.array([count]), base_us, span_us, 1, self.causes)

    # -- state ----------------------------------------------------------------------------------------------
    def _put_state(self) -> None:
        self._room.put("levels", np.stack([self._upper, self._lower], axis=1))
        if self._has_more:
            more = np.zeros((self.height * self.width, 4), np.uint32)
            if self._fired.size:
                more[:, 0] = self._fired.view(np.uint32)
            if self._last_ns.size:
                more[:, 2:] = self._last_ns.view(np.uint32).reshape(-1, 2)
            self._room.put("more", more)

    def state_dict(self) -> dict[str, np.ndarray]:
        """As of :class:`Esim`, with which it may be exchanged."""
        if self.t_ns is not None:
            self.gl.resume()
            levels = self._room.get("levels", np.int32).reshape(-1, 2)
            self._upper[...], self._lower[...] = levels.T
            if self._before_is_log:  # restored, and not gone on since
                self._log[...] = self._room.get("now", np.int32)
            else:
                self._log[...] = log_q25(self._room.get("now", np.float32) + np.float32(self.config.log_eps))
            if self._has_more:
                more = self._room.get("more", np.uint32).reshape(-1, 4)
                if self._fired.size:
                    self._fired[...] = more[:, 0].view(np.int32)
                if self._last_ns.size:
                    self._last_ns[...] = np.ascontiguousarray(more[:, 2:]).view(np.int64)[:, 0]
        return super().state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.gl.resume()
        self._room.put("now", self._log)
        self._before_is_log = True
        self._put_state()


class _Room:
    """The buffers of one emulator. words : of 32 pixels, whole blocks.   capacity : events that `packed` holds."""

    def __init__(self, gl: GLContext, height: int, width: int, spread: bool, more: bool):
        self._gl, self._pixels = gl, height * width
        padded = -(-self._pixels // BLOCK) * BLOCK
        self.words, self.capacity = padded // WORD, max(BLOCK, padded // 4)
        record = 32 if more else 16
        sizes = {
            "now": 4 * padded,
            "before": 4 * padded,
            "levels": 8 * padded,
            "marks": 4 * self.words,
            "listed": HEAD_BYTES + 8 * padded,
            "records": record * padded,
            "counts": 4 * (padded + PIXELS_PER_GROUP),
            "places": 4 * (padded + PIXELS_PER_GROUP),
            "sums": 4 * (self.words + PIXELS_PER_GROUP),
            "packed": 8 * self.capacity,
            **({"thresholds": 8 * padded} if spread else {}),
            **({"more": 16 * padded} if more else {}),
        }
        _refuse_too_large(gl, sizes, f"{width}x{height}")
        self._buffers = {name: gl.ctx.buffer(reserve=size) for name, size in sizes.items()}
        self._buffers["levels"].write(np.tile(np.array([_FAR, -_FAR], np.int32), padded).tobytes())
        for name in ("now", "before"):
            self._buffers[name].write(np.ones(padded, np.float32).tobytes())

    def __getitem__(self, name: str) -> moderngl.Buffer:
        return self._buffers[name]

    def turn(self) -> None:
        """What is now becomes what was before; `now` is to be written."""
        both = self._buffers
        both["now"], both["before"] = both["before"], both["now"]

    def put(self, name: str, array: np.ndarray) -> None:
        self._buffers[name].write(np.ascontiguousarray(array))

    def get(self, name: str, dtype: type) -> np.ndarray:
        """Of all pixels, flat."""
        padded = self.words * WORD
        size = self._buffers[name].size // padded * self._pixels
        return np.frombuffer(self._buffers[name].read(size), dtype)

    def grow(self, count: int) -> None:
        """Room for so many events, and a quarter more."""
        capacity = count + count // 4
        _refuse_too_large(self._gl, {"packed": 8 * capacity}, f"{count} events in one step")
        self._buffers["packed"].release()
        self._buffers["packed"], self.capacity = self._gl.ctx.buffer(reserve=8 * capacity), capacity

    def release(self) -> None:
        for buffer in self._buffers.values():
            buffer.release()


def _refuse_too_large(gl: GLContext, sizes: dict[str, int], what: str) -> None:
    limit = gl.ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]
    largest = max(sizes.values())
    if largest > limit:
        raise GLError(
            f"{what} are too many for this card's buffers",
            where="events.device",
            value=f"{largest / 2**20:.0f} MiB in one",
            accepted=f"at most {limit / 2**20:.0f} MiB, or events.device: cpu",
        )
