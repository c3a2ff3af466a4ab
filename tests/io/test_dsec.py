"""DSEC event files: written by us, read back by h5py alone with the DSEC slicer's rule."""

from __future__ import annotations

import subprocess
import sys

import h5py
import hdf5plugin  # noqa: F401 - registers Blosc
import numpy as np
import pytest

from blinkgl.errors import AssetError, EventDataError, OutputError
from blinkgl.io import dsec
from blinkgl.io.dsec import DsecEventReader, DsecEventWriter
from blinkgl.types.events import Events
from tests.io.some_events import same, some_events


def random_events(n: int, duration_us: int, t0: int = 0) -> Events:
    return some_events(n, t0, t0 + duration_us, 48, 64)


def write(path, events: Events, sizes, t_offset_us=0, t_end_us=None, **kw):
    writer = DsecEventWriter(path, 48, 64, t_offset_us, **kw)
    start = 0
    while start < len(events):
        n = next(sizes)
        writer.append(Events(*(getattr(events, k)[start : start + n] for k in "xytp")))
        start += n
    writer.close(t_end_us)


def chunk_sizes(seed):
    rng = np.random.default_rng(seed)
    while True:
        yield int(rng.choice([1, 7, 1000, 60_000]))


def slicer_reference(file: h5py.File, t_start_us: int, t_end_us: int) -> dict[str, np.ndarray]:
    """The DSEC slicer's rule, written from the format page: conservative window by ms_to_idx, then exact."""
    offset = int(file["t_offset"][()])
    start, end = t_start_us - offset, t_end_us - offset
    ms_to_idx = file["ms_to_idx"][()].astype(np.int64)
    low, high = int(np.floor(start / 1000)), int(np.ceil(end / 1000))
    assert high < len(ms_to_idx), "the slicer would return nothing"
    window = slice(ms_to_idx[low], ms_to_idx[high])
    t = file["events/t"][window].astype(np.int64)
    keep = (t >= start) & (t < end)
    return {k: file[f"events/{k}"][window][keep] for k in "xyp"} | {"t": t[keep] + offset}


def test_gzip_is_read_by_h5py_alone(tmp_path):
    """In a process that has no Blosc."""
    events = some_events(1000, 0, 50_000, 480, 640)
    with DsecEventWriter(tmp_path / "e.h5", 480, 640, codec="gzip") as writer:
        writer.append(events.part(slice(300)))
        writer.append(events.part(slice(300, None)))
    with DsecEventReader(tmp_path / "e.h5") as reader:
        assert same(reader.slice(0, 50_000), events)
    alone = (
        "import h5py, sys; f = h5py.File(sys.argv[1]); f.visititems(lambda k, d: hasattr(d, 'shape') and d[()]);"
        "assert 'hdf5plugin' not in sys.modules; print(f['events/x'][:].sum(), len(f['ms_to_idx']))"
    )
    said = subprocess.run([sys.executable, "-c", alone, str(tmp_path / "e.h5")], capture_output=True, text=True)
    assert said.stdout.split() == [str(events.x.sum(dtype=int)), "51"], said.stderr


@pytest.mark.parametrize("n, duration", [(0, 5000), (1, 5000), (300_000, 250_000), (200, 400_000)])
def test_ms_to_idx_and_columns_exhaustively(tmp_path, monkeypatch, n, duration):
    monkeypatch.setattr(dsec, "BLOCK", 4096)  # many blocks: entries straddle them
    offset = 5_000_000_000_000
    events = random_events(n, duration, t0=offset)
    write(tmp_path / "e.h5", events, chunk_sizes(1), offset, offset + duration)
    with h5py.File(tmp_path / "e.h5") as file:
        dtypes = {k: file[f"events/{k}"].dtype for k in "xytp"} | {k: file[k].dtype for k in ("ms_to_idx", "t_offset")}
        assert dtypes == {"x": "u2", "y": "u2", "t": "u4", "p": "u1", "ms_to_idx": "u8", "t_offset": "i8"}
        assert file["events/t"].id.get_create_plist().get_filter(0)[0] == 32001
        t = file["events/t"][()].astype(np.int64)
        assert np.array_equal(t + offset, events.t)
        ms_to_idx = file["ms_to_idx"][()]
        assert len(ms_to_idx) == -(-duration // 1000) + 1
        assert ms_to_idx.tolist() == [int(np.sum(t < 1000 * ms)) for ms in range(len(ms_to_idx))]


def test_slices_agree_with_the_independent_slicer(tmp_path, monkeypatch):
    monkeypatch.setattr(dsec, "BLOCK", 4096)
    offset, duration = 123_456_789, 60_000
    events = random_events(50_000, duration, t0=offset)
    write(tmp_path / "e.h5", events, chunk_sizes(2), offset, offset + duration)
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "e.h5") as file, DsecEventReader(tmp_path / "e.h5") as reader:
        assert (reader.height, reader.width, reader.count) == (48, 64, 50_000)
        windows = [(0, duration), (0, 1), (999, 1000), (1000, 2000), (duration - 1, duration)]
        windows += [tuple(sorted(rng.integers(0, duration, 2))) for _ in range(100)]
        for a, b in windows:
            a, b = offset + int(a), offset + int(b)
            reference, ours = slicer_reference(file, a, b), reader.slice(a, b)
            assert ours.t.dtype == np.int64
            assert all(np.array_equal(reference[k], getattr(ours, k)) for k in "xytp")
            assert same(ours, events.window(a, b))
        assert same(Events.concatenate(list(reader.chunks(7777))), events)
        for a, b in [
            (offset - 10_000, offset + 5),
            (offset + duration - 5, offset + 10**7),
            (offset + 10**7, offset + 2 * 10**7),
        ]:
            assert same(reader.slice(a, b), events.window(a, b))


def one(x=0, y=0, t=0, p=0) -> Events:
    return Events(np.array([x], np.uint16), np.array([y], np.uint16), np.array([t], np.int64), np.array([p], np.uint8))


@pytest.mark.parametrize(
    "second, message",
    [
        (one(t=9), r"decrease at event 1 .*10, 9"),
        (one(t=10, x=64), r"outside the sensor.*x < 64"),
        (one(t=10, y=48), "outside the sensor"),
        (one(t=10, p=2), "polarity"),
        (one(t=10 + 2**32), "71.6 minutes"),
        (
            Events(*(np.array(v, d) for v, d in (([1, 1], "u2"), ([1, 1], "u2"), ([30, 20], "i8"), ([0, 0], "u1")))),
            "decrease at event 2",
        ),
    ],
)
def test_events_outside_the_contract_are_refused(tmp_path, second, message):
    with pytest.raises(EventDataError, match=message):
        with DsecEventWriter(tmp_path / "e.h5", 48, 64) as writer:
            writer.append(one(t=10))
            writer.append(second)


def test_last_representable_microsecond(tmp_path):
    # ms_to_idx of 71 minutes is 4.3 M entries: eventless time must be filled, not skipped.
    with DsecEventWriter(tmp_path / "e.h5", 48, 64) as writer:
        writer.append(one(t=5))
        writer.append(one(t=2**32 - 1))
    with DsecEventReader(tmp_path / "e.h5") as reader:
        assert reader.slice(6, 2**33).t.tolist() == [2**32 - 1]
        assert reader._ms_to_idx[[0, 1, 4294967, 4294968]].tolist() == [0, 1, 1, 2]


def test_error_in_the_background_thread_reaches_the_caller(tmp_path, monkeypatch):
    def full(self, block):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(DsecEventWriter, "_store", full)
    events = random_events(500_000, 1000)
    with pytest.raises(OutputError, match="e.h5: cannot write: no space left"):
        with DsecEventWriter(tmp_path / "e.h5", 48, 64) as writer:
            for _ in range(20):
                writer.append(Events(events.x, events.y, np.full_like(events.t, 1000), events.p))


def test_a_truncated_file_and_none(tmp_path):
    write(tmp_path / "e.h5", random_events(100_000, 1000), chunk_sizes(0))
    (tmp_path / "e.h5").write_bytes((tmp_path / "e.h5").read_bytes()[:-5000])
    with pytest.raises(AssetError, match="truncated HDF5"):
        DsecEventReader(tmp_path / "e.h5")
    with pytest.raises(AssetError, match="no such file"):
        DsecEventReader(tmp_path / "none.h5")
