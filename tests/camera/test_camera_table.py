"""A camera model that nothing but this file knows, and each part of it taken away in turn."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from blinkgl.camera import CAMERA_MODELS, PinHole, register, unregister
from blinkgl.camera.distorted import DistortedModel


@dataclass(frozen=True)
class Stereographic(DistortedModel):
    """A direction at the angle theta to the axis is seen at 2 f tan(theta / 2), stretched by ``pull``."""

    kind: ClassVar[str] = "stereographic"
    coefficients: ClassVar[tuple[str, ...]] = ("pull",)
    reach: ClassVar[float] = np.inf

    pull: float = 1.0

    def project(self, points):
        points = np.asarray(points, np.float64)
        ahead = points[..., 2] + np.linalg.norm(points, axis=-1)
        return 2 * self.pull * points[..., :2] / ahead[..., None] * [self.fx, self.fy] + [self.cx, self.cy]

    def jacobian(self, points):
        points = np.asarray(points, np.float64)
        length = np.linalg.norm(points, axis=-1, keepdims=True)
        ahead = points[..., 2:] + length
        eye = np.broadcast_to(np.eye(3)[:2], (*points.shape[:-1], 2, 3))
        slope = points / length + [0, 0, 1]
        out = (
            2
            * self.pull
            * (eye / ahead[..., None] - points[..., :2, None] * slope[..., None, :] / ahead[..., None] ** 2)
        )
        return np.array([[self.fx], [self.fy]]) * out

    def rays(self, xy):
        u = (np.asarray(xy, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy] / (2 * self.pull)
        return np.concatenate([2 * u, 1 - (u**2).sum(axis=-1, keepdims=True)], axis=-1)

    def ray_jacobian(self, xy):
        u = (np.asarray(xy, np.float64) - [self.cx, self.cy]) / [self.fx, self.fy] / (2 * self.pull)
        out = np.concatenate([np.broadcast_to(2 * np.eye(2), (*u.shape, 2)), -2 * u[..., None, :]], axis=-2)
        return out / [self.fx, self.fy] / (2 * self.pull)


@pytest.fixture
def stereographic():
    yield register(Stereographic)
    unregister("stereographic")


def test_a_model_from_outside_is_in_the_table(stereographic):
    assert CAMERA_MODELS["stereographic"] is Stereographic and register(Stereographic) is Stereographic
    camera = Stereographic(64, 48, 40.0, 40.0, 31.5, 23.5)
    assert camera.part(0, 0, 32, 24, 2).pull == 1.0


def without(part, value=None):
    """The class with one part taken away, or another in its place."""
    parts = (
        "__annotations__",
        "kind",
        "coefficients",
        "reach",
        "pull",
        "project",
        "jacobian",
        "rays",
        "ray_jacobian",
    )
    body = {name: vars(Stereographic)[name] for name in parts if name != part} | (
        {} if value is None else {part: value}
    )
    return dataclass(frozen=True)(type("Spoiled", (DistortedModel,), body))


@pytest.mark.parametrize(
    "part, value, problem",
    [
        ("project", None, "camera model 'stereographic': `project` is missing"),
        ("jacobian", None, "camera model 'stereographic': `jacobian` is missing"),
        ("rays", None, "`rays` is missing"),
        ("ray_jacobian", None, "`ray_jacobian` is missing"),
        ("kind", 3, "camera model Spoiled: `kind` is not a name"),
    ],
)
def test_a_part_that_is_missing_or_wrong_is_named(part, value, problem):
    before = dict(CAMERA_MODELS)
    with pytest.raises(TypeError, match=problem):
        register(without(part, value))
    assert before == CAMERA_MODELS


def test_what_is_no_model_and_what_is_there_already(stereographic):
    with pytest.raises(TypeError, match="'pinhole' is not a subclass of CameraModel"):
        register("pinhole")

    @dataclass(frozen=True)
    class Other(PinHole):
        kind: ClassVar[str] = "stereographic"

    with pytest.raises(TypeError, match="camera model 'stereographic': there is one already, Stereographic"):
        register(Other)
