"""Recordings and made files, event for event beside readers that are not ours: plain loops after OpenEB's rules, faery,
dv-processing, scipy, h5py, NumPy. rosbags: test_ros.py."""

from __future__ import annotations

import gzip

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, savemat

from blinkgl.io.formats import open_events
from blinkgl.io.reading import EventReading
from tests.io.some_events import some_events
from tests.io.test_evt import slow_evt2, slow_evt3
from tests.shared_data import shared

pytestmark = pytest.mark.slow


def equal(path, expected, **declared) -> int:
    with open_events(path, EventReading.of(**declared)) as file:
        events = file.read()
    for got, true, name in zip((events.x, events.y, events.t, events.p), expected, "xytp", strict=True):
        np.testing.assert_array_equal(got, true, err_msg=name)
    return len(events)


def by_openeb(path):
    """A plain loop over the words, as OpenEB decodes them."""
    head, _, body = path.read_bytes().partition(b"% end\n")
    if not body:
        data = path.read_bytes()
        at = 0
        while data[at : at + 2] == b"% ":
            at = data.index(b"\n", at) + 1
        head, body = data[:at], data[at:]
    three = b"evt 3" in head or b"EVT3" in head
    rows = (slow_evt3 if three else slow_evt2)(np.frombuffer(body, "<u2" if three else "<u4").tolist())
    return np.array(rows).T


def by_faery(path):
    a = pytest.importorskip("faery").events_stream_from_file(path).to_array()
    return a["x"], a["y"], a["t"].astype(np.int64), a["on"].astype(int)


def by_dv(path):
    recording, parts = pytest.importorskip("dv_processing").io.MonoCameraRecording(str(path)), []
    while (batch := recording.getNextEventBatch()) is not None:
        xy = batch.coordinates()
        parts.append((xy[:, 0], xy[:, 1], batch.timestamps(), batch.polarities()))
    return tuple(np.concatenate(columns) for columns in zip(*parts))


def by_jaer(path):
    """AEDAT 2.0 of a DAVIS240: y and x of events are counted from the other side."""
    data = path.read_bytes()
    at = 0
    while data[at : at + 1] == b"#":
        at = data.index(b"\n", at) + 1
    a = np.frombuffer(data[at:], ">u4").astype(np.int64).reshape(-1, 2)
    a = a[(a[:, 0] >> 31 == 0) & (a[:, 0] >> 10 & 1 == 0)]
    return 239 - (a[:, 0] >> 12 & 1023), 179 - (a[:, 0] >> 22 & 511), a[:, 1], a[:, 0] >> 11 & 1


def by_numpy(path):
    t, x, y, p = np.loadtxt(path).T
    return x, y, np.rint(t * 1e6), p


def by_scipy(path):
    table = loadmat(path)
    return table["x"].ravel(), table["y"].ravel(), table["ts"].ravel(), (table["pol"].ravel() > 0).astype(int)


@pytest.mark.parametrize(
    "name, reader",
    [
        ("prophesee/faery_evt2_gen3vga.raw", by_openeb),
        ("prophesee/expelliarmus_evt3_gen41hd.raw", by_openeb),
        ("aedat4/davis346_events_frames_imu.aedat4", by_dv),
        ("cuke_davis346/demo-01.aedat4", by_faery),
        ("noise/dvxplorer_constant_light.aedat4", by_dv),
        ("aermanager/head_turn.aedat4", by_faery),
        ("rueckauer2016/IMU_translBoxes.aedat", by_jaer),
        ("slider_depth/events_chunk.txt", by_numpy),
        ("ecd_rotation/boxes_rotation/events.txt", by_numpy),
        ("ecd_rotation/shapes_rotation/events.txt", by_numpy),
        ("evbench_davis240/seq_0001_e.mat", by_scipy),
        ("../../field/events/es_dvs.es", by_faery),
    ],
)
def test_twelve_recordings(name, reader):
    path = shared(f"data/events/{name}")
    assert equal(path, reader(path)) > 1000


E = some_events(5000, 3000, 900_000, 260, 346, seed=4)
COLUMNS = (E.x, E.y, E.t, E.p)
SCALE = {"s": 1e-6, "ms": 1e-3, "us": 1, "ns": 1000}


@pytest.mark.parametrize("ending", ["raw", "dat", "es", "aedat4", "csv"])
@pytest.mark.parametrize("seed", range(2))
def test_files_that_faery_makes(tmp_path, ending, seed):
    faery = pytest.importorskip("faery")
    e = some_events(3000, 0, 900_000, 260, 346, seed)
    a = np.empty(len(e), faery.EVENTS_DTYPE)
    a["t"], a["x"], a["y"], a["on"] = e.t, e.x, e.y, e.p
    path = tmp_path / f"e.{ending}"
    faery.events_stream_from_array(a, (346, 260)).to_file(path, **({} if ending == "aedat4" else {"zero_t0": False}))
    equal(path, (e.x, e.y, e.t, e.p))
    with open_events(path) as file:
        assert (file.height, file.width) == (260, 346) and file.notes == []


@pytest.mark.parametrize("unit", SCALE)
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("form", ["h5", "npz", "mat", "txt"])
def test_tables_of_strangers(tmp_path, unit, signed, form):
    """Thirty-two tables: units by their names, p of two kinds."""
    t, p = E.t * SCALE[unit], E.p.astype(np.int8) * 2 - 1 if signed else E.p
    path = tmp_path / f"e.{form}"
    table = {f"timestamp_{unit}": t, "x": E.x, "y": E.y, "polarity": p}
    if form == "h5":
        with h5py.File(path, "w") as file:
            for name, column in table.items():
                file.create_dataset(f"data/{name}", data=column, compression="gzip")
    elif form == "npz":
        np.savez_compressed(path, **table)
    elif form == "mat":
        savemat(path, table)
    else:
        np.savetxt(path, np.stack([t, E.x, E.y, p], 1), header=f"t[{unit}] x y p", fmt=["%.10g", "%d", "%d", "%d"])
    equal(path, COLUMNS)
    if form == "txt":
        (tmp_path / "e.txt.gz").write_bytes(gzip.compress(path.read_bytes()))
        equal(tmp_path / "e.txt.gz", COLUMNS)
