"""``lights.npz`` of a sequence: the state of light that changes over time."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from blinkgl.io.images import checked_arrays

LIGHTS = "lights.npz"
_SHAPES: dict[str, tuple[str, str]] = {
    "t_ns": ("T", "i"),
    "names": ("N", "U"),
    "factors": ("NT", "f"),
    "jump_t_ns": ("J", "i"),
    "jump_light": ("J", "i"),
    "jump_factor": ("J", "f"),
}
"""Array -> its axes, N lights, T times and J jumps, and NumPy's kind of number."""


def read_lights(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays of ``lights.npz``, by name: t_ns (T,) of the poses, the start and every label's time;
    names (N,) of the lights; factors (N, T) float64 by which they shine; jump_t_ns (J,) at which one jumps, increasing,
    jump_light (J,) its number among the names, jump_factor (J,) what it jumps to. An event of a jump has its
    microsecond, jump_t_ns // 1000, from an emulator without a low-pass.
    path : the file, or the folder of its sequence.

    Raises AssetError: missing, damaged, another shape or number type."""
    path = Path(path)
    return checked_arrays(path / LIGHTS if path.is_dir() else path, _SHAPES)
