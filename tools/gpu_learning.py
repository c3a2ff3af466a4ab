"""What gpu_suite trains: a network while its data are rendered, and the five networks side by side; and what
travels to a card for this. Pieces as in gpu_pieces."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import resources
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.tools import fingerprint as cases
from blinkgl.tools.gpu_pieces import PACKED, WITHOUT_CODECS, Row, Rows, arrays_of, command, last_line, only, overrides
from eflow.checkpoint import find_weights, load_model, read_tensors, write_tensors
from eflow.data.sources import FolderSource, Source, open_source
from eflow.evaluate import Scores, evaluate
from eflow.models import NETWORKS

RECIPES = resources.files("blinkgl.configs") / "eflow"
CORES = len(os.sched_getaffinity(0))
WINDOWS = {"window_ms": [5, 100], "min_events": 40, "max_flow": 16, "min_density": 0.008}
GROUPS = ("bodies_still.enabled=true", "bodies_few.enabled=true", "bodies_moving.enabled=true", "dense.enabled=true")
"""Windows and further groups of what real_bodies was trained on (configs/eflow/real_bodies.yaml)."""
SMALLER = ("camera.width=160", "camera.height=120", "events.contrast_threshold={uniform: [0.35, 0.4]}")
SETS = {
    "real_data": ("-n", "32", "--window-ms", "5-100"),
    "independent_data": ("-n", "24", "--window-ms", "50-50", *overrides(*SMALLER)),
}
"""Recipes of configs/eflow of whose test groups windows travel, 8 MiB of them."""
EVERY_MINUTES, BESIDE_S, MOST = 2.0, 60.0, 56
"""Minutes between two scores of a training; seconds that are not the training's own, when processes begin and
weights are judged; samples of a set that they are judged by."""
PARTS = {"FlyingObjects": "flying", "E-Tartan-like": "tartan", "custom": "custom"}
"""Test sets of the networks by the beginnings of their sequences' names."""


def pack(folder: Path, small: bool) -> None:
    """Write what a card's stages compare with: windows to judge networks by, and the fingerprint's pictures and labels.

    Flow is rounded to 1/256 px, half of the step of BlinkGL's own files."""
    for name, asked in SETS.items():
        words = ["--split", "test", "-q", "--workers", "2", "--per-sequence", "2", "--max-flow", "16", *asked]
        words += ["--min-density", "0.008", *overrides("labels.flow=[forward]"), *(["-n", "4"] if small else [])]
        command("eflow.cli", "render", str(RECIPES / f"{name}.yaml"), "--out", str(folder / name), *words)
        for path in (folder / name).glob("*.npz"):
            arrays = dict(np.load(path))
            rounded = np.where(arrays["valid"][..., None], np.round(256 * arrays["flow"]) / 256, 0)
            np.savez_compressed(path, **arrays | {"flow": rounded.astype(np.float32)})
    names = [*cases.table()["cases"]][: 4 if small else None]
    arrays = {path: array for name in names for path, array in arrays_of(name).items()}
    np.savez_compressed(folder / PACKED, **arrays)
    print(f"{folder}: {sum(path.stat().st_size for path in folder.rglob('*') if path.is_file()) / 2**20:.1f} MiB")


def started(words: Sequence[str], log: Path) -> subprocess.Popen:
    """Begin ``python -m eflow.cli`` with what it says in ``log``."""
    with log.open("a", encoding="utf-8") as file:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "eflow.cli", *words], stdout=file, stderr=subprocess.STDOUT
        )


def training(options: Namespace, data: Mapping[str, object], optim: Mapping[str, object]) -> list[str]:
    """Return overrides of ``eflow train`` for this machine: all that a training of minutes writes is its log and its
    newest weights."""
    never = 1_000_000
    run = {"device": options.device.split(":")[0], "precision": "bf16", "channels_last": True, "threads": None}
    run |= {"log_every": 20, "checkpoint_every": 100, "validate_every": never, "picture_every": never}
    data = {"workers": max(1, 3 * CORES // 4), **data}
    if options.small:
        data, run = data | {"workers": 0, "batch": 2}, run | {"log_every": 1, "checkpoint_every": 2}
    parts = {"data": data, "optim": {"steps": never, **optim}, "run": run}
    pairs = [f"{part}.{key}={json.dumps(value)}" for part, of in parts.items() for key, value in of.items()]
    return overrides(f"seed={options.seed}", *pairs)


def trained_so_far(run: Path, log: Path) -> Row:
    """Return what a run's log says last. Raises RuntimeError: there is no checkpoint."""
    if not (run / "checkpoints").is_dir():
        raise RuntimeError(f"no weights: {last_line(log.read_text(encoding='utf-8'))}")
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    names = ("step", "samples_per_s", "waited", "rendered", "render_ms", "failed_sequences")
    last = [line for line in lines if line["kind"] == "train"][-1]
    return {name: last[name] for name in names if name in last}


def scores(weights: str, sources: Mapping[str, Source], options: Namespace) -> dict[str, dict[str, Scores]]:
    """Return the metrics of a network and of the baselines, by set."""
    model = load_model(weights).to(options.device)
    return {name: evaluate(model, source, limit=MOST)["methods"] for name, source in sources.items()}


# --- a training while its data are rendered ---------------------------------------------------------------------------


def online(options: Namespace) -> Rows:
    sources = {name: open_source(path, "windows") for name in SETS if (path := options.packed / name).is_dir()}
    if not sources:
        raise AssetError("no windows to judge by", where=str(options.packed), accepted="use --pack before")
    run, log, best = Path(options.scratch, "online"), Path(options.scratch, "online.log"), np.inf

    def judge(weights: str) -> Row:
        judged = scores(weights, sources, options)
        share = lambda of: of["network"]["total"]["AEE"] / of["zero flow"]["total"]["AEE"]
        return {f"{name}, of zero flow's error": share(of) for name, of in judged.items()}

    def after(until: float, last: bool) -> Row:
        nonlocal best
        while process.poll() is None and (last or time.monotonic() < until):
            time.sleep(0.2)
        progress, (tensors, metadata) = trained_so_far(run, log), read_tensors(find_weights(run))
        halves = {key: value.half() if value.is_floating_point() else value for key, value in tensors.items()}
        write_tensors(newest := run / "half.safetensors", halves, metadata)
        row = judge(str(newest))
        if (mean := float(np.mean([*row.values()]))) < best:
            best = mean
            shutil.copy(newest, options.out / "online_half.safetensors")
        return {**progress, **row, "best": mean == best, "status": process.poll()}

    yield "real_bodies, which ships", partial(judge, "real_bodies")
    began, minutes = time.monotonic(), 0.15 if options.small else max(options.seconds - BESIDE_S, 30.0) / 60
    source = {"recipe": str(RECIPES / "real_data.yaml"), "online": True, "uses": 8, **WINDOWS}
    source |= {"set": [f"groups.{change}" for change in (*GROUPS, "plain.output.sequences=90")]}
    source |= {"workers": 1, "samples": 2} if options.small else {"workers": max(2, CORES), "samples": 10}
    data = {"train": [source], "validate_on": [], "batch": 64}
    words = ["train", str(RECIPES / "real_bodies.yaml"), "--out", str(run)]
    words += training(options, data, {"minutes": minutes})
    process = started([*words, *(["--resume"] if (run / "checkpoints").exists() else [])], log)
    count = max(1, round(minutes / EVERY_MINUTES))
    for k in range(1, count + 1):
        until = began + 60 * minutes * k / count
        yield f"after {minutes * k / count:.1f} minutes", partial(after, until, k == count)


# --- five networks ----------------------------------------------------------------------------------------------------


def networks(options: Namespace) -> Rows:
    yield "data", partial(_rendered, options, 0.22 * options.seconds)
    minutes = 0.1 if options.small else max(0.78 * options.seconds / len(NETWORKS) - BESIDE_S / 2, 10.0) / 60
    for name in NETWORKS:
        yield f"{name}, seed {options.seed}", partial(_learnt, options, name, minutes)


def _rendered(options: Namespace, seconds: float) -> Row:
    """Test sets, then windows of the training groups for what is left of ``seconds``. The frames of the E-Tartan-like
    set are BlinkGL's, too, interpolated along their flow."""
    until, scratch, workers = time.monotonic() + seconds, Path(options.scratch), str(max(1, CORES - 1))
    width, height, count, custom = 320, 240, 12, ("dancers", "crossing", "flags", "aquarium")
    rates = ["time.duration=1", "time.label_rate=10"]
    if options.small:
        width, height, count, custom = 96, 64, 2, ("dancers",)
        rates = ["time.duration=0.3", "time.label_rate=20"]
    size = [f"camera.width={width}", f"camera.height={height}", "labels.flow=[forward]", *rates]

    def made(name: str, groups: Sequence[str], *changes: str) -> None:
        words = overrides(*only(*groups), *WITHOUT_CODECS, *size, *changes)
        words += ["--out", str(scratch / name), "--num", str(count), "--workers", workers, "-q"]
        command("blinkgl", "generate", "blinkflow", *words)

    made("clips", ["flying_test"], "labels.images=true", "seed=1")
    frames = {"folders": [f"{scratch}/clips/test/flying_*"], "images": "images", "flow": "flow/forward"}
    changes = [f"groups.e_tartan.frames={json.dumps(frames | {'fps': float(rates[1].split('=')[1])})}"]
    changes.append(f"groups.e_tartan.output.sequences={count}")
    made("tests", ["flying_test", "e_tartan", *custom], *changes)
    words = ["render", "blinkflow", "--out", str(scratch / "pool"), "-n", "20" if options.small else "1000000"]
    words += ["--per-sequence", "9", "--workers", workers, *overrides(*only("flying_train"), *size)]
    process = started([*words, "--seed", str(options.seed)], scratch / "pool.log")
    while process.poll() is None and (options.small or time.monotonic() < until):
        time.sleep(0.1)
    process.terminate()  # the windows that are finished stay
    if process.wait():
        raise RuntimeError(f"no windows: {last_line((scratch / 'pool.log').read_text(encoding='utf-8'))}")
    windows, tests = [*(scratch / "pool").glob("*.npz")], [*(scratch / "tests" / "test").iterdir()]
    return {"windows": len(windows), "test sequences": len(tests)}


def _learnt(options: Namespace, name: str, minutes: float) -> Row:
    scratch, model = Path(options.scratch), f"{name}-tiny" if options.small else name
    run, log = scratch / name, scratch / f"{name}.log"
    augment = {"vertical_flip": 0.3, "scale_probability": 0}
    data = {"crop": [64, 96] if options.small else [240, 320], "batch": 8, "empty": "skip", "augment": augment}
    words = ["train", "--model", model, "--data", str(scratch / "pool"), "--out", str(run)]
    started([*words, *training(options, data, {"lr": 4e-4, "ema": 0.995, "minutes": minutes})], log).wait()
    row = {"minutes": minutes, **trained_so_far(run, log)}
    whole = open_source(str(scratch / "tests" / "test"))
    assert isinstance(whole, FolderSource)
    of = lambda start: FolderSource([s for s in whole.sequences if s.name.split("/")[-1].startswith(start)])
    for title, methods in scores(str(run), {title: of(start) for title, start in PARTS.items()}, options).items():
        own, zero = methods["network"]["total"], methods["zero flow"]["total"]
        columns = {"AEE, px": own["AEE"], "outliers, %": own["outlier"], "AE, deg": own["AE2D"], "zero": zero["AEE"]}
        row |= {f"{title}: {name}": value for name, value in columns.items()}
    return row
