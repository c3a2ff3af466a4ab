"""Small scenes with known answers, shared by the tests of the reference, of the GPU and of the independent renderer."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Mesh, Part, Scene, SceneObject, Texture

SECOND = 1_000_000_000


def pose(position=(0, 0, 0), rotation=None) -> np.ndarray:
    m = np.eye(4)
    m[:3, 3] = position
    m[:3, :3] = np.eye(3) if rotation is None else rotation.as_matrix()
    return m


# Camera axes for a camera at the origin that looks along world +y with world +z up.
LEVEL = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
FACING = LEVEL * Rotation.from_euler("x", 180, degrees=True)  # a quad that faces a LEVEL camera


def still(position=(0, 0, 0), rotation=None) -> StaticPath:
    return StaticPath(pose(position, rotation))


def drift(p0, p1, r0=None, r1=None, seconds=1.0) -> KeyframePath:
    """Constant velocity and constant body rate from pose 0 at t = 0 to pose 1."""
    identity = Rotation.identity()
    turns = Rotation.concatenate([r0 or identity, r1 or r0 or identity])
    return KeyframePath([0, int(seconds * SECOND)], [p0, p1], turns, interpolation="linear")


def curve(seed: int, centre, spread: float, turn: float, base=None, keys: int = 5) -> KeyframePath:
    """A smooth C2 motion over one second through random way-points."""
    rng = np.random.default_rng(seed)
    positions = np.asarray(centre, float) + spread * rng.uniform(-1, 1, (keys, 3))
    turns = (base or Rotation.identity()) * Rotation.from_rotvec(turn * rng.uniform(-1, 1, (keys, 3)))
    return KeyframePath(np.linspace(0, SECOND, keys).astype(np.int64), positions, turns)


def mesh(vertices, faces, normals=None, uvs=None, closed=False, name="") -> Mesh:
    solid = trimesh.Trimesh(vertices, faces, process=False)
    normals = solid.vertex_normals if normals is None else normals
    uvs = np.asarray(vertices)[:, :2] if uvs is None else uvs
    return Mesh(
        np.asarray(vertices, np.float64), np.asarray(faces, np.int32), np.asarray(normals, np.float32),
        np.asarray(uvs, np.float32), closed, name,
    )  # fmt: skip


def quad(half_x=1.0, half_y=1.0, splits=1) -> Mesh:
    """z = 0, normal +z; texture upright when seen from +z with +y up."""
    s = np.linspace(-1.0, 1.0, splits + 1)
    x, y = (a.ravel() for a in np.meshgrid(s * half_x, s * half_y))
    i = np.arange((splits + 1) ** 2).reshape(splits + 1, splits + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    uvs = np.stack([0.5 + 0.5 * x / half_x, 0.5 - 0.5 * y / half_y], 1)
    return mesh(np.stack([x, y, 0 * x], 1), faces, np.tile([0.0, 0, 1], (len(x), 1)), uvs, name="quad")


def cube(half=1.0) -> Mesh:
    """Closed, flat normals, every side with its own (0, 1) square of texture."""
    vertices, faces, normals, uvs = [], [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * sign
            n = np.eye(3)[axis] * sign
            k = len(vertices)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                vertices.append(half * (n + a * u + b * v))
                normals.append(n)
                uvs.append((0.5 + 0.5 * a, 0.5 - 0.5 * b))
            faces += [(k, k + 1, k + 2), (k, k + 2, k + 3)]
    return mesh(vertices, faces, normals, uvs, closed=True, name="cube")


def sphere(radius=1.0, subdivisions=4) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    n = ball.vertices / radius
    # no seam: a smooth map of the whole sphere, so that interpolated uv means the same for every renderer
    uvs = np.stack([0.5 + 0.5 * n[:, 0], 0.5 - 0.5 * n[:, 2]], 1)
    return mesh(ball.vertices, ball.faces, n, uvs, closed=True, name="sphere")


def smooth_texture(seed=0, size=64, low=0.15, high=0.85) -> Texture:
    """Periodic, band-limited, linear float32: what bilinear and mip-mapped sampling agree on."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:size, 0:size] / size * 2 * np.pi
    image = np.stack(
        [sum(rng.uniform(-1, 1) * np.cos(a * x + b * y + rng.uniform(0, 7)) for a in (1, 2) for b in (0, 1, 2))
         for _ in range(3)], 2)  # fmt: skip
    image = (image - image.min()) / (image.max() - image.min())
    return Texture((low + (high - low) * image).astype(np.float32), name=f"smooth{seed}")


def thing(name, instance_id, shape, path, material=None) -> SceneObject:
    return SceneObject(name, instance_id, (Part(shape, material or Material()),), path)


def placed(number: int, shape, place, rotation=None, material=None, category="object") -> SceneObject:
    """A thing by its number, which stands."""
    part = Part(shape, material or Material())
    return SceneObject(f"{number}", number, (part,), still(place, rotation), category)


def rig(width=160, height=120, focal=150.0, path=None, near=0.05) -> Rig:
    return Rig.alone(
        PinHole(width, height, focal, focal * 1.03, width / 2 - 1.7, height / 2 + 0.6, near),
        path or still(rotation=LEVEL),
    )


def scene(objects, seen_by: Rig | None = None, light=None, background=0.0) -> Scene:
    return Scene(tuple(objects), seen_by or rig(), 0, SECOND, light or Light(), background)


def shifted(path, offset):
    """The same motion somewhere else (numerical tests far from the origin)."""

    class Shifted:
        t0_ns, t1_ns, is_static = path.t0_ns, path.t1_ns, path.is_static

        def pose(self, t_ns):
            m = path.pose(t_ns).copy()
            m[:3, 3] += offset
            return m

        def derivative(self, t_ns):
            return path.derivative(t_ns)

        def poses(self, t_ns):
            m = path.poses(t_ns).copy()
            m[:, :3, 3] += offset
            return m

        def speed_bound(self, ta_ns, tb_ns):
            return path.speed_bound(ta_ns, tb_ns)

    return Shifted()


def moved_scene(original: Scene, offset) -> Scene:
    from dataclasses import replace

    return replace(
        original,
        objects=tuple(replace(o, path=shifted(o.path, offset)) for o in original.objects),
        rig=replace(original.rig, path=shifted(original.rig.path, offset)),
    )


def mixed_scene(width=160, height=120, seed=3, unlit=False, camera_moves=True, textured=True) -> Scene:
    """Room, ground, sphere, cube and a two-sided quad, all textured and all moving: the scene of most comparisons."""

    def paint(k, **more):
        return Material(texture=smooth_texture(seed + k) if textured else None, base_color=(0.9, 0.8 - 0.03 * k, 0.7),
                        unlit=unlit, **more)  # fmt: skip

    room = cube(20.0)
    room = mesh(room.vertices, room.faces[:, ::-1], -room.normals, room.uvs, closed=True, name="room")
    sky = Material(texture=smooth_texture(seed), uv_scale=(3.0, 3.0), unlit=True)
    objects = (
        SceneObject("sky", 1, (Part(room, sky),), still(), "sky"),
        SceneObject("ground", 2, (Part(quad(15, 15, splits=8), paint(1)),), still((0, 5, -1.5)), "ground"),
        thing("ball", 3, sphere(0.8, 4), curve(seed, (-0.9, 5.0, -0.3), 0.3, 0.4), paint(2)),
        thing("box", 4, cube(0.6), curve(seed + 1, (1.0, 4.5, -0.2), 0.3, 0.5), paint(3)),
        thing(
            "sheet", 5, quad(0.5, 0.7), curve(seed + 2, (0.2, 3.6, 0.5), 0.25, 0.6, LEVEL), paint(4, both_sides=True)
        ),
    )
    path = curve(seed + 3, (0, 0, 0), 0.15, 0.05, LEVEL) if camera_moves else still(rotation=LEVEL)
    return scene(objects, rig(width, height, 0.94 * width, path), background=0.0)


def length(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.asarray(vectors, np.float64), axis=-1)


def rates(renderer, t_ns: int, h: int = 1_000_000) -> tuple[np.ndarray, np.ndarray]:
    """d(luminance)/dt as it is drawn, and the difference quotient of frames h ns before and after, (H, W) float64."""
    drawn = renderer.brightness(t_ns).read()[..., 1].astype(np.float64)
    before, after = (renderer.luminance(t_ns + dt).read().astype(np.float64) for dt in (-h, h))
    return drawn, (after - before) / (2e-9 * h)


def largest_speed(velocity: np.ndarray) -> float:
    """Return the largest length of (H, W, 2) vectors."""
    return float(np.linalg.norm(velocity, axis=-1).max())
