"""The ``physics:`` section of a scene and of its objects: bodies that fall, bounce and are thrown. MuJoCo computes the
motion before anything is drawn (:mod:`blinkgl.scene.motion.dynamics`); these models define only units and limits.

scene:
  kind: explicit
  physics: {gravity: [0, 0, -9.81]}
  objects:
    - {mesh: floor, category: ground}                      # static: things fall on it
    - mesh: die
      position: [0, 0, 1.5]
      physics: {mass: 0.1, restitution: 0.5, velocity: [1, 0, 2], spin: [0, 720, 90]}
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Config, Former, Refused, always, rule
from blinkgl.config.trajectory import RateRange, SpeedRange
from blinkgl.config.values import as_pair, ordered

_Acceleration = Annotated[float, Field(ge=-1e4, le=1e4)]
_Velocity = Annotated[float, Field(ge=-1e4, le=1e4)]
_Spin = Annotated[float, Field(ge=-36_000.0, le=36_000.0)]
_Friction = Annotated[float, Field(ge=0, le=10)]
_Density = Annotated[float, Field(gt=0, le=1e9)]
# Above this value a stack of soft contacts gains energy from rounding; a super ball has 0.9.
_Restitution = Annotated[float, Field(ge=0, le=0.95)]


def _range_of(number):
    return Annotated[tuple[number, number], BeforeValidator(as_pair), AfterValidator(ordered)]


class PhysicsConfig(Config):
    """Physics of a whole scene. World units are metres; in other units, give gravity in those."""

    gravity: tuple[_Acceleration, _Acceleration, _Acceleration] = Field((0.0, 0.0, -9.81), description="m/s²")
    rate: float = Field(
        20_000.0,
        ge=1000,
        le=1e6,
        description="steps per second, Hz; computing time is proportional to it. An impact lasts 1.6 ms, but at least "
        "16 steps; a body at 5 m/s sinks in by 2.5 mm",
    )
    max_speed: float = Field(
        200.0,
        gt=0,
        le=1e4,
        description="m/s; a faster body is an error",
    )


class RandomPhysicsConfig(PhysicsConfig):
    """A fraction of a random world's objects falls or is thrown. They collide with the ground, each other, objects on
    trajectories and the camera's clearance. Invisible walls keep them in the region."""

    max_speed: float = Field(50.0, gt=0, le=1e4, description="m/s; an object that becomes faster is left out")
    share: float = Field(
        0.5, ge=0, le=1, description="fraction of the objects that fall; the others follow object_motion"
    )
    thrown: float = Field(0.5, ge=0, le=1, description="fraction of those that is thrown; the others are dropped")
    speed: SpeedRange = Field((1.0, 6.0), description="speed of thrown objects, m/s; uniform")
    spin: RateRange = Field((0.0, 540.0), description="rotation rate of thrown objects, deg/s; uniform")
    density: _range_of(_Density) = Field((100.0, 2000.0), description="kg/m³; log-uniform")
    friction: _range_of(_Friction) = Field((0.2, 0.9), description="coefficient of Coulomb friction; uniform")
    restitution: _range_of(_Restitution) = Field(
        (0.1, 0.8), description="speed kept at an impact, as a fraction; uniform"
    )
    former: ClassVar[dict[str, Former]] = {"rolling": always(0.01)}


class BodyConfig(Config):
    """Physics of one object (docs/scenes.md). One without this table is an obstacle, with the friction and
    restitution of the body that meets it."""

    kind: Literal["dynamic", "fixed", "none"] = Field(
        "dynamic",
        description="fixed: stays in place, or on its key frames; none: does not collide",
    )
    mass: float | None = Field(None, gt=0, le=1e12, description="kg; null: from the density")
    density: _Density = Field(700.0, description="kg/m³ (wood)")
    friction: _Friction = Field(0.5, description="coefficient of Coulomb friction")
    rolling: float = Field(0.01, ge=0, le=1, description="rolling friction, as a fraction of the body's radius")
    restitution: _Restitution = Field(0.5, description="speed after an impact on a fixed surface, over that before")
    velocity: tuple[_Velocity, _Velocity, _Velocity] = Field(
        (0.0, 0.0, 0.0), description="velocity of the centre of mass at the start, m/s"
    )
    spin: tuple[_Spin, _Spin, _Spin] = Field(
        (0.0, 0.0, 0.0), description="angular velocity at the start about the world's axes, deg/s"
    )

    former: ClassVar[dict[str, Former]] = {
        "shape": Former("the mesh's own hull, box or ball", lambda value: value == "auto")
    }

    @rule("kind", "velocity", "spin")
    def _only_what_moves_has_a_velocity(kind, velocity, spin):
        for key, value in (("velocity", velocity), ("spin", spin)):
            if kind != "dynamic" and any(value):
                raise Refused(
                    f"a {kind} body does not use this key", where=key, value=list(value), accepted="kind: dynamic"
                )


IN_THE_WAY = BodyConfig(kind="fixed", friction=0.0, rolling=0.0, restitution=0.95)
"""Physics of an object without its own table: the values of the body that hits it count."""
