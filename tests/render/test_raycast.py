"""Rays and triangles, without a scene: the kernels against Moeller and Trumbore's test of every triangle in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.render.raycast import LEAF_TRIANGLES, Holes, build_tree, join_trees, nearest_tree
from exhaustive import nearest_exhaustive


def triangles(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, 1, 3)) + rng.normal(0, 0.35, (count, 3, 3))


def forest_of(parts: list[np.ndarray], cull: list[bool]):
    return join_trees([build_tree(t.reshape(-1, 3), np.arange(3 * len(t)).reshape(-1, 3)) for t in parts], cull)


def ask(kernel, forest, origins, axes, rays, near=0.0, far=None, skip=None):
    n = len(rays)
    hit, bary, depth = np.empty((n, 3), np.int32), np.zeros((n, 3)), np.empty(n)
    kernel(
        forest,
        origins,
        axes,
        rays,
        near,
        np.full(n, np.inf) if far is None else far,
        np.full((n, 2), -1, np.int32) if skip is None else skip,
        hit,
        bary,
        depth,
    )
    return hit, bary, depth


def every_depth(parts, origins, axes, rays):
    """(rays, triangles of all parts) depth, inf where missed; whether the front is seen;
    (part, face) of each column."""
    depths, fronts, names = [], [], []
    for p, corners in enumerate(parts):
        d = rays @ axes[p][:, :2].T + axes[p][:, 2]
        a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        h = np.cross(d[:, None], e2[None])
        det = (h * e1).sum(-1)
        s = origins[p] - a
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (h * s).sum(-1) / det
            q = np.cross(s, e1)
            v = (d @ q.T) / det
            t = (e2 * q).sum(-1) / det
        depths.append(np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf))
        fronts.append((d @ np.cross(e1, e2).T) < 0)
        names += [(p, k) for k in range(len(corners))]
    return np.concatenate(depths, 1), np.concatenate(fronts, 1), np.array(names)


def world(seed: int):
    rng = np.random.default_rng(seed)
    parts = [triangles(seed, 70), np.empty((0, 3, 3)), triangles(seed + 1, LEAF_TRIANGLES), triangles(seed + 2, 33)]
    axes = np.ascontiguousarray(Rotation.random(4, rng).as_matrix())
    origins = -np.einsum("pij,j->pi", axes, [0, 0, 2.5]) + rng.normal(0, 0.1, (4, 3))
    return parts, origins, axes, rng.uniform(-0.6, 0.6, (300, 2))


def forest_with_an_empty_part(parts, cull):
    """A part of no triangles has a root that nobody visits."""
    whole = forest_of([p for p in parts if len(p)], [c for p, c in zip(parts, cull) if len(p)])
    at = next(k for k, p in enumerate(parts) if not len(p))
    return whole._replace(
        root=np.insert(whole.root, at, 0).astype(np.int32),
        first=np.insert(whole.first, at, whole.first[at]).astype(np.int32),
        size=np.insert(whole.size, at, 0).astype(np.int32),
        side=np.array(cull),
        extent=np.insert(whole.extent, at, 1.0),
        mask=np.insert(whole.mask, at, -1).astype(np.int32),
    )


@pytest.mark.parametrize("kernel", [nearest_tree, nearest_exhaustive])
@pytest.mark.parametrize("culled", [False, True])
def test_nearest_of_all_triangles(kernel, culled):
    """With a near distance, a far one of each ray, a triangle that a ray passes through,
    and parts that have no back."""
    parts, origins, axes, rays = world(3)
    cull = [culled, False, False, culled]
    forest = forest_with_an_empty_part(parts, cull)
    depths, fronts, names = every_depth(parts, origins, axes, rays)
    depths[:, np.array(cull)[names[:, 0]]] = np.where(fronts, depths, np.inf)[:, np.array(cull)[names[:, 0]]]
    rng = np.random.default_rng(0)
    first = names[depths.argmin(1)].astype(np.int32)
    passed = np.where((rng.random(len(rays)) < 0.5)[:, None] & np.isfinite(depths.min(1))[:, None], first, -1).astype(
        np.int32
    )
    other = passed.copy()  # the same face of another part, which is not passed through
    other[passed[:, 0] == 0, 0] = 3
    for near, far, skip in (
        (0.0, None, None),
        (2.3, None, None),
        (0.0, rng.uniform(1.5, 3.5, len(rays)), None),
        (0.0, None, passed),
        (0.0, None, other),
    ):
        allowed = np.where((depths >= near) & (depths < (np.inf if far is None else far[:, None])), depths, np.inf)
        if skip is not None:
            allowed[(names[None, :, 0] == skip[:, :1]) & (names[None, :, 1] == skip[:, 1:])] = np.inf
        hit, bary, depth = ask(kernel, forest, origins, axes, rays, near, far, skip)
        expected = allowed.min(1)
        seen = np.isfinite(expected)
        assert 0.2 < seen.mean() < 1
        np.testing.assert_array_equal(hit[:, 0] >= 0, seen)
        np.testing.assert_array_equal(np.isfinite(depth), seen)
        np.testing.assert_array_equal(hit[seen, :2], names[allowed.argmin(1)][seen])
        np.testing.assert_allclose(depth[seen], expected[seen], rtol=1e-10)
        np.testing.assert_array_equal(hit[seen, 2], fronts[seen, allowed.argmin(1)[seen]])
        for i in np.flatnonzero(seen):  # the weights of the corners make the point
            p, f = hit[i, :2]
            point = origins[p] + depth[i] * (axes[p] @ [*rays[i], 1.0])
            np.testing.assert_allclose(bary[i] @ parts[p][f], point, atol=1e-9)
            assert bary[i].min() >= 0 and bary[i].sum() == pytest.approx(1)


@pytest.mark.parametrize("kernel", [nearest_tree, nearest_exhaustive])
@pytest.mark.parametrize("reverse", [False, True])
def test_of_equal_depths_the_lower_part_and_triangle_is_hit(kernel, reverse):
    sheet = np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2.0]]])
    far = sheet + [0, 0, 1]
    heap = np.concatenate([far, sheet, sheet, far, sheet, sheet, far])
    parts = [far, heap[::-1] if reverse else heap, heap]
    hit, _, depth = ask(
        kernel, forest_of(parts, [False] * 3), np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)), np.zeros((1, 2))
    )
    assert hit[0, :2].tolist() == [1, 1] and depth[0] == 2
    skip = np.array([[1, 1]], np.int32)
    assert ask(
        kernel,
        forest_of(parts, [False] * 3),
        np.zeros((3, 3)),
        np.tile(np.eye(3), (3, 1, 1)),
        np.zeros((1, 2)),
        skip=skip,
    )[0][0, :2].tolist() == [1, 2]


@pytest.mark.parametrize("kernel", [nearest_tree, nearest_exhaustive])
def test_near_and_far_are_half_open(kernel):
    """A hit at the near distance counts, one at the far distance does not."""
    forest = forest_of([np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2.0]]])], [False])
    at = lambda near, far: ask(
        kernel, forest, np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 2)), near, np.array([far])
    )[0][0, 0]
    assert (
        at(2.0, 3.0) == 0
        and at(0.0, 2.0) == -1
        and at(np.nextafter(2.0, 3), 3.0) == -1
        and at(0.0, np.nextafter(2.0, 3)) == 0
    )


@pytest.mark.parametrize("kernel", [nearest_tree, nearest_exhaustive])
def test_a_ray_that_is_no_number_hits_nothing(kernel):
    """Lenses have none where no light comes from; every comparison with it is false."""
    forest = forest_of([np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2.0]]])], [False])
    found = ask(kernel, forest, np.zeros((1, 3)), np.eye(3)[None], np.full((1, 2), np.nan), 0.1, np.array([np.inf]))
    assert found[0][0, 0] == -1


@pytest.mark.parametrize("kernel", [nearest_tree, nearest_exhaustive])
@pytest.mark.parametrize("turned", [False, True])
def test_edges_and_corners_belong_to_the_triangle_seen_from_either_side(kernel, turned):
    """Rays exactly through them: an edge that two triangles share is missed by neither."""
    sheet = np.array([[[-1, -1, 2], [1, -1, 2], [-1, 1, 2.0]]])
    rays = np.array([[-1, -1], [1, -1], [-1, 1], [0, -1], [-1, 0], [0, 0], [-0.5, -0.5], [0.5, -0.5 - 2**-30]]) / 2
    hit, bary, depth = ask(
        kernel, forest_of([sheet[:, ::-1] if turned else sheet], [False]), np.zeros((1, 3)), np.eye(3)[None], rays
    )
    assert (hit[:, 0] == 0).all() and (depth == 2).all() and set(hit[:, 2]) == {int(turned)} and (bary >= 0).all()
    outside = np.array([[-1 - 2**-30, 0], [0, -1 - 2**-30], [2**-29, 0], [1, 1]]) / 2
    assert (ask(kernel, forest_of([sheet], [False]), np.zeros((1, 3)), np.eye(3)[None], outside)[0][:, 0] == -1).all()


def test_no_parts_at_all():
    forest = join_trees([], [])
    hit, _, depth = ask(nearest_tree, forest, np.empty((0, 3)), np.empty((0, 3, 3)), np.zeros((2, 2)))
    assert (hit == -1).all() and np.isinf(depth).all()


@pytest.mark.parametrize("kernel", [nearest_tree, nearest_exhaustive])
@pytest.mark.parametrize("wrap", [("repeat", "clamp"), ("mirror", "repeat")])
def test_rays_pass_through_holes(kernel, wrap):
    """A card with a picture of holes before a card without: what is hit is what the picture's bilinear value says, by
    SciPy, which knows its wrap modes by other names."""
    from scipy.ndimage import map_coordinates

    rng = np.random.default_rng(3)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uvs = np.array([[-1.3, 2.1], [1.9, 2.1], [1.9, -0.7], [-1.3, -0.7]])
    opacity, cutoff = rng.random((5, 7)).astype(np.float32), 0.45
    trees = [build_tree(square + [0, 0, z], faces) for z in (2.0, 3.0)]
    forest = join_trees(trees, [False, False], [Holes(uvs[faces], opacity, cutoff, wrap), None])
    rays = rng.uniform(-0.33, 0.33, (4000, 2))
    hit, _, depth = ask(kernel, forest, np.zeros((2, 3)), np.repeat(np.eye(3)[None], 2, 0), rays)
    at = (2 * rays + 1) / 2
    u, v = -1.3 + 3.2 * at[:, 0], 2.1 - 2.8 * at[:, 1]
    padded = np.pad(opacity, ((40, 40), (0, 0)), {"repeat": "wrap", "clamp": "edge", "mirror": "symmetric"}[wrap[1]])
    padded = np.pad(padded, ((0, 0), (42, 42)), {"repeat": "wrap", "clamp": "edge", "mirror": "symmetric"}[wrap[0]])
    value = map_coordinates(padded.astype(float), [v * 5 - 0.5 + 40, u * 7 - 0.5 + 42], order=1)
    clear = np.abs(value - cutoff) > 1e-6
    there = np.where(value < cutoff, 1, 0)
    np.testing.assert_array_equal(hit[clear, 0], there[clear])
    assert 0.2 < there.mean() < 0.8
    np.testing.assert_allclose(depth[clear], 2.0 + there[clear], rtol=1e-12)
