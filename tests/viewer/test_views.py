"""What a sequence has to show, as arrays: no viewer is needed."""

import shutil

import numpy as np
import pytest
import yaml

from blinkgl import read_events
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.errors import AssetError
from blinkgl.io.boxes import read_boxes
from blinkgl.io.sequence_tables import read_tracks
from blinkgl.sequence_files.sequence_dir import SequenceWriter
from blinkgl.types.events import Events
from blinkgl.viewer.views import MAX_EVENTS, SequenceView, sequences_in
from recipes import RIG, SINGLE


def make(folder, recipe):
    folder.mkdir(exist_ok=True)
    (folder / "recipe.yaml").write_text(yaml.safe_dump(recipe))
    run_dataset(load_run(folder / "recipe.yaml"), folder / "out")
    return folder / "out"


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    return make(tmp_path_factory.mktemp("single"), SINGLE) / "train/sequence_000000"


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    return make(tmp_path_factory.mktemp("rig"), RIG) / "train/sequence_000000"


@pytest.fixture
def sensor(single):
    sequence = SequenceView(single)
    yield sequence.sensors[0]
    sequence.close()


def test_every_label_has_its_picture_and_what_lacks_has_none(single, rig):
    with_all = SequenceView(single).sensors[0].pictures(7_150_000, 5000)
    assert [one.heading for one in with_all] == [
        "frame", "frame camera", "events", "forward flow", "backward flow", "velocity label", "depth", "instance id",
        "normals", "occluded, forward", "occluded, backward", "scene flow", "semantics",
    ]  # fmt: skip
    for one in with_all:
        assert one.image.dtype == np.uint8
        assert one.image.shape[2] == 3
        assert one.image.std() > 0, one.heading
    left, right, rgb = SequenceView(rig).sensors
    for eye in (left, right):
        headings = [one.heading for one in eye.pictures(100_000, 5000)]
        assert headings == ["frame", "events", "forward flow", "depth", "disparity"]
    assert [one.heading for one in rgb.pictures(100_000, 5000)] == ["frame camera"]


def test_a_window_holds_the_events_before_its_time_on_the_sequences_clock(single, sensor):
    events = read_events(single / "events.h5")
    assert sensor.source.start_us == 7_000_000
    assert events.t[0] >= 7_000_000
    window = sensor.events(7_150_000, 5000)
    assert len(window) == np.count_nonzero((events.t >= 7_145_000) & (events.t < 7_150_000)) > 0
    picture = next(one for one in sensor.pictures(7_150_000, 5000) if one.heading == "events")
    pixels = {*zip(window.y.tolist(), window.x.tolist())}
    assert {*zip(*map(np.ndarray.tolist, np.nonzero((picture.image != 255).any(axis=2))))} == pixels
    assert f"{len(window):,}" in picture.note
    assert "7145.0–7150.0 ms" in picture.note


def test_points_of_events_are_centred_and_end_at_the_time(sensor):
    points, on = sensor.event_points(7_150_000, 50_000)
    assert len(points) == len(on) <= MAX_EVENTS
    assert points[:, 2].min() >= 0
    assert points[:, 2].max() < 1
    width, height = sensor.source.width, sensor.source.height
    assert np.abs(points[:, 0]).max() <= 0.5 - 0.5 / width + 1e-6  # pixels' centres: half a pixel inside
    assert np.abs(points[:, 1]).max() <= 0.5 * height / width - 0.5 / width + 1e-6
    x = points[:, 0] * width + (width - 1) / 2
    assert np.allclose(x, x.round(), atol=1e-4)


def test_labels_hold_until_the_next_one(sensor):
    def at(t_us):
        return {one.heading: one for one in sensor.pictures(t_us, 1000)}

    first, before, later = at(7_100_000), at(7_199_999), at(7_200_000)
    assert first["depth"].note.startswith("7100.0 ms")
    assert np.array_equal(first["depth"].image, before["depth"].image)
    assert later["depth"].note.startswith("7200.0 ms")
    assert not np.array_equal(first["depth"].image, later["depth"].image)
    assert np.array_equal(sensor.camera_pose(7_199_999), sensor.source.poses["T_world_cam"][1])


def test_depth_is_where_the_pixels_see_objects_and_nothing_else(sensor):
    cloud, ids = sensor.depth_cloud(7_100_000), sensor.source.value("ids", 0)
    names = dict(zip(sensor.source.poses["object_ids"].tolist(), sensor.source.poses["object_categories"].tolist()))
    objects = np.isin(ids, [i for i, name in names.items() if name not in ("sky", "ground")])
    assert len(cloud.points) == objects.sum() > 0
    pose = sensor.camera_pose(7_100_000)
    px = sensor.source.camera.project((cloud.points - pose[:3, 3]) @ pose[:3, :3])
    y, x = np.nonzero(objects)
    assert np.allclose(px, np.stack([x, y], axis=-1), atol=1e-3)  # pixels' centres, not their corners
    assert np.array_equal(cloud.colours, sensor.source.image(0)[y, x])


def test_without_ids_the_objects_boxes_cut_sky_and_ground(sensor, monkeypatch):
    whole, has = sensor.depth_cloud(7_100_000), type(sensor.source).has
    monkeypatch.setattr(type(sensor.source), "has", lambda self, name: not name.startswith("ids/") and has(self, name))
    cut = sensor.depth_cloud(7_100_000)
    assert 0.95 * len(whole.points) <= len(cut.points) <= 1.2 * len(whole.points)
    monkeypatch.setattr(type(sensor), "bodies", lambda self, t_us: [])
    assert len(sensor.depth_cloud(7_100_000).points) > 2 * len(cut.points)


def test_bodies_are_where_labels_say(single, sensor):
    said = read_boxes(single / "boxes/000001.npz")
    bodies = {body.name: body for body in sensor.bodies(7_200_000)}
    names = dict(zip(sensor.source.poses["object_ids"].tolist(), sensor.source.poses["object_names"].tolist()))
    assert len(bodies) == 3
    checked = 0
    for k, number in enumerate(said.instance.tolist()):
        if names[number] in ("sky", "ground"):
            assert names[number] not in bodies
            continue
        assert np.allclose(bodies[names[number]].pose, said.T_world_box[k])
        assert np.allclose(bodies[names[number]].size, said.size[k])
        checked += 1
    assert checked
    before = {body.name: body for body in sensor.bodies(7_000_000)}  # no label yet: shapes at rest, at that pose
    row = list(sensor.source.poses["object_names"]).index(next(iter(before)))
    assert np.allclose(before[next(iter(before))].pose[:3, :3], sensor.source.poses["T_world_obj"][row, 0, :3, :3])


def test_tracked_points_are_seen_where_the_tracks_say(single, sensor):
    tracks, m = read_tracks(single), 2
    t_us = int(tracks["t_us"][m])
    cloud, pose = sensor.track_cloud(t_us), sensor.camera_pose(t_us)
    assert t_us in (sensor.source.poses["t_ns"] // 1000).tolist()
    seen = ~tracks["occluded"][:, m]
    px = sensor.source.camera.project((cloud.points - pose[:3, 3]) @ pose[:3, :3])
    assert np.allclose(px[seen], tracks["target_points"][seen, m], atol=1e-2)
    assert (cloud.colours[~seen] == 130).all()


def test_a_rig_has_all_its_cameras_and_units_on_one_clock(rig):
    sequence = SequenceView(rig)
    assert [one.name for one in sequence.sensors] == ["left", "right", "rgb"]
    assert list(sequence.units) == ["imu"]
    assert (sequence.start_us, sequence.end_us) == (0, 200_000)
    middle, radius = sequence.extent()
    assert radius > 0
    assert np.isfinite(middle).all()


def test_events_alone_are_a_recording_without_space(tmp_path):
    folder = tmp_path / "events"
    with SequenceWriter(folder, 12, 16, config_yaml="{}", t_offset_us=5_000_000) as writer:
        t = np.arange(5_000_000, 5_010_000, 100)
        x, y, p = (np.uint16(t % 16), np.uint16(t % 12), np.uint8(t // 100 % 2))
        writer.append_events(Events(x, y, t, p))
        writer.info = {"duration_us": 10_000}
    sequence = SequenceView(folder)
    assert not sequence.has_space
    assert sequence.extent()[1] == 1.0
    (sensor,) = sequence.sensors
    assert [one.heading for one in sensor.pictures(5_010_000, 1000)] == ["events"]
    assert len(sensor.events(5_010_000, 1000)) == 10
    assert sensor.depth_cloud(5_010_000) is None
    assert sensor.bodies(5_010_000) == []


def test_an_empty_sequence_is_refused(tmp_path):
    with SequenceWriter(tmp_path / "nothing", 12, 16, config_yaml="{}", events=False) as writer:
        writer.info = {"duration_us": 1000}
    with pytest.raises(AssetError, match="nothing: the sequence is empty"):
        SequenceView(tmp_path / "nothing")


def test_what_is_no_sequence_is_refused(tmp_path, single):
    with pytest.raises(AssetError, match="no such folder"):
        sequences_in(tmp_path / "gone")
    with pytest.raises(AssetError, match="the folder has no sequence"):
        sequences_in(tmp_path)
    assert sequences_in(single.parents[1]) == [single]
    damaged = shutil.copytree(single, tmp_path / "damaged")
    (damaged / "poses.npz").unlink()
    with pytest.raises(AssetError, match=r"damaged sequence: poses\.npz: missing"):
        SequenceView(damaged)


def test_the_last_image_keeps_the_labels_before_it(single, sensor):
    """Only an image is of the sequence's end: the labels, clouds and boxes of the last label stay."""
    end = SequenceView(single).end_us
    before, last = ({one.heading: one for one in sensor.pictures(t, 1000)} for t in (end - 1, end))
    assert set(before) == set(last) and before["depth"].note == last["depth"].note
    assert before["frame"].note != last["frame"].note
    assert np.array_equal(sensor.depth_cloud(end - 1).points, sensor.depth_cloud(end).points)
    assert len(sensor.bodies(end)) == len(sensor.bodies(end - 1))
