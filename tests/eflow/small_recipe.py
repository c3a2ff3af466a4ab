"""A recipe whose sequences take milliseconds, and what its windows hold."""

from pathlib import Path

from tiny_recipe import TINY

from eflow.config import SourceConfig

RECIPE = {
    **TINY,
    "labels": {**TINY["labels"], "flow": ["forward", "backward"]},
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
