"""The occlusion mask: what four samples say against a slow twin, what they leave to a ray against geometry."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.occlusion import HIDDEN, NARROW, REACH, SEEN, UNDECIDED, judged_by_samples, near_thin
from blinkgl.render.renderer import Renderer
from blinkgl.tools.shader_debugger import reference
from render_scenes import FACING, LEVEL, SECOND, cube, drift, mesh, mixed_scene, quad, rig, scene, sphere, still, thing

MS = 1_000_000


def thin_around(x, y, ids, depth) -> bool:
    """Whether a pixel within REACH, in x and y, belongs to a run of at most NARROW, across or down, before others."""
    for lines, depths, (u, v) in ((ids, depth, (x, y)), (ids.T, depth.T, (y, x))):
        for row in range(max(v - REACH, 0), min(v + REACH + 1, len(lines))):
            ends = [0, *(np.flatnonzero(np.diff(lines[row].astype(int))) + 1), lines.shape[1]]
            for start, end in itertools.pairwise(ends):
                if not 0 < start < end < lines.shape[1] or end - start > NARROW or depths[row, start] == 0:
                    continue
                farther = [
                    there == 0 or there > own
                    for there, own in (
                        (depths[row, start - 1], depths[row, start]),
                        (depths[row, end], depths[row, end - 1]),
                    )
                ]
                if all(farther) and start - REACH <= u < end + REACH:
                    return True
    return False


def verdict(x, y, flow, z, ids, depth_there, ids_there, near) -> int:
    """What the pixels at t' say of the point of pixel (x, y), at depth ``z`` then."""
    height, width = ids.shape
    xt, yt = x + float(flow[0]), y + float(flow[1])
    if xt < -0.5 or yt < -0.5 or xt >= width - 0.5 or yt >= height - 0.5 or z < near:
        return HIDDEN
    if not (0 <= xt <= width - 1 and 0 <= yt <= height - 1):
        return UNDECIDED  # no pixel centre is on its other side
    # the square of pixel centres around the place
    left, top = (int(min(max(np.floor(v), 0), max(many - 2, 0))) for v, many in ((xt, width), (yt, height)))
    corners = [(min(top + dy, height - 1), min(left + dx, width - 1), dx, dy) for dy in (0, 1) for dx in (0, 1)]
    at = [(float(depth_there[r, c]), ids_there[r, c] == ids[y, x]) for r, c, _, _ in corners]
    if all(not own and there > 0 and there * 1.001 < z for there, own in at):
        return HIDDEN
    weights = [(1 - (xt - left), xt - left)[dx] * (1 - (yt - top), yt - top)[dy] for _, _, dx, dy in corners]
    between = sum(w / there for w, (there, _) in zip(weights, at) if there)
    steep = z * np.ptp([1 / there if there else 0 for there, _ in at]) > 0.05
    if all(own for _, own in at) and abs(z * between - 1) <= 3e-4 and not steep:
        return UNDECIDED if thin_around(left, top, ids_there, depth_there) else SEEN
    return UNDECIDED


@pytest.mark.parametrize("shape", [(9, 13), (2, 2), (1, 8), (7, 1), (1, 1)])
def test_samples_equal_their_slow_twin(shape):
    """Patches of three objects and of nothing; depths that differ by less and by more than what is allowed; flow
    beyond the border."""
    rng = np.random.default_rng(shape[0] * 100 + shape[1])
    answers = set()
    for _ in range(60):
        ids, ids_there = (
            np.kron(rng.integers(0, 3, (5, 7)), np.ones((2, 2), int))[: shape[0], : shape[1]].astype(np.uint32)
            for _ in range(2)
        )
        if rng.random() < 0.4:
            ids_there[:] = ids[:] = 1
        y, x = np.mgrid[: shape[0], : shape[1]]
        plane = 1 / (0.3 + 0.002 * x - 0.001 * y)
        part = rng.choice([0, 0, 0, 0, 0, 0, 0.0005, 0.03, 0.3], shape) * rng.choice([-1, 1], shape)
        depth_there = (plane * (1 + part)).astype(np.float32)
        depth_there[ids_there == 0] = 0
        z = (plane * (1 + rng.choice([0, 0.0005, 0.01, 0.1, 0.5], shape) * rng.choice([-1, 1], shape))).astype(
            np.float32
        )
        flow = (rng.choice([0.0, 0.25, 0.5, 1.0, 2.75], (*shape, 2)) * rng.choice([-1, 1], (*shape, 2))).astype("f")
        valid = (ids > 0) & (rng.random(shape) < 0.9)
        found = judged_by_samples(flow, z, valid, ids, depth_there, ids_there, near=2.0)
        assert found.dtype == np.uint8 and (found[~valid] == SEEN).all()
        for r, c in zip(*np.nonzero(valid)):
            expected = verdict(c, r, flow[r, c], float(z[r, c]), ids, depth_there, ids_there, 2.0)
            assert found[r, c] == expected, (r, c)
            answers.add(expected)
    assert answers == ({SEEN, HIDDEN, UNDECIDED} if min(shape) > 2 else answers)


def test_the_outer_half_pixel_is_looked_up(gl):
    """A wall moves up by 0.3 px behind a bar that covers what is above y = -0.2: the first row's points land at -0.3,
    in the picture and hidden."""
    what = scene([], rig(64, 48, 60.0))
    camera = what.camera
    # z of the world where a point 5 units away is at y = -0.2.
    edge = -(-0.2 - camera.cy) / camera.fy * 5
    bar = thing("bar", 1, quad(9, 1), still((0, 5, edge + 1), FACING))
    rise = 0.3 / camera.fy * 10
    wall = thing("wall", 2, quad(30, 30), drift((0, 10, 0), (0, 10, rise), FACING, FACING))
    with Renderer(gl, replace(what, objects=(bar, wall)), RenderConfig()) as renderer:
        frame = renderer.labels(0, LabelRequest("ids", "flow_forward", "occlusion_forward"), SECOND)
    assert (frame.ids == 2).all() and frame.forward.flow[0, :, 1] == pytest.approx(-0.3, abs=1e-3)
    assert frame.forward.occluded[0].all() and not frame.forward.occluded[1:].any()


# ------------------------------------------------------------------------------------------------- rays


def masks(gl, world, t_ns: int, to_ns: int):
    """(mask, the reference's flow, pixels that both give to the same object)"""
    with Renderer(gl, world, RenderConfig()) as renderer:
        ours = renderer.labels(t_ns, LabelRequest("ids", "occlusion_forward", "flow_forward"), to_ns)
    frame = reference.render(world, t_ns, forward_ns=to_ns)
    return ours.forward.occluded, frame.forward, (ours.ids == frame.instance) & frame.hit & ours.forward.valid


def test_the_shadow_of_a_card_is_exact(gl):
    """A card of 1 x 1 at Z = 2 before a wall at Z = 4, both still; the camera moves sideways. What is hidden of the
    wall is a rectangle by similar triangles, to the pixel."""
    camera = rig(path=drift((0, 0, 0), (0.37, 0, 0.11), LEVEL, LEVEL))
    wall = thing("wall", 1, quad(6, 6), still((0, 4, 0), FACING))
    card = thing("card", 2, quad(0.5, 0.5), still((0.1, 2, 0.05), FACING))
    world = scene([wall, card], camera)
    t_ns, to_ns = 300 * MS, 700 * MS
    mask, flow, same = masks(gl, world, t_ns, to_ns)
    lens = world.camera
    y, x = np.mgrid[: lens.height, : lens.width]
    here, there = (world.camera_path.pose(t)[:3, 3] for t in (t_ns, to_ns))
    seen = {}
    for name, z in (("wall", 4.0), ("card", 2.0)):  # world axes: x right, y away, z up
        seen[name] = np.stack([here[0] + z * (x - lens.cx) / lens.fx, here[2] - z * (y - lens.cy) / lens.fy], axis=-1)
    on_card = (np.abs(seen["card"] - [0.1, 0.05]) < 0.5).all(axis=-1)
    crossing = (seen["wall"] + there[[0, 2]]) / 2  # where the sight of the wall's point passes Z = 2 at t'
    behind = ~on_card & (np.abs(crossing - [0.1, 0.05]) < 0.5).all(axis=-1)
    off_edge = np.abs(np.abs(crossing - [0.1, 0.05]) - 0.5).min(axis=-1) > 2e-3  # world units: a tenth of a pixel
    ask = same & ~flow.outside & (off_edge | on_card)
    assert behind[ask].sum() > 100 and ask.mean() > 0.7
    np.testing.assert_array_equal(mask[ask], behind[ask])


def crowd():
    """Twenty bodies that overlap, some turning."""
    rng, things = np.random.default_rng(4), []
    for k in range(20):
        mesh = (cube(0.45), sphere(0.5, 3), quad(0.5, 0.5))[k % 3]
        at = np.array([rng.uniform(-1.6, 1.6), rng.uniform(3, 6), rng.uniform(-1.2, 1.2)])
        turns = [Rotation.random(random_state=rng) for _ in range(2)]
        things.append(thing(f"{k}", k + 1, mesh, drift(at, at + rng.uniform(-1, 1, 3), *turns)))
    things.append(thing("wall", 99, quad(15, 15), still((0, 8, 0), FACING)))
    return scene(things, rig(path=drift((0, 0, 0), (0.3, 0.1, 0.1), LEVEL, LEVEL)))


@pytest.mark.parametrize("make", [crowd, mixed_scene])
def test_masks_beside_silhouettes_are_those_of_the_reference(gl, make):
    """Everywhere, edges included: one depth sample a pixel is wrong in three to eleven percent of what is hidden."""
    world, counted, wrong = make(), 0, 0
    for to_ms in (200, 330, 420):
        mask, flow, same = masks(gl, world, 300 * MS, to_ms * MS)
        counted += (flow.occluded & ~flow.outside & same).sum()
        wrong += ((mask != flow.occluded) & same).sum()
    assert counted > 500 and wrong <= 0.005 * counted


def test_a_part_hides_another_of_the_same_mesh(gl):
    """A post before a wall, one mesh and one id; the camera slides by, and the post's side turns out of sight. Whether
    something is between is a ray's interval in two boxes."""
    boxes = np.array([[(-0.15, 2.0, -1), (0.15, 2.3, 1)], [(-2, 2.6, -1.5), (2, 2.7, 1.5)]])
    solid = [cube(0.5).vertices * (high - low) + (high + low) / 2 for low, high in boxes]
    count = len(cube().vertices)
    shape = mesh(np.concatenate(solid), np.concatenate([cube().faces, cube().faces + count]))
    camera = rig(path=drift((0.55, 0, 0.03), (-0.05, 0, 0.03), LEVEL, LEVEL))
    world = scene([thing("both", 1, shape, still())], camera)
    frame = reference.render(world, 0, forward_ns=900 * MS)
    mask, flow, same = masks(gl, world, 0, 900 * MS)
    points = np.array([0.55, 0, 0.03]) + (casting.rays_of(world.camera, frame.hits().xy) @ LEVEL.as_matrix().T) * (
        frame.depth.reshape(-1, 1)
    )
    eye = np.array([0.01, 0, 0.03])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (boxes[:, :, None] - eye) / (points - eye)
    enters, leaves = ends.min(axis=1).max(axis=-1), ends.max(axis=1).min(axis=-1)
    hidden = ((enters < leaves) & (enters < 1 - 1e-4)).any(axis=0).reshape(mask.shape)
    ask = same & ~flow.outside
    assert (hidden & ask).sum() > 1000 and ((mask != hidden) & ask).sum() <= 0.001 * (hidden & ask).sum()


def wires():
    """Five of a third of a pixel to two, at all angles, before a wall; the camera slides by."""
    things = [thing("wall", 99, quad(15, 15), still((0, 8, 0), FACING))]
    for k, (px, turn) in enumerate(((0.33, 3), (0.5, 40), (0.7, 75), (1.0, 110), (2.0, 160))):
        half = px * 3 / 150 / 2
        turned = FACING * Rotation.from_euler("z", turn, degrees=True)
        things.append(thing(f"{k}", k + 1, quad(half, 3), still((0.5 * k - 1, 3, 0.2 * k - 0.4), turned)))
    return scene(things, rig(path=drift((0, 0, 0), (1.0, 0, 0.3), LEVEL, LEVEL)))


def test_what_is_thinner_than_a_pixel_hides(gl):
    """Between four pixels that all show the wall: six in a hundred of the hidden ones were wrong without."""
    world = wires()
    mask, flow, same = masks(gl, world, 300 * MS, 360 * MS)
    hidden = (flow.occluded & ~flow.outside & same).sum()
    wrong = ((mask != flow.occluded) & same).sum()
    assert hidden > 400 and wrong <= 0.02 * hidden


def test_thin_is_what_has_others_on_both_sides_and_farther():
    ids, depth = np.ones((13, 17), np.uint32), np.full((13, 17), 5.0, np.float32)
    assert not near_thin(ids, depth).any()
    ids[:, 8:10], depth[:, 8:10] = 2, 4.0
    expected = np.zeros(ids.shape, bool)
    expected[:, 8 - REACH : 10 + REACH] = True
    assert (near_thin(ids, depth) == expected).all() and (near_thin(ids.T.copy(), depth.T.copy()) == expected.T).all()
    assert not near_thin(ids, -depth + 9).any(), "a gap: what is seen through it is farther away"
    assert not near_thin(ids[:, :10].copy(), depth[:, :10].copy()).any(), "it may go on beyond the border"
    ids[:, 10], depth[:, 10] = 2, 4.0
    assert not near_thin(ids, depth).any(), f"{NARROW + 1} px are seen by some of any four"


def test_rays_are_asked_where_samples_do_not_agree_and_matter_there(gl, monkeypatch):
    """The two halves of the work, each seen to be needed: few rays, and many wrong pixels without them."""
    asked = []
    true = casting.is_hidden
    monkeypatch.setattr(casting, "is_hidden", lambda s, t, xy, z, e: asked.append(len(xy)) or true(s, t, xy, z, e))
    world = crowd()
    mask, flow, same = masks(gl, world, 300 * MS, 420 * MS)
    assert 0 < asked[0] < 0.2 * mask.size
    monkeypatch.setattr(casting, "is_hidden", lambda s, t, xy, z, e: np.zeros(len(xy), bool))
    without, _, _ = masks(gl, world, 300 * MS, 420 * MS)
    hidden = flow.occluded & ~flow.outside & same
    assert ((without != flow.occluded) & same).sum() > 0.05 * hidden.sum()
