"""The light on the pixels of an event camera behind a lens: defocus, point spread, colour filters.

    optics = Optics(renderer, config.optics)
    optics.light(t_ns)                 # (H, W) float32, linear, as renderer.luminance without optics

The light of a frame is the mean over points of the lens (:mod:`blinkgl.imaging.lens`), spread by the kernel, of the
pixel's own colour or of luminance. Beyond the picture's edges the outermost pixels continue.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.config.optics import AiryPsfConfig, GaussianPsfConfig, KernelPsfConfig, OpticsConfig
from blinkgl.imaging import lens as thin_lens
from blinkgl.imaging.sensor import mosaic
from blinkgl.machine.kernels import kernel
from blinkgl.render.colour import LUMA
from blinkgl.render.moment import Moment, View

if TYPE_CHECKING:
    from blinkgl.render.renderer import Renderer

_REACH = 4.0
"""Standard deviations to which a Gaussian reaches: 6e-5 of its light is farther."""
_AIRY_ZEROS = 3.8317059702075125, 10.173468135062722
"""First and third zero of the Bessel function J1: the first and the third dark ring."""
_WITHIN = 7
"""Samples of a pixel's side over which an Airy pattern is averaged."""


class Optics:
    """The optics of one event camera.   config : ``optics:``."""

    def __init__(self, renderer: Renderer, config: OpticsConfig):
        self._renderer, self._config = renderer, config
        self._kernels = [] if config.psf is None else kernels_of(config.psf)
        lens = config.lens
        self._points = None if lens is None else thin_lens.points(config.lens_points, lens.aperture)

    def light(self, at: int | Moment) -> np.ndarray:
        """Return the light on the pixels at a time, ns, or of a moment, (H, W) float32, linear."""
        light = self._drawn(at if isinstance(at, Moment) else self._renderer.moment(at))
        # Before the colour filters: they lie on the pixels, and light is spread on its way there.
        for weights in self._kernels:
            light = np.stack([spread(light[..., c], weights) for c in range(light.shape[2])], axis=2)
        bayer = self._config.bayer
        return np.ascontiguousarray(light[..., 0] if bayer is None else mosaic(light, bayer), np.float32)

    def _drawn(self, moment: Moment) -> np.ndarray:
        """Return (H, W, 1 or 3) float32 before the spread."""
        draw, lens, coloured = self._renderer, self._config.lens, self._config.bayer is not None
        if lens is None or self._points is None:
            return (
                draw.colour(moment, draw.antialiasing).read() if coloured else draw.luminance(moment).read()[..., None]
            )
        total = None
        for point in self._points:
            seen = thin_lens.through(moment.view.camera, point, lens.focus)
            there = moment.from_place(View.of(seen), thin_lens.at_point(moment.T_world_cam, point))
            # float64, so that the sum over many points of the lens does not round.
            picture = draw.colour(there, draw.antialiasing).read().astype(np.float64)
            total = picture if total is None else total + picture
        assert total is not None
        mean = total / len(self._points)
        return (mean if coloured else (mean @ LUMA)[..., None]).astype(np.float32)


def kernels_of(psf: GaussianPsfConfig | AiryPsfConfig | KernelPsfConfig) -> list[np.ndarray]:
    """Return the kernels, (rows, columns) float64 that sum to 1, whose succession is the point spread; odd sizes."""
    if isinstance(psf, KernelPsfConfig):
        weights = np.array(psf.weights, np.float64)
        return [weights / weights.sum()]
    if isinstance(psf, GaussianPsfConfig):
        edges = np.arange(2 * math.ceil(_REACH * psf.sigma) + 2) - math.ceil(_REACH * psf.sigma) - 0.5
        # The integral over each pixel, not the value at its centre: a narrow kernel keeps its width.
        share = np.array([math.erf(edge / (math.sqrt(2) * psf.sigma)) for edge in edges])
        row = np.diff(share) / np.diff(share).sum()
        return [row[None], row[:, None]]  # it is separable
    from scipy.special import j1

    reach = math.ceil(psf.radius * _AIRY_ZEROS[1] / _AIRY_ZEROS[0])
    # Places of the samples, px from the centre of the middle pixel; all pixels have _WITHIN of them a side.
    place = np.arange(-reach * _WITHIN - _WITHIN // 2, reach * _WITHIN + _WITHIN // 2 + 1) / _WITHIN
    distance = np.hypot(place[:, None], place[None]) * _AIRY_ZEROS[0] / psf.radius
    inside = (distance > 0) & (distance < _AIRY_ZEROS[1])
    ring = np.where(inside, distance, 1.0)
    # Airy's pattern, (2 J1(x) / x)^2: 1 in its middle, and cut off at the third dark ring.
    pattern = np.where(inside, (2 * j1(ring) / ring) ** 2, distance == 0)
    weights = pattern.reshape(2 * reach + 1, _WITHIN, 2 * reach + 1, _WITHIN).mean(axis=(1, 3))
    return [weights / weights.sum()]


@kernel
def spread(light: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return (H, W) float32: the sum over (rows, columns) weights of the light around each pixel. light : (H, W)
    float32; beyond its edges the outermost pixels continue."""
    height, width = light.shape
    up, left = weights.shape[0] // 2, weights.shape[1] // 2
    out = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            total = 0.0
            for j in range(weights.shape[0]):
                # A convolution: the weights say where light goes, so the pixel that it comes from is on the other side.
                row = min(max(y + up - j, 0), height - 1)
                for i in range(weights.shape[1]):
                    column = min(max(x + left - i, 0), width - 1)
                    total += weights[j, i] * light[row, column]
            out[y, x] = np.float32(total)
    return out
