"""Tiny data sets in each layout, fabricated: a random texture of event pixels that moves with
a known constant velocity."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from blinkgl.io.dsec import DsecEventWriter, identity_rectify_map, write_rectify_map
from blinkgl.io.flow import write_flow_png
from blinkgl.labels import Flow
from blinkgl.sequence_files.sequence_dir import SequenceWriter
from blinkgl.types.events import Events

SPAN = 100_000


def moving_events(
    height: int, width: int, t0: int, t1: int, velocity=(40.0, -20.0), n: int = 4000, seed: int = 0
) -> Events:
    """Events of [t0, t1): points of a fixed texture carried along at ``velocity`` px/s, wrapped round the sensor."""
    rng = np.random.default_rng(seed)
    points, polarity = rng.random((300, 2)) * (width, height), rng.integers(0, 2, 300)
    t = np.sort(rng.integers(t0, t1, n))
    which = rng.integers(0, 300, n)
    at = (points[which] + t[:, None] * 1e-6 * np.asarray(velocity)) % (width, height)
    return Events(at[:, 0].astype(np.uint16), at[:, 1].astype(np.uint16), t, polarity[which].astype(np.uint8))


def constant_flow(height: int, width: int, velocity=(40.0, -20.0), sign: int = 1) -> np.ndarray:
    return np.broadcast_to(np.float32(velocity) * np.float32(sign * SPAN * 1e-6), (height, width, 2)).copy()


def blinkgl_set(
    root: Path,
    sequences: int = 2,
    labels: int = 3,
    height: int = 128,
    width: int = 144,
    backward: bool = True,
    events: int = 4000,
) -> Path:
    """BlinkGL sequences as the generator writes them: one interval of pre-roll, then ``labels`` labels."""
    for s in range(sequences):
        velocity = (40.0 + 10 * s, -20.0)
        with SequenceWriter(root / "train" / f"seq_{s:06d}", height, width, config_yaml="seed: 0\n") as writer:
            writer.append_events(
                moving_events(height, width, 0, SPAN * (labels + 1), velocity, events * (labels + 1), s)
            )
            for k in range(labels):
                t = SPAN * (k + 1)
                valid = np.ones((height, width), bool)
                valid[:4] = False
                writer.label("flow_forward", k, Flow(constant_flow(height, width, velocity), valid), t, t + SPAN)
                if backward:
                    writer.label(
                        "flow_backward", k, Flow(constant_flow(height, width, velocity, -1), valid), t, t - SPAN
                    )
            writer.t_end_us = SPAN * (labels + 1)
    return root


def dsec_set(
    root: Path,
    sequences: tuple[str, ...] = ("thun_00_a",),
    labels: int = 2,
    test: bool = False,
    offset: int = 49_000_000_000,
) -> Path:
    """DSEC: 480x640, ``t_offset`` beyond 32 bits, flow every other image, or the test split's CSV."""
    height, width = 480, 640
    for s, name in enumerate(sequences):
        events = root / name / "events" / "left"
        events.mkdir(parents=True)
        e = moving_events(height, width, offset, offset + SPAN * (labels + 1), n=6000, seed=s)
        with DsecEventWriter(events / "events.h5", height, width, offset) as writer:
            writer.append(e)
        write_rectify_map(events / "rectify_map.h5", identity_rectify_map(height, width) + np.float32(0.25))
        times = [(offset + SPAN * (k + 1), offset + SPAN * (k + 2)) for k in range(labels)]
        if test:
            lines = [f"{a}, {b}, {2 * k + 2}" for k, (a, b) in enumerate(times)]
            (root / name / "test_forward_flow_timestamps.csv").write_text(
                "# from_timestamp_us, to_timestamp_us, file_index\n" + "\n".join(lines) + "\n"
            )
            continue
        flow = root / name / "flow"
        (flow / "forward").mkdir(parents=True)
        (flow / "forward_timestamps.txt").write_text(
            "# from_timestamp_us, to_timestamp_us\n" + "".join(f"{a}, {b}\n" for a, b in times)
        )
        for k in range(labels):
            write_flow_png(
                flow / "forward" / f"{2 * k + 2:06d}.png", constant_flow(height, width), np.ones((height, width), bool)
            )
    return root


def blinkflow_set(root: Path, labels: int = 3, height: int = 480, width: int = 640) -> Path:
    """BlinkFlow as published: gzip, u8 times, no t_offset, no entry for the last millisecond in ms_to_idx."""
    folder = root / "test" / "scene_a" / "seq_0"
    (folder / "events_left").mkdir(parents=True)
    (folder / "forward_flow").mkdir()
    e = moving_events(height, width, 0, SPAN * labels, n=6000)
    with h5py.File(folder / "events_left" / "events.h5", "w") as file:
        for k, dtype in (("x", "u2"), ("y", "u2"), ("t", "u8"), ("p", "u1")):
            file.create_dataset(f"events/{k}", data=getattr(e, k).astype(dtype), compression="gzip")
        last_ms = int(e.t[-1]) // 1000
        file["ms_to_idx"] = np.searchsorted(e.t, np.arange(last_ms) * 1000).astype(np.uint64)
    for k in range(labels):
        np.save(
            folder / "forward_flow" / f"{k:06d}.npy",
            np.dstack([constant_flow(height, width), np.ones((height, width), np.float32)]),
        )
    (folder / "config.yaml").write_text("duration: 0.3\nfps: 10\n")
    return root


def mvsec_set(root: Path, name: str = "indoor_flying1", images: int = 12, compressed: bool = False) -> Path:
    """MVSEC: images at 31 Hz, flow at 20 Hz, one px of flow per interval of flow everywhere
    but a zero (invalid) corner."""
    root.mkdir(parents=True, exist_ok=True)
    t0, height, width = 1.5e9, 260, 346
    stamps = t0 + np.arange(images) / 31
    e = moving_events(height, width, 0, int(images / 31 * 1e6), n=20000)
    table = np.stack([e.x, e.y, t0 + e.t * 1e-6, np.where(e.p, 1, -1)], 1).astype(np.float64)
    with h5py.File(root / f"{name}_data.hdf5", "w") as file:
        file["davis/left/events"] = table
        file["davis/left/image_raw_ts"] = stamps
        file["davis/left/image_raw_event_inds"] = np.searchsorted(table[:, 2], stamps)
    flow_t = t0 + np.arange(7) / 20
    flow = np.ones((7, height, width))
    flow[:, :20, :20] = 0
    save = np.savez_compressed if compressed else np.savez
    save(root / f"{name}_gt_flow_dist.npz", timestamps=flow_t, x_flow_dist=flow, y_flow_dist=-0.5 * flow)
    return root
