"""HDF5 files are not followed out of themselves, their data sets are checked before they are
believed, and nothing of the process changes."""

from __future__ import annotations

import errno
import itertools
import signal
import struct
import subprocess
import sys

import h5py
import hdf5plugin
import numpy as np
import pytest

from blinkgl.errors import AssetError, BlinkGLError, OutputError
from blinkgl.io import atomic
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.formats import open_events
from blinkgl.io.hdf5 import dataset, growing_dataset, open_hdf5, write_rows
from blinkgl.io.records import read_text
from blinkgl.sequence_files.index import INDEX, read_index
from eflow.data.sources import read_rectify_map
from tests.io.test_columns import dsec, mvsec


def external_storage(file, name, secret):
    file.create_dataset(name, (100,), np.uint8, external=[(str(secret), 0, 100)])


def external_link(file, name, secret):
    file[name] = h5py.ExternalLink(str(secret), "/x")


def virtual(file, name, secret):
    layout = h5py.VirtualLayout((3,), "u2")
    layout[:] = h5py.VirtualSource(str(secret), "x", (3,))
    file.create_virtual_dataset(name, layout)


def link_in_a_group(file, name, secret):
    """Not read by anybody, but a soft link may lead there."""
    file["deep/er/x"] = h5py.ExternalLink(str(secret), "/x")
    file[name] = h5py.SoftLink("/deep/er/x")


@pytest.mark.parametrize(
    "how, message",
    [
        (external_storage, "a data set with external storage"),
        (external_link, "an external link"),
        (virtual, "a virtual data set"),
        (link_in_a_group, "an external link"),
    ],
)
@pytest.mark.parametrize("kind", ["dsec", "mvsec", "rectify_map"])
def test_files_that_lead_elsewhere_are_refused(tmp_path, how, message, kind):
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(range(100)))
    path = tmp_path / "e.h5"
    if kind == "rectify_map":
        with h5py.File(path, "w") as file:
            how(file, "rectify_map", secret)
        read = lambda: read_rectify_map(path)
    else:
        (dsec if kind == "dsec" else mvsec)(path)
        with h5py.File(path, "r+") as file:
            name = "events/x" if kind == "dsec" else "davis/left/events"
            del file[name]
            how(file, name, secret)
        read = lambda: open_events(path).read()
    with pytest.raises(AssetError, match=rf"e.h5: '.*' is {message}, which refers to other files; refused"):
        read()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"t_offset": np.zeros(3, int)}, r"'t_offset' has the wrong shape or type \(got 'int64 \(3,\)'\)"),
        ({"t_offset": "late"}, "'t_offset' has the wrong"),
        ({"t_offset": h5py.Empty("i8")}, "'t_offset' has the wrong"),
        ({"t_offset": None}, "no dataset 't_offset'"),
        ({"t_offset": 1 << 62}, "t of event"),
        ({"ms_to_idx": np.zeros((2, 2), int)}, "'ms_to_idx' has the wrong"),
        ({"ms_to_idx": np.zeros(2)}, "'ms_to_idx' has the wrong"),
        ({"ms_to_idx": None}, "no dataset 'ms_to_idx'"),
        ({"events/x": None}, "no dataset 'events/x'"),
        ({"events/p": np.zeros((3, 1), int)}, "'events/p' has the wrong"),
        ({"events/x": np.zeros(3)}, "'events/x' has the wrong"),
        ({"events/x": np.zeros(4, int)}, "differ in length"),
        ({"events/y": np.zeros(3, [("a", "i4")])}, "'events/y' has the wrong"),
    ],
)
def test_dsec_data_sets_of_wrong_shape_or_type(tmp_path, change, message):
    with h5py.File(dsec(tmp_path / "e.h5"), "r+") as file:
        for name, value in change.items():
            if name in file:
                del file[name]
            file.create_group(name) if value is None else file.create_dataset(name, data=value)
    with pytest.raises(BlinkGLError, match=message), DsecEventReader(tmp_path / "e.h5") as reader:
        list(reader.chunks())


def test_claims_without_data(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("chunked", (10**12,), "u8", chunks=(1 << 17,), compression="gzip")
        file.create_dataset("plain", (10**12,), "u8")
        file.create_dataset("chunk", (1 << 29,), "u8", chunks=(1 << 26,), compression="gzip")
        file.create_dataset("filled", (10**9,), "u8", chunks=(1 << 17,), fillvalue=7)
        file.create_dataset("none", (0,), "u8", maxshape=(None,))
        file["one"] = np.uint64(5)
    with open_hdf5(tmp_path / "a.h5") as file:
        for name, message in (
            ("chunked", "declares 1000000000000 values, but stores fewer"),
            ("plain", "but stores fewer"),
            ("chunk", "chunks that are too large"),
            ("filled", "but stores fewer"),
        ):
            with pytest.raises(AssetError, match=message):
                dataset(file, name, tmp_path / "a.h5", shape=(None,))
        assert (
            len(dataset(file, "none", tmp_path / "a.h5", shape=(None,))) == 0
            and dataset(file, "one", tmp_path / "a.h5", shape=())[()] == 5
        )


@pytest.mark.parametrize("chunks", [None, (2, 2)])
def test_a_value_that_the_file_states_for_what_it_does_not_store_is_read(tmp_path, chunks):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("flow", (3, 4), "i8", fillvalue=-2, chunks=chunks)
    with open_hdf5(tmp_path / "a.h5") as file:
        assert (dataset(file, "flow", tmp_path / "a.h5", shape=(3, 4))[:] == -2).all()


def test_a_filter_that_is_not_installed_is_named(tmp_path):
    path = dsec(tmp_path / "e.h5")
    with h5py.File(path, "r+") as file:
        del file["events/x"]
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((3,))
        layout.set_filter(40000, h5py.h5z.FLAG_OPTIONAL, ())
        space = h5py.h5s.create_simple((3,))
        made = h5py.h5d.create(file["events"].id, b"x", h5py.h5t.STD_U16LE, space, layout)
        made.write_direct_chunk((0,), np.zeros(3, np.uint16).tobytes())
    with pytest.raises(AssetError, match="packed by an HDF5 filter that is not run here .*expected gzip"):
        open_events(path).read()


def test_blosc_without_its_parameters_does_not_crash(tmp_path):
    """Found by the fuzz: the filter reads them without asking how many there are."""
    path = tmp_path / "m.h5"
    with h5py.File(path, "w") as file:
        write_rows(growing_dataset(file, "d", (0,), np.float32, (64,)), 0, np.zeros(64, np.float32))
    data = bytearray(path.read_bytes())
    at = data.find(struct.pack("<H", hdf5plugin.Blosc.filter_id))
    assert struct.unpack_from("<HH", data, at + 4) == (1, 7)  # optional, seven parameters
    data[at + 6] = 0
    path.write_bytes(data)
    with (
        open_hdf5(path) as file,
        pytest.raises(AssetError, match="m.h5: damaged HDF5 file: dataset 'd' lacks data that Blosc needs"),
    ):
        dataset(file, "d", path, shape=(64,), kinds="f")


def test_a_list_for_an_attribute_is_not_read(tmp_path):
    """A flipped bit makes one of a text, and h5py ends the process."""
    path = dsec(tmp_path / "e.h5")
    with h5py.File(path, "r+") as file:
        file.attrs.pop("height", None)
        value = np.empty((), object)
        value[()] = np.arange(3, dtype=np.int8)
        file.attrs.create("height", value, dtype=h5py.vlen_dtype(np.int8))
    with pytest.raises(AssetError, match="e.h5: attribute 'height' holds neither numbers nor text"):
        open_events(path)


def test_rows_written_here_are_those_of_the_filter(tmp_path):
    """Byte for byte what h5py writes through HDF5's filter with one thread, incompressible
    chunks and partial ones included."""
    rng = np.random.default_rng(0)
    rows = np.concatenate([rng.integers(0, 50, 9000), rng.integers(0, 2**63, 4096), np.zeros(500, int)]).astype(
        np.uint64
    )
    cuts = [0, 10, 4096, 5000, 12_000, len(rows)]
    for name in "ab":
        with h5py.File(tmp_path / name, "w", rdcc_nbytes=0) as file:
            data = growing_dataset(file, "d", (0,), np.uint64, (4096,))
            for i, j in itertools.pairwise(cuts):
                if name == "a":
                    write_rows(data, i, rows[i:j])
                else:
                    data.resize((j,))
                    data[i:j] = rows[i:j]
            np.testing.assert_array_equal(data[()], rows)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


# --- Records that somebody else may have written, and names that appear whole or not at all: limits from either
# side.

# --- text and names ---------------------------------------------------------------------------------------------------


def test_text_up_to_a_limit(tmp_path):
    path = tmp_path / "a"
    path.write_bytes("µ12".encode())
    assert read_text(path, 4) == "µ12" == read_text(path)
    with pytest.raises(AssetError, match=r"a: too large; expected at most 3 bytes"):
        read_text(path, 3)
    path.write_bytes(b"\xff")
    for bad in (path, tmp_path / "a\0b"):
        with pytest.raises(AssetError, match="not a text file in UTF-8"):
            read_text(bad)
    with pytest.raises(FileNotFoundError):
        read_text(tmp_path / "none")
    with pytest.raises(AssetError, match="not a regular file"):
        read_text(tmp_path)
    with pytest.raises(AssetError, match="a/b: cannot be read: Not a directory"):
        read_text(path / "b")


# --- the index --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, said",
    [
        ('{"path": "a"}\n\n{"path": "b"}\n', None),
        ('{"path": "a"}\n{"path": "a"}\n', "damaged index: a is listed twice; run 'blinkgl report'"),
        ('{"path": "../a"}\n', "damaged index: path: not a path inside the folder"),
        ('{"name": "a"}\n', "damaged index: path: field required"),
        ("{\n", "damaged index: not JSON"),
        (None, "no such file"),
    ],
)
def test_an_index_that_cannot_be_used(tmp_path, text, said):
    if text is not None:
        (tmp_path / INDEX).write_text(text)
    if said is None:
        assert [line["path"] for line in read_index(tmp_path)] == ["a", "b"]
        return
    with pytest.raises(AssetError) as caught:
        read_index(tmp_path)
    assert said in str(caught.value)


# --- names that appear at the end -------------------------------------------------------------------------------------


def test_looking_for_the_dead_harms_nobody(tmp_path):
    """Signal 0 asks, any other tells."""
    alive = subprocess.Popen([sys.executable, "-ISc", "input()"], stdin=subprocess.PIPE)
    name = f".x.blinkgl-tmp-{atomic.machine_token()}-{alive.pid}-0.h5"
    (tmp_path / name).touch()
    (tmp_path / name.replace("-0.h5", "-1")).mkdir()
    assert atomic.remove_stale(tmp_path) == [] and alive.poll() is None
    alive.stdin.close()
    assert alive.wait() != -signal.SIGHUP
    assert sorted(p.name for p in atomic.remove_stale(tmp_path)) == sorted([name, name.replace("-0.h5", "-1")])
    assert list(tmp_path.iterdir()) == [] and atomic.remove_stale(tmp_path / "none") == []


@pytest.mark.parametrize(
    "error, said",
    [
        (OSError(errno.ENOSPC, "x"), "no space left on the device"),
        (OSError(errno.EACCES, "x"), "permission denied"),
        (OSError("write failed (errno = 28, something)"), "no space left on the device"),
        (OSError("write failed (errno = 13, something)"), "permission denied"),
        (OSError("12 requested and 3 written"), "no space left on the device"),
        (OSError("Not enough free space"), "no space left on the device"),
        (OSError("odd\n  words"), "odd words"),
    ],
)
def test_why_it_cannot_be_written(error, said):
    with pytest.raises(OutputError) as caught, atomic.output_errors("f"):
        raise error
    assert str(caught.value) == f"f: cannot write: {said}"
    with pytest.raises(KeyError), atomic.output_errors("f"):
        raise KeyError
