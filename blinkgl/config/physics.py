"""``physics:`` of a scene and of its objects: what falls, bounces and is thrown. Computed by MuJoCo before anything is
drawn (:mod:`blinkgl.scene.motion.dynamics`); the models here only know units and limits.

scene:
  kind: explicit
  physics: {gravity: [0, 0, -9.81]}
  objects:
    - {mesh: floor, category: ground}                      # stands still: things fall on it
    - mesh: die
      position: [0, 0, 1.5]
      physics: {mass: 0.1, restitution: 0.5, velocity: [1, 0, 2], spin: [0, 720, 90]}
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Config, Refused, Removed, rule
from blinkgl.config.trajectory import RateRange, SpeedRange, as_pair, ordered

_Acceleration = Annotated[float, Field(ge=-1e4, le=1e4)]
_Velocity = Annotated[float, Field(ge=-1e4, le=1e4)]
_Spin = Annotated[float, Field(ge=-36_000.0, le=36_000.0)]
_Friction = Annotated[float, Field(ge=0, le=10)]
_Density = Annotated[float, Field(gt=0, le=1e9)]
# Above this a stack of soft contacts gains energy from rounding; a super ball has 0.9.
_Restitution = Annotated[float, Field(ge=0, le=0.95)]


def _range_of(number):
    return Annotated[tuple[number, number], BeforeValidator(as_pair), AfterValidator(ordered)]


class PhysicsConfig(Config):
    """What all bodies of a scene share. World units are metres, or gravity is to be said in theirs."""

    gravity: tuple[_Acceleration, _Acceleration, _Acceleration] = Field((0.0, 0.0, -9.81), description="m/s²")
    rate: float = Field(
        20_000.0,
        ge=1000,
        le=1e6,
        description="steps of the engine per second, Hz; time to compute goes with it. An impact lasts 1.6 ms, "
        "in which a body sinks in by a third of its speed times that (5 m/s: 2.5 mm), but never less "
        "than 16 steps",
    )
    max_speed: float = Field(
        200.0, gt=0, le=1e4, description="m/s; a body that is faster ends the sequence with an error: it exploded"
    )


class RandomPhysicsConfig(PhysicsConfig):
    """Of a random world: a share of the objects is dropped where it was placed, or thrown. They meet the ground,
    each other, objects on their trajectories and the camera's clearance, and stay in the region: its sides hold
    them back, seen or not."""

    max_speed: float = Field(50.0, gt=0, le=1e4, description="m/s; an object that comes to be faster is left out")
    share: float = Field(0.5, ge=0, le=1, description="share of the objects that fall; the others: object_motion")
    thrown: float = Field(0.5, ge=0, le=1, description="share of those that is thrown; the others are dropped")
    speed: SpeedRange = Field((1.0, 6.0), description="of the thrown, m/s: a number or [low, high]; uniform")
    spin: RateRange = Field((0.0, 540.0), description="turning of the thrown, deg/s: a number or [low, high]; uniform")
    density: _range_of(_Density) = Field((100.0, 2000.0), description="kg/m³: a number or [low, high]; log-uniform")
    friction: _range_of(_Friction) = Field((0.2, 0.9), description="a number or [low, high]; uniform")
    restitution: _range_of(_Restitution) = Field((0.1, 0.8), description="a number or [low, high]; uniform")
    rolling: float = Field(0.01, ge=0, le=1, description="rolling friction, of a body's radius")


class BodyConfig(Config):
    """What the engine makes of one object. What touches is each part's convex hull (a box and a ball where the mesh is
    one, a flat ground without end): hollows are filled. Where two surfaces meet, the larger friction and the smaller
    restitution count. An object without this, in a scene with physics, is in the way, and what hits it has both
    numbers; sky is never."""

    kind: Literal["dynamic", "fixed", "none"] = Field(
        "dynamic",
        description="dynamic: falls and is pushed; fixed: stays where it is, or on its key frames, whatever hits it; "
        "none: is not there",
    )
    mass: float | None = Field(None, gt=0, le=1e12, description="kg; null: by its density")
    density: _Density = Field(700.0, description="kg/m³ (wood)")
    friction: _Friction = Field(0.5, description="Coulomb's coefficient")
    rolling: float = Field(0.01, ge=0, le=1, description="rolling friction, of the body's radius")
    restitution: _Restitution = Field(
        0.5, description="speed after an impact against a fixed surface over that before it"
    )
    velocity: tuple[_Velocity, _Velocity, _Velocity] = Field(
        (0.0, 0.0, 0.0), description="of the centre of mass at the start, m/s"
    )
    spin: tuple[_Spin, _Spin, _Spin] = Field(
        (0.0, 0.0, 0.0), description="angular velocity at the start about the world's axes, deg/s"
    )

    removed: ClassVar[Any] = {"shape": Removed("the mesh's own hull, box or ball", lambda value: value == "auto")}

    @rule("kind", "velocity", "spin")
    def _only_what_moves_has_a_velocity(kind, velocity, spin):
        for key, value in (("velocity", velocity), ("spin", spin)):
            if kind != "dynamic" and any(value):
                raise Refused(f"a {kind} body has none", where=key, value=list(value), accepted="kind: dynamic")


IN_THE_WAY = BodyConfig(kind="fixed", friction=0.0, rolling=0.0, restitution=0.95)
"""An object that says nothing: what hits it decides."""
