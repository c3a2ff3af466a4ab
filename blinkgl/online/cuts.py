"""Cutting useful samples out of a sequence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import cast

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.labels.values import Flow
from blinkgl.online.job import StreamJob
from blinkgl.online.samples import StreamSample, WindowSample
from blinkgl.sequence import SensorSimulation
from blinkgl.types.events import Events

_LEAST_PX = 0.3  # shorter flow counts as this long for the density
_CANDIDATES = 6  # candidate positions for each requested sample

Sample = WindowSample | StreamSample
Cut = Callable[[SensorSimulation, StreamJob, str, int, np.random.Generator], Iterator[Sample]]
"""(sequence, job, name of the sequence, number of wanted samples, random generator) -> samples, perhaps more."""


def windows(
    sequence: SensorSimulation, job: StreamJob, name: str, wanted: int, dice: np.random.Generator
) -> Iterator[WindowSample]:
    """Yield pairs of windows at random times and of random lengths."""
    events = sequence.gather()
    for start, span in _places(sequence, job, 2, wanted, dice):
        t = start + span
        old, new = events.window(start, t), events.window(t, t + span)
        if min(len(old), len(new)) < job.min_events:
            continue
        truth = sequence.truth(t * 1000, span * 1000).frame
        forward, backward = cast(Flow, truth.forward), truth.backward
        if not _moves_as_asked(job, forward.flow[forward.valid], forward.valid.size, [new]):
            continue
        yield WindowSample(
            old=old,
            new=new,
            t_us=t,
            span_us=span,
            flow=forward.flow,
            valid=forward.valid,
            backward=None if backward is None else backward.flow,
            backward_valid=None if backward is None else backward.valid,
            name=f"{name}/{t}us+{span}us",
        )


def streams(
    sequence: SensorSimulation, job: StreamJob, name: str, wanted: int, dice: np.random.Generator
) -> Iterator[StreamSample]:
    """Yield runs of ``job.steps`` consecutive windows."""
    events = sequence.gather()
    for start, span in _places(sequence, job, job.steps, wanted, dice):
        # steps windows have steps + 1 edges; the flow of each leads from its first edge to its last.
        edges = start + span * np.arange(job.steps + 1, dtype=np.int64)
        parts = [events.window(int(a), int(b)) for a, b in pairwise(edges)]
        if min(len(part) for part in parts) < job.min_events:
            continue
        frames = [sequence.truth(int(t) * 1000, span * 1000).frame.forward for t in edges[:-1]]
        flow, valid = (np.stack([getattr(frame, key) for frame in frames]) for key in ("flow", "valid"))
        if not _moves_as_asked(job, flow[valid], valid[0].size, parts):
            continue
        yield StreamSample(tuple(parts), edges, flow, valid, f"{name}/{start}us+{job.steps}x{span}us")


CUTS: dict[str, Cut] = {"windows": windows, "streams": streams}


def _moves_as_asked(job: StreamJob, flow: np.ndarray, pixels: int, parts: list[Events]) -> bool:
    """Return whether there is flow, not too long, and with enough events per px."""
    # Every seventh pixel suffices for a median.
    lengths = np.hypot(*flow[::7].T)
    if not len(lengths) or np.median(lengths) > job.max_flow:
        return False
    events = sum(len(part) for part in parts)
    return events >= job.min_density * len(parts) * pixels * max(float(lengths.mean()), _LEAST_PX)


def _places(
    sequence: SensorSimulation, job: StreamJob, steps: int, wanted: int, dice: np.random.Generator
) -> list[tuple[int, int]]:
    drawn = drawn_spans(
        dice,
        -(-sequence.t0_ns // 1000),
        sequence.t1_ns // 1000,
        _CANDIDATES * wanted,
        job.window_us or (sequence.config.time.interval_ns // 1000,) * 2,
        steps,
    )
    return list(dict.fromkeys(drawn))  # a short sequence has few positions, and no sample may occur twice


def drawn_spans(
    rng: np.random.Generator, t0_us: int, t1_us: int, count: int, window_us: tuple[int, int], steps: int = 2
) -> list[tuple[int, int]]:
    """Return ``count`` starts and lengths (t, span), µs, with [t, t + steps · span) inside [t0, t1]: lengths
    log-uniform in ``window_us``, as far as the sequence is long enough, positions uniform.

    Raises ConfigError: a sequence that is shorter than ``steps`` of the shortest."""
    longest = min(window_us[1], (t1_us - t0_us) // steps)
    if longest < window_us[0]:
        raise ConfigError(
            f"a sequence of {(t1_us - t0_us) / 1000:g} ms holds no {'two' if steps == 2 else steps} windows of "
            f"{window_us[0] / 1000:g} ms",
            where="time.duration",
            accepted="a longer one, or shorter window_ms",
        )
    # Log-uniform: as many between 5 and 10 ms as between 50 and 100.
    spans = np.rint(np.exp(rng.uniform(np.log(window_us[0]), np.log(longest), count))).astype(np.int64)
    spans = np.clip(spans, window_us[0], longest)
    # + 1, as the latest start is among those that are drawn.
    times = t0_us + np.floor(rng.random(count) * (t1_us - t0_us - steps * spans + 1)).astype(np.int64)
    return [(int(t), int(span)) for t, span in zip(times, spans, strict=True)]
