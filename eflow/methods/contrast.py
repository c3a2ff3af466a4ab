"""Contrast maximisation: finds the flow with the sharpest images of warped events.

Gallego, Rebecq and Scaramuzza (CVPR 2018). The objective is the squared gradient of the image (Gallego, Gehrig and
Scaramuzza, CVPR 2019) at the first, middle and last time, divided by its value at zero flow (Shiba, Aoki and Gallego,
ECCV 2022), which penalises flow that maps all events to one point at one of the times.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize

from blinkgl.errors import EventDataError
from eflow.data.window import Window
from eflow.methods.iwe import slope_at, vote
from eflow.types import Flow, Numbers

LEAST_EVENTS = 50
MOST_EVENTS = 60_000
"""Largest number of events; of more, every n-th is used, since further events cost time and hardly change the
result."""
HOT = 10.0
"""A pixel is hot if it has more than this many times the mean number of events of pixels with events."""
BLURS_PX = (4.0, 2.0, 1.0)
"""Standard deviations of the blur of successive optimisations: a coarse image has few local maxima."""
TIMES = ((0.0, 0.25), (0.5, 0.5), (1.0, 0.25))
"""(Reference time of the warp, as a share of the span; weight)."""
_FINEST_PX = 1.5
"""Largest blur, px, for which the image has the resolution of the sensor; above, its pixels are larger."""
MARGIN = 0.15
"""Border around the image, as a share of its larger side: flow must not gain by moving events out of the image."""
FARTHEST = 0.4
"""Largest translation over both windows, as a share of the larger side."""
MOST_GROWTH = 0.7
"""Largest change of flow per px over both windows. A field with a change of 2 maps all events to one point at the last
time: the sharpest image, but not the motion (event collapse)."""


@dataclass
class _Cloud:
    """Events as float64, at most :data:`MOST_EVENTS`. s : time as a share of the span, 0 to 1."""

    x: Numbers
    y: Numbers
    s: Numbers
    height: int
    width: int

    @classmethod
    def of(cls, windows: list[Window], height: int, width: int) -> _Cloud:
        t0, t1 = windows[0].t0, windows[-1].t1
        x, y = (np.concatenate([getattr(w, k).astype(np.float64) for w in windows]) for k in "xy")
        s = np.concatenate([w.t - t0 for w in windows]) / (t1 - t0)
        if len(x) < LEAST_EVENTS:
            raise EventDataError(
                "too few events for contrast maximisation",
                where=f"window [{t0}, {t1}) µs",
                value=len(x),
                accepted=f"at least {LEAST_EVENTS}",
            )
        # Rectified events may lie outside the picture, so numbers of pixels begin below 0.
        pixel = np.rint(y).astype(np.intp) * width + np.rint(x).astype(np.intp)
        counts = np.bincount(pixel - pixel.min())
        cold = counts[pixel - pixel.min()] <= HOT * counts[counts > 0].mean()
        x, y, s = x[cold], y[cold], s[cold]
        # Rounded up, so that no more than the most are left.
        every = -(-len(x) // MOST_EVENTS)
        return cls(x[::every], y[::every], s[::every], height, width)


class _Field:
    """A flow field that is linear in its parameters.

    basis : two (N, k) matrices: flow of N points in px over the span is basis[0] @ p, basis[1] @ p.
    limits : (k,) largest absolute value of each parameter."""

    def __init__(self, basis: tuple[Numbers, Numbers], limits: Numbers):
        self.basis, self.limits = basis, limits

    def at(self, p: Numbers) -> tuple[Numbers, Numbers]:
        return self.basis[0] @ p, self.basis[1] @ p

    def first(self, count: int) -> _Field:
        """Return the field of the first ``count`` parameters."""
        return _Field((self.basis[0][:, :count], self.basis[1][:, :count]), self.limits[:count])

    def pulled(self, slope: Numbers) -> Numbers:
        """Return the derivative (k,) by the parameters, given the derivative (N, 2) by the flow of the points."""
        return self.basis[0].T @ slope[:, 0] + self.basis[1].T @ slope[:, 1]


def _centred(x: Numbers, y: Numbers, height: int, width: int, unit: float) -> tuple[Numbers, Numbers]:
    return (x - (width - 1) / 2) / unit, (y - (height - 1) / 2) / unit


def affine_field(x: Numbers, y: Numbers, height: int, width: int) -> _Field:
    """Return an affine field of six parameters, px at the border: a translation, then the change with x, then that with
    y. The first two alone are a translation."""
    u, v = _centred(x, y, height, width, max(height, width) / 2)
    one, none = np.ones_like(u), np.zeros_like(u)
    most, growth = FARTHEST * max(height, width), MOST_GROWTH * max(height, width) / 2
    return _Field(
        (np.stack([one, none, u, none, v, none], axis=1), np.stack([none, one, none, u, none, v], axis=1)),
        np.array([most, most, growth, growth, growth, growth]),
    )


def rotation_field(x: Numbers, y: Numbers, height: int, width: int, focal: float) -> _Field:
    """Return the field of a rotating pin-hole camera, with three parameters, radians times the focal length
    (Longuet-Higgins and Prazdny 1980, the part that does not depend on depth)."""
    u, v = _centred(x, y, height, width, focal)
    most = FARTHEST * max(height, width)
    return _Field(
        (np.stack([u * v, -(1 + u * u), v], axis=1), np.stack([1 + v * v, -u * v, -u], axis=1)),
        np.array([most, most, MOST_GROWTH * focal]),
    )


def sharpness(cloud: _Cloud, flow: tuple[Numbers, Numbers], blur: float) -> tuple[float, Numbers]:
    """Return the mean squared gradient of the images of warped events over :data:`TIMES`, and its derivative (N, 2) by
    the flow of each event. flow : px over the span."""
    unit = max(1.0, blur / _FINEST_PX)  # a blurred image does not need fine pixels
    blur, edge = blur / unit, MARGIN * max(cloud.height, cloud.width) / unit
    shape = (math.ceil(cloud.height / unit + 2 * edge), math.ceil(cloud.width / unit + 2 * edge))
    total, slope, point = 0.0, np.zeros((len(cloud.x), 2)), np.empty((len(cloud.x), 2))
    for time, weight in TIMES:
        # Warped to one time: x' = x - (s - time) flow, in coarser pixels and inside of the border.
        share = cloud.s - time
        x, y = (cloud.x - share * flow[0]) / unit + edge, (cloud.y - share * flow[1]) / unit + edge
        votes = np.zeros(shape)
        vote(x, y, votes)
        image = ndimage.gaussian_filter(votes, blur, mode="constant", truncate=3)
        down, right = np.diff(image, axis=0), np.diff(image, axis=1)
        # Differences of neighbours: the gradient without a kernel of its own.
        total += weight * ((down**2).sum() + (right**2).sum())
        back = np.zeros(shape)  # derivative by the blurred image, then by the votes: a Gaussian filter is self-adjoint
        back[1:] += down
        back[:-1] -= down
        back[:, 1:] += right
        back[:, :-1] -= right
        slope_at(x, y, ndimage.gaussian_filter(2 * back, blur, mode="constant", truncate=3), point)
        # dx'/dflow = -(s - time) / unit, by the chain rule.
        slope -= (weight / unit) * share[:, None] * point
    return total, slope


LENGTHS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1)
"""Factors that :func:`sharpest_length` tries. Networks often return too long flow for short motion, and seldom too
short flow; and with independent motion a longer flow is always a little sharper (event collapse)."""
LENGTH_PRIOR = 0.03
"""Weight of (ln factor)^2, subtracted from the logarithm of the sharpness: it favours the network's own length."""
DENSE = 0.09
"""Events per pixel, of blocks of ``BLOCK`` px with events, from which a shorter flow is believed. Of fewer events the
sharpest image is often that of hardly any flow (docs/results_eflow.md has the bursts by their share of events)."""
BLOCK = 16


def sharpest_length(windows: list[Window], flow: Flow) -> tuple[float, str]:
    """Return (factor of a flow with which the warped events are sharpest, "" or why it stays 1). Networks estimate the
    direction of motion better than its length.

    windows : one, or two successive ones.   flow : (H, W, 2) px over the last of them. Events outside it (rectified
    ones may be) are left out.
    The factor is 1.0 if there are fewer than :data:`LEAST_EVENTS` events, nothing moves, sharpness grows down to the
    smallest factor, or events are too sparse (:data:`DENSE`) for a shorter flow to be believed."""
    height, width = flow.shape[:2]
    x, y = (np.rint(np.concatenate([getattr(w, k) for w in windows])).astype(np.int64) for k in "xy")
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    sizes = np.cumsum([len(w) for w in windows])[:-1]
    windows = [w.take(keep) for w, keep in zip(windows, np.split(inside, sizes), strict=True)]
    try:
        cloud = _Cloud.of(windows, height, width)
    except EventDataError:
        return 1.0, "too few events"
    # The flow is over the last window, and the cloud spans both.
    spans = (windows[-1].t1 - windows[0].t0) / (windows[-1].t1 - windows[-1].t0)
    at = flow[np.rint(cloud.y).astype(np.intp), np.rint(cloud.x).astype(np.intp)].astype(np.float64) * spans
    values = np.array([sharpness(cloud, (f * at[:, 0], f * at[:, 1]), BLURS_PX[-1])[0] for f in LENGTHS])
    if not np.isfinite(values).all() or not values.min() > 0:
        return 1.0, "nothing to sharpen"
    scores = np.log(values) - LENGTH_PRIOR * np.log(LENGTHS) ** 2
    best = int(scores.argmax())
    if best == 0:
        return 1.0, "no length is sharpest"
    blocks = np.unique(y[inside] // BLOCK * width + x[inside] // BLOCK).size
    if LENGTHS[best] < 1 and np.count_nonzero(inside) < DENSE * BLOCK**2 * blocks:
        return 1.0, "too few events"
    if best == len(LENGTHS) - 1:
        return LENGTHS[best], ""
    # Maximum of the parabola through three equally spaced factors.
    low, middle, high = scores[best - 1 : best + 2]
    step = LENGTHS[best + 1] - LENGTHS[best]
    return LENGTHS[best] + 0.5 * step * (low - high) / (low - 2 * middle + high), ""


def _climb(
    cloud: _Cloud,
    field: _Field,
    start: Numbers,
    blur: float,
    steps: int,
) -> tuple[Numbers, float]:
    """Return (parameters, relative sharpness) of the local maximum near ``start``."""
    none = (np.zeros_like(cloud.x),) * 2
    scale = sharpness(cloud, none, blur)[0] or 1.0

    def loss(p: Numbers) -> tuple[float, Numbers]:
        value, slope = sharpness(cloud, field.at(p), blur)
        return -value / scale, -field.pulled(slope) / scale

    bounds = list(zip(-field.limits, field.limits, strict=True))
    start = np.clip(start, -field.limits, field.limits)
    best = optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": steps})
    return best.x, -float(best.fun)


def _best_translation(cloud: _Cloud, keep: Numbers, most: float) -> Numbers:
    """Return the best of a grid of translations up to ``most``, (2,) px over the span, by the variance of an image with
    pixels four times as large."""
    coarse = 4.0
    x, y, s = cloud.x[keep] / coarse, cloud.y[keep] / coarse, cloud.s[keep] - 0.5
    shape = (math.ceil(cloud.height / coarse) + 2, math.ceil(cloud.width / coarse) + 2)
    reach = most / coarse
    # Three lengths an octave: the optimisation that follows bridges the rest.
    lengths = np.concatenate([[0.0], np.geomspace(0.5, max(reach, 0.6), max(2, math.ceil(3 * math.log2(2 + reach))))])
    best, top = np.zeros(2), -1.0
    for length in lengths:
        ways = max(1, math.ceil(4 * math.pi * min(length, 4)))  # half a coarse pixel apart for short translations
        for turn in 2 * math.pi * np.arange(ways) / ways:
            shift = length * np.array([math.cos(turn), math.sin(turn)])
            # Warped to the middle of the span; a border of one pixel catches what rounds out of the picture.
            image = np.zeros(shape)
            vote(x - s * shift[0] + 1, y - s * shift[1] + 1, image)
            value = (image**2).sum()
            if value > top:
                best, top = shift * coarse, value
    return best


class ContrastMaximisation:
    """A method (:class:`eflow.methods.Method`) that fits one flow field to both windows.

    field : "translation" | "affine" | "rotation".   focal : px, for rotation.
    The field is constant over both windows: a motion that changes within them is averaged."""

    def __init__(self, field: str, focal: float | None = None):
        self.field, self.focal = field, focal
        self.name, self.about = f"contrast-{field}", f"contrast maximisation, {field}"

    def __call__(self, old: Window, new: Window, height: int, width: int) -> Flow:
        """Return the flow over the new window, see :class:`eflow.methods.Method`."""
        cloud = _Cloud.of([old, new], height, width)
        # The search is for the flow over both windows, the result is that over the new one.
        span = (new.t1 - old.t0) / (new.t1 - new.t0)
        make = self._family(height, width)
        field = make(cloud.x, cloud.y)
        maxima = [self._from(cloud, field, start) for start in self._starts(cloud, field)]
        # The maximum of the blurred images may be worse than zero flow without blur.
        maxima.append(_climb(cloud, field, np.zeros(field.basis[0].shape[1]), BLURS_PX[-1], 30))
        p = max(maxima, key=lambda maximum: maximum[1])[0]
        grid = np.mgrid[:height, :width].reshape(2, -1).astype(np.float64)
        rows, columns = grid
        flow = np.stack(make(columns, rows).at(p), axis=1)
        return (flow.reshape(height, width, 2) / span).astype(np.float32)

    def _family(self, height: int, width: int) -> Callable[[Numbers, Numbers], _Field]:
        if self.field == "rotation":
            focal = self.focal
            assert focal is not None
            return lambda x, y: rotation_field(x, y, height, width, focal)
        if self.field == "translation":
            return lambda x, y: affine_field(x, y, height, width).first(2)
        return lambda x, y: affine_field(x, y, height, width)

    def _starts(self, cloud: _Cloud, field: _Field) -> list[Numbers]:
        """Return initial parameters: zero flow, the best translation, and the field nearest to the best translations of
        nine parts of the image."""
        most = FARTHEST * max(cloud.height, cloud.width)
        everywhere = np.ones(len(cloud.x), bool)
        whole = _best_translation(cloud, everywhere, most)
        wanted = np.broadcast_to(whole, (len(cloud.x), 2)).copy()
        starts = [np.zeros(field.basis[0].shape[1]), self._fit(field, wanted, everywhere)]
        if self.field != "translation":
            # Parts of a 3 x 3 grid, so that a field that turns or grows starts near what each part does.
            column = np.minimum((cloud.x * 3 / cloud.width).astype(int), 2)
            row = np.minimum((cloud.y * 3 / cloud.height).astype(int), 2)
            used = np.zeros(len(cloud.x), bool)
            for part in range(9):
                keep = row * 3 + column == part
                if keep.sum() >= LEAST_EVENTS:
                    wanted[keep], used = _best_translation(cloud, keep, most), used | keep
            if used.any():
                starts.append(self._fit(field, wanted, used))
        return starts

    @staticmethod
    def _fit(field: _Field, flow: Numbers, keep: Numbers) -> Numbers:
        basis = np.concatenate([field.basis[0][keep], field.basis[1][keep]])
        return np.linalg.lstsq(basis, np.concatenate([flow[keep, 0], flow[keep, 1]]), rcond=None)[0]

    @staticmethod
    def _from(cloud: _Cloud, field: _Field, start: Numbers) -> tuple[Numbers, float]:
        p, value = start, -math.inf
        # From coarse to fine: each maximum is the next start.
        for blur in BLURS_PX:
            p, value = _climb(cloud, field, p, blur, 30)
        return p, value
