"""``deform:`` of an object: how its shape changes with time, by formula.

Lengths are in parts of the mesh's own size, so that one setting suits any mesh. What runs stands in
:mod:`blinkgl.scene.shapes`.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from blinkgl.config.base import Family, Members, Refused, rule

Axis = Literal["x", "y", "z"]
Period = Annotated[float, Field(ge=0.001, le=1e6, description="s of one oscillation")]
Phase = Annotated[float, Field(ge=-360, le=360, description="degrees of the oscillation at time 0")]


class DeformConfig(Family):
    """The configuration of any deformer; a member declares its ``kind: Literal["..."] = "..."`` and takes no
    argument without a default."""

    members: ClassVar[Members[DeformConfig]] = Members("kind", default="wave")


def _across(along: str, towards: str) -> None:
    if along == towards:
        raise Refused("must be another axis than along", where="towards", value=towards)


class WaveConfig(DeformConfig):
    """A wave that runs along one axis and moves the surface along another."""

    kind: Literal["wave"] = "wave"
    along: Axis = Field("x", description="axis that the wave runs along, of the object at rest")
    towards: Axis = Field("z", description="axis that the surface moves along")
    amplitude: float = Field(0.08, ge=0, le=1, description="parts of the object's length along ``along``")
    wavelength: float = Field(1.0, ge=0.05, le=100, description="parts of the object's length along ``along``")
    period: Period = 1.0
    phase: Phase = 0.0

    _axes = rule("along", "towards")(_across)


class FlagConfig(DeformConfig):
    """Cloth in wind: held at its low end of ``along``, waving the more the further from it, with a second, shorter
    wave aslant."""

    kind: Literal["flag"] = "flag"
    along: Axis = Field("x", description="axis from the held end to the free one, of the object at rest")
    towards: Axis = Field("y", description="axis that the cloth moves along")
    amplitude: float = Field(
        0.12, ge=0, le=1, description="at the free end, parts of the object's length along ``along``"
    )
    wavelength: float = Field(0.8, ge=0.05, le=100, description="parts of the object's length along ``along``")
    period: Period = 0.7
    phase: Phase = 0.0

    _axes = rule("along", "towards")(_across)


class TwistConfig(DeformConfig):
    """To and fro about an axis, the more the further from one end."""

    kind: Literal["twist"] = "twist"
    along: Axis = Field("z", description="axis that it is twisted about, of the object at rest")
    angle: float = Field(60.0, ge=-720, le=720, description="degrees between the two ends, at most")
    held: float = Field(
        0.5, ge=0, le=1, description="where along the axis nothing turns: 0 the low end, 1 the high one"
    )
    period: Period = 2.0
    phase: Phase = 0.0


class BendConfig(DeformConfig):
    """To and fro about an axis across: each slice is turned about the held one, the more the further it is away."""

    kind: Literal["bend"] = "bend"
    along: Axis = Field("z", description="axis that is bent, of the object at rest")
    towards: Axis = Field("x", description="axis that it is bent towards")
    angle: float = Field(35.0, ge=-180, le=180, description="degrees of the slice furthest away, at most")
    held: float = Field(
        0.0, ge=0, le=1, description="where along the axis nothing turns: 0 the low end, 1 the high one"
    )
    period: Period = 2.0
    phase: Phase = 0.0

    _axes = rule("along", "towards")(_across)


class BreatheConfig(DeformConfig):
    """Larger and smaller about the middle."""

    kind: Literal["breathe"] = "breathe"
    amount: tuple[
        Annotated[float, Field(ge=-0.9, le=0.9)],
        Annotated[float, Field(ge=-0.9, le=0.9)],
        Annotated[float, Field(ge=-0.9, le=0.9)],
    ] = Field(
        (0.1, 0.1, 0.1), description="parts of the size along x, y, z; negative: smaller while others grow (a jelly)"
    )
    period: Period = 1.5
    phase: Phase = 0.0


for _member in (WaveConfig, FlagConfig, TwistConfig, BendConfig, BreatheConfig):
    DeformConfig.members.add(_member)
