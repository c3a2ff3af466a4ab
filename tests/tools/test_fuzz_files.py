"""The fuzz of file formats: a short seeded run over all of them, and that it finds what it is there to find."""

from __future__ import annotations

import errno
import json
import mmap
import os
import signal
import time

import numpy as np
import pytest

from blinkgl.errors import AssetError
from blinkgl.tools import fuzz_files, fuzz_mutators
from blinkgl.tools.fuzz_files import CRASH, HANG, MEMORY, OK, REFUSED, TRACEBACK, WRONG, Limits, fuzz
from blinkgl.tools.fuzz_formats import FORMATS, Format

SHORT = (
    "events text",
    "events dsec",
    "events mvsec",
    "events npz",
    "events evt3",
    "events aedat2",
    "flow png dsec",
    "flow npy",
    "frames png",
    "frames pfm",
    "frames npz",
    "mesh obj mtl and image",
    "mesh ply",
    "scene gltf",
    "scene glb",
    "texture hdr",
    "dataset manifest",
    "yaml explicit scene",
    "checkpoint weights",
)
"""One of every kind; a format costs its imports and compiled kernels, a mutant next to nothing."""


def run(*arguments) -> int:
    """In a process of its own: this one has threads, which cannot be forked."""
    import subprocess
    import sys

    return subprocess.run(
        [sys.executable, "-m", "blinkgl.tools.fuzz_files", *map(str, arguments)], capture_output=True, text=True
    )


def test_no_format_has_a_defect(tmp_path):
    names = [f.name for f in FORMATS if f.available and f.name in SHORT]
    result = run("--mutants", 25, "--seed", 3, "--json", tmp_path / "r.json", "--formats", *names)
    report = json.loads((tmp_path / "r.json").read_text())
    assert [r["format"] for r in report["reports"]] == names, result.stderr
    assert result.returncode == 0, result.stdout
    assert all(r["mutants"] == 25 for r in report["reports"])


def _judge(how: str, folder):
    data = (folder / "a").read_bytes()
    if data == b"whole":
        return None
    if how == "refused":
        raise AssetError("not whole", where="a")
    if how == "wrong":
        return "not whole"
    if how == "traceback":
        raise ZeroDivisionError
    if how == "nameless":
        raise AssetError("not whole")
    if how == "lines":
        raise PermissionError(errno.EACCES, "", "a\nfile")
    if how == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if how == "exit":
        os._exit(0)
    if how == "spin":
        while True:
            pass
    if how == "sleep":
        time.sleep(60)
    if how == "memory":
        mmap.mmap(-1, 40 << 20).write(bytes(40 << 20))  # pages of its own: the heap may have as much lying about
    return None


EXPECTED = {
    "ok": OK,
    "refused": REFUSED,
    "wrong": WRONG,
    "traceback": TRACEBACK,
    "nameless": WRONG,
    "lines": WRONG,
    "crash": CRASH,
    "exit": CRASH,
    "spin": HANG,
    "sleep": HANG,
    "memory": MEMORY,
}


def _make(folder):
    (folder / "a").write_bytes(b"whole")
    return ["a"]


def _break(rng, data):
    return b"broken" + rng.bytes(2)


@pytest.mark.parametrize("how", EXPECTED)
def test_every_outcome_is_told_apart_and_survived(tmp_path, how):
    made_up = Format("made up", _make, lambda folder: _judge(how, folder), (_break,))
    report = fuzz(
        made_up, 2, limits=Limits(cpu_s=0, wall_s=0.5 if how == "sleep" else 60.0, memory_mb=16), out=tmp_path
    )
    assert report.mutants == 2 and report.outcomes == {EXPECTED[how]: 2}
    kept = sorted(p.parent.name for p in tmp_path.glob("*/a"))
    if EXPECTED[how] in (OK, REFUSED):
        assert not report.defects and not kept
    else:
        (found,) = report.defects.values()
        assert (
            found["count"] == 2
            and found["mutants"] == [0, 1]
            and '--formats "made up" --seed 0 --only 0' in found["repeat"]
        )
        assert kept == ["made_up-0", "made_up-1"] and (tmp_path / "made_up-0/a").read_bytes().startswith(b"broken")


def test_the_same_seed_makes_the_same_mutants(tmp_path):
    fmt = next(f for f in FORMATS if f.name == "events dsec")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    a, b = (fuzz_files._Task(fmt, tmp_path / k, 0, Limits()) for k in "ab")
    mutants = [a.mutant(i) for i in range(40)]
    assert mutants == [b.mutant(i) for i in range(40)]
    assert len({data for _, data, _ in mutants}) > 35 and {name for _, _, name in mutants} >= {
        "hdf5_objects",
        "fields",
        "flip_bits",
    }


def test_mutators_change_what_they_are_given():
    rng = np.random.default_rng(0)
    data = bytes(range(256)) * 4
    for mutate in {*fuzz_mutators.BLIND, *fuzz_mutators.TEXT, fuzz_mutators.fixed((0, "<I"), (4, "<d"))}:
        assert sum(mutate(rng, data) != data for _ in range(20)) >= 12, mutate
        for short in (b"", b"a"):
            mutate(rng, short)
