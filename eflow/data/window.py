"""Windows of events, samples of two windows and their flow, and exact transforms of them.

Transforms act on the events, before any grid, so that they are right for every representation. Tests compare them with
the transforms of voxel grids.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from blinkgl.errors import EventDataError
from blinkgl.online.samples import StreamSample, WindowSample
from blinkgl.types.events import Events
from eflow.types import Flow, Mask

SIDES = ("old", "new")
"""The windows of a pair: the events before the reference time, and those after it."""


@dataclass(frozen=True, eq=False)
class Window:
    """Events of [t0, t1). x, y: (N,) uint16 px, or float32 rectified px; t: (N,) int64 µs; p: (N,) uint8 {0, 1}."""

    x: np.ndarray
    y: np.ndarray
    t: np.ndarray
    p: np.ndarray
    t0: int
    t1: int

    @classmethod
    def of(cls, events: Events, t0: int, t1: int) -> Window:
        """Return the window [t0, t1) µs of a stream."""
        e = events.window(t0, t1)
        return cls(e.x, e.y, e.t, e.p, t0, t1)

    def __len__(self) -> int:
        return len(self.t)

    def take(self, keep: np.ndarray) -> Window:
        """Return a window with the events of a mask or an index, in order."""
        return replace(self, x=self.x[keep], y=self.y[keep], t=self.t[keep], p=self.p[keep])

    def flipped(self, axis: str, size: int) -> Window:
        """Return the window mirrored along axis "x" or "y"; ``size`` is the width or height of the sensor."""
        column = getattr(self, axis)
        return replace(self, **{axis: (column.dtype.type(size - 1) - column).astype(column.dtype)})

    def transposed(self) -> Window:
        """Return the window with rows and columns exchanged."""
        return replace(self, x=self.y, y=self.x)

    def inverted(self) -> Window:
        """Return the window with all polarities swapped."""
        return replace(self, p=1 - self.p)

    def reversed(self) -> Window:
        """Return the window with time reversed: t -> t0 + t1 - t, order reversed, polarity swapped.

        Times are then in (t0, t1]. The voxel grid of the result is exactly -flip(bins) of the original one."""
        return replace(self, x=self.x[::-1], y=self.y[::-1], t=(self.t0 + self.t1) - self.t[::-1], p=(1 - self.p)[::-1])

    def with_events(self, x: np.ndarray, y: np.ndarray, t: np.ndarray, p: np.ndarray) -> Window:
        """Return the window with further events merged in by time; at equal times the original ones come first."""
        order = np.argsort(t, kind="stable")
        # Only the new events are sorted: the window may have 500,000.
        at = np.searchsorted(self.t, t[order], side="right") + np.arange(len(t))
        there = np.ones(len(self.t) + len(t), bool)
        there[at] = False
        # The rest keep their order, around the places of the new events.
        columns: list[np.ndarray] = []
        for old, new in ((self.x, x), (self.y, y), (self.t, t), (self.p, p)):
            column = np.empty(len(there), old.dtype)
            column[at], column[there] = new[order], old
            columns.append(column)
        x, y, t, p = columns
        return Window(x, y, t, p, self.t0, self.t1)


@dataclass(frozen=True)
class StreamWindow:
    """A reference time, the window before it and the window after it. name, scene : as of a
    :class:`RawSample`."""

    t_us: int
    old: Window
    new: Window
    name: str = ""
    scene: str = ""

    @classmethod
    def of(cls, events: Events, start: int, t_us: int, end: int) -> StreamWindow:
        """Return the windows [start, t_us) and [t_us, end) µs of a stream."""
        return cls(t_us, Window.of(events, start, t_us), Window.of(events, t_us, end))


def hit_pixels(windows: Iterable[Window], height: int, width: int) -> Mask:
    """Return the pixels with an event in one of the windows, (H, W) bool; events outside are left out."""
    hit = np.zeros((height, width), bool)
    for w in windows:
        x, y = (np.rint(c).astype(np.int64) for c in (w.x, w.y))
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        hit[y[inside], x[inside]] = True
    return hit


@dataclass(frozen=True, eq=False)
class RawSample:
    """A sample as a source returns it, before augmentation and grids.

    old, new : events of [t - Δ, t) and [t, t + Δ). height, width : sensor, px.
    flow : (H, W, 2) float32 px, t -> t + Δ, at reference time t; valid : (H, W) bool. None: no ground truth.
    backward, backward_valid : the same for t -> t - Δ, if the source has it.
    mask : (H, W) bool, pixels to evaluate (MVSEC: pixels with events inside the crop); None: all.
    name : "sequence/000012", unique in the data set. scene : group over which evaluation averages.
    """

    old: Window
    new: Window
    height: int
    width: int
    name: str
    scene: str
    flow: Flow | None = None
    valid: Mask | None = None
    backward: Flow | None = None
    backward_valid: Mask | None = None
    mask: Mask | None = None

    @property
    def has_events(self) -> bool:
        """Return whether both windows have events."""
        return len(self.old) > 0 and len(self.new) > 0

    def without(self, bottom: int, left: int) -> RawSample:
        """Return the sample without ``bottom`` rows and ``left`` columns, px. Raises EventDataError: none is left."""
        height, width = self.height - bottom, self.width - left
        if min(height, width) < 1:
            size = f"less than {(self.height, self.width)}"
            raise EventDataError("nothing is left of the sample", where=self.name, value=(bottom, left), accepted=size)

        def cut(w: Window) -> Window:
            # Rectified coordinates lie between pixels.
            w = w.take((w.x > left - 1) & (w.y < height) if w.x.dtype.kind == "f" else (w.x >= left) & (w.y < height))
            return replace(w, x=w.x - w.x.dtype.type(left))

        rest = lambda a: None if a is None else a[:height, left:]
        return replace(
            self,
            old=cut(self.old),
            new=cut(self.new),
            height=height,
            width=width,
            flow=rest(self.flow),
            backward=rest(self.backward),
            valid=rest(self.valid),
            backward_valid=rest(self.backward_valid),
            mask=rest(self.mask),
        )

    def flip(self, axis: str) -> RawSample:
        """Return the sample mirrored horizontally (axis "x") or vertically ("y")."""
        size, image_axis, component = (self.width, 1, 0) if axis == "x" else (self.height, 0, 1)
        turn = lambda a: None if a is None else np.flip(a, image_axis)
        sign = np.ones(2, np.float32)
        sign[component] = -1
        # a new array: sources may share theirs
        signed = lambda f: None if f is None else np.flip(f, image_axis) * sign
        return replace(
            self,
            old=self.old.flipped(axis, size),
            new=self.new.flipped(axis, size),
            flow=signed(self.flow),
            backward=signed(self.backward),
            valid=turn(self.valid),
            backward_valid=turn(self.backward_valid),
            mask=turn(self.mask),
        )

    def transpose(self) -> RawSample:
        """Return the sample with rows and columns, and components of flow, exchanged."""
        turn = lambda a: None if a is None else a.swapaxes(0, 1)
        swapped = lambda f: None if f is None else f.swapaxes(0, 1)[..., ::-1]
        return replace(
            self,
            old=self.old.transposed(),
            new=self.new.transposed(),
            height=self.width,
            width=self.height,
            flow=swapped(self.flow),
            backward=swapped(self.backward),
            valid=turn(self.valid),
            backward_valid=turn(self.backward_valid),
            mask=turn(self.mask),
        )

    def invert(self) -> RawSample:
        """Return the sample with all polarities swapped; flow does not change."""
        return replace(self, old=self.old.inverted(), new=self.new.inverted())

    def reverse(self) -> RawSample:
        """Return the sample with time reversed about the reference time.

        The windows exchange their places and run backwards. The target is the *backward* flow; minus the forward flow
        would be right only for constant velocity. Raises ValueError: no backward flow."""
        if self.backward is None:
            raise ValueError("time reversal needs the backward flow")
        t = self.new.t0  # mirrored about the reference: [t, t + Δ) becomes (t - Δ, t]
        move = lambda w: replace(w.reversed(), t=2 * t - w.t[::-1], t0=2 * t - w.t1, t1=2 * t - w.t0)
        return replace(
            self,
            old=move(self.new),
            new=move(self.old),
            flow=self.backward,
            valid=self.backward_valid,
            backward=self.flow,
            backward_valid=self.valid,
        )

    def drop(self, fraction: float, rng: np.random.Generator) -> RawSample:
        """Return the sample with each event lost with probability ``fraction``."""
        thin = lambda w: w.take(rng.random(len(w)) >= fraction)
        return replace(self, old=thin(self.old), new=thin(self.new))

    def hot_pixels(self, count: int, rate_hz: float, rng: np.random.Generator) -> RawSample:
        """Return the sample with ``count`` hot pixels, which fire ON events at ``rate_hz`` (a Poisson process)."""
        x, y = rng.integers(0, self.width, count), rng.integers(0, self.height, count)

        def burn(w: Window) -> Window:
            n = rng.poisson(rate_hz * (w.t1 - w.t0) * 1e-6, count)
            t = rng.integers(w.t0, w.t1, n.sum())
            return w.with_events(np.repeat(x, n), np.repeat(y, n), t, np.ones(n.sum(), np.uint8))

        return replace(self, old=burn(self.old), new=burn(self.new))

    def noise(self, rate_hz: float, rng: np.random.Generator) -> RawSample:
        """Return the sample with background activity: Poisson events of both polarities, ``rate_hz`` per pixel."""

        def add(w: Window) -> Window:
            n = rng.poisson(rate_hz * (w.t1 - w.t0) * 1e-6 * self.height * self.width)
            return w.with_events(
                rng.integers(0, self.width, n),
                rng.integers(0, self.height, n),
                rng.integers(w.t0, w.t1, n),
                rng.integers(0, 2, n).astype(np.uint8),
            )

        return replace(self, old=add(self.old), new=add(self.new))


def raw_sample(s: WindowSample | StreamSample) -> RawSample:
    """Return a rendered sample, of a stream of windows, as a RawSample."""
    assert isinstance(s, WindowSample)
    t, span = s.t_us, s.span_us
    return RawSample(
        Window(s.old.x, s.old.y, s.old.t, s.old.p, t - span, t),
        Window(s.new.x, s.new.y, s.new.t, s.new.p, t, t + span),
        s.height,
        s.width,
        name=s.name,
        scene=s.name.split("/")[0],
        flow=s.flow,
        valid=s.valid,
        backward=s.backward,
        backward_valid=s.backward_valid,
    )
