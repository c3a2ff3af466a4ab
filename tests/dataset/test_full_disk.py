"""A disk that is full at any instant: one line, exit status 2, nothing half, and the same bytes once there is space.
The disk is a tmpfs, which Linux keeps to its size."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.errors import OutputError
from blinkgl.io.dsec import DsecEventWriter
from blinkgl.types.events import Events
from runs import NAMES, recipe_file, temporaries, tree

PAGE = 4096


@pytest.fixture
def small_disk(tmp_path):
    """A file system of a megabyte; sizes are changed by :func:`resized`."""
    mount = tmp_path / "disk"
    mount.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", mount], capture_output=True, text=True)
    if made.returncode:
        pytest.skip(f"this machine does not let tests mount a small disk: {made.stderr.strip()}")
    yield mount
    subprocess.run(["umount", mount], check=True)


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    assert run(["generate", str(recipe_file(folder)), "--out", str(folder / "out"), "--quiet"]) == 0
    return folder / "out"


def resized(disk: Path, size: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={max(size, PAGE)}", disk], check=True)


def leave_pages(disk: Path, pages: int) -> None:
    now = os.statvfs(disk)
    resized(disk, (now.f_blocks - now.f_bfree + pages) * now.f_frsize)


def refused(capsys) -> str:
    """The line of a command that met the full disk."""
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("error: ") and "no space left on the device" in error, error
    return error


def without_index(out: Path) -> dict[str, str]:
    return {name: digest for name, digest in tree(out).items() if name != "index.jsonl"}


def test_full_disk_stops_the_run_and_a_larger_one_goes_on(reference, small_disk, tmp_path, capsys):
    recipe, out = recipe_file(tmp_path), small_disk / "out"
    # Small files take a page each.
    pages = sum(-(-p.stat().st_size // PAGE) for p in reference.rglob("*") if p.is_file())
    # Four of six, two at work.
    resized(small_disk, pages * 2 // 3 * PAGE)
    assert run(["generate", str(recipe), "--out", str(out), "--workers", "2", "--quiet"]) == 2
    assert "--resume" in refused(capsys)
    assert temporaries(out) == [] and 0 < sum((out / name).is_dir() for name in NAMES) < 6
    resized(small_disk, 1 << 26)
    assert run(["generate", str(recipe), "--out", str(out), "--resume", "--quiet"]) == 0
    assert without_index(out) == without_index(reference)


# The run's records, the first file of a sequence, its pictures, its events, its end; the second sequence.
@pytest.mark.parametrize("pages", [1, 2, 4, 5, 12, 64, 80])
def test_every_instant_of_a_run(reference, small_disk, tmp_path, capsys, pages):
    line = ["generate", str(recipe_file(tmp_path)), "--out", str(small_disk / "out"), "--resume", "--quiet"]
    resized(small_disk, pages * PAGE)
    for _ in range(2):  # the second time, too
        assert run(line) == 2
        refused(capsys)
        assert temporaries(small_disk / "out") == []
    resized(small_disk, 1 << 26)
    assert run(line) == 0
    assert without_index(small_disk / "out") == without_index(reference)


@pytest.fixture
def kept(reference, small_disk) -> Path:
    """A copy of the data set on the small disk."""
    resized(small_disk, 1 << 26)
    return shutil.copytree(reference, small_disk / "out")


@pytest.mark.parametrize("pages", [0, 1])
def test_the_index(reference, small_disk, kept, tmp_path, capsys, pages):
    line = ["generate", str(recipe_file(tmp_path)), "--out", str(kept), "--resume", "--quiet"]
    (kept / "index.jsonl").unlink()
    leave_pages(small_disk, pages)
    assert run(line) == 2 and "index.jsonl" in refused(capsys)
    resized(small_disk, 1 << 26)
    assert run(line) == 0
    assert without_index(kept) == without_index(reference) and (kept / "index.jsonl").is_file()


@pytest.mark.parametrize("pages", range(4))
def test_drop(reference, small_disk, kept, tmp_path, capsys, pages):
    """It takes nothing away that it could not record, and neither does its undoing."""
    leave_pages(small_disk, pages)
    assert run(["drop", str(kept), NAMES[1]]) == 2
    refused(capsys)
    assert without_index(kept) == without_index(reference)
    resized(small_disk, 1 << 26)
    assert run(["drop", str(kept), NAMES[1]]) == 0 and not (kept / NAMES[1]).exists()
    leave_pages(small_disk, min(pages, 1))
    assert run(["drop", str(kept), "--undo", NAMES[1]]) == 2
    resized(small_disk, 1 << 26)
    assert run(["drop", str(kept), "--undo", NAMES[1]]) == 0
    assert run(["generate", str(recipe_file(tmp_path)), "--out", str(kept), "--resume", "--quiet"]) == 0
    assert without_index(kept) == without_index(reference)


@pytest.mark.parametrize("layout", ["webdataset", "dsec", "blinkflow", "mvsec", "intervals"])
def test_exports(reference, small_disk, capsys, layout):
    """Also those whose files HDF5 writes, which on a full disk are damaged without an error, or end the process."""
    line = ["export", str(reference), "--out", str(small_disk / "x"), "--layout", layout]
    for size in (PAGE, 20 * PAGE, 120 * PAGE):
        resized(small_disk, size)
        assert run(line) == 2 and str(small_disk / "x/") in refused(capsys)
        assert list(small_disk.iterdir()) == []
    resized(small_disk, 1 << 26)
    assert run(line) == 0


def test_the_end_of_a_file_of_events(small_disk):
    """HDF5 writes its tables as it closes the file."""
    rng, count, path = np.random.default_rng(0), 60_000, small_disk / "events.h5"
    x, y, p = (rng.integers(0, n, count) for n in (64, 48, 2))
    t = np.sort(rng.integers(0, 200_000, count))

    def written() -> bytes:
        with DsecEventWriter(path, 48, 64) as writer:
            writer.append(Events(x=x.astype(np.uint16), y=y.astype(np.uint16), t=t, p=p.astype(np.uint8)))
        return path.read_bytes()

    whole, refusals = written(), 0
    for pages in range(-4, 4):
        path.unlink()
        resized(small_disk, (-(-len(whole) // PAGE) + pages) * PAGE)
        try:
            assert written() == whole
        except OutputError as error:
            refusals += 1
            assert "no space left on the device" in str(error)
    assert 0 < refusals < 8
