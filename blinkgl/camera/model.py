"""The interface of a camera model, and what is computed from it for every model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from blinkgl.errors import ConfigError

_LARGEST_SIDE, _LARGEST = 65_536, 1e9


@dataclass(frozen=True)
class CameraModel(ABC):
    """Base class of camera models. Points are in camera axes (OpenCV: x right, y down, z forward); pixels are (x, y),
    +x right, +y down, with (0, 0) the centre of the top-left pixel, so the image is
    [-0.5, width - 0.5) x [-0.5, height - 0.5).

    Each model maps a point to an image plane at distance 1; then ``x = fx u + cx``, ``y = fy v + cy`` gives pixels.

    width, height : px.   fx, fy, cx, cy : px.   near : points with a smaller Z are not visible, world units.
    kind : the model's name in the table (:mod:`blinkgl.camera.table`).
    Raises ConfigError for invalid values.
    """

    kind: ClassVar[str]
    coefficients: ClassVar[tuple[str, ...]] = ()
    """Names of the model's own parameters, in the order of calibrations."""
    shader: ClassVar[str] = ""
    """Macro of a model with distortion in ``shaders/include/lens.glsl``; "": it cannot be drawn."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near: float = 0.05

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if not (isinstance(value, (int, np.integer)) and 1 <= value <= _LARGEST_SIDE):
                self._refuse(name, "not a size", f"a whole number of px, 1 or more, at most {_LARGEST_SIDE}")
        for name in ("fx", "fy", "near"):
            value = getattr(self, name)
            if not 0 < value <= _LARGEST:
                self._refuse(name, "not a length", f"a finite number above 0, at most {_LARGEST:g}")
        for name in ("cx", "cy"):
            if not abs(getattr(self, name)) <= _LARGEST:
                self._refuse(name, "not a position", f"a finite number of px, at most {_LARGEST:g}")

    def _refuse(self, name: str, problem: str, accepted: str) -> None:
        raise ConfigError(problem, where=f"{type(self).__name__}.{name}", value=getattr(self, name), accepted=accepted)

    # ---- what a model is ---------------------------------------------------------------------------------------

    @abstractmethod
    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the (..., 2) px of (..., 3) points; nan where a point is not visible (behind a pin-hole camera)."""

    @abstractmethod
    def jacobian(self, points: np.ndarray) -> np.ndarray:
        """Return the (..., 2, 3) d px / d point of :meth:`project` at (..., 3) points, px per world unit; nan where
        that is nan."""

    @abstractmethod
    def rays(self, xy: np.ndarray) -> np.ndarray:
        """Return (..., 3) directions, of any length, of the points visible at (..., 2) px; nan where there are none."""

    @abstractmethod
    def ray_jacobian(self, xy: np.ndarray) -> np.ndarray:
        """Return the (..., 3, 2) d ray / d px of :meth:`rays` at (..., 2) px; nan where that is nan."""

    # ---- bounds of what is in the picture ----------------------------------------------------------------------

    @property
    @abstractmethod
    def half_angle(self) -> float:
        """Largest angle between the optical axis and a visible point, rad, or slightly more."""

    @property
    @abstractmethod
    def magnification(self) -> float:
        """A displacement d of any direction at depth Z moves the image by at most ``magnification * d / Z`` px,
        anywhere in the picture."""

    @property
    @abstractmethod
    def near_corner(self) -> float:
        """Distance from the camera's centre to the farthest visible point of the near plane; inf if half of space is
        visible."""

    @abstractmethod
    def frustum_planes(self) -> np.ndarray:
        """(n, 3) inward unit normals, camera axes, of planes through the centre: visible points are on the inner side
        of each."""

    @property
    def px_per_slope(self) -> float:
        """Largest distance, px, by which a point's image moves when (X / Z, Y / Z) changes by a step of length 1."""
        return self.magnification

    # ---- what follows ------------------------------------------------------------------------------------------

    def disparity(self, depth: np.ndarray, baseline: float) -> np.ndarray:
        """Return the disparity, px of the flat picture, between the two eyes of a rectified pair, ``baseline`` world
        units apart: f b / Z of ``depth`` (…), world units."""
        return self.fx * baseline / depth

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """The values fx, fy, cx, cy."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def distortion(self) -> tuple[float, ...]:
        """The values of its ``coefficients``."""
        return tuple(getattr(self, name) for name in self.coefficients)

    @property
    def K(self) -> np.ndarray:
        """(3, 3) float64 intrinsic matrix: image plane at distance 1 to pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def summary(self) -> str:
        """Size and focal length as text."""
        return f"{self.width}x{self.height}, fx {self.fx:.0f} px"

    def clip_from_cam(self) -> np.ndarray:
        """Return the (4, 4) float64 matrix from camera axes to clip space (:mod:`blinkgl.render.moment`).

        Raises ConfigError: only a pin-hole camera has such a matrix; for a lens one is drawn
        (:func:`blinkgl.camera.drawing.seen_through`)."""
        raise ConfigError(
            "this camera model cannot be drawn",
            where="camera",
            value=self.kind,
            accepted="a pin-hole camera, or a lens that the shaders know",
        )

    def displacement(self, rays: np.ndarray, depth: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return the (n, 2) px by which points move in the image that are visible along (n, 3) rays at (n,) depth Z and
        move by (n, 3) change; nan where they are not visible before or after."""
        points = rays * (depth / rays[:, 2])[:, None]
        return self.project(points + change) - self.project(points)

    def part(self, x0: int, y0: int, x1: int, y1: int, scale: int = 1) -> Self:
        """Return the camera of the pixels x0 <= x < x1, y0 <= y < y1 alone, ``scale`` times finer in x and y."""
        # Pixel x is [x - 0.5, x + 0.5): its left edge, not its centre, is a multiple of the scale.
        return replace(
            self,
            width=(x1 - x0) * scale,
            height=(y1 - y0) * scale,
            fx=self.fx * scale,
            fy=self.fy * scale,
            # Pixel centres are whole numbers, so the edge at -0.5 is what is scaled.
            cx=(self.cx - x0 + 0.5) * scale - 0.5,
            cy=(self.cy - y0 + 0.5) * scale - 0.5,
        )

    def resized(self, width: int, height: int) -> Self:
        """Return the camera with the same view and width x height pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            # Pixel centres are at whole numbers, so the picture begins at -0.5.
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )


def planes_of(left: float, right: float, top: float, bottom: float) -> np.ndarray:
    """Return (5, 3) inward unit normals of a pin-hole picture with these edges on the image plane, and of the plane
    through the centre."""
    # x >= left z and so on: a plane through the camera's centre for each edge of the picture; the last one is z >= 0.
    planes = np.array([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom], [0, 0, 1]], float)
    return planes / np.linalg.norm(planes, axis=1, keepdims=True)
