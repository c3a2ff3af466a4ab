"""An event camera: an emulator with its read-out, and the one loop that passes frames through it.

Generated sequences, converted frames, videos, references and benchmarks all use this loop, so none of them can leave
out the read-out.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import EventDataError
from blinkgl.events.emulator import Emulator
from blinkgl.events.light_noise import LightNoise
from blinkgl.events.pixels import PixelNoise
from blinkgl.events.rate_control import RateController
from blinkgl.events.resets import FrameResets
from blinkgl.events.table import EMULATORS, make_emulator
from blinkgl.events.truth import Surfaces, SurfaceTruth
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import OPTIONAL, Events

# ---------------------------------------------------------------------------------------------------------------------
# The read-out bus: what happens to events when a sensor makes more than it can send.
#
# One bus, first come first served. An event that finds ``queue_events`` others waiting is lost. The others are stamped
# when they leave the bus, ``1 / events_per_second`` after the one before (plus ``row_ns`` where the row changes or the
# bus was idle). Below the limit events are late by less than a microsecond; above it time stamps lag by up to
# ``queue_events / events_per_second`` and the output rate is the bus's. Events of one microsecond are served in raster
# order, as by a row arbiter, so in overload the upper rows of that microsecond come first.
#
# After the bus comes the clock: a time stamp is the last tick of ``clock_us`` that has passed.
#
# An event is output when it leaves the bus. A recording that ends at time T therefore ends with the last event that
# left by T; events still on the bus are not part of it and are counted (``late``).

# Time on the bus is counted in ps, so that the rounding of 1 / events_per_second does not accumulate. It starts at the
# first event, because ps since 1970 do not fit 64 bits.
_PS_PER_US = 1_000_000
_NO_EVENT_YET = -(2**62)


@kernel(error_model="numpy")
def _serve(t_us, y, event_ps, row_ps, waiting, state, keep, out_us):
    """Serve events. ``waiting``: ring of the times (ps) at which the last accepted events left.
    ``state``: accepted, bus free (ps), row."""
    kept, size = 0, waiting.size
    accepted, free_ps, row = state[0], state[1], state[2]
    for i in range(t_us.size):
        arrival = t_us[i] * _PS_PER_US
        # The place in the ring of the event ``size`` places ahead.
        slot = accepted % size
        if accepted >= size and waiting[slot] > arrival:
            # The event ``size`` places ahead has not left: the queue is full.
            continue
        start = max(arrival, free_ps)
        # The row's address is sent when the row changes or the bus was idle.
        if row_ps and (np.int64(y[i]) != row or start > free_ps):
            start += row_ps
        row, free_ps = np.int64(y[i]), start + event_ps
        waiting[slot] = free_ps
        accepted += 1
        keep[kept] = i
        out_us[kept] = free_ps // _PS_PER_US
        kept += 1
    state[0], state[1], state[2] = accepted, free_ps, row
    return kept


class Readout:
    """Events of an emulator, in order, chunk by chunk -> the events the sensor sends.

    ``dropped`` counts the events that found the queue full or that the rate controller took out; ``late`` those that
    had not left the bus by the end of the last step.
    """

    def __init__(self, config: ReadoutConfig):
        self.config = config
        self._overrun = 0
        rate = config.events_per_second
        self._event_ps = 0 if rate is None else max(1, round(1e12 / rate))
        self._row_ps = round(config.row_ns * 1000)
        self._waiting = np.zeros(config.queue_events, np.int64)
        # Events accepted; time from which the bus is free (always); its row (none); µs of the first event.
        self._state = np.array([0, -(2**62), -1, _NO_EVENT_YET], np.int64)
        self._on_bus = Events.empty()
        self._control = None if config.max_rate is None else RateController(config.max_rate)

    @property
    def dropped(self) -> int:
        return self._overrun + (0 if self._control is None else self._control.dropped)

    @property
    def late(self) -> int:
        """Return the number of accepted events that no step has returned yet."""
        return len(self._on_bus)

    def step(self, events: Events, until_us: int | None = None) -> Events:
        """Return the events that leave the bus until ``until_us`` (that microsecond included), stamped when they leave
        and in order from step to step; later ones wait for the next step. None: all of them, however late.

        ``until_us`` : the time up to which the emulator has given its events, int µs.
        Raises EventDataError 100 days after the first event, which picoseconds in int64 cannot hold."""
        events = self._inside(events)
        sent = self._serve(events) if len(events) and self._event_ps else events
        # Events that have been served are already in order and later than those still on the bus.
        if self.late:
            sent = Events.concatenate([self._on_bus, sent])
        count = len(sent) if until_us is None else int(np.searchsorted(sent.t, until_us, side="right"))
        self._on_bus = sent.part(slice(count, None)).copy()
        passed = sent.part(slice(count))
        return self._stamped(passed if self._control is None else self._control.step(passed))

    def _inside(self, events: Events) -> Events:
        """Return the events of the region of interest, all where there is none."""
        if self.config.roi is None or not len(events):
            return events
        x, y, width, height = self.config.roi
        return events.part((events.x >= x) & (events.x < x + width) & (events.y >= y) & (events.y < y + height))

    def _stamped(self, events: Events) -> Events:
        """Return the events stamped with the last tick of the clock."""
        tick = self.config.clock_us
        return events if tick == 1 else replace(events, t=events.t - events.t % tick)

    def _serve(self, events: Events) -> Events:
        """Return the events that find a place in the queue, with the times at which they leave the bus."""
        if self._state[3] == _NO_EVENT_YET:
            self._state[3] = events.t[0]
        origin_us = int(self._state[3])
        # 2^43 us are 8.8e18 ps, just below 2^63.
        if int(events.t[-1]) - origin_us > 2**43:
            raise EventDataError(
                "the time since the first event is too long",
                value=f"{(int(events.t[-1]) - origin_us) / 8.64e10:.4g} days",
                accepted="at most 100 days",
            )
        keep, out_us = np.empty(len(events), np.int64), np.empty(len(events), np.int64)
        after_us = events.t - origin_us
        kept = _serve(after_us, events.y, self._event_ps, self._row_ps, self._waiting, self._state, keep, out_us)
        self._overrun += len(events) - kept
        keep = keep[:kept]
        return replace(events.part(keep), t=out_us[:kept] + origin_us)

    def state_dict(self) -> dict[str, np.ndarray]:
        return {
            "waiting": self._waiting.copy(),
            "state": self._state.copy(),
            "dropped": np.array([self._overrun], np.int64),
            **({} if self._control is None else {"control": self._control.state_dict()}),
            **{f"on_bus_{k}": getattr(self._on_bus, k).copy() for k in self._on_bus.columns},
        }

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        columns = ("x", "y", "t", "p", *(k for k in OPTIONAL if f"on_bus_{k}" in state))
        control = () if self._control is None else ("control",)
        known = {"waiting", "state", "dropped", *control, *(f"on_bus_{k}" for k in columns)}
        mine = {"waiting": self._waiting, "state": self._state}
        if set(state) != known or any(state[name].shape != array.shape for name, array in mine.items()):
            raise EventDataError("the saved state belongs to another read-out", value=sorted(state))
        self._waiting[...], self._state[...], self._overrun = state["waiting"], state["state"], int(state["dropped"][0])
        if self._control is not None:
            self._control.load_state_dict(state["control"])
        self._on_bus = Events(**{k: state[f"on_bus_{k}"].copy() for k in columns})


_NOTHING = nullcontext()


class EventFrame(NamedTuple):
    """Input of an emulator at one time; valid until the next one is requested, so that a source may reuse its arrays.

    luminance : (H, W) float32, linear, or uint8 codes; or a tensor on the camera's :attr:`~EventCamera.tensor_device`.
    rows : (y0, y1): outside these rows the frame equals the one before; None: it may differ anywhere. See
    ``Emulator.step``. surfaces : the surfaces seen by the pixels, for a camera that records the truth of its events."""

    t_ns: int
    luminance: Any
    rows: tuple[int, int] | None = None
    surfaces: Surfaces | None = None


class EventCamera:
    """The ``events:`` and ``readout:`` sections of a configuration: takes frames, returns the events that leave the
    sensor.

    The light, changed by the jumps of a frame camera's resets, goes into the emulator; its events go through the
    pixels' defects and noise, the bus and its clock, as far as the configuration has them.
    readout : None: none of these.   seed : of the draws.
    emulator : the :class:`Emulator` itself.
    truth : finds the surface of each event, for frames with ``surfaces``; None: not requested.
    make : makes the emulator, on the CPU or on the requested device (``tensors/choice.py``).
    Raises EventDataError: a size out of range, a region of interest outside the picture."""

    def __init__(
        self,
        config: EmulatorConfig,
        readout: ReadoutConfig | None,
        height: int,
        width: int,
        seed: int,
        truth: SurfaceTruth | None = None,
        make: Callable[..., Emulator] = make_emulator,
    ):
        self._truth = truth
        self.emulator = make(config, height, width, seed)
        self.frames = 0
        """Frames taken so far."""
        self._unheard: str | None = None
        self._pixels, self._noise, self._readout, self._resets = None, None, None, None
        if readout is not None:
            if readout.frame_resets is not None:
                # A reset's size is stated in log intensity, the emulator's level in thresholds of its own response.
                response = EMULATORS[config.emulator].response(config)
                self._resets = FrameResets(readout.frame_resets, self.emulator, response.threshold / response.gain)
            if readout.pixels is not None:
                self._pixels = PixelNoise(readout.pixels, height, width, seed, self.emulator.causes)
            if readout.light_noise is not None and not self.emulator.noisy:
                self._unheard = config.emulator
            # Rates by light need an emulator that has noise; ESIM says that it has none.
            elif readout.light_noise is not None:
                self._noise = LightNoise(readout.light_noise, height, width, seed, self.emulator.causes)
            if readout.roi is not None and (readout.roi[0] >= width or readout.roi[1] >= height):
                raise EventDataError(
                    "the region of interest lies outside the picture",
                    where="readout.roi",
                    value=list(readout.roi),
                    accepted=f"[x, y, width, height] that meets {width}x{height} px",
                )
            self._readout = Readout(readout)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what of the read-out its emulator leaves out, a line each."""
        if self._unheard is None:
            return ()
        return (
            f"events: {self._unheard} models no noise and leaves out readout.light_noise; v2e and voltmeter have it",
        )

    @property
    def records_truth(self) -> bool:
        """Return whether the surface of each event is recorded, so that frames must have ``surfaces``."""
        return self._truth is not None

    @property
    def tensor_device(self) -> Any:
        """Return the torch device of which it takes frames as tensors; None: only arrays, because the emulator or
        another part of the camera needs them."""
        arrays = (self._truth, self._resets, self._noise)
        return self.emulator.tensor_device if all(part is None for part in arrays) else None

    @property
    def saturated(self) -> int:
        """Return the events cut by the emulator's ``max_events_per_step`` so far."""
        return self.emulator.saturated

    @property
    def dropped(self) -> int:
        """Return the events that the read-out has lost so far: the queue was full, or the rate controller took them
        out."""
        return 0 if self._readout is None else self._readout.dropped

    @property
    def late(self) -> int:
        """Return the number of events that wait on the bus."""
        return 0 if self._readout is None else self._readout.late

    def step(self, frame: EventFrame) -> Events:
        """Return the new events that leave by the frame's time. Raises EventDataError as ``Emulator.step``; its
        ``t_ns`` is then the frame's."""
        self.frames += 1
        try:
            events = self._emulated(frame)
        except EventDataError as error:
            error.t_ns = frame.t_ns if error.t_ns is None else error.t_ns
            raise
        if self._truth is not None and frame.surfaces is not None:
            memory_s = self.emulator.memory_s(self.emulator.decoded(frame.luminance))
            self._truth.see(frame.t_ns, frame.surfaces, memory_s)
        until_us = frame.t_ns // 1000
        if self._pixels is not None:
            events = self._pixels.step(events, until_us)
        if self._noise is not None:
            events = self._noise.step(events, until_us, self.emulator.decoded(frame.luminance))
        if self._truth is not None:  # the later stages keep the truth with its event
            events = replace(events, truth=self._truth.of(events, frame.t_ns))
        return events if self._readout is None else self._readout.step(events, until_us)

    def _emulated(self, frame: EventFrame) -> Events:
        """Return the emulator's events, also those of frames inserted before this one."""
        if self._resets is None:
            return self.emulator.step(frame.luminance, frame.t_ns, frame.rows)
        shown = self._resets.shown(frame.t_ns, self.emulator.decoded(frame.luminance))
        chunks = [self.emulator.step(light, t_ns, None if jump else frame.rows) for t_ns, light, jump in shown]
        # Up to the first frame the pixels get used to the resets; no events are recorded.
        return Events.concatenate(chunks) if self.frames > 1 else chunks[0]


def emulate(
    frames: Iterable[EventFrame],
    camera: EventCamera,
    clock: Callable[[str], AbstractContextManager] = lambda _: _NOTHING,
) -> Iterator[tuple[int, Events]]:
    """Yield (t_ns, events) frame by frame: all new events before t_ns's microsecond.

    The loop requests a frame and yields its events before it requests the next.
    clock : ``clock("events")`` is entered around the camera's work."""
    for frame in frames:
        with clock("events"):
            events = camera.step(frame)
        yield frame.t_ns, events


FIRST = 3
"""Frames of a sequence that are not worked on beside others."""


def emulate_beside(
    frames: Iterable[EventFrame],
    camera: EventCamera,
    clock: Callable[[str], AbstractContextManager] = lambda _: _NOTHING,
) -> Iterator[tuple[int, Events]]:
    """Yield what :func:`emulate` does, bit for bit, while the next frame is made: the camera works in a thread of its
    own, on a copy of each frame. On one processor it is :func:`emulate`."""
    if len(os.sched_getaffinity(0)) < 2:
        yield from emulate(frames, camera, clock)
        return

    def step(frame: EventFrame) -> Events:
        with clock("events"):
            return camera.step(frame)

    with ThreadPoolExecutor(1, "emulator") as thread:
        working: tuple[int, Future[Events]] | None = None
        for number, frame in enumerate(frames):
            # Kernels are compiled at the first frames, and that time is taken off a clock that threads share.
            if number < FIRST:
                yield frame.t_ns, step(frame)
                continue
            if working is not None:
                yield working[0], working[1].result()
            # The source may overwrite its frame when the next is asked for.
            working = frame.t_ns, thread.submit(step, frame._replace(luminance=np.array(frame.luminance)))
        if working is not None:
            yield working[0], working[1].result()
