"""The preview's picture, pixel by pixel, and its clock; colours of flow against the published wheel."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.io.colour import INVALID, flow_colour
from blinkgl.sequence_files import preview as module
from blinkgl.sequence_files.preview import PreviewWriter


class Film:
    """Stands for the encoder: keeps every picture."""

    def __init__(self, path, height, width, fps, **options):
        self.size, self.fps, self.pictures, self.ended = (height, width), fps, [], None

    def write(self, picture):
        assert picture.shape == (*self.size, 3) and picture.dtype == np.uint8
        self.pictures.append(picture.copy())

    def close(self):
        self.ended = "closed"

    def abort(self):
        self.ended = "aborted"


@pytest.fixture(autouse=True)
def film(monkeypatch):
    monkeypatch.setattr(module, "VideoWriter", Film)


def test_full_colour_follows_speed_up_at_once_and_down_slowly():
    made = PreviewWriter("p.mp4", 40, 40)
    for speed, full in ((2.0, 2.0), (8.0, 8.0), (1.0, 7.6), (0.0, 7.22)):
        made.set_flow(np.full((40, 40, 2), (speed, 0), np.float32))
        assert made._flow_max == pytest.approx(full)
    spread = np.zeros((40, 40, 2), np.float32)
    spread[::4, ::4, 1] = np.linspace(0, 100, 100).reshape(10, 10)
    made.set_flow(spread)
    assert made._flow_max == pytest.approx(95.0)
    made.set_flow(spread * 100, np.zeros((40, 40), bool))
    assert made._flow_max == pytest.approx(95.0), "nothing is valid: nothing is learned"
    spread[0, 0] = np.inf
    made.set_flow(spread)
    assert np.isfinite(made._flow_max)


def test_flow_is_shown_by_its_colour_and_what_is_invalid_is_grey():
    made = PreviewWriter("p.mp4", 30, 40)
    flow, valid = np.zeros((30, 40, 2), np.float32), np.ones((30, 40), bool)
    flow[:, 20:, 0], valid[:10] = 4.0, False
    made.set_flow(flow, valid)
    expected = np.kron(flow_colour(flow, made._flow_max, valid), np.ones((2, 2, 1), np.uint8))
    np.testing.assert_array_equal(made._panel_view(2), expected)
    made = PreviewWriter("p.mp4", 30, 40, flow=False)
    made.set_flow(flow, valid)
    assert made._canvas.shape == (90, 164, 3), "no panel for it"


# --- colours ----------------------------------------------------------------------------------------------------------


def middlebury(u: float, v: float) -> np.ndarray:
    """Colour of a flow of at most unit length, by the published bands of hue (Baker et al. 2011)."""
    bands = [
        (15, (255, 0, 0), (0, 1, 0)),
        (6, (255, 255, 0), (-1, 0, 0)),
        (4, (0, 255, 0), (0, 0, 1)),
        (11, (0, 255, 255), (0, -1, 0)),
        (13, (0, 0, 255), (1, 0, 0)),
        (6, (255, 0, 255), (0, 0, -1)),
    ]
    ring = [np.array(start) + 255 * k / steps * np.array(way) for steps, start, way in bands for k in range(steps)]
    turn = (np.arctan2(-v, -u) / np.pi + 1) / 2 * 55
    low = int(turn) % 55
    hue = ring[low] * (1 - turn % 1) + ring[(low + 1) % 55] * (turn % 1)
    return 255 - np.hypot(u, v) * (255 - hue)


def test_flow_by_the_published_wheel():
    dice = np.random.default_rng(0)
    flow = dice.uniform(-5, 5, (30, 40, 2)).astype(np.float32)
    rgb = flow_colour(flow, 10.0)
    for y, x in dice.integers(0, 30, (200, 2)):
        u, v = np.round(flow[y, x] / 10.0 * 255) / 255
        np.testing.assert_allclose(rgb[y, x], middlebury(u, v), atol=0.51)


def test_full_saturation():
    """Of the largest valid speed unless it is said; what is faster keeps its hue."""
    flow = np.zeros((2, 3, 2), np.float32)
    flow[0, :, 0], flow[1, 0] = (1, 2, 4), (np.nan, 1)
    flow[1, 1, 1] = 100.0
    valid = np.ones((2, 3), bool)
    valid[1, 1] = False
    np.testing.assert_array_equal(flow_colour(flow, None, valid), flow_colour(flow, 4.0, valid))
    rgb = flow_colour(flow, 2.0, valid)
    assert rgb[0, 1].tolist() == rgb[0, 2].tolist() == [255, 0, 0] and rgb[1, 2].tolist() == [255, 255, 255]
    assert (rgb[1, :2] == INVALID).all()
    assert (flow_colour(np.zeros((2, 2, 2))) == 255).all()
