"""The measurement: its reference, its front, its files."""

from __future__ import annotations

import csv
import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import ConfigError
from blinkgl.events import emulator_of
from blinkgl.render.renderer import Renderer
from blinkgl.tools.trade.matching import match_events
from blinkgl.tools.trade.measure import Bench, FineTiles, Level, Options
from blinkgl.tools.trade.metrics import SpeedMaps, event_errors
from blinkgl.tools.trade.settings import Setting, pareto_front
from blinkgl.tools.trade.words import convergence_line
from blinkgl.types.events import Events

CONFIG = {
    "seed": 3,
    "camera": {"width": 64, "height": 48},
    "time": {"duration": 0.1, "label_rate": 20},
    "scene": {
        "kind": "random",
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 4},
        "textures": {"procedural": ["checks", "fbm"], "variants": 4, "photographs": False, "max_size": 64},
    },
}
OPTIONS = Options(clip_s=0.02, tiles=(2, 2, 16, 12), levels=((2, 0.5), (4, 0.25)), rounds=1)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("trade") / "c.yaml"
    path.write_text(yaml.safe_dump(CONFIG))
    return path


def test_front_by_hand():
    rows = [
        dict(n=n, c=c, e=e)
        for n, c, e in (
            ("a", 1, 9),
            ("b", 2, 5),
            ("worse than b", 3, 5),
            ("c", 4, 1),
            ("slow", 9, 2),
            ("equal to c", 4, 1),
            ("unknown", 0, float("nan")),
        )
    ]
    assert [r["n"] for r in pareto_front(rows, "c", "e")] == ["a", "b", "c"]


def test_fine_tiles_are_the_image_itself_and_then_its_mean(gl, config):
    """One sample a pixel: the picture's own pixels. More: what super-sampling the whole image gives."""
    bench = Bench(gl, load_run(config), OPTIONS)
    t = bench.t0_ns
    for scale, antialiasing in ((1, "none"), (2, "ssaa2"), (4, "ssaa4")):
        render = bench.config([f"render.antialiasing={antialiasing}"]).render
        with (
            Renderer(gl, bench.scene, render) as whole,
            FineTiles(gl, bench.scene, bench.tiles, scale, RenderConfig()) as tiles,
        ):
            image = whole.luminance(t).read()
            (mine,) = tiles([t])
            inside = np.abs(mine - image)[bench.mask]
            # The tiles' projection rounds differently: a sample on an edge may fall on its other side.
            assert np.percentile(inside, 97) < 2e-4 * image.max() and inside.mean() < 2e-3 * image.max()
            assert not mine[~bench.mask].any()
            speed = np.hypot(*np.moveaxis(whole.velocity(t).read(), -1, 0))[bench.mask].max()
            assert tiles.pace(1.0).at(t) == pytest.approx(speed, rel=0.05)


def test_reference_converges_and_the_ladder_says_so(gl, config):
    """The finer of two references moves less; what is judged by itself is without error."""
    bench = Bench(gl, load_run(config), replace(OPTIONS, levels=((2, 0.5), (4, 0.2), (8, 0.1), (16, 0.05))))
    results = bench.measure([Setting("displacement 2 px")])
    levels = bench.judge(results, bench.speeds())
    moved = [level.movement["voxel"] for level in levels[1:]]
    assert len(levels) >= 3 and moved[-1] < 0.7 * moved[0]
    assert levels[-1].ratio["voxel"] == pytest.approx(levels[-1].movement["voxel"] / results[0].errors.voxel)
    assert bench.errors(levels[-1].events, levels[-1].events, bench.speeds()).voxel == 0
    assert results[0].flow["flow_max_px"] < 1e-2
    level = replace(
        levels[-1], movement=dict.fromkeys(levels[-1].movement, 1.0), smallest=dict.fromkeys(levels[-1].movement, 10.0)
    )
    assert level.converged and not replace(level, smallest=dict.fromkeys(level.movement, 9.9)).converged
    assert not Level(1, 1.0, 1, 1.0, levels[0].events).converged, "a single level was never checked"


def test_a_reference_with_more_than_the_settings(gl, config):
    """Judged by a scene with shadows: the settings have none, the reference other events."""
    template = load_run(config)
    same, more = (
        Bench(gl, template, replace(OPTIONS, levels=((2, 0.5),), reference_set=texts))
        for texts in ((), ("scene.light.shadows=hard", "scene.light.sky=0.1"))
    )
    assert (more.scene.light.shadows, more.reference_scene.light.shadows) == ("off", "hard")
    assert same.reference_scene is same.scene and more.tiles == same.tiles
    (plain,), (shaded,) = (bench.judge([], bench.speeds()) for bench in (same, more))
    assert same.errors(shaded.events, plain.events, same.speeds()).wrong > 0.02
    with pytest.raises(ConfigError, match="--reference-set: the reference may differ only in the scene"):
        Bench(gl, template, replace(OPTIONS, reference_set=("camera.width=10",)))


def test_half_size_keeps_the_view(gl, config):
    template = load_run(config, ["camera.cx=31.5", "camera.fov=50"])
    full, half = (Bench(gl, template, OPTIONS, size) for size in ("", "half size"))
    assert (half.width, half.height) == (32, 24)
    assert half.scene.camera.fx == pytest.approx(full.scene.camera.fx / 2) and half.scene.camera.cx == pytest.approx(
        15.5
    )


@pytest.fixture(scope="module")
def result(config, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "t"
    status = run(
        [
            "trade",
            str(config),
            "--quick",
            "--clip",
            "0.01",
            "--rounds",
            "1",
            "--only",
            "1 px, edges2",
            "--only",
            "2 px, none",
            "--minutes",
            "0.1",
            "-o",
            str(out),
        ]
    )
    assert status == 0
    return out


def test_files_of_the_command(result):
    data = json.loads((result / "trade.json").read_text())
    assert "NaN" not in (result / "trade.json").read_text()
    names = [s["name"] for s in data["settings"]]
    assert data["front"] and set(data["front"]) <= set(names) and len(names) == 2
    rows = list(csv.DictReader((result / "trade.csv").open()))
    assert [r["name"] for r in rows] == names and float(rows[0]["wall_s"]) > 0 and rows[0]["flow_median_px"]
    assert (result / "pareto.png").read_bytes()[:4] == b"\x89PNG"
    page = (result / "trade.html").read_text()
    assert all(n in page for n in names) and not re.search(r"(src|href)=['\"](?!data:)", page) and "<script" not in page


def test_errors(config, tmp_path, capsys):
    for arguments, message in (
        (["--only", "raytracing"], "--only, --skip: no setting has this name"),
        (["--cost", "euros"], "--cost: unknown cost"),
        (["--set", "render.antialiasing=fxaa"], "render.antialiasing"),
    ):
        assert run(["trade", str(config), "-o", str(tmp_path / "x"), *arguments]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert not (tmp_path / "x").exists()
    (tmp_path / "f.yaml").write_text("frames: {folders: nothing}\n")
    assert run(["trade", str(tmp_path / "f.yaml"), "-o", str(tmp_path / "x")]) == 2
    assert "no settings to compare" in capsys.readouterr().err


def test_an_unchecked_reference_is_called_that():
    result = {
        "enough": 0.1,
        "sizes": {"full": {"converged": False, "levels": [{"scale": 8, "max_px": 0.1, "frames": 3, "ratio": {}}]}},
    }
    assert "NOT checked" in convergence_line(result)
    ratio = dict.fromkeys(("time_median_us", "time_p95_us", "wrong", "voxel"), 0.3)
    result["sizes"]["full"]["levels"].append({"scale": 16, "max_px": 0.05, "frames": 3, "ratio": ratio})
    assert "did NOT converge" in convergence_line(result) and "voxel grid 30 %" in convergence_line(result)
    result["sizes"]["full"]["converged"] = True
    assert "the reference converged" in convergence_line(result)


# --- Matching and errors of event streams: cases that were worked out by hand, an exhaustive search, exact shifts.

H, W = 4, 5


def stream(*rows) -> Events:
    """Events from (x, y, t, p) rows, sorted by time."""
    rows = sorted(rows, key=lambda r: r[2])
    x, y, t, p = zip(*rows) if rows else ((), (), (), ())
    return Events(np.array(x, np.uint16), np.array(y, np.uint16), np.array(t, np.int64), np.array(p, np.uint8))


def train(*times, x=1, y=2, p=1) -> Events:
    return stream(*((x, y, t, p) for t in times))


def random_stream(n: int, span_us: int, seed: int) -> Events:
    rng = np.random.default_rng(seed)
    return Events(
        rng.integers(0, W, n).astype(np.uint16),
        rng.integers(0, H, n).astype(np.uint16),
        np.sort(rng.integers(0, span_us, n)),
        rng.integers(0, 2, n).astype(np.uint8),
    )


def pairs(a: Events, b: Events, limit_us: int) -> list[tuple[int, int]]:
    m = match_events(a, b, H, W, limit_us)
    return [(int(a.t[i]), int(b.t[j])) for i, j in enumerate(m.partner) if j >= 0]


SPEED = SpeedMaps(np.array([0]), np.full((1, H, W), 200.0, np.float32))


def errors(a: Events, b: Events, limit_us: int = 1000, **options):
    return event_errors(a, b, SPEED, 0, 100_000, limit_us=limit_us, **options)


def test_dropped_and_invented_events_are_counted():
    a = random_stream(4000, 100_000, 1)
    keep = np.arange(len(a)) % 8 != 0
    b = Events(a.x[keep], a.y[keep], a.t[keep], a.p[keep])
    e = errors(a, b)
    assert e.missed == pytest.approx(1 / 8) and e.extra == 0 and e.time_p95_us == 0 and e.count == pytest.approx(-1 / 8)
    e = errors(b, a)
    assert e.missed == 0 and e.extra == pytest.approx(1 / 7)


def cost_of(a: list[int], b: list[int], limit: int) -> float:
    """The least cost over all matchings, by trying them all."""
    best = np.inf
    for size in range(min(len(a), len(b)) + 1):
        for left in itertools.combinations(range(len(a)), size):
            for right in itertools.permutations(range(len(b)), size):
                distances = [abs(a[i] - b[j]) for i, j in zip(left, right)]
                if all(d <= limit for d in distances):
                    best = min(best, sum(distances) + limit / 2 * (len(a) + len(b) - 2 * size))
    return best


@pytest.mark.parametrize("seed", range(60))
def test_optimal_among_all_matchings(seed):
    rng = np.random.default_rng(seed)
    a, b = (sorted(rng.integers(0, 60, rng.integers(1, 6)).tolist()) for _ in range(2))
    limit = int(rng.integers(2, 40))
    found = match_events(train(*a), train(*b), H, W, limit)
    cost = float(np.abs(found.dt_us).sum()) + limit / 2 * (int((~found.matched).sum()) + found.extra)
    assert cost == cost_of(a, b, limit)
    used = found.partner[found.matched]
    assert len(set(used.tolist())) == len(used) and np.abs(found.dt_us).max(initial=0) <= limit


def test_window_and_mask():
    a = train(1000, 5000, 9000)
    b = stream((1, 2, 1010, 1), (1, 2, 9010, 1), (4, 3, 5000, 1))
    e = event_errors(a, b, SPEED, 0, 6000, limit_us=100)
    assert (e.reference_events, e.events, e.missed, e.extra) == (2, 2, 0.5, 0.5)
    mask = np.zeros((H, W), bool)
    mask[2, 1] = True
    e = event_errors(a, b, SPEED, 0, 10_000, limit_us=100, mask=mask)
    assert (e.reference_events, e.events, e.extra) == (3, 2, 0) and e.missed == pytest.approx(1 / 3)
    empty = event_errors(train(), train(), SPEED, 0, 10, limit_us=5)
    assert np.isnan(empty.missed) and np.isnan(empty.voxel) and np.isnan(empty.time_median_us) and np.isnan(empty.count)


def test_off_the_sensor_is_refused():
    with pytest.raises(ValueError, match="off the sensor"):
        match_events(train(1, x=W), train(1), H, W, 10)
    with pytest.raises(ValueError, match="limit_us"):
        match_events(train(1), train(1), H, W, 0)


@pytest.mark.parametrize(
    "wave", [{"kind": "sine", "frequency": 100, "depth": 0.5}, {"kind": "pwm", "frequency": 90, "duty": 0.3}], ids=str
)
def test_the_reference_sees_lights_that_change(gl, tmp_path, wave):
    """A camera at rest before a body at rest: between two frames of the reference the light changes by a tenth of a
    threshold at most, or it jumps, and both sides of the jump have a frame."""
    scene = {
        "kind": "explicit",
        "meshes": {"a": {"primitive": "cuboid"}},
        "objects": [{"mesh": "a", "position": [3, 0, 0]}],
        "camera": {"position": [0, 0, 0]},
        "light": {"over_time": wave},
    }
    path = tmp_path / "r.yaml"
    path.write_text(yaml.safe_dump({"camera": {"width": 48, "height": 36}, "scene": scene, "time": {"duration": 0.2}}))
    bench = Bench(gl, load_run(path), OPTIONS)
    response = emulator_of(bench.emulator).response(bench.emulator)
    with FineTiles(gl, bench.scene, bench.tiles, 1) as source:
        times = list(source.times(0.1, bench.t0_ns, bench.t1_ns, response))
    (light,) = bench.scene.waveforms.values()
    jumps = light.jumps(bench.t0_ns, bench.t1_ns)
    shown = np.log([light.factor(max(t - 1, bench.t0_ns)) + 1e-9 for t in times])
    leaps = np.isin(times[:-1], jumps)
    assert np.abs(np.diff(shown))[~leaps].max(initial=0) <= 0.1001 * response.threshold
    assert set(jumps) <= set(times) and {t + 1 for t in jumps} <= set(times)
    assert len(jumps) == 4 if wave["kind"] == "pwm" else len(times) > 100
