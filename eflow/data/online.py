"""Samples rendered during training: a :class:`blinkgl.online.stream.SampleStream` as a source.

with open_online(SourceConfig(recipe="configs/eflow/real_data.yaml", online=True, workers=2), seed=0) as source:
    sample = source[0]              # waits until it is rendered
"""

from __future__ import annotations

from blinkgl.config.base import placed
from blinkgl.config.run import load_run
from blinkgl.machine.closing import Closing
from blinkgl.online.job import MIX, StreamJob, stream_seed
from blinkgl.online.stream import SampleStream
from eflow.config import SourceConfig
from eflow.data.sources import Part
from eflow.data.window import RawSample, raw_sample

LEAST_APART = 512
"""Rendered samples between two uses of one, at least."""


class OnlineSource(Closing):
    """An endless :class:`~eflow.data.sources.Source`. ``source[n]`` returns sample n once, in a loader process, too;
    :meth:`first` does not consume it.

    uses, apart : where a rendered sample is used several times, each one that is new is followed by those that are
    ``apart``, 2 · ``apart`` … older; at the beginning, where there are none yet, by any. It is kept for ``apart`` more
    than its last use, since loader processes do not take samples in order.
    stats : :class:`blinkgl.online.StreamStats`."""

    endless = True

    def __init__(self, stream: SampleStream, uses: int = 1, apart: int = LEAST_APART):
        self._uses, self._apart = uses, apart
        self.stream, self.stats, self.has_backward = stream, stream.stats, stream.has_backward

    def __len__(self) -> int:
        raise TypeError("an online source is endless")

    def __getitem__(self, index: int) -> RawSample:
        if self._uses == 1:
            return raw_sample(self.stream.take(index))
        newest, age = divmod(index, self._uses)
        if age == 0 and (gone := newest - self._uses * self._apart) >= self.stream.first:
            self.stream.drop(gone)
        wanted = newest - age * self._apart
        return raw_sample(self.stream.peek(wanted if wanted >= 0 else wanted % (newest + 1)))

    def first(self) -> RawSample:
        """Return the first sample of a training without consuming it."""
        return raw_sample(self.stream.peek(self.stream.first))

    def close(self) -> None:
        self.stream.close()


def open_online(
    s: SourceConfig, seed: int, *, split: str = "train", first: int = 0, batch: int = 1, loaded: int = 0
) -> OnlineSource:
    """Open the source of ``{recipe: FILE, online: true, …}`` in an eflow configuration.

    first : the first sample to take.   batch : samples taken together.   loaded : samples that loader processes may
    take before their turn.
    Raises BlinkGLError: the recipe is bad, or cannot be rendered here."""
    recipe = str(s.recipe)
    template = load_run(recipe, s.set)
    # The seed of the training joins the recipe's own, which must be read first.
    template = load_run(recipe, s.set, seed=stream_seed(template.seed, seed))
    job = StreamJob(
        "",
        "",
        "",
        samples=s.samples,
        window_us=None if s.window_ms is None else (round(1000 * s.window_ms[0]), round(1000 * s.window_ms[1])),
        min_events=s.min_events,
        max_flow=s.max_flow,
        min_density=s.min_density,
        split=split,
        seed=seed,
    )
    apart = max(LEAST_APART, loaded)
    kept = s.uses * apart if s.uses > 1 else 0
    # With `uses` the buffer of the last samples is filled anew after a resume: it begins so much earlier.
    first, ahead = max(0, first // s.uses - kept), 1 + (batch + kept) // (MIX * s.samples)
    with placed(lambda where: f"{recipe}: {where}" if where else recipe):
        stream = SampleStream.of(template, job, workers=s.workers, first=first, ahead=ahead)
        return OnlineSource(stream, s.uses, apart)


def held(s: SourceConfig, count: int) -> Part:
    """Render ``count`` samples of a recipe's test groups into memory, each another whatever its ``uses`` say. Raises as
    :func:`open_online`."""
    with open_online(s.model_copy(update={"uses": 1}), 0, split="test") as source:
        samples = [source[n] for n in range(count)]
    return Part(samples, range(count), all(sample.backward is not None for sample in samples))
