"""Decoding of given frames: luminance from codes by a curve, and the noise of the frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import DTypeLike

from blinkgl.errors import ConfigError, EventDataError
from blinkgl.machine.kernels import kernel
from blinkgl.recordings.fitting import Fitting
from blinkgl.recordings.frame_noise import FrameNoise, frame_noise
from blinkgl.srgb import linear_from_srgb

_LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""ITU-R BT.709, on linear light."""


class Decoder:
    """Converts stored frames to linear luminance, (H, W) float32.

    gamma : as of :func:`~blinkgl.recordings.simulation.frames_to_events`."""

    def __init__(self, gamma: str | float | None):
        self._gamma = gamma
        self._tables: dict[np.dtype, np.ndarray] = {}

    def table(self, dtype: DTypeLike) -> np.ndarray:
        """Return the luminance of each code of an unsigned integer type, float32."""
        dtype = np.dtype(dtype)
        if dtype not in self._tables:
            most = 2 ** (8 * dtype.itemsize) - 1
            self._tables[dtype] = self._curve(np.arange(most + 1, dtype=np.float64) / most, "srgb").astype(np.float32)
        return self._tables[dtype]

    def __call__(self, frame: np.ndarray, name: str) -> np.ndarray:
        """Decode a frame. Raises EventDataError with ``name``, pixel and value for NaN, infinite or negative
        intensities."""
        if frame.dtype in (np.uint8, np.uint16):
            table = self.table(frame.dtype)
            if frame.ndim == 2:
                return table[frame]
            out = np.empty(frame.shape[:2], np.float32)
            _luma_by_table(np.ascontiguousarray(frame), table, _LUMA, out)
            return out
        if frame.dtype.kind != "f":
            raise EventDataError(
                "unsupported pixel type", where=name, value=str(frame.dtype), accepted="uint8, uint16 or float"
            )
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
        linear = self._curve(frame, "linear")
        return np.ascontiguousarray(linear if linear.ndim == 2 else linear @ _LUMA, np.float32)

    def _curve(self, code: np.ndarray, default: str) -> np.ndarray:
        gamma = default if self._gamma is None else self._gamma
        if gamma == "linear":
            return code
        return linear_from_srgb(code) if gamma == "srgb" else code ** code.dtype.type(gamma)


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
    if gamma in (None, "srgb", "linear"):
        return gamma
    try:
        value = float(gamma)
        if 0 < value <= 10:
            return value
    except (TypeError, ValueError):
        pass
    raise ConfigError(
        "unknown transfer curve", where="gamma", value=gamma, accepted="srgb, linear or an exponent up to 10"
    )


def noise_of(frames: Sequence[np.ndarray], decode: Decoder, fitting: Fitting | None = None) -> FrameNoise | None:
    """Return the noise of the first stored frames, after ``decode`` and ``fitting``; None for floats, which are exact,
    and for frames of different sizes (which are refused later)."""
    first = frames[0]
    if first.dtype not in (np.uint8, np.uint16):
        return None
    if any(frame.dtype != first.dtype or frame.shape != first.shape for frame in frames):
        return None
    lights = [decode(frame, "") for frame in frames]
    lights = lights if fitting is None else [fitting(light) for light in lights]
    table = decode.table(first.dtype)
    middle = int(np.clip(np.searchsorted(table, np.median(lights[0])), 1, len(table) - 1))
    return frame_noise(lights, float(table[middle] - table[middle - 1]))
