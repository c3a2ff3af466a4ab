"""Nothing stays open: not after the end, not after an error, not when somebody stops reading in the middle."""

from __future__ import annotations

import gc
import os
import threading

import cv2
import numpy as np
import pytest

from blinkgl.errors import BlinkGLError
from blinkgl.io.dsec import DsecEventReader, DsecEventWriter
from blinkgl.io.formats import event_writer, open_events, write_events
from blinkgl.io.frames import open_frames
from blinkgl.io.video import VideoReader, VideoWriter
from blinkgl.sequence_files.sequence_dir import SequenceWriter
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


@pytest.mark.parametrize("kind", FILES)
def test_readers(tmp_path, kind):
    """To the end, and only to the first event; closed once more; of a file that is cut."""
    path = tmp_path / FILES[kind]
    write_events(path, some(), 8, 8)
    with open_events(path) as file:
        assert len(file.read()) == 5
        chunks = file.chunks()
        assert len(next(chunks)) > 0
        chunks.close()
    file.close()
    path.write_bytes(path.read_bytes()[:-3])
    damaged = None
    try:
        damaged = open_events(path)
        damaged.read()
    except BlinkGLError:
        pass
    if damaged is not None:
        damaged.close()


def test_the_writer_of_dsec_ends_its_thread(tmp_path):
    for end in ("close", "abort"):
        writer = DsecEventWriter(tmp_path / end, 8, 8)
        writer.append(some())
        assert "dsec-writer" in held()[1]
        getattr(writer, end)()
        getattr(writer, end)()
    with DsecEventReader(tmp_path / "close") as reader:
        assert len(reader.slice(0, 1000)) == 5
    reader.close()


@pytest.mark.parametrize("fails", [False, True])
def test_a_sequence_ends_its_threads(tmp_path, fails):
    try:
        with SequenceWriter(tmp_path / "s", 8, 8, config_yaml="") as writer:
            writer.append_events(some())
            for k in range(20):  # more than wait for the encoder at once
                writer.label("depth", k, np.ones((8, 8), np.float32), k)
            if fails:
                raise KeyError
    except KeyError:
        assert fails
    assert (tmp_path / "s").exists() is not fails and len(list(tmp_path.iterdir())) == (not fails)


def test_videos_and_folders_of_frames(tmp_path):
    frame = np.full((32, 48, 3), 90, np.uint8)
    video = VideoWriter(tmp_path / "v.mp4", 32, 48, 25)
    for _ in range(4):
        video.write(frame)
    video.close()
    aborted = VideoWriter(tmp_path / "w.mp4", 32, 48, 25)
    aborted.write(frame)
    aborted.abort()
    reader = VideoReader(tmp_path / "v.mp4")
    stopped = iter(reader)
    next(stopped)
    stopped.close()
    assert len(list(reader)) == 4
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), frame)
    np.savez(tmp_path / "a.npz", frames=np.ones((3, 4, 4)))
    for source in (open_frames(tmp_path, fps=1), open_frames(tmp_path / "a.npz", fps=1)):
        frames = iter(source)
        next(frames)
        frames.close()
        assert len(list(source)) == 3
