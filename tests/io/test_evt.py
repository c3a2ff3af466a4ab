"""EVT2 and EVT3 words against decoders and encoders in plain Python, written from the formats' pages."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.evt import EvtReader, EvtWriter
from blinkgl.io.formats import open_events
from blinkgl.io.reading import EventReading
from blinkgl.types.events import Events

WORD = {"evt2": "<u4", "evt3": "<u2"}


def decoded(path, version: str, words, block: int = 1 << 17, header: bytes = b"") -> list[tuple[int, int, int, int]]:
    path.write_bytes(
        b"% evt " + version[-1].encode() + b".0\n" + header + b"% end\n" + np.array(words, WORD[version]).tobytes()
    )
    return [
        row
        for e in EvtReader(path).chunks(block)
        for row in zip(e.x.tolist(), e.y.tolist(), e.t.tolist(), e.p.tolist())
    ]


def slow_evt2(words) -> list[tuple[int, int, int, int]]:
    rows, high, turns = [], None, 0
    for word in words:
        kind, rest = divmod(word, 1 << 28)
        if kind == 8:
            turns += high is not None and high - rest > 2**27
            high = rest
        elif kind < 2 and high is not None:
            rows.append((rest // 2**11 % 2**11, rest % 2**11, (turns * 2**28 + high) * 64 + rest // 2**22, kind))
    return rows


def slow_evt3(words) -> list[tuple[int, int, int, int]]:
    rows, high, turns, row, low, base, polarity = [], None, 0, 0, 0, 0, 0
    for word in words:
        kind, rest = divmod(word, 1 << 12)
        found = []
        if kind <= 1:
            row = rest % 2048 if kind == 0 else None
        elif kind == 2:
            found = [(rest % 2048, rest // 2048)]
        elif kind == 3:
            base, polarity = rest % 2048, rest // 2048
        elif kind in (4, 5):
            wide = 12 if kind == 4 else 8
            found = [(base + k, polarity) for k in range(wide) if rest >> k & 1]
            base += wide
        elif kind == 6:
            low = rest
        elif kind == 8:
            turns += high is not None and high - rest >= 2**11
            low = low if rest == (high or 0) else 0
            high = rest
        if high is not None and row is not None:
            rows += [(x, row, (turns * 2**12 + high) * 4096 + low, p) for x, p in found]
    return rows


@pytest.mark.parametrize("block", [1, 7, 1 << 17])
def test_random_words_of_evt2(tmp_path, block):
    rng = np.random.default_rng(1)
    words = [int(rng.integers(0, 2)) << 28 | int(rng.integers(0, 1 << 28)) for _ in range(5)]  # before any time
    for _ in range(400):
        kind = int(rng.choice([0, 1, 8, 10, 14, 15], p=[0.35, 0.35, 0.15, 0.05, 0.05, 0.05]))
        words.append(kind << 28 | int(rng.integers(0, 1 << 28)))
    rows = decoded(tmp_path / "e.raw", "evt2", words, block)
    assert rows == slow_evt2(words) and len(rows) > 200


@pytest.mark.parametrize("block", [1, 7, 1 << 17])
@pytest.mark.parametrize("order", ["little", "legacy"])
def test_random_words_of_evt21(tmp_path, block, order):
    """A word is one of EVT2's and a mask of 32 pixels to the right; the halves lie in either order."""
    rng = np.random.default_rng(3)
    words, single = [], []
    for _ in range(200):
        kind = int(rng.choice([0, 1, 8, 10], p=[0.4, 0.4, 0.15, 0.05]))
        mask, upper = int(rng.integers(0, 1 << 32)), kind << 28 | int(rng.integers(0, 1 << 28)) & ~(31 << 11)
        words += [upper, mask] if order == "legacy" else [mask, upper]
        single += [upper + (k << 11) for k in range(32) if mask >> k & 1] if kind < 2 else [upper]
    path = tmp_path / "e.raw"
    header = f"% evt 2.1\n% format EVT21;endianness={order};height=320;width=320\n% end\n"
    path.write_bytes(header.encode() + np.array(words, "<u4").tobytes())
    reader = EvtReader(path)
    rows = [
        row
        for e in reader.chunks(block)
        for row in zip(e.x.tolist(), e.y.tolist(), e.t.tolist(), e.p.tolist(), strict=True)
    ]
    assert rows == slow_evt2(single) and len(rows) > 1000 and (reader.height, reader.width) == (320, 320)


@pytest.mark.parametrize("block", [1, 7, 1 << 17])
def test_random_words_of_evt3(tmp_path, block):
    """Times that go on and that fall (a turn of the counter, or a word out of order), vectors one after the other."""
    rng = np.random.default_rng(2)
    words = [0x2005, 0x3003, 0x4FFF]
    for _ in range(600):
        kind = int(
            rng.choice(
                [0, 1, 2, 3, 4, 5, 6, 8, 7, 10, 14, 15],
                p=[0.1, 0.02, 0.28, 0.1, 0.1, 0.1, 0.1, 0.1, 0.025, 0.025, 0.025, 0.025],
            )
        )
        rest = int(rng.integers(0, 1 << 12))
        words.append(kind << 12 | (rest % 512 | rest & 0x800 if kind == 3 else rest & 0xFF if kind == 5 else rest))
    rows = decoded(tmp_path / "e.raw", "evt3", words, block)
    assert rows == slow_evt3(words) and len(rows) > 400


def test_the_low_bits_belong_to_their_time_high(tmp_path):
    """As OpenEB's decoder: a TIME_HIGH that differs clears them, one that repeats keeps them; the counter has wrapped
    where it falls by half of its range."""
    words = [0x8001, 0x6FA0, 5, 0x280A, 0x8002, 0x280B, 0x8003, 0x200C, 0x8004, 0x6FA1, 0x200D, 0x8004, 0x200E]
    assert [t for _, _, t, _ in decoded(tmp_path / "e.raw", "evt3", words)] == [8096, 8192, 12288, 20385, 20385]
    assert [t for _, _, t, _ in decoded(tmp_path / "e.raw", "evt3", [0x8800, 0x2001, 0x8000, 0x2001])] == [
        1 << 23,
        1 << 24,
    ]


@pytest.mark.parametrize(
    "words, bad",
    [
        ([0x8000, 0x3000 | 2047, 0x4001, 0x4001], 3),
        ([0x8000, 0x3000 | 2046, 0x4006], 2),
        ([0x8000, 0x3000 | 2041, 0x5080], 2),
    ],
)
def test_a_vector_may_not_leave_the_row(tmp_path, words, bad):
    """The last pixel is 2047; a bit beyond it is damage, a clear one is nothing."""
    with pytest.raises(
        AssetError,
        match=rf"damaged at byte {len(b'% evt 3.0' + b'% end') + 2 + 2 * bad}: no valid EVT3 word .got "
        rf"'0x{words[bad]:04x}'",
    ):
        decoded(tmp_path / "e.raw", "evt3", words)
    assert decoded(tmp_path / "e.raw", "evt3", [0x8000, 0x3800 | 2046, 0x4003, 0x4000]) == [
        (2046, 0, 0, 1),
        (2047, 0, 0, 1),
    ]
    assert decoded(tmp_path / "e.raw", "evt3", [0x8000, 0x3000 | 2040, 0x5080]) == [(2047, 0, 0, 0)]


@pytest.mark.parametrize("version, kinds", [("evt2", (2, 3, 7, 9, 11, 13)), ("evt3", (9, 11, 12, 13))])
def test_kinds_of_words_that_do_not_exist(tmp_path, version, kinds):
    shift = 28 if version == "evt2" else 12
    for kind in kinds:
        with pytest.raises(AssetError, match=f"damaged at byte .*no valid {version.upper()} word"):
            decoded(tmp_path / "e.raw", version, [8 << shift, kind << shift])


@pytest.mark.parametrize("version", ["evt2", "evt3"])
def test_events_that_never_get_a_time(tmp_path, version):
    words = [1 << 28] * 3 if version == "evt2" else [0x2001, 0x3000, 0x4003]
    with pytest.raises(AssetError, match="3 events and no TIME_HIGH word, so no times"):
        decoded(tmp_path / "e.raw", version, words)
    assert decoded(tmp_path / "e.raw", version, []) == []


def some_events() -> Events:
    """Times that stay, go on by 1, cross 64 and 4096 µs and leap; rows that stay and change."""
    t = np.array([0, 0, 1, 63, 64, 64, 4095, 4096, 4096, 50_000, 16_777_215, 16_777_216, 16_777_300])
    n = len(t)
    return Events(
        (np.arange(n) * 57 % 640).astype(np.uint16),
        np.repeat([3, 3, 9, 479], 4)[:n].astype(np.uint16),
        t,
        (np.arange(n) % 3 == 0).astype(np.uint8),
    )


def written(path, chunks: list[Events]) -> list[int]:
    with contextlib.closing(EvtWriter(path, 480, 640)) as writer:
        for events in chunks:
            writer.append(events)
    return np.frombuffer(path.read_bytes().split(b"% end\n")[1], "<u2").tolist()


def cut(events: Events, size: int) -> list[Events]:
    return [Events(*(getattr(events, k)[i : i + size] for k in "xytp")) for i in range(0, len(events), size)]


@pytest.mark.parametrize("size", [1, 3, 100])
def test_evt3_as_written(tmp_path, size):
    """Every step of 4096 µs, the low bits where the time has changed, the row where it has, then the column."""
    events, expected, high, low, row = some_events(), [0x8000], 0, None, None
    for x, y, t, p in zip(events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist()):
        while high < t // 4096:
            high += 1
            expected.append(0x8000 | high % 4096)
        if low != t:
            expected.append(0x6000 | t % 4096)
            low = t
        if row != y:
            expected.append(y)
            row = y
        expected.append(0x2000 | p << 11 | x)
    assert written(tmp_path / "e.raw", cut(events, size)) == expected


def one(t: int) -> Events:
    return Events(np.zeros(1, np.uint16), np.zeros(1, np.uint16), np.array([t]), np.ones(1, np.uint8))


@pytest.mark.parametrize(
    "times, said",
    [
        ([-1], "got '?-1'?.; expected 0 to less"),
        ([1 << 34], f"got '?{1 << 34}'?.; expected 0 to less"),
        ([(1 << 34) - 1, 5], "decrease at event 1"),
    ],
)
def test_times_beyond_the_writers_limits(tmp_path, times, said):
    with pytest.raises(EventDataError, match=said):
        written(tmp_path / "e.raw", [one(t) for t in times])


def test_sizes_beyond_eleven_bits(tmp_path):
    EvtWriter(tmp_path / "f.raw", 2048, 2048).close()
    for size in ((2049, 10), (10, 2049)):
        with pytest.raises(EventDataError, match="EVT3 has 11-bit coordinates"):
            EvtWriter(tmp_path / "f.raw", *size)


@pytest.mark.parametrize("block", [1, 7, 1 << 17])
@pytest.mark.parametrize("version", ["evt2", "evt3"])
def test_triggers_among_random_words(tmp_path, version, block):
    """Time, channel and edge of each, by the words before it, in whatever pieces the file is read."""
    rng, two = np.random.default_rng(4), version == "evt2"
    kinds, rest = ([0, 1, 8, 10], 28) if two else ([0, 2, 6, 8, 10], 12)
    words = [int(rng.choice(kinds)) << rest | int(rng.integers(0, 1 << rest)) for _ in range(600)]
    high, low, turns, expected = None, 0, 0, []
    for word in words:
        kind, value = word >> rest, word & (1 << rest) - 1
        if kind == 8:
            turns += high is not None and high - value > (2**27 if two else 2**11 - 1)
            low = 0 if not two and value != (high or 0) else low
            high = value
        elif kind == 6:
            low = value
        elif kind == 10 and high is not None:
            now = (turns * 2**28 + high) * 64 + (value >> 22) if two else (turns * 2**12 + high) * 4096 + low
            expected.append([now, value >> 8 & (31 if two else 15), value & 1])
    path = tmp_path / "t.raw"
    path.write_bytes(b"% evt " + version[-1].encode() + b".0\n% end\n" + np.array(words, WORD[version]).tobytes())
    reader = EvtReader(path)
    for _ in range(2):
        list(reader.chunks(block))
        assert reader.triggers.tolist() == expected and len(expected) > 100


def test_events_before_any_time_get_none_when_they_are_mended(tmp_path):
    """Low bits that fall before the first TIME_HIGH are no turn of a counter."""
    words = [0x6FA0, 0x0005, 0x2001, 0x600A, 0x2002, 0x8800, 0x6001, 0x2003]
    path = tmp_path / "e.raw"
    path.write_bytes(b"% evt 3.0\n% end\n" + np.array(words, "<u2").tobytes())
    for options in ({}, {"damaged": "keep"}, {"sort": True}):
        with open_events(path, EventReading.of(**options)) as file:
            events = file.read()
            assert events.x.tolist() == [3] and events.t.tolist() == [(0x800 << 12) | 1], options
