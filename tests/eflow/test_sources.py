"""Every layout read from files of that layout; damaged ones refused by name."""

import dataclasses
import shutil

import h5py
import numpy as np
import pytest

from blinkgl.errors import AssetError, BlinkGLError, ConfigError
from blinkgl.io.atomic import temporary_beside
from eflow.data import mvsec
from eflow.data.content import content_of
from eflow.data.folders import below
from eflow.data.mvsec import MvsecSource, propagate
from eflow.data.sources import open_source, read_flow
from eflow.load_config import load_train_config
from flow_data import SPAN, blinkflow_set, blinkgl_set, constant_flow, dsec_set, moving_events, mvsec_set
from trainings import config_file


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    root = tmp_path_factory.mktemp("sets")
    return {
        "blinkgl": blinkgl_set(root / "blinkgl"),
        "dsec": dsec_set(root / "dsec"),
        "blinkflow": blinkflow_set(root / "blinkflow"),
        "mvsec": mvsec_set(root / "mvsec"),
    }


def test_blinkgl(sets):
    source = open_source(sets["blinkgl"])
    assert len(source) == 6 and source.has_backward
    s = source[4]
    assert s.name == "train/seq_000001/000001" and s.scene == "train/seq_000001"
    assert (s.new.t0, s.new.t1) == (2 * SPAN, 3 * SPAN)
    e = moving_events(128, 144, 0, 4 * SPAN, (50.0, -20.0), 16000, 1).window(2 * SPAN, 3 * SPAN)
    np.testing.assert_array_equal(s.new.t, e.t)
    np.testing.assert_array_equal(s.new.x, e.x)
    np.testing.assert_allclose(s.flow[10, 10], (5.0, -2.0), atol=1 / 256)
    np.testing.assert_allclose(s.backward[10, 10], (-5.0, 2.0), atol=1 / 256)
    assert not s.valid[:4].any() and s.valid[4:].all()


def test_dsec_rectified_and_beyond_32_bits(sets):
    s = open_source(sets["dsec"])[1]
    assert s.name == "thun_00_a/000004" and s.new.t0 == 49_000_000_000 + 2 * SPAN
    e = moving_events(480, 640, 49_000_000_000, 49_000_000_000 + 3 * SPAN, n=6000).window(s.new.t0, s.new.t1)
    np.testing.assert_array_equal(s.new.t, e.t)
    np.testing.assert_allclose(s.new.x, e.x + 0.25)
    assert s.new.x.dtype == np.float32


def test_blinkflow_label_0_has_no_past(sets):
    source = open_source(sets["blinkflow"])
    assert [source[i].name for i in range(len(source))] == ["scene_a/seq_0/000001", "scene_a/seq_0/000002"]
    assert source[0].scene == "scene_a" and (source[0].new.t0, source[0].new.t1) == (SPAN, 2 * SPAN)
    e = moving_events(480, 640, 0, 3 * SPAN, n=6000)
    assert len(source[1].new) == len(e.window(2 * SPAN, 3 * SPAN))  # past the end of ms_to_idx


def test_mvsec_with_its_truth_as_hdf5(tmp_path):
    """MVSEC's own <sequence>_gt.hdf5, which IDNet's loader reads: the same samples as of the .npz."""
    of_npz = MvsecSource(mvsec_set(tmp_path / "npz"))
    path = mvsec_set(tmp_path / "hdf5") / "indoor_flying1_gt_flow_dist.npz"
    with np.load(path) as arrays, h5py.File(path.with_name("indoor_flying1_gt.hdf5"), "w") as file:
        flow = np.stack([arrays["x_flow_dist"], arrays["y_flow_dist"]], 1)
        file.create_dataset("davis/left/flow_dist", data=flow, compression="gzip")
        file["davis/left/flow_dist_ts"] = arrays["timestamps"]
    path.unlink()
    of_hdf5 = MvsecSource(tmp_path / "hdf5")
    assert len(of_hdf5) == len(of_npz) > 3
    for k in range(len(of_npz)):
        assert (of_hdf5[k].flow == of_npz[k].flow).all() and (of_hdf5[k].valid == of_npz[k].valid).all()
    with h5py.File(path.with_name("indoor_flying1_gt.hdf5"), "w") as file:
        file["davis/left/flow_dist"], file["davis/left/flow_dist_ts"] = flow[:, 0], np.arange(float(len(flow)))
    with pytest.raises(
        AssetError, match=r"_gt\.hdf5: dataset 'davis/left/flow_dist' has the wrong shape .*, 2, 260, 346"
    ):
        MvsecSource(tmp_path / "hdf5")


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("dt", [1, 4])
def test_mvsec(tmp_path, dt, compressed):
    source = MvsecSource(mvsec_set(tmp_path, compressed=compressed), dt)
    s = source[0]
    assert s.name == f"indoor_flying1/{dt:06d}"
    e = moving_events(260, 346, 0, int(12 / 31 * 1e6), n=20000)
    assert abs(len(s.new) - len(e.window(s.new.t0, s.new.t1))) <= 1  # float64 seconds since 1970 resolve 0.2 µs
    inside = (
        s.valid
        & (np.arange(346)[None] > 40)
        & (np.arange(260)[:, None] > 40)
        & (np.arange(260)[:, None] < 200)
        & (np.arange(346)[None] < 300)
    )
    span = (s.new.t1 - s.new.t0) * 20e-6
    np.testing.assert_allclose(s.flow[inside], np.broadcast_to((span, -0.5 * span), (inside.sum(), 2)), rtol=1e-4)
    assert not s.valid[:18, :18].any()
    assert not s.mask[:2].any() and not s.mask[:, :45].any() and s.mask[2:258, 45:301].any()
    hits = np.zeros_like(s.mask)
    hits[s.new.y, s.new.x] = True
    assert not (s.mask & ~hits).any()


def outdoor(root, fields=7):
    """outdoor_day1 whose flow grows: 1, 2, 3 … px per interval."""
    mvsec_set(root, "outdoor_day1")
    path = root / "outdoor_day1_gt_flow_dist.npz"
    stored = np.load(path)
    grow = np.arange(1, fields + 1)[:, None, None]
    np.savez(path, timestamps=stored["timestamps"], **{k: stored[k] * grow for k in ("x_flow_dist", "y_flow_dist")})
    return root


def protocol(monkeypatch, name, **changes):
    monkeypatch.setitem(
        mvsec.PROTOCOLS, name, dataclasses.replace(mvsec.PROTOCOLS.get(name, mvsec.Protocol()), **changes)
    )


def test_mvsec_frames_of_a_protocol(tmp_path, monkeypatch):
    root = outdoor(tmp_path)
    everything = [s.name for s in MvsecSource(root)]
    assert everything == [f"outdoor_day1/{i:06d}" for i in range(1, 9)]
    with pytest.raises(AssetError, match="no frame that ste-flownet scores .*1 to 8.*9200 to 9599 and 10500"):
        MvsecSource(root, protocol="ste-flownet")
    protocol(monkeypatch, "ste-flownet", frames={"outdoor_day1": ((2, 4), (6, 7)), "indoor_flying1": ((0, 1),)})
    source = MvsecSource(root, protocol="ste-flownet")
    assert [s.name[-1] for s in source] == ["2", "3", "6"]
    # rows 2 … 191: the centre crop begins at row 2, and the hood at 192
    mask = source[0].mask
    rows = np.flatnonzero(mask.any(1))
    assert rows[0] == 2 and rows[-1] == 191 and MvsecSource(root)[1].mask[192].any()


def test_mvsec_frames_and_pixels_of_ones_own(tmp_path):
    root = outdoor(tmp_path)
    source = MvsecSource(root, frames=((2, 4), (7, 8)), dense=True)
    assert [s.name[-1] for s in source] == ["2", "3", "7"]
    sparse = MvsecSource(root, frames=((2, 3),))[0].mask
    # The whole centre crop above the hood: rows 2 to 192, columns 45 to 300.
    assert source[0].mask.sum() == (193 - 2) * 256 > sparse.sum() and not (sparse & ~source[0].mask).any()
    with pytest.raises(AssetError, match="has no frame that --frames scores .*expected 90 to 99"):
        MvsecSource(root, frames=((90, 100),))
    with pytest.raises(ConfigError, match="frames: only for MVSEC"):
        open_source(blinkgl_set(tmp_path / "b", 1, 1), frames=((0, 1),))


def test_both_conventions_of_mvsecs_ground_truth(tmp_path, monkeypatch):
    """Images at 31 Hz, flow at 20: image 3 is at 96.8 ms, and its interval goes over the stamp at 100."""
    root = outdoor(tmp_path)
    interval, begin = 1 / 31 * 20, 3 / 31 * 20
    first, second = 2 - begin, interval - (2 - begin)  # shares of the fields of 2 and 3 px
    middle = (100, 150)
    for truth, u in (("propagated", 2 * first + 3 * second), ("scaled", 2 * interval)):
        protocol(monkeypatch, truth, truth=truth)
        sample = MvsecSource(root, protocol=truth)[2]
        assert sample.name.endswith("000003") and sample.valid[middle]
        assert sample.flow[middle] == pytest.approx((u, -u / 2), abs=1e-3), truth
    inside = [MvsecSource(root, protocol=t)[1].flow for t in mvsec.TRUTHS]  # image 2: within one field
    np.testing.assert_allclose(*inside, atol=1e-6)
    four = [MvsecSource(root, 4, t)[0].flow for t in mvsec.TRUTHS]  # longer than a field: followed, either way
    assert np.array_equal(*four)


def test_mvsec_at_20_hz(tmp_path, monkeypatch):
    protocol(monkeypatch, "e-raft", frames={"outdoor_day1": ((2, 4),)})
    source = MvsecSource(outdoor(tmp_path), protocol="e-raft")
    assert [s.name[-1] for s in source] == ["2", "3"]
    sample = source[0]
    assert (sample.old.t0, sample.new.t0, sample.new.t1) == (50_000, 100_000, 150_000)
    assert sample.flow[100, 150] == pytest.approx((3, -1.5), abs=1e-4), "field 2 as it is"
    e = moving_events(260, 346, 0, int(12 / 31 * 1e6), n=20000)
    assert abs(len(sample.new) - len(e.window(100_000, 150_000))) <= 1
    protocol(monkeypatch, "e-raft", frames={})
    assert [s.name[-1] for s in MvsecSource(outdoor(tmp_path / "all"), protocol="e-raft")] == list("12345")


def test_what_is_asked_of_mvsec_alone(tmp_path):
    root = mvsec_set(tmp_path / "m")
    for options, message in (
        ({"protocol": "kitti"}, "protocol: unknown choice .*all, ste-flownet, e-raft"),
        ({"protocol": "e-raft", "dt": 4}, "dt"),
    ):
        with pytest.raises(ConfigError, match=message):
            open_source(root, **options)
    with pytest.raises(ConfigError, match="dt: only for MVSEC"):
        open_source(blinkgl_set(tmp_path / "d", sequences=1, labels=1), dt=4)
    with pytest.raises(ConfigError, match="protocol: only for MVSEC"):
        open_source(blinkgl_set(tmp_path / "b", sequences=1, labels=1), protocol="e-raft")


def test_mvsec_whose_flow_is_of_another_time(tmp_path):
    path = mvsec_set(tmp_path) / "indoor_flying1_gt_flow_dist.npz"
    stored = dict(np.load(path))
    np.savez(path, **{**stored, "timestamps": stored["timestamps"] + 100})
    refused("no image whose windows the ground truth covers", lambda: open_source(tmp_path))


def test_propagation_through_successive_fields():
    """A shear: u = y in the first field; then v = 1. The second field is read where the point has got to."""
    h, w = 8, 30
    first, second = np.zeros((h, w, 2), np.float32), np.ones((h, w, 2), np.float32)
    first[..., 0] = np.arange(h)[:, None]
    first[0] = (0, 0)
    second[..., 0] = np.arange(w)[None]
    flow, valid = propagate([(first, 1.0), (second, 0.5)])
    assert not valid[0].any()  # 0, 0 is invalid
    x, y = 5, 4
    np.testing.assert_allclose(flow[y, x], (4 + 0.5 * 9, 0.5))
    assert valid[4, 25] and not valid[4, 26]  # x + 4 leaves the image
    assert (flow[~valid] == 0).all()


# ---- damaged and missing ---------------------------------------------------------------------------------------------


TIMES = "flow/forward_timestamps.txt"


def refused(match: str, call) -> None:
    with pytest.raises(BlinkGLError, match=match) as caught:
        call()
    assert "\n" not in str(caught.value)


def rewrite(name, change):
    """What changes the bytes of a file of a sequence."""

    def spoil(folder):
        (folder / name).write_bytes(change((folder / name).read_bytes()))

    return spoil


@pytest.mark.parametrize(
    "spoil, said",
    [
        (rewrite("events.h5", lambda data: data[: len(data) // 2]), r"events\.h5: truncated"),
        (rewrite("events.h5", lambda data: b"no hdf5 at all" * 100), r"events\.h5: not an HDF5 file"),
        (lambda folder: (folder / "events.h5").unlink(), "no blinkgl sequence"),
        (
            rewrite(TIMES, lambda text: text.replace(b"100000, 200000", b"200000, 100000")),
            "forward_timestamps.txt: not an interval",
        ),
        (rewrite(TIMES, lambda text: b"# header\nnonsense\n"), "forward_timestamps.txt: line 2 is no time"),
        (rewrite(TIMES, lambda text: text + b"400000, 500000\n"), "differ in number"),
    ],
)
def test_damaged_sequences(tmp_path, spoil, said):
    root = blinkgl_set(tmp_path, sequences=1)
    spoil(root / "train" / "seq_000000")
    refused(said, lambda: open_source(root)[0])


@pytest.mark.parametrize("make", [blinkgl_set, dsec_set, blinkflow_set, mvsec_set])
def test_a_sequence_that_is_being_written_is_no_data_yet(tmp_path, make):
    """Training on a set that grows: a run writes its next sequence in a hidden folder, whose files come and go."""
    root = make(tmp_path / "set")
    names = [open_source(root)[k].name for k in range(len(open_source(root)))]
    config = load_train_config(config_file(tmp_path, root))
    content = content_of(config)
    whole = next(below(root, "*"))
    shutil.copytree(whole, temporary_beside(whole)) if whole.is_dir() else shutil.copy(whole, temporary_beside(whole))
    (temporary_beside(root / "next.h5")).symlink_to(root / "gone")
    source = open_source(root)
    assert [source[k].name for k in range(len(source))] == names and content_of(config) == content


@pytest.mark.parametrize("ending", [".flo", ".pfm", ".flo5", ".PNG"])
def test_other_labels_are_another_content(tmp_path, ending):
    label = tmp_path / f"set/flow/forward/000000{ending}"
    label.parent.mkdir(parents=True)
    config = load_train_config(config_file(tmp_path, tmp_path / "set"))
    digests = []
    for data in (b"1", b"2"):
        label.write_bytes(data)
        digests.append(content_of(config))
    assert digests[0] != digests[1]


def test_recordings_of_one_name_are_two(tmp_path):
    for day, names in (("mon", ("rec", "own")), ("tue", ("rec",))):
        dsec_set(tmp_path / "dsec" / day, names, labels=1)
    source = open_source(tmp_path / "dsec")
    assert [source[k].name for k in range(3)] == ["own/000002", "mon/rec/000002", "tue/rec/000002"]
    assert [source[k].scene for k in range(3)] == ["own", "mon/rec", "tue/rec"]
    root = blinkflow_set(tmp_path / "blinkflow", labels=2)
    shutil.copytree(root / "test", root / "train")
    source = open_source(root)
    assert [source[k].name for k in range(2)] == [f"{split}/scene_a/seq_0/000001" for split in ("test", "train")]
    assert source[0].scene == source[1].scene == "scene_a"


@pytest.mark.parametrize(
    ("kind", "folder", "name"),
    [
        ("blinkgl", "train/seq_000000", "seq_000000/000000"),
        ("dsec", "thun_00_a", "thun_00_a/000002"),
        ("blinkflow", "test/scene_a/seq_0", "scene_a/seq_0/000001"),
    ],
)
def test_a_sequence_opened_from_inside_has_its_name(sets, monkeypatch, kind, folder, name):
    monkeypatch.chdir(sets[kind] / folder)
    assert open_source(".")[0].name == name


def test_folders_without_data(tmp_path):
    refused("no such data set", lambda: open_source(tmp_path / "nowhere"))
    refused("no data set found", lambda: open_source(tmp_path))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_or_infinite_flow(tmp_path, value):
    flow = np.dstack([constant_flow(8, 9), np.ones((8, 9), np.float32)])
    flow[2, 3, 0] = value
    np.save(tmp_path / "a.npy", flow)
    refused(r"a\.npy: flow is NaN or infinite at pixel \(3, 2\)", lambda: read_flow(tmp_path / "a.npy"))
    flow[2, 3, 2] = 0  # marked invalid: may hold anything
    np.save(tmp_path / "a.npy", flow)
    assert read_flow(tmp_path / "a.npy")[0][2, 3].tolist() == [0, 0]


def test_mvsec_without_ground_truth(tmp_path):
    mvsec_set(tmp_path)
    path = tmp_path / "indoor_flying1_gt_flow_dist.npz"
    path.write_bytes(path.read_bytes()[:1000])
    refused("npz: cannot read", lambda: open_source(tmp_path))
    path.unlink()
    refused("gt_flow_dist.npz: no such file", lambda: open_source(tmp_path))


def test_dsec_without_rectification_map(tmp_path):
    root = dsec_set(tmp_path)
    (root / "thun_00_a/events/left/rectify_map.h5").unlink()
    refused("rectify_map.h5: no rectification map", lambda: open_source(root))


def test_the_folder_that_one_stands_in_has_its_name(sets, monkeypatch):
    for kind, sequence in (("dsec", "**/events/left"), ("blinkflow", "**/forward_flow"), ("blinkgl", "train/*/flow")):
        folder = next(sets[kind].glob(sequence))
        folder = folder.parent.parent if kind == "dsec" else folder.parent
        monkeypatch.chdir(folder)
        names = [source[0].name for source in (open_source("."), open_source(folder))]
        assert names[0] == names[1] and folder.name in names[0]
