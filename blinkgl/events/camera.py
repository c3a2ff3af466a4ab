"""An event camera, emulator and what is behind it together, and the one loop that frames go through it in.

Whoever turns frames into events does it here: a generated sequence, converted frames, a video, a reference, a
benchmark. So what stands between an emulator and the outside, the read-out, is never left out by one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from blinkgl.config.events import EmulatorConfig
from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import EventDataError
from blinkgl.events.pixels import PixelNoise
from blinkgl.events.readout import Readout
from blinkgl.events.resets import FrameResets
from blinkgl.events.table import EMULATORS, make_emulator
from blinkgl.events.truth import Surfaces, SurfaceTruth
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from blinkgl.events.emulator import Emulator

_NOTHING = nullcontext()


class EventFrame(NamedTuple):
    """What an emulator is given of one moment; valid until the next one is asked for, so
    that a source may reuse its arrays.

    luminance : (H, W) float32, linear, or uint8 codes; or a tensor on the camera's
    :attr:`~EventCamera.tensor_device`.
    rows : (y0, y1): outside these rows the frame is the one before; None: it may differ anywhere.
    As of ``Emulator.step``. surfaces : what the pixels show, of a camera that says what made its events."""

    t_ns: int
    luminance: Any
    rows: tuple[int, int] | None = None
    surfaces: Surfaces | None = None


class EventCamera:
    """``events:`` and ``readout:`` of a configuration: frames in, the events that leave the sensor out.

    Light goes through the jumps that a frame camera's resets make into the emulator, its events through the pixels'
    defects and the bus with its clock, as far as the configuration has them.
    readout : None: none of it.   seed : of the draws.
    emulator : the :class:`Emulator` itself.
    truth : says what made each event, of frames that come with their ``surfaces``; None: nobody asks.
    make : of the emulator: that on the processor, or on the device that is asked for (``tensors/choice.py``).
    Raises EventDataError: a size out of range."""

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
        """Taken so far."""
        self._pixels, self._readout, self._resets = None, None, None
        if readout is not None:
            if readout.frame_resets is not None:
                response = EMULATORS[config.emulator].response(config)
                self._resets = FrameResets(readout.frame_resets, response.threshold / response.gain)
            if readout.pixels is not None:
                self._pixels = PixelNoise(readout.pixels, height, width, seed, self.emulator.causes)
            self._readout = Readout(readout)

    @property
    def tells(self) -> bool:
        """Whether events say what made them, so that frames have to come with their ``surfaces``."""
        return self._truth is not None

    @property
    def tensor_device(self) -> Any:
        """The torch device of which it takes frames as tensors; None: arrays alone, because the emulator does or
        because something else of the camera looks at them."""
        return self.emulator.tensor_device if self._truth is None and self._resets is None else None

    @property
    def saturated(self) -> int:
        """Events cut by the emulator's ``max_events_per_step`` so far."""
        return self.emulator.saturated

    @property
    def dropped(self) -> int:
        """Events that found the read-out's queue full, so far."""
        return 0 if self._readout is None else self._readout.dropped

    @property
    def late(self) -> int:
        """Events under way to the outside, on the bus."""
        return 0 if self._readout is None else self._readout.late

    def step(self, frame: EventFrame) -> Events:
        """The events that are out by the frame's time and were not before. Raises EventDataError as ``Emulator.step``;
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
        if self._truth is not None:  # what is behind the pixels carries it along, whenever it lets an event go
            events = replace(events, truth=self._truth.of(events, frame.t_ns))
        return events if self._readout is None else self._readout.step(events, until_us)

    def _emulated(self, frame: EventFrame) -> Events:
        """The emulator's events, of what else its pixels are shown before the frame, too."""
        if self._resets is None:
            return self.emulator.step(frame.luminance, frame.t_ns, frame.rows)
        shown = self._resets.shown(frame.t_ns, self.emulator.decoded(frame.luminance))
        chunks = [self.emulator.step(light, t_ns, None if jump else frame.rows) for t_ns, light, jump in shown]
        return chunks[0] if len(chunks) == 1 else Events.concatenate(chunks)


def emulate(
    frames: Iterable[EventFrame],
    camera: EventCamera,
    clock: Callable[[str], AbstractContextManager] = lambda _: _NOTHING,
) -> Iterator[tuple[int, Events]]:
    """(t_ns, events) frame by frame: all events before t_ns's microsecond that have not been given before.

    The loop asks for a frame, takes its events and gives them away before it asks for the next.
    clock : ``clock("events")`` is entered around the camera's work."""
    for frame in frames:
        with clock("events"):
            events = camera.step(frame)
        yield frame.t_ns, events
