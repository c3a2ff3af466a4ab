"""A judge of recordings, on one that is made up: points that move evenly, whose flow is known."""

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


def test_a_burst_is_scored_beside_its_bounds(root):
    rows = rr.burst(root / rr.TEST / "turn", ["contrast-translation"])
    long = np.hypot(*(0.1 * SPEED))
    assert rows["zero"]["aee_all"] == pytest.approx(long, rel=1e-5) and rows["zero"]["of_zero_events"] == 1
    for bound in ("best constant", "best affine"):
        assert rows[bound]["of_zero_all"] < 1e-6 and rows[bound]["cosine_events"] == pytest.approx(1)
    found = rows["contrast-translation"]
    assert found["of_zero_events"] < 0.2 and found["cosine_all"] > 0.98 and 0.85 < found["length_all"] < 1.15
