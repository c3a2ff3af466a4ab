"""ESIM on the card (``shaders/compute/events_*.glsl``): the events of :class:`~blinkgl.events.esim.Esim`, bit for bit.

A step is ten dispatches. *Mark*: the logarithm of every pixel against its two levels, a bit each;
of a texture also whether it has a value that cannot be used, in which case nothing fires. *List*: the pixels that fire,
in raster order, their places found by prefix sums. *Fire*: how many events each has, its next levels, and a record.
*Emit*: the events, from the records alone, at places found by prefix sums again; the state has moved by then, and
*emit* may be repeated.

Logarithms and levels are whole numbers of 2^-25, times are divided exactly in 64 bits made of pairs of 32. What is left
are sums and products of floats in the logarithm, and the doubles of which the draws of jitter are made;
:mod:`blinkgl.card.proof` asks the card whether it rounds them as IEEE 754 says, and where it does not, they are whole
numbers, too (:file:`shaders/include/soft_float.glsl`, :file:`soft_double.glsl`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.card.arith import words
from blinkgl.card.emulator import CardEmulator, Flight
from blinkgl.card.kernels import Rounding, refuse_without_compute
from blinkgl.card.room import Room
from blinkgl.card.stages import Stages, is_long
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.emulator import BLOCK, INTENSITY_LIMIT_BITS
from blinkgl.events.esim import Esim
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

_LARGEST_STEP = 22.0
"""Thresholds beyond that, ln units, do not fit into 32 bits with a logarithm; normal numbers stay below 8.6."""


class CardEsim(CardEmulator, Esim):
    """See the module and :class:`~blinkgl.card.emulator.CardEmulator`; straight lines between frames alone.

    gl : where it runs; made current at every step.   rounding : what is computed in whole numbers; None: where the
    card's own rounding is not that of IEEE 754.
    owns_gl : release the context with it.
    late : ``step`` returns the events of the interval before its own, whose way back nobody had to wait for; ``flush``
    the last ones (as of any emulator that ``lags``). sorts : events are sorted on the card. None for either: where the
    context is not the processor's, which gains by neither. Events and their order are the same.
    State on the card: 16 bytes per pixel, spread thresholds 8 more, jitter or a refractory period 16.
    Raises EventDataError for a configuration that it does not do, GLError: no compute shaders, or not enough memory."""

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
        rounding: Rounding | None = None,
        late: bool | None = None,
        sorts: bool | None = None,
    ):
        config = config or EsimConfig()
        if problem := self.unfit(config, reconstruction):
            raise problem
        refuse_without_compute(gl)
        super().__init__(height, width, config, seed, reconstruction)
        self._set_up(gl, owns_gl, rounding, late, sorts)
        self._room = Room(
            gl,
            self.height * self.width,
            f"{width}x{height} pixels",
            (width, height),
            spread=self._on.size > 0,
            more=self._has_more,
        )
        self._stages = Stages(
            self._kernels,
            self._room,
            spread=bool(self._on.size),
            jitter=bool(self._fired.size),
            refractory=bool(self._last_ns.size),
        )
        if self._on.size:
            self._room.put("thresholds", np.stack([self._on, self._off], axis=1))
        self._before_is_log = False

    @classmethod
    def unfit(cls, config: EsimConfig, reconstruction: str = "linear") -> EventDataError | None:
        """Why the card's kernel does not do this, naming the key; None: it does."""
        if problem := super().unfit(config, reconstruction):
            return problem
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

    # -- kernels --------------------------------------------------------------------------------------------
    def _values(self, t_ns: int) -> dict[str, Any]:
        was_log, self._before_is_log = self._before_is_log, False
        return {
            "words": self._room.words,
            "limit": int(INTENSITY_LIMIT_BITS),
            "before_is_log": was_log,
            "width": self.width,
            **self._own_values((self.t_ns or 0, t_ns)),
        }

    def _fire(self, flight: Flight, checked: bool) -> None:
        self._stages.fire(flight.values, checked=checked, long=is_long(flight[:2]))

    def _emit(self, flight: Flight) -> None:
        self._stages.emit(flight.values, long=is_long(flight[:2]))

    def _undone(self, flight: Flight) -> None:
        self._before_is_log = flight.values["before_is_log"]

    def _own_values(self, interval: tuple[int, int]) -> dict[str, Any]:
        """What sequences of one size do not share, as shaders/include/tiles.glsl names it."""
        start_ns, end_ns = interval
        jitter = np.float64(self.config.threshold_jitter * Q_ONE)
        return {
            "eps": float(np.float32(self.config.log_eps)),
            "share": max(BLOCK, self.config.max_events_per_step // self._blocks),
            "steps": (self._on_all, self._off_all),
            "start_ns": start_ns % 1000,
            "dt_ns": words(end_ns - start_ns),
            "base_ns": words(start_ns - start_ns % 1000),
            "refractory_ns": words(self._refractory_ns),
            "floors": (self._floor_on, self._floor_off),
            "jitter": words(int(jitter.view(np.uint64))),
            "seed": words(int(self.seed)),
        }

    # -- state ----------------------------------------------------------------------------------------------
    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        self._before_is_log = False
        return super()._start(frame, t_ns, rate)

    def _put_state(self) -> None:
        self._room.put("levels", np.stack([self._upper, self._lower], axis=1))
        if self._has_more:
            more = np.zeros((self.height * self.width, 4), np.uint32)
            if self._fired.size:
                more[:, 0] = self._fired.view(np.uint32)
            if self._last_ns.size:
                more[:, 2:] = self._last_ns.view(np.uint32).reshape(-1, 2)
            self._room.put("more", more)

    def _get_state(self) -> None:
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

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._room.put("now", self._log)
        self._before_is_log = True
