"""Boxes of objects against their corners put together by hand, and categories by names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.deform import BreatheConfig
from blinkgl.config.labels import LabelsConfig
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import ConfigError
from blinkgl.io.boxes import kitti_text, read_boxes
from blinkgl.io.pictures import with_boxes
from blinkgl.labels import LABELS, LabelRequest, asked_for
from blinkgl.labels.semantics import BY_NAME, category_of, class_of
from blinkgl.render.boxes import before
from blinkgl.render.renderer import Renderer
from blinkgl.scene.shapes.table import deformer_of
from blinkgl.scene.types import Mask, Material, Part, SceneObject
from render_scenes import FACING, cube, drift, mesh, quad, rig, scene, sphere, still, thing

MS = 1_000_000
T = 300 * MS
SPIN = Rotation.from_rotvec([0.4, -0.9, 0.6])
ROW = LABELS["boxes"]


def world():
    """Two cubes, one half behind a wall that is one half behind it; one at the picture's edge, one behind the camera,
    one that the near plane cuts; a ball that breathes."""
    ball = sphere(0.4, 2)
    kind = BreatheConfig(amount=(0.5, 0.2, 0.1), period=0.5)
    ball = replace(ball, deformer=deformer_of(kind, ball.vertices.min(axis=0), ball.vertices.max(axis=0)))
    return scene(
        (
            thing("cuboid-3#1", 1, cube(0.5), drift((-0.9, 4, 0.1), (-0.3, 4.6, 0.4), Rotation.identity(), SPIN)),
            replace(thing("board", 2, quad(0.5, 0.6), still((-1.2, 3, 0), FACING)), category="wall"),
            thing("Chair.001", 3, cube(0.4), still((2.0, 4, 0), SPIN)),
            thing("behind", 4, cube(0.4), still((0, -4, 0))),
            thing("hidden", 5, cube(0.05), still((0, 6, 0))),
            thing("ball", 6, ball, still((0.1, 3.5, 0.0), SPIN)),
            thing("rail", 7, cube(0.5), still((0.5, 0.4, -0.7))),
        ),
        rig(near=0.3),
    )


@pytest.fixture(scope="module")
def made(_gl_session):
    table = {"cuboid*": 7, "Chair": 300, "b*": 2, "wall": 9}
    what, labels = world(), LabelsConfig(boxes=True, semantics=table, ids=True, flow=(), images=False)
    _gl_session.make_current()
    with Renderer(_gl_session, what, RenderConfig()) as renderer:
        return what, renderer.labels(T, asked_for(labels))


def corners_by_hand(what, one):
    """(N, 2) px of a body's vertices, by the camera's own formula."""
    mesh, camera = one.parts[0].mesh, what.camera
    points = mesh.vertices if mesh.deformer is None else mesh.deformer.positions(mesh, T)
    to_camera = np.linalg.inv(what.camera_path.pose(T)) @ one.path.pose(T)
    seen = points @ to_camera[:3, :3].T + to_camera[:3, 3]
    return np.stack(
        [camera.fx * seen[:, 0] / seen[:, 2] + camera.cx, camera.fy * seen[:, 1] / seen[:, 2] + camera.cy], 1
    )


def test_boxes_in_the_picture(made):
    what, frame = made
    boxes, ids = frame.boxes, frame.ids
    assert boxes.instance.tolist() == [1, 2, 3, 5, 6, 7] and boxes.category.tolist() == [7, 2, 300, 0, 2, 0]
    assert boxes.kind.tolist() == ["cuboid", "wall", "Chair", "hidden", "ball", "rail"]
    for k, number in enumerate(boxes.instance):
        y, x = np.nonzero(ids == number)
        assert boxes.visible_pixels[k] == len(x)
        if len(x):
            edges = [x.min() - 0.5, y.min() - 0.5, x.max() + 0.5, y.max() + 0.5]
            assert boxes.visible_box[k].tolist() == edges
            # what is seen lies in what there is, to the half pixel that its centres may miss
            assert (boxes.amodal_box[k, :2] <= boxes.visible_box[k, :2] + 0.5).all()
            assert (boxes.amodal_box[k, 2:] >= boxes.visible_box[k, 2:] - 0.5).all()
        if number != 7:
            px = corners_by_hand(what, what.objects[number - 1])
            np.testing.assert_allclose(boxes.amodal_box[k], [*px.min(axis=0), *px.max(axis=0)], atol=1e-9)
    assert boxes.visible_pixels[3] == 0 and not boxes.visible_box[3].any() and boxes.occluded[3] == 1
    chair = boxes.amodal_box[2]
    share = (what.camera.width - 0.5 - chair[0]) / (chair[2] - chair[0])
    assert chair[2] > what.camera.width and boxes.truncated[2] == pytest.approx(1 - share) and share < 0.9
    assert boxes.cut_box[2].tolist() == [*chair[:2], what.camera.width - 0.5, chair[3]]
    assert boxes.truncated[4] == 0 and ROW.wrong(boxes, 120, 160) is None


def test_pixels_of_the_whole_are_those_of_the_body_alone(made, gl):
    """Drawn without the others; so is what of it is hidden."""
    what, frame = made
    boxes = frame.boxes
    assert 0.1 < boxes.occluded[0] < 0.6
    for k, number in enumerate(boxes.instance):
        alone = replace(what, objects=(what.objects[number - 1],))
        with Renderer(gl, alone, RenderConfig()) as renderer:
            there = np.count_nonzero(renderer.labels(T, LabelRequest("ids")).ids)
        assert abs(boxes.amodal_pixels[k] - there) <= max(2, 0.002 * there), number
        assert boxes.occluded[k] == pytest.approx(1 - boxes.visible_pixels[k] / boxes.amodal_pixels[k])


def test_boxes_in_space(made):
    what, frame = made
    for k, number in enumerate(frame.boxes.instance):
        one, mesh = what.objects[number - 1], what.objects[number - 1].parts[0].mesh
        points = mesh.vertices if mesh.deformer is None else mesh.deformer.positions(mesh, T)
        np.testing.assert_allclose(frame.boxes.size[k], np.ptp(points, axis=0), atol=1e-12)
        world_points = points @ one.path.pose(T)[:3, :3].T + one.path.pose(T)[:3, 3]
        for pose, seen in (
            (frame.boxes.T_world_box[k], world_points),
            (frame.boxes.T_cam_box[k], (world_points - 0) @ what.camera_path.pose(T)[:3, :3]),
        ):
            inside = (seen - pose[:3, 3]) @ pose[:3, :3]
            np.testing.assert_allclose(inside.max(axis=0), frame.boxes.size[k] / 2, atol=1e-12)
            np.testing.assert_allclose(inside.min(axis=0), -frame.boxes.size[k] / 2, atol=1e-12)
    assert abs(frame.boxes.size[4] / 0.8 - 1).max() > 0.1  # the ball has breathed


def test_files_and_kittis_fields(made, tmp_path):
    _, frame = made
    npz, txt = ROW.forms
    (tmp_path / "b.npz").write_bytes(npz.encode(frame.boxes))
    assert npz.encode(frame.boxes) == npz.encode(ROW.own(frame.boxes))
    for name, array in vars(read_boxes(tmp_path / "b.npz")).items():
        assert np.array_equal(array, getattr(frame.boxes, name)), name
    lines = [line.split() for line in txt.encode(frame.boxes).decode().splitlines()]
    assert [line[0] for line in lines] == ["cuboid", "wall", "Chair", "ball", "rail"] and {len(k) for k in lines} == {
        15
    }
    upright = replace(
        frame.boxes,
        **{name: getattr(frame.boxes, name)[:1] for name in vars(frame.boxes) if name != "resolution"}
        | {
            "T_cam_box": np.array([[[0.0, -1, 0, 1], [0, 0, -1, 0.5], [1, 0, 0, 4], [0, 0, 0, 1]]]),
            "size": np.array([[4.0, 2.0, 1.5]]),
        },
    )
    fields = kitti_text(upright).split()
    # its x axis points forward: a car that drives away, -90 degrees; seen at atan2(1, 4) to the right
    height, width, length, x, y, z, turn = (float(v) for v in fields[8:])
    assert (height, width, length, x, y, z, turn) == (1.5, 2.0, 4.0, 1.0, 1.25, 4.0, -1.57)
    assert float(fields[3]) == pytest.approx(-np.pi / 2 - np.arctan2(1, 4), abs=0.01)
    assert "outside of them" in ROW.wrong(replace(upright, cut_box=upright.cut_box + 200), 120, 160)
    assert "not 100x100 px: [160, 120]" in ROW.wrong(frame.boxes, 100, 100) and "of 1 objects" in ROW.wrong(
        replace(upright, size=upright.size[:, :2]), 120, 160
    )


def test_triangles_are_cut_at_the_near_plane():
    points = np.array([[0, 0, -1.0], [0, 2, 1], [2, 0, 1], [5, 5, 0.5]])
    cut, faces = before(points, np.array([[0, 1, 2], [1, 2, 0], [0, 0, 3], [1, 2, 3]]), 0.0)
    assert (cut[faces][..., 2] >= 0).all()
    area = lambda p: np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum() / 2
    assert area(cut[faces[-4:]]) == pytest.approx(2 * 0.75 * area(points[[[0, 1, 2]]]))
    assert len(before(points, np.array([[0, 0, 0]]), 0.0)[1]) == 0


def test_semantics_are_the_first_pattern_that_fits(made):
    what, frame = made
    numbers = {1: 7, 2: 2, 3: 300, 6: 2, 7: 0, 0: 0}
    assert frame.semantics.dtype == np.uint16
    for number, category in numbers.items():
        assert (frame.semantics[frame.ids == number] == category).all()
    assert [class_of(one) for one in what.objects][:3] == ["cuboid", "wall", "Chair"]
    assert category_of(what.objects[0], BY_NAME) == 4 and category_of(what.objects[2], BY_NAME) == 255
    row, labels = LABELS["semantics"], LabelsConfig(semantics={"car*": 1, "bus": 2})
    with pytest.raises(
        ConfigError, match=r"labels.semantics: no object's name matches .*patterns of cuboid, wall, Chair"
    ):
        row.check(what, labels)
    row.check(what, LabelsConfig(semantics={"car*": 1, "*": 0}))
    facts = row.facts(what, LabelsConfig(semantics={"cuboid*": 7}))
    assert facts["categories"]["objects"]["cuboid-3#1"] == 7 and facts["categories"]["patterns"] == {"cuboid*": 7}


def test_boxes_are_drawn_over_pictures(made):
    _, frame = made
    before_, over = np.zeros((120, 160, 3), np.uint8), None
    over = with_boxes(before_, frame.boxes)
    assert not before_.any() and over.any()
    left, top, _, bottom = frame.boxes.visible_box[0]
    assert over[int(top + 0.5) : int(bottom), int(left + 0.5)].any(axis=-1).all()


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_bodies_with_holes_and_of_one_side_are_as_large_as_they_are_seen(gl, turn):
    """Alone before the camera nothing hides them: a plate whose mask leaves its middle, half a tube that is drawn from
    its front only, and both in one body. Their boxes are those of their pixels."""
    alpha = np.zeros((64, 64), np.uint8)
    alpha[16:48, 16:48] = 255
    leaf = Material(mask=Mask(alpha), both_sides=True)
    angle = np.linspace(0, np.pi, 25)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(25)], 1)
    tube = np.concatenate([ring - [0, 0, 0.5], ring + [0, 0, 0.5]])
    k = np.arange(24)
    faces = np.concatenate([np.stack([k, k + 1, k + 25], 1), np.stack([k + 25, k + 1, k + 26], 1)])
    shell = mesh(0.5 * tube, faces)
    front = Material(both_sides=False)
    facing = Rotation.from_euler("z", turn) * FACING
    half = Rotation.from_euler("z", 3.0 + turn)
    both = SceneObject(
        "both", 3, (Part(quad(0.3, 0.3), leaf), Part(replace(shell, vertices=shell.vertices + [0, 0, 0.7]), front)),
        still((0, 3, -0.4), facing),
    )  # fmt: skip
    what = scene(
        [
            thing("leaf", 1, quad(0.5, 0.5), still((-1.0, 3, 0.1), facing), leaf),
            thing("shell", 2, shell, still((1.0, 3, 0.2), half), front),
            both,
        ]
    )
    with Renderer(gl, what, RenderConfig()) as renderer:
        frame = renderer.labels(0, asked_for(LabelsConfig(boxes=True, ids=True, flow=(), images=False)))
    boxes = frame.boxes
    assert sorted(boxes.instance.tolist()) == [1, 2, 3]
    assert (boxes.occluded < 0.01).all() and (boxes.truncated == 0).all()
    np.testing.assert_allclose(boxes.amodal_pixels, boxes.visible_pixels, rtol=0.01)
    np.testing.assert_allclose(boxes.amodal_box, boxes.visible_box, atol=1.01)


def test_a_holed_body_at_the_edge_of_the_picture_is_cut_there(gl):
    """The opaque half of a plate lies outside: nothing of it is in the picture, and what is has no pixel."""
    alpha = np.zeros((64, 64), np.uint8)
    alpha[:, :32] = 255
    camera = rig().sensors[0].camera
    # The plate's middle on the left edge of the picture.
    x = (-0.5 - camera.cx) / camera.fx * 3
    for at, seen in ((x, False), (x + 0.25, True)):
        plate = thing(
            "plate", 1, quad(0.5, 0.5), still((at, 3, 0), FACING), Material(mask=Mask(alpha), both_sides=True)
        )
        with Renderer(gl, scene([plate]), RenderConfig()) as renderer:
            boxes = renderer.labels(0, asked_for(LabelsConfig(boxes=True, ids=True, flow=(), images=False))).boxes
        assert len(boxes.instance) == seen
        if seen:
            assert boxes.truncated[0] == pytest.approx(0.5, abs=0.03) and boxes.occluded[0] == 0


def test_a_holed_body_far_beside_the_picture_is_looked_for_on_both_sides(gl):
    """A long plate whose middle is open: its box on the right mirrors that on the left, up to twice the picture's
    width."""
    alpha = np.full((64, 64), 255, np.uint8)
    alpha[:, 60:] = 0
    camera, found = rig().sensors[0].camera, []
    for side in (-1, 1):
        cut = Mask(np.ascontiguousarray(alpha[:, ::side]))
        paint, at = Material(mask=cut, both_sides=True), still((side * 3.0, 3, 0), FACING)
        asked = asked_for(LabelsConfig(boxes=True, ids=True, flow=(), images=False))
        with Renderer(gl, scene([thing("plate", 1, quad(3.2, 0.5), at, paint)]), RenderConfig()) as renderer:
            found.append(renderer.labels(0, asked).boxes.amodal_box[0])
    left, right = found
    assert right[2] > 2 * camera.width
    np.testing.assert_allclose(right[[0, 2]], 2 * camera.cx - left[[2, 0]], atol=1.01)
