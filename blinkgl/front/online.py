"""Sequences rendered during their use: samples for training, without files."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from blinkgl.config.problems import validate_field
from blinkgl.config.run import RunTemplate
from blinkgl.config.sequence import OutputConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.runs import load
from blinkgl.machine.closing import Closing
from blinkgl.machine.extras import install
from blinkgl.online.cuts import CUTS
from blinkgl.online.job import StreamJob, stream_seed
from blinkgl.online.samples import StreamSample, WindowSample
from blinkgl.online.stream import SampleStream, Share, StreamStats, share_of_process

if TYPE_CHECKING:
    from blinkgl.online.loader import Batches

MAX_WINDOW_MS = 60_000


class OnlineSequences(Closing):
    """Endless samples of a recipe, rendered by worker processes during their use; no file is kept.

        with OnlineSequences("recipe.yaml", window_ms=(5, 50), workers=2) as sequences:
            for sample in sequences:                 # the process that trains, or
                sample.new, sample.flow              # Events, (H, W, 2) float32 px
            for batch in DataLoader(sequences.batches(8, collate), batch_size=None, num_workers=2):
                ...                                  # torch: the same batches whatever num_workers

    source : a recipe's path, or the result of :func:`load` for one. Groups are drawn in proportion to their numbers of
        sequences. Each sequence is drawn anew, so a recipe without random values gives other windows of one scene.
    kind : "windows" gives :class:`WindowSample`, two adjacent windows and the flow over each; "streams" gives
        :class:`StreamSample`, ``steps`` successive windows and the flow over each.
    window_ms : (shortest, longest) or one length, drawn log-uniformly for each sample; default: the recipe's label
        interval.   steps : windows of a sample of kind "streams".
    per_sequence : samples from one sequence, mixed with those of seven others.
    min_events : fewest events in each window.   max_flow : longest median of a sample's flow, px.   min_density :
        fewest events per pixel of a window and px of its mean flow.   split : "train" or "test" groups.
    workers : rendering processes, each with an OpenGL context and one thread; 0: this process renders on request.
    seed : of everything.   rank, world : number of this process and of all processes in a distributed training: each
        renders every ``world``-th block of one stream. Together they have each sample once, the same ones whatever
        ``world``. Default: the values of `torchrun` (``RANK``, ``WORLD_SIZE``) or Ray Train; the workers then render on
        one of several graphics cards, that of ``LOCAL_RANK``. ``world=1``: the whole stream in every process.
    first : the sample to continue with; earlier samples are not rendered, except those mixed with it.

    Sample n is a function of (recipe, seed, rank, world, n) only: not of workers, readers or earlier samples. Every
    sample is given once. Two blocks (of ``block`` samples, from eight sequences) are rendered ahead, then rendering
    waits. Dead workers are replaced. Failed sequences are replaced by the next in a fixed order, and counted; when half
    fail, the next sample raises. Memory does not grow with the number of samples.

    stats : :class:`StreamStats`.   block : samples that are mixed with each other.   stream : the underlying
        :class:`~blinkgl.online.stream.SampleStream`.
    Raises ConfigError (a bad recipe, or bad arguments here; a recipe that gives no samples, at the sample), AssetError,
    GLError; EventDataError: a sample that was taken before, or after :meth:`close`."""

    @check.public()
    def __init__(
        self,
        source: str | RunTemplate,
        *,
        kind: str = "windows",
        window_ms: float | Sequence[float] | None = None,
        steps: int = 8,
        per_sequence: int = 8,
        min_events: int = 1,
        max_flow: float = 400.0,
        min_density: float = 0.0,
        split: str = "train",
        workers: int = 1,
        seed: int = 0,
        rank: int | None = None,
        world: int | None = None,
        first: int = 0,
    ):
        template = source if isinstance(source, RunTemplate) else load(source)
        seed = check.seed(seed)
        share = Share(rank or 0, 1 if world is None else world)
        if rank is None and world is None:
            share = share_of_process()
        world = check.whole(share.world, "world", 1, 1_000_000)
        rank = check.whole(share.rank, "rank", 0, world - 1)
        if kind not in CUTS:
            raise ConfigError("unknown kind", where="kind", value=kind, accepted=", ".join(CUTS))
        validate_field(OutputConfig, "split", split)
        job = StreamJob(
            out="",
            base="",
            recipe="",
            num=None,
            kind=kind,
            samples=check.whole(per_sequence, "per_sequence", 1, 1000),
            window_us=_window_us(window_ms),
            steps=check.whole(steps, "steps", 1, 10_000),
            min_events=check.whole(min_events, "min_events", 0, 1_000_000_000),
            max_flow=check.number(max_flow, "max_flow", above=0),
            min_density=check.number(min_density, "min_density", least=0),
            split=split,
            seed=seed,
            rank=rank,
            world=world,
        )
        self.first = check.whole(first, "first", 0, 2**62)
        template = RunTemplate({**template.tree, "seed": stream_seed(template.seed, seed)}, template.base)
        workers = check.whole(workers, "workers", 0, 1024)
        self.stream = SampleStream.of(template, job, workers=workers, first=self.first, card=share.local)

    @property
    def stats(self) -> StreamStats:
        return self.stream.stats

    @property
    def block(self) -> int:
        return self.stream.block

    def __getitem__(self, n: int) -> WindowSample | StreamSample:
        """Return sample n when it is ready; each sample is given once."""
        return self.stream.take(check.whole(n, "n", self.first, 2**62))

    def __iter__(self) -> Iterator[WindowSample | StreamSample]:
        """Iterate endlessly over samples from ``first`` on."""
        return (self.stream.take(n) for n in itertools.count(self.first))

    def batches(self, size: int, collate: Callable[[list], Any] = list, *, count: int | None = None) -> Batches:
        """Return a ``torch.utils.data.IterableDataset`` of batches: batch k is ``collate`` of the samples from first +
        k · size on. For ``DataLoader(…, batch_size=None, num_workers=N)``: ``collate`` runs in the loader's processes,
        and the batches and their order are the same whatever N.

        collate : list of samples -> input of a training step; a function of a module, so that loader processes find it.
        count : number of batches; None: endless.   Raises ConfigError: torch is not installed."""
        size = check.whole(size, "size", 1, 1_000_000)
        count = None if count is None else check.whole(count, "count", 0, 2**62)
        try:
            from blinkgl.online.loader import Batches
        except ImportError:
            raise ConfigError(
                "torch is not installed",
                where="batches",
                accepted=f"run {install('torch')}, or iterate without it",
            ) from None
        return Batches(self.stream, self.first, size, collate, count)

    def close(self) -> None:
        """End the workers and remove all their files."""
        self.stream.close()


def _window_us(length: float | Sequence[float] | None) -> tuple[int, int] | None:
    if length is None:
        return None
    ends = list(check.plain(length)) if isinstance(check.plain(length), list) else [length, length]
    if len(ends) != 2:
        raise ConfigError(
            "not lengths of windows", where="window_ms", value=length, accepted="a number of ms, or (shortest, longest)"
        )
    low, high = (check.number(end, "window_ms", least=0.001, most=MAX_WINDOW_MS) for end in ends)
    if low > high:
        raise ConfigError(
            "the shortest is longer than the longest", where="window_ms", value=length, accepted="(shortest, longest)"
        )
    return round(1000 * low), round(1000 * high)
