"""`blinkgl export --layout intervals`, read as the published loaders do: TimeLens' HybridStorage (rpg_timelens,
common/event.py and image_sequence.py), EVREAL's converter of BS-ERGB, and EvTexture's Hdf5Backend
with the voxel grids of its DataPreparation.md. No reader here imports blinkgl."""

import itertools

import cv2
import h5py
import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.layouts import LAYOUTS, Source, export_layout
from blinkgl.layouts.export import refuse_plan
from blinkgl.layouts.mvsec import _data
from blinkgl.layouts.source import Planned
from loaders import DsecEvents
from test_layouts import HEIGHT, LENS, RECIPE, WIDTH, generate

BASE = {k: v for k, v in RECIPE.items() if k not in ("tracks", "imu", "labels")}
RECIPES = {
    "labels": {**BASE, "labels": {"flow": [], "images": True}},
    "frame_camera": {
        **BASE,
        "labels": {"flow": []},
        "images": {"rate": 20, "exposure_us": 10_000, "bits": 10, "also": ["sharp"]},
    },
}


@pytest.fixture(scope="module", params=RECIPES)
def made(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    data = generate(folder, RECIPES[request.param])
    assert export_layout(data, folder / "out_intervals", "intervals").said == ()
    return request.param, data / "train/sequence_000000", folder / "out_intervals/train/sequence_000000"


def frame_times(folder):
    return [float(line.split(" ")[-1]) for line in (folder / "images/timestamp.txt").read_text().splitlines()]


def timelens(path):
    """(N, 4): x, y, t, p = -1 or +1, as load_events."""
    with np.load(path) as file:
        columns = [file[name].astype(np.float64).reshape(-1) for name in "xyt"]
        return np.stack([*columns, file["p"].astype(np.float32).reshape(-1) * 2 - 1], axis=-1)


def bs_ergb(path, width=970, height=625):
    with np.load(path) as file:
        places = []
        for name, most in (("x", width - 1), ("y", height - 1)):
            raw = file[name].astype(np.int32)
            raw[raw > most * 32] -= 65536
            places.append(np.clip(np.rint(raw / 32.0), 0, most))
        return np.stack([*places, file["timestamp"], file["polarity"] * 2.0 - 1], axis=-1)


def voxels(x, y, t, p, bins=5):
    """E2VID's grid, bin by bin: max(0, 1 - |place - bin|), place from 0 at the first event to bins - 1."""
    grid = np.zeros((bins, HEIGHT, WIDTH))
    place = (t - t[0]) / max(t[-1] - t[0], 1) * (bins - 1)
    for b in range(bins):
        np.add.at(grid[b], (y.astype(int), x.astype(int)), p * np.maximum(0, 1 - np.abs(place - b)))
    size = np.sort(np.abs(grid[grid != 0]))
    most = size[int(np.floor(len(size) * 0.98))]
    return np.where(np.abs(grid) < most, grid / most, np.sign(grid))


def test_each_interval_has_the_events_of_its_time(made):
    case, sequence, folder = made
    times, events = frame_times(folder), DsecEvents(sequence / "events.h5")
    t = events.t.astype("i8") + events.t_offset
    images = sorted((folder / "images").glob("*.png"))
    files = {name: sorted((folder / name).iterdir()) for name in ("events_aligned", "events")}
    assert len(images) == len(times) == len(files["events"]) + 1 == len(files["events_aligned"]) + 1 > 4
    assert images[0].stem == files["events"][0].stem == "000000"
    for k, (aligned, fine) in enumerate(zip(files["events_aligned"], files["events"])):
        inside = (t >= times[k]) & (t < times[k + 1])
        expected = np.stack([events.x[inside], events.y[inside], t[inside], events.p[inside] * 2.0 - 1], axis=-1)
        assert len(expected) > 10
        np.testing.assert_array_equal(timelens(aligned), expected)
        np.testing.assert_array_equal(bs_ergb(fine), expected)
    assert (folder / "sharp/000000.png").is_file() == (case == "frame_camera")


def test_evtexture(made):
    case, _, folder = made
    with h5py.File(f"{folder}.h5") as file:
        number = len(file["images"])
        assert len(file["voxels_f"]) == len(file["voxels_b"]) == number - 1
        for k in range(number):
            shown = cv2.imread(str(folder / f"images/{k:06d}.png"), cv2.IMREAD_UNCHANGED)
            assert (shown.dtype == np.uint16) == (case == "frame_camera")
            image = file[f"images/{k:06d}"][:]
            np.testing.assert_array_equal(image, shown // 4 if case == "frame_camera" else shown)
        for k in range(number - 1):
            x, y, t, p = timelens(folder / f"events_aligned/{k:06d}.npz").T
            assert np.abs(file[f"voxels_f/{k:06d}"][:] - voxels(x, y, t, p)).max() < 1e-4
            back = voxels(x[::-1], y[::-1], (t[-1] - t + t[0])[::-1], -p[::-1])
            assert np.abs(file[f"voxels_b/{k:06d}"][:] - back).max() < 1e-4


def test_recorded_frames_have_intervals_and_a_file_of_events_has_not(tmp_path, capsys):
    clip = tmp_path / "clip/image_left"
    clip.mkdir(parents=True)
    for k in range(6):
        wave = 128 + 90 * np.sin((np.arange(40) + 1.5 * k) / 4)
        cv2.imwrite(str(clip / f"{k:06d}.png"), np.round(np.tile(wave, (30, 1))).astype(np.uint8))
    frames = {"folders": [str(tmp_path / "clip")], "images": "image_left", "flow": None, "fps": 100}
    recipe = {"frames": frames, "labels": {"flow": [], "images": True}, "preview": {"enabled": False}}
    data = generate(tmp_path / "data", recipe)
    folder = tmp_path / "out/train/sequence_000000"
    assert run(["export", str(data), "--layout", "intervals", "--out", str(tmp_path / "out")]) == 0
    assert np.diff(frame_times(folder)).tolist() == [10_000] * 4
    assert sum(len(timelens(path)) for path in (folder / "events_aligned").iterdir()) > 100
    capsys.readouterr()
    events = tmp_path / "events.npz"
    assert run(["simulate", str(clip), "--fps", "100", "--out", str(events), "-q"]) == 0
    assert run(["export", str(events), "--layout", "intervals", "--out", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err == (
        f"error: {events}: a file of events keeps no frames and no labels; expected a data set: 'blinkgl generate' "
        "with frames: {folders: […]} makes one of recorded frames\n"
    )
    assert not (tmp_path / "none").exists()


IN_SENSOR_PIXELS = {"blinkflow", "mvsec", "multiflow", "eventkubric", "rosbag", "intervals"}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_events_in_sensor_pixels_have_no_rectified_labels_beside_them(tmp_path, layout):
    """DSEC's loaders rectify the events; TAP-Vid has none, and nerf says it."""
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(LENS))
    for pixels, camera in itertools.product(("rectified", "sensor"), (False, True)):
        overrides = [f"labels.pixels={pixels}", *(["images={rate: 20, exposure_us: 1000}"] if camera else [])]
        planned = Planned.of(load_run(tmp_path / "recipe.yaml", overrides).sequence(0), tmp_path)
        lacks = "labels: {pixels: sensor}" in [missing.yaml for missing in LAYOUTS[layout].missing(planned)]
        taken = layout in IN_SENSOR_PIXELS and not (camera and layout == "intervals")
        assert lacks == (pixels == "rectified" and taken), (pixels, camera)


def test_track_times_of_a_plan_are_those_that_a_run_writes(tmp_path):
    """EventKubric's 96 images and tracks in 2 s, also at a rate of the same times."""
    changes = {
        "time": {"duration": 2, "label_rate": 47.5},
        "labels": {"images": True},
        "timeline": {"kind": "uniform", "fps": 60},
    }
    for tracks in ({"points": 9}, {"points": 9, "rate": 47.5}):
        recipe = {**RECIPE, **changes, "tracks": tracks}
        (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(recipe))
        refuse_plan(load_run(tmp_path / "recipe.yaml"), None, "eventkubric")
    recipe["time"]["duration"] = 0.2
    sequence = generate(tmp_path / "made", recipe) / "train/sequence_000000"
    planned = Planned.of(load_run(tmp_path / "made/recipe.yaml").sequence(0), tmp_path)
    assert planned.track_times == np.load(sequence / "tracks.npz")["t_us"].tolist()


def test_mvsec_numbers_no_event_where_there_is_none(made, tmp_path):
    """Of a camera that is blind an image's event is the first, not the last of nothing."""

    class Blind(Source):
        def events(self, chunk=0):
            return iter([])

    source = Blind.open(made[1])
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        _data(source, file, "left")
        assert set(file["left/image_raw_event_inds"][...].tolist()) <= {0}
