"""torch on one thread: test processes run side by side, and tiny networks only wait at each other's barriers."""

import importlib.util
from pathlib import Path

import pytest
import yaml

if importlib.util.find_spec("torch") is not None:
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def recipe(tmp_path_factory) -> Path:
    """The small recipe as a file."""
    from small_recipe import RECIPE

    path = tmp_path_factory.mktemp("recipe") / "recipe.yaml"
    path.write_text(yaml.safe_dump(RECIPE))
    return path
