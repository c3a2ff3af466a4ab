"""Records that somebody else may have written, and names that appear whole or not at all: limits from either side."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys

import pytest

from blinkgl.errors import AssetError, OutputError
from blinkgl.io import atomic
from blinkgl.io.records import read_text
from blinkgl.sequence_files.index import INDEX, read_index

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
