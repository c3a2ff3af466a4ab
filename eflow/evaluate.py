"""Scores of a network on a data set: table, JSON, pictures; beside it two answers that need no network."""

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
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.machine.terminal import plain_console
from blinkgl.sequence_files.sequence_dir import refuse_existing
from eflow.confidence import SHARES, area, disagreement, sparsification
from eflow.data.dataset import FlowDataset, collate
from eflow.data.sources import Source
from eflow.density import LengthByDensity
from eflow.infer import PICTURED, MethodPredictor, Predictor, StreamWindow, predict
from eflow.methods import Method
from eflow.metrics import NAMES, Tally, frame_metrics
from eflow.models import FlowModel, parameters_of
from eflow.pictures import comparison, events_of, write_picture

MEDIAN_FRAMES = 64
JUDGED = 1000
"""Pixels of a sample, evenly spaced, that a confidence is judged by over a set."""
BASELINES = ("zero flow", "median of the set", "median of the frame", "affine of the frame")
"""Zero; one constant flow, the component-wise median of the set's own ground truth; and, frame by frame, the median of
that frame's ground truth and the affine field nearest to it: the best an answer could be that saw only the global
motion. But for zero they know the truth, so they are no methods."""


def evaluate(
    model: FlowModel | Method,
    source: Source,
    out: str | os.PathLike | None = None,
    *,
    pictures: int = 12,
    empty: str = "error",
    precision: str = "fp32",
    limit: int | None = None,
    confidence: bool = False,
    progress: Callable[[int, int, float], None] | None = None,
) -> dict[str, Any]:
    """Scores ``model``, or a method that needs no training, on every labelled sample of ``source``.

    out : new folder for ``results.json`` and ``pictures/`` (evenly spaced samples: events, truth, prediction, error
    map); None: nothing is written. limit : score only so many samples, evenly spaced.
    confidence : judge :func:`~eflow.confidence.disagreement`, too, by leaving out the pixels that it doubts.
    progress : called with (done, of, AEE so far).
    Returns {"methods": {name: {"total": …, "scenes": …}}, "lengths": rows of :class:`~eflow.density.LengthByDensity`,
    "ms", "samples", "skipped", "model", "parameters"}; metrics as in :mod:`eflow.metrics`. "confidence", where asked
    for: {"area": :func:`~eflow.confidence.area` over pixels of all samples, "area_in_a_sample": the mean of each one's
    own, "left_out": shares, and the AEE of the rest by "doubt", at "best", by "chance"}.

    Raises AssetError: no ground truth, unreadable files. EventDataError: a window without events
    (unless ``empty="skip"``)."""
    if out is not None:
        refuse_existing(out)
    out = Path(out) if out is not None else None
    method = None if isinstance(model, FlowModel) else model
    representation = model.representation if method is None else PICTURED
    reads = model.reads if method is None else ("old", "new")
    dataset = FlowDataset([source], representation, empty=empty, raw=True, reads=reads)
    indices = [int(i) for i in np.linspace(0, len(dataset) - 1, min(limit or len(dataset), len(dataset))).round()]
    shown = (
        {indices[int(i)] for i in np.linspace(0, len(indices) - 1, min(pictures, len(indices))).round()}
        if pictures
        else set()
    )
    median = _set_median(dataset, indices)
    tallies = {name: Tally() for name in ("network", *BASELINES)}
    lengths = LengthByDensity()
    spent, sum_aee, scored = 0.0, 0.0, 0
    areas, errors, doubted = [], [], []
    for done, i in enumerate(indices, 1):
        batch = collate([dataset[i]])
        raw = batch["raw"][0]
        began = time.perf_counter()
        if method is None:
            flow = predict(model, batch, precision=precision).flow[0].permute(1, 2, 0).cpu().numpy()
        else:
            flow = method(raw.old, raw.new, raw.height, raw.width)
        spent += time.perf_counter() - began
        truth, valid = batch["flow"][0].permute(1, 2, 0).numpy(), (batch["valid"] & batch["mask"])[0].numpy()
        scene = batch["scene"][0]
        metrics = frame_metrics(flow, truth, valid)
        tallies["network"].add(scene, metrics)
        for name, constant in zip(
            BASELINES,
            (np.zeros(2), median, *_from_truth(truth, valid)),
            strict=True,
        ):
            tallies[name].add(scene, frame_metrics(np.broadcast_to(constant, truth.shape), truth, valid))
        lengths.add(flow, truth, valid, len(raw.new), raw.hit)
        if confidence:
            where = (raw.height, raw.width)
            views = (
                Predictor(model, *where, precision=precision, empty="zero")
                if method is None
                else MethodPredictor(method, *where, empty="zero")
            )
            doubt = disagreement(views, StreamWindow(raw.new.t0, raw.old, raw.new), flow)
            error = np.hypot(*np.moveaxis(flow - truth, -1, 0))
            if curves := sparsification(error, doubt, valid):
                areas.append(area(curves))
                for kept, field in ((errors, error), (doubted, doubt)):
                    kept.append(field[valid][:: -(-int(valid.sum()) // JUDGED)])
        if metrics:
            sum_aee, scored = sum_aee + metrics["AEE"], scored + 1
        if progress is not None:
            progress(done, len(indices), sum_aee / max(scored, 1))
        if out is not None and i in shown:
            name = batch["name"][0].replace("/", "_")
            write_picture(
                out / "pictures" / f"{name}.png", comparison(events_of(batch["new"][0].numpy()), flow, truth, valid)
            )
    if not scored:
        raise AssetError("no sample has a valid ground-truth pixel", accepted="a labelled data set")
    result = {
        "model": json.loads(model.config.model_dump_json()) if method is None else {"name": method.name},
        "parameters": parameters_of(model) if method is None else 0,
        "samples": len(indices),
        "skipped": tallies["network"].skipped,
        "ms": 1000 * spent / len(indices),
        "device": _device_name(model) if method is None else "cpu",
        "methods": {name: {"total": t.total(), "scenes": t.scenes()} for name, t in tallies.items()},
        "lengths": lengths.rows(),
    }
    if confidence:
        error, doubt = np.concatenate(errors), np.concatenate(doubted)
        curves = sparsification(error, doubt, np.ones(error.shape, bool))
        result["confidence"] = {
            "area": area(curves),
            "area_in_a_sample": float(np.nanmean(areas)),
            "left_out": SHARES.tolist(),
            **{k: v.tolist() for k, v in curves.items()},
        }
    if out is not None:
        write_json(out / "results.json", result)
    return result


def _lengths(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="predicted / true length, median of the samples")
    for name in ("events per px of flow", "samples", "all pixels", "at events", "quartiles"):
        table.add_column(name, justify="right")
    for row in rows:
        above = row["to"] is None
        table.add_row(
            f"above {row['from']:g}" if above else f"{row['from']:g} to {row['to']:g}",
            str(row["samples"]),
            f"{row['all']:.2f}",
            f"{row['events']:.2f}",
            "{:.2f} to {:.2f}".format(*row["quartiles"]),
        )
    return table


def _confidence(judged: dict[str, Any]) -> Table:
    table = Table(
        title=f"confidence: {judged['area']:.2f} of the area of chance over all samples, "
        f"{judged['area_in_a_sample']:.2f} within one (0 is perfect, 1 says nothing)"
    )
    for name in ("most doubtful left out", "AEE of the rest, px", "at best", "by chance"):
        table.add_column(name, justify="right")
    for share, *values in zip(*(judged[k] for k in ("left_out", "doubt", "best", "chance")), strict=True):
        if round(100 * share) % 25 == 0 or share == judged["left_out"][-1]:
            table.add_row(f"{100 * share:.0f} %", *(f"{v:.3f}" for v in values))
    return table


def _from_truth(truth: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median (2,), and the affine field (H, W, 2) nearest to the truth in the mean square; 0 where nothing is valid."""
    if not valid.any():
        return np.zeros(2), np.zeros_like(truth)
    y, x = np.indices(valid.shape) / max(valid.shape)
    ground = np.stack([np.ones_like(x), x, y], axis=-1)
    affine = np.linalg.lstsq(ground[valid], truth[valid].astype(np.float64), rcond=None)[0]
    return np.median(truth[valid], axis=0), ground @ affine


def _set_median(dataset: FlowDataset, indices: list[int]) -> np.ndarray:
    """Component-wise median of the ground truth, over at most 64 samples and every 8th pixel."""
    rows = []
    for i in indices[:: -(-len(indices) // MEDIAN_FRAMES)]:
        sample = dataset[i]
        if "flow" not in sample:
            raise AssetError("no ground truth", where=sample["name"], accepted="a labelled data set")
        keep = (sample["valid"] & sample["mask"])[::8, ::8]
        rows.append(sample["flow"][:, ::8, ::8][:, keep].numpy())
    values = np.concatenate(rows, axis=1)
    return np.median(values, axis=1) if values.size else np.zeros(2)


def _device_name(model: FlowModel) -> str:
    device = next(model.parameters()).device
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu, {torch.get_num_threads()} threads"


def write_json(path: Path, tree: dict) -> None:
    """Whole or not at all."""
    with atomic_file(path) as temporary, output_errors(path):
        Path(temporary).write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")


def show(result: dict[str, Any], console: Console | None = None, by_density: bool = False) -> None:
    """Two tables: all metrics of the network and the baselines; the network scene by scene, or (``by_density``) how
    long its flow is where events are few and many. Fits 80 columns."""
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
    if by_density:
        console.print(_lengths(result["lengths"]))
    elif len(scenes) > 1:
        columns = ("AEE", "outlier", "3PE", "AE2D")
        table = Table(title="by scene")
        for name in ("", "frames", *columns):
            table.add_column(name, justify="right" if name else "left")
        for scene, scores in scenes.items():
            table.add_row(scene, str(scores["frames"]), *(f"{scores[c]:.3f}" for c in columns))
        console.print(table)
    if "confidence" in result:
        console.print(_confidence(result["confidence"]))
    if result["skipped"]:
        console.print(f"{result['skipped']} samples without a valid pixel were left out")
