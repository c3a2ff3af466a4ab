"""Which camera models there are: one table of classes.

@register
@dataclass(frozen=True)
class Mine(CameraModel):           # or DistortedModel, which finds the bounds by itself
    kind: ClassVar[str] = "mine"
    sample: ClassVar[dict] = {…}   # values of its own parameters, of the camera that `register` tries
    …
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from blinkgl.camera.distorted import largest_stretch
from blinkgl.camera.model import CameraModel

CAMERA_MODELS: dict[str, type[CameraModel]] = {}
"""By ``kind``."""
_SIZE_AND_K = {"width": 64, "height": 48, "fx": 50.0, "fy": 55.0, "cx": 30.0, "cy": 25.0}


def register(model: type[CameraModel]) -> type[CameraModel]:
    """Puts a class into the table after trying a camera of it; returns it, so that it may stand above the class.

    Raises TypeError naming the model and the part that is missing, or that does not agree with another; nothing is
    then registered."""
    kind = _checked(model)
    if CAMERA_MODELS.get(kind, model) is not model:
        raise TypeError(f"camera model '{kind}': there is one already, {CAMERA_MODELS[kind].__name__}")
    CAMERA_MODELS[kind] = model
    return model


def unregister(kind: str) -> None:
    """Takes the model of this name out again. Raises KeyError where there is none."""
    del CAMERA_MODELS[kind]


def _checked(model: Any) -> str:
    if not (isinstance(model, type) and issubclass(model, CameraModel)):
        raise TypeError(f"{model!r} is not a subclass of CameraModel")
    name = model.__name__

    def unless(right: Any, part: str, problem: str) -> None:
        if not right:
            raise TypeError(f"camera model {name}: `{part}` {problem}")

    kind = getattr(model, "kind", None)
    unless(isinstance(kind, str) and kind, "kind", "is not a name")
    name = f"'{kind}'"
    for part in sorted(model.__abstractmethods__):
        unless(False, part, "is missing")
    unless(
        is_dataclass(model) and model.__dataclass_params__.frozen,
        "@dataclass(frozen=True)",
        "is missing above the class",
    )
    sample = getattr(model, "sample", {})
    own = [field.name for field in fields(model) if field.name not in {f.name for f in fields(CameraModel)}]
    unless(
        isinstance(sample, dict) and set(sample) == set(own),
        "sample",
        f"gives {sorted(sample)} and not a value to each of {sorted(own)}",
    )
    camera = model(**_SIZE_AND_K, **sample)

    x, y = np.meshgrid(np.linspace(-0.5, camera.width - 0.5, 9), np.linspace(-0.5, camera.height - 0.5, 9))
    xy = np.stack([x, y], axis=-1)
    rays = camera.rays(xy)
    unless(np.shape(rays) == (9, 9, 3), "rays", f"gives shape {np.shape(rays)} for (9, 9, 2) px, not (9, 9, 3)")
    unless(np.isfinite(rays).all(), "rays", "has pixels without a ray")
    points = 3.0 * rays
    back = camera.project(points)
    unless(np.shape(back) == (9, 9, 2), "project", f"gives shape {np.shape(back)} for (9, 9, 3) points, not (9, 9, 2)")
    unless(np.abs(back - xy).max() < 1e-8, "rays", "are not where `project` sees their points")
    _agrees(unless, "jacobian", "project", camera.jacobian(points), camera.project, points)
    _agrees(unless, "ray_jacobian", "rays", camera.ray_jacobian(xy), camera.rays, xy)
    angle = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
    unless(angle.max() <= camera.half_angle + 1e-12, "half_angle", "is less than a pixel's")
    unless((rays @ camera.frustum_planes().T >= -1e-9).all(), "frustum_planes", "cut off part of the picture")
    x0, y0, x1, y1 = camera.bounds(np.array([points[2, 2], points[2, 6], points[6, 2], points[6, 6]])) or (0, 0, 0, 0)
    inner = back[2:7, 2:7][[0, 0, -1, -1], [0, -1, 0, -1]]
    unless((inner >= [x0, y0]).all() and (inner < [x1, y1]).all(), "bounds", "leaves out a point that it was given")
    deep = points[points[..., 2] > 0]
    stretch = largest_stretch(camera.jacobian(deep / deep[:, 2:]))
    unless(stretch.max(initial=0.0) <= camera.magnification * (1 + 1e-9), "magnification", "is less than a pixel's")
    return kind


def _agrees(unless: Any, part: str, of: str, slopes: np.ndarray, function: Any, at: np.ndarray) -> None:
    """Central differences: O(h²) and O(1e-16 / h) off."""
    step = 1e-5
    size = at.shape[-1]
    rises = [(function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(size)]
    expected = np.stack(rises, axis=-1)
    unless(np.shape(slopes) == expected.shape, part, f"has shape {np.shape(slopes)}, not {expected.shape}")
    inner = np.isfinite(expected)  # a step off the border of what is seen has no value
    unless(
        np.isfinite(slopes).all()
        and np.abs(slopes - expected)[inner].max() < 1e-5 * (1 + np.abs(expected[inner]).max()),
        part,
        f"is not the derivative of `{of}`",
    )
