"""Falling bodies against what physics says: closed forms, what is conserved, and what users get wrong."""

from __future__ import annotations

import math
import sys
import threading

import numpy as np
import pytest

from blinkgl.config.physics import BodyConfig, PhysicsConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.geometry.meshes import transform_mesh
from blinkgl.scene.geometry.primitives import cone, cuboid, cylinder, grid, icosphere, sphere
from blinkgl.scene.motion.body_shapes import Barrier, damping_ratio, shapes_of
from blinkgl.scene.motion.dynamics import simulate
from blinkgl.scene.motion.paths import HermitePath, KeyframePath, StaticPath
from blinkgl.scene.types import Material, Part, SceneObject
from blinkgl.types.poses import pose_of
from tests.refusals import refusal

G, S = 9.81, 1_000_000_000


def body(name, mesh, at=(0, 0, 0), turn=None, category="object", path=None):
    return SceneObject(name, 1, (Part(mesh, Material()),), path or StaticPath(pose_of(at, turn)), category)


def ball(name="ball", at=(0, 0, 1.0), radius=0.1):
    return body(name, icosphere(radius=radius, subdivisions=2), at)


FLOOR = body("floor", grid(width=40, depth=40), category="ground")


def run(objects, bodies, seconds, t0=0, **settings):
    pytest.importorskip("mujoco")
    t1 = t0 + round(seconds * S)
    made, dynamics = simulate(objects, bodies, PhysicsConfig(**settings), t0, t1)
    return {obj.name: obj.path for obj in made}, dynamics


def states(path, times):
    """Positions, velocities (n, 3), rotations (n, 3, 3) and world angular velocities (n, 3)."""
    T = path.poses(times)
    D = np.stack([path.derivative(int(t)) for t in times])
    W = D[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)
    return T[:, :3, 3], D[:, :3, 3], T[:, :3, :3], np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], 1)


def apexes(path, seconds):
    """Times, s, and heights of the tops of a bouncing body's flights, the first left out (it is dropped from rest)."""
    t = np.arange(1, round(seconds * 2000)) * (S // 2000)
    vz = np.array([path.derivative(int(x))[2, 3] for x in t])
    tops = np.flatnonzero((vz[:-1] > 0) & (vz[1:] <= 0))
    found = []
    for k in tops:
        exact = t[k] + round((t[k + 1] - t[k]) * vz[k] / (vz[k] - vz[k + 1]))
        found.append((exact * 1e-9, path.pose(exact)[2, 3]))
    return np.array(found).T


@pytest.mark.parametrize(("e", "rate", "height", "late"), [(0.8, 20_000, 0.015, 0.025), (0.6, 200_000, 0.012, 0.006)])
def test_five_bounces_are_those_of_the_closed_form(e, rate, height, late):
    """Heights as a share of each drop's, times in s after five bounces; what is left is the phase in which a step meets
    the ground."""
    h = 0.9
    fall = math.sqrt(2 * h / G)
    tops = [fall + sum(2 * e**k * fall for k in range(1, n)) + e**n * fall for n in range(1, 6)]
    paths, dynamics = run([ball(), FLOOR], {"ball": BodyConfig(restitution=e)}, tops[-1] + 0.05, rate=rate)
    times, heights = apexes(paths["ball"], tops[-1] + 0.05)
    assert len(times) == 5
    np.testing.assert_allclose(np.sqrt((heights - 0.1) / (h * e ** (2 * np.arange(1, 6)))), 1, atol=2 * height)
    np.testing.assert_allclose(times, tops, atol=late)
    impacts = [fall + sum(2 * e**k * fall for k in range(1, n)) for n in range(1, 6)]
    np.testing.assert_allclose(np.array(dynamics.impacts_ns[:5]) * 1e-9, impacts, atol=late)


def test_a_flight_is_a_parabola():
    paths, _ = run([ball()], {"ball": BodyConfig(velocity=(1.0, -2.0, 3.0), spin=(90.0, 0.0, 720.0))}, 1.0)
    t = np.arange(0, S, 7_654_321)
    p, v, _, w = states(paths["ball"], t)
    s = t[:, None] * 1e-9
    np.testing.assert_allclose(p, [0, 0, 1] + np.array([1.0, -2, 3]) * s - [0, 0, 0.5 * G] * s**2, atol=1e-9)
    np.testing.assert_allclose(v, np.array([1.0, -2, 3]) - [0, 0, G] * s, atol=1e-6)
    np.testing.assert_allclose(w, np.broadcast_to(np.radians([90.0, 0, 720]), w.shape), atol=1e-6)


def test_the_centre_of_mass_flies_not_the_origin():
    """A cone's is a quarter of its height above its base, and its mesh is centred elsewhere."""
    mesh = transform_mesh(cone(radius=0.2, height=0.6, segments=48), np.diag([1.0, 1.0, 1.0]))
    paths, _ = run([body("cone", mesh, (0, 0, 2))], {"cone": BodyConfig(spin=(300.0, 200.0, 0.0))}, 0.6)
    low, high = mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()
    centre = np.array([0, 0, low + (high - low) / 4])
    t = np.arange(0, 6 * S // 10, 10_000_000)
    p, _, R, _ = states(paths["cone"], t)
    flown = p + R @ centre
    np.testing.assert_allclose(flown[:, :2], 0, atol=1e-5)
    np.testing.assert_allclose(flown[:, 2], 2 + centre[2] - 0.5 * G * (t * 1e-9) ** 2, atol=1e-5)
    assert np.abs(p[:, :2]).max() > 0.02


def test_a_die_never_gains_energy():
    """Kinetic (with turning) and potential energy at 1 kHz: before the first impact constant, later never more than
    before, in the end at rest. What a spring of the contact holds for its 1.6 ms is not counted, so impacts dip."""
    a, m = 0.2, 1.0
    die = body("die", cuboid(extents=(a, a, a)), (0, 0, 1.2))
    config = BodyConfig(mass=m, restitution=0.5, friction=0.4, velocity=(1.0, 0.3, 0.0), spin=(400.0, 250.0, 100.0))
    paths, dynamics = run([die, FLOOR], {"die": config}, 2.5)
    t = np.arange(0, 5 * S // 2, 1_000_000)
    p, v, _, w = states(paths["die"], t)
    energy = 0.5 * m * (v**2).sum(1) + 0.5 * (m * a * a / 6) * (w**2).sum(1) + m * G * p[:, 2]
    first = np.searchsorted(t, dynamics.impacts_ns[0]) - 3
    np.testing.assert_allclose(energy[:first], energy[0], rtol=1e-6)
    impacts = np.array(dynamics.impacts_ns)
    free = np.array([np.abs(impacts - x).min() > 3_000_000 for x in t])
    assert (np.diff(energy[free]) < 2e-3 * energy[0]).all()
    assert energy[-1] == pytest.approx(m * G * a / 2, rel=1e-3)
    assert not v[-1].any() and not w[-1].any()


def test_two_bodies_keep_their_momentum_and_restitution():
    """Two balls that meet off their centres without gravity: momentum and angular momentum; head on: restitution."""
    one, two = ball("one", (-0.5, 0, 0)), ball("two", (0.5, 0.08, 0), radius=0.15)
    config = {
        "one": BodyConfig(mass=1.0, restitution=0.7, friction=0.3, velocity=(2.0, 0, 0), spin=(0, 0, 300.0)),
        "two": BodyConfig(mass=3.0, restitution=0.9, friction=0.3, velocity=(-1.0, 0, 0)),
    }
    paths, dynamics = run([one, two], config, 0.6, gravity=(0, 0, 0))
    assert len(dynamics.impacts_ns) >= 1
    t = np.array([0, 100_000_000, 500_000_000, 590_000_000])
    total, turning = 0.0, 0.0
    for name, m, r in (("one", 1.0, 0.1), ("two", 3.0, 0.15)):
        p, v, _, w = states(paths[name], t)
        total = total + m * v
        turning = turning + m * np.cross(p, v) + 0.4 * m * r * r * w
    np.testing.assert_allclose(total, np.broadcast_to(total[0], total.shape), atol=1e-6)
    np.testing.assert_allclose(turning, np.broadcast_to(turning[0], turning.shape), atol=2e-5)
    head_on = [ball("one", (-0.5, 0, 0)), ball("two", (0.5, 0, 0))]
    paths, _ = run(
        head_on, config | {"one": config["one"].model_copy(update={"spin": (0, 0, 0)})}, 0.6, gravity=(0, 0, 0)
    )
    after = [states(paths[name], np.array([S // 2]))[1][0, 0] for name in ("one", "two")]
    assert (after[1] - after[0]) / 3.0 == pytest.approx(0.7, abs=0.02)  # the smaller of the two


def test_friction_stops_a_sliding_block_where_it_should():
    block = body("block", cuboid(extents=(0.3, 0.3, 0.1)), (0, 0, 0.05))
    paths, _ = run([block, FLOOR], {"block": BodyConfig(friction=0.4, velocity=(2.0, 0, 0), restitution=0.0)}, 1.2)
    end = paths["block"].pose(S)
    assert end[0, 3] == pytest.approx(2.0**2 / (2 * 0.4 * G), rel=0.02)
    assert end[2, 3] == pytest.approx(0.05, abs=1e-4)
    np.testing.assert_array_equal(end, paths["block"].pose(6 * S // 5))  # asleep: to the bit


def test_an_impact_is_not_overshot():
    """Between steps, too, the ball is never deeper than its spring lets it, and its velocity jumps inside 2 ms."""
    paths, dynamics = run([ball(), FLOOR], {"ball": BodyConfig(restitution=0.5)}, 0.6)
    path, at = paths["ball"], dynamics.impacts_ns[0]
    t = np.arange(at - 5_000_000, at + 5_000_000, 1_000)
    z = path.poses(t)[:, 2, 3]
    v = math.sqrt(2 * G * 0.9)
    assert 0 < 0.1 - z.min() < v * 1.6e-3 / math.pi
    rates = [path.derivative(at + dt)[2, 3] for dt in (-1_500_000, 1_500_000)]
    np.testing.assert_allclose(rates, [-v, 0.5 * v], atol=0.1)
    speeds = [abs(path.derivative(int(x))[2, 3]) for x in t]
    assert max(speeds) < 1.02 * v and v < path.speed_bound(t[0], t[-1])[0] < 1.1 * v
    # Continuous at every knot, and the derivative is that of the poses.
    for knot in path.key_times_ns[1:-1]:
        assert np.abs(path.pose(knot + 1) - path.pose(knot - 1)).max() < 1e-7
        assert np.abs(path.derivative(knot + 1) - path.derivative(knot - 1)).max() < 0.02


def test_what_is_on_its_way_pushes_and_is_not_stopped():
    """A bat on key frames hits a ball at rest: it leaves at (1 + e) times the bat's speed."""
    bat = KeyframePath([0, S], [(-1, 0, 0), (1, 0, 0)], np.tile([0.0, 0, 0, 1], (2, 1)), "linear")
    objects = [body("bat", cuboid(extents=(0.1, 1, 1)), path=bat), ball(at=(0, 0, 0))]
    paths, _ = run(objects, {"ball": BodyConfig(restitution=0.5)}, 0.9, gravity=(0, 0, 0))
    assert paths["bat"] is bat
    _, v, _, _ = states(paths["ball"], np.array([8 * S // 10]))
    np.testing.assert_allclose(v[0], [2 * 1.5, 0, 0], atol=0.05)


def test_nothing_enters_the_camera_nor_leaves_by_the_sides():
    pytest.importorskip("mujoco")
    eye = StaticPath(np.eye(4))
    (thrown,), _ = simulate(
        [ball(at=(-1, 0, 0))],
        {"ball": BodyConfig(velocity=(3.0, 0, 0), restitution=0.9)},
        PhysicsConfig(gravity=(0, 0, 0)),
        0,
        2 * S,
        camera=(eye, 0.3),
        sides=[Barrier((1.0, 0.0, 0.0), -1.5)],
    )
    p = thrown.path.poses(np.arange(0, 2 * S, 1_000_000))[:, :3, 3]
    assert np.linalg.norm(p, axis=1).min() > 0.4 - 0.003
    assert p[:, 0].min() > -1.4 - 0.003


def test_the_same_again_in_any_thread():
    objects = [body("die", cuboid(extents=(0.2, 0.2, 0.2)), (0, 0, 0.4)), ball(at=(0.05, 0, 0.8)), FLOOR]
    bodies = {"die": BodyConfig(spin=(90.0, 20.0, 0.0)), "ball": BodyConfig()}
    found = [run(objects, bodies, 0.6)[1]]
    thread = threading.Thread(target=lambda: found.append(run(objects, bodies, 0.6)[1]))
    thread.start()
    thread.join()
    found.append(run(objects, bodies | {"ball": BodyConfig(friction=0.51)}, 0.6)[1])
    assert found[0] == found[1]
    assert found[0].digest != found[2].digest


def test_shapes_are_what_the_mesh_is():
    kinds = {
        "BOX": cuboid(extents=(1, 2, 3), subdivisions=3),
        "SPHERE": sphere(radius=0.3, segments=48, rings=24),
        "MESH": cylinder(radius=0.5, height=1.0),
    }
    for kind, mesh in kinds.items():
        (shape,) = shapes_of(body("it", mesh), BodyConfig())
        assert shape.kind == kind
    (plane,) = shapes_of(FLOOR, BodyConfig(kind="fixed"))
    assert plane.kind == "PLANE"
    (shelf,) = shapes_of(body("shelf", grid(width=2, depth=1)), BodyConfig(kind="fixed"))
    assert shelf.kind == "BOX" and sorted(shelf.size) == pytest.approx([0.01, 0.5, 1.0])


def test_a_ball_comes_to_rest_on_a_shelf():
    shelf = body("shelf", grid(width=1, depth=1), (0, 0, 0.5))
    paths, _ = run([ball(), shelf], {"ball": BodyConfig(restitution=0.2)}, 1.5)
    assert paths["ball"].pose(3 * S // 2)[2, 3] == pytest.approx(0.6 + 0.01 * 0.5, abs=1e-3)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("flatness", [1.0, 1e-3, 1e-7])
def test_any_size_and_any_flatness_falls(size, flatness):
    """Grains, houses, sheets of paper: MuJoCo itself refuses what weighs less than nothing or has no volume."""
    mesh = transform_mesh(cone(radius=0.5, height=1.0), np.diag([size, size, size * flatness]))
    made = body("it", mesh, (0, 0, 2 * size))
    paths, _ = run([made, FLOOR], {"it": BodyConfig(spin=(9.0, 0, 0))}, 0.02, rate=2000)
    assert paths["it"].pose(S // 100)[2, 3] == pytest.approx(2 * size - 0.5 * G * 1e-4, abs=2e-3 * size)


@pytest.mark.parametrize("e", [0.0, 0.3, 0.7, 0.95])
def test_the_damping_is_that_of_a_spring_let_go(e):
    """The continuous spring with a damper that does not pull: what so many steps come to."""
    ratio = damping_ratio(e, 400.0)
    if e == 0.0:
        assert ratio > 1.0
        return
    root = math.sqrt(1 - ratio**2)
    t = (math.pi - math.atan2(2 * ratio * root, 1 - 2 * ratio**2)) / root
    assert math.exp(-ratio * t) * (ratio / root * math.sin(root * t) - math.cos(root * t)) == pytest.approx(e, abs=2e-3)


# ---- what goes wrong -------------------------------------------------------------------------------------------------


def test_bodies_inside_each_other_are_refused():
    with pytest.raises(ConfigError, match=r"at the start ball is 0\.06\d* m inside (floor|it).*none"):
        run([ball(at=(0, 0, 0.04)), FLOOR], {"ball": BodyConfig()}, 0.1)
    with pytest.raises(ConfigError, match="inside"):
        run([ball("one"), ball("two", at=(0.05, 0, 1))], {"one": BodyConfig(), "two": BodyConfig()}, 0.1)
    # A trifle is lifted out, and does not jump.
    paths, _ = run([ball(at=(0, 0, 0.0995)), FLOOR], {"ball": BodyConfig(restitution=0.9)}, 0.3)
    assert np.ptp(paths["ball"].poses(np.arange(0, 3 * S // 10, 1_000_000))[:, 2, 3]) < 1e-4


def test_an_explosion_is_refused():
    with pytest.raises(ConfigError, match=r"scene.physics: ball diverges 0.10.* s after the start.*max_speed 1"):
        run([ball()], {"ball": BodyConfig()}, 0.5, max_speed=1.0)
    refusal(ConfigError, run, [ball()], {"ball": BodyConfig(velocity=(0, 0, 500.0))}, 0.5, match="diverges 0 s")


def test_a_nan_is_an_explosion(monkeypatch):
    mujoco = pytest.importorskip("mujoco")
    step = mujoco.mj_step

    def broken(model, data):
        step(model, data)
        data.qpos[:] = np.nan

    monkeypatch.setattr(mujoco, "mj_step", broken)
    refusal(ConfigError, run, [ball()], {"ball": BodyConfig()}, 0.1, match="diverges")


def test_without_mujoco_there_is_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match=r"needs MuJoCo.*run .* -m pip install 'mujoco"):
        simulate([ball()], {"ball": BodyConfig()}, PhysicsConfig(), 0, S)


def test_a_path_of_one_pose_stands_still():
    path = HermitePath(np.array([5]), np.ones((1, 3)), np.ones((1, 3)), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)))
    assert path.is_static and (path.t0_ns, path.t1_ns) == (5, 5)
    np.testing.assert_array_equal(path.pose(7)[:3, 3], 1)
