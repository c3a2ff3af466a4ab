"""`blinkgl verify --deep` finds nothing wrong with a fresh set of any shipped run, rig, sensor, recipe and preset."""

from pathlib import Path

import pytest
import yaml
from tiny_recipe import TINY

from blinkgl.config.names import shipped_names
from blinkgl.config.reader import read_table
from blinkgl.config.run import load_run
from blinkgl.dataset.cross_checks import comparable, first_difference
from blinkgl.dataset.generate import config_yaml
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset

CONFIGS = Path(__file__).parents[2] / "configs"
SMALL = {key: value for key, value in TINY.items() if key not in ("camera", "timeline")}
SHORT = {**SMALL, "time": {"duration": 0.02, "label_rate": 50}, "timeline": {"kind": "uniform", "fps": 200}}
ONE = {**SHORT, "camera": TINY["camera"]}
NAMED = {
    **{f"rig {name}": {**SHORT, "rig": name} for name in shipped_names("rigs")},
    "rig drawn": {**SHORT, "rig": {"choice": ["davis", "mvsec"]}},
    "sensor on a rig": {**SHORT, "rig": "davis", "sensors": [{"name": "davis", "sensor": "davis240c"}]},
    **{f"sensor {name}": {**SHORT, "sensor": name} for name in shipped_names("sensors")},
    **{f"recipe {name}": {**ONE, "events": {"recipe": name}} for name in shipped_names("emulators")},
    **{
        f"quality {name}": {**{k: v for k, v in ONE.items() if k != "timeline"}, "quality": name}
        for name in ("fast", "balanced", "accurate", "reference")
    },
}
RUNS = sorted(
    path
    for folder in (".", "scenes", "trade", "eflow")
    for path in (CONFIGS / folder).glob("*.yaml")
    if folder != "eflow" or path.stem.endswith("_data")
)


def groups_of(template):
    return [group.template for group in template.groups] if "groups" in template.tree else [template]


def same_when_read_again(path: Path, tmp_path: Path) -> None:
    for template in groups_of(load_run(path)):
        for index in range(3):
            drawn = template.sequence(index)
            (tmp_path / "config.yaml").write_text(config_yaml(drawn, index))
            again = load_run(tmp_path / "config.yaml").sequence(index)
            assert first_difference(comparable(again), comparable(drawn)) == ""


@pytest.mark.parametrize("name", NAMED)
def test_a_sequences_own_configuration_says_what_was_drawn(name, tmp_path):
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump(NAMED[name]))
    same_when_read_again(path, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_a_shipped_runs_own_configuration_says_what_was_drawn(path, tmp_path):
    same_when_read_again(path, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMED)
def test_a_fresh_set_is_right(name, tmp_path):
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump(NAMED[name]))
    right(load_run(path), tmp_path / "set")


@pytest.mark.slow
@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_a_fresh_set_of_a_shipped_run_is_right(path, tmp_path):
    tree = read_table(path)
    sizes = ["camera.width=32", "camera.height=24"] if "width" in tree.get("camera", {}) else []
    times = [] if path.stem == "multiflow" else ["time.duration=0.02", "time.label_rate=50"]
    if "frames" in tree:
        pytest.skip("it reads frames of a published data set")
    one_of_each = [f"groups.{name}.output.sequences=1" for name in tree.get("groups", {})]
    right(load_run(path, [*sizes, *times, *one_of_each]), tmp_path / "set")


def right(template, out: Path) -> None:
    run_dataset(template, out, num=None if "groups" in template.tree else 1)
    result = verify_dataset(out, deep=1)
    assert result.clean, result.problems
    assert len(result.deep) == 1
