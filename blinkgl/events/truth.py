"""The truth of an event: its surface, the surface's position and motion, from the two frames around the event.

An emulator sees a pixel only at the times of its frames, so the surface that made an event is in one of them:

- if the pixel shows the same surface in both, it is that surface, at the nearer frame in time;
- if not (an edge has passed), it is the one nearer to the camera: its edge moved. So the object makes the events behind
  itself, not the surface that it uncovers.

"The same surface" is the same instance at about the same depth (``_JUMP``): an arm in front of its own body passes,
too. In anti-aliased event frames a surface that covers a part of a pixel changes it as well; then the four pixels
around it are also considered (``reach``), where they show something that moves.

A pixel may follow a change after it is over (V2E's low-pass; :meth:`Emulator.memory_s`): for that time its events are
still those of the surface that left, and of the light that changed it. Noise events get the surface that their pixel
shows, and no light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blinkgl.types.events import TRUTH, Cause, Events

_JUMP = 0.05
"""Relative change of depth between frames beyond which one instance shows another of its surfaces."""
_AROUND = ((0, 0), (0, -1), (0, 1), (-1, 0), (1, 0))


class Surfaces(NamedTuple):
    """The surface at every pixel at one time. ids : (H, W) whole numbers, 0: nothing.   depth : (H, W) float32 along
    the optical axis, inf: nothing.   velocity : (H, W, 2) float32 px/s.
    light : (H, W) int32 number of the light that changed the pixel since the frame before, -1: none; None: no light of
    the scene changes."""

    ids: np.ndarray
    depth: np.ndarray
    velocity: np.ndarray
    light: np.ndarray | None = None


class SurfaceTruth:
    """Assigns events to the surfaces that made them, from the surfaces at the time of every frame.

    reach : 1 where a frame's pixels see more than their centres, 0 where they do not."""

    def __init__(self, reach: int = 0):
        self._offsets = _AROUND if reach else _AROUND[:1]
        self._seen: list[tuple[int, Surfaces]] = []
        self._left: Surfaces | None = None
        self._until_ns = np.empty(0, np.int64)
        self._lit: tuple[np.ndarray, np.ndarray] | None = None

    def see(self, t_ns: int, surfaces: Surfaces, memory_s: np.ndarray | None = None) -> None:
        """Add the surfaces at the time of a frame, in order. The arrays are kept until the frame after the next.

        memory_s : (H, W) how long a pixel follows a past change, s; None: not at all."""
        if memory_s is not None and self._seen:
            before = self._seen[-1][1]
            # The surface that the pixel showed was nearer and is gone.
            gone = (before.depth < surfaces.depth) & (before.ids != surfaces.ids)
            if self._left is None:
                self._left = Surfaces(*(array.copy() for array in _arrays(before)))
                self._until_ns = np.full(gone.shape, np.iinfo(np.int64).min)
            for kept, array in zip(_arrays(self._left), _arrays(before)):
                kept[gone] = array[gone]
            self._until_ns[gone] = _after(t_ns, memory_s[gone])
        if memory_s is not None and surfaces.light is not None:
            lit = surfaces.light >= 0
            if self._lit is None:
                self._lit = surfaces.light.copy(), np.full(lit.shape, np.iinfo(np.int64).min)
            self._lit[0][lit] = surfaces.light[lit]
            self._lit[1][lit] = _after(t_ns, memory_s[lit])
        self._seen = [*self._seen[-2:], (t_ns, surfaces)]

    def of(self, events: Events, done_ns: int) -> np.ndarray:
        """Return (N,) of :data:`~blinkgl.types.events.TRUTH` of events of the interval that ends at the frame of
        done_ns."""
        truth = np.empty(len(events), TRUTH)
        at = next(k for k, (t_ns, _) in enumerate(self._seen) if t_ns == done_ns)
        (before_ns, before), (after_ns, after) = self._seen[max(at - 1, 0)], self._seen[at]
        # Compared as twice the times, in whole numbers; an event is in the middle of its microsecond.
        late = 2 * (1000 * events.t + 500) >= before_ns + after_ns
        x, y = events.x.astype(np.intp), events.y.astype(np.intp)
        height, width = after.ids.shape
        pixel = y * width + x
        # What its pixel shows at the nearer of the two frames.
        speeds = _where(late, _looked_up(after, pixel), _looked_up(before, pixel))
        # found[1] is the depth, and the nearest surface wins.
        best = speeds[1].copy()
        for surfaces in (before, after):
            for dy, dx in self._offsets:
                place = np.clip(y + dy, 0, height - 1) * width + np.clip(x + dx, 0, width - 1)
                other = _looked_up(surfaces, place)
                # another part of the same instance counts only at the pixel itself
                jump = other[1] < best * (1 - _JUMP) if dy == dx == 0 else False
                passes = (other[1] < best) & ((other[0] != speeds[0]) | jump)
                if dy or dx:  # the edge of a surface at rest changes no pixel beside it
                    passes &= other[2].any(axis=1)
                speeds, best = _where(passes, other, speeds), np.where(passes, other[1], best)
        if self._left is not None:
            left = _looked_up(self._left, pixel)
            # The surface that has left, while its pixel still follows the change and nothing nearer is there.
            follows = (1000 * events.t <= self._until_ns.reshape(-1)[pixel]) & (left[1] < best)
            speeds = _where(follows & (left[0] != speeds[0]), left, speeds)
        truth["instance"], truth["depth"], truth["velocity"] = speeds
        truth["light"] = self._light(events, after.light, pixel)
        return truth

    def _light(self, events: Events, light: np.ndarray | None, pixel: np.ndarray) -> np.ndarray | int:
        if light is None:
            return -1
        numbers = light.reshape(-1)[pixel]
        if self._lit is not None:
            last, until_ns = (array.reshape(-1)[pixel] for array in self._lit)
            follows = (numbers < 0) & (1000 * events.t <= until_ns)
            numbers = np.where(follows, last, numbers)
        return numbers if events.cause is None else np.where(events.cause == Cause.SIGNAL, numbers, -1)


def _after(t_ns: int, memory_s: np.ndarray) -> np.ndarray:
    return t_ns + np.rint(1e9 * memory_s).astype(np.int64)


def _arrays(surfaces: Surfaces) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return surfaces.ids, surfaces.depth, surfaces.velocity


def _looked_up(surfaces: Surfaces, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    ids, depth, velocity = _arrays(surfaces)
    return ids.reshape(-1)[pixel], depth.reshape(-1)[pixel], velocity.reshape(-1, 2)[pixel]


def _where(which: np.ndarray, one: tuple, other: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return (
        np.where(which, one[0], other[0]),
        np.where(which, one[1], other[1]),
        np.where(which[:, None], one[2], other[2]),
    )
