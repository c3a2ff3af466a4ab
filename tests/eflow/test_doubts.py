"""What a recording makes one doubt."""

import numpy as np
import pytest

pytest.importorskip("torch")

from blinkgl.types.events import Events
from eflow.cli import run
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
