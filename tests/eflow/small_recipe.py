"""A recipe whose sequences take milliseconds, and what its windows hold."""

from pathlib import Path

from eflow.config import SourceConfig

RECIPE = {
    "seed": 3,
    "camera": {"width": 32, "height": 32},
    "time": {"duration": 0.05, "label_rate": 20},
    "timeline": {"kind": "displacement", "max_px": 2.0},
    "scene": {
        "objects": {"count": 2},
        "textures": {"photographs": False, "procedural": ["checks"], "variants": 2, "max_size": 32},
        "pool": {"primitives": ["cuboid"], "variants": 2, "test_fraction": 0.5},
        "object_motion": {"kind": "static"},
        "camera_motion": {"speed": 2, "rotation_rate": 90},
    },
    "labels": {"images": False, "flow": ["forward", "backward"], "occlusion": False},
    "preview": {"enabled": False},
    "groups": {
        "one": {"output": {"sequences": 3}},
        "two": {"output": {"sequences": 1}, "events": {"contrast_threshold": {"uniform": [0.1, 0.3]}}},
        "judge": {"output": {"split": "test", "sequences": 1}},
    },
}


def asked(recipe: Path, **keys) -> SourceConfig:
    return SourceConfig(**{"recipe": str(recipe), "online": True, "workers": 0, "samples": 2, **keys})


def said(sample) -> tuple:
    """Everything of a sample, comparable."""
    columns = [getattr(w, c).tobytes() for w in (sample.old, sample.new) for c in "xytp"]
    return sample.name, sample.flow.tobytes(), sample.valid.tobytes(), sample.backward.tobytes(), *columns
