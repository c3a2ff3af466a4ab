"""Scenes in Python: the parts of ``scene: {kind: explicit}``, checked by the same models,
drawn from the same data classes.

    path = Keyframes({0: look_at((-3, 0, 1), (0, 0, 0)), 1: look_at((-3, 1, 1), (0, 0, 0))})
    scene = Scene(Camera(320, 240, pose=path))
    scene += Primitive("cuboid", material=Material(procedural="bricks"))

World: right-handed, z up. Lengths in metres, angles in degrees, times in seconds on the scene's clock. All parts are
immutable values: ``scene + body`` is another scene. A wrong argument raises a ConfigError with its name when the part
is created.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from blinkgl.config.base import placed
from blinkgl.config.camera import CameraConfig, calibrated
from blinkgl.config.deform import AnimationConfig
from blinkgl.config.physics import BodyConfig, PhysicsConfig
from blinkgl.config.problems import validate
from blinkgl.config.run import RunTemplate
from blinkgl.config.scene import ExplicitSceneConfig, MeshConfig, ObjectConfig
from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.poses import Keyframes, Piece, Pose, Trajectory, Vector, motion_tree, signed_by
from blinkgl.front.pyrender_scenes import taken
from blinkgl.front.surfaces import Light, Material
from blinkgl.scene import types as data
from blinkgl.scene.geometry.meshes import make_mesh
from blinkgl.scene.surfaces.coats import COATS
from blinkgl.scene.surfaces.images import content_hash
from blinkgl.scene.worlds.explicit import InMemory, explicit_scene, primitive_mesh
from blinkgl.types.trees import Tree


@signed_by(CameraConfig)
class Camera(Piece):
    """A camera, its lens and its motion.

    width, height : px (default 346 x 260).   fov : horizontal field of view, degrees (default 60), or focal : focal
    length, px, or fx, fy.
    cx, cy : principal point, px; (0, 0) is the centre of the top-left pixel; default: the image's
    centre.   near : m, nothing nearer is drawn.
    lens : "pinhole", "radtan" with distortion=(k1, k2, p1, p2[, k3]), or "equidistant" with (k1, k2, k3, k4).
    calibration : YAML file of Kalibr or DSEC instead of size, intrinsics and lens; calibration_name : the camera's name
    in it.
    pose : :class:`Pose`, :class:`Keyframes`, :class:`Trajectory` or a position (3,); OpenCV axes (x right, y down, z
    forward).
    Raises ConfigError."""

    def __init__(
        self,
        width: int | None = None,
        height: int | None = None,
        *,
        calibration: str | os.PathLike | None = None,
        pose: Pose | Keyframes | Trajectory | Vector = (0.0, 0.0, 0.0),
        **keys: object,
    ):
        table = {"near": 0.05, **check.given(width=width, height=height, **keys)}
        if calibration is None:
            table = {"width": 346, "height": 260, **table}
        else:
            file = str(check.path(calibration, "calibration"))
            table = calibrated({"calibration_name": None, **table, "calibration": file}, Path.cwd())
        self.tree = self._checked(CameraConfig, table)
        self.motion = motion_tree(pose, "Camera.pose")


@signed_by(BodyConfig)
class Body(Piece):
    """Physics of a body: ``Primitive("cuboid", body=Body(velocity=(1, 0, 2)))`` (docs/scenes.md, "Dynamics").

    kind : "dynamic" falls; "fixed" stays, or follows its path, whatever hits it; "none" has no collisions.
    mass : kg, or by density : kg/m³ (default 700).
    friction : Coulomb's coefficient.   rolling : the coefficient of rolling, as a part of the radius.
    restitution : fraction of the speed that remains after an impact.
    velocity : (3,) m/s, of the centre of mass at the start.   spin : (3,) degrees/s about the world's axes. Raises
    ConfigError; a missing MuJoCo and intersecting bodies raise when the scene is built."""

    def __init__(self, kind: Literal["dynamic", "fixed", "none"] = "dynamic", **keys: object):
        self.tree = self._checked(BodyConfig, check.given(kind=kind, **keys))


class Deform(Piece):
    """Change of a body's shape over time, by a formula: ``Mesh("tree.glb", deform=Deform("bend", angle=10))``.

    kind : "wave", "flag", "twist", "bend", "breathe", or that of your own deformer.
    keys : of that kind (docs/configuration.md, "deform"), such as ``amplitude`` and ``wavelength`` in parts of the
    body's size, ``period`` s, ``phase`` and ``angle`` degrees, ``along`` and ``towards`` axes of the body at rest.
    Raises ConfigError."""

    def __init__(self, kind: str = "wave", **keys: float | str | Vector):
        tree = {"kind": check.one_of(kind, "Deform.kind", str, "the name of a deformation"), **check.given(**keys)}
        self._checked(ObjectConfig, {"mesh": "mesh", "deform": tree}, deform="")
        self.tree = tree


class Animation(Piece):
    """A clip for a glTF file's skins, morph targets and nodes: ``Mesh("ann.glb",
    animation=Animation("Walk", speed=1.2))``.

    clip : name or number of the animation.   file : another glTF file that contains it, whose joints have the same
    names; None: the mesh's own.   speed : factor on the clip's own, negative backwards.   phase : s of the clip at time
    0.   loop : restarts at its end; False: constant before its first and after its last key.
    Raises ConfigError; a clip that the file does not contain raises when the scene is built."""

    def __init__(
        self,
        clip: str | int = 0,
        *,
        file: str | os.PathLike | None = None,
        speed: float = 1.0,
        phase: float = 0.0,
        loop: bool = True,
    ):
        tree = check.given(clip=clip, file=file, speed=speed, phase=phase, loop=loop)
        self.tree = self._checked(AnimationConfig, tree)


class Way(Piece):
    """A curve that a body follows at constant speed, its x axis forwards: the ``pose`` of a walking figure.

    points : (N, 3) m, two or more, through which the curve passes smoothly; beyond its ends it is straight.
    speed : m/s; None: the speed of a figure's steps or a fish's strokes, 1 for other bodies.
    closed : continue from the last point to the first.   level : the body's z axis stays up; False: its x axis follows
    the curve's slope.   start : fraction of the curve already covered at time 0.
    Raises ConfigError."""

    def __init__(
        self,
        points: Sequence[Vector] | np.ndarray,
        *,
        speed: float | None = None,
        closed: bool = False,
        level: bool = True,
        start: float = 0.0,
    ):
        tree = check.given(points=points, speed=speed, closed=closed, level=level, start=start)
        self._checked(ObjectConfig, {"mesh": "mesh", "way": tree}, way="")
        self.tree = tree


class _Object(Piece):
    """Common base of primitives and meshes: an object of the scene, its mesh and its material."""

    mesh: Tree
    triangles: data.Mesh | None = None
    notes: tuple[str, ...] = ()  # what was not taken from another program's scene

    def _placed(
        self,
        name: str | None,
        material: Material | None,
        pose: Pose | Keyframes | Trajectory | Way | Vector,
        scale: float | Vector,
        category: str,
        body: Body | None,
        deform: Deform | None,
        animation: str | int | Animation | None = None,
    ) -> Tree:
        kind = type(self).__name__
        self.material = None if material is None else check.one_of(material, f"{kind}.material", Material, "a Material")
        motion = {"way": pose.tree} if isinstance(pose, Way) else motion_tree(pose, f"{kind}.pose", "Way, ")
        tree = {"mesh": "mesh", **check.given(name=name, scale=scale, category=category), **motion}
        if body is not None:
            tree["physics"] = check.one_of(body, f"{kind}.body", Body, "a Body").tree
        if deform is not None:
            tree["deform"] = check.one_of(deform, f"{kind}.deform", Deform, "a Deform").tree
        if animation is not None:
            accepted = "an Animation, or a clip's name or number"
            check.one_of(animation, f"{kind}.animation", (str, int, Animation), accepted)
            tree["animation"] = animation.tree if isinstance(animation, Animation) else animation
        return self._checked(ObjectConfig, tree, way="pose")


class Primitive(_Object):
    """A body of a known shape: cuboid, sphere, icosphere, cylinder, cone, torus, capsule, prism, pyramid, grid, die, a
    point of light, or one that moves by itself: figure, flag, fish.

    parameters : the shape's sizes (m) and numbers of faces, such as ``extents=(1, 1, 2)``, and a figure's movement,
    such as ``clip="dance"`` (docs/configuration.md, "primitives").
    material : :class:`Material`, default white, or the texture of figures, flags and fish.   scale : one factor, or
    (3,).
    pose : :class:`Pose`, :class:`Keyframes`, :class:`Trajectory`, :class:`Way` or a position (3,).
    name : default the shape's.   category : "object", "ground", "wall" or "sky", for collisions.
    body : its physics, :class:`Body`; None: an obstacle.
    deform : change of its shape, :class:`Deform`; None: none, or that of figures, flags and fish.
    Raises ConfigError."""

    def __init__(
        self,
        kind: str,
        *,
        material: Material | None = None,
        pose: Pose | Keyframes | Trajectory | Way | Vector = (0.0, 0.0, 0.0),
        scale: float | Vector = 1.0,
        name: str | None = None,
        category: Literal["object", "ground", "wall", "sky"] = "object",
        body: Body | None = None,
        deform: Deform | None = None,
        **parameters: float | str | Vector,
    ):
        check.one_of(kind, "Primitive.kind", str, "the name of a shape")
        self.mesh = {"primitive": kind, "parameters": check.plain(parameters)}
        try:
            self._checked(MeshConfig, self.mesh, primitive="kind")
            primitive_mesh(validate(MeshConfig, self.mesh), "mesh")
        except ConfigError as error:
            _, parameter, key = (error.where or "").rpartition("parameters")
            if parameter and not key and error.value in parameters:  # one that this kind does not have
                key = f".{error.value}"
            raise ConfigError(
                error.problem, where=f"Primitive{key}" if parameter else key, value=error.value, accepted=error.accepted
            ) from None
        if material is None and kind not in COATS:
            material = Material()
        self.tree = self._placed(name, material, pose, scale, category, body, deform)
        self.tree.setdefault("name", kind)


class Mesh(_Object):
    """A body from a file, ``Mesh("chair.glb")``, or from triangles, ``Mesh(vertices=v, faces=f)``.

    file : obj, ply, stl, off, 3mf, glb or gltf.   up : the file's axis that points up, "auto", "y" or "z".
    vertices : (V, 3) m, body axes.   faces : (F, 3) indices, counter-clockwise seen from outside.
    uvs : (V, 2), (0, 0) the texture's top left, v down; default: projected along the axes of a box.
    material : :class:`Material`; default: the file's own, or white.   pose, scale, name,
    category, body, deform : as of :class:`Primitive`.
    animation : of a glTF file: a clip's name or number, looped, or an :class:`Animation`; None: no animation. Raises
    ConfigError; a damaged file raises when the scene is built."""

    def __init__(
        self,
        file: str | os.PathLike | None = None,
        *,
        vertices: ArrayLike | None = None,
        faces: ArrayLike | None = None,
        uvs: ArrayLike | None = None,
        up: Literal["auto", "y", "z"] = "auto",
        material: Material | None = None,
        pose: Pose | Keyframes | Trajectory | Way | Vector = (0.0, 0.0, 0.0),
        scale: float | Vector = 1.0,
        name: str | None = None,
        category: Literal["object", "ground", "wall", "sky"] = "object",
        body: Body | None = None,
        deform: Deform | None = None,
        animation: str | int | Animation | None = None,
    ):
        if (file is None) == (vertices is None) or (vertices is None) != (faces is None):
            raise ConfigError("give a file, or vertices and faces", where="Mesh.file", value=file)
        if file is not None:
            self.mesh = self._checked(MeshConfig, check.given(file=str(check.path(file, "Mesh.file")), up=up))
        elif vertices is not None and faces is not None:
            # The model requires a shape or a file; explicit_scene gets these triangles under the mesh's name.
            self.mesh, self.triangles = {"primitive": "grid"}, _triangles(vertices, faces, uvs)
            material = material if material is not None else Material()
        if animation is not None and (file is None or Path(file).suffix.lower() not in (".glb", ".gltf")):
            raise ConfigError(
                "only glTF files have animations", where="Mesh.animation", value=animation, accepted="None, or deform"
            )
        if animation is not None and deform is not None:
            raise ConfigError(
                "deform and animation exclude each other", where="Mesh.deform", accepted="deform or animation"
            )
        self.tree = self._placed(name, material, pose, scale, category, body, deform, animation)
        if file is not None:
            check.existing(file, "Mesh.file")
        self.tree.setdefault("name", "mesh" if file is None else Path(file).stem)


def _triangles(vertices: ArrayLike, faces: ArrayLike, uvs: ArrayLike | None) -> data.Mesh:
    v = check.array(vertices, "Mesh.vertices", (None, 3), "an array (V, 3) of finite numbers, m").astype(np.float64)
    f = check.array(faces, "Mesh.faces", (None, 3), "an array (F, 3) of whole numbers below V")
    if not len(v) or not np.isfinite(v).all():
        raise ConfigError(
            "not finite, or none", where="Mesh.vertices", value=v.shape, accepted="an array (V, 3) of finite numbers, m"
        )
    if f.dtype.kind not in "iu" or not len(f) or f.min() < 0 or f.max() >= len(v):
        raise ConfigError(
            "not indices of vertices",
            where="Mesh.faces",
            value=f"{f.dtype} {f.shape}",
            accepted=f"whole numbers, 0 to {len(v) - 1}",
        )
    t = None if uvs is None else check.array(uvs, "Mesh.uvs", (len(v), 2), f"an array ({len(v)}, 2)").astype(np.float32)
    digest = content_hash(v.tobytes(), f.astype(np.int64).tobytes(), b"" if t is None else t.tobytes())
    with placed("Mesh.vertices", of=(AssetError,)):
        return replace(make_mesh(v, f, uvs=t, name="mesh", where="Mesh"), source_hash=digest)


class Scene(Piece):
    """Bodies before a camera, for a duration. ``scene + body`` is a scene with one more.

    camera : :class:`Camera`.   objects : :class:`Primitive` and :class:`Mesh`; ids count from 1 in this order.
    light : :class:`Light`.   background : linear radiance of pixels without a surface.   fog : density per metre and
    linear radiance of fog between the camera and every surface; None: clear air.
    duration, label_rate, start : s, Hz, s, as ``time:`` of a YAML: labels at ``label_rate``, the first one label
    interval after ``start``, so that a recording runs from ``start`` to ``start + duration + 1 / label_rate``.
    collisions : stop bodies where they collide.   gravity : (3,) m/s², without effect if no object is a dynamic
    :class:`Body`.   seed : of the sensor's noise.   both_sides : whether faces of files are drawn from behind, too;
    None: as each file says.
    Raises ConfigError."""

    def __init__(
        self,
        camera: Camera | None = None,
        objects: Sequence[Primitive | Mesh] = (),
        *,
        light: Light | None = None,
        background: float = 0.2,
        fog: tuple[float, float] | None = None,
        duration: float = 1.0,
        label_rate: float = 10.0,
        start: float = 0.0,
        collisions: bool = False,
        gravity: Vector = (0.0, 0.0, -9.81),
        seed: int = 0,
        both_sides: bool | None = None,
    ):
        self.camera = Camera() if camera is None else check.one_of(camera, "Scene.camera", Camera, "a Camera")
        self.light = Light() if light is None else check.one_of(light, "Scene.light", Light, "a Light")
        self.objects = tuple(check.one_of(objects, "Scene.objects", (list, tuple), "a list of Primitive and Mesh"))
        for k, body in enumerate(self.objects):
            check.one_of(body, f"Scene.objects[{k}]", _Object, "a Primitive or a Mesh")
        self.fog = None if fog is None else tuple(check.one_of(fog, "Scene.fog", (list, tuple), "(density, radiance)"))
        if self.fog is not None and len(self.fog) != 2:
            raise ConfigError("not two numbers", where="Scene.fog", value=fog, accepted="(density, radiance)")
        self._plain = {"background": check.plain(background), "collisions": check.plain(collisions)}
        self._plain["both_sides"] = check.plain(both_sides)
        self._gravity = self._checked(PhysicsConfig, {"gravity": check.plain(gravity)})
        self._run = {
            "seed": check.plain(seed),
            "time": {
                "duration": check.plain(duration),
                "label_rate": check.plain(label_rate),
                "start": check.plain(start),
            },
        }
        self._checked(SequenceConfig, self._run, time="")
        if self.objects:  # a scene without bodies is refused at its use, because `scene + body` begins with one
            self._checked(ExplicitSceneConfig, self.tree)

    @classmethod
    def from_pyrender(cls, scene: Any, width: int, height: int, **keys: Any) -> Scene:
        """Return the scene of a ``pyrender.Scene``, drawn in width x height px as its ``OffscreenRenderer`` does.

        Taken: meshes of triangles with their materials, the poses and scales of nodes, instances, the main camera and
        the lights; what is not is named as ``not_drawn`` of reports and manifests. Its axes stay. Without lights it is
        unlit.   keys : other arguments of a Scene, such as ``duration``; ``light`` replaces the file's. Raises
        ConfigError: no perspective camera, no triangles."""
        theirs = taken(scene, height, width)
        camera = Camera(width, height, pose=theirs.place, **cast(Any, theirs.lens))
        bodies = []
        for mesh, material, pose, name in theirs.bodies:
            bodies.append(Mesh(vertices=mesh.vertices, faces=mesh.faces, material=material, pose=pose, name=name))
            bodies[-1].triangles, bodies[-1].notes = mesh, theirs.notes
        keys.setdefault("light", Light(0.0, 0.0, lights=theirs.lights) if theirs.lights else Light(unlit=True))
        keys.setdefault("background", theirs.background)
        return cls(camera, bodies, **keys)

    @functools.cached_property
    def _listed(self) -> tuple[Tree, InMemory]:
        """The scene as plain data, with meshes, materials and objects by name, and those parts that are made of
        arrays."""
        # Without a falling body no simulator is asked for, and friction says nothing.
        falls = any(body.tree.get("physics", {}).get("kind") == "dynamic" for body in self.objects)
        named, meshes, materials, memory = [], {}, {}, InMemory()
        taken: set[str] = set()
        for k, body in enumerate(self.objects):
            item = {**body.tree, "mesh": f"mesh{k}"}
            if not falls:
                item.pop("physics", None)
            # Names are unique in a configuration; bodies of the same kind get their number.
            item["name"] = item["name"] if item["name"] not in taken else f"{item['name']}#{k}"
            taken.add(item["name"])
            meshes[f"mesh{k}"] = body.mesh
            # Arrays travel beside the tree, which holds only what YAML can say.
            if body.triangles is not None:
                memory.meshes[f"mesh{k}"] = body.triangles
            if body.material is not None:
                item["material"] = f"material{k}"
                materials[f"material{k}"] = body.material.tree
                if body.material.maps:
                    memory.maps[f"material{k}"] = body.material.maps
                if body.material.image is not None:
                    memory.textures[f"material{k}"] = body.material.image
            named.append(item)
        tree = {
            "kind": "explicit",
            "meshes": meshes,
            "materials": materials,
            "objects": named,
            "camera": self.camera.motion,
            "light": self.light.tree,
            **self._plain,
            **({} if self.fog is None else {"fog": dict(zip(("density", "radiance"), check.plain(self.fog)))}),
            **({"physics": self._gravity} if falls else {}),
        }
        return tree, memory

    @property
    def tree(self) -> Tree:  # pyrefly: ignore [bad-override]
        return self._listed[0]

    def __add__(self, body: Primitive | Mesh) -> Scene:
        check.one_of(body, "Scene + …", _Object, "a Primitive or a Mesh")
        # Only the new body is checked: to check all of them at each step takes minutes for thousands.
        scene = Scene(
            self.camera,
            (body,),
            light=self.light,
            fog=self.fog,
            gravity=self._gravity["gravity"],
            seed=self._run["seed"],
            **self._plain,
            **self._run["time"],
        )
        del scene._listed
        scene.objects = (*self.objects, body)
        return scene

    def __repr__(self) -> str:
        return f"<Scene of {len(self.objects)} objects>"

    def template(self) -> RunTemplate:
        """Return the scene as the run of an equivalent YAML file, relative paths from the working
        folder. Raises ConfigError: no objects."""
        if not self.objects:
            raise ConfigError(
                "a scene without objects", where="Scene.objects", accepted="at least one: scene + Primitive(…)"
            )
        return RunTemplate({**self._run, "camera": self.camera.tree, "scene": self.tree}, Path.cwd())

    @property
    def on_disk(self) -> bool:
        """Whether a YAML file could describe it: no part is made of arrays."""
        memory = self._listed[1]
        return not (memory.meshes or memory.textures or memory.maps)

    def build(self, config: SequenceConfig) -> data.Scene:
        """Return the scene for the renderer. Raises ConfigError and AssetError: files."""
        from blinkgl.scene.build import equipped, in_fog, seen_by, sharpest_of

        span_ns = config.time.t0_ns, config.time.t1_ns
        where = Path.cwd(), self._listed[1], sharpest_of(config)
        made = explicit_scene(config.scene, seen_by(config).model, *span_ns, *where)
        if notes := dict.fromkeys(note for body in self.objects for note in body.notes):
            made = replace(made, omissions=(*made.omissions, f"pyrender's scene is drawn without: {'; '.join(notes)}"))
        return equipped(in_fog(made, config.scene), config)
