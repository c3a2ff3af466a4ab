"""Groups of a recipe: laid over the common part, independent of one another, in the proportions asked for."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.stats import kstest

from blinkgl.config.draw import draw, middle, options
from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.config.expansion import load_recipe
from blinkgl.config.names import shipped_names
from blinkgl.config.problems import validate
from blinkgl.config.run import load_run
from blinkgl.dataset.assets import check_assets
from blinkgl.dataset.plan import Plan
from blinkgl.errors import ConfigError
from blinkgl.show.simulate import emulator_options
from tests.refusals import refusal

CONFIGS = Path(__file__).parents[2] / "configs"


def load(tmp_path, tree, overrides=()):
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    return load_run(path, overrides)


TREE = {
    "seed": 3,
    "camera": {"width": 64, "height": 48},
    "events": {"emulator": "v2e", "cutoff_hz": {"log_uniform": [50, 500]}},
    "groups": {
        "a": {"output": {"sequences": 3}},
        "b": {"output": {"split": "test", "sequences": 2}, "camera": {"width": 80}},
    },
}


def test_groups_share_what_they_do_not_say(tmp_path):
    plan = Plan.of(load(tmp_path, TREE))
    assert [t.name for t in plan.tasks] == [
        "train/a_000000",
        "train/a_000001",
        "train/a_000002",
        "test/b_000000",
        "test/b_000001",
    ]
    configs = {t.name: plan.config(t) for t in plan.tasks}
    assert {c.camera.height for c in configs.values()} == {48}
    assert [c.camera.width for c in configs.values()] == [64, 64, 64, 80, 80]
    assert len({c.events.cutoff_hz for c in configs.values()}) == 5, (
        "each sequence draws for itself, groups with seeds of their own"
    )
    assert [t.name for t in Plan.of(load(tmp_path, TREE), num=2).tasks] == ["train/a_000000", "test/b_000000"]


def test_a_group_does_not_depend_on_the_others(tmp_path):
    before = {g.name: (g.template.sequence(1), g.identity) for g in load(tmp_path, TREE).groups}
    grown = {
        **TREE,
        "groups": {
            "new": {"output": {"name": "new"}},
            "b": {**TREE["groups"]["b"], "output": {"split": "test", "sequences": 99}},
            "a": TREE["groups"]["a"],
        },
    }
    after = {g.name: (g.template.sequence(1), g.identity) for g in load(tmp_path, grown).groups}
    assert after["a"] == before["a"]
    assert after["b"][1] == before["b"][1], "how many there are is no part of what they are"
    other = {g.name: g.identity for g in load(tmp_path, TREE, ["camera.height=50"]).groups}
    assert all(other[name] != before[name][1] for name in "ab")


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"groups": {}}, "groups: not a table of groups"),
        ({"groups": {"a": 3}}, "groups.a: not a group"),
        ({"groups": {"a": {"enabled": "maybe"}}}, "groups.a.enabled: not true or false"),
        (
            {"groups": {"a": {"output": {"name": "x"}}, "b": {"output": {"name": "x"}}}},
            "groups.b.output: writes the same folders as group 'a'",
        ),
        (
            {"groups": {"a": {"camera": {"widht": 3}}}},
            "camera.widht: in group 'a': unknown key; expected 'width' (nearest)",
        ),
        (
            {"groups": {"a": {"output": {"split": {"choice": ["train", "test"]}}}}},
            "output: in group 'a': belongs to the whole run and cannot be drawn",
        ),
        ({"groups": {"a": {"enabled": False}}}, "groups: all groups are disabled"),
        (
            {
                "events": {
                    "shares": [
                        {"share": 0.8, "value": {"emulator": "v2e"}},
                        {"share": 0.3, "value": {"emulator": "voltmeter"}},
                    ]
                }
            },
            "events.shares: in group 'a': not a list of shares",
        ),
        ({"events": {"shares": [{"share": 1.0}]}}, "events.shares: in group 'a': not a list of shares"),
        ({"events": {"shares": None}}, "events.shares: in group 'a': not a list of shares"),
        ({"events": {"shares": 5}}, "events.shares: in group 'a': not a list of shares"),
        ({"events": {"choice": 5}}, "events.choice: in group 'a': not a list of choices"),
        ({"camera": {"width": {"uniform": 5}}}, "camera.width.uniform: in group 'a': not a range"),
        ({"camera": {"width": {"weighted": [1]}}}, "camera.width.weighted: in group 'a': not a table of weights"),
        (
            {
                "events": {
                    "shares": [
                        {"share": 0.5, "value": {"emulator": "v2e"}},
                        {"share": 0.5, "value": {"emulator": "blender"}},
                    ]
                }
            },
            "events.emulator: in group 'a': unknown choice",
        ),
    ],
)
def test_bad_recipes(tmp_path, changes, message):
    assert message in refusal(ConfigError, lambda: Plan.of(load(tmp_path, {**TREE, **changes})))


@pytest.mark.parametrize(
    "scene, message",
    [
        ({"pool": {"primitives": [], "folders": []}}, "in group 'a': the pool of meshes is empty"),
        (
            {"pool": {"primitives": ["cuboid"], "variants": 2, "test_fraction": 0.01}},
            "in group 'b': none of the 2 meshes falls to split 'test'",
        ),
        (
            {"textures": {"procedural": ["checks"], "variants": 1, "photographs": False, "test_fraction": 0.0}},
            "in group 'b': none of the 1 textures falls to split 'test'",
        ),
        ({"pool": {"folders": ["nowhere"]}}, "in group 'a': no such folder"),
    ],
)
def test_pools_that_cannot_serve_the_split(tmp_path, scene, message):
    made = Plan.of(load(tmp_path, {**TREE, "scene": {"kind": "random", **scene}}))
    assert message in refusal(ConfigError, check_assets, made)


def test_shares_are_dealt_out():
    """Any stretch of n sequences has n * share of each, within two, for every seed; twice the
    same; independent of where it starts."""
    tree = {
        "x": {
            "shares": [
                {"share": 0.5, "value": "a"},
                {"share": 0.3, "value": "b"},
                {"share": 0.2, "value": "c"},
                {"share": 0.0, "value": "never"},
            ]
        }
    }
    worst = 0.0
    for seed in range(6):
        values = [draw(tree, seed, i)["x"] for i in range(400)]
        for n in (10, 40, 200):
            for begin in range(0, 400 - n, 37):
                counted = Counter(values[begin : begin + n])
                worst = max(worst, *(abs(counted[k] - n * s) for k, s in (("a", 0.5), ("b", 0.3), ("c", 0.2))))
        assert "never" not in values
    assert worst < 3
    starts = [draw(tree, seed, 0)["x"] for seed in range(600)]
    np.testing.assert_allclose([starts.count(k) / 600 for k in "abc"], [0.5, 0.3, 0.2], atol=0.07)  # 3.5 sigma


def halves(*values: object) -> dict:
    return {"shares": [{"share": 1 / len(values), "value": value} for value in values]}


@pytest.mark.parametrize("seed", [3, 4])
def test_shares_deal_independently_of_each_other(seed):
    """Two in one recipe, three, and one below a value of another: each pair comes up as often as chance says, and each
    keeps its own shares among any 20 sequences."""
    tree = {"events": halves("a", "b"), "camera": halves(1, 2), "x": {"y": halves(*"rstu")}}
    tree["scene"] = halves({"kind": halves("k", "l")}, {"kind": "m"})
    rows = [draw(tree, seed, n) for n in range(400)]
    pairs = Counter((row["events"], row["camera"]) for row in rows)
    assert len(pairs) == 4 and all(85 <= count <= 115 for count in pairs.values())
    triples = Counter((row["events"], row["camera"], row["x"]["y"]) for row in rows)
    assert len(triples) == 16 and all(15 <= count <= 35 for count in triples.values())
    inner = Counter(row["scene"]["kind"] for row in rows)
    assert abs(inner["m"] - 200) <= 4 and abs(inner["k"] - 100) <= 15
    for first in range(0, 380, 7):
        assert 8 <= sum(row["camera"] == 1 for row in rows[first : first + 20]) <= 12
    # What the events draw does not depend on what else is dealt.
    assert [row["events"] for row in rows] == [draw({"events": tree["events"]}, seed, n)["events"] for n in range(400)]


@pytest.mark.parametrize("outer", ["choice", "shares", "weighted"])
def test_a_distribution_within_another_has_numbers_of_its_own(outer):
    inner = [{"integer": [0, 9]}, {"integer": [10, 19]}]
    spec = {"choice": inner, "shares": halves(*inner)["shares"], "weighted": None}[outer]
    if outer == "weighted":  # its keys are plain values
        assert {draw({"n": {"weighted": {"3": 1, "4": 1}}}, 1, k)["n"] for k in range(50)} == {"3", "4"}
        return
    counts = Counter(draw({"n": {outer: spec}}, 7, n)["n"] for n in range(2000))
    assert len(counts) == 20 and max(counts.values()) < 150
    with pytest.raises(ConfigError, match=r"^n\.integer: not a range"):
        draw({"n": {"choice": [{"integer": [2, 1]}]}}, 1, 0)


@pytest.mark.parametrize(
    "name, counts",
    [
        ("blinkflow", {("train", "v2e"): 2689, ("train", "voltmeter"): 673, ("test", "voltmeter"): 205}),
        ("blinkflow_mini", {("train", "v2e"): 13, ("train", "voltmeter"): 3, ("test", "voltmeter"): 4}),
    ],
)
def test_shipped_recipes(name, counts):
    plan = Plan.of(load_run(CONFIGS / f"{name}.yaml"))
    check_assets(plan)
    drawn = [plan.by_name[t.group].template for t in plan.tasks]
    emulators = Counter(
        (t.name.split("/")[0], draw({"events": template.tree["events"]}, template.seed, t.index)["events"]["emulator"])
        for t, template in zip(plan.tasks, drawn, strict=True)
    )
    for key, expected in counts.items():
        assert abs(emulators[key] - expected) <= 2
    assert sum(emulators.values()) == sum(counts.values())
    for task in plan.tasks[:3] + plan.tasks[-6:]:
        config = plan.config(task)
        threshold = config.events.contrast_threshold if config.events.emulator == "v2e" else 1 / config.events.k1
        assert 0.18 <= threshold <= 0.25


def test_a_scene_from_another_file(tmp_path):
    """It is as if it stood there: other keys lie over it, options too, and the recipe that is kept has it."""
    (tmp_path / "scenes").mkdir()
    scene = {"kind": "explicit", "meshes": {"a": {"primitive": "cuboid"}}, "objects": [{"mesh": "a"}], "camera": {}}
    (tmp_path / "scenes/one.yaml").write_text(yaml.safe_dump({"seed": 9, "camera": {"width": 20}, "scene": scene}))
    tree = {
        "camera": {"width": 64},
        "groups": {"a": {"scene": {"from": "scenes/one.yaml", "background": 0.5}}, "b": {}},
    }
    a, b = load(tmp_path, tree, ["groups.a.scene.light.unlit=true"]).groups
    config = a.template.sequence(0)
    assert config.scene.objects[0].mesh == "a" and config.scene.background == 0.5 and config.scene.light.unlit
    assert config.camera.width == 64, "nothing else comes from there"
    assert b.template.sequence(0).scene.kind == "random"
    alone = load(tmp_path, {"scene": {"from": "scenes/one.yaml"}})
    assert alone.tree["scene"] == scene
    for given, message in (
        ("scenes/two.yaml", "two.yaml: no such file"),
        (3, "scene.from: not a file"),
        ("recipe.yaml", "scene.from: the file has no table scene"),
    ):
        with pytest.raises(ConfigError, match=message):
            load(tmp_path, {"scene": {"from": given}})


# --- Recipes of published training sets: what they draw, keys beside them, and that every value has a source.

PAGE = Path(__file__).resolve().parents[2] / "docs" / "sensors.md"


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
    with pytest.raises(ConfigError, match="the recipe uses another emulator"):
        events_of(tmp_path, "events: {recipe: etap, emulator: v2e}")


def test_a_video_takes_the_middle():
    emulator, _ = emulator_options("esim", None, ["recipe=etap"])
    assert emulator.contrast_threshold == pytest.approx(0.25)


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


@pytest.mark.parametrize("low", [4.999, 4.9999995])
def test_narrow_limits_of_a_normal_law_are_drawn_over_all_of_them(low):
    """About the middle of so narrow limits the law is uniform; nothing is drawn so often as its mean."""
    values = np.array([draw({"c": {"normal": [5, 1, low, 10 - low]}}, 0, k)["c"] for k in range(300)])
    assert len(set(values)) == 300 and kstest((values - low) / (10 - 2 * low), "uniform").pvalue > 1e-3


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


def test_naming_the_kind_that_a_table_has_anyway_changes_nothing(tmp_path):
    """In a group, and over a scene from another file: tables of the default kind are merged with those that name it."""
    (tmp_path / "world.yaml").write_text(yaml.safe_dump({"scene": {"objects": {"count": 3}, "background": 0.7}}))
    common = {"events": {"contrast_threshold": 0.4}, "timeline": {"max_px": 0.25}, "scene": {"from": "world.yaml"}}
    common["scene"]["camera_motion"] = {"speed": [1, 2]}
    own = {"events": {"refractory_us": 100}, "timeline": {"min_step_us": 100}}
    named = {
        key: {**table, **tag}
        for (key, table), tag in zip(own.items(), ({"emulator": "esim"}, {"kind": "displacement"}))
    }
    named["scene"] = {"kind": "random", "camera_motion": {"kind": "spline", "rotation_rate": [3, 4]}}
    other = {"events": {"emulator": "v2e"}, "timeline": {"kind": "uniform"}}
    (tmp_path / "r.yaml").write_text(yaml.safe_dump({**common, "groups": {"a": own, "b": named, "c": other}}))
    a, b, c = (group.template.sequence(0) for group in load_run(tmp_path / "r.yaml").groups)
    assert (a.events, a.timeline) == (b.events, b.timeline) and a.events.contrast_threshold == 0.4
    assert (b.scene.objects.count, b.scene.background, b.scene.camera_motion.speed) == (3, 0.7, (1, 2))
    assert c.events.contrast_threshold != 0.4 and c.timeline.kind == "uniform"


@pytest.mark.parametrize("text", ["1e-1", "'0.1'", "0.1"])
def test_a_threshold_written_as_text_has_its_spread(tmp_path, text):
    """YAML 1.1 reads 1e-1 as text, which numbers may be."""
    (tmp_path / "r.yaml").write_text(f"events: {{contrast_threshold: {text}}}\n")
    events = load_run(tmp_path / "r.yaml").sequence(0).events
    assert events.contrast_threshold == 0.1 and events.threshold_sigma == pytest.approx(0.0105)
