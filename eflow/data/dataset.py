"""From sources to batches: augmentation, grids, cropping, mixing. Every sample is a pure function of (seed, epoch,
position).

So checkpoints need not store any state of the data: step s of a run takes the same samples with the same augmentation,
whatever the number of workers and interruptions.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeGuard

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from blinkgl.errors import BlinkGLError, ConfigError, EventDataError
from blinkgl.types.recent import Recent
from eflow.config import AugmentConfig
from eflow.data.representation import Representation, grids_of
from eflow.data.sources import Source
from eflow.data.window import SIDES, RawSample
from eflow.types import Flow, Mask

if TYPE_CHECKING:
    from blinkgl.online.stream import StreamStats

ENDLESS = 4096
"""Number of samples of an endless source in an epoch."""
SPARSE = 0.5
MOST_TRIES = 1000
"""Samples in a row that may have no events, or no valid pixel."""
MAX_FLOW = 400.0
"""Ground truth of this length or more, px, is neither trained on nor scored (BlinkFlow's rule)."""


@dataclass(frozen=True)
class Key:
    """One draw: the source, the index of the sample in it, and the numbers that seed its augmentation."""

    epoch: int
    position: int
    source: int
    index: int


class Mixture:
    """The order of an endless training run over several sources.

    sizes : number of samples of each source. None: the source is endless
    (:class:`~eflow.data.online.OnlineSource`); its samples are used once, in order, and :data:`ENDLESS` of them count
    as an epoch.
    weights : relative share of each source in an epoch, at least one sample unless it is 0. An epoch has as many
    samples as all sources together. Every pass over a source has a new random order.
    """

    def __init__(self, sizes: list[int | None], weights: list[float], seed: int):
        counted = [ENDLESS if size is None else size for size in sizes]
        if not counted or min(counted) < 1 or len(counted) != len(weights) or min(weights) < 0 or sum(weights) <= 0:
            raise ValueError("sizes and weights")
        self.sizes, self.seed, self.epoch_length = counted, seed, sum(counted)
        self.endless = [size is None for size in sizes]
        share = np.array(weights, float) / sum(weights) * self.epoch_length
        counts = np.floor(share).astype(int)
        for i in np.argsort(counts - share, kind="stable")[: self.epoch_length - counts.sum()]:
            counts[i] += 1  # largest remainders: the counts add up to the total
        # The counts of all epochs are the same, so that a source whose share is below half a sample was never drawn.
        for i in np.flatnonzero((counts == 0) & (share > 0)):
            counts[counts.argmax()] -= 1
            counts[i] = 1
        self.counts = [int(c) for c in counts]
        self._epochs: Recent[int, list[Key]] = Recent(1)
        self._orders: Recent[tuple[int, int], list[int]] = Recent(1)

    def epoch(self, epoch: int) -> list[Key]:
        """Return the samples of one epoch, in order."""
        return self._epochs.of(epoch, lambda: self._drawn(epoch))

    def _drawn(self, epoch: int) -> list[Key]:
        picks = []
        for source, (size, count) in enumerate(zip(self.sizes, self.counts, strict=True)):
            for n in range(epoch * count, (epoch + 1) * count):  # n-th sample ever drawn from this source
                pass_, place = divmod(n, size)
                picks.append((source, n if self.endless[source] else self._order(source, pass_)[place]))
        # First numbers of spawn keys: 0 for the mixture, 1 for passes over a source, 2 for the augmentation of a draw.
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(0, epoch)))
        picks = [picks[i] for i in rng.permutation(len(picks))]
        # Endless sources give their samples in order, so their places in the mixture take them by number.
        for source in np.flatnonzero(self.endless):
            places = [i for i, (picked, _) in enumerate(picks) if picked == source]
            for i, n in zip(places, sorted(picks[i][1] for i in places), strict=True):
                picks[i] = (int(source), n)
        return [Key(epoch, position, *pick) for position, pick in enumerate(picks)]

    def first(self, source: int, n: int, rank: int = 0, world: int = 1) -> int:
        """Return the number of the next sample of an endless ``source`` after n samples of the run.

        Each of ``world`` processes takes every ``world``-th sample of the run, from ``rank`` on."""
        epoch, position = divmod(n, self.epoch_length)
        if world == 1:
            return epoch * self.counts[source] + sum(key.source == source for key in self.epoch(epoch)[:position])
        ends = [self.epoch_length] * epoch + [position]
        return sum(
            key.source == source and (e * self.epoch_length + i) % world == rank
            for e, end in enumerate(ends)
            for i, key in enumerate(self.epoch(e)[:end])
        )

    def key(self, n: int) -> Key:
        """Return the n-th sample of the run."""
        epoch, position = divmod(n, self.epoch_length)
        return self.epoch(epoch)[position]

    def _order(self, source: int, pass_: int) -> list[int]:
        """Return the order of the samples of a source in one pass over it."""
        rng = lambda: np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(1, source, pass_)))
        return self._orders.of((source, pass_), lambda: rng().permutation(self.sizes[source]).tolist())


class FlowDataset(Dataset):
    """Samples as tensors. ``dataset[key]`` for training (a :class:`Key`), ``dataset[i]`` for
    evaluation (no augmentation, no crop).

    A sample is a dict: old, new (C, H, W) float32; flow (2, H, W) float32 px, valid (H, W) bool (finite, |flow| < 400),
    mask (H, W) bool, name, scene. Without ground truth it has no flow, valid and mask.

    reads : windows to convert to tensors (:attr:`eflow.models.FlowModel.reads`).
    empty : "error" raises for a sample with an empty window among these. "skip" leaves out samples of which either
    window is empty, whichever are read, so that all networks are scored on the same ones: ``dataset[i]`` is None then,
    and training takes the next sample.

    Training takes the next sample for one without a valid pixel, too.
    """

    def __init__(
        self,
        sources: list[Source],
        representation: Representation,
        *,
        seed: int = 0,
        augment: AugmentConfig | None = None,
        crop: tuple[int, int] | None = None,
        leave_out: tuple[int, int] = (0, 0),
        empty: str = "error",
        reads: tuple[str, ...] = SIDES,
    ):
        self.sources, self.representation, self.seed = sources, representation, seed
        self.reads, self.augment, self.crop, self.empty = reads, augment, crop, empty
        self.leave_out = leave_out
        self._starts = np.cumsum([0, *(0 if is_endless(s) else len(s) for s in sources)])
        if augment is not None and augment.time_reversal > 0 and not all(s.has_backward for s in sources):
            raise ConfigError(
                "time reversal needs backward flow, which a training set lacks",
                where="data.augment.time_reversal",
                value=augment.time_reversal,
                accepted="0, or data generated with labels.flow: [forward, backward]",
            )

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, key: Key | int) -> dict | None:  # type: ignore[bad-override-param-name]
        if isinstance(key, Key):
            return self._drawn(key)
        # Endless sources are empty intervals here, which "right" steps over.
        source = int(np.searchsorted(self._starts, key, side="right")) - 1
        sample = self._with_events(self.sources[source][int(key - self._starts[source])])
        return None if sample is None else self._tensors(sample, None)

    def _drawn(self, key: Key) -> dict:
        """Return the sample of a draw, or the next one of its source that can be trained on."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(2, key.epoch, key.position)))
        source = self.sources[key.source]
        # The next sample of an endless source belongs to its next draw.
        tries = 1 if is_endless(source) else min(len(source), MOST_TRIES)
        name = ""
        for step in range(tries):
            sample = source[key.index if is_endless(source) else (key.index + step) % len(source)]
            if any(self.leave_out):
                sample = sample.without(*self.leave_out)
            name, sample = sample.name, self._with_events(sample)
            if sample is None:
                continue
            if sample.flow is None:
                raise EventDataError("no ground truth to train on", where=name, accepted="a labelled data set")
            if self.augment is not None:
                sample = augmented(sample, self.augment, rng)
            tensors = self._tensors(sample, rng)
            # Without one the loss would be 0, as if the network knew.
            if is_endless(source) or tensors["valid"].any():
                return tensors
        raise EventDataError(
            f"no events, or no valid pixel, in {tries} samples up to this one",
            where=name,
            accepted=f"labels with valid pixels of less than {MAX_FLOW:g} px",
        )

    def _with_events(self, sample: RawSample) -> RawSample | None:
        """Return the sample, or None if it is to be left out."""
        sides = SIDES if self.empty == "skip" else self.reads
        side = next((side for side in sides if not len(getattr(sample, side))), None)
        if side is None or self.empty == "skip":
            return sample if side is None else None
        window = getattr(sample, side)
        raise EventDataError(
            f"no events in the {side} window [{window.t0}, {window.t1}) µs",
            where=sample.name,
            accepted="use data.empty=skip to leave such samples out",
        )

    def _tensors(self, s: RawSample, rng: np.random.Generator | None) -> dict:
        grids = grids_of(self.representation, s, self.reads, (s.height, s.width))
        out = {k: torch.from_numpy(grid) for k, grid in grids.items()}
        if (truth := truth_of(s)) is not None:
            flow, valid, mask = truth
            out["flow"] = torch.from_numpy(np.ascontiguousarray(flow.transpose(2, 0, 1)))
            out["valid"], out["mask"] = torch.from_numpy(valid), torch.from_numpy(np.ascontiguousarray(mask))
        if rng is not None:
            if self.augment is not None and rng.random() < self.augment.scale_probability:
                out = scaled(out, float(np.exp2(rng.uniform(*self.augment.scale))), least=self.crop)
            if self.crop is not None:
                out = cropped(out, self.crop, rng, s.name)
        return {**out, "name": s.name, "scene": s.scene}


def truth_of(s: RawSample) -> tuple[Flow, Mask, Mask] | None:
    """Return the ground truth of a sample, where it is valid and shorter than :data:`MAX_FLOW`, and the pixels to
    evaluate; None: it has none. Raises EventDataError: a valid pixel is not finite."""
    if s.flow is None or s.valid is None:
        return None
    if not np.isfinite(s.flow[s.valid]).all():
        raise EventDataError("flow is NaN or infinite and marked valid", where=s.name)
    with np.errstate(over="ignore", invalid="ignore"):  # invalid pixels may have any value
        moves = np.square(s.flow[..., 0]) + np.square(s.flow[..., 1])  # torch would use all threads
    valid = s.valid & (moves < MAX_FLOW**2)
    return s.flow.astype(np.float32, copy=False), valid, np.ones_like(valid) if s.mask is None else s.mask


def evenly(of: int, count: int) -> list[int]:
    """Return ``count`` integers from 0 to ``of`` - 1 (at most all of them), evenly spaced, both ends included."""
    return [int(k) for k in np.linspace(0, of - 1, min(count, of)).round()]


class Endless(Source, Protocol):
    """A source whose samples can be taken once, in order (:class:`~eflow.data.online.OnlineSource`)."""

    stats: StreamStats

    def first(self) -> RawSample:
        """Return the next sample."""


def is_endless(source: Source) -> TypeGuard[Endless]:
    """Whether a source is endless."""
    return getattr(source, "endless", False)


def augmented(sample: RawSample, a: AugmentConfig, rng: np.random.Generator) -> RawSample:
    """Return a sample with the event-level augmentations, each applied with its own probability.

    All random numbers are always drawn, so that switching one augmentation off does not change the others."""
    u = rng.random(7)
    # A further child generator does not change the first ones.
    noise_rng, hot_rng, drop_rng, view_rng = rng.spawn(4)
    if u[0] < a.horizontal_flip:
        sample = sample.flip("x")
    if u[1] < a.vertical_flip:
        sample = sample.flip("y")
    if view_rng.random() < a.transpose:
        sample = sample.transpose()
    if u[2] < a.polarity:
        sample = sample.invert()
    if u[3] < a.time_reversal:
        sample = sample.reverse()
    if u[4] < a.drop_probability:
        sample = sample.drop(drop_rng.uniform(0, a.drop), drop_rng)
    if u[5] < a.hot_probability:
        sample = sample.hot_pixels(int(hot_rng.integers(1, a.hot_pixels + 1)), hot_rng.uniform(0, a.hot_rate), hot_rng)
    if u[6] < a.noise_probability:
        sample = sample.noise(noise_rng.uniform(0, a.noise_rate), noise_rng)
    return sample


def scaled(sample: dict, factor: float, least: tuple[int, int] | None = None) -> dict:
    """Return a sample scaled by ``factor``, but not below the size ``least`` = (H, W).

    Grids and flow are bilinear; flow is multiplied by the exact factor of each axis. A pixel is valid only if all four
    contributing pixels are. Of sparse truth (less than ``SPARSE`` is valid), of which hardly any pixel would be, each
    valid pixel moves to the one nearest to its new place."""
    height, width = sample["new"].shape[-2:]
    size = [max(round(height * factor), (least or (1, 1))[0]), max(round(width * factor), (least or (1, 1))[1])]
    resize = lambda a: torch.nn.functional.interpolate(a[None], size=size, mode="bilinear", align_corners=False)[0]
    out = {**sample, **{k: resize(sample[k]) for k in SIDES if k in sample}}
    if "flow" in sample:
        # Sizes are whole, so the factor of an axis is a little off the one that was drawn.
        ratio = torch.tensor([size[1] / width, size[0] / height])[:, None, None]
        if sample["valid"].float().mean() < SPARSE:
            resize = lambda a: _moved(a, sample["valid"], size)
        out["flow"] = resize(torch.where(sample["valid"], sample["flow"], 0)) * ratio
        for k in ("valid", "mask"):
            out[k] = resize(sample[k][None].float())[0] > 0.999
    return out


def _moved(a: Tensor, valid: Tensor, size: list[int]) -> Tensor:
    """Return an array (C, *size), 0 but where a valid pixel of ``a`` (C, H, W) moved to; of several the last one."""
    y, x = np.nonzero(valid.numpy())
    (height, width), out = valid.shape, np.zeros((len(a), *size), np.float32)
    # A pixel's centre is at + 0.5, before and after.
    out[:, ((y + 0.5) * size[0] / height).astype(int), ((x + 0.5) * size[1] / width).astype(int)] = a.numpy()[:, y, x]
    return torch.from_numpy(out)


def cropped(sample: dict, size: tuple[int, int], rng: np.random.Generator, name: str) -> dict:
    """Return a random crop (H, W) of a sample. Raises EventDataError: the sample is smaller."""
    height, width = sample["new"].shape[-2:]
    if height < size[0] or width < size[1]:
        raise EventDataError(
            "sample is smaller than the crop",
            where=f"data.crop, {name}",
            value=(height, width),
            accepted=f"at least {size}",
        )
    top, left = int(rng.integers(height - size[0] + 1)), int(rng.integers(width - size[1] + 1))
    return {
        k: v[..., top : top + size[0], left : left + size[1]].contiguous() if torch.is_tensor(v) else v
        for k, v in sample.items()
    }


class StepSampler(Sampler):
    """Yields batches of keys from training step ``start`` on, for one rank of ``world``.

    Step s takes samples s·B … (s+1)·B - 1 of the mixture, and rank r every world-th of them. Each rank renders its own
    endless sources and takes their samples in order."""

    def __init__(self, mixture: Mixture, batch: int, start: int, stop: int, rank: int = 0, world: int = 1):
        self.mixture, self.batch, self.start, self.stop, self.rank, self.world = (
            mixture,
            batch,
            start,
            stop,
            rank,
            world,
        )

    def __len__(self) -> int:
        return max(self.stop - self.start, 0)

    def __iter__(self) -> Iterator[list[Key]]:
        own = (self.rank, self.world)
        endless = [k for k, without_end in enumerate(self.mixture.endless) if without_end and self.world > 1]
        numbers = {k: itertools.count(self.mixture.first(k, self.start * self.batch, *own)) for k in endless}
        for step in range(self.start, self.stop):
            keys = [
                self.mixture.key(n) for n in range(step * self.batch + self.rank, (step + 1) * self.batch, self.world)
            ]
            yield [replace(key, index=next(numbers[key.source])) if key.source in numbers else key for key in keys]


def collate(samples: list[dict]) -> dict:
    """Return a batch: tensors are stacked, other values become lists. Raises EventDataError: sizes differ."""
    if len({tuple(s["new"].shape) for s in samples}) > 1:
        raise EventDataError(
            "samples of a batch differ in size",
            where="data.crop",
            value=[tuple(s["new"].shape[-2:]) for s in samples],
            accepted="a crop that fits all training sets",
        )
    return {
        k: torch.stack([s[k] for s in samples]) if torch.is_tensor(samples[0][k]) else [s[k] for s in samples]
        for k in samples[0]
    }


class _Carrying(Dataset):
    """A data set that returns errors as values, since torch reports an error of a loader process as pages of
    traceback."""

    def __init__(self, dataset: FlowDataset):
        self.dataset = dataset

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, key: Key | int) -> dict | BlinkGLError | None:  # type: ignore[bad-override-param-name]
        try:
            return self.dataset[key]
        except BlinkGLError as error:
            return error


def _collate_or_carry(samples: list) -> dict | BlinkGLError:
    try:
        return next((s for s in samples if isinstance(s, BlinkGLError)), None) or collate(samples)
    except BlinkGLError as error:
        return error


def batches(dataset: FlowDataset, sampler: StepSampler, workers: int, pin: bool = False) -> Iterator[dict]:
    """Yield batches in the order of the sampler, the same for any number of workers. Raises what ``dataset`` and
    :func:`collate` raise."""
    loader = DataLoader(
        _Carrying(dataset),
        batch_sampler=sampler,
        num_workers=workers,
        collate_fn=_collate_or_carry,
        pin_memory=pin,
        persistent_workers=workers > 0,
        prefetch_factor=4 if workers else None,
        generator=torch.Generator(),  # otherwise it would draw from torch's global generator
        multiprocessing_context="forkserver" if workers else None,
    )
    try:
        for batch in loader:
            if isinstance(batch, BlinkGLError):
                raise batch
            yield batch
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise ConfigError(
            "a loader process ended: it ran out of memory, or it ran a script that trains without a guard",
            where="data.workers",
            value=workers,
            accepted="0, or the script's call of train() below `if __name__ == '__main__':`",
        ) from None
