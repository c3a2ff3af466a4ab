"""The noise of given frames: estimated from the frames, and prevented from becoming events.

A static camera's frames differ by noise, and an emulator interprets every difference as light. An event camera's own
pixels have less noise, which the emulator models (:mod:`blinkgl.events.noise`); the frames' noise must not be added to
it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from blinkgl.timeline.interpolate import DenseFlow

LOOKED_AT = 5
"""Number of first frames from which the noise is estimated."""
BAND = 4.0
"""Standard deviations of the noise within which a change counts as noise: of a hundred thousand static pixels, a dozen
exceed it per frame. For two recordings by static cameras, 3 leaves 0.6 and 4.5 times the event camera's events at
static pixels, 4 leaves 0.4 and 2.2; 5 begins to lose events of motion."""
_BLOCK_PX = 8
_QUANTILE, _OF_CHI_SQUARED = 0.2, 0.85
"""Part of the blocks of one brightness that are taken to hold noise alone, and the 20 % quantile of the mean square of
64 normal numbers: blocks in which something moves lie above."""
_MASK = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_WHITE, _LEAST_WHITE = 0.6, 0.1
"""Of the variance at all scales, what there is at the finest if changes are white, and the part of the blocks in which
it has to be so."""
_EXPLAINED, _LEAST_STILL, _SMOOTH_PX = 0.62, 0.5, 41
"""Part of a change that remains along dense flow, below which it is motion; the part of the white blocks in which it
has to be noise; the side over which the flow is smoothed. Of noise 0.7 or more remains in nine blocks of ten, of
photographs that move by 0.5 px 0.2 to 0.5 (median), by 2 or 7 px 0.02."""
_BINS, _LEAST_BLOCKS = 12, 12
_CLEAN = 0.35
"""Codes: rounding alone gives 0.29."""
_BRIGHT = 0.85
"""Fraction of full scale: above, codes are near their end, and noise is clipped."""
_FEW_CODES, _CLIPPED, _FLICKER = 32, 0.1, 0.02
"""From which on frames are warned of: different codes, part of the pixels at an end, and how much the whole picture's
brightness jumps to and fro from one frame to the next (median)."""


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


def frame_noise(frames: Sequence[np.ndarray], code: float) -> FrameNoise | None:
    """Return the noise of the first frames of a clip, or None for frames with only rounding noise, or too small to
    estimate.

    frames : (H, W) float32 luminance of full scale 1, of one size.   code : distance of two codes at middle brightness,
    in luminance."""
    found = [_blocks(a, b) for a, b in itertools.pairwise(frames)]
    light, square = (np.concatenate(values) for values in zip(*found)) if found else (np.empty(0), np.empty(0))
    if len(light) < 2 * _LEAST_BLOCKS:
        return None
    edges = np.quantile(light, np.linspace(0, 1, max(min(_BINS, len(light) // _LEAST_BLOCKS), 2) + 1))
    kind = np.clip(np.searchsorted(edges, light, side="right") - 1, 0, len(edges) - 2)
    kinds = np.unique(kind)
    level = np.array([light[kind == k].mean() for k in kinds])
    variance = np.array([np.quantile(square[kind == k], _QUANTILE) for k in kinds]) / _OF_CHI_SQUARED
    constant, slope = _lower_line(level, variance)
    middle = float(np.median(light))
    sigma = float(np.sqrt(constant + slope * middle))
    return None if sigma < _CLEAN * code else FrameNoise(constant, slope, (middle, sigma))


def _blocks(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean luminance and variance of a pixel's noise, (N,), of the blocks in which no code is at an end and the
    change is white: noise is, and a moving texture is not."""
    height, width = (side // _BLOCK_PX * _BLOCK_PX for side in a.shape)
    if not height or not width:
        return np.empty(0), np.empty(0)
    mean = lambda image: cv2.resize(
        image[:height, :width], (width // _BLOCK_PX, height // _BLOCK_PX), interpolation=cv2.INTER_AREA
    ).ravel()
    change = b - a
    # A smooth change over the picture is light. Subtracting the mean of 3x3 leaves 8/9 of the noise's variance
    # (Immerkaer, CVIU 1996, whose mask leaves 36 times it); a difference of two frames has twice the variance of one.
    square = mean((change - cv2.blur(change, (3, 3))) ** 2) / (2 * 8 / 9)
    finest = mean(cv2.filter2D(change, -1, _MASK) ** 2) / (2 * 36)
    light = mean((a + b) / 2)
    ends = (np.minimum(a, b) <= 0) | (np.maximum(a, b) >= 1)
    inside = (mean(ends.astype(np.float32)) == 0) & (light < _BRIGHT)
    white = inside & (finest > _WHITE * square)
    still = white & ~_moved(a, b, mean)
    if np.count_nonzero(still) < max(_LEAST_WHITE * np.count_nonzero(inside), _LEAST_STILL * np.count_nonzero(white)):
        return np.empty(0), np.empty(0)
    return light[still], finest[still]


def _moved(a: np.ndarray, b: np.ndarray, mean: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | bool:
    """(N,) whether dense flow explains the change of a block: a fine texture that moves is as white as noise, but noise
    is nowhere to be found in the other frame. The flow is smoothed, since pixel by pixel it fits noise, too. False for
    pictures that are too small for dense flow."""
    if min(a.shape) < DenseFlow.LEAST:
        return False
    flow = cv2.blur(DenseFlow().forward(DenseFlow.codes(a), DenseFlow.codes(b)), (_SMOOTH_PX, _SMOOTH_PX))
    row, column = np.indices(a.shape, np.float32)
    # Bilinear interpolation would average noise away; Lanczos interpolation keeps it.
    place = column + flow[..., 0], row + flow[..., 1]
    followed = cv2.remap(b, *place, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return mean((followed - a) ** 2) < _EXPLAINED * mean((b - a) ** 2)


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
        trust = np.where(variance / scale > columns @ line, 0.2, 1.0)
    return float(line[0] * scale), float(line[1] * scale)


class Steadied:
    """A pixel follows the frames' light only as far as noise does not explain the difference: a band of ``BAND``
    standard deviations on each side of its value, which the light pushes. Changes inside cause no event; a ramp is
    followed at a distance."""

    def __init__(self, noise: FrameNoise):
        self._noise = noise
        self._at: np.ndarray | None = None
        self._frames = 0

    def __call__(self, luminance: np.ndarray) -> np.ndarray:
        """Return the pixels' values for the next frame, (H, W) float32; the argument is not changed."""
        if self._at is None:
            self._at = luminance
        else:
            # At first a pixel's value is the frames' mean, whose own noise is included in the difference.
            width = BAND * np.sqrt(1 + 1 / self._frames) * self._noise.sigma(np.maximum(self._at, 0))
            self._at = np.clip(self._at, luminance - width, luminance + width).astype(np.float32)
        self._frames += 1
        return self._at


def caveats(first: Sequence[np.ndarray], brightness: Sequence[float]) -> Iterator[str]:
    """Yield warnings about stored frames that affect their events, a line each.

    first : the first frames.   brightness : mean code of each frame."""
    codes = [frame for frame in first if frame.dtype.kind == "u"]
    if codes:
        most = np.iinfo(codes[0].dtype).max
        clipped = float(np.mean([(frame == 0) | (frame == most) for frame in codes]))
        different = len(np.unique(np.concatenate([np.unique(frame) for frame in codes])))
        if clipped > _CLIPPED:
            yield f"{100 * clipped:.0f} % of the codes are at an end: what moves there makes no events"
        if different <= _FEW_CODES:
            yield f"frames of {different} different codes: each step from one to the next makes events at once"
    jumps = np.diff(np.log(np.maximum(brightness, 1e-6)), 2)
    if len(jumps) >= 3 and np.median(np.abs(jumps)) > _FLICKER:
        yield (
            f"the whole picture flickers, by {100 * np.median(np.abs(jumps)) / 2:.0f} % from frame to frame, and that "
            "makes events as motion does"
        )
