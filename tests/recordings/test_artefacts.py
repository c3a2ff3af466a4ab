"""Measures of two frames and their flow, against motions whose every number is known."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.recordings import artefacts

H, W = 40, 64
YES = np.ones((H, W), bool)


def constant(u: float, v: float) -> np.ndarray:
    return np.broadcast_to(np.float32([u, v]), (H, W, 2)).copy()


def bar(width: int, px: int, x0: int = 20) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flows there and back of an upright bar, ``width`` px wide, that moves ``px`` to the right before a still wall;
    and which pixels of the wall it hides in the second frame."""
    forward, backward, behind = constant(0, 0), constant(0, 0), np.zeros((H, W), bool)
    forward[:, x0 : x0 + width, 0] = px
    backward[:, x0 + px : x0 + px + width, 0] = -px
    behind[:, x0 + px : x0 + px + width] = True
    behind[:, x0 : x0 + width] = False
    return forward, backward, behind


def ramp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Light whose logarithm (with the measures' constant) is linear: bilinear sampling of it is exact."""
    return (np.exp(-3 + 0.02 * x + 0.01 * y) - artefacts.EPS).astype(np.float32)


GRID = np.meshgrid(np.arange(W, dtype=np.float64), np.arange(H, dtype=np.float64))


def test_displacement_is_the_99th_percentile_of_valid_lengths():
    assert artefacts.displacement(constant(3, -4), YES) == 5.0
    flow = constant(0, 0)
    flow[..., 0] = np.linspace(0, 100, H * W).reshape(H, W)
    assert artefacts.displacement(flow, YES) == pytest.approx(99, abs=0.1)
    few = np.zeros((H, W), bool)
    few[0, 1] = True
    assert artefacts.displacement(flow, few) == flow[0, 1, 0]


@pytest.mark.parametrize("u, v", [(4, 0), (0, -3), (2.25, 1.25)])
def test_a_constant_translation_hides_what_leaves_and_uncovers_what_enters(u, v):
    lost = artefacts.hidden(constant(u, v), YES, constant(-u, -v), YES)
    x, y = GRID
    outside = (x + u < 0) | (x + u > W - 1) | (y + v < 0) | (y + v > H - 1)
    np.testing.assert_array_equal(lost, outside)
    # Half a pixel or more covers one.
    entered = 1 - (W - np.floor(abs(u))) * (H - np.floor(abs(v))) / (W * H)
    assert artefacts.uncovered(constant(u, v), YES) == pytest.approx(entered, abs=1e-6)


@pytest.mark.parametrize("u, v", [(0.4, 0.4), (0.25, 0.75), (0.6, 0.1), (0.3, 2.9), (1.7, 0.2), (5.45, 7.3)])
def test_pixels_are_covered_by_what_of_others_comes_to_them(u, v):
    """Bilinear shares are products: of a constant flow, of one along the row and one along the column."""

    def along(length: int, px: float) -> np.ndarray:
        whole, part = int(px), px - int(px)
        return np.concatenate([np.zeros(whole), [1 - part], np.ones(length - whole - 1)])

    covered = np.outer(along(H, v), along(W, u)) >= 0.5
    assert artefacts.uncovered(constant(u, v), YES) == pytest.approx(1 - covered.mean(), abs=1e-9)
    assert artefacts.uncovered(constant(-u, -v), YES) == pytest.approx(1 - covered.mean(), abs=1e-9)


@pytest.mark.parametrize("u, v", [(0, 0), (4, 0), (2.5, -1.25)])
def test_a_constant_translation_leaves_no_residual(u, v):
    x, y = GRID
    assert artefacts.residual(ramp(x, y), ramp(x - u, y - v), constant(u, v), YES) < 2e-4
    mean = lambda a, b: np.sqrt((a + artefacts.EPS) * (b + artefacts.EPS)) - artefacts.EPS
    assert artefacts.left_out(ramp(x + u, y + v), ramp(x, y), ramp(x - u, y - v), mean) < 1e-4


def test_residual_is_the_log_of_what_light_does_otherwise():
    x, y = GRID
    a = ramp(x, y)
    b = ((ramp(x - 2, y) + artefacts.EPS) * np.exp(0.3) - artefacts.EPS).astype(np.float32)
    assert artefacts.residual(a, b, constant(2, 0), YES) == pytest.approx(0.3, abs=1e-3)
    # Of a wrong flow, what the light changes over its error: 0.02 per px.
    assert artefacts.residual(a, ramp(x - 2, y), constant(7, 0), YES) == pytest.approx(5 * 0.02, abs=1e-3)
    assert np.isnan(artefacts.residual(a, b, constant(2, 0), ~YES)), "nothing is visible"
    assert np.isnan(artefacts.residual(a, b, constant(2 * W, 0), YES)), "everything leaves"
    half = x < W / 2
    b[:, W // 2 + 2 :] *= 7
    assert artefacts.residual(a, b, constant(2, 0), half) == pytest.approx(0.3, abs=1e-3), "hidden pixels do not count"


@pytest.mark.parametrize("width, px", [(3, 3), (3, 8), (8, 3), (1, 5), (12, 12)])
def test_a_bar_hides_what_it_comes_to_and_uncovers_what_it_leaves(width, px):
    forward, backward, behind = bar(width, px)
    lost = artefacts.hidden(forward, YES, backward, YES)
    np.testing.assert_array_equal(lost, behind)
    share = min(width, px) * H / (W * H)
    assert lost.mean() == pytest.approx(share) == pytest.approx(artefacts.uncovered(forward, YES))


def test_flows_agree_as_sundaram_brox_and_keutzer_say():
    """0.01 (|f|^2 + |b|^2) + 0.5 is 2.2 for 10 px there and 8.5 back, 2.9 for 10 px there and 11.7 back."""
    flow = constant(0, 10)
    seen = GRID[1] + 10 <= H - 1
    for miss, wrong in ((1.45, False), (1.55, True), (-1.65, False), (-1.72, True), (0.0, False)):
        lost = artefacts.hidden(flow, YES, constant(0, -10 + miss), YES)
        assert (lost[seen] == wrong).all() and lost[~seen].all(), miss


def test_what_has_no_valid_vector_there_is_hidden_and_here_is_not_judged():
    valid, back = YES.copy(), YES.copy()
    valid[:, :5], back[:, 30:34] = False, False
    lost = artefacts.hidden(constant(2, 0), valid, constant(-2, 0), back)
    assert lost[:, 28:32].all() and lost[:, W - 2 :].all() and not lost[:, :5].any()
    assert lost.sum() == H * 6


@pytest.mark.parametrize(
    "width, px, thin",
    [(1, 2, False), (1, 3, True), (2, 3, False), (2, 4, True), (3, 4, False), (3, 5, True), (5, 7, True), (5, 6, False),
     (8, 12, False), (8, 13, True), (11, 13, True), (20, 25, True), (20, 24, False), (20, 12, False)],
)  # fmt: skip
def test_bars_that_move_by_more_than_their_width_are_thin(width, px, thin):
    """By more than the next of the widths that are tried, to be exact: 2, 3, 4, 6, 8, 12, 16, 24."""
    forward, _, _ = bar(width, px)
    share = width / W if thin else 0
    assert artefacts.thin(forward, YES) == pytest.approx(share)
    assert artefacts.thin(forward.transpose(1, 0, 2).copy(), YES.T) == pytest.approx(share), "level ones, too"
    assert artefacts.thin(-forward, YES) == pytest.approx(share), "whichever way they move"


def test_structures_that_move_with_what_is_around_them_are_not_thin():
    x, y = GRID
    turning = np.stack([0.1 * y, -0.1 * x], -1).astype(np.float32)
    zooming = np.stack([0.2 * (x - 30), 0.2 * (y - 20)], -1).astype(np.float32)
    for flow in (constant(9, 4), turning, zooming):
        assert artefacts.thin(flow, YES) == 0
    bars, _, _ = bar(3, 14)
    assert artefacts.thin(bars + constant(-13, 3), YES) == artefacts.thin(bars, YES) == pytest.approx(3 / W)


def test_a_thin_structure_of_which_the_surroundings_are_not_known_is_not_judged():
    forward, _, _ = bar(3, 6)
    valid = np.zeros((H, W), bool)
    valid[:, 20:23] = True
    assert artefacts.thin(np.where(valid[..., None], forward, np.float32(0)), valid) == 0


def test_astray_is_the_share_that_is_followed_wrongly():
    flow, own = constant(10, 0), constant(10, 0)
    own[:, :16, 0] = 11.5
    own[:, 16:32, 0] = 10.9  # within a pixel
    assert artefacts.astray(own, flow, YES) == 0.25
    flow[:, :16, 0], own[:, :16, 0] = 40, 41.5  # within a twentieth
    assert artefacts.astray(own, flow, YES) == 0
    own[:, :16, 0] = 42.5
    weight = np.zeros((H, W), np.float32)
    weight[:, 8:24] = 2.0
    assert artefacts.astray(own, flow, YES, weight) == 0.5
    weight[:, :16] = 0
    assert artefacts.astray(own, flow, YES, weight) == 0
    assert np.isnan(artefacts.astray(own, flow, YES, 0 * weight)), "no edges"
    valid = YES.copy()
    valid[:, :16] = False
    assert artefacts.astray(own, flow, valid) == 0


def test_left_out_is_the_error_over_the_change():
    light = lambda log: np.full((H, W), np.exp(log) - artefacts.EPS, np.float32)
    assert artefacts.change(light(-2), light(-1.6)) == pytest.approx(0.4, abs=1e-5)
    tried = lambda before, middle, after: artefacts.left_out(light(before), light(middle), light(after), lambda a, b: a)
    assert tried(-2, -1.9, -1.6) == pytest.approx(0.1 / 0.4, abs=1e-4)
    assert tried(-2, -2.4, -1.6) == pytest.approx(1, abs=1e-4)
    assert tried(-2, -1.999, -2) == pytest.approx(0.001 / 0.01, rel=1e-3), "of still frames, over a hundredth"
    assert tried(-2, -2, -2) == 0


@pytest.mark.parametrize(
    "columns, lost",
    [("00001111", 0), ("00110011", 0), ("01010101", 1), ("00010000", 0.5), ("00011000", 0), ("0000", 0)],
)
def test_fine_is_what_half_a_pixel_loses(columns, lost):
    """Of steps and of what is two pixels wide nothing, of a line half, of what alternates everything."""
    log = np.array([int(c) for c in columns], np.float64)[None].repeat(6, 0)
    light = (np.exp(log - 2) - artefacts.EPS).astype(np.float32)
    assert artefacts.fine(light) == pytest.approx(lost, abs=0.01 if lost < 1 else 0)
    assert artefacts.fine(light.T) == pytest.approx(artefacts.fine(light), abs=1e-9)


def test_slopes_are_not_fine():
    assert artefacts.fine(ramp(*GRID)) == pytest.approx(0, abs=1e-4)


def test_edges_are_gradients_of_the_log():
    slopes = artefacts.edges(ramp(*GRID))[2:-2, 2:-2]
    np.testing.assert_allclose(slopes, np.hypot(0.02, 0.01), rtol=1e-3)


def test_all_that_a_given_flow_says():
    x, y = GRID
    a, b, flow = ramp(x, y), ramp(x - 3, y), constant(3, 0)
    plain = artefacts.of_given_flow(a, b, flow, YES)
    assert list(plain) == ["displacement", "uncovered", "thin", "residual"]
    assert plain == pytest.approx({"displacement": 3, "uncovered": 3 / W, "thin": 0, "residual": 0}, abs=2e-4)
    gone = x < W / 4
    b[:, : W // 4 + 3] *= 3  # where it goes is not seen, so it does not count
    known = artefacts.of_given_flow(a, b, flow, YES, gone=gone, own=constant(5, 0))
    assert known["hidden"] == 0.25 and known["residual"] < 2e-4 and known["astray"] == pytest.approx(1)
    assert artefacts.of_given_flow(a, b, flow, YES)["residual"] > 0.2
    half = x >= W / 2
    assert artefacts.of_given_flow(a, b, flow, half, gone=gone)["hidden"] == 0, "of the valid pixels"
    flat = np.full((H, W), 0.5, np.float32)
    assert "astray" not in artefacts.of_given_flow(flat, flat, flow, YES, own=flow), "no edges to be followed"
    assert "residual" not in artefacts.of_given_flow(a, b, flow, YES, gone=YES), "nothing is seen"


@pytest.mark.parametrize(
    "call",
    [
        lambda: artefacts.displacement(constant(1, 0), YES[:-1]),
        lambda: artefacts.displacement(constant(1, 0), ~YES),
        lambda: artefacts.thin(constant(1, 0), ~YES),
        lambda: artefacts.hidden(constant(1, 0), YES, constant(1, 0)[:, :-1], YES),
        lambda: artefacts.uncovered(constant(1, 0)[..., 0], YES),
        lambda: artefacts.residual(np.zeros((3, 3), np.float32), np.zeros((H, W), np.float32), constant(1, 0), YES),
        lambda: artefacts.astray(constant(1, 0)[:-1], constant(1, 0), YES),
        lambda: artefacts.left_out(np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 4)), lambda a, b: a),
    ],
)
def test_what_does_not_fit_is_refused(call):
    with pytest.raises(ValueError, match=r"shapes differ|not a flow|no valid vector"):
        call()
