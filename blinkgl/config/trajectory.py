"""Random motion: ``scene.camera_motion`` and ``scene.object_motion``.

object_motion:
  waypoints: 6
  speed: [0.2, 1.5]            # mean speed; each object draws its own from the range
  rotation_rate: [20, 120]     # mean rotation rate, deg/s
  smoothness: 0.5
camera_motion: {kind: static}
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Config, Former, always
from blinkgl.config.values import as_pair, ordered

# Far beyond anything filmed; a larger value almost certainly has the wrong unit (float64 geometry would still be fine).
_Speed = Annotated[float, Field(ge=0, le=1e4)]
_Rate = Annotated[float, Field(ge=0, le=36_000.0)]
SpeedRange = Annotated[tuple[_Speed, _Speed], BeforeValidator(as_pair), AfterValidator(ordered)]
RateRange = Annotated[tuple[_Rate, _Rate], BeforeValidator(as_pair), AfterValidator(ordered)]


_MOST_POINTS = 10_000


class MotionConfig(Config):
    """Motion of one body through random waypoints; ranges are drawn anew for each body."""

    kind: Literal["spline", "static"] = Field(
        "spline", description="spline: through random waypoints; static: no motion"
    )
    waypoints: int = Field(6, ge=2, le=1000, description="waypoints per sequence, approximately")
    waypoints_per_s: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="waypoints per second, instead of waypoints",
    )
    pauses: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of the bodies that stop once, for 10 to 50 % of the sequence",
    )
    speed: SpeedRange = Field((0.2, 1.5), description="mean speed of the body's origin, world units/s")
    rotation_rate: RateRange = Field(
        (20.0, 120.0),
        description="mean angular rate, deg/s; may add key frames",
    )
    smoothness: float = Field(
        0.5, ge=0, le=1, description="0: each leg starts in a random direction; 1: it continues in the last one's"
    )

    def points(self, seconds: float) -> int:
        """Return the number of waypoints of a sequence of this duration, >= 2."""
        if self.waypoints_per_s is None:
            return self.waypoints
        # n intervals have n + 1 ends.
        return min(max(math.ceil(self.waypoints_per_s * seconds) + 1, 2), _MOST_POINTS)


class ObjectMotion(MotionConfig):
    """Motion of the objects. Objects that rest on the ground slide on it and turn about the vertical."""

    static_share: float = Field(0.0, ge=0, le=1, description="fraction of objects that stand still")


class CameraMotion(MotionConfig):
    """Motion of the camera, which looks approximately at the scene's centre."""

    speed: SpeedRange = Field((0.3, 1.5), description="mean speed of the camera centre, world units/s")
    rotation_rate: RateRange = Field((10.0, 60.0), description="mean angular rate without shake, deg/s")
    view_cone: float = Field(
        20.0, ge=1, le=180, description="largest angle between viewing direction and target at the waypoints, deg"
    )
    heading: Literal["any", "view", "across"] = Field(
        "any",
        description="initial direction; view: along its line of sight, forwards or backwards; across: perpendicular "
        "to it",
    )
    roll: float = Field(20.0, ge=0, le=180, description="largest roll of the horizon at the waypoints, deg")
    shake: float = Field(
        0.0, ge=0, le=30, description="hand shake: standard deviation of the rotation about each axis, deg"
    )
    shake_rate: ClassVar[float] = 8.0
    """Shake impulses per second."""
    former: ClassVar[dict[str, Former]] = {"shake_rate": always(shake_rate)}
