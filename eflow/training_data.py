"""The training and validation sets of a training."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from blinkgl.config.run import derived_seed
from blinkgl.errors import AssetError, ConfigError
from eflow.config import SourceConfig, TrainConfig
from eflow.data.dataset import FlowDataset, Key, Mixture, collate, evenly, is_endless
from eflow.data.sources import Source, open_source, parts_of
from eflow.infer import predict
from eflow.metrics import frame_metrics
from eflow.models import FlowModel


def training_sets(
    config: TrainConfig, start: int, rank: int, world: int, stack: contextlib.ExitStack
) -> tuple[Mixture, list[Source]]:
    """Return the order of the samples and the open sets.

    ``stack`` ends the rendering processes. Each rank renders its own sequences, different from those of other ranks."""
    data = config.data
    sources: dict[int, Source] = {
        k: open_source(s.path, s.format, dt=s.dt) for k, s in enumerate(data.train) if s.path is not None
    }
    for share in (s.share for s in data.validate_on if s.share is not None):
        sources = {k: parts_of(source, share, f"data.train.{k}.path")[0] for k, source in sources.items()}
    sizes = [len(sources[k]) if k in sources else None for k in range(len(data.train))]
    mixture = Mixture(sizes, [s.weight for s in data.train], config.seed)
    for k, s in enumerate(data.train):
        if s.online:
            from eflow.data.online import open_online  # imports the renderer

            first = mixture.first(k, start * data.batch, rank, world)
            seed = derived_seed(config.seed, f"rank {rank}") if rank else config.seed
            batch = data.batch // world
            # Each loader process has four batches in hand (dataset.batches), and one is collected.
            loaded = 4 * (data.workers + 1) * batch // s.uses
            source = open_online(s, seed, first=first, batch=batch, loaded=loaded)
            sources[k] = stack.enter_context(source)
    return mixture, [sources[k] for k in range(len(data.train))]


def check_sizes(dataset: FlowDataset, model: FlowModel, crop: tuple[int, int] | None) -> None:
    """Raise ConfigError, before anything is written, if the network cannot be trained on samples of this size."""
    # A crop has one size whatever the source; of rendered samples the first is made here all the same, so that a bad
    # recipe fails before anything is written.
    sources = [source for source in dataset.sources if crop is None or is_endless(source)]
    firsts = [source.first() if is_endless(source) else source[0] for source in sources]
    if crop is not None:
        sizes = {"data.crop": crop}
    else:
        sizes = {f"data.crop is not set, {s.name}": (s.height, s.width) for s in firsts}
    for where, size in sizes.items():
        if min(size) < model.least or any(side % model.divisor for side in size):
            raise ConfigError(
                "a size the network cannot train on",
                where=where,
                value=tuple(size),
                accepted=f"multiples of {model.divisor}, at least {model.least} px{_proposed(model, size)}",
            )


def _proposed(model: FlowModel, size: Sequence[int]) -> str:
    """Return the largest crop of samples of this (height, width) that the network takes, as an option to paste; empty:
    there is none."""
    height, width = (side // model.divisor * model.divisor for side in size)
    return f": --set data.crop=[{height},{width}]" if min(height, width) >= model.least else ""


def validation_sets(config: TrainConfig, model: FlowModel) -> list[tuple[str, FlowDataset, list[int]]]:
    """Return (name, set, indices of the samples to score) for every set of ``data.validate_on``."""
    sets = []
    folders = [s for s in config.data.train if s.path is not None]
    held = [(s, one.share) for one in config.data.validate_on for s in (folders if one.share else [one])]
    for title, (s, share) in zip(titles([s for s, _ in held]), held, strict=True):
        if s.path is None:
            from eflow.data.online import held as rendered

            source = rendered(s, config.data.validate_samples)
        else:
            source = open_source(s.path, s.format, dt=s.dt)
        if share is not None:
            source = parts_of(source, share, s.path or "")[1]
        dataset = FlowDataset([source], model.representation, empty=config.data.empty, reads=model.reads)
        sets.append((title, dataset, evenly(len(dataset), config.data.validate_samples)))
    return sets


def titles(sets: list[SourceConfig]) -> list[str]:
    """Return the name of every set in the log, each another: that of its folder or recipe; of equal ones with the
    folder above, and with a number where that is the same, too."""
    places = [Path(os.path.abspath(s.path or str(s.recipe))) for s in sets]
    ends = [f"_dt{s.dt}" if s.dt != 1 else "" for s in sets]
    names = [(p.name if p.is_dir() else p.stem) + end for p, end in zip(places, ends, strict=True)]
    longer = [f"{p.parent.name}/{n}" if names.count(n) > 1 else n for p, n in zip(places, names, strict=True)]
    return [name if longer.count(name) == 1 else f"{name}#{k}" for k, name in enumerate(longer, 1)]


def check_truth(dataset: FlowDataset, mixture: Mixture, validation: list[tuple[str, FlowDataset, list[int]]]) -> None:
    """Raise EventDataError or AssetError, before anything is written, if the first sample of a training set cannot be
    trained on, or no sample of a validation set be scored."""
    for k, endless in enumerate(mixture.endless):
        if not endless:
            dataset[Key(0, 0, k, 0)]
    for name, scored, indices in validation:
        samples = (sample for i in indices if (sample := scored[i]) is not None)
        if not any("flow" in s and (s["valid"] & s["mask"]).any() for s in samples):
            raise AssetError("no sample has events and a valid ground-truth pixel", where=f"data.validate_on: {name}")


@torch.no_grad()
def validate(
    model: FlowModel,
    ema: dict[str, Tensor] | None,
    validation: list[tuple[str, FlowDataset, list[int]]],
    precision: str,
    size: int = 1,
) -> dict[str, float]:
    """Return the AEE of each validation set with the averaged weights, and as ``zero`` that of zero flow.

    size : largest number of samples in a batch."""
    # Judged are the averaged weights; the training's own come back, whatever happens.
    own = {k: v.detach().clone() for k, v in model.state_dict().items()} if ema is not None else None
    if ema is not None:
        model.load_state_dict(ema)
    try:
        scores = {}
        for name, dataset, indices in validation:
            rows = []
            for batch in _alike(filter(None, (dataset[i] for i in indices)), size):
                flows = predict(model, batch, precision=precision).flow.permute(0, 2, 3, 1).cpu().numpy()
                truths, valids = batch["flow"].permute(0, 2, 3, 1).numpy(), (batch["valid"] & batch["mask"]).numpy()
                for flow, truth, valid in zip(flows, truths, valids, strict=True):
                    metrics, zero = frame_metrics(flow, truth, valid), frame_metrics(np.zeros_like(flow), truth, valid)
                    if metrics and zero:
                        rows.append((metrics["AEE"], zero["AEE"]))
            scores[f"{name}/AEE"], scores[f"{name}/zero"] = (
                (float(v) for v in np.mean(rows, axis=0)) if rows else (float("nan"),) * 2
            )
        return scores
    finally:
        if own is not None:
            model.load_state_dict(own)


def _alike(samples: Iterable[dict], size: int) -> Iterator[dict]:
    """Yield batches, in order, of up to ``size`` samples with the same height and width."""
    for _, group in itertools.groupby(samples, key=lambda sample: sample["new"].shape):
        while part := list(itertools.islice(group, size)):
            yield collate(part)
