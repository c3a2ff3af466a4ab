"""Records that somebody else may have written, and names that appear whole or not at all: limits from either side."""

from __future__ import annotations

import errno
import json
import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import TypeAdapter, ValidationError

from blinkgl.errors import AssetError, OutputError
from blinkgl.io import atomic
from blinkgl.io.records import InsidePath, open_regular, read_text
from blinkgl.sequence_files.index import INDEX, read_index, sequence_folders, write_index
from blinkgl.sequence_files.sequence_dir import Manifest, refuse_existing, verify_sequence

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


def test_pipes_and_devices_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    (tmp_path / "file").write_text("x")
    (tmp_path / "good").symlink_to(tmp_path / "file")
    before = len(os.listdir("/proc/self/fd"))
    for path in (tmp_path / "pipe", tmp_path / "link", Path("/dev/null")):
        with pytest.raises(AssetError, match="not a regular file"):
            open_regular(path)
    descriptor = open_regular(tmp_path / "good")
    assert os.read(descriptor, 9) == b"x" and not os.get_inheritable(descriptor)
    os.close(descriptor)
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.parametrize(
    "name, fine",
    [
        ("a", True),
        ("a/b.png", True),
        ("..a/b..", True),
        ("a" * 255, True),
        ("a" * 256, False),
        ("µ" * 127 + "a", True),
        ("µ" * 128, False),
        ("/".join(["a" * 255] * 4), True),
        ("/".join(["a" * 255] * 4) + "/a", False),
        ("", False),
        (".", False),
        ("a/./b", False),
        ("../a", False),
        ("/a", False),
        ("a/", False),
        ("a//b", False),
        ("a\0b", False),
        ("\ud800", False),
    ],
)
def test_paths_that_stay_inside(name, fine):
    model = TypeAdapter(InsidePath)
    if fine:
        assert model.validate_python(name) == name
    else:
        with pytest.raises(ValidationError):
            model.validate_python(name)


# --- what a manifest says ---------------------------------------------------------------------------------------------

WHOLE = {
    "format": "blinkgl-sequence",
    "format_version": 1,
    "height": 1,
    "width": 65536,
    "events": 0,
    "t_offset_us": -(2**62),
    "files": {},
}


@pytest.mark.parametrize(
    "changes, fine",
    [
        ({}, True),
        ({"height": 0}, False),
        ({"height": 65537}, False),
        ({"width": 0}, False),
        ({"width": 65537}, False),
        ({"width": 1.0}, False),
        ({"events": -1}, False),
        ({"events": 2**62}, True),
        ({"events": 2**62 + 1}, False),
        ({"t_offset_us": 2**62}, True),
        ({"t_offset_us": 2**62 + 1}, False),
        ({"t_offset_us": -(2**62) - 1}, False),
        ({"duration_us": -1}, False),
        ({"duration_us": 0}, True),
        ({"duration_us": None}, True),
        ({"seed": 2**63 - 1}, True),
        ({"seed": 2**63}, False),
        ({"seed": -1}, False),
        ({"sequence": -1}, False),
        ({"split": "s" * 255}, True),
        ({"split": "s" * 256}, False),
        ({"emulator": "e" * 256}, False),
        ({"format_version": 2}, False),
        ({"format": "blinkgl"}, False),
        ({"files": {"a": {"bytes": 0, "sha256": "0" * 64}}}, True),
        ({"files": {"a": {"bytes": -1, "sha256": "0" * 64}}}, False),
        ({"files": {"a": {"bytes": 0, "sha256": "0" * 63}}}, False),
        ({"files": {"a": {"bytes": 0, "sha256": "G" * 64}}}, False),
        ({"files": {"../a": {"bytes": 0, "sha256": "0" * 64}}}, False),
        ({"more": [1]}, True),
    ],
)
def test_limits_of_a_manifest(changes, fine):
    if fine:
        assert Manifest.model_validate({**WHOLE, **changes})
    else:
        with pytest.raises(ValidationError):
            Manifest.model_validate({**WHOLE, **changes})


def sequence(folder: Path, **changes) -> Path:
    """A folder that is whole by its manifest: two files."""
    from hashlib import sha256

    (folder / "sub").mkdir(parents=True)
    files = {"a": b"1234", "sub/b": b""}
    for name, data in files.items():
        (folder / name).write_bytes(data)
    said = {name: {"bytes": len(d), "sha256": sha256(d).hexdigest()} for name, d in files.items()}
    (folder / "manifest.json").write_text(json.dumps({**WHOLE, "files": said, **changes}))
    return folder


def test_what_a_whole_sequence_is_not(tmp_path):
    whole = sequence(tmp_path / "s")
    assert verify_sequence(whole) == verify_sequence(whole, checksums=False) == []
    (whole / "a").write_bytes(b"4321")
    (whole / "sub/b").unlink()
    (whole / "x\n").write_bytes(b"")
    (whole / "link").symlink_to("a")
    os.mkfifo(whole / "pipe")
    found = [
        "sub/b: missing",
        "link: a symbolic link",
        "pipe: a special file",
        "sub: an empty folder",
        "x\\n: not in the manifest",
    ]
    assert verify_sequence(whole, checksums=False) == found and verify_sequence(whole) == [
        "a: checksum differs",
        *found,
    ]
    (whole / "a").write_bytes(b"12345")
    assert verify_sequence(whole)[0] == "a: 5 bytes, manifest says 4"
    (whole / "a").unlink()
    (whole / "a").symlink_to("manifest.json")
    assert [line for line in verify_sequence(whole) if line.startswith("a:")] == ["a: a symbolic link"]
    assert verify_sequence(tmp_path / "none") == [f"{tmp_path}/none/manifest.json: no manifest"]


def test_a_name_that_is_taken(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "full/x").mkdir(parents=True)
    (tmp_path / "file").touch()
    (tmp_path / "dangling").symlink_to("nowhere")
    for free in ("none", "empty"):
        refuse_existing(tmp_path / free)
    for name, said in (
        ("full", "output folder exists"),
        ("file", "output path is a file"),
        ("dangling", "output path is"),
    ):
        with pytest.raises(OutputError, match=said):
            refuse_existing(tmp_path / name)


# --- the index --------------------------------------------------------------------------------------------------------


def test_the_index_lists_what_is_whole(tmp_path):
    for name in ("train/b", "train/a", "alone", ".hidden/a", "train/.a", "train/deep/er"):
        sequence(tmp_path / name, seed=3, split="train", events=5)
    sequence(tmp_path / "test/bad", format="?")
    assert [p.relative_to(tmp_path).as_posix() for p in sequence_folders(tmp_path)] == [
        "alone", "test/bad", "train/a", "train/b"
    ]  # fmt: skip
    assert write_index(tmp_path) == 3
    lines = read_index(tmp_path)
    assert [line["path"] for line in lines] == ["alone", "train/a", "train/b"]
    assert lines[1] == {
        "path": "train/a", "name": "a", "split": "train", "seed": 3, "events": 5, "bytes": 4, "height": 1,
        "width": 65536, "t_offset_us": -(2**62), "sequence": None, "emulator": None, "labels": None, "frames": None,
        "duration_us": None, "blinkgl": None,
    }  # fmt: skip
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hidden", "alone", INDEX, "test", "train"]
    assert write_index(tmp_path / "alone") == 1 and read_index(tmp_path / "alone")[0]["path"] == "."
    assert list(sequence_folders(tmp_path / "alone")) == [tmp_path / "alone"]


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


@pytest.mark.parametrize("error, alive", [(ProcessLookupError, False), (PermissionError, True), (OverflowError, None)])
def test_who_is_alive(monkeypatch, error, alive):
    def kill(pid, number):
        assert number == 0
        raise error

    monkeypatch.setattr(atomic.os, "kill", kill)
    if alive is None:
        with pytest.raises(OverflowError):
            atomic._alive(7)
    else:
        assert atomic._alive(7) is alive


@pytest.mark.parametrize(
    "number, folder, file", [(errno.EINVAL, True, False), (errno.ENOTSUP, True, False), (errno.EIO, False, False)]
)
def test_folders_that_cannot_be_synced(tmp_path, monkeypatch, number, folder, file):
    """Some network file systems cannot; a file that cannot is no file."""
    (tmp_path / "a").touch()
    before = len(os.listdir("/proc/self/fd"))

    def fail(descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(atomic.os, "fsync", fail)
    for path, fine in ((tmp_path, folder), (tmp_path / "a", file)):
        if fine:
            atomic.fsync(path)
        else:
            with pytest.raises(OSError):
                atomic.fsync(path)
    assert len(os.listdir("/proc/self/fd")) == before


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


def test_a_file_appears_at_the_end_under_its_own_name(tmp_path):
    final = tmp_path / "new/a.mp4"
    with atomic.atomic_file(final) as path:
        path.write_text("x")
        assert path.parent == final.parent and path.name.startswith(".a.mp4.blinkgl-tmp-") and path.suffix == ".mp4"
        assert f"-{os.getpid()}-" in path.name and atomic._PATTERN.match(path.name)[1] == atomic.machine_token()
    assert final.read_text() == "x" and stat.S_ISREG(final.stat().st_mode)
    with atomic.atomic_file(final) as one, atomic.atomic_file(final) as two:
        assert one != two
        one.write_text("1")
        two.write_text("2")
    assert final.read_text() == "1", "the last to leave"
    with pytest.raises(OutputError, match="a.mp4: full") as caught, atomic.atomic_file(final) as path:
        raise OutputError("full", where=str(path), accepted="more")
    assert caught.value.where == str(final) and caught.value.accepted == "more"
    with pytest.raises(OutputError, match="other: full"), atomic.atomic_file(final):
        raise OutputError("full", where="other")
    with pytest.raises(OutputError, match="a.mp4: cannot write: no such file"), atomic.atomic_file(final):
        pass  # nothing was written
    assert final.read_text() == "1" and [p.name for p in final.parent.iterdir()] == ["a.mp4"]
