"""Collisions against closed-form times, and against brute force on random scenes."""

import itertools
import math

import fcl
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from blinkgl.config.trajectory import CameraMotion, ObjectMotion
from blinkgl.scene.motion.collision import resolve_collisions
from blinkgl.scene.motion.paths import CutPath, KeyframePath, StaticPath
from blinkgl.scene.motion.trajectories import FreeSpace
from blinkgl.scene.types import Material, Mesh, Part, SceneObject
from blinkgl.types.poses import pose_of
from tests.scene.motion.starts import free_place, random_camera_path, random_path

SECOND = 1_000_000_000
FAR = StaticPath(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1e4], [0, 0, 0, 1]]))  # a camera out of the way
BOX = trimesh.creation.box((1, 1, 1))


def body(name, shape, path, category="object"):
    v, f = np.array(shape.vertices, dtype=np.float64), np.array(shape.faces, dtype=np.int32)
    normals, uvs = np.zeros((len(v), 3), np.float32), np.zeros((len(v), 2), np.float32)
    return SceneObject(name, 1, (Part(Mesh(v, f, normals, uvs, shape.is_watertight), Material()),), path, category)


def at(x=0.0, y=0.0, z=0.0, rotvec=(0, 0, 0)):
    return pose_of((x, y, z), Rotation.from_rotvec(rotvec).as_matrix())


def line(start, velocity, duration=1.0, spin=(0, 0, 0)):
    """Constant velocity and constant body rate; exact in a linear path when turns stay below pi per key."""
    n = max(2, int(np.linalg.norm(spin) * duration) + 2)
    s = np.linspace(0, duration, n)
    return KeyframePath(
        np.rint(s * SECOND).astype(np.int64),
        np.asarray(start) + s[:, None] * np.asarray(velocity, float),
        Rotation.from_rotvec(s[:, None] * np.asarray(spin, float)),
        "linear",
    )


def plane(size=10.0, z=0.0):
    return trimesh.Trimesh(
        [[-size, -size, z], [size, -size, z], [size, size, z], [-size, size, z]], [[0, 1, 2], [0, 2, 3]], process=False
    )


def ground(size=10.0):
    return body("ground", plane(size), StaticPath(), "ground")


def resolve(objects, camera=FAR, radius=0.1, t1=SECOND, **settings):
    return resolve_collisions(objects, camera, radius, 0, t1, **settings)


def only(result):
    assert len(result.events) == 1, result.log
    return result.events[0]


# ---- closed-form times -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed, tolerance", [(3.0, 1e-3), (50.0, 1e-3), (3.0, 1e-6)])
def test_cube_flies_into_a_wall(speed, tolerance):
    wall = body("wall", trimesh.creation.box((0.2, 20, 20)), StaticPath(at(2.6)), "wall")
    cube = body("cube", BOX, line((0, 0, 0), (speed, 0, 0)))
    event = only(resolve([cube, wall], tolerance=tolerance))
    tol = tolerance * math.sqrt(0.75)
    # Faces are 2 apart: stopped at a separation in [tol / 2, tol].
    assert (2 - tol) / speed - 2e-9 <= event.t_ns * 1e-9 <= (2 - tol / 2) / speed + 2e-9
    assert tol / 2 * (1 - 1e-6) <= event.separation <= tol and event.cut == ("cube",)


def test_a_turning_cube_touches_with_its_edge():
    # Spin w about z next to a wall at distance g from the centre: the edge reaches sqrt(1/2) cos(pi/4 - w t).
    w, g = 1.0, 0.65
    wall = body("wall", trimesh.creation.box((1, 9, 9)), StaticPath(at(g + 0.5)), "wall")
    event = only(resolve([body("cube", BOX, line((0, 0, 0), (0, 0, 0), spin=(0, 0, w))), wall]))
    tol = 1e-3 * math.sqrt(0.75)
    times = [(math.pi / 4 - math.acos((g - s) / math.sqrt(0.5))) / w for s in (tol, tol / 2)]
    assert times[0] - 1e-9 <= event.t_ns * 1e-9 <= times[1] + 1e-9


def test_the_camera_falls_onto_the_ground():
    # A parabola is a cubic: the not-a-knot spline through four points is the fall itself.
    g, h, r = 9.81, 2.0, 0.25
    s = np.linspace(0, 1, 4)
    fall = KeyframePath(
        np.rint(s * SECOND).astype(np.int64),
        np.c_[0 * s, 0 * s, h - 0.5 * g * (np.rint(s * SECOND) * 1e-9) ** 2],
        Rotation.identity(4),
    )
    result = resolve([ground()], fall, r)
    event = only(result)
    tol = 1e-3 * r
    early, late = (math.sqrt(2 * (h - r - s) / g) for s in (tol, tol / 2))
    assert early - 2e-9 <= event.t_ns * 1e-9 <= late + 2e-9 and event.cut == ("camera",)
    assert r < result.camera_path.pose(SECOND)[2, 3] <= r + tol


def test_two_spheres_meet_off_centre():
    # Camera spheres are exact; an icosphere's surface lies between its in- and circumsphere.
    ball = trimesh.creation.icosphere(4, radius=0.5)
    inner = np.abs(np.einsum("ij,ij->i", ball.face_normals, ball.triangles[:, 0])).min()
    result = resolve(
        [body("ball", ball, line((4, 0.4, 0), (-3, 0, 0), spin=(1, 2, 0)))], line((0, 0, 0), (1, 0, 0)), 0.3
    )
    event = only(result)

    def meeting(reach):  # |(4 - 4 t, 0.4)| = reach
        return (4 - math.sqrt(reach**2 - 0.16)) / 4

    assert meeting(0.8 + 3e-4) - 1e-9 <= event.t_ns * 1e-9 <= meeting(0.3 + inner) + 1e-9
    assert set(event.cut) == {"ball", "camera"}


def test_head_on_both_stop_and_the_order_of_the_list_does_not_matter():
    a, b = body("a", BOX, line((-2, 0, 0), (2, 0, 0))), body("b", BOX, line((2, 0, 0), (-2, 0, 0)))
    forward, backward = resolve([a, b]), resolve([b, a])
    assert only(forward).t_ns == only(backward).t_ns and set(only(forward).cut) == {"a", "b"}
    xa, xb = (o.path.pose(SECOND)[0, 3] for o in forward.objects)
    assert xa == pytest.approx(-xb, abs=1e-12) and 1 < xb - xa <= 1 + 1e-3
    assert all(isinstance(o.path, CutPath) for o in forward.objects)


# ---- no tunnelling ---------------------------------------------------------------------------------------------------


def through_the_hole(offset):
    ring = body("ring", trimesh.creation.torus(1.0, 0.3, major_sections=48, minor_sections=24), StaticPath())
    return resolve([body("ball", trimesh.creation.icosphere(2, radius=0.4), line((offset, 0, -2), (0, 0, 4))), ring])


def test_exact_triangles_let_a_ball_through_a_ring():
    assert not through_the_hole(0.2).events and only(through_the_hole(0.4))


# ---- later collisions see earlier cuts -------------------------------------------------------------------------------


def test_a_stopped_body_is_an_obstacle_and_one_that_never_came_is_none():
    wall = body("wall", trimesh.creation.box((1, 9, 9)), StaticPath(at(5)), "wall")
    first = body("first", BOX, line((2, 0, 0), (4, 0, 0)))  # reaches the wall's face (4.5) at t = 0.5
    second = body("second", BOX, line((-3, 0, 0), (8, 0, 0)))  # reaches first's back (3.5) at t = 0.75
    crossing = body("crossing", BOX, line((6.4, 3, 0), (0, -4, 0)))  # behind the wall, where first would have come
    assert any(e.cut == ("first", "crossing") for e in resolve([first, crossing]).events)
    result = resolve([first, second, crossing, wall])
    assert [e.cut for e in result.events] == [("first",), ("second",)]
    assert result.events[1].t_ns * 1e-9 == pytest.approx(0.75, abs=1e-3)
    assert result.objects[2].path is crossing.path
    assert [e.t_ns for e in result.events] == sorted(e.t_ns for e in result.events)
    assert "first touches wall; stopped: first" in result.log[0]


# ---- rest ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("support", ["plane", "slab"])
def test_what_rests_on_the_ground_slides_lifts_off_and_sinks(support):
    base = (
        ground()
        if support == "plane"
        else body("ground", trimesh.creation.box((20, 20, 1)), StaticPath(at(z=-0.5)), "ground")
    )
    rolled = line((0, 0, 0.5), (1, 0.5, 0), spin=(0, 0, 2))
    assert not resolve([body("slides", BOX, rolled), base]).events
    assert not resolve([body("just above", BOX, line((0, 0, 0.5 + 1e-9), (1, 0, 0))), base]).events
    assert not resolve([body("lifts off", BOX, line((0, 0, 0.5), (0, 0, 2))), base]).events
    hop = KeyframePath([0, SECOND // 2, SECOND], [[0, 0, 0.5], [0, 0, 1], [0, 0, -2]], Rotation.identity(3))
    for name, path in (
        ("sinks", line((0, 0, 0.5), (0, 0, -1))),
        ("hops and dives", hop),
        ("tips", line((0, 0, 0.5), (0, 0, 0), spin=(1, 0, 0))),
    ):
        result = resolve([body(name, BOX, path), base])
        assert only(result).t_ns > 0
        lowest = (BOX.vertices @ result.objects[0].path.pose(SECOND)[:3, :3].T)[:, 2].min() + result.objects[
            0
        ].path.pose(SECOND)[2, 3]
        assert -0.0101 * math.sqrt(0.75) <= lowest < 0.0, name


def test_touching_ground_that_is_not_convex_or_another_body_at_the_start_is_reported():
    hills = plane().subdivide()
    hills.vertices[:, 2] -= np.cos(hills.vertices[:, 0] * 0.1) - 1
    path = line((0, 0, 0.5), (1, 0, 0))
    result = resolve([body("cube", BOX, path), body("ground", hills, StaticPath(), "ground")])
    assert result.at_start == result.events and only(result).t_ns == 0 and result.objects[0].path.is_static
    assert only(resolve([body("cube", BOX, path), body("other", BOX, StaticPath(at(-1, 0, 0.5)))])).t_ns == 0


def test_off_the_edge_of_the_ground_it_may_fall():
    off = KeyframePath([0, SECOND // 2, SECOND], [[0, 0, 0.5], [3, 0, 0.8], [4, 0, -3]], Rotation.identity(3))
    assert not resolve([body("cube", BOX, off), ground(size=1.5)]).events


def test_the_camera_may_be_in_the_sky():
    box = trimesh.creation.box((50, 50, 50))
    for shape in (box, box.copy()):
        shape is box or shape.invert()
        assert not resolve([body("sky", shape, StaticPath(), "sky")], line((0, 0, 1), (1, 0, 0))).events
    assert only(
        resolve([body("sky", box, StaticPath(), "sky")], line((0, 0, 0), (40, 0, 0)))
    ).t_ns * 1e-9 == pytest.approx(24.9 / 40, abs=1e-5)


# ---- random scenes against brute force -------------------------------------------------------------------------------


def random_scene(seed, count=7):
    rng = np.random.default_rng(seed)
    shapes = [
        trimesh.creation.icosphere(1),
        trimesh.creation.torus(0.8, 0.25, major_sections=12, minor_sections=8),
        trimesh.creation.box((1.4, 1.4, 0.05)),
        trimesh.creation.cone(0.5, 1.5, sections=8),
    ]
    objects, centres, radii = [ground(6.0)], np.zeros((0, 3)), np.zeros(0)
    for k in range(count):
        shape = shapes[k % len(shapes)].copy()
        shape.apply_scale(rng.uniform(0.25, 0.6))
        r = float(np.linalg.norm(shape.vertices, axis=1).max())
        turn = rng.normal(size=3)
        start = at(*free_place(rng, FreeSpace((-2, -2, 0), (2, 2, 2.5), 0.0, centres, radii), r), turn)
        path = random_path(
            rng,
            0,
            SECOND,
            ObjectMotion(speed=[2, 6], rotation_rate=[50, 900]),
            FreeSpace((-2, -2, 0), (2, 2, 2.5), 0.0),
            r,
            start,
        )
        centres, radii = np.vstack([centres, start[:3, 3]]), np.r_[radii, r]
        objects.append(body(f"object {k}", shape, path))
    camera = random_camera_path(
        rng,
        0,
        SECOND,
        CameraMotion(speed=3.0),
        FreeSpace((-2, -2, 0), (2, 2, 2.5), 0.0, centres, radii),
        0.15,
        (0, 0, 1),
    )
    return objects, camera


class Brute:
    """Do any of the paths' bodies intersect at t? fcl's collision test, no distances, no bounds."""

    def __init__(self, objects, camera, radius):
        self.paths = [o.path for o in objects] + [camera]
        self.shapes = []
        for o in objects:
            model = fcl.BVHModel()
            mesh = o.parts[0].mesh
            model.beginModel(len(mesh.vertices), len(mesh.faces))
            model.addSubModel(mesh.vertices, mesh.faces)
            model.endModel()
            self.shapes.append(fcl.CollisionObject(model))
        self.shapes.append(fcl.CollisionObject(fcl.Sphere(radius)))
        self.reach = [o.radius for o in objects[1:]] + [radius]

    def hits(self, t):
        poses = [p.pose(t) for p in self.paths]
        for shape, T in zip(self.shapes, poses):
            shape.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        for i, j in itertools.combinations(range(len(poses)), 2):
            if i == 0:
                near = poses[j][2, 3] < self.reach[j - 1]
            else:
                near = np.linalg.norm(poses[i][:3, 3] - poses[j][:3, 3]) < self.reach[i - 1] + self.reach[j - 1]
            if near and fcl.collide(self.shapes[i], self.shapes[j], fcl.CollisionRequest(), fcl.CollisionResult()):
                return True
        return False


@pytest.mark.parametrize("seed", range(6))
def test_random_scenes_have_no_intersection_left_and_no_cut_without_reason(seed):
    objects, camera = random_scene(seed)
    result = resolve(objects, camera, 0.15)
    assert not result.at_start and result.events  # these scenes are dense
    after = Brute(result.objects, result.camera_path, 0.15)
    times = np.linspace(0, SECOND, 500).astype(np.int64)
    assert not any(after.hits(t) for t in times)
    # Up to the first event nothing intersects in the paths as given; had they gone on past it, something would.
    before = Brute(objects, camera, 0.15)
    first = result.events[0].t_ns
    assert not any(before.hits(t) for t in times[times <= first])
    assert all(0 < e.separation <= 1e-3 for e in result.events if "ground" not in (e.first, e.second))
    again = resolve(objects, camera, 0.15)
    assert again.events == result.events


def test_wrong_parameters_are_programming_errors():
    for settings in (
        {"tolerance": 0},
        {"tolerance": 0.101},
        {"rest_margin": 0},
        {"rest_margin": 0.101},
        {"radius": 0},
        {"t1": -1},
    ):
        with pytest.raises(ValueError, match="tolerance and rest_margin in"):
            resolve([ground()], **settings)
    for settings in ({"tolerance": 0.1}, {"rest_margin": 0.1}, {"t1": 0}):
        assert resolve([ground()], **settings).events == ()
