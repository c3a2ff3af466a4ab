"""What the loaders of public data sets ask of files, restated from their documentation: names, shapes, types, clocks.

Nothing here imports blinkgl: h5py, NumPy and OpenCV by hand.
"""

import io
import math
import pickle

import cv2
import h5py
import hdf5plugin  # noqa: F401 - registers Blosc
import numpy as np
import yaml


class DsecEvents:
    """DSEC's ``events.h5`` ("Data format" of the data set's page): t is relative to t_offset; ms_to_idx[ms] is the
    first event that is not before ms, so that a window lies between the entries of its floor and its ceiling, which
    must exist."""

    def __init__(self, path):
        with h5py.File(path) as file:
            assert {n: file["events"][n].dtype for n in "xytp"} == {"x": "u2", "y": "u2", "t": "u4", "p": "u1"}
            assert file["ms_to_idx"].dtype == "u8" and file["t_offset"].shape == () and file["t_offset"].dtype == "i8"
            self.x, self.y, self.t, self.p = (file["events"][n][:] for n in "xytp")
            self.ms_to_idx, self.t_offset = file["ms_to_idx"][:].astype("i8"), int(file["t_offset"][()])
        assert set(np.unique(self.p)) <= {0, 1}

    def window(self, start, end):
        """x, y, t, p of [start, end) µs on the clock of the images."""
        first, last = math.floor((start - self.t_offset) / 1000), math.ceil((end - self.t_offset) / 1000)
        assert first >= 0 and last < len(self.ms_to_idx), "a window that the table does not reach gives no events"
        low, high = self.ms_to_idx[first], self.ms_to_idx[last]
        t = self.t[low:high].astype("i8") + self.t_offset
        assert t.size, "loaders look at the first event of a window"
        a, b = np.searchsorted(t, [start, end])
        return self.x[low + a : low + b], self.y[low + a : low + b], t[a:b], self.p[low + a : low + b]


def rectify_map(path, height, width):
    with h5py.File(path) as file:
        found = file["rectify_map"][()]
    assert found.shape == (height, width, 2) and found.dtype == np.float32
    return found


def dsec_flow(path):
    """(flow, valid) of a 16-bit PNG: R = x, G = y, B = valid, (I - 2^15) / 128."""
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert raw.dtype == np.uint16 and raw.shape[2] == 3
    valid = raw[..., 2] == 1
    assert (raw[~valid, 2] == 0).all()
    return np.where(valid[..., None], (raw[..., :2].astype("f4") - 2**15) / 128, 0), valid


def dsec_sequence(folder, height, width):
    """A training sequence: per flow, (number, from, to, flow, valid, events before, events of it)."""
    events = DsecEvents(folder / "events/left/events.h5")
    rectify = rectify_map(folder / "events/left/rectify_map.h5", height, width)
    times = np.loadtxt(folder / "flow/forward_timestamps.txt", dtype="int64", delimiter=",", ndmin=2)
    files = sorted((folder / "flow/forward").iterdir())
    assert times.shape == (len(files), 2) and all(f.suffix == ".png" for f in files)
    images = np.loadtxt(folder / "images/timestamps.txt", dtype="int64")
    numbers = [int(f.stem) for f in files]
    assert numbers[0] == 2, "bflow's asks for the number two before each"
    assert set(np.diff(numbers)) == {2}, "flow at half the images' rate: the window before flow k is that of k - 2"
    for number, file, (start, end) in zip(numbers, files, times.tolist()):
        assert images[number] == start and images[number + 2] == end
        windows = [events.window(a, b) for a, b in ((2 * start - end, start), (start, end))]
        for x, y, _, _ in windows:
            assert rectify[y, x].shape == (len(x), 2)
        yield number, start, end, *dsec_flow(file), *windows


def dsec_disparity(folder, height, width):
    """The example provider: stamps, maps x 256 (0: none), both eyes' events of the 50 ms before each but the first."""
    stamps = np.loadtxt(folder / "disparity/timestamps.txt", dtype="int64", ndmin=1)
    files = sorted((folder / "disparity/event").iterdir())
    assert len(files) == len(stamps) and all(f.suffix == ".png" for f in files) and int(files[0].stem) == 0
    eyes = {eye: DsecEvents(folder / f"events/{eye}/events.h5") for eye in ("left", "right")}
    for eye in eyes:
        rectify_map(folder / f"events/{eye}/rectify_map.h5", height, width)
    for file, t in list(zip(files, stamps.tolist()))[1:]:
        raw = cv2.imread(str(file), cv2.IMREAD_ANYDEPTH)
        assert raw.dtype == np.uint16 and raw.shape == (height, width)
        yield raw.astype("f4") / 256, {eye: events.window(t - 50_000, t) for eye, events in eyes.items()}


def eraft_sequence(folder, height, width):
    """E-RAFT's test loader: every second image but the first and the last, 100 ms on both sides."""
    csv = np.genfromtxt(folder / "test_forward_flow_timestamps.csv", delimiter=",")
    assert csv.ndim == 2 and csv.shape[1] == 3, "one row alone would be read as a vector"
    images = np.loadtxt(folder / "image_timestamps.txt", dtype="int64")
    events = DsecEvents(folder / "events_left/events.h5")
    rectify_map(folder / "events_left/rectify_map.h5", height, width)
    for t, number in zip(images[::2][1:-1].tolist(), np.arange(len(images))[::2][1:-1].tolist()):
        assert number in csv[:, 2]
        yield number, t, events.window(t - 100_000, t), events.window(t, t + 100_000)


def blinkflow_sequence(folder):
    """BlinkFlow's loader: whole ms, flow i between frames i and i + 1, a table of ms, a clock that begins at 0."""
    about = yaml.safe_load((folder / "config.yaml").read_text())
    step = int(1e3 / about["fps"])
    with h5py.File(folder / "events_left/events.h5") as file:
        assert file["events/t"].dtype == "u8" and file["ms_to_idx"].dtype == "u8" and "t_offset" not in file
        table, columns = file["ms_to_idx"][:], [file[f"events/{n}"][:] for n in "xytp"]
    for i in range(1, int(about["duration"] * about["fps"])):
        assert (i + 1) * step < len(table), "the last window would be cut short"
        windows = [[c[table[a * step] : table[b * step]] for c in columns] for a, b in ((i - 1, i), (i, i + 1))]
        flow = np.load(folder / f"forward_flow/{i:06d}.npy", allow_pickle=False)
        assert flow.dtype == np.float32 and flow.ndim == 3 and flow.shape[2] == 3
        yield i, i * step * 1000, flow, *windows


def tapvid(path):
    """Tables of plain NumPy arrays, and of nothing else: what the pickle asks for is compared with a list."""

    class Plain(pickle.Unpickler):
        def find_class(self, module, name):
            assert name in ("_reconstruct", "ndarray", "dtype", "_frombuffer") and module.startswith("numpy"), name
            return super().find_class(module, name)

    table = Plain(io.BytesIO(path.read_bytes())).load()
    for name, video in table.items():
        assert set(video) == {"video", "points", "occluded"}, name
        n, times = video["occluded"].shape
        assert video["video"].dtype == np.uint8 and video["video"].shape[0] == times and video["video"].shape[3] == 3
        assert video["points"].shape == (n, times, 2) and video["points"].dtype == np.float32
        assert video["occluded"].dtype == bool and not video["occluded"].all(axis=1).any()
    return table


def multiflow_sample(folder, height, width):
    """MultiFlow's sample: the reference at 0.4 s of its own clock, the target at 0.9 s, images at both, flow from the
    one to every time that a file is named by, events a tenth of a second beyond. (x, y, t, p), images, {µs: flow}."""
    with h5py.File(folder / "events/events.h5") as file:
        x, y, t, p = (file[name][:] for name in "xytp")
    assert (np.diff(t) >= 0).all() and t[0] >= 0 and t[-1] < 1_000_000 and set(np.unique(p)) <= {0, 1}
    assert (t.astype("i4") == t).all() and (x.astype("i2") == x).all()
    images = [cv2.imread(str(folder / f"images/{time:07d}.png")) for time in (400_000, 900_000)]
    assert all(image.shape == (height, width, 3) for image in images)
    flows = {}
    for path in sorted((folder / "flow").iterdir()):
        assert path.suffix == ".h5" and len(path.stem) == 7 and int(path.stem) % 10_000 == 0
        with h5py.File(path) as file:
            flows[int(path.stem)] = file["flow"][()]
        assert flows[int(path.stem)].shape == (height, width, 2) and flows[int(path.stem)].dtype == np.float32
    assert max(flows) == 900_000 and min(flows) > 400_000
    return (x, y, t, p), images, flows


def eventkubric_sample(folder, times, seconds):
    """EventKubric's sample as ETAP reads it: (x, y, t in ns, p), images, target points and what is occluded."""
    table = np.load(folder / "annotations.npy", allow_pickle=True).item()
    assert table["target_points"].shape == (*table["occluded"].shape, 2) and table["occluded"].dtype == bool
    assert table["occluded"].shape[1] == times and table["target_points"].dtype == np.float32
    with h5py.File(folder / "data.hdf5") as file:
        rgba = file["rgba"][:]
    assert rgba.shape[0] == times and rgba.shape[3] == 4 and rgba.dtype == np.uint8 and (rgba[..., 3] == 255).all()
    parts = [np.load(path) for path in sorted((folder / "events").iterdir())]
    x, y, t, p = (np.concatenate([part[name] for part in parts]) for name in "xytp")
    assert (np.diff(t) >= 0).all() and t[0] >= 0 and t[-1] < seconds * 1e9 and set(np.unique(p)) == {-1, 1}
    return (x, y, t, p), rgba[..., :3], table["target_points"], table["occluded"]
