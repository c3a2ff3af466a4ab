"""Settings of random motion: ``scene.camera_motion`` and ``scene.object_motion``.

object_motion:
  waypoints: 6
  speed: [0.2, 1.5]            # mean speed; each object draws its own from the range
  rotation_rate: [20, 120]     # mean turn, deg/s
  smoothness: 0.5
camera_motion: {kind: static}
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Config


def as_pair(value: Any) -> Any:
    """A number stands for both ends of a range."""
    # Text too: YAML 1.1 reads 1e-1 as text, and pydantic turns it into a number afterwards.
    return (value, value) if isinstance(value, (int, float, str)) and not isinstance(value, bool) else value


def ordered(pair: tuple[float, float]) -> tuple[float, float]:
    """The range, if its lower end is not above its upper one; else ValueError."""
    if pair[0] > pair[1]:
        raise ValueError("the lower end of the range is above the upper end")
    return pair


# Far beyond anything filmed; past them float64 geometry is fine but a unit was almost certainly mistaken.
_Speed = Annotated[float, Field(ge=0, le=1e4)]
_Rate = Annotated[float, Field(ge=0, le=36_000.0)]
SpeedRange = Annotated[tuple[_Speed, _Speed], BeforeValidator(as_pair), AfterValidator(ordered)]
RateRange = Annotated[tuple[_Rate, _Rate], BeforeValidator(as_pair), AfterValidator(ordered)]


_MOST_POINTS = 10_000


class MotionConfig(Config):
    """Motion of one body through random way-points; ranges are drawn anew for each body."""

    kind: Literal["spline", "static"] = Field(
        "spline", description="spline: through random way-points; static: stands still"
    )
    waypoints: int = Field(6, ge=2, le=1000, description="way-points over the sequence (about: see rotation_rate)")
    waypoints_per_s: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="way-points per second, in place of waypoints: a short sequence is then a piece of a smooth "
        "motion, as recordings are, and not six turns in a fraction of a second",
    )
    pauses: float = Field(
        0.0,
        ge=0,
        le=1,
        description="share of the bodies that stop once, for 10 to 50 % of the sequence, softly, and go on",
    )
    speed: SpeedRange = Field(
        (0.2, 1.5), description="mean speed of the body's origin, world units/s: a number or [low, high]"
    )
    rotation_rate: RateRange = Field(
        (20.0, 120.0),
        description="mean angular rate, deg/s: a number or [low, high]; key frames are added where two "
        "way-points would be more than 115 degrees apart",
    )
    smoothness: float = Field(
        0.5, ge=0, le=1, description="0: each leg starts in a fresh random direction, 1: it keeps the last one's"
    )

    def points(self, seconds: float) -> int:
        """Way-points of a sequence that lasts so long, >= 2."""
        if self.waypoints_per_s is None:
            return self.waypoints
        return min(max(math.ceil(self.waypoints_per_s * seconds) + 1, 2), _MOST_POINTS)


class ObjectMotion(MotionConfig):
    """Motion of the objects. Those that rest on the ground slide in the plane and turn about the vertical."""

    static_share: float = Field(0.0, ge=0, le=1, description="share of the objects that stand still")


class CameraMotion(MotionConfig):
    """Motion of the camera: as an object's, but it keeps looking roughly at the scene's centre."""

    speed: SpeedRange = Field(
        (0.3, 1.5), description="mean speed of the camera centre, world units/s: a number or [low, high]"
    )
    rotation_rate: RateRange = Field(
        (10.0, 60.0), description="mean angular rate without shake, deg/s: a number or [low, high]"
    )
    view_cone: float = Field(
        20.0, ge=1, le=180, description="largest angle at the way-points between viewing direction and target, deg"
    )
    heading: Literal["any", "view", "across"] = Field(
        "any",
        description="where it sets out to: view: along its line of sight, forwards or backwards (a zoom); across: at "
        "right angles to it. How long it keeps to that says smoothness",
    )
    roll: float = Field(20.0, ge=0, le=180, description="largest roll of the horizon at the way-points, deg")
    shake: float = Field(
        0.0, ge=0, le=30, description="hand shake on top: standard deviation of the rotation about each axis, deg"
    )
    shake_rate: ClassVar[Any] = 8.0
    """Shake impulses per second."""
    fixed: ClassVar[Any] = ("shake_rate",)
