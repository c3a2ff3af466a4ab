"""The ``deform:`` key of an object: how its shape changes with time, by formula.

Lengths are fractions of the mesh's size, so that one setting suits any mesh. The code is in
:mod:`blinkgl.scene.shapes`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.base import Config, Former, Refused, rule
from blinkgl.config.values import as_pair, ordered

if TYPE_CHECKING:
    import numpy as np

Axis = Literal["x", "y", "z"]
Period = Annotated[float, Field(ge=0.001, le=1e6, description="duration of one oscillation, s")]
_Strength = Annotated[float, Field(ge=0, le=10)]
_Period = Annotated[float, Field(ge=0.001, le=1e6)]
StrengthRange = Annotated[tuple[_Strength, _Strength], BeforeValidator(as_pair), AfterValidator(ordered)]
PeriodRange = Annotated[tuple[_Period, _Period], BeforeValidator(as_pair), AfterValidator(ordered)]
Phase = Annotated[float, Field(ge=-360, le=360, description="phase of the oscillation at time 0, degrees")]


class DeformConfig(Config):
    """Base of the deformer configurations. A member declares its ``kind: Literal["..."] = "..."``; all its other keys
    have defaults."""

    members: ClassVar[dict[str, type[DeformConfig]]] = {}
    tag, default_member = "kind", "wave"

    @classmethod
    def drawn(cls, rng: np.random.Generator, strength: float, period: float) -> DeformConfig:
        """Draw a deformer of this kind for a random world. strength : of the motion, 1: the defaults.   period : s."""
        keys = {"period": period, "phase": float(rng.uniform(-180, 180))}
        return cls(**{key: value for key, value in keys.items() if key in cls.model_fields})


def _two_axes(rng: np.random.Generator) -> tuple[str, str]:
    first, second = rng.permutation(3)[:2]
    return "xyz"[first], "xyz"[second]


def _across(along: str, towards: str) -> None:
    if along == towards:
        raise Refused("must be another axis than along", where="towards", value=towards)


class _Waving(DeformConfig):
    wavelengths: ClassVar[tuple[float, float]]
    """Of a random world."""

    @classmethod
    def drawn(cls, rng: np.random.Generator, strength: float, period: float) -> DeformConfig:
        (along, towards), wavelength = _two_axes(rng), float(rng.uniform(*cls.wavelengths))
        keys = super().drawn(rng, strength, period).model_dump()
        amplitude = min(cls.model_fields["amplitude"].default * strength, 1.0)
        return cls(**keys | {"along": along, "towards": towards, "amplitude": amplitude, "wavelength": wavelength})


class WaveConfig(_Waving):
    """A wave travels along one axis and moves the surface along another."""

    kind: Literal["wave"] = "wave"
    along: Axis = Field("x", description="axis that the wave travels along, of the object at rest")
    towards: Axis = Field("z", description="axis that the surface moves along")
    amplitude: float = Field(0.08, ge=0, le=1, description="as a fraction of the object's length along ``along``")
    wavelength: float = Field(1.0, ge=0.05, le=100, description="as a fraction of the object's length along ``along``")
    period: Period = 1.0
    phase: Phase = 0.0

    _axes = rule("along", "towards")(_across)

    wavelengths = 0.5, 1.5


class FlagConfig(_Waving):
    """Cloth in wind, held at one end: the motion grows with the distance from it; a shorter wave crosses it."""

    kind: Literal["flag"] = "flag"
    along: Axis = Field("x", description="axis between the held end and the free one, of the object at rest")
    held: Literal["low", "high"] = Field(
        "low", description="held end of ``along``; `along: z, held: high` is a sheet on a line"
    )
    towards: Axis = Field("y", description="axis that the cloth moves along")
    amplitude: float = Field(
        0.12, ge=0, le=1, description="at the free end, as a fraction of the object's length along ``along``"
    )
    wavelength: float = Field(0.8, ge=0.05, le=100, description="as a fraction of the object's length along ``along``")
    period: Period = 0.7
    phase: Phase = 0.0

    _axes = rule("along", "towards")(_across)

    wavelengths = 0.6, 1.2


class TwistConfig(DeformConfig):
    """Twists to and fro about an axis; the angle grows with the distance from the held end."""

    kind: Literal["twist"] = "twist"
    along: Axis = Field("z", description="axis of the twist, of the object at rest")
    angle: float = Field(60.0, ge=-720, le=720, description="largest angle between the two ends, degrees")
    held: float = Field(
        0.5, ge=0, le=1, description="position along the axis that does not turn: 0 the low end, 1 the high end"
    )
    period: Period = 2.0
    phase: Phase = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator, strength: float, period: float) -> DeformConfig:
        along, held = "xyz"[rng.integers(3)], float(rng.random())
        keys = super().drawn(rng, strength, period).model_dump()
        return cls(**keys | {"along": along, "held": held, "angle": min(60.0 * strength, 720.0)})


class BendConfig(DeformConfig):
    """Bends to and fro: each slice turns about the held one, by an angle that grows with its distance."""

    kind: Literal["bend"] = "bend"
    along: Axis = Field("z", description="axis that is bent, of the object at rest")
    towards: Axis = Field("x", description="axis that it bends towards")
    angle: float = Field(35.0, ge=-180, le=180, description="largest angle of the farthest slice, degrees")
    held: float = Field(
        0.0, ge=0, le=1, description="position along the axis that does not turn: 0 the low end, 1 the high end"
    )
    period: Period = 2.0
    phase: Phase = 0.0

    _axes = rule("along", "towards")(_across)

    @classmethod
    def drawn(cls, rng: np.random.Generator, strength: float, period: float) -> DeformConfig:
        (along, towards), held = _two_axes(rng), float(rng.random())
        keys = super().drawn(rng, strength, period).model_dump()
        return cls(**keys | {"along": along, "towards": towards, "held": held, "angle": min(35.0 * strength, 180.0)})


class BreatheConfig(DeformConfig):
    """Grows and shrinks about its middle."""

    kind: Literal["breathe"] = "breathe"
    amount: tuple[
        Annotated[float, Field(ge=-0.9, le=0.9)],
        Annotated[float, Field(ge=-0.9, le=0.9)],
        Annotated[float, Field(ge=-0.9, le=0.9)],
    ] = Field(
        (0.1, 0.1, 0.1),
        description="as fractions of the size along x, y, z; a negative one shrinks while the others grow",
    )
    period: Period = 1.5
    phase: Phase = 0.0

    @classmethod
    def drawn(cls, rng: np.random.Generator, strength: float, period: float) -> DeformConfig:
        amount = tuple(min(0.12 * strength, 0.9) * float(part) for part in rng.uniform(-1, 1, 3))
        return cls(**super().drawn(rng, strength, period).model_dump() | {"amount": amount})


class AnimationConfig(Config):
    """One clip of a glTF file, and how it is played."""

    clip: str | int = Field(0, description="name or index of the animation")
    file: str | None = Field(
        None,
        description="another file with the clip, for joints of the same names; null: the mesh's own",
    )
    speed: float = Field(1.0, ge=-100, le=100, description="factor on the clip's speed; negative: backwards")
    phase: float = Field(0.0, ge=-1e6, le=1e6, description="time within the clip at time 0, s")
    loop: bool = Field(True, description="false: holds the first pose before it, the last after it")

    former: ClassVar[dict[str, Former]] = {
        "blend": Former("one clip; mix two in Blender and export the mixture", lambda value: value is None),
        "share": Former("no share: two clips are no longer mixed", lambda value: value in (0.5, None)),
    }


def animation_of(value: str | int | AnimationConfig | None, loop: bool = True) -> AnimationConfig | None:
    """Return the animation that a clip's name or index means."""
    return AnimationConfig(clip=value, loop=loop) if isinstance(value, (str, int)) else value


class RandomDeformConfig(Config):
    """The fraction of a random world's objects that change their shape by formula."""

    share: float = Field(0.0, ge=0, le=1, description="fraction of the objects")
    kinds: tuple[str, ...] = Field((), description="kinds of ``deform`` that are drawn with equal chances; []: all")
    strength: StrengthRange = Field(
        (0.5, 1.5), description="strength of the motion, 1: the defaults of each kind; uniform"
    )
    period: PeriodRange = Field((0.5, 3.0), description="duration of one oscillation, s; log-uniform")

    @rule("kinds")
    def _known(kinds: tuple[str, ...]):
        for number, kind in enumerate(kinds):
            if kind not in DeformConfig.members:
                raise Refused(
                    "no such kind of deformation",
                    where=f"kinds.{number}",
                    value=kind,
                    accepted="one of: " + ", ".join(DeformConfig.members),
                )


DeformConfig.members |= {
    "wave": WaveConfig,
    "flag": FlagConfig,
    "twist": TwistConfig,
    "bend": BendConfig,
    "breathe": BreatheConfig,
}
