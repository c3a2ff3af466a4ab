"""BlinkFlow's folders (Li et al., IROS 2023), as its PyTorch loader reads them.

    training|test/<scene>/<sequence>/
      events_left/events.h5      events/{x,y} u2, p u1, t u8 µs from the sequence's start; ms_to_idx u8; gzip
      forward_flow/%06d.npy      f4 (H, W, 3) = u, v, visible at both ends: file i leads from i / fps to (i + 1) / fps
      backward_flow/%06d.npy     file i leads from (i + 1) / fps to i / fps
      config.yaml                duration, fps

Its loader begins with flow 1, because there have to be events before it: our label k is its flow k + 1.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blinkgl.config.reader import to_yaml
from blinkgl.io.flow import encode_flow_npy
from blinkgl.io.images import encode_npy
from blinkgl.layouts.layout import (
    BEFORE,
    Layout,
    Missing,
    append,
    forward_flow,
    growing,
    need,
    new_hdf5,
    sensor_pixels,
    write_bytes,
)
from blinkgl.layouts.source import Source


def _divided_second(source: Source) -> Missing | None:
    if not source.flow_times("forward"):
        return None
    interval = _interval_us(source)
    if interval % 1000 == 0 and 1_000_000 % interval == 0:
        return None
    rate = max(r for r in (1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 100) if r <= max(1, 1e6 / interval))
    expected = f"flow over whole ms that divide a second (labels come at {1e6 / interval:g} Hz)"
    return Missing(expected, f"time: {{label_rate: {rate}}}")


_events_before = need(
    *BEFORE, lambda source: not (t := source.flow_times("forward")) or t[0][0] == source.start_us + _interval_us(source)
)


class BlinkFlow(Layout):
    """BlinkFlow's layout. Its clock is in whole ms from the beginning of a sequence."""

    name = "blinkflow"
    about = "BlinkFlow's PyTorch loader, E-FlowFormer's training, eflow"
    size = (480, 640)
    needs = (forward_flow, _divided_second, _events_before, sensor_pixels)

    def folder(self, source: Source) -> str:
        scene, _, number = source.name.rpartition("_")
        split = "training" if source.split == "train" else source.split
        return f"{split}/{scene or source.name}/{number if scene else '000000'}"

    def write(self, source: Source, folder: Path) -> list[str]:
        _write_events(source, folder / "events_left/events.h5")
        times = source.flow_times("forward")
        checked = source.count("occlusion_forward") == len(times)
        for k in range(len(times)):
            flow, valid = source.flow("forward", k)
            if checked:  # their third channel is a forward-backward check; flow is valid everywhere
                valid = valid & ~source.value("occlusion_forward", k)
            write_bytes(
                folder / f"forward_flow/{k + 1:06d}.npy", encode_npy(np.dstack([flow, valid]).astype(np.float32))
            )
        for k in range(len(source.flow_times("backward"))):
            write_bytes(folder / f"backward_flow/{k:06d}.npy", encode_flow_npy(*source.flow("backward", k)))
        fps = 1_000_000 // _interval_us(source)
        about = {"duration": (len(times) + 1) / fps, "fps": fps}
        write_bytes(folder / "config.yaml", to_yaml(about).encode())
        return []


def _interval_us(source: Source) -> int:
    start, end = source.flow_times("forward")[0]
    return end - start


def _write_events(source: Source, path: Path) -> None:
    with new_hdf5(path) as file:
        columns = {
            name: growing(file, f"events/{name}", dtype)
            for name, dtype in (("x", np.uint16), ("y", np.uint16), ("t", np.uint64), ("p", np.uint8))
        }
        table, count, next_ms = growing(file, "ms_to_idx", np.uint64), 0, 0
        for events in source.events():
            t = events.t - source.start_us
            for name, column in columns.items():
                append(column, t if name == "t" else getattr(events, name))
            if len(t):
                # ms whose first event cannot come in a later chunk.
                settled = np.arange(next_ms, int(t[-1]) // 1000 + 1) * 1000
                append(table, count + np.searchsorted(t, settled, side="left"))
                count, next_ms = count + len(t), next_ms + len(settled)
        # One entry past the last ms, which published files lack: their loader then cuts the last window short.
        last_ms = -(-(source.end_us - source.start_us) // 1000)
        append(table, np.full(max(0, last_ms + 1 - next_ms), count))
