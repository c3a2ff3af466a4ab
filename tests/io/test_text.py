"""Numbers in text against Python's decimal arithmetic, and what is printed against Python's own format."""

from __future__ import annotations

import gzip
from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pytest

from blinkgl.errors import AssetError
from blinkgl.io.clock import TimeUnit
from blinkgl.io.reading import EventReading
from blinkgl.io.text import TextReader, TextWriter
from blinkgl.types.events import Events


def read(path, text: str, unit: str | None = None) -> Events:
    path.write_text(text)
    return Events.concatenate([Events.empty(), *TextReader(path, EventReading(time_unit=unit)).chunks()])


def decimals(count: int) -> list[str]:
    """Times of every way to write one: signs, points at either end, exponents of either
    sign, more digits than a double has."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(count):
        digits = "".join(map(str, rng.integers(0, 10, rng.integers(1, 16))))
        point = int(rng.integers(0, len(digits) + 1))
        text = rng.choice(["", "+", "-"]) + digits[:point] + "." + digits[point:]
        if rng.random() < 0.6:
            text += rng.choice(["e", "E"]) + rng.choice(["", "+", "-"]) + str(rng.integers(0, 13))
        found.append(text)
    return found


def test_times_are_the_nearest_microsecond(tmp_path):
    """Half of one away from zero; refused beyond 10^18 µs and not before."""
    for text in [
        *decimals(300),
        "0.0000005",
        "-0.0000005",
        "0.00000049999",
        "1.5e-6",
        "25e-7",
        ".5",
        "5.",
        "1.e3",
        "1e-30",
        "1e-19",
        "9e-19",
        "5e-7",
        "123456.7890125",
        "00000000000000000000001.5",
        "0.000000000000000000000000000001e30",
        "1234567890123456.7",
        "0.12345678901234567890123",
    ]:
        exact = (Decimal(text) * 10**6).to_integral_value(ROUND_HALF_UP)
        if abs(exact) < 10**17:
            assert read(tmp_path / "e.txt", f"{text} 1 2 1\n", "s").t.tolist() == [int(exact)], text
        elif abs(exact) > 10**19:
            with pytest.raises(AssetError, match="line 1 is not an event"):
                read(tmp_path / "e.txt", f"{text} 1 2 1\n", "s")


@pytest.mark.parametrize(
    "text",
    ["123456789012345678", "1e", "1e+", "1ex", ".", "+", "-", "--1", "1-", "1.2.3", "0x10", "e5", "1e99999999999"],
)
def test_what_is_no_number(tmp_path, text):
    with pytest.raises(AssetError, match="line 2 is not an event"):
        read(tmp_path / "e.txt", f"0 1 2 1\n{text} 1 2 1\n")


@pytest.mark.parametrize(
    "line",
    [
        "5 3.5 2 1",
        "5 30001e-4 2 1",
        "5 65536 2 1",
        "5 3 65536 1",
        "5 3 -1 1",
        "5 3 2 -2",
        "5 3 2 2",
        "5 3 2 0.5",
        "5 1e-3 2 1",
        "5 3 2 1 #",
    ],
)
def test_coordinates_and_polarities_that_are_none(tmp_path, line):
    with pytest.raises(AssetError, match="line 3 is not an event"):
        read(tmp_path / "e.txt", f"% width height\n4 1 1 1\n{line}\n")


@pytest.mark.parametrize(
    "text, times",
    [
        ("0.5 1 2 1\n3 1 2 1\n", [500_000, 3_000_000]),
        ("0 1 2 1\n1.5 1 2 1\n2 1 1 1\n", [0, 1_500_000, 2_000_000]),
        ("1 1 2 1\n2e0 1 2 1\n", [1, 2]),
    ],
)
def test_all_times_have_one_unit(tmp_path, text, times):
    """Whether a time is written with a point says nothing about that line alone."""
    assert read(tmp_path / "e.txt", text).t.tolist() == times


def test_separators_comments_and_empty_lines(tmp_path):
    text = "# one\n\n%two\n 1\t2,3 ,\t1 \r\n   # indented\n2 , 3 4\t0\n\n%last"
    events = read(tmp_path / "e.txt", text)
    assert [events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist()] == [
        [1, 2],
        [2, 3],
        [3, 4],
        [1, 0],
    ]


@pytest.mark.parametrize(
    "head, unit",
    [
        ("t[s] x y p", 0.5),
        ("timestamp[us],x,y,polarity", 5e-7),
        ("t (µs) x [px] y [px] p", 5e-7),
        ('ts,"x","y","on"', None),
    ],
)
def test_the_unit_that_a_name_says_binds(tmp_path, head, unit):
    path = tmp_path / "e.txt"
    for t, microseconds in (("0.5", 500_000), ("5", 5)):
        seconds = "." in t
        said = microseconds if unit is None or (unit == 0.5) == seconds else 5_000_000 if unit == 0.5 else 1
        assert read(path, f"{head}\n{t} 1 2 1\n").t.tolist() == [said]


def test_the_longest_line(tmp_path):
    comment = "#" + "x" * 65534
    assert len(comment) + 1 == 1 << 16
    assert len(read(tmp_path / "e.txt", f"{comment}\n1 2 3 1\n")) == 1
    with pytest.raises(AssetError, match="line 1 is longer than 65536 bytes"):
        read(tmp_path / "f.txt", f"{comment}xx\n1 2 3 1\n")
    with pytest.raises(AssetError, match="line 3 is longer than 65536 bytes"):
        (tmp_path / "g.txt").write_text(f"1 2 3 1\n2 2 3 1\n{' ' * 70_000}1 2 3 1\n3 2 3 1\n")
        list(TextReader(tmp_path / "g.txt").chunks(1000))


@pytest.mark.parametrize("separator, unit", [(" ", "s"), (",", "s"), (" ", "us"), (",", "us")])
def test_what_is_written_is_what_python_would_print(tmp_path, separator, unit):
    t = np.array([0, 7, 999_999, 1_000_000, 1_000_001, 59_000_000, 1_506_117_887_123_456])
    events = Events(
        np.array([0, 9, 10, 99, 100, 1279, 1], np.uint16),
        np.array([719, 0, 1, 10, 99, 100, 5], np.uint16),
        t,
        np.array([0, 1, 1, 0, 1, 0, 1], np.uint8),
    )
    writer = TextWriter(tmp_path / "e.txt", 720, 1280, separator, write_unit=unit)
    writer.append(Events.empty())
    writer.append(events)
    writer.close()
    head = {(",", "s"): ["t,x,y,p"], (",", "us"): ["t,x@1280,y@720,on"]}.get((separator, unit), [])
    stamp = (lambda v: f"{v // 10**6}.{v % 10**6:06d}") if unit == "s" else str
    rows = [
        separator.join((stamp(int(v)), *(str(int(c[k])) for c in (events.x, events.y, events.p))))
        for k, v in enumerate(t)
    ]
    assert (tmp_path / "e.txt").read_text() == "".join(line + "\n" for line in head + rows)
    reading = EventReading(time_unit=None if separator == "," and unit == "us" else unit)
    back = Events.concatenate(list(TextReader(tmp_path / "e.txt", reading).chunks(64)))
    assert all(np.array_equal(getattr(back, k), getattr(events, k)) for k in "xytp")


@pytest.mark.parametrize("ending", ["txt", "txt.gz"])
@pytest.mark.parametrize("lines", [1500, 4500])
def test_a_unit_is_guessed_from_whole_lines(tmp_path, ending, lines):
    """The first and last 32 KiB are looked at; wherever in a line they end, half a number is no time."""
    body = "".join(f"{13.582595999 + 9e-6 * k:.9f} {k % 240} {k % 180} {k % 2}\n" for k in range(1, lines))
    path = tmp_path / f"e.{ending}"
    for blanks in range(24):
        with gzip.open(path, "wb") if ending.endswith("gz") else open(path, "wb") as file:
            file.write(f"13.582595999 0 0 0{' ' * blanks}\n{body}".encode())
        assert TextReader(path).unit == TimeUnit("s", "guessed", (13.582595999, 13.582595999 + 9e-6 * (lines - 1)))
