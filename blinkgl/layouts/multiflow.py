"""MultiFlow's samples (Gehrig, Muglikar, Scaramuzza: Dense Continuous-Time Optical Flow from Event Cameras, T-PAMI
2024), as bflow's loader reads them.

    train|val/<sequence>_<label>/
      events/events.h5           x, y u2, p u1, t i8 µs on the sample's clock, 0 to 1 s; gzip
      flow/%07d.h5               flow (H, W, 2) f4 px from 0400000 to that µs: multiples of 10 ms, the last one 0900000
      images/0400000.png         and 0900000.png

A sample is a second around one label: its clock is 400 ms when the label is. There is no mask; where nothing is seen
the flow is 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blinkgl.layouts.layout import (
    GZIP,
    Layout,
    append,
    growing,
    images,
    keep,
    need,
    new_hdf5,
    sensor_pixels,
    write_bytes,
)
from blinkgl.layouts.source import Source

LABEL_US, TARGET_US, END_US, STEP_US = 400_000, 900_000, 1_000_000, 10_000


_flow_over_half_a_second = need(
    "flow to several times, the last one 0.5 s after the label",
    "labels: {flow: [0.1, 0.2, 0.3, 0.4, 0.5]}",
    lambda source: any(_leads(source, k) for k in range(len(source.interval_times))),
)
_samples = need(
    "a label with 0.4 s before it, 0.6 s after it, and images at it and 0.5 s later",
    "time: {duration: 1, label_rate: 2}",
    lambda source: _flow_over_half_a_second(source) or not source.image_times or labels_of(source),
)


class MultiFlow(Layout):
    """Flow to many times, in samples of a second."""

    name = "multiflow"
    about = "bflow's MultiFlow loader (flow at many times after one; folders train and val)"
    size = (384, 512)
    filled = ("train", "val")
    needs = (_flow_over_half_a_second, images, _samples, sensor_pixels)

    def folder(self, source: Source) -> str:
        return "train" if source.split == "train" else "val"

    def write(self, source: Source, folder: Path) -> list[str]:
        unseen = []
        for k in labels_of(source):
            t = source.interval_times[k]
            sample = folder / f"{source.name}_{k:06d}"
            _write_events(source, t, sample / "events/events.h5")
            for clock_us in (LABEL_US, TARGET_US):
                at = source.image_times.index(t + clock_us - LABEL_US)
                write_bytes(sample / f"images/{clock_us:07d}.png", source.copied("images", at))
            flows = source.flows(k)
            for clock_us, one, valid in zip(_clock_us(flows.interval_ns), flows.flow, flows.valid):
                if clock_us is not None:
                    _write_flow(one, sample / f"flow/{clock_us:07d}.h5")
                    unseen.append(1 - valid.mean())
        share = float(np.mean(unseen))
        return [f"{source.name}: {share:.1%} of its flow is 0 where nothing is seen: there is no mask"] if share else []


def labels_of(source: Source) -> list[int]:
    """Return the numbers of the labels that samples are made of."""
    there = set(source.image_times)
    return [
        k
        for k, t in enumerate(source.interval_times)
        if t - LABEL_US >= source.start_us
        and t - LABEL_US + END_US <= source.end_us
        and {t, t + TARGET_US - LABEL_US} <= there
        and _leads(source, k)
    ]


def _leads(source: Source, k: int) -> bool:
    """Return whether label ``k`` leads to the end of a sample."""
    return TARGET_US in _clock_us(source.interval_ns(k))


def _clock_us(interval_ns: np.ndarray) -> list[int | None]:
    """Return their ends on a sample's clock; None: not in a sample, or not at a multiple of its step."""
    ends = [(int(ns) / 1000, round(int(ns) / 1000 / STEP_US) * STEP_US) for ns in interval_ns]
    fits = [abs(us - step) <= 1 and 0 < step <= TARGET_US - LABEL_US for us, step in ends]
    return [LABEL_US + step if fit else None for (_, step), fit in zip(ends, fits)]


def _write_flow(flow: np.ndarray, path: Path) -> None:
    with new_hdf5(path) as file:
        keep(file, "flow", flow.astype(np.float32), **GZIP)


def _write_events(source: Source, label_us: int, path: Path) -> None:
    start = label_us - LABEL_US
    with new_hdf5(path) as file:
        columns = {
            name: growing(file, name, dtype)
            for name, dtype in (("x", np.uint16), ("y", np.uint16), ("p", np.uint8), ("t", np.int64))
        }
        for events in source.events():
            part = events.window(start, start + END_US)
            for name, column in columns.items():
                append(column, part.t - start if name == "t" else getattr(part, name))
