"""Evaluation of a network or a method on a data set, beside baselines; tables, JSON and pictures."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from blinkgl.errors import AssetError
from blinkgl.io.atomic import write_whole
from blinkgl.io.records import inside
from blinkgl.machine.terminal import plain_console
from blinkgl.sequence_files.sequence_dir import refuse_existing
from eflow.data.dataset import FlowDataset, collate, evenly
from eflow.data.sources import Source
from eflow.infer import PICTURED, WarmStart
from eflow.methods import Method
from eflow.methods.contrast import sharpest_length
from eflow.metrics import NAMES, Tally, frame_metrics
from eflow.models import FlowModel, parameters_of
from eflow.pictures import comparison, events_of, write_picture

MEDIAN_FRAMES = 64
BASELINES = ("zero flow", "median of the set", "median of the frame", "affine of the frame")
"""Answers to compare with: zero flow; the component-wise median of the set's ground truth; the median of each frame's
ground truth; and the affine field nearest to it. All but zero flow are computed from the truth: the last two are the
best that any global motion can reach."""


def evaluate(
    model: FlowModel | Method,
    source: Source,
    out: str | os.PathLike | None = None,
    *,
    pictures: int = 12,
    empty: str = "error",
    precision: str = "fp32",
    limit: int | None = None,
    sharpen: bool = False,
    warm_start: bool = False,
    progress: Callable[[int, int, float], None] | None = None,
) -> dict[str, Any]:
    """Score ``model``, or a method that needs no training, on every labelled sample of ``source``.

    out : new folder for ``results.json`` and ``pictures/`` (evenly spaced samples: events, truth, prediction, error
    map); None: write nothing.
    limit : score only this many samples, evenly spaced.
    sharpen : scale the flow of a network to the length that makes the events of its windows sharpest, as `eflow
    predict` does.
    warm_start : start the refinement of a sample whose new window follows the previous sample's from its flow.
    progress : called with (samples done, samples in all, AEE so far).
    empty : samples with an empty window: "error", or "skip" leaves them out, for every network the same ones.
    Returns {"methods": {name: {"total": …, "scenes": …}}, "ms", "samples", "skipped" (no valid pixel), "left_out"
    (empty windows), "model", "parameters"}; metrics as in :mod:`eflow.metrics`.

    Raises AssetError: no ground truth, unreadable files. EventDataError: a window has no events (unless
    ``empty="skip"``)."""
    if out is not None:
        refuse_existing(out)
    out = Path(out) if out is not None else None
    representation = model.representation if isinstance(model, FlowModel) else PICTURED
    reads = model.reads if isinstance(model, FlowModel) and not sharpen else ("old", "new")
    dataset = FlowDataset([source], representation, empty=empty, raw=True, reads=reads, option="--empty skip")
    indices = evenly(len(dataset), limit or len(dataset))
    shown = {indices[k] for k in evenly(len(indices), pictures)}
    scores = _Scores(_set_median(dataset, indices))
    spent, left_out, warm = 0.0, 0, WarmStart(warm_start)
    for done, i in enumerate(indices, 1):
        if (sample := dataset[i]) is None:
            left_out += 1
            continue
        batch = collate([sample])
        raw, scene = batch["raw"][0], batch["scene"][0]
        began = time.perf_counter()
        if isinstance(model, FlowModel):
            flow = warm.predict(model, batch, (scene, raw.new.t0), (scene, raw.new.t1), precision)
            if sharpen:
                flow = flow * np.float32(sharpest_length([raw.old, raw.new], flow)[0])
        else:
            flow = model(raw.old, raw.new, raw.height, raw.width)
        spent += time.perf_counter() - began
        truth, valid = batch["flow"][0].permute(1, 2, 0).numpy(), (batch["valid"] & batch["mask"])[0].numpy()
        scores.add(scene, flow, truth, valid)
        if progress is not None:
            progress(done, len(indices), scores.aee)
        if out is not None and i in shown:
            name = batch["name"][0].replace("/", "_")
            picture = comparison(events_of(batch["new"][0].numpy()), flow, truth, valid)
            write_picture(inside(out / "pictures", f"{name}.png"), picture)
    if not scores.count:
        raise AssetError("no sample has events and a valid ground-truth pixel", accepted="a labelled data set")
    result = {
        **_of_the_model(model),
        "samples": len(indices) - left_out,
        "skipped": scores.tallies["network"].skipped,
        "left_out": left_out,
        **({"warm": warm.count} if warm_start else {}),
        "ms": 1000 * spent / (len(indices) - left_out),
        "methods": {name: {"total": t.total(), "scenes": t.scenes()} for name, t in scores.tallies.items()},
    }
    if out is not None:
        write_whole(out / "results.json", json.dumps(result, indent=1) + "\n")
    return result


class _Scores:
    """Metrics of the network and of the baselines, by scene. median : (2,) of the set's ground truth, px."""

    def __init__(self, median: np.ndarray):
        self.median = median
        self.tallies = {name: Tally() for name in ("network", *BASELINES)}
        self.count, self._sum = 0, 0.0

    @property
    def aee(self) -> float:
        """Return the network's mean AEE so far, px."""
        return self._sum / max(self.count, 1)

    def add(self, scene: str, flow: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> None:
        metrics = frame_metrics(flow, truth, valid)
        self.tallies["network"].add(scene, metrics)
        for name, constant in zip(BASELINES, (np.zeros(2), self.median, *best_motions(truth, valid)), strict=True):
            self.tallies[name].add(scene, frame_metrics(np.broadcast_to(constant, truth.shape), truth, valid))
        if metrics:
            self._sum, self.count = self._sum + metrics["AEE"], self.count + 1


def _of_the_model(model: FlowModel | Method) -> dict[str, Any]:
    """Return configuration, number of parameters and device of a model, as plain data."""
    if not isinstance(model, FlowModel):
        return {"model": {"name": model.name}, "parameters": 0, "device": "cpu"}
    device = next(model.parameters()).device
    cpu = f"cpu, {torch.get_num_threads()} threads"
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else cpu
    config = json.loads(model.config.model_dump_json())
    return {"model": config, "parameters": parameters_of(model), "device": name}


def best_motions(truth: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the median (2,) and the least-squares affine field (H, W, 2) of the truth; zeros if nothing is valid."""
    if not valid.any():
        return np.zeros(2), np.zeros_like(truth)
    # Coordinates of about 1 condition the least squares.
    y, x = np.indices(valid.shape) / max(valid.shape)
    ground = np.stack([np.ones_like(x), x, y], axis=-1)
    affine = np.linalg.lstsq(ground[valid], truth[valid].astype(np.float64), rcond=None)[0]
    return np.median(truth[valid], axis=0), ground @ affine


def _set_median(dataset: FlowDataset, indices: list[int]) -> np.ndarray:
    """Return the component-wise median of the ground truth over at most 64 samples and every 8th pixel."""
    rows = []
    # Rounded up, so that no more than MEDIAN_FRAMES are read.
    for i in indices[:: -(-len(indices) // MEDIAN_FRAMES)]:
        if (sample := dataset[i]) is None:
            continue
        if "flow" not in sample:
            raise AssetError("no ground truth", where=sample["name"], accepted="a labelled data set")
        keep = (sample["valid"] & sample["mask"])[::8, ::8]
        rows.append(sample["flow"][:, ::8, ::8][:, keep].numpy())
    values = np.concatenate(rows, axis=1) if rows else np.zeros((2, 0))
    return np.median(values, axis=1) if values.size else np.zeros(2)


def show(result: dict[str, Any], console: Console | None = None) -> None:
    """Print two tables: all metrics of the network and the baselines, and the network's metrics by scene."""
    console = console or plain_console()
    units = {"AEE": "px", "cosine": "", "AE2D": "deg", "AE3D": "deg"}
    table = Table(
        title=f"{result['model']['name']}: {result['samples']} samples, {result['ms']:.0f} ms each on "
        f"{result['device']}"
    )
    table.add_column("")
    for name in result["methods"]:
        table.add_column(name, justify="right")
    for metric in NAMES:
        table.add_row(
            f"{metric} {units.get(metric, '%')}".strip(),
            *(f"{m['total'][metric]:.3f}" for m in result["methods"].values()),
        )
    console.print(table)
    scenes = result["methods"]["network"]["scenes"]
    if len(scenes) > 1:
        columns = ("AEE", "outlier", "3PE", "AE2D")
        table = Table(title="by scene")
        for name in ("", "frames", *columns):
            table.add_column(name, justify="right" if name else "left")
        for scene, scores in scenes.items():
            table.add_row(scene, str(scores["frames"]), *(f"{scores[c]:.3f}" for c in columns))
        console.print(table)
    if "warm" in result:
        console.print(f"{result['warm']} samples follow the one before and were started from its flow")
    for key, what in (("skipped", "without a valid pixel"), ("left_out", "with an empty window")):
        if result[key]:
            console.print(f"{result[key]} samples {what} are left out")
