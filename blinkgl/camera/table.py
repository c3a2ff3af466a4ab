"""Which camera models there are: one table of classes.

@register
@dataclass(frozen=True)
class Mine(CameraModel):           # or DistortedModel, which finds the bounds by itself
    kind: ClassVar[str] = "mine"
    …
"""

from __future__ import annotations

from typing import Any

from blinkgl.camera.model import CameraModel

CAMERA_MODELS: dict[str, type[CameraModel]] = {}
"""By ``kind``."""


def register(model: type[CameraModel]) -> type[CameraModel]:
    """Puts a class into the table; returns it, so that it may stand above the class. That its parts agree with each
    other, tests/camera/test_camera_models.py finds for every model of the table.

    Raises TypeError naming the model and the part that is missing; nothing is then registered."""
    kind = _checked(model)
    if CAMERA_MODELS.get(kind, model) is not model:
        raise TypeError(f"camera model '{kind}': there is one already, {CAMERA_MODELS[kind].__name__}")
    CAMERA_MODELS[kind] = model
    return model


def unregister(kind: str) -> None:
    """Takes the model of this name out again. Raises KeyError where there is none."""
    del CAMERA_MODELS[kind]


def _checked(model: Any) -> str:
    if not (isinstance(model, type) and issubclass(model, CameraModel)):
        raise TypeError(f"{model!r} is not a subclass of CameraModel")
    kind = getattr(model, "kind", None)
    if not isinstance(kind, str) or not kind:
        raise TypeError(f"camera model {model.__name__}: `kind` is not a name")
    for part in sorted(model.__abstractmethods__):
        raise TypeError(f"camera model '{kind}': `{part}` is missing")
    return kind
