"""The methods by name; `eflow predict` and `eflow evaluate` take these names in place of a checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from blinkgl.errors import ConfigError
from eflow.data.window import Window
from eflow.types import Flow


class Method(Protocol):
    """Computes the flow t -> t + Δ from the events of [t - Δ, t) and [t, t + Δ).

    name : as in :data:`METHODS`.   about : one line."""

    name: str
    about: str

    def __call__(self, old: Window, new: Window, height: int, width: int) -> Flow:
        """Return flow (H, W, 2) float32 px, +x right, +y down. Raises EventDataError: too few events."""
        ...


def _contrast(field: str) -> Callable[[float | None], Method]:
    def make(focal: float | None) -> Method:
        from eflow.methods.contrast import ContrastMaximisation

        return ContrastMaximisation(field, focal)

    return make


METHODS = {
    "contrast-translation": _contrast("translation"),
    "contrast-affine": _contrast("affine"),
    "contrast-rotation": _contrast("rotation"),
}
"""Name -> function that makes the method, given the focal length in px (only rotation needs it)."""


def make_method(name: str, focal: float | None = None) -> Method:
    """Return a method of :data:`METHODS`. focal : px, of a pin-hole camera with its principal point in the image
    centre.

    Raises ConfigError: rotation without a focal length."""
    if name == "contrast-rotation" and not focal:
        raise ConfigError("a rotation's flow depends on the lens", where="--focal", accepted="its focal length in px")
    return METHODS[name](focal)
