"""The noise of given frames: estimated from the frames as they come, and prevented from becoming events.

A static camera's frames differ by noise, and an emulator interprets every difference as light. An event camera's own
pixels have less noise, which the emulator models (:mod:`blinkgl.events.noise`); the frames' noise must not be added to
it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.timeline.interpolate import DenseFlow

BAND = 4.0
"""Standard deviations of the noise within which a change counts as noise: of a hundred thousand static pixels, a dozen
exceed it per frame. For two recordings by static cameras, 3 leaves 0.6 and 4.5 times the event camera's events at
static pixels, 4 leaves 0.4 and 2.2; 5 begins to lose events of motion."""
_LEAP = 3.0
"""Bands by which the light has to change for a pixel to take it at once, instead of being pushed."""
MOST_CODES = 10.0
"""Of 255: standard deviation at middle brightness beyond which changes are no camera's noise but the scene's, such as a
stimulus of random dots. A phone's video by night has 5 to 8."""
_KEPT = 8
"""Pairs of frames, the last ones looked at, from which the noise is estimated."""
_PART_PX = (384, 512)
"""Rows and columns of a pair that are looked at."""
_FIRST, _EVERY, _EVERY_NOISY = 4, 16, 6
"""Every one of the first pairs is looked at, later every 16th, or every 6th where there is noise, and four in a row
where the picture's brightness or the share of pixels that change has changed by these factors."""
_BRIGHTER, _LIVELIER = 1.1, 2.0
_SPARSE_PX = 64
"""Side of the grid of pixels that tells whether the picture has changed its nature."""
_BLOCKS_PX = (8, 4)
"""Side of a block, and that of pictures of few rows or columns, which would show too few blocks at first."""
_QUANTILE, _OF_CHI_SQUARED = 0.2, {8: 0.85, 4: 0.70}
"""Part of the blocks of one brightness that are taken to hold noise alone, and the 20 % quantile of the mean square of
64 or 16 normal numbers: blocks in which something moves lie above."""
# The second difference along y of that along x, which is 0 for any f(x) + g(y). Its squares add up to 36.
_MASK = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_WHITE, _LEAST_WHITE = 0.6, 0.1
"""Of the variance at all scales, what there is at the finest if changes are white, and the part of the blocks in which
it has to be so."""
_EXPLAINED, _LEAST_STILL, _SMOOTH_PX = 0.62, 0.5, 41
"""Part of a change that remains along dense flow, below which it is motion; the part of the white blocks in which it
has to be noise; the side over which the flow is smoothed. Of noise 0.7 or more remains in nine blocks of ten, of
photographs that move by 0.5 px 0.2 to 0.5 (median), by 2 or 7 px 0.02."""
_PEAKED = (2.2, 6.0)
"""Kurtosis of a block's changes, median over the blocks, that noise can have (3 for a normal distribution, of which 64
samples show 2.8): dots that flip have 2 or less where all do, 10 where a tenth does."""
_COARSE, _ROUNDED = 1.5, 12.0
"""Codes below which rounding raises the kurtosis, and up to what."""
_BINS, _LEAST_BLOCKS = 12, 12
_NEARLY = 0.6
"""Part of the noise that was believed up to which a bound is news."""
_ALIKE = 0.5
"""Difference of pixels of one filter to that of neighbours, along both axes, up to which a picture is a mosaic of
colour filters: of other pictures neighbours are the most alike."""
_CLEAN = 0.35
"""Codes: rounding alone gives 0.29."""
_BRIGHT = 0.85
"""Fraction of full scale: above, codes are near their end, and noise is clipped."""


@dataclass(frozen=True)
class FrameNoise:
    """Variance of a pixel's noise, ``constant + slope * luminance``: what read-out and photons make of it in linear
    light (Foi et al., IEEE TIP 2008).   typical : (luminance, standard deviation), at the frames' middle brightness."""

    constant: float
    slope: float
    typical: tuple[float, float]

    def sigma(self, luminance: np.ndarray) -> np.ndarray:
        """Return the standard deviation at a luminance, of full scale."""
        return np.sqrt(self.constant + self.slope * luminance)

    def __str__(self) -> str:
        light, sigma = self.typical
        return f"the frames' own noise is {100 * sigma / light:.2g} % at middle brightness"


class _Look(NamedTuple):
    """What one pair of frames shows, per block, (N,).   light : mean luminance.   square : variance of a pixel's noise,
    over its lower quantile in such a block.
    kurtosis : of its change; 3 where unknown.   bound : whether ``square`` only bounds the noise from above, because
    all moves."""

    light: np.ndarray
    square: np.ndarray
    kurtosis: np.ndarray
    bound: bool = False


def estimated(looks: Sequence[_Look], code: Callable[[float], float]) -> tuple[FrameNoise | None, str | None]:
    """Return the noise that pairs of frames show, None for frames with only rounding noise, or too small to estimate;
    and the line that says why changes that look like noise are not believed, or None.

    code : the distance of two codes of 8 bits, in luminance, at a luminance."""
    if not looks:
        return None, None
    light, square, kurtosis = (np.concatenate([look[k] for look in looks]) for k in range(3))
    if len(light) < 2 * _LEAST_BLOCKS:
        return None, None
    # Classes of brightness with about equally many blocks.
    edges = np.quantile(light, np.linspace(0, 1, max(min(_BINS, len(light) // _LEAST_BLOCKS), 2) + 1))
    kind = np.clip(np.searchsorted(edges, light, side="right") - 1, 0, len(edges) - 2)
    kinds = np.unique(kind)
    level = np.array([light[kind == k].mean() for k in kinds])
    variance = np.array([np.quantile(square[kind == k], _QUANTILE) for k in kinds])
    constant, slope = _lower_line(level, variance)
    middle = float(np.median(light))
    sigma = float(np.sqrt(constant + slope * middle))
    codes = sigma / code(middle)
    if codes < _CLEAN:
        return None, None
    if codes > MOST_CODES:
        return None, (
            f"neighbouring frames differ like noise of {codes:.0f} codes of 255, more than a camera has "
            f"({MOST_CODES:.0f}): taken as the scene, and makes events"
        )
    shape = float(np.median(kurtosis))
    if not (_PEAKED[0] < shape < _PEAKED[1] if codes > _COARSE else shape < _ROUNDED):
        which = "few pixels change, by much" if shape > 3 else "pixels jump between few values"
        return None, f"neighbouring frames differ pixel by pixel, but unlike noise ({which}): taken as the scene"
    return FrameNoise(constant, slope, (middle, sigma)), None


def is_mosaic(image: np.ndarray) -> bool:
    """Return whether (H, W) light or codes are a mosaic of 2x2 colour filters."""
    if image.ndim != 2 or min(image.shape) < 2 * _BLOCKS_PX[0]:
        return False
    light = image[:_SEEN_PX, :_SEEN_PX].astype(np.float32)
    return all(
        np.abs(one[2:] - one[:-2]).mean() < _ALIKE * np.abs(one[1:] - one[:-1]).mean() for one in (light, light.T)
    )


_SEEN_PX = 512


def looked_at_phases(a: np.ndarray, b: np.ndarray) -> _Look | None:
    """Return :func:`looked_at` of the four filters of a mosaic, each a picture of its own: what changes from filter to
    filter is no noise."""
    places = [(slice(row, None, 2), slice(column, None, 2)) for row in (0, 1) for column in (0, 1)]
    looks = [look for at in places if (look := looked_at(*(np.ascontiguousarray(one[at]) for one in (a, b))))]
    if not looks:
        return None
    light, square, kurtosis = (np.concatenate([look[k] for look in looks]) for k in range(3))
    return _Look(light, square, kurtosis, any(look.bound for look in looks))


def looked_at(a: np.ndarray, b: np.ndarray) -> _Look | None:
    """Return what a pair of frames, (H, W) float32 luminance of full scale 1, shows of their noise: the blocks in which
    no code is at an end and the change is white, which noise is and a moving texture is not. None: it shows nothing."""
    count = lambda side: (a.shape[0] // side) * (a.shape[1] // side)
    block = next((side for side in _BLOCKS_PX if count(side) >= 4 * _LEAST_BLOCKS), _BLOCKS_PX[-1])
    height, width = (side // block * block for side in a.shape)
    if not height or not width:
        return None
    of_quantile = _OF_CHI_SQUARED[block]
    mean = lambda image: cv2.resize(
        image[:height, :width], (width // block, height // block), interpolation=cv2.INTER_AREA
    ).ravel()
    light = mean((a + b) / 2)
    # A code at either end of its range is clipped, so its noise is too small.
    ends = (np.minimum(a, b) <= 0) | (np.maximum(a, b) >= 1)
    inside = (mean(ends.astype(np.float32)) == 0) & (light < _BRIGHT)
    if not inside.any():
        return None
    change = b - a
    square, finest = _variance(change, mean)
    white = inside & (finest > _WHITE * square)
    if not white.any():
        # Nothing moves, or what does is smooth: there is no more noise than what is left at the finest scale.
        return _Look(light[inside], finest[inside] / of_quantile, np.full(np.count_nonzero(inside), 3.0), bound=True)
    followed = _followed(a, b) - a
    still = white & ~(mean(followed**2) < _EXPLAINED * mean(change**2))
    if np.count_nonzero(still) < max(_LEAST_WHITE * np.count_nonzero(inside), _LEAST_STILL * np.count_nonzero(white)):
        # All moves. Noise is still in what the flow leaves, which may be more than noise but not much less.
        left = _variance(followed, mean)[1] / _EXPLAINED
        return _Look(light[inside], left[inside] / of_quantile, np.full(np.count_nonzero(inside), 3.0), bound=True)
    rough = change - cv2.blur(change, (3, 3))  # flicker is light, too
    kurtosis = mean(rough**4) / np.maximum(mean(rough**2) ** 2, 1e-30)
    return _Look(light[still], finest[still] / of_quantile, kurtosis[still])


def _variance(change: np.ndarray, mean: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the variance of a pixel's noise per block, from all scales but the largest and from the finest."""
    # A smooth change over the picture is light. Subtracting the mean of 3x3 leaves 8/9 of the noise's variance
    # (Immerkaer, CVIU 1996, whose mask leaves 36 times it); a difference of two frames has twice the variance of one.
    square = mean((change - cv2.blur(change, (3, 3))) ** 2) / (2 * 8 / 9)
    return square, mean(cv2.filter2D(change, -1, _MASK) ** 2) / (2 * 36)


def _followed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return frame ``b`` at the places where dense flow sees the pixels of ``a``: a fine texture that moves is as white
    as noise, but noise is nowhere to be found in the other frame. The flow is smoothed, since pixel by pixel it fits
    noise, too."""
    flow = cv2.blur(
        DenseFlow(cv2.DISOPTICAL_FLOW_PRESET_FAST).forward(DenseFlow.codes(a), DenseFlow.codes(b)),
        (_SMOOTH_PX, _SMOOTH_PX),
    )
    row, column = np.indices(a.shape, np.float32)
    # Bilinear interpolation would average noise away; Lanczos interpolation keeps it.
    place = column + flow[..., 0], row + flow[..., 1]
    return cv2.remap(b, *place, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)


def _lower_line(level: np.ndarray, variance: np.ndarray) -> tuple[float, float]:
    """Return (constant, slope), neither negative, of a line below most of the points: at some levels everything moves,
    and their variance is not noise."""
    from scipy.optimize import nnls

    scale = max(float(variance.max()), 1e-30)
    # Squares of relative errors, about: noise of dark pixels is as well known as that of bright ones.
    weight = 1 / np.sqrt(np.maximum(variance / scale, 1e-6))
    columns = np.stack([np.ones_like(level), level], axis=1)
    trust = np.ones_like(level)
    for _ in range(20):
        w = trust * weight
        line, _ = nnls(columns * w[:, None], variance / scale * w)
        # Points above the line weigh a fifth, so it settles below most of them.
        trust = np.where(variance / scale > columns @ line, 0.2, 1.0)
    return float(line[0] * scale), float(line[1] * scale)


@kernel(error_model="numpy")
def _push(at, light, constant, slope, band, leap, out):
    """Write what pixels at ``at`` show after ``light``, (H, W) float32."""
    for row in range(at.shape[0]):
        for column in range(at.shape[1]):
            value, new = at[row, column], light[row, column]
            width = band * np.sqrt(constant + slope * max(value, np.float32(0)))
            # At the band's edge the noise's own extremes would push on for many frames after a cut.
            if abs(new - value) > leap * width:
                out[row, column] = new
            else:
                out[row, column] = min(max(value, new - width), new + width)


class DenoisedLight:
    """Light of frames without their noise, as they come.

    A pixel follows the frames' light only as far as noise does not explain the difference: a band of ``BAND`` standard
    deviations on each side of its value, which the light pushes; a leap of two bands is followed at once. Changes
    inside cause no event; a ramp is followed at a distance. The noise is estimated from pairs of frames all along the
    clip, so that neither its beginning nor a cut decides over the rest.

    light : returns the luminance, (H, W) float32, of a stored frame.   code : as of :func:`estimated`.   noise : the
    last estimate, for a report; None: none was found.   doubt : the line that says why changes that look like noise
    are not believed, or None."""

    def __init__(self, light: Callable[[np.ndarray], np.ndarray], code: Callable[[float], float]):
        self._light, self._code = light, code
        self.noise: FrameNoise | None = None
        self.doubt: str | None = None
        self._now: FrameNoise | None = None
        self._looks: deque[_Look] = deque(maxlen=_KEPT)
        self._at: np.ndarray | None = None
        self._last: np.ndarray | None = None
        self._sparse: np.ndarray | None = None
        self._nature = (0.0, 0.0)
        self._frames, self._banded, self._more, self._known, self._looked = 0, 0, _FIRST, False, 0

    def __call__(self, frame: np.ndarray, luminance: np.ndarray | None = None) -> np.ndarray | None:
        """Return the pixels' values for the next frame, (H, W) float32; None: the frame's own, since it has no noise.

        frame : as stored, of which only copies are kept.   luminance : its light, where it is known already."""
        due = self._due(frame)
        if luminance is None and (due or self._now is not None):
            luminance = self._light(frame)
        if due or self._now is not None:
            assert self._last is not None and luminance is not None
            self._last = self._last if self._last.dtype == np.float32 else self._light(self._last)
            if due:
                part = self._part(luminance.shape)
                self._look(self._last[part], luminance[part])
        if self._now is None:
            self._at = None
        else:
            assert luminance is not None
            assert self._last is not None
            if self._at is None:
                self._banded = 1
            at = self._last if self._at is None else self._at
            # At first a pixel's value is the frames' mean, whose own noise is included in the difference.
            band = np.float32(BAND * (1 + 1 / self._banded) ** 0.5)
            self._at = np.empty_like(luminance)
            constant, slope = np.float32(self._now.constant), np.float32(self._now.slope)
            _push(at, luminance, constant, slope, band, np.float32(_LEAP), self._at)
            self._banded += 1
        self._last = frame.copy() if luminance is None else luminance
        return self._at

    def _due(self, frame: np.ndarray) -> bool:
        """Return whether to look at the pair that ends with ``frame``."""
        step = tuple(slice(None, None, max(1, side // _SPARSE_PX)) for side in frame.shape[:2])
        last, self._sparse, number = self._sparse, frame[step].copy(), self._frames
        self._frames += 1
        if last is None:
            return False
        bright, lively = float(self._sparse.mean()), float(np.mean(self._sparse != last))
        old_bright, old_lively = self._nature
        self._nature = bright, lively
        brighter = not old_bright / _BRIGHTER <= bright <= old_bright * _BRIGHTER
        livelier = not old_lively / _LIVELIER - 0.02 <= lively <= old_lively * _LIVELIER + 0.02
        if number > 1 and (brighter or livelier):
            # A cut, or noise that begins or ends. This pair spans the change and shows neither; those after it do.
            self._looks.clear()
            self._more = _FIRST
            return False
        self._more -= 1
        every = _EVERY if self._now is None else _EVERY_NOISY
        return self._more >= 0 or number % every == 0 or not self._known

    def _part(self, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """Return the part of the picture that the next look is at: each in turn, so that large pictures cost no
        more."""
        # As many parts as cover a side, the quotient rounded up; neighbours overlap.
        starts = [
            np.linspace(0, max(0, side - most), -(-side // most)).astype(int) for side, most in zip(shape, _PART_PX)
        ]
        row, column = divmod(self._looked % (len(starts[0]) * len(starts[1])), len(starts[1]))
        self._looked += 1
        top, left = int(starts[0][row]), int(starts[1][column])
        return slice(top, top + _PART_PX[0]), slice(left, left + _PART_PX[1])

    def _look(self, a: np.ndarray, b: np.ndarray) -> None:
        look = (looked_at_phases if is_mosaic(a) else looked_at)(a, b)
        if look is None:
            return
        self._known = True
        if look.bound:
            # It shows no noise of its own, but may show that there is less than was believed.
            if self._now is None or np.median(look.square / self._now.sigma(look.light) ** 2) > _NEARLY:
                return
            self._looks.clear()
        self._looks.append(look)
        self._now, doubt = estimated(self._looks, self._code)
        self.doubt = doubt or self.doubt
        self.noise = self._now or self.noise
