"""Plane fitting: an edge that moves leaves times that grow along its way, so their slope is its slowness.

Benosman et al., "Event-based visual flow" (2014): the times of one polarity round an event are fitted by a plane, whose
gradient g (s/px) gives the motion across the edge, g / |g|². Of that part alone, which is all that an edge shows
of a motion (the aperture problem), full flow is made as in Lucas and Kanade (1981): the motion that the edges of a
neighbourhood agree on best.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy import ndimage

from blinkgl.errors import EventDataError
from eflow.data.window import Window

RADIUS = 3
"""Of the neighbourhood of a fit, px."""
LEAST = 8
"""Times in it that agree with the plane; fewer say nothing."""
WORST = 0.15
"""Largest mean distance of the times from their plane, as a share of the times' range."""
QUIET = 0.1
"""Share of the two windows for which a pixel must have been silent: only the first event of an edge that passes tells
when it came, and the later ones of a strong edge would make it look fast."""
REACH_PX = 20.0
"""Gaussian of the neighbourhood whose edges are asked for one motion."""


@numba.njit(cache=True, nogil=True)
def normal_flow(
    x: np.ndarray,
    y: np.ndarray,
    t: np.ndarray,
    p: np.ndarray,
    quiet: float,
    height: int,
    width: int,
    out: np.ndarray,
) -> None:
    """out (N, 2) float64: motion across the edge that each event is of, px/s; NaN where none can be told.

    x, y : px.   t : s, ascending.   p : 0 or 1.   quiet : s without an event of that polarity after which an event is
    the first of an edge. Each fit sees the events up to its own."""
    first, latest = np.full((2, height, width), -np.inf), np.full((2, height, width), -np.inf)
    for i in range(len(t)):
        column, row = x[i], y[i]
        surface = first[p[i]]
        out[i, 0] = out[i, 1] = np.nan
        silent = t[i] - latest[p[i], row, column]
        latest[p[i], row, column] = t[i]
        if silent < quiet:
            continue
        surface[row, column] = t[i]
        y0, y1 = max(0, row - RADIUS), min(height, row + RADIUS + 1)
        x0, x1 = max(0, column - RADIUS), min(width, column + RADIUS + 1)
        # The second and third time without what is far from the plane before, mostly another edge.
        a, b, c, limit = 0.0, 0.0, 0.0, np.inf
        good = False
        for _ in range(3):
            n = su = sv = st = suu = svv = suv = sut = svt = 0.0
            low = 0.0
            for r in range(y0, y1):
                for q in range(x0, x1):
                    age = surface[r, q] - t[i]
                    if age == -np.inf:
                        continue
                    u, v = float(q - column), float(r - row)
                    if abs(age - (a * u + b * v + c)) > limit:
                        continue
                    low = min(low, age)
                    n += 1
                    su += u
                    sv += v
                    st += age
                    suu += u * u
                    svv += v * v
                    suv += u * v
                    sut += u * age
                    svt += v * age
            good = False
            if n < LEAST or low == 0.0:
                break
            suu, svv, suv = suu - su * su / n, svv - sv * sv / n, suv - su * sv / n
            sut, svt = sut - su * st / n, svt - sv * st / n
            determinant = suu * svv - suv * suv
            if determinant < 1e-6 * (suu + svv) ** 2:
                break
            a, b = (svv * sut - suv * svt) / determinant, (suu * svt - suv * sut) / determinant
            c = (st - a * su - b * sv) / n
            residual = 0.0
            for r in range(y0, y1):
                for q in range(x0, x1):
                    age = surface[r, q] - t[i]
                    far = abs(age - (a * (q - column) + b * (r - row) + c))
                    if age > -np.inf and far <= limit:
                        residual += far
            residual /= n
            good = residual <= WORST * -low
            limit = 2 * residual + 1e-9
        steep = a * a + b * b
        if good and steep > 0:
            out[i, 0], out[i, 1] = a / steep, b / steep


class PlaneFitting:
    """Only slow and well separated edges fit well: the poor relation that the field began with."""

    name, about = "planes", "local planes through the times of events, then one motion per neighbourhood"

    def __call__(self, old: Window, new: Window, height: int, width: int) -> np.ndarray:
        """As :class:`eflow.methods.Method`."""
        x, y, p = (np.concatenate([getattr(w, k) for w in (old, new)]) for k in "xyp")
        t = np.concatenate([w.t - old.t0 for w in (old, new)]) * 1e-6
        x, y = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x, y, t, p = x[inside], y[inside], t[inside], p[inside].astype(np.int64)
        motion = np.empty((len(t), 2))
        normal_flow(x, y, t, p, QUIET * t[-1] if len(t) else 0.0, height, width, motion)
        motion *= (new.t1 - new.t0) * 1e-6
        speed = np.hypot(motion[:, 0], motion[:, 1])
        fits = np.isfinite(speed) & (speed > 0) & (speed < max(height, width))
        if fits.sum() < LEAST:
            raise EventDataError(
                "no edge whose motion could be told",
                where=f"window [{old.t0}, {new.t1}) µs",
                value=f"{len(t)} events",
                accepted="events of moving edges",
            )
        return self._agreed(x[fits], y[fits], motion[fits], speed[fits], height, width)

    @staticmethod
    def _agreed(
        x: np.ndarray, y: np.ndarray, motion: np.ndarray, speed: np.ndarray, height: int, width: int
    ) -> np.ndarray:
        """(H, W, 2) float32: with n the direction across an edge and s its speed, the f with the least sum of
        (n . f - s)² over the neighbourhood, an edge's weight 1 / s² because a fit's error grows with its speed."""
        n, weight = motion / speed[:, None], 1 / (speed**2 + 0.25)
        spread = lambda values: ndimage.gaussian_filter(
            np.bincount(y * width + x, weight * values, height * width).reshape(height, width), REACH_PX, truncate=3
        )
        xx, xy, yy = spread(n[:, 0] ** 2), spread(n[:, 0] * n[:, 1]), spread(n[:, 1] ** 2)
        bx, by = spread(n[:, 0] * speed), spread(n[:, 1] * speed)
        # Towards the motion across the edge where all edges are parallel, towards 0 where there are none.
        ridge = 0.02 * (xx + yy) + 1e-3 * (xx + yy).max()
        xx, yy = xx + ridge, yy + ridge
        determinant = xx * yy - xy * xy
        return np.stack([(yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant], -1).astype(np.float32)
