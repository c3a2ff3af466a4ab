"""Evaluation of a network or a method on a data set: its answers beside baselines; tables, JSON and pictures."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NotRequired, TypedDict

import numpy as np
import torch
from rich.table import Table

from blinkgl.errors import AssetError
from blinkgl.io.atomic import write_whole
from blinkgl.io.records import inside
from blinkgl.machine.terminal import plain_console
from blinkgl.sequence_files.sequence_dir import refuse_existing
from eflow.data.dataset import evenly, truth_of
from eflow.data.sources import Source
from eflow.data.window import RawSample
from eflow.infer import Predictor
from eflow.methods import Method
from eflow.metrics import NAMES, Tally, frame_metrics
from eflow.models import FlowModel, parameters_of
from eflow.types import Flow, Mask, Numbers
from eflow.writers import Answer, comparison, events_of, write_picture

MEDIAN_FRAMES, PICTURES = 64, 12
BASELINES = ("zero flow", "median of the set", "median of the frame", "affine of the frame")
"""Answers to compare with: zero flow; the component-wise median of the set's ground truth; the median of each frame's
ground truth; and the affine field nearest to it. All but zero flow are computed from the truth: the last two are the
best that any global motion can reach."""


class Scores(TypedDict):
    """Metrics of :mod:`eflow.metrics`, in total and by scene."""

    total: dict[str, float]
    scenes: dict[str, dict[str, float]]


class Result(TypedDict):
    """The content of ``results.json``.

    model : its configuration, by key, or the name of a method.   parameters : their number.
    skipped, left_out : samples without a valid pixel, with an empty window.   still : samples with zero flow, of a
    method that has too few events.   warm : samples that were started from the flow before, with ``warm_start``.
    ms : mean time of a sample."""

    model: dict[str, object]
    parameters: int
    device: str
    samples: int
    skipped: int
    left_out: int
    still: int
    warm: NotRequired[int]
    ms: float
    methods: dict[str, Scores]


def answers(predictor: Predictor, source: Source, indices: Iterable[int]) -> Iterator[tuple[int, RawSample, Answer]]:
    """Yield (number, sample, answer) of the samples of a set, in order: the only walk over one.

    Raises AssetError: unreadable files. EventDataError: events outside the sensor."""
    for i in indices:
        sample = source[i]
        predictor.height, predictor.width = sample.height, sample.width  # sequences may differ
        began = time.perf_counter()
        flow, events = predictor(sample)
        yield i, sample, Answer(sample, flow, events, time.perf_counter() - began)


def evaluate(
    model: FlowModel | Method,
    source: Source,
    out: str | os.PathLike | None = None,
    *,
    limit: int | None = None,
    refine: bool = False,
    warm_start: bool = False,
    views: int = 1,
    progress: Callable[[int, int, float], None] | None = None,
) -> Result:
    """Score ``model``, or a method that needs no training, on every labelled sample of ``source``. Samples with an
    empty window are left out, for every network the same ones.

    out : new folder for ``results.json`` and ``pictures/`` (at most 12 evenly spaced samples: events, truth,
    prediction, error map); None: write nothing.
    limit : score only this many samples, evenly spaced.   refine, warm_start, views : as of
    :class:`~eflow.infer.Predictor`.
    progress : called with (samples done, samples in all, AEE so far).

    Raises AssetError: no ground truth, unreadable files. EventDataError: events outside the sensor."""
    if out is not None:
        refuse_existing(out)
    indices = evenly(len(source), limit or len(source))
    shown = {indices[k] for k in evenly(len(indices), PICTURES)}
    scores = _Scores(_set_median(source, indices))
    predictor = Predictor(model, 0, 0, warm_start=warm_start, refine=refine, views=views)
    for done, (i, sample, answer) in enumerate(answers(predictor, source, indices), 1):
        if not sample.has_events:
            scores.left_out += 1
            continue
        truth, valid = _labelled(sample)
        scores.add(answer, truth, valid)
        if progress is not None:
            progress(done, len(indices), scores.aee)
        if out is not None and i in shown:
            picture = comparison(events_of(answer.events), answer.flow, truth, valid)
            write_picture(inside(Path(out) / "pictures", f"{sample.name.replace('/', '_')}.png"), picture)
    if not scores.count:
        raise AssetError("no sample has events and a valid ground-truth pixel", accepted="a labelled data set")
    result = scores.result(predictor, len(indices) - scores.left_out)
    if out is not None:
        write_whole(Path(out) / "results.json", json.dumps(result, indent=1) + "\n")
    return result


class _Scores:
    """Metrics of the network and of the baselines, by scene. median : (2,) of the set's ground truth, px."""

    def __init__(self, median: Numbers):
        self.median = median
        self.tallies = {name: Tally() for name in ("network", *BASELINES)}
        self.count, self.left_out, self.still, self._sum, self._seconds = 0, 0, 0, 0.0, 0.0

    @property
    def aee(self) -> float:
        """Return the network's mean AEE so far, px."""
        return self._sum / max(self.count, 1)

    def add(self, answer: Answer, truth: Flow, valid: Mask) -> None:
        """Score one answer beside the baselines."""
        assert isinstance(answer.pair, RawSample)
        self._seconds += answer.seconds
        self.still += not answer.flow.any()
        scene, metrics = answer.pair.scene, frame_metrics(answer.flow, truth, valid)
        self.tallies["network"].add(scene, metrics)
        for name, constant in zip(BASELINES, (np.zeros(2), self.median, *best_motions(truth, valid)), strict=True):
            self.tallies[name].add(scene, frame_metrics(np.broadcast_to(constant, truth.shape), truth, valid))
        if metrics:
            self._sum, self.count = self._sum + metrics["AEE"], self.count + 1

    def result(self, predictor: Predictor, samples: int) -> Result:
        """Return everything about ``samples`` samples, for tables and files."""
        model = predictor.model
        network = isinstance(model, FlowModel)
        result: Result = {
            "model": json.loads(model.config.model_dump_json()) if network else {"name": model.name},
            "parameters": parameters_of(model) if network else 0,
            "device": _device_of(model),
            "samples": samples,
            "skipped": self.tallies["network"].skipped,
            "left_out": self.left_out,
            "still": self.still,
            "ms": 1000 * self._seconds / samples,
            "methods": {name: {"total": t.total(), "scenes": t.scenes()} for name, t in self.tallies.items()},
        }
        if predictor.warm_start:
            result["warm"] = predictor.warm
        return result


def _device_of(model: FlowModel | Method) -> str:
    """Return the name of the card on which a model computes, or "cpu" and the threads of a network there."""
    if not isinstance(model, FlowModel):
        return "cpu"
    device = next(model.parameters()).device
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu, {torch.get_num_threads()} threads"


def best_motions(truth: Numbers, valid: Mask) -> tuple[Numbers, Numbers]:
    """Return the median (2,) and the least-squares affine field (H, W, 2) of the truth; zeros if nothing is valid."""
    if not valid.any():
        return np.zeros(2), np.zeros_like(truth)
    # Coordinates of about 1 condition the least squares.
    y, x = np.indices(valid.shape) / max(valid.shape)
    ground = np.stack([np.ones_like(x), x, y], axis=-1)
    affine = np.linalg.lstsq(ground[valid], truth[valid].astype(np.float64), rcond=None)[0]
    return np.median(truth[valid], axis=0), ground @ affine


def _labelled(sample: RawSample) -> tuple[Flow, Mask]:
    """Return the ground truth of a sample and the pixels to score. Raises AssetError: it has none."""
    if (truth := truth_of(sample)) is None:
        raise AssetError("no ground truth", where=sample.name, accepted="a labelled data set")
    flow, valid, mask = truth
    return flow, valid & mask


def _set_median(source: Source, indices: list[int]) -> Numbers:
    """Return the component-wise median of the ground truth over at most 64 samples and every 8th pixel."""
    rows = [np.zeros((0, 2), np.float32)]
    # Rounded up, so that no more than MEDIAN_FRAMES are read.
    for sample in (source[i] for i in indices[:: -(-len(indices) // MEDIAN_FRAMES)]):
        if sample.has_events:
            flow, keep = (array[::8, ::8] for array in _labelled(sample))
            rows.append(flow[keep])
    values = np.concatenate(rows)
    return np.median(values, axis=0) if values.size else np.zeros(2)


def show(result: Result) -> None:
    """Print two tables: all metrics of the network and the baselines, and the network's metrics by scene."""
    console = plain_console()
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
    for count, what in (
        (result["skipped"], "without a valid pixel are left out"),
        (result["left_out"], "with an empty window are left out"),
        (result["still"], "have zero flow: too few events, or nothing moves"),
    ):
        if count:
            console.print(f"{count} samples {what}")
