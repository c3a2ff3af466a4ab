"""The picture of a lens, made from a pinhole picture.

A rasteriser draws what a pinhole camera sees. For a lens with distortion, the pinhole picture that contains its whole
view (:func:`blinkgl.camera.drawing.seen_through`) is drawn at a density of 1.42 or more, and each pixel of the lens's
picture reads it where its ray meets it:

- light is the mean of the pinhole picture's pixels over the pixel, by area;
- labels are not interpolated. Each pixel claims the pinhole pixel whose centre is nearest to its ray; no two claim the
  same one. That fragment is evaluated where the ray passes, not at its centre (``along_ray.glsl``). So a label is of
  the
  surface at the pinhole pixel's centre, at most half a pixel of the lens's beside the ray, and exact there.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.camera.drawing import seen_through
from blinkgl.types.recent import Kept

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext
    from blinkgl.gl.shader import Uniforms
    from blinkgl.render.moment import Moment


class Places(NamedTuple):
    """Positions of a lens's pixels (or every n-th) in the pinhole picture.

    places : (h, w, 2) float32 px from the pinhole picture's corner (its first pixel is [0, 1)).
    slopes : (h, w, 4) float32 d(place) / d(px), for a pixel to the right and for one downwards."""

    places: np.ndarray
    slopes: np.ndarray


@lru_cache(maxsize=16)
def places_of(camera: CameraModel, flat: PinHole, width: int, height: int) -> Places:
    """Return the places of a picture of ``camera``'s whole view, width x height px."""
    fine = camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)
    x, y = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
    xy = np.stack([x, y], axis=-1)
    rays = fine.rays(xy)
    slopes = flat.jacobian(rays) @ fine.ray_jacobian(xy)
    # d(place_i) / d(px_j) becomes the change of place for a pixel to the right, then that for a pixel downwards.
    across = np.ascontiguousarray(np.swapaxes(slopes, -1, -2), np.float32).reshape(height, width, 4)
    # A projection counts from the first pixel's centre, places from the picture's corner half a pixel before it.
    return Places((flat.project(rays) + 0.5).astype(np.float32), across)


@lru_cache(maxsize=8)
def claims_of(camera: CameraModel, flat: PinHole) -> np.ndarray:
    """Return (h, w, 2) float32 of the pinhole picture: px from each pixel's centre to the ray of the pixel that claims
    it; 9 where none does."""
    places = places_of(camera, flat, camera.width, camera.height).places
    claims = np.full((flat.height, flat.width, 2), 9, np.float32)
    # Only the lens's pixel nearest to this pinhole pixel claims it; 9 means none.
    nearest = np.floor(places).astype(np.intp)
    claims[nearest[..., 1], nearest[..., 0]] = places - (nearest + np.float32(0.5))
    return claims


_SPARED = 0.4
"""px of the pinhole picture: places are at most 1 + this divided by their number apart."""
_MOST = 16


@lru_cache(maxsize=32)
def steps_of(camera: CameraModel, finer: int) -> tuple[int, int]:
    """Return the number of places per pixel, along x and y, so that between two of them lies about one pixel of a
    pinhole picture ``finer`` times as fine, everywhere in the picture."""
    seen, size = seen_through(camera), (camera.width, camera.height)
    slopes = places_of(camera, seen, *size).slopes  # type: ignore[bad-argument-type]
    # Lengths of the two slopes: components 0 and 2 are along x, 1 and 3 along y.
    lengths = np.hypot(slopes[..., ::2], slopes[..., 1::2]).max(axis=(0, 1)) * finer
    columns, rows = np.clip(np.ceil(lengths - _SPARED), 1, _MOST).astype(int)
    return int(columns), int(rows)


class Lens:
    """The textures of one renderer's lens passes.

    camera : the lens's.   flat : the pinhole camera that is drawn."""

    def __init__(self, gl: GLContext, camera: CameraModel, flat: PinHole):
        self.camera, self.flat, self._gl = camera, flat, gl
        self._textures: Kept[tuple, moderngl.Texture] = Kept()

    @classmethod
    def of(cls, gl: GLContext, camera: CameraModel) -> Lens | None:
        """Return the lens of a camera; None for a pinhole camera."""
        flat = seen_through(camera)
        return None if flat is camera else cls(gl, camera, flat)

    def places(self, width: int, height: int) -> moderngl.Texture:
        """Return the texture of places for a picture of this size."""
        make = lambda: self._texture(places_of(self.camera, self.flat, width, height).places)
        return self._textures.of(("places", width, height), make)

    def slopes(self, width: int, height: int) -> moderngl.Texture:
        make = lambda: self._texture(places_of(self.camera, self.flat, width, height).slopes)
        return self._textures.of(("slopes", width, height), make)

    @property
    def claims(self) -> moderngl.Texture:
        return self._textures.of(("claims",), lambda: self._texture(claims_of(self.camera, self.flat)))

    def _texture(self, array: np.ndarray) -> moderngl.Texture:
        height, width, components = array.shape
        texture = self._gl.ctx.texture((width, height), components, array.tobytes(), dtype="f4")
        texture.filter = self._gl.ctx.NEAREST, self._gl.ctx.NEAREST
        return texture

    @cached_property
    def _numbers(self) -> tuple[float, ...]:
        # The shaders' arrays have up to five coefficients; those that a camera model lacks are 0.
        return (*self.camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]

    def set(self, uniforms: Uniforms, moment: Moment, unit: int) -> None:
        """Set the uniforms of lens.glsl and along_ray.glsl. unit : a free texture unit."""
        if "lens_claims" in uniforms:
            self.claims.use(unit)
            uniforms["lens_claims"].value = unit
        if "lens_plane" in uniforms:
            # NDC x is P00 X/Z + P02, which is solved for X/Z: a scale and an offset for each axis.
            P = moment.view.projection
            uniforms["lens_plane"].value = 1 / P[0, 0], 1 / P[1, 1], -P[0, 2] / P[0, 0], -P[1, 2] / P[1, 1]
        if "lens_focal" in uniforms:
            uniforms["lens_focal"].value = self.camera.intrinsics[:2]
        if "lens_limit" in uniforms:
            uniforms["lens_limit"].value = self.camera.plane_limit  # type: ignore[missing-attribute]
        if "lens_k" in uniforms:
            uniforms["lens_k"].value = self._numbers[: uniforms["lens_k"].array_length]

    def release(self) -> None:
        for texture in self._textures.values():
            texture.release()
        self._textures.clear()
