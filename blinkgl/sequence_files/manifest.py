"""The form of a sequence's manifest, which somebody else may have written: it is checked before anything is used."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, model_validator

from blinkgl.io.records import path_inside, plain_name
from blinkgl.io.sequence_tables import EXPOSURES

InsidePath = Annotated[str, AfterValidator(path_inside)]
"""A relative path that neither leaves its folder nor names the folder itself."""
PlainName = Annotated[str, AfterValidator(plain_name)]
"""The name of one folder: no separators, not hidden, printable."""
HereOrInside = Annotated[str, AfterValidator(lambda name: name if name == "." else path_inside(name))]
"""As InsidePath, or "." for the folder itself."""

_LARGEST = 2**62
_PIXELS = 2**28
_Corner = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class _File(BaseModel):
    """A line of the manifest's ``files``."""

    model_config = ConfigDict(strict=True)
    bytes: int = Field(ge=0, le=_LARGEST)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class _FrameCamera(BaseModel):
    """What the manifest says of a frame camera."""

    model_config = ConfigDict(strict=True, extra="allow")
    pictures: list[Literal["images", "sharp", "clean"]]
    bits: int = Field(ge=8, le=16)


class _Object(BaseModel):
    """What the manifest says of an object; box: its corners at rest."""

    model_config = ConfigDict(extra="allow")
    id: int = Field(ge=0, le=_LARGEST)
    box: tuple[_Corner, _Corner] | None = None


class _Common(BaseModel):
    """The schema of any manifest. Further keys are allowed; missing keys are None."""

    model_config = ConfigDict(strict=True, extra="allow")
    format_version: Literal[1, 2]
    """1: without a hash of itself"""
    events: int = Field(ge=0, le=_LARGEST)
    t_offset_us: int = Field(ge=-_LARGEST, le=_LARGEST)
    duration_us: int | None = Field(None, ge=0, le=_LARGEST)
    seed: int | None = Field(None, ge=0, lt=2**63)
    sequence: int | None = Field(None, ge=0, le=_LARGEST)
    split: PlainName | None = None
    label: str | None = Field(None, alias="class", max_length=255)
    blinkgl: str | None = Field(None, max_length=255)
    labels: int | None = Field(None, ge=0, le=_LARGEST)
    frames: int | None = Field(None, ge=0, le=_LARGEST)
    opengl: dict[str, str] | None = None
    versions: dict[str, str] | None = None
    objects: list[_Object] = []
    events_by_cause: dict[str, Annotated[int, Field(ge=0, le=_LARGEST)]] | None = None
    files: dict[InsidePath, _File]


class Manifest(_Common):
    """The manifest of one camera's sequence."""

    format: Literal["blinkgl-sequence"]
    height: int = Field(ge=1, le=65536)
    width: int = Field(ge=1, le=65536)
    emulator: str | None = Field(None, max_length=255)
    sensor: PlainName | None = None
    frame_camera: _FrameCamera | None = None

    @model_validator(mode="after")
    def _says_what_its_files_need(self) -> Manifest:
        if self.height * self.width > _PIXELS:
            raise ValueError(f"{self.width}x{self.height} px, more than {_PIXELS}")
        if EXPOSURES in self.files and self.frame_camera is None:
            raise ValueError(f"{EXPOSURES}, but no 'frame_camera'")
        return self


class RigManifest(_Common):
    """The manifest of a rig's sequence (rig_dir.py), whose ``files`` are those of all sensors."""

    format: Literal["blinkgl-rig"]
    sensors: list[PlainName]
    cameras: list[PlainName]


MODEL, RIG_MODEL = TypeAdapter(Manifest), TypeAdapter(RigManifest)
