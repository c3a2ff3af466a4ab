"""Materials of an explicit scene (docs/light.md)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, get_args

from pydantic import Field

from blinkgl.config.base import Config, Former, Refused, at_most_one, rule
from blinkgl.config.waveforms import OVER_TIME, WaveformConfig

TextureKind = Literal["value", "perlin", "fbm", "stripes", "checks", "glyphs", "dots", "gradient", "bricks"]
TEXTURE_KINDS: tuple[str, ...] = get_args(TextureKind)
Radiance = Annotated[float, Field(ge=0, le=1e9)]
Repeats = Annotated[float, Field(ge=-1e6, le=1e6)]


class MaterialConfig(Config):
    """A colour times at most one texture, and further properties of the surface."""

    texture: str | None = Field(None, description="image file, sRGB, or .hdr, linear")
    procedural: Literal[TextureKind, "pips"] | None = Field(
        None, description="kind of procedural texture; pips: the faces of a die"
    )
    seed: int = Field(0, ge=0, description="number of the procedural texture of that kind")
    photograph: str | None = Field(
        None, description="name of a photograph bundled with scikit-image, such as astronaut"
    )
    max_size: int = Field(2048, ge=1, le=16384, description="longer texture sides are reduced to this, px")
    color: tuple[Radiance, Radiance, Radiance] = Field((1.0, 1.0, 1.0), description="linear factor")
    uv_scale: tuple[Repeats, Repeats] = Field((1.0, 1.0), description="texture repeats per unit of texture coordinate")
    unlit: bool = Field(False, description="radiance = albedo, independent of light")
    both_sides: bool | None = Field(
        None,
        description="draw faces from behind, too; null: as the mesh's file says, or unless the primitive is closed",
    )
    metallic: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="fraction that is metal")
    roughness: Annotated[float, Field(ge=0, le=1)] = Field(
        1.0, description="0: a mirror; 1 for a non-metal: matt, without reflection"
    )
    metallic_roughness_map: str | None = Field(
        None,
        description="linear image file, as in glTF: blue times metallic, green times roughness",
    )
    normal_map: str | None = Field(None, description="image file of normals, as in glTF: x right, y up, z outwards")
    normal_scale: Annotated[float, Field(ge=-100, le=100)] = Field(
        1.0, description="factor on x and y of the normal map"
    )
    emission: tuple[Radiance, Radiance, Radiance] = Field((0.0, 0.0, 0.0), description="emitted radiance, linear")
    emission_map: str | None = Field(None, description="image file, sRGB, times emission")
    emission_over_time: WaveformConfig | None = OVER_TIME
    mask: str | None = Field(
        None,
        description="image file: holes where its opacity (or grey value) is below cutoff",
    )
    cutoff: Annotated[float, Field(gt=0, le=1)] = Field(0.5, description="threshold of the mask; 1 is white or opaque")

    former: ClassVar[dict[str, Former]] = {"double_sided": Former("both_sides: true", lambda value: value is False)}

    _one = at_most_one("texture", "procedural", "photograph")

    @property
    def files(self) -> dict[str, str]:
        """Return the files that the material reads, by key."""
        keys = ("texture", "metallic_roughness_map", "normal_map", "emission_map", "mask")
        return {key: file for key in keys if (file := getattr(self, key)) is not None}

    @rule("emission_map", "emission")
    def _a_map_of_nothing(emission_map, emission):
        if emission_map is not None and not any(emission):
            raise Refused(
                "emission_map has no effect: emission, which multiplies it, is 0",
                where="emission",
                value=list(emission),
                accepted="a radiance above 0, such as [1, 1, 1]",
            )

    @rule("?emission_over_time", "emission", "unlit")
    def _something_changes(over_time, emission, unlit):
        if over_time and (unlit or not any(emission)):
            raise Refused(
                "nothing emits that could change over time: " + ("unlit is true" if unlit else "emission is 0"),
                where="emission_over_time",
                accepted="unlit: false, and an emission above 0, such as [1, 1, 1]",
            )

    @rule("unlit", "normal_map", "metallic_roughness_map", "emission_map")
    def _maps_of_what_is_lit(unlit, *maps):
        used = [k for k, v in zip(("normal_map", "metallic_roughness_map", "emission_map"), maps) if v is not None]
        if unlit and used:
            raise Refused(
                "this map has no effect on an unlit surface",
                where=used[0],
                value=maps[0] or maps[1] or maps[2],
                accepted="unlit: false, or no such map",
            )
