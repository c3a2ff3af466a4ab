"""AEDAT4 without the library: what the reader makes of batches, and of a decoder that ends too early."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest

from blinkgl.errors import AssetError, EventDataError, OutputError
from blinkgl.io import aedat4
from blinkgl.io.aedat4 import Aedat4Reader
from blinkgl.io.formats import open_events, write_events
from blinkgl.types.events import Events

LIBRARY = """
import os
import numpy as np
class EventStore(list):
    def push_back(self, t, x, y, p):
        self.append((t, x, y, p))
ROW = np.dtype([("timestamp", "<i8"), ("x", "<i2"), ("y", "<i2"), ("polarity", "u1")])
class io:
    class MonoCameraWriter:
        written = []
        EventOnlyConfig = staticmethod(lambda name, size: size)
        def __init__(self, path, size):
            if size == (1, 1):
                raise RuntimeError("no  such\\n stream")
            self.written.append((os.path.basename(path).split(".")[1], size))
        def writeEvents(self, store):
            if len(store) == 5:
                raise RuntimeError("full")
            self.written.append(list(store))
    class MonoCameraRecording:
        def __init__(self, path):
            self.counts = [int(n) for n in open(path).read().split()[1:]]
            self.at = 0
        def isEventStreamAvailable(self):
            return self.counts != [0]
        def getEventResolution(self):
            return 640, 480
        def getNextEventBatch(self):
            if not self.counts:
                return None
            n, self.at = self.counts.pop(0), self.at
            if n == 99:
                os._exit(1)
            if n == 98:
                raise RuntimeError("packet  is\\n odd")
            a = np.zeros(n, ROW)
            a["timestamp"] = 10 * (self.at + np.arange(n))
            a["x"], a["y"], a["polarity"] = self.at + np.arange(n), 7, np.arange(n) % 2
            self.at += n
            batch = lambda: None
            batch.numpy = lambda: a
            return batch
"""


@pytest.fixture
def recording(tmp_path, monkeypatch):
    """A file of batches of so many events, by a library of our own."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: True)
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)  # it would hide that the decoder keeps something back
    (tmp_path / "dv_processing.py").write_text(LIBRARY)
    monkeypatch.syspath_prepend(tmp_path)

    def written(*counts: int):
        (tmp_path / "e.aedat4").write_bytes(b"#!AER-DAT4.0\r\n" + " ".join(map(str, counts)).encode())
        return tmp_path / "e.aedat4"

    before, library = len(os.listdir("/proc/self/fd")), sys.modules.pop("dv_processing", None)
    yield written
    sys.modules.pop("dv_processing", None)  # ours
    if library is not None:
        sys.modules["dv_processing"] = library
    assert len(os.listdir("/proc/self/fd")) == before, "the decoder's pipe stayed open"


def test_batches_are_joined_to_about_a_size(recording):
    with open_events(recording(3, 0, 2, 4)) as file:
        assert (file.format, file.height, file.width) == ("aedat4", 480, 640)
        events = file.read()
    assert events.t.tolist() == list(range(0, 90, 10)) and events.x.tolist() == list(range(9))
    assert events.p.tolist() == [0, 1, 0, 0, 1, 0, 1, 0, 1] and (events.y == 7).all()
    for size, pieces in ((5, [5, 4]), (6, [9])):
        reader = Aedat4Reader(recording(3, 0, 2, 4))
        assert [len(e) for e in reader.chunks(size)] == pieces
    assert [len(e) for e in reader.chunks(1)] == [3, 2, 4], "read once more"
    reader.close()
    reader.close()


@pytest.mark.parametrize("counts, read", [((3, 99), 3), ((2, 2, 99), 4)])
def test_a_decoder_that_ends_too_early(recording, counts, read):
    reader, found = Aedat4Reader(recording(*counts)), []
    with pytest.raises(AssetError, match="e.aedat4: damaged AEDAT4 file: dv-processing crashed on it"):
        for events in reader.chunks(1):
            found.append(len(events))
    assert sum(found) == read
    with pytest.raises(AssetError, match="damaged AEDAT4 file: packet is odd"):
        list(Aedat4Reader(recording(2, 98)).chunks())
    with pytest.raises(AssetError, match="e.aedat4: no events in the recording"):
        Aedat4Reader(recording(0))


def test_what_is_no_recording(recording, tmp_path, monkeypatch):
    (tmp_path / "n.aedat4").write_bytes(b"#!AER-DAT3")
    with pytest.raises(AssetError, match="not an AEDAT4 file: wrong magic"):
        open_events(tmp_path / "n.aedat4")
    with pytest.raises(AssetError, match="cannot read: Is a directory"):
        Aedat4Reader(tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(AssetError, match="AEDAT4 needs dv-processing, which is not installed; .*pip install"):
        open_events(recording(3))
    monkeypatch.setitem(sys.modules, "dv_processing", None)
    with pytest.raises(OutputError, match="AEDAT4 needs dv-processing"):
        write_events(tmp_path / "w.aedat4", some([1]), 2, 2)
    assert not (tmp_path / "w.aedat4").exists()


def some(t) -> Events:
    n = len(t)
    return Events(np.arange(n, dtype=np.uint16), np.ones(n, np.uint16), np.array(t, np.int64), np.uint8(n * [1]))


def test_what_is_written(recording, tmp_path):
    path = tmp_path / "w.aedat4"
    assert write_events(path, [some([1, 2]), Events.empty(), some([2])], 32767, 32767) == 3
    import dv_processing

    log = dv_processing.io.MonoCameraWriter.written
    assert log == [("w", (32767, 32767)), [(1, 0, 1, True), (2, 1, 1, True)], [(2, 0, 1, True)]]
    for height, width, events, error, said in (
        (32768, 3, [some([1])], EventDataError, "15-bit coordinates"),
        (3, 32768, [some([1])], EventDataError, "15-bit coordinates"),
        (1, 1, [some([1])], OutputError, "cannot write: no such stream"),
        (9, 9, [some([1, 2, 3, 4, 5])], OutputError, "cannot write: full"),
        (9, 9, [some([1, 5]), some([4])], EventDataError, "backwards at event 2"),
        (9, 1, [some([1, 5])], EventDataError, "event 1 is outside the sensor"),
    ):
        with pytest.raises(error, match=said):
            write_events(tmp_path / "n.aedat4", events, height, width)
    assert not (tmp_path / "n.aedat4").exists()


def test_positions_are_counted_from_the_file_s_first_event(recording, monkeypatch):
    """x is as large as the number of the event here, so that event 640 is the first outside."""
    with pytest.raises(EventDataError, match=r"event 640 is outside the sensor .got \(640, 7\)"):
        open_events(recording(600, 100)).read()
    monkeypatch.setattr(aedat4, "events_of", lambda x, y, t, p, where, first: (_ for _ in ()).throw(KeyError(first)))
    with pytest.raises(KeyError, match="^0$"):
        next(Aedat4Reader(recording(3, 4)).chunks())
