"""Whole sequences where duration, clock, image and speed are extreme, and how what is beyond is refused."""

from __future__ import annotations

from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  (registers the Blosc filter for h5py)
import numpy as np
import pytest

from blinkgl.config.run import RunTemplate
from blinkgl.dataset.generate import generate_sequence
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.sequence_files.sequence_dir import verify_sequence

BOX = {
    "kind": "explicit",
    "meshes": {"box": {"primitive": "cuboid"}},
    "materials": {"paint": {"procedural": "checks", "max_size": 64}},
    "objects": [{"mesh": "box", "material": "paint", "position": [3.0, 0.2, 0.1]}],
    "camera": {"position": [0.0, 0.0, 0.0]},
}


def moving(seconds: float, distance: float, start: float = 0.0) -> dict:
    keys = [
        {"time": start, "position": [3.0, -distance / 2, 0.0]},
        {"time": start + seconds, "position": [3.0, distance / 2, 0.0]},
    ]
    return {**BOX, "objects": [{"mesh": "box", "material": "paint", "keyframes": keys, "interpolation": "linear"}]}


def generate(gl, out: Path, **tree):
    defaults = {
        "camera": {"width": 32, "height": 24},
        "scene": BOX,
        "preview": {"enabled": False},
        "timeline": {"kind": "uniform", "fps": 20},
        "labels": {"flow": ["forward", "backward"], "float_flow": ["npy"], "depth": True},
    }
    config = RunTemplate({**defaults, **tree}, Path(".")).sequence(0)
    report = generate_sequence(config, 0, out, gl)
    assert verify_sequence(report.path) == []
    return report


def events_of(path: Path) -> tuple[np.ndarray, int, h5py.Dataset]:
    with h5py.File(path / "events.h5") as file:
        return (
            file["events/t"][:].astype(np.int64) + int(file["t_offset"][()]),
            int(file["t_offset"][()]),
            file["ms_to_idx"].shape[0],
        )


def test_the_longest_still_sequence(gl, tmp_path, promise):
    """An hour and one label interval, from 10^6 s on, in frames of at most 15 minutes: what an event file can hold."""
    hour = {"duration": 3600, "label_rate": 1 / 600, "start": 1_000_000}
    report = generate(gl, tmp_path, time=hour, timeline={"kind": "displacement", "max_step_us": 9e8})
    assert report.labels == 6 and report.frames == 6  # 4200 s in steps of 900 s
    promise("a still hour as a sequence: events", report.events, 0)
    flow = np.stack([np.load(f) for f in sorted((report.path / "flow/forward_npy").iterdir())])
    assert flow.shape[0] == 6 and flow[..., 2].any()
    promise("a still hour as a sequence: flow", np.abs(flow[..., :2]).max(), 0.0, "px")
    _, offset, milliseconds = events_of(report.path)
    assert offset == 10**12 and milliseconds == 4_200_000 + 1  # covers the eventless tail, to the last millisecond


def test_longer_than_the_event_format_can_hold(gl, tmp_path):
    """DSEC's u4 of microseconds ends after 71.6 minutes: known when the configuration is read."""
    with pytest.raises(ConfigError, match=r"time.duration: .* 10800 s are more than the 4295.0 s \(71.6 minutes\)"):
        generate(
            gl,
            tmp_path,
            time={"duration": 7200, "label_rate": 1 / 3600},
            scene=moving(10_800, 1.0),
            timeline={"kind": "uniform", "fps": 0.01},
        )
    assert not any(tmp_path.rglob("*.h5"))


def test_a_start_at_a_million_seconds_shifts_the_clock_and_nothing_else(gl, tmp_path, promise):
    runs = [
        generate(
            gl,
            tmp_path / str(start),
            time={"duration": 0.2, "label_rate": 10, "start": start},
            scene=moving(0.5, 2.0, start),
            timeline={"kind": "displacement"},
        )
        for start in (0, 1_000_000)
    ]
    (a, _, _), (b, offset, _) = (events_of(run.path) for run in runs)
    assert offset == 10**12 and len(a) == len(b) > 300
    promise("a run from 1e6 s on: shift of any event time, less 1e6 s", np.abs(b - a - 10**12).max(), 0, "us")
    for k in range(2):
        np.testing.assert_array_equal(*(np.load(run.path / f"flow/forward_npy/{k:06d}.npy") for run in runs))


@pytest.mark.parametrize(
    "camera",
    [
        {"width": 1, "height": 1},
        {"width": 1, "height": 30},
        {"width": 30, "height": 1},
        {"width": 24, "height": 16, "fov": 170},
        {"width": 24, "height": 16, "fov": 1},
    ],
)
def test_images_and_lenses(gl, tmp_path, camera):
    report = generate(
        gl,
        tmp_path,
        camera=camera,
        time={"duration": 0.2, "label_rate": 10},
        scene=moving(0.4, 2.0),
        timeline={"kind": "displacement"},
        preview={"enabled": True},
        render={"antialiasing": "ssaa4"},
    )
    assert report.labels == 2 and (report.path / "preview.mp4").stat().st_size > 500


@pytest.mark.parametrize(
    "change, message",
    [
        ({"camera": {"near": 0.0}}, "camera.near"),
        ({"camera": {"near": 1e-40}}, "camera.near"),
        ({"camera": {"fov": 180}}, "camera.fov"),
        ({"camera": {"focal": 1e12}}, "camera.focal"),
        ({"camera": {"width": 0}}, "camera.width"),
        ({"time": {"duration": 1e9}}, "time.duration"),
        ({"time": {"start": 1e300}}, "time.start"),
        ({"events": {"emulator": "esim", "contrast_threshold": 1e-4}}, "events.contrast_threshold"),
        ({"timeline": {"kind": "uniform", "fps": 1e12}}, "timeline.fps"),
        ({"scene": {**BOX, "camera": {"position": [1e300, 0, 0]}}}, "scene.camera.position"),
        ({"scene": {**BOX, "light": {"sun": 1e39}}}, "scene.light.sun"),
        ({"scene": {**BOX, "background": 1e39}}, "scene.background"),
        ({"scene": {**BOX, "objects": [{"mesh": "box", "scale": 1e300}]}}, "scene.objects.0.scale"),
        ({"camera": {"near": 5.0, "fov": 179}, "scene": {"kind": "random"}}, "scene.region.height"),
    ],
)
def test_beyond_the_ranges_there_is_a_message(gl, tmp_path, change, message):
    with pytest.raises(ConfigError, match=message.replace(".", "\\.")) as caught:
        generate(gl, tmp_path, **change)
    assert "\n" not in str(caught.value) and not any(tmp_path.iterdir())


def test_light_beyond_the_emulators_is_refused_where_it_is_seen(gl, tmp_path):
    bright = {**BOX, "materials": {"paint": {"color": [1e6, 1e6, 1e6]}}, "light": {"sky": 1e6}}
    with pytest.raises(
        BlinkGLError,
        match="frame 0 at 0 s: intensity at pixel .* it shows object .* a finite value from 0 to 1.07e\\+09",
    ):
        generate(gl, tmp_path, scene=bright)
    assert not any(tmp_path.rglob("*.h5"))


def test_frames_further_apart_than_17_minutes_are_refused(gl, tmp_path):
    with pytest.raises(ConfigError, match=r"timeline.fps: .* expected a number from 0.001"):
        generate(
            gl, tmp_path, time={"duration": 2400, "label_rate": 1 / 1200}, timeline={"kind": "uniform", "fps": 1 / 1200}
        )
    assert not any(tmp_path.rglob("*.h5"))
