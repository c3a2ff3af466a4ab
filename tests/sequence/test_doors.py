"""A read-out, a refractory period and recorded frames through every door: files, arrays,
the loop itself, explain, trade."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import blinkgl
from blinkgl import EventChunk, Events, GroundTruth, Picture
from blinkgl.config.run import load_run
from blinkgl.dataset.generate import generate_run

BUS = {"events_per_second": 20_000, "row_ns": 300, "queue_events": 40}
DRAWN = {
    "camera": {"width": 48, "height": 36},
    "time": {"duration": 0.1, "label_rate": 30},
    "scene": {
        "kind": "random",
        "objects": {"count": 3, "distance": [2, 4]},
        "pool": {"primitives": ["cuboid"], "variants": 1},
        "textures": {"procedural": ["checks"], "variants": 2, "photographs": False, "max_size": 32},
    },
    "timeline": {"kind": "uniform", "fps": 170},
}
EVENTS = {"emulator": "esim", "contrast_threshold": 0.1, "refractory_us": 1500, "threshold_sigma": 0.03}
COMMON = {
    "seed": 6,
    "events": EVENTS,
    "readout": BUS,
    "preview": {"enabled": False},
    "labels": {"flow": ["forward"], "occlusion": False},
}
FRAMES, FPS = 8, 50


@pytest.fixture
def run(request, tmp_path):
    """A configuration that is drawn, or one of recorded frames with their flow."""
    tree = COMMON | (
        DRAWN
        if request.param == "drawn"
        else {"frames": {"folders": ["clip"], "fps": FPS, "max_px": 0.5, "interpolate": request.param}}
    )
    if request.param != "drawn":
        write_frames(tmp_path / "clip")
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump(tree))
    return load_run(path)


def write_frames(folder: Path) -> None:
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.random((80, 100)).astype(np.float32), (0, 0), 1.5)
    texture = (texture - texture.min()) / np.ptp(texture)
    for name in ("image_left", "flow"):
        (folder / name).mkdir(parents=True)
    for k in range(FRAMES):
        image = cv2.warpAffine(texture, np.float32([[1, 0, 1.5 * k - 30], [0, 1, -20]]), (48, 36))
        cv2.imwrite(str(folder / f"image_left/{k:03d}.png"), np.round(255 * image).astype(np.uint8))
        if k:
            np.save(folder / f"flow/{k:03d}.npy", np.full((36, 48, 2), (1.5, 0), np.float32))


def same(a: Events, b: Events) -> bool:
    return len(a) == len(b) > 100 and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in "xytp")


@pytest.mark.parametrize("run", ["drawn", "linear", "motion"], indirect=True)
def test_every_door_gives_the_same(run, tmp_path):
    (report,) = generate_run(run, tmp_path / "out")
    written = blinkgl.read_events(report.path / "events.h5")
    recording = blinkgl.record(run)
    sequence = blinkgl.simulate_sequence(run)
    items = list(sequence)
    assert same(Events.concatenate([item.events for item in items if isinstance(item, EventChunk)]), written)
    assert same(recording.events, written)
    assert sequence.camera.dropped == recording.lost > 50 and sequence.camera.late > 0
    assert recording.frames == report.frames == sequence.frames
    by_pixel = np.lexsort((written.t, written.x, written.y))
    gaps = np.diff(written.t[by_pixel])[
        (np.diff(written.x[by_pixel].astype(int)) == 0) & (np.diff(written.y[by_pixel].astype(int)) == 0)
    ]
    assert gaps.min() > 1500 - 1e6 * BUS["queue_events"] / BUS["events_per_second"] and len(gaps) > 100, (
        "the refractory period, as late as the bus may be"
    )
    truths = [item for item in items if isinstance(item, GroundTruth)]
    flows = [truth.frame.forward for truth in truths if truth.forward_ns is not None]
    assert len(flows) == report.labels == len(recording.flow)
    for k, flow in enumerate(flows):
        np.testing.assert_array_equal(flow.flow, recording.flow[k])
        saved, valid = blinkgl.read_flow(report.path / f"flow/forward/{k:06d}.png")
        assert np.array_equal(valid, flow.valid) and np.abs(saved - flow.flow)[valid].max() <= 1 / 256 + 1e-6
    for k in range(len(truths)):
        assert np.array_equal(
            cv2.imread(str(report.path / f"images/{k:06d}.png"))[..., ::-1].max(-1),
            np.atleast_3d(recording.images[k]).max(-1),
        )
    assert recording.image_t_us.tolist() == [truth.t_ns // 1000 for truth in truths]
    assert len(recording.window(0)) == np.count_nonzero(
        (written.t >= recording.t_us[0]) & (written.t < recording.t_us[1])
    )


@pytest.mark.parametrize("run", ["drawn", "linear"], indirect=True)
def test_pictures_come_after_the_events_until_then(run):
    items = list(blinkgl.simulate_sequence(run, pictures_hz=20, labels=[]))
    pictures = [k for k, item in enumerate(items) if isinstance(item, Picture)]
    assert len(pictures) > 2 and all(
        isinstance(items[k - 1], EventChunk) and items[k - 1].t_ns == items[k].t_ns for k in pictures
    )
    times = [items[k].t_ns / 1e9 for k in pictures]
    assert times[0] == 0 and np.diff(times).max() < 0.05 + 1 / 50 + 1e-9
    drawn = items[pictures[0]].flow is not None
    assert all(items[k].image.dtype == np.float32 and (items[k].flow is not None) == drawn for k in pictures[:-2])


def test_the_flow_of_a_picture_is_the_label_of_its_time():
    # Above all before a camera that turns: its velocity times the interval is another motion.
    turn = blinkgl.Keyframes({0: blinkgl.Pose((-3, 0, 1)), 0.2: blinkgl.Pose((-3, 0, 1), look_at=(-2, 0.6, 1.2))})
    scene = blinkgl.Scene(blinkgl.Camera(48, 32, pose=turn), [blinkgl.Primitive("cuboid")], duration=0.2)
    pictures = (one for one in blinkgl.simulate_sequence(scene, pictures_hz=10, labels=[]) if isinstance(one, Picture))
    drawn = {one.t_ns: one.flow for one in pictures}
    with blinkgl.Renderer(scene) as renderer:
        for t_ns in sorted(drawn)[:-1]:
            label = renderer.frame(t_ns * 1e-9, ["forward"])
            assert np.abs(label.forward.flow).max() > 4 or t_ns > 150_000_000
            np.testing.assert_array_equal(drawn[t_ns], np.nan_to_num(label.forward.flow))
