"""Nothing stays open: not after the end, not after an error, not when somebody stops reading in the middle."""

from __future__ import annotations

import gc
import os
import threading

import numpy as np
import pytest

from blinkgl.errors import BlinkGLError
from blinkgl.io import atomic
from blinkgl.io.atomic import atomic_file, is_temporary, machine_token, remove_stale
from blinkgl.io.formats import event_writer, open_events
from blinkgl.types.events import Events

FILES = {
    "dsec": "e.h5",
    "evt3": "e.raw",
    "text": "e.txt",
    "csv": "e.csv",
    "npz": "e.npz",
    "npy": "e.npy",
}


def some(n=5, t0=0) -> Events:
    k = np.arange(n)
    return Events(k.astype(np.uint16), k.astype(np.uint16), t0 + 10 * k, (k % 2).astype(np.uint8))


def held() -> tuple[int, set[str]]:
    """Open files of this process, and the threads that are not the interpreter's or a pool's for ever."""
    return len(os.listdir("/proc/self/fd")), {t.name for t in threading.enumerate()}


@pytest.fixture(autouse=True)
def nothing_stays():
    gc.disable()  # what is only forgotten shall not look like what is closed
    before = held()
    yield
    after = held()
    gc.enable()
    assert after[0] == before[0] and after[1] <= before[1], after[1] - before[1]


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("how", ["whole", "error", "refused"])
def test_writers(tmp_path, kind, how):
    path, writer = tmp_path / FILES[kind], None
    try:
        with event_writer(path, 8, 8) as writer:
            writer.append(some())
            if how == "error":
                raise KeyError
            if how == "refused":
                writer.append(some(t0=-1000))
    except (KeyError, BlinkGLError):
        assert how != "whole"
    assert writer is not None and [p.name for p in tmp_path.iterdir()] == ([path.name] if how == "whole" else [])
    if how == "whole":
        assert open_events(path).read().t.tolist() == some().t.tolist()
    for again in (writer.abort, writer.abort):
        again()


def test_a_name_as_long_as_the_file_system_takes_is_written(tmp_path):
    for name in ("a" * 251 + ".npz", "ü" * 120 + ".npz", "b" * 40 + ".npz"):
        with atomic_file(tmp_path / name) as temporary:
            assert is_temporary(temporary.name) and len(temporary.name.encode()) <= 255
            temporary.write_bytes(b"x")
        assert (tmp_path / name).read_bytes() == b"x"


def test_leftovers_that_may_not_be_deleted_stop_nobody(tmp_path, monkeypatch):
    """Of another user's dead process, in a folder where only owners may delete."""
    left = tmp_path / f".x.npz.blinkgl-tmp-{machine_token()}-999999999-0.npz"
    left.write_bytes(b"")

    def refused(path):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(atomic, "_remove", refused)
    assert remove_stale(tmp_path) == [] and left.exists()
    with atomic_file(tmp_path / "mine.npz") as temporary:
        temporary.write_bytes(b"x")
