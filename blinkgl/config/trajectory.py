"""Settings of random motion: ``scene.camera_motion`` and ``scene.object_motion``.

object_motion:
  waypoints: 6
  speed: [0.2, 1.5]            # mean speed; each object draws its own from the range
  rotation_rate: [20, 120]     # mean turn, deg/s
  smoothness: 0.5
camera_motion: {kind: static}
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

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


class MotionConfig(Config):
    """Motion of one body through random way-points; ranges are drawn anew for each body."""

    kind: Literal["spline", "static"] = Field(
        "spline", description="spline: through random way-points; static: stands still"
    )
    waypoints: int = Field(6, ge=2, le=1000, description="way-points over the sequence (about: see rotation_rate)")
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
    roll: float = Field(20.0, ge=0, le=180, description="largest roll of the horizon at the way-points, deg")
    shake: float = Field(
        0.0, ge=0, le=30, description="hand shake on top: standard deviation of the rotation about each axis, deg"
    )
    shake_rate: float = Field(8.0, gt=0, le=200, description="shake impulses per second")
