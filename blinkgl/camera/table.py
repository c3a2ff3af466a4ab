"""The table of camera models: its rows are classes.

@register
@dataclass(frozen=True)
class Mine(CameraModel):           # or DistortedModel, which finds the bounds by itself
    kind: ClassVar[str] = "mine"
    …
"""

from __future__ import annotations

from blinkgl.camera.model import CameraModel

CAMERA_MODELS: dict[str, type[CameraModel]] = {}
"""Camera models by ``kind``."""


def register(model: type[CameraModel]) -> type[CameraModel]:
    """Add a class to the table and return it, so that this is usable as a decorator. tests/camera/test_camera_models.py
    checks for every model of the table that its parts agree.

    Raises TypeError naming the model and the missing part; nothing is then registered."""
    kind = _checked(model)
    if CAMERA_MODELS.get(kind, model) is not model:
        raise TypeError(f"camera model '{kind}': there is one already, {CAMERA_MODELS[kind].__name__}")
    CAMERA_MODELS[kind] = model
    return model


def _checked(model: object) -> str:
    if not (isinstance(model, type) and issubclass(model, CameraModel)):
        raise TypeError(f"{model!r} is not a subclass of CameraModel")
    kind = getattr(model, "kind", None)
    if not isinstance(kind, str) or not kind:
        raise TypeError(f"camera model {model.__name__}: `kind` is not a name")
    for part in sorted(model.__abstractmethods__):
        raise TypeError(f"camera model '{kind}': `{part}` is missing")
    return kind
