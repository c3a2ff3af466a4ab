"""A judge of recordings, on one that is made up: points that move evenly, whose flow is known."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from blinkgl.tools import real_recordings as rr  # noqa: E402

SIDE, SPEED = 128, np.array([60.0, -30.0])  # px/s


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Ninety points over 0.3 s, as a recording and, its first 0.1 s, as a burst with its flow."""
    root = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(0)
    start = rng.uniform(0, SIDE, (90, 2))
    t = np.sort(rng.uniform(0, 0.3, (90, 120)), 1)
    at = np.rint((start[:, None] + SPEED * t[..., None]) % SIDE).astype(int) % SIDE
    rows = sorted(
        (float(time), int(x), int(y), int(rng.integers(2)))
        for times, places in zip(t, at, strict=True)
        for time, (x, y) in zip(times, places, strict=True)
    )
    lines = [f"{time:.6f} {x} {y} {p}" for time, x, y, p in rows]
    (root / "points").mkdir()
    (root / "points" / "events.txt").write_text("\n".join(lines) + "\n")
    burst = root / rr.TEST / "turn"
    burst.mkdir(parents=True)
    (burst / "events.txt").write_text("\n".join(line for line in lines if float(line.split()[0]) < 0.1) + "\n")
    (burst / "calib.txt").write_text("100 100 64 64 0 0 0 0 0\n")
    flow = np.broadcast_to((0.1 * SPEED)[:, None, None], (1, 2, 180, 240)).astype(np.float32)
    np.save(burst / "flow.npy", flow)
    return root


def test_what_moves_is_told_and_the_bursts_stay_out_of_it(root, monkeypatch, tmp_path, capsys):
    """Three answers that know the speed, or half of it, or nothing."""

    def knowing(name, height, width, focal=None):
        share = {"zero": 0.0, "half": 0.5, "contrast-affine": 1.0, "contrast-translation": 1.0}[name]
        seconds = lambda window: (window.new.t1 - window.new.t0) * 1e-6
        return lambda window: np.broadcast_to(share * seconds(window) * SPEED, (height, width, 2)).astype(np.float32)

    monkeypatch.setattr(rr, "answer_of", knowing)
    out = tmp_path / "real.json"
    arguments = ["zero", "half", "contrast-affine", "--recordings", str(root), "--windows", "2", "--json", str(out)]
    monkeypatch.setattr("sys.argv", ["real_recordings", *arguments])
    rr.main()
    found = json.loads(out.read_text())
    assert list(found) == ["points/events.txt"]
    it = found["points/events.txt"]
    assert it["span_ms"] * 1e-3 * np.hypot(*SPEED) == pytest.approx(rr.LIKELY_PX, rel=0.05)
    rows = it["rows"]
    assert rows["contrast-affine"]["fwl"] > 1.3 and rows["zero"]["fwl"] == pytest.approx(1)
    assert rows["half"]["fwl"] < 1.1  # (places between pixels blur the image: half the way can be worse than none)
    assert it["moves"] == rows["contrast-affine"]["fwl"]
    assert rows["half"]["cosine"] == pytest.approx(1) and rows["half"]["length"] == pytest.approx(0.5)
    assert rows["half"]["x"] == pytest.approx(60 / np.hypot(60, 30)) and rows["zero"]["length"] == 0
    assert "all that move (1)" in capsys.readouterr().out


@pytest.mark.slow
def test_the_length_of_a_window_is_found_by_what_moves(root):
    events, height, width = rr.looked_at(root / "points" / "events.txt")
    assert 2.5 < rr.likely_span(events, height, width) * 1e-6 * np.hypot(*SPEED) < 10


def test_a_burst_is_scored_beside_its_bounds(root):
    rows = rr.burst(root / rr.TEST / "turn", ["contrast-translation"])
    long = np.hypot(*(0.1 * SPEED))
    assert rows["zero"]["aee_all"] == pytest.approx(long, rel=1e-5) and rows["zero"]["of_zero_events"] == 1
    for bound in ("best constant", "best affine"):
        assert rows[bound]["of_zero_all"] < 1e-6 and rows[bound]["cosine_events"] == pytest.approx(1)
    found = rows["contrast-translation"]
    assert found["of_zero_events"] < 0.2 and found["cosine_all"] > 0.98 and 0.85 < found["length_all"] < 1.15


def test_a_large_sensor_is_looked_at_in_its_middle(tmp_path):
    x, y = np.meshgrid([0, 146, 147, 319, 320, 492, 493], [110, 239, 369, 370])
    lines = [f"{0.001 * k:.3f} {a} {b} 1" for k, (a, b) in enumerate(zip(x.ravel(), y.ravel(), strict=True))]
    (tmp_path / "events.txt").write_text("\n".join([*lines, "0.9 639 479 1"]) + "\n")
    events, height, width = rr.looked_at(tmp_path / "events.txt")
    assert (height, width) == rr.MIDDLE
    assert {*zip(events.x.tolist(), events.y.tolist(), strict=True)} == {
        (a - 147, b - 110) for a in (147, 319, 320, 492) for b in (110, 239, 369)
    }
