"""The occlusion mask against a slow twin that asks every pixel in turn."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.render.occlusion import occlusion_mask


def hidden(x, y, flow, w, ids, depth_next, ids_next, near, tolerance) -> bool:
    """Whether the point of pixel (x, y), at depth ``w`` then, is not seen at the other end of its flow."""
    height, width = ids.shape
    xt, yt = x + float(flow[0]), y + float(flow[1])
    if xt < -0.5 or yt < -0.5 or xt >= width - 0.5 or yt >= height - 0.5 or w < near:
        return True
    nearest = int(np.floor(yt + 0.5)), int(np.floor(xt + 0.5))
    mine = ids[y, x]
    if ids_next[nearest] != mine:
        return bool(depth_next[nearest] > 0 and w > depth_next[nearest] * (1 + tolerance))
    # the square of pixel centres around the place; at the border the outermost one, beyond which its plane goes on
    left, top = (int(min(max(np.floor(v), 0), max(many - 2, 0))) for v, many in ((xt, width), (yt, height)))
    corners = [(min(top + dy, height - 1), min(left + dx, width - 1), dx, dy) for dy in (0, 1) for dx in (0, 1)]
    ax, ay = xt - left, yt - top
    same = [c for c in corners if ids_next[c[0], c[1]] == mine]
    if len(same) < 4:
        ax, ay = np.clip([ax, ay], 0, 1)
    weights = np.array([(1 - ax, ax)[dx] * (1 - ay, ay)[dy] for _, _, dx, dy in same])
    inverse = np.array([1 / float(depth_next[r, c]) for r, c, _, _ in same])
    return bool((weights * inverse).sum() / weights.sum() > (1 + tolerance) / w + (inverse.max() - inverse.min()) / 2)


@pytest.mark.parametrize("shape", [(9, 13), (2, 2), (1, 8), (7, 1), (1, 1)])
@pytest.mark.parametrize("tolerance", [1e-3, 0.05])
def test_equals_slow_twin(shape, tolerance):
    """Patches of three objects and of nothing; depths that differ by less and by more than
    what is allowed; flow beyond the border."""
    rng = np.random.default_rng(shape[0] * 100 + shape[1])
    answers = set()
    for _ in range(40):
        ids, ids_next = (
            np.kron(rng.integers(0, 3, (5, 7)), np.ones((2, 2), int))[: shape[0], : shape[1]].astype(np.uint32)
            for _ in range(2)
        )
        if rng.random() < 0.3:
            ids_next[:] = ids[:] = 1
        y, x = np.mgrid[: shape[0], : shape[1]]
        plane = 1 / (0.3 + 0.02 * x - 0.01 * y)
        depth_next = (plane * (1 + rng.choice([0, 0, 0.0005, 0.03, 0.3], shape) * rng.choice([-1, 1], shape))).astype(
            np.float32
        )
        depth_next[ids_next == 0] = 0
        w = (plane * (1 + rng.choice([0, 0.0005, 0.01, 0.04, 0.1, 0.5], shape) * rng.choice([-1, 1], shape))).astype(
            np.float32
        )
        flow = rng.choice([0.0, 0.25, 0.5, 1.0, 2.75], (*shape, 2)) * rng.choice([-1, 1], (*shape, 2))
        flow = flow.astype(np.float32)
        valid = (ids > 0) & (rng.random(shape) < 0.9)
        mask = occlusion_mask(flow, w, valid, ids, depth_next, ids_next, near=2.0, tolerance=tolerance)
        assert mask.dtype == bool and not mask[~valid].any()
        for r, c in zip(*np.nonzero(valid)):
            assert mask[r, c] == hidden(c, r, flow[r, c], float(w[r, c]), ids, depth_next, ids_next, 2.0, tolerance), (
                r,
                c,
            )
            answers.add(bool(mask[r, c]))
    assert answers == ({True, False} if max(shape) > 1 else answers)


@pytest.mark.parametrize(
    "step, seen",
    [
        ((-0.5, 0), True),
        ((-0.51, 0), False),
        ((3.49, 0), True),
        ((3.5, 0), False),
        ((0, -0.5), True),
        ((0, -0.51), False),
        ((0, 2.49), True),
        ((0, 2.5), False),
    ],
)
def test_the_image_ends_half_a_pixel_beyond_the_outermost_centres(step, seen):
    ids, depth = np.ones((3, 4), np.uint32), np.full((3, 4), 5.0, np.float32)
    flow, valid = np.zeros((3, 4, 2), np.float32), np.zeros((3, 4), bool)
    flow[0, 0], valid[0, 0] = step, True
    assert occlusion_mask(flow, depth, valid, ids, depth, ids)[0, 0] == (not seen)


def test_without_a_near_plane_everything_in_front_is_seen():
    ids, depth = np.ones((2, 2), np.uint32), np.full((2, 2), 1e-6, np.float32)
    flow, valid = np.zeros((2, 2, 2), np.float32), np.ones((2, 2), bool)
    assert not occlusion_mask(flow, depth, valid, ids, depth, ids).any()
    assert not occlusion_mask(flow, depth, valid, ids, depth, ids, near=float(np.float32(1e-6))).any()
    assert occlusion_mask(flow, depth, valid, ids, depth, ids, near=2e-6).all()


def test_a_thousandth_is_the_same_surface():
    ids, near = np.ones((2, 2), np.uint32), np.full((2, 2), 2.0, np.float32)
    flow, valid = np.zeros((2, 2, 2), np.float32), np.ones((2, 2), bool)
    for farther, hides in ((1.0009, False), (1.0011, True)):
        assert occlusion_mask(flow, near * np.float32(farther), valid, ids, near, ids).all() == hides
