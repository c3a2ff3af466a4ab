"""The configurations that ship: every one is valid, and what the README says about them holds."""

from pathlib import Path

import pytest

pytest.importorskip("torch")

from blinkgl.config.sequence import load_run  # noqa: E402
from eflow.config import load_train_config  # noqa: E402
from eflow.models import NAMES, model_config  # noqa: E402

FOLDER = Path(__file__).resolve().parents[2] / "configs" / "eflow"
TRAINING = sorted(p.name for p in FOLDER.glob("*.yaml") if not p.name.endswith("_data.yaml"))


@pytest.mark.parametrize("name", TRAINING)
def test_training_configurations(name):
    config = load_train_config(FOLDER / name)
    model = model_config(config.model.model_dump())
    assert model == config.model
    if config.data.crop is not None:
        assert all(side % 16 == 0 and side >= 128 for side in config.data.crop)


@pytest.mark.parametrize("name", sorted(p.name for p in FOLDER.glob("*_data.yaml")))
def test_generation_configurations(name):
    """Backward flow for time reversal; train and test from other seeds and, by content hash, other meshes and textures."""
    first = load_run(FOLDER / name).check()
    assert set(first.labels.flow) == {"forward", "backward"}
    assert first.scene.pool.test_fraction > 0 and first.scene.textures.test_fraction > 0
    text = (FOLDER / name).read_text()
    assert "output.split=test" in text and f"--seed {first.seed + 1}" in text


def test_one_per_network_and_a_smoke_run():
    models = {load_train_config(FOLDER / n).model.name for n in TRAINING}
    assert models == set(NAMES)
    assert {"smoke.yaml", "eflowformer.yaml", "h100_30min.yaml"} <= set(TRAINING)
