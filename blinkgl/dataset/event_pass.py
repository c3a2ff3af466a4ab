"""Pass 1 of a sequence: frames at the times the timeline asks for, through the emulator."""

from __future__ import annotations

from collections.abc import Iterator

from blinkgl.dataset.clock import StageClock
from blinkgl.errors import EventDataError
from blinkgl.events import Emulator, Events, emulator_of, make_emulator
from blinkgl.render.renderer import Renderer
from blinkgl.timeline import make_timeline


class EventPass:
    """Iterates over (t_ns, events): all events up to t_ns that have not been given before. Frames are drawn as it goes.

    timeline, events : ``timeline:`` and ``events:`` configurations.   seed : of the emulator's draws.
    clock : gets the seconds of the emulator as "events".   window_ns : first and last time; default: the scene's.

    emulator : Emulator.   timeline : Timeline, with what it achieved in ``info()``.   frames : drawn so far."""

    def __init__(self, timeline, events, renderer: Renderer, seed: int, clock: StageClock | None = None,
                 window_ns: tuple[int, int] | None = None):
        self.renderer, self._clock = renderer, clock or StageClock()
        self.emulator: Emulator = make_emulator(events, renderer.height, renderer.width, seed, timeline.reconstruction)
        first_ns, last_ns = window_ns or (renderer.scene.t0_ns, renderer.scene.t1_ns)
        self.timeline = make_timeline(timeline, first_ns, last_ns, renderer, emulator_of(events).response(events))
        self.frames = 0

    def __iter__(self) -> Iterator[tuple[int, Events]]:
        emulator, frame = self.emulator, None
        for t_ns in self.timeline:
            before, frame = frame, self.renderer.luminance(t_ns, rate=emulator.needs_rate)
            luminance, rate = frame.view(), frame.view("rate") if emulator.needs_rate else None
            self.timeline.observe(t_ns, luminance, rate)
            with self._clock("events"):
                try:
                    events = emulator.step(luminance, t_ns, frame.rows_changed_since(before), rate)
                except EventDataError as error:
                    raise self._explained(error, t_ns) from error
            self.frames += 1
            yield emulator.done_ns, events
        if emulator.lags:
            with self._clock("events"):
                events = emulator.flush()
            yield emulator.done_ns, events

    def _explained(self, error: EventDataError, t_ns: int) -> EventDataError:
        """The error with the time and, where a pixel is at fault, what is seen there."""
        if error.pixel is None:
            return error
        explained = EventDataError(f"{error.problem}: it shows {self.renderer.shown_at(*error.pixel, t_ns)}",
                                   where=f"{error.where} at {t_ns * 1e-9:.9g} s", value=error.value, accepted=error.accepted)
        explained.pixel = error.pixel
        return explained
