"""The methods by name; `eflow predict` and `eflow evaluate` take these names in place of a checkpoint."""

from __future__ import annotations

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


METHODS = {
    "contrast-translation": "translation",
    "contrast-affine": "affine",
    "contrast-rotation": "rotation",
}
"""Name -> the motion field whose contrast the method maximises."""


def make_method(name: str, focal: float | None = None) -> Method:
    """Return a method of :data:`METHODS`. focal : px, of a pin-hole camera with its principal point in the image
    centre.

    Raises ConfigError: rotation without a focal length."""
    if name == "contrast-rotation" and not focal:
        raise ConfigError("a rotation's flow depends on the lens", where="--focal", accepted="its focal length in px")
    from eflow.methods.contrast import ContrastMaximisation

    return ContrastMaximisation(METHODS[name], focal)
