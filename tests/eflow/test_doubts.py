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
