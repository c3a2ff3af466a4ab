"""Recipes of published training sets: what they draw, keys beside them, and that every value has a source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from blinkgl.config.draw import draw, middle, options
from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.config.expansion import load_recipe
from blinkgl.config.problems import validate
from blinkgl.config.reader import shipped_names
from blinkgl.config.run import load_run
from blinkgl.errors import ConfigError
from blinkgl.show.simulate import emulator_options

PAGE = Path(__file__).resolve().parents[2] / "docs" / "concepts.md"


def events_of(tmp_path, text, count=400):
    (tmp_path / "run.yaml").write_text(text)
    template = load_run(tmp_path / "run.yaml")
    return [template.sequence(k).events for k in range(count)]


def thresholds(events):
    return np.array([(e.contrast_threshold, e.contrast_threshold_off or e.contrast_threshold) for e in events]).T


def test_every_value_of_every_recipe_has_a_source_and_the_page_names_it():
    page = PAGE.read_text()
    for name in shipped_names("emulators"):
        recipe = load_recipe(name)
        shares = recipe.events.get("shares")
        tables = [part["value"] for part in shares] if shares else [recipe.events]
        keys = {key for table in tables for key in table} - {"emulator", "preset"}
        silent = {key for key in keys if key not in recipe.sources and not (key == "contrast_threshold_off" and shares)}
        assert not silent, (name, silent)
        assert recipe.sources and len(recipe.about) > 20 and f"`{name}`" in page


@pytest.mark.parametrize(
    "name, low, high, ratio", [("v2v", 0.05, 2.0, (1.0, 1.5)), ("stoffregen2020", 0.1, 1.5, (0.5, 1.5))]
)
def test_ratios_of_polarities(tmp_path, name, low, high, ratio):
    on, off = thresholds(events_of(tmp_path, f"events: {{recipe: {name}}}"))
    ratios = off / on
    if name == "v2v":
        assert low <= np.minimum(on, off).min() < low + 0.05 and high - 0.05 < np.minimum(on, off).max() <= high
        assert 0.4 < (ratios > 1).mean() < 0.6 and np.maximum(ratios, 1 / ratios).max() <= 1.5
        assert abs(np.maximum(ratios, 1 / ratios).mean() - 1.25) < 0.03
    else:
        assert 0.09 < ratios.std() < 0.12 and abs(np.median(ratios) - 1) < 0.02 and on.max() > 1.4 and on.min() < 0.15


def test_keys_beside_a_recipe_win_and_groups_and_choices_have_recipes(tmp_path):
    text = """
    groups:
      a: {events: {recipe: v2v, log_eps: 0.02, threshold_sigma: 0.1}}
      b: {events: {choice: [{recipe: etap}, {recipe: blinkflow, k6: 0}]}}
    """
    (tmp_path / "run.yaml").write_text(text)
    a, b = (group.template for group in load_run(tmp_path / "run.yaml").groups)
    assert {(a.sequence(k).events.log_eps, a.sequence(k).events.threshold_sigma) for k in range(9)} == {(0.02, 0.1)}
    kinds = [b.sequence(k).events for k in range(30)]
    assert {e.emulator for e in kinds} == {"esim", "voltmeter"}
    assert all(e.k6 == 0 and 4 <= e.k1 <= 6 for e in kinds if e.emulator == "voltmeter")


def test_what_is_no_recipe(tmp_path):
    with pytest.raises(ConfigError, match="one of blinkflow, e2vid, etap"):
        events_of(tmp_path, "events: {recipe: etapp}")
    with pytest.raises(ConfigError, match="the recipe is of another emulator"):
        events_of(tmp_path, "events: {recipe: etap, emulator: v2e}")


def test_a_video_takes_the_middle():
    data = emulator_options("esim", None, ["recipe=etap"])["emulator"]
    assert data["contrast_threshold"] == pytest.approx(0.25)


@pytest.mark.parametrize("model", [EsimConfig, V2eConfig])
def test_the_threshold_that_is_not_given_follows_from_the_ratio(model):
    assert model(contrast_threshold=0.3, threshold_ratio=1.2).contrast_threshold_off == pytest.approx(0.36)
    assert model(threshold_ratio=2).contrast_threshold_off == pytest.approx(0.4)
    other = model(contrast_threshold_off=0.3, threshold_ratio=1.5)
    assert (other.contrast_threshold, other.contrast_threshold_off) == (pytest.approx(0.45), 0.3)
    assert validate(model, other.model_dump()) == other, "as a sequence's config.yaml says it"
    with pytest.raises(ConfigError, match="not the ratio"):
        validate(model, {"contrast_threshold": 0.2, "contrast_threshold_off": 0.2, "threshold_ratio": 1.1})
    with pytest.raises(ConfigError, match="contrast_threshold_off: too large"):
        validate(model, {"contrast_threshold": 5, "threshold_ratio": 3})


def test_the_normal_distribution():
    spec = {"normal": [0.18, 0.03, 0.1, 0.2]}
    drawn = np.array([draw({"c": spec}, 3, k)["c"] for k in range(3000)])
    from scipy import stats

    law = stats.truncnorm((0.1 - 0.18) / 0.03, (0.2 - 0.18) / 0.03, 0.18, 0.03)
    assert stats.kstest(drawn, law.cdf).pvalue > 1e-3
    assert options(("c",), spec) == [0.1, 0.2] and middle(spec) == 0.18
    for bad in ([1, 2], [0, 1, 1, 2], [0, 0, -1, 1], [0, 1, -1, "x"]):
        with pytest.raises(ConfigError, match="not a normal distribution"):
            draw({"c": {"normal": bad}}, 0, 0)
