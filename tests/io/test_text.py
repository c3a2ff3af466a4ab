"""Numbers in text against Python's decimal arithmetic, and what is printed against Python's own format."""

from __future__ import annotations

import gzip
import zipfile
from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pytest

from blinkgl.errors import AssetError
from blinkgl.io.formats import open_events
from blinkgl.io.reading import EventReading
from blinkgl.io.text import TextReader, TextWriter
from blinkgl.types.events import Events


def read(path, text: str, unit: str = "us", columns: tuple[str, ...] = ("t", "x", "y", "p")) -> Events:
    path.write_text(text)
    reading = EventReading(time_unit=unit, columns=columns)
    return Events.concatenate([Events.empty(), *TextReader(path, reading).chunks()])


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
    ["12345678901234567890", "1e", "1e+", "1ex", ".", "+", "-", "--1", "1-", "1.2.3", "0x10", "e5", "1e99999999999"],
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
    said = "line 3 (is not an event|has a polarity that is not known|is between pixels)"
    with pytest.raises(AssetError, match=said):
        read(tmp_path / "e.txt", f"% width height\n4 1 1 1\n{line}\n")


def test_all_times_have_one_unit(tmp_path):
    """Whether a time is written with a point says nothing about that line alone."""
    for text, times in (("0.5 1 2 1\n3 1 2 1\n", [500_000, 3_000_000]), ("1 1 2 1\n2e0 1 2 1\n", [10**6, 2 * 10**6])):
        assert read(tmp_path / "e.txt", text, "s").t.tolist() == times


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
    "head, scale",
    [
        ("t[s] x y p", 10**6),
        ("timestamp[us],x,y,polarity", 1),
        ("t (µs) x [px] y [px] p", 1),
        ('t_ms,"x","y","on"', 1000),
    ],
)
def test_the_unit_that_a_name_says_binds(tmp_path, head, scale):
    for t in ("0.5", "5"):
        (tmp_path / "e.txt").write_text(f"{head}\n{t} 1 2 1\n")
        (events,) = TextReader(tmp_path / "e.txt").chunks()
        assert events.t.tolist() == [int(Decimal(float(t) * scale).to_integral_value(ROUND_HALF_UP))]


def test_the_longest_line(tmp_path):
    comment = "#" + "x" * 65534
    assert len(comment) + 1 == 1 << 16
    assert len(read(tmp_path / "e.txt", f"{comment}\n1 2 3 1\n")) == 1
    with pytest.raises(AssetError, match="line 1 is longer than 65536 bytes"):
        read(tmp_path / "f.txt", f"{comment}xx\n1 2 3 1\n")
    with pytest.raises(AssetError, match="line 3 is longer than 65536 bytes"):
        (tmp_path / "g.txt").write_text(f"1 2 3 1\n2 2 3 1\n{' ' * 70_000}1 2 3 1\n3 2 3 1\n")
        list(TextReader(tmp_path / "g.txt", EventReading("us", columns=("t", "x", "y", "p"))).chunks(1000))


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
    plain = separator == " " and unit == "us"
    reading = EventReading(time_unit="us", columns=("t", "x", "y", "p")) if plain else EventReading()
    back = Events.concatenate(list(TextReader(tmp_path / "e.txt", reading).chunks(64)))
    assert all(np.array_equal(getattr(back, k), getattr(events, k)) for k in "xytp")


@pytest.mark.parametrize("ending", ["txt", "txt.gz", "zip"])
def test_the_event_camera_dataset_is_known_without_a_heading(tmp_path, ending):
    """Seconds with a point, x, y, 0 or 1 in every row; wherever the sample of the rows ends."""
    body = "".join(f"{13.582595999 + 9e-6 * k:.9f} {k % 240} {k % 180} {k % 2}\n" for k in range(1, 1500))
    path = tmp_path / f"e.{ending}"
    for blanks in range(8):
        text = f"13.582595999 0 0 0{' ' * blanks}\n{body}"
        if ending == "zip":
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("rec.txt", "240 180\n" + text)
        else:
            with gzip.open(path, "wb") if ending.endswith("gz") else open(path, "wb") as file:
                file.write(text.encode())
        reader = TextReader(path)
        assert reader.unit == "s" and reader.notes == ["read as the Event Camera Dataset's text: t x y p, seconds"]
        assert (reader.width, reader.height) == ((240, 180) if ending == "zip" else (None, None))
        assert sum(map(len, reader.chunks())) == 1500


@pytest.mark.parametrize("odd", ["14 1 2 1", "14.000000 1 2 -1", "14.000000 1 2 2"])
def test_a_row_that_is_not_of_the_event_camera_datasets_layout(tmp_path, odd):
    """Behind the rows that are looked at first: what was read till then is not kept as a recording."""
    (tmp_path / "e.txt").write_text("13.582595 1 2 1\n" * 4000 + odd + "\n")
    with pytest.raises(AssetError, match=r"line 4001 is not as the lines before it, the Event Camera Dataset's"):
        list(TextReader(tmp_path / "e.txt").chunks())
    for few in ("13.5 1 2 1\n", "13 1 2 1\n", "13.582595 1 2 -1\n", "13.582595,1,2\n"):
        (tmp_path / "e.txt").write_text(few * 9)
        with pytest.raises(AssetError, match="no heading names the columns; try --columns"):
            TextReader(tmp_path / "e.txt")


def test_columns_that_the_heading_names_otherwise_are_said(tmp_path):
    (tmp_path / "e.csv").write_text("t_us,x,y,p\n10,1,2,1\n20,3,4,0\n", encoding="utf-8")
    for columns, said in (("t,x,y,p", False), ("t,y,x,p", True), (None, False)):
        file = open_events(tmp_path / "e.csv", EventReading.of(columns=columns, time_unit="us"))
        assert ("the heading names the columns t,x,y,p; --columns is used" in file.notes) == said
        assert file.read().x.tolist() == ([2, 4] if said else [1, 3])
