"""Decoding of given frames: what codes mean, by one rule, and luminance from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from blinkgl.config.frames import ACCEPTED_CURVES, CURVES
from blinkgl.errors import ConfigError, EventDataError
from blinkgl.io.frames import FrameSource
from blinkgl.machine.kernels import kernel
from blinkgl.srgb import LUMA, linear_from_srgb

_REFERENCE_WHITE = 203.0
"""cd/m² of white in PQ, which is 1 here (ITU-R BT.2408, 2.1)."""


class OwnFrames(NamedTuple):
    """Properties of a sensor's own frames: grey, of the sensor's (height, width), with this curve from codes to
    light."""

    size: tuple[int, int]
    gamma: str | float


@dataclass(frozen=True)
class Codes:
    """What is known of the codes of frames; None: nothing.

    gamma, white_level, range : declared by the user, as of :class:`~blinkgl.io.reading.Declared`.   own : properties
    of the sensor's own frames.   transfer, levels, origin : what the file says, as of
    :class:`~blinkgl.io.frames.FrameSource`."""

    gamma: str | float | None = None
    white_level: float | None = None
    range: str | None = None
    own: OwnFrames | None = None
    transfer: str | float | None = None
    levels: tuple[float, float] | None = None
    origin: str = "images"

    def of(self, source: FrameSource) -> Codes:
        """Return these with what a file says."""
        return Codes(
            gamma=self.gamma,
            white_level=self.white_level,
            range=self.range,
            own=self.own,
            transfer=source.transfer,
            levels=source.levels,
            origin=source.origin,
        )


UNKNOWN = Codes()


@dataclass
class Meaning:
    """How codes are decoded.   decode : to luminance.   assumed : the curve, where nothing declares or states it.
    white : the code of white, where it is not the type's largest.   notes : what was guessed, a line each."""

    decode: Decoder
    assumed: str | float | None
    white: float | None
    notes: list[str] = field(default_factory=list)


def meaning(first: np.ndarray, codes: Codes) -> Meaning:
    """Return how frames like ``first`` are decoded.

    The curve is the declared one, else the file's, else sRGB for video, else that of the sensor's own frames for grey
    integers of its size, else sRGB for integers and linear for floats. Black and white are declared, else the file's,
    else the ends of the type, or 0 and 1 of floats. Raises ConfigError: unknown curve, a white level beyond the type's
    codes. EventDataError: another type."""
    integers, notes = first.dtype.kind == "u", []
    if integers and first.dtype not in (np.uint8, np.uint16):
        raise _unsupported(first.dtype, "the frames")
    gamma, assumed = checked_gamma(codes.gamma), None
    if gamma is None:
        gamma = codes.transfer
        if isinstance(gamma, str) and gamma not in CURVES:
            raise ConfigError(
                "the file states a curve that is not read", where="--gamma", value=gamma, accepted=ACCEPTED_CURVES
            )
    if gamma is None and codes.origin == "video":
        gamma = "srgb"  # made for viewing
    # Grey whole numbers of the sensor's size are its own; all others are meant for viewing.
    if gamma is None and integers:
        own = codes.own if codes.own is not None and first.shape == codes.own.size else None
        gamma = assumed = own.gamma if own else "srgb"
        notes.append(
            f"images of the sensor's size taken for its own: --gamma {gamma}"
            if own
            else "integer codes taken as sRGB (--gamma linear for a camera's raw frames)"
        )
    if gamma is None:
        gamma = assumed = "linear"
        notes.append("floats taken as linear light (--gamma srgb for codes of pictures)")
    levels = codes.levels
    if codes.white_level is not None or (codes.range is not None and codes.origin != "video"):
        top = float(np.iinfo(first.dtype).max) if integers else 1.0
        white = codes.white_level or (levels[1] if levels else top)
        if integers and white > top:
            accepted = f"at most {top:g} of {first.dtype}"
            raise ConfigError("no code of the frames is white", where="--white-level", value=white, accepted=accepted)
        # Of 8 bits, 16 is black and 235 white; of more, as many times that as there are more codes.
        scale = 2.0 ** (round(np.log2(white + 1)) - 8) if integers else white / 255
        levels = (16 * scale, 235 * scale) if codes.range == "limited" else (0.0, white)
    return Meaning(Decoder(gamma, levels), assumed, levels[1] if levels else None, notes)


def _unsupported(dtype: np.dtype, where: str) -> EventDataError:
    return EventDataError("unsupported pixel type", where=where, value=str(dtype), accepted="uint8, uint16 or float")


class Decoder:
    """Converts stored frames to linear luminance, (H, W) float32.

    gamma : "srgb", "linear", "pq", "hlg" or an exponent.   levels : codes of black, 0, and white, 1; None: the ends of
    an integer type, 0 and 1 of floats."""

    def __init__(self, gamma: str | float, levels: tuple[float, float] | None = None):
        self.gamma, self._levels = gamma, levels
        self._tables: dict[np.dtype, np.ndarray] = {}

    def table(self, dtype: DTypeLike) -> np.ndarray:
        """Return the luminance of each code of an unsigned integer type, float32."""
        dtype = np.dtype(dtype)
        if dtype not in self._tables:
            most = 2 ** (8 * dtype.itemsize) - 1
            black, white = self._levels or (0, most)
            # Codes below black are noise about it; above white there may be highlights.
            code = np.maximum((np.arange(most + 1, dtype=np.float64) - black) / (white - black), 0)
            self._tables[dtype] = self._curve(code).astype(np.float32)
        return self._tables[dtype]

    def code_distance(self, dtype: DTypeLike) -> Callable[[float], float]:
        """Return the function of a luminance that gives the distance of two codes there, were there 256."""
        black, white = self._levels or (0, 2 ** (8 * np.dtype(dtype).itemsize) - 1)
        table, step = self.table(dtype), max(1, round((white - black) / 255))

        def distance(luminance: float) -> float:
            # The table rises, so the code of a luminance is where it would be inserted.
            at = int(np.clip(np.searchsorted(table, luminance), step, len(table) - 1))
            return float(table[at] - table[at - step]) * (white - black) / (255 * step) or 1e-12

        return distance

    def __call__(self, frame: np.ndarray, name: str) -> np.ndarray:
        """Decode a frame. Raises EventDataError with ``name``, pixel and value for NaN, infinite or negative
        intensities."""
        if frame.dtype in (np.uint8, np.uint16):
            table = self.table(frame.dtype)
            if frame.ndim == 2:
                return table[frame]
            out = np.empty(frame.shape[:2], np.float32)
            _luma_by_table(np.ascontiguousarray(frame), table, LUMA, out)
            return out
        if frame.dtype.kind != "f":
            raise _unsupported(frame.dtype, name)
        frame = np.asarray(frame, np.float32)
        low, high = frame.min(), frame.max()
        if not (low >= 0 and high < np.inf):  # NaN fails both
            where = np.argwhere(~((frame >= 0) & (frame < np.inf)))[0]
            raise EventDataError(
                f"intensity at pixel x={where[1]}, y={where[0]} cannot be used",
                where=name,
                value=float(frame[tuple(where)]),
                accepted="a finite value >= 0",
            )
        if self._levels is not None:
            black, white = map(np.float32, self._levels)
            frame = np.maximum((frame - black) / (white - black), np.float32(0))
        linear = self._curve(frame)
        return np.ascontiguousarray(linear if linear.ndim == 2 else linear @ LUMA, np.float32)

    def _curve(self, code: np.ndarray) -> np.ndarray:
        gamma = self.gamma
        if gamma == "linear":
            return code
        if gamma in ("pq", "hlg"):
            return {"pq": _pq, "hlg": _hlg}[gamma](code.astype(np.float64)).astype(code.dtype)
        return linear_from_srgb(code) if gamma == "srgb" else code ** code.dtype.type(gamma)


def _pq(code: np.ndarray) -> np.ndarray:
    """Return light by the curve of SMPTE ST 2084 (ITU-R BT.2100, table 4), 1 at reference white."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = np.minimum(code, 1.0) ** (1 / m2)
    return (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1) * (1e4 / _REFERENCE_WHITE)


def _hlg(code: np.ndarray) -> np.ndarray:
    """Return the scene's light by the inverse of the hybrid log-gamma curve (ITU-R BT.2100, table 5), 1 at reference
    white, which is code 0.75."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    light = np.where(code <= 0.5, code**2 / 3, (np.exp((np.minimum(code, 1.2) - c) / a) + b) / 12)
    return light / ((np.exp((0.75 - c) / a) + b) / 12)


@kernel
def _luma_by_table(frame, table, weights, out):
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            out[y, x] = (
                weights[0] * table[frame[y, x, 0]]
                + weights[1] * table[frame[y, x, 1]]
                + weights[2] * table[frame[y, x, 2]]
            )


def checked_gamma(gamma: str | float | None) -> str | float | None:
    """Return a curve given by a user: its name, or an exponent as a number. Raises ConfigError."""
    if gamma is None or gamma in CURVES:
        return gamma
    try:
        value = float(gamma)
        if 0 < value <= 10:
            return value
    except (TypeError, ValueError):
        pass
    raise ConfigError("unknown transfer curve", where="gamma", value=gamma, accepted=ACCEPTED_CURVES)
