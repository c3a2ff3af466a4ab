"""The ``optics:`` section: what light passes before it reaches the pixels of an event camera."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from blinkgl.config.base import Config, Refused, one_of, rule
from blinkgl.config.images import Bayer, LensConfig

MOST_TAPS = 101
_Row = Annotated[tuple[Annotated[float, Field(ge=0, le=1)], ...], Field(min_length=1, max_length=MOST_TAPS)]


class GaussianPsfConfig(Config):
    """A normal law, integrated over pixels."""

    kind: Literal["gaussian"]
    sigma: float = Field(gt=0, le=12, description="standard deviation, px")


class AiryPsfConfig(Config):
    """The diffraction of a round aperture, to its third dark ring."""

    kind: Literal["airy"]
    radius: float = Field(
        gt=0, le=12, description="of the first dark ring, px: 1.22 times wavelength times f-number over the pixel pitch"
    )


class KernelPsfConfig(Config):
    """A measured point spread."""

    kind: Literal["kernel"]
    weights: Annotated[tuple[_Row, ...], Field(min_length=1, max_length=MOST_TAPS)] = Field(
        description="rows of the picture of a point: odd numbers of rows and columns, sum 1"
    )

    @rule("weights")
    def _a_kernel(weights: tuple[tuple[float, ...], ...]):
        if len(weights) % 2 == 0 or len({len(row) for row in weights}) > 1 or len(weights[0]) % 2 == 0:
            sizes = ", ".join(str(len(row)) for row in weights)
            raise Refused(
                "a kernel has a middle",
                where="weights",
                value=f"{len(weights)} rows of {sizes}",
                accepted="an odd number of rows, all of the same odd length",
            )
        total = math.fsum(value for row in weights for value in row)
        if abs(total - 1) > 1e-3:
            raise Refused(
                "a kernel that does not sum to 1 changes the light",
                where="weights",
                value=f"sum {total:.6g}",
                accepted="1; divide each weight by the sum",
            )


PsfConfig = one_of("kind", GaussianPsfConfig, AiryPsfConfig, KernelPsfConfig)


class OpticsConfig(Config):
    """Between the scene and the pixels of the event camera."""

    psf: PsfConfig | None = Field(
        None, description="point spread of the lens: gaussian, airy or kernel; null: a point stays one"
    )
    lens: LensConfig | None = Field(None, description="defocus by a thin lens; null: everything is in focus")
    lens_points: int = Field(16, ge=4, le=1024, description="points of the lens per event frame; each costs a frame")
    bayer: Bayer | None = Field(None, description="one colour per pixel in this pattern, as of the colour DAVIS")

    @rule("?psf", "?lens", "?bayer")
    def _something(psf, lens, bayer):
        if not (psf or lens or bayer):
            raise Refused("optics that change nothing", accepted="psf, lens or bayer, or optics: null")
