"""Samples that are rendered while they are trained on: the same ones whoever makes them, each once, bounded ahead."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

torch = pytest.importorskip("torch")

from blinkgl.errors import ConfigError, EventDataError  # noqa: E402
from blinkgl.online.cuts import drawn_spans  # noqa: E402
from blinkgl.online.job import MIX  # noqa: E402
from eflow.checkpoint import newest  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.data.dataset import Mixture, StepSampler  # noqa: E402
from eflow.data.online import held, open_online  # noqa: E402
from eflow.load_config import load_train_config  # noqa: E402
from eflow.train import train  # noqa: E402
from small_recipe import RECIPE, asked, said  # noqa: E402


def test_the_same_samples_whoever_renders_them_though_a_worker_is_killed(recipe):
    """Inline, from another beginning, and by two processes, one of which is killed: the n-th sample is the n-th."""
    count = 2 * MIX * 2  # two blocks of eight sequences, two samples each
    with open_online(asked(recipe, window_ms=(5, 30)), 0) as source:
        alone = [said(source[n]) for n in range(count + 4)]
    assert len({sample[0] for sample in alone}) == len(alone)
    with open_online(asked(recipe, window_ms=(5, 30)), 0, first=count + 3) as source:
        assert said(source[count + 3]) == alone[count + 3]
    with open_online(asked(recipe, window_ms=(5, 30), workers=2), 0) as source:
        spool = source.stream.spool
        os.kill(source.stream._executor._processes[0].popen.pid, signal.SIGKILL)
        for n in range(count + 4):
            assert said(source[n]) == alone[n], n
            slots = {int(p.name[:9]) for p in spool.glob("*.npz")}
            assert len(slots) <= 2 * MIX  # no further ahead than a block
        assert source.stats.replaced == 1 and source.stats.failures == 0 and source.stats.cpu_s > 0
        with pytest.raises(EventDataError, match="taken"):
            source[0]
    assert not spool.exists()


def test_a_sample_is_used_again_and_again_far_apart_and_then_dropped(recipe, monkeypatch):
    monkeypatch.setattr("eflow.data.online.LEAST_APART", 5)
    uses, apart, whole = 3, 5, 2 * MIX * 2 + 8
    with open_online(asked(recipe, window_ms=(5, 30)), 0) as source:
        alone = [said(source[n]) for n in range(whole)]
    with open_online(asked(recipe, window_ms=(5, 30), uses=uses), 0) as source:
        seen = [alone.index(said(source[n])) for n in range(uses * whole)]
        assert seen[::uses] == list(range(whole))
        full = seen[uses * uses * apart :]  # from here on there are older ones of every age
        assert [n - m for n, m in zip(np.repeat(full[::uses], uses), full)] == [0, apart, 2 * apart] * (len(full) // 3)
        assert len(set(seen[: uses * apart])) == apart
        with pytest.raises(EventDataError, match="taken"):
            source[0]
        assert source.stream.peek(whole - uses * apart)  # kept for one distance more than its last use


def test_samples_to_validate_with_are_used_once(recipe):
    samples = held(asked(recipe, window_ms=(5, 30), uses=4), 6)
    assert len({said(samples[k]) for k in range(6)}) == 6


def test_ranks_take_their_own_streams_one_sample_after_the_other():
    """Of a stream of its own each rank takes the samples 0, 1, 2 …; of a folder they share the order of one process."""
    mixture = Mixture([None, 10, None], [1.0, 0.3, 0.5], seed=3)
    batch, world, steps = 6, 3, 1600  # beyond an epoch
    assert steps * batch > mixture.epoch_length
    alone = [key for keys in StepSampler(mixture, batch, 0, steps) for key in keys]
    ranks = [list(StepSampler(mixture, batch, 0, steps, rank, world)) for rank in range(world)]
    for rank, taken in enumerate(ranks):
        mine = [key for keys in taken for key in keys]
        assert [(k.epoch, k.position, k.source) for k in mine] == [
            (k.epoch, k.position, k.source) for k in alone[rank::world]
        ]
        assert [k.index for k in mine if k.source == 1] == [k.index for k in alone[rank::world] if k.source == 1]
        for endless in (0, 2):
            numbers = [k.index for k in mine if k.source == endless]
            assert numbers == list(range(len(numbers)))
        for start in (7, 1500):
            assert list(StepSampler(mixture, batch, start, steps, rank, world)) == taken[start:], "resumed"
            count = sum(k.source == 2 for keys in taken[:start] for k in keys)
            assert mixture.first(2, start * batch, rank, world) == count


@pytest.mark.slow
def test_two_processes_render_for_themselves(recipe, tmp_path):
    """torchrun: each rank its own sequences; the run is resumed, and its folder is that of any run."""
    path = run_file(tmp_path, {"recipe": str(recipe), "online": True, "workers": 1, "samples": 2})
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1"}
    words = [
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
        "-m",
        "eflow.cli",
        "train",
        str(path),
    ]
    for more in (["--set", "run.time_limit=0.0001"], ["--resume"]):
        done = subprocess.run(
            [sys.executable, *words, "--out", str(tmp_path / "run"), "--quiet", *more],
            capture_output=True,
            text=True,
            timeout=300,
            env=environment,
        )
        assert done.returncode == 0, done.stderr[-3000:]
    assert int(newest(tmp_path / "run").name) == 12
    line = json.loads((tmp_path / "run" / "log.jsonl").read_text().splitlines()[-1])
    assert line["rendered"] >= 2 and line["failed_sequences"] == 0


def test_windows_lie_inside_and_lengths_are_log_uniform():
    spans = drawn_spans(np.random.default_rng(0), 1_000, 301_000, 20_000, (5_000, 100_000))
    t, span = np.array(spans).T
    assert (t >= 1_000).all() and (t + 2 * span <= 301_000).all()
    assert (span >= 5_000).all() and (span <= 100_000).all()
    share = np.log(span / 5_000) / np.log(20)
    assert np.abs(np.histogram(share, 4, (0, 1))[0] / len(share) - 0.25).max() < 0.02
    assert max(s for _, s in drawn_spans(np.random.default_rng(0), 0, 40_001, 100, (20_000, 100_000))) == 20_000
    with pytest.raises(ConfigError, match="holds no two windows of 50 ms"):
        drawn_spans(np.random.default_rng(0), 0, 99_000, 1, (50_000, 60_000))


def test_flow_is_over_the_windows_own_length(tmp_path):
    """A camera that slides along a wall at 1 m/s, 1 m away, focal length 32 px: 32 px/s, forwards and back."""
    slides = [{"time": t, "position": [t, 0, 0], "quaternion": [1, 0, 0, 0]} for t in (0.0, 1.0)]
    wall = {"mesh": "wall", "material": "checks", "position": [0, 0, 1.05], "scale": [20, 20, 0.1]}
    scene = {
        "kind": "explicit",
        "meshes": {"wall": {"primitive": "cuboid"}},
        "materials": {"checks": {"procedural": "checks", "uv_scale": [40, 40], "max_size": 64, "unlit": True}},
        "objects": [wall],
        "camera": {"keyframes": slides, "interpolation": "linear"},
    }
    tree = {**{k: v for k, v in RECIPE.items() if k != "groups"}, "scene": scene}
    tree["camera"] = {"width": 32, "height": 32, "focal": 32}
    (tmp_path / "wall.yaml").write_text(yaml.safe_dump(tree))
    with open_online(asked(tmp_path / "wall.yaml", window_ms=(5, 45), samples=MIX), 0) as source:
        found = [source[n] for n in range(MIX)]
    spans = [sample.new.t1 - sample.new.t0 for sample in found]
    assert max(spans) > 2 * min(spans)
    for sample, span in zip(found, spans, strict=True):
        assert sample.valid.all() and sample.old.t1 == sample.new.t0 and sample.old.t1 - sample.old.t0 == span
        for flow, sign in ((sample.flow, -1), (sample.backward, 1)):
            truth = [sign * 32e-6 * span, 0]
            np.testing.assert_allclose(flow[sample.valid], np.broadcast_to(truth, (sample.valid.sum(), 2)), atol=1e-4)


def run_file(folder: Path, *sets: dict, **keys) -> Path:
    tree = {
        "seed": 5,
        "model": {"name": "ev_flownet", "input": "voxel", "bins": 3, "width": 4},
        "data": {
            "train": list(sets),
            "batch": 2,
            "crop": [32, 32],
            "augment": {"time_reversal": 0.3, "scale_probability": 0},
            **keys,
        },
        "optim": {"steps": 12},
        "run": {"device": "cpu", "log_every": 1},
    }
    path = folder / "train.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.mark.parametrize("uses", [1, 3])
def test_trains_without_files_and_resumes_exactly(tmp_path, recipe, monkeypatch, uses):
    monkeypatch.setattr("eflow.data.online.LEAST_APART", 1)
    live = {"recipe": str(recipe), "online": True, "workers": 0, "samples": 2, "uses": uses}
    validate_on = [{**live, "uses": 1}]
    config = load_train_config(run_file(tmp_path, live, validate_on=validate_on, validate_samples=3))
    train(config, tmp_path / "whole", quiet=True)
    train(config, tmp_path / "parts", stop_after=9, quiet=True)  # inside the second block
    train(config, tmp_path / "parts", resume=True, quiet=True)
    logs = [[json.loads(line) for line in (tmp_path / d / "log.jsonl").open()] for d in ("whole", "parts")]
    steps = [[(r["step"], r["loss"]) for r in log if r["kind"] == "train"] for log in logs]
    assert steps[0] == steps[1] and len(steps[0]) == 12
    assert [r["recipe/zero"] for r in logs[0] if r["kind"] == "validation"] == [logs[1][-1]["recipe/zero"]]
    last = logs[0][-2]
    assert last["rendered"] >= 24 // uses and last["render_ms"] > 0 and 0 < last["waited"] <= 1
    files = [sorted(p.name for p in newest(tmp_path / d).iterdir()) for d in ("whole", "parts")]
    assert files[0] == files[1]


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({}, "give a folder (path) or a recipe"),
        ({"path": "a", "recipe": "b", "online": True}, "give a folder (path) or a recipe"),
        ({"recipe": "b"}, "online: true says so"),
        ({"path": "a", "online": True}, "a folder is not rendered"),
        ({"recipe": "b", "online": True, "window_ms": [100, 5]}, "window_ms"),
        ({"recipe": "b.yaml", "online": True, "workers": 0}, "loader processes do not render"),
        ({"recipe": "b.yaml", "online": True, "dt": 4}, "data.train.0.dt: only for a folder (path) (got 4)"),
        ({"path": "a", "uses": 4}, "data.train.0.uses: only for a recipe (got 4)"),
        ({"path": "a", "window_ms": [5, 50]}, "data.train.0.window_ms: only for a recipe (got (5.0, 50.0))"),
        ({"path": "a", "set": ["a.b=c"]}, "data.train.0.set: only for a recipe"),
    ],
)
def test_sources_that_make_no_sense(tmp_path, source, said):
    with pytest.raises(ConfigError) as caught:
        load_train_config(run_file(tmp_path, source, workers=1))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "where", "said"),
    [
        ({"labels.flow": []}, "labels.flow", "no flow labels to learn from"),
        ({"groups.one.enabled": False, "groups.two.enabled": False}, "output.split", "no sequences of split 'train'"),
        ({"scene.objects.count": -1}, "scene.objects.count", "count"),
        ({"frames": {"folders": ["x"], "images": "i", "fps": 10}}, "frames", "recorded frames are not rendered"),
    ],
)
def test_recipes_that_cannot_be_rendered_are_refused_at_once(tmp_path, recipe, changes, where, said):
    overrides = [f"{key}={json.dumps(value)}" for key, value in changes.items()]
    with pytest.raises(ConfigError) as caught:
        open_online(asked(recipe, set=tuple(overrides)), 0)
    assert said in str(caught.value) and where in (caught.value.where or "")


def test_a_recipe_is_evaluated_without_files(recipe, capsys, tmp_path):
    out = tmp_path / "scores"
    command = ["evaluate", "contrast-translation", str(recipe), "--window-ms", "5-30", "--limit", "3"]
    assert run([*command, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "3 samples" in said and json.loads((out / "results.json").read_text())["samples"] == 3
    for wrong in ("5ms", "100-5", "-5", "1-2-3"):
        assert run([*command[:3], f"--window-ms={wrong}"]) == 2
        assert "--window-ms: not a range of window lengths" in capsys.readouterr().err
