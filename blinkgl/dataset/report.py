"""What making one sequence cost, and the configuration that makes it again."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import yaml

import blinkgl
from blinkgl.config.sequence import SequenceConfig

Progress = Callable[["SequenceReport", float], None]
"""Called now and then with the running report and the fraction done, 0 … 1."""


@dataclass
class SequenceReport:
    """What one sequence cost and holds. Times in wall seconds; they are shown, never written into the data set."""

    index: int
    path: Path
    simulated_s: float = 0.0
    frames: int = 0
    events: int = 0
    triangles: int = 0
    labels: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    total_s: float = 0.0
    timeline: dict = field(default_factory=dict)
    """what an adaptive timeline says it achieved"""
    omissions: tuple[str, ...] = ()
    """what files of the scene ask for and is not drawn, a line per file"""


def config_yaml(config: SequenceConfig, index: int) -> str:
    """The resolved configuration as YAML; ``blinkgl generate`` takes it and makes this one sequence again."""
    tree = json.loads(config.model_dump_json())
    tree["output"].update(first_index=index, sequences=1)
    if tree.get("frames") is None:
        tree.pop("frames", None)
    return (f"# BlinkGL {blinkgl.__version__}, sequence {index}: every value as drawn.\n"
            "# Relative paths start from the folder of the run's own configuration file.\n"
            + yaml.safe_dump(tree, sort_keys=False))
