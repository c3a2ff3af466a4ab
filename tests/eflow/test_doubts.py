"""What a recording makes one doubt."""

import numpy as np
import pytest

pytest.importorskip("torch")

from blinkgl.errors import EventDataError
from blinkgl.io.formats import write_events
from blinkgl.types.events import Events
from eflow import infer
from eflow.choice import _pairs
from eflow.cli import run
from eflow.cli_arguments import WindowsAsked
from eflow.infer import doubts


def recorded(count=20_000, span_us=100_000, hot=0.0, seed=0) -> Events:
    """Events all over 100x80 px; a share ``hot`` of them in 20 pixels."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 100, count), rng.integers(0, 80, count)
    flood = rng.random(count) < hot
    x[flood], y[flood] = rng.integers(0, 20, flood.sum()), 5
    t = np.sort(rng.integers(0, span_us, count))
    return Events(x.astype(np.uint16), y.astype(np.uint16), t, rng.integers(0, 2, count).astype(np.uint8))


@pytest.mark.parametrize("factor, said", [(1000 * 1000, "ns, or ticks"), (1 / 1000, "ms, or ticks of a slower clock")])
def test_times_in_another_unit(factor, said):
    e = recorded()
    (line,) = doubts(Events(e.x, e.y, (e.t * factor).astype(np.int64), e.p), 80, 100)
    assert said in line and "instead of µs?" in line


def test_a_flood_of_hot_pixels():
    (line,) = doubts(recorded(hot=0.8), 80, 100)
    assert line.startswith("40 pixels (0.5 %) have 8") and "hot pixels" in line
    assert doubts(recorded(hot=0.3), 80, 100) == []


def test_predict_says_so_in_one_line(tmp_path, capsys):
    e = recorded(2000, hot=0.9)
    np.savetxt(tmp_path / "hot.txt", np.c_[e.t * 1e-6, e.x, e.y, e.p], fmt=["%.6f", "%d", "%d", "%d"])
    command = ["predict", "contrast-translation", str(tmp_path / "hot.txt"), "--size", "100x80", "--window-ms", "40"]
    assert run(command) == 0 and capsys.readouterr().err.count("hot.txt: 40 pixels") == 1


def test_windows_of_short_flow_propose_longer_ones_that_are_not_short(tmp_path, capsys):
    """Columns of dots that move to the right by 100 px/s: 0.8 px in 8 ms."""
    r = np.random.default_rng(3)
    x0, y, k = r.uniform(-40, 128, 700), r.integers(0, 96, 700), np.arange(60)
    x = np.floor(x0)[:, None] + k
    t = (x - x0[:, None]) / 100
    keep = (t >= 0) & (t < 0.4) & (x >= 0) & (x < 128)
    rows = np.c_[t[keep], x[keep], np.repeat(y, 60).reshape(700, 60)[keep], np.ones(keep.sum())]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    np.savetxt(tmp_path / "dots.txt", rows, fmt=["%.6f", "%d", "%d", "%d"])

    def lines(window_ms: str) -> list[str]:
        command = ["predict", "real_small", str(tmp_path / "dots.txt"), "--size", "128x96", "--window-ms", window_ms]
        assert run([*command, "--end-ms", str(50 * float(window_ms))]) == 0
        return [line for line in capsys.readouterr().out.splitlines() if "below 2 px" in line]

    (line,) = lines("8")
    proposed = line.partition("try --window-ms ")[2]
    assert 8 < float(proposed) <= 400
    assert lines(proposed) == []
    (line,) = lines("1")
    assert "try --window-ms" in line or "too short" in line


def says(monkeypatch, speed) -> list:
    """Let predictors say flow of ``speed(t)`` px/s at the start t µs of the new window; return the windows they see."""
    windows = []

    def flow(self, window):
        windows.append(window)
        length = speed(window.new.t0) * (window.new.t1 - window.new.t0) * 1e-6
        return np.full((80, 100, 2), (length, 0), np.float32), np.zeros((2, 80, 100), np.float32)

    monkeypatch.setattr(infer.Predictor, "__call__", flow)
    return windows


@pytest.mark.parametrize("name", ["real_small", "contrast-translation"])
def test_the_length_of_windows_is_chosen_between_the_limits(name, tmp_path, monkeypatch, capsys):
    """Slow for two seconds, then fast: 5 px in 10 ms."""
    e = recorded(4000, 2_500_000)
    write_events(tmp_path / "e.h5", e, 80, 100)
    windows = says(monkeypatch, lambda t: 10 if t < 2_000_000 else 500)
    limits = ["--start-ms", "2000", "--end-ms", "2200", "--no-refine"]
    assert run(["predict", name, str(tmp_path / "e.h5"), "--window-ms", "auto", *limits]) == 0
    assert "windows of 10 ms" in capsys.readouterr().out
    first = int(e.t[0])
    assert min(w.new.t0 for w in windows) >= first + 2_000_000 and max(w.new.t1 for w in windows) <= first + 2_200_000


@pytest.mark.parametrize(("limits", "proposed"), [([], "8990"), (["--start-ms", "2000", "--end-ms", "6000"], "4000")])
def test_longer_windows_fit_between_the_limits(limits, proposed, tmp_path, monkeypatch, capsys):
    """5 px would take 50 s. A number, without an exponent."""
    write_events(tmp_path / "e.h5", recorded(4000, 9_000_000), 80, 100)
    says(monkeypatch, lambda t: 0.1)
    assert run(["predict", "real_small", str(tmp_path / "e.h5"), "--window-ms", "1000", "--no-refine", *limits]) == 0
    assert f"try --window-ms {proposed}\n" in capsys.readouterr().out


class InChunks:
    """An event file of chunks in memory."""

    path = "e.h5"

    def __init__(self, *chunks: Events):
        self.chunks = lambda: iter(chunks)


def at(t: np.ndarray) -> Events:
    return Events(np.zeros(len(t), np.uint16), np.zeros(len(t), np.uint16), t, np.zeros(len(t), np.uint8))


@pytest.mark.parametrize(
    ("begin", "asked", "inside"),
    [
        (-100_000, {"end_ms": 100}, (-100_000, 0)),
        (-50_000, {"start_ms": 50}, (0, 150_000)),
        (0, {"start_ms": 20, "end_ms": 121}, (20_000, 121_000)),
    ],
)
def test_limits_where_times_are_negative(begin, asked, inside):
    """A limit at 0 is one, and the end is not inside."""
    file = InChunks(at(np.arange(begin, begin + 200_000, 100)))
    pairs = list(_pairs(file, WindowsAsked(window_ms="50", **asked)))
    assert pairs and all(inside[0] <= pair.old.t0 and pair.new.t1 <= inside[1] for pair in pairs)


def test_events_before_the_start_are_not_kept(monkeypatch):
    t = np.arange(0, 2_000_000, 100)
    sizes, joined = [], Events.concatenate
    monkeypatch.setattr(Events, "concatenate", lambda parts: sizes.append(sum(map(len, parts))) or joined(parts))
    file = InChunks(*(at(part) for part in np.split(t, 100)))
    for reads in (("new",), ("old", "new")):
        sizes.clear()
        window = next(infer.windows(file, 10_000, start_us=1_900_000, reads=reads))
        assert max(sizes) < 700 and len(window.old) == len(window.new) == 100
    # A silent window first, then the jump.
    late = InChunks(at(np.arange(5)), at(np.arange(5) + 100_000_000))
    stream = infer.windows(late, 1000, start_us=50_000)
    assert len(next(stream).new) == 0
    with pytest.raises(EventDataError, match="event times jump by 99.948 s"):
        next(stream)
