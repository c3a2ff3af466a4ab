"""The methods by name, as `eflow predict` and `eflow evaluate` take them in a checkpoint's place."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from blinkgl.errors import ConfigError
from eflow.data.window import Window


class Method(Protocol):
    """Events of [t - Δ, t) and [t, t + Δ) to the flow t -> t + Δ.

    name : as in :data:`METHODS`.   about : one line."""

    name: str
    about: str

    def __call__(self, old: Window, new: Window, height: int, width: int) -> np.ndarray:
        """(H, W, 2) float32 px, +x right, +y down. Raises EventDataError: too few events to say anything."""
        ...


def _contrast(field: str):
    def make(focal: float | None) -> Method:
        from eflow.methods.contrast import ContrastMaximisation

        return ContrastMaximisation(field, focal)

    return make


METHODS = {
    "contrast-translation": _contrast("translation"),
    "contrast-affine": _contrast("affine"),
    "contrast-rotation": _contrast("rotation"),
}
"""name -> what makes it, given the focal length in px (only rotation needs it)."""


def make_method(name: str, focal: float | None = None) -> Method:
    """A method of :data:`METHODS`. focal : px, of an ideal pin-hole camera whose axis meets the middle of the image.

    Raises ConfigError: rotation without a focal length."""
    if name == "contrast-rotation" and not focal:
        raise ConfigError("a rotation's flow depends on the lens", where="--focal", accepted="its focal length in px")
    return METHODS[name](focal)
