"""A scene is data: meshes, materials, poses over time, sensors, one light. No OpenGL and no YAML here.

Frames and units
----------------
World: right-handed, z up, units of the user's choice (metres in the shipped configs).
Camera: OpenCV axes (x right, y down, z forward). ``T_world_cam`` maps camera to world coordinates.
Pixels: (x, y) with (0, 0) the centre of the top-left pixel; :mod:`blinkgl.camera` projects points.
Time: int64 nanoseconds. Poses: 4x4 float64, rigid (scale is baked into the vertices).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.config.lights import LightConfig
from blinkgl.errors import ConfigError

if TYPE_CHECKING:
    from blinkgl.config.deform import DeformConfig
    from blinkgl.scene.motion.pose_path import PosePath
    from blinkgl.scene.rig import Rig, Sensor
    from blinkgl.scene.waveforms import Waveform


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in object-local coordinates; of a deforming mesh at rest.

    vertices : (V, 3) float64.   faces : (F, 3) int32, counter-clockwise seen from outside.
    normals  : (V, 3) float32, unit.
    uvs      : (V, 2) float32; (0, 0) is the top-left corner of the texture image, v grows downwards; repeats.
    closed   : watertight and wound outwards: its back faces are not seen from outside. Only primitives know it.
    name, source_hash : its source; ``source_hash`` is a stable hash of the content (train/test splits).
    deformer : how its shape changes with time, in object-local coordinates; None: it does not.
    colours  : (V, 3) float32 linear factors on the albedo; None: white.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    closed: bool = False
    name: str = ""
    source_hash: str = ""
    deformer: Deformer | None = None
    colours: np.ndarray | None = None

    @property
    def radius(self) -> float:
        """Return the radius of the bounding sphere around the local origin."""
        return float(np.sqrt((self.vertices**2).sum(axis=1).max())) if len(self.vertices) else 0.0


class Deformer(ABC):
    """Deformation of one mesh: a shape q(p, t) replaces the vertex p, in the frame of its object. It belongs to a mesh
    (``Mesh.deformer``), whose vertices are the shape at rest; :mod:`blinkgl.scene.shapes.sweep` has what it sweeps.

    A rigid body's point is at ``T(t) p``, a deforming one's at ``T(t) q(p, t)``. With the clip matrix ``MVP`` the
    motion from t to t' is

        MVP' (q' - q) + (MVP' - MVP) q,

    in which neither difference is one of rounded numbers: the second is composed in float64, and every deformer
    computes the first in its own form (:meth:`changes`), so a motion of 1e-6 px is as exact as one of 10 px. Likewise
    for rates: ``MVP dq/dt + dMVP/dt q``.

    For the vertex stage
        glsl : name of the source, ``shaders/include/deform/NAME.glsl``, or of ``source`` where that is given.
        source : the text itself: the five functions that ``shaders/include/deform.glsl`` names.
        rows : numbers per time, as vec4.   attributes : further vertex attributes, (V, 1 to 4) float32 by GLSL name.
        textures : (h, w, 4) float32 by sampler name.   sizes : further macros, whole numbers.

    examples : ``sizes`` of the variants that ``blinkgl shader check`` compiles.

    locomotion : how a moving body is oriented: "free"; "upright" on the ground, "level" above it, both along its x
    axis.
    speed : units/s that fit the motion, such as steps; 0: it may stay in place.

    mirrors : whether the shape is a mirror image at some time (:meth:`side`).

    Config : its model in ``deform:``; None: none.   period_ns : period of the shape; None: not periodic.   span_ns :
    time from 0 after which the shape no longer changes.   timescale_ns : time in which no velocity changes much, such
    as a sixteenth of the shortest period; None: unknown, so that steps between frames are examined at all times."""

    glsl: ClassVar[str]
    source: ClassVar[str | None] = None
    Config: ClassVar[type[DeformConfig] | None] = None

    attributes: Mapping[str, np.ndarray] = {}
    textures: Mapping[str, np.ndarray] = {}
    sizes: Mapping[str, int] = {}
    period_ns: int | None = None
    span_ns: int = 0
    timescale_ns: int | None = None
    locomotion: str = "free"
    speed: float = 0.0
    mirrors: bool = False
    examples: ClassVar[tuple[Mapping[str, int], ...]] = ({},)

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        """Return the times in (t0, t1), ns, increasing, after which it stands elsewhere a nanosecond later."""
        return []

    @classmethod
    def of(cls, config: Any, low: np.ndarray, high: np.ndarray) -> Deformer:
        """Return the deformer of a ``deform:`` configuration, for an object whose box at rest is (3,) low to high. Only
        for classes with a ``Config``."""
        raise NotImplementedError

    @property
    @abstractmethod
    def rows(self) -> int:
        """Return the rows of the arrays of :meth:`numbers`, :meth:`rates` and :meth:`changes`."""

    @property
    def is_static(self) -> bool:
        """Return whether the shape is the same at all times."""
        return False

    def side(self, t_ns: int) -> int:
        """Return 1; where faces are mirrored at a time, -1; 0 where some are and others are not."""
        return 1

    # ---- the shape, on the CPU -----------------------------------------------------------------------------------

    @abstractmethod
    def positions(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        """Return q(p, t) of the mesh's vertices, (V, 3) float64."""

    @abstractmethod
    def velocity(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        """Return dq/dt, analytic, (V, 3) float64, units/s."""

    @abstractmethod
    def normals(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        """Return directions of the normals, not normalised, (V, 3) float64."""

    def of_vertices(self, vertices: np.ndarray) -> Deformer | None:
        """Return the deformer of a mesh of some of the vertices, (n,) indices, in their order; None where it is not
        known: a subclass with numbers for each vertex says it."""
        return None if self.attributes or self.textures else self

    def transformed(self, matrix: np.ndarray) -> Deformer:
        """Return the deformer of the mesh under an affine (4, 4) map A: q_A(A p) = A q(p). Raises TypeError where that
        would be another kind of deformer."""
        raise TypeError(f"{type(self).__name__} cannot be transformed")

    # ---- the shape, for the vertex stage -------------------------------------------------------------------------

    @abstractmethod
    def numbers(self, t_ns: int) -> np.ndarray:
        """Return the numbers of the shape at t for GLSL, (rows, 4) float64."""

    @abstractmethod
    def rates(self, t_ns: int) -> np.ndarray:
        """Return the further numbers for dq/dt at t, (rows, 4) float64."""

    @abstractmethod
    def changes(self, t_ns: int, there_ns: int) -> np.ndarray:
        """Return the further numbers for q(p, there) - q(p, t), (rows, 4) float64."""


@dataclass(frozen=True, eq=False)
class Texture:
    """image: (h, w, 3) uint8 sRGB-encoded, or (h, w, 3) float32 linear light. Row 0 is the top."""

    image: np.ndarray
    name: str = ""
    source_hash: str = ""


Wrap = Literal["repeat", "mirror", "clamp"]
FARTHEST = 2.0**36
"""World units: anything farther along the optical axis has an infinite depth. A sky is a box 16 times as large. A power
of two, by which float32 multiplies without rounding, and whose square is far below float32's limit."""
REPEAT: tuple[Wrap, Wrap] = ("repeat", "repeat")
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class Map:
    """Numbers over a surface, (h, w, 3) uint8 for 0 to 1, or sRGB if they are colours.

    at   : (a, b, c, d, e, f): looked up at (a u + b v + c, d u + e v + f), (u, v) those of the base colour.
    wrap : continuation beyond the image, along u and v.
    """

    texture: Texture
    at: tuple[float, float, float, float, float, float] = IDENTITY
    wrap: tuple[Wrap, Wrap] = REPEAT


@dataclass(frozen=True, eq=False)
class Gloss:
    """A glossy surface: glTF's metal and roughness (docs/light.md).

    metallic, roughness : 0 to 1; times the blue and the green channel of ``map``, if there is one.
    """

    metallic: float = 0.0
    roughness: float = 1.0
    map: Map | None = None


@dataclass(frozen=True, eq=False)
class Mask:
    """Holes of a surface. alpha : (h, w) uint8 over the texture coordinates and with the wrap modes of the base colour,
    bilinear, never mip-mapped: a hole is where ``factor`` times it, 0 to 1, is below ``cutoff``."""

    alpha: np.ndarray
    factor: float = 1.0
    cutoff: float = 0.5

    @property
    def threshold(self) -> float:
        """Return the limit of the image's own alpha, 0 to 1."""
        return self.cutoff / self.factor


@dataclass(frozen=True, eq=False)
class Material:
    """albedo(u, v) = texture(uv * uv_scale) * base_color * the mesh's colours, linear light; matt without a gloss.

    texture      : None means white.
    base_color   : (3,) linear factor.
    unlit        : radiance = albedo, independent of the light (sky boxes, screens).
    both_sides   : whether faces are drawn from behind, too, with the normal reversed; None: unless the mesh is closed.
    wrap         : continuation beyond the texture, along u and v.
    gloss        : None: Lambert.
    bumps        : normal map, x right in the texture, y up, z outwards, 0 to 1 for -1 to 1; None: none.
    bump_scale   : factor on its x and y.
    emission     : (3,) emitted radiance, linear; times ``emission_map``, a colour, and ``emission_over_time``; None: 1.
    mask         : its holes; None: none.
    """

    texture: Texture | None = None
    base_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    uv_scale: tuple[float, float] = (1.0, 1.0)
    unlit: bool = False
    both_sides: bool | None = None
    wrap: tuple[Wrap, Wrap] = REPEAT
    gloss: Gloss | None = None
    bumps: Map | None = None
    bump_scale: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_map: Map | None = None
    mask: Mask | None = None
    emission_over_time: Waveform | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """One mesh with one material; an object has one or several."""

    mesh: Mesh
    material: Material

    @property
    def culled(self) -> bool:
        """Return whether its faces are drawn from one side only: what its material says, else for closed surfaces
        without holes."""
        both = self.material.both_sides
        return self.mesh.closed and self.material.mask is None if both is None else not both

    def side(self, t_ns: int) -> int:
        """Return the side from which its faces are drawn at a time: 0 both, 1 the front, -1 the back, which faces
        outwards while its deformer mirrors it."""
        if not self.culled:
            return 0
        return 1 if self.mesh.deformer is None or not self.mesh.deformer.mirrors else self.mesh.deformer.side(t_ns)


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A body on its path, rigid except for deforming parts. ``instance_id`` >= 1 is what the id pass writes (0 is
    'nothing hit').

    at_infinity : a sky whose points have a direction but no distance. Its vertices are at least :data:`FARTHEST` from
    its origin, and the scene centres it on the camera (:meth:`Rig.path_of_sky`)."""

    name: str
    instance_id: int
    parts: tuple[Part, ...]
    path: PosePath
    category: Literal["object", "ground", "wall", "sky"] = "object"
    at_infinity: bool = False

    @property
    def deforms(self) -> bool:
        """Return whether any of its parts deforms."""
        return any(part.mesh.deformer is not None and not part.mesh.deformer.is_static for part in self.parts)

    @property
    def is_static(self) -> bool:
        """Return whether it looks the same at all times."""
        return self.path.is_static and not self.deforms

    @property
    def radius(self) -> float:
        return max((part.mesh.radius for part in self.parts), default=0.0)


@dataclass(frozen=True)
class Lamp:
    """A sun, a point light or a spot light. It shines along the -z axis of its path's poses, as glTF's lights do, and a
    point light in all directions; :func:`blinkgl.scene.lights.beam` computes its light.

    strength : (3,) linear rgb, the radiance of a white surface that faces it: for a point or spot light at 1 world
               unit, from where it falls with the square of the distance.
    path     : T_world_lamp.
    reach    : world units at which a point or spot light has faded to zero, inf: never. With d the distance its light
               is multiplied by max(0, 1 - (d / reach)^4).
    inner, outer : rad, angles from the axis of a spot light up to which it shines fully, and from which it does not
               shine; between them by the square of a function that is linear in the cosine from 1 to 0
               (KHR_lights_punctual).
    size     : source size for soft shadows: a sun's angular diameter, rad; the diameter of others, world units.
    over_time : factor on its strength; None: 1.   name : for messages and lights.npz.
    """

    kind: Literal["sun", "point", "spot"]
    strength: tuple[float, float, float]
    path: PosePath
    reach: float = math.inf
    inner: float = 0.0
    outer: float = math.pi / 4
    size: float = 0.0
    over_time: Waveform | None = None
    name: str = ""

    @property
    def cone(self) -> tuple[float, float]:
        """Return (scale, offset): a spot light shines by clamp(scale cos + offset, 0, 1)² at an angle from its axis."""
        scale = 1.0 / max(1e-3, math.cos(self.inner) - math.cos(self.outer))
        return scale, -math.cos(self.outer) * scale


WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Light:
    """Sun + sky: irradiance factor E(n) = sun * max(0, n.s) + sky * (0.5 + 0.5 * n_z); radiance = albedo * E. Both are
    white by default, and the only light unless there are lamps.

    sun_direction : unit vector in the world, from the surface towards the sun (s).
    sun_color, sky_color : (3,) linear factors.   sun_size : rad, as of a lamp.
    lamps : further lights.
    quadric : form of the other light of the surroundings (:func:`blinkgl.scene.lights.ambient`), 3 x 4 x 4 numbers;
        None: none.
    quartic : form of the same, 3 x 9 x 9 numbers, where ``quadric`` alone is not accurate enough.
    surroundings : the same as a picture without its suns, (h, w, 3) float32 radiance with pixels as in
        :func:`~blinkgl.scene.surfaces.environment.pixel_directions`, for reflections; lights that differ only in it are
        equal. None: the sky alone, ``sky`` above the horizon.
    shadows : of suns and spot lights; soft by their size.   shadow_size : px per side of each map.
    over_time : factor on the sun and the light of the surroundings; None: 1.

    The defaults are those of ``light:`` in the configuration, where nothing is random.
    """

    sun_direction: tuple[float, float, float] = LightConfig().sun_direction()
    sun: float = LightConfig().sun
    sky: float = LightConfig().sky
    sun_color: tuple[float, float, float] = WHITE
    sky_color: tuple[float, float, float] = WHITE
    sun_size: float = math.radians(LightConfig().sun_size)
    lamps: tuple[Lamp, ...] = ()
    quadric: tuple[tuple[tuple[float, ...], ...], ...] | None = None
    quartic: tuple[tuple[tuple[float, ...], ...], ...] | None = None
    surroundings: np.ndarray | None = field(default=None, compare=False, repr=False)
    shadows: Literal["off", "hard", "soft"] = "off"
    shadow_size: int = LightConfig().shadow_size
    over_time: Waveform | None = None

    @property
    def plain(self) -> bool:
        """Return whether the light is only a white sun and sky: the formula above."""
        lone = not self.lamps and self.quadric is None and self.shadows == "off"
        return lone and self.sun_color == WHITE == self.sky_color


@dataclass(frozen=True)
class Fog:
    """A medium that absorbs light and adds its own: at a distance d from the camera L becomes
    L e^(-density d) + radiance (1 - e^(-density d)). density : per world unit.   radiance : linear, of fog alone."""

    density: float
    radiance: float


@dataclass(frozen=True)
class Dynamics:
    """Record of the simulation of a scene's falling bodies.

    engine, version : the physics engine.   bodies : number of bodies.   steps : of the engine.
    impacts_ns : times at which a velocity changes abruptly, increasing: frames at these times capture reversals.
    digest : SHA-256 of all their paths, in hex.
    """

    engine: str
    version: str
    bodies: int
    steps: int
    impacts_ns: tuple[int, ...]
    digest: str


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is rendered over [t0_ns, t1_ns].

    rig        : the moving rig with its sensors.
    background : linear radiance where nothing is hit.
    log        : one line per important decision (collisions cut, objects dropped), for the manifest.
    omissions  : one line per file with features that are not drawn, for the user and the manifest.
    dynamics   : of the objects that an engine moves; None: there are none.
    fog        : between the camera and everything; None: clear air.
    """

    objects: tuple[SceneObject, ...]
    rig: Rig
    t0_ns: int
    t1_ns: int
    light: Light = Light()
    background: float = 0.0
    log: tuple[str, ...] = field(default=())
    omissions: tuple[str, ...] = field(default=())
    dynamics: Dynamics | None = None
    fog: Fog | None = None

    def __post_init__(self) -> None:
        # Their paths follow the first sensor, so that no motion of the rig brings the sky nearer.
        if any(obj.at_infinity for obj in self.objects):
            sky = self.rig.path_of_sky()
            placed = tuple(replace(obj, path=sky) if obj.at_infinity else obj for obj in self.objects)
            object.__setattr__(self, "objects", placed)

    @property
    def changing_lights(self) -> Iterator[tuple[str, Waveform, int]]:
        """Yield the lights that change over time: their name, "light" for the sun's and the surroundings', and the
        number of the scene's part that emits, object by object; -1: none, but a lamp or the surroundings. No two have
        one name: an object called as a light before it is "NAME (object)"."""
        names = {"light", *(lamp.name for lamp in self.light.lamps)}
        if self.light.over_time is not None:
            yield "light", self.light.over_time, -1
        for lamp in self.light.lamps:
            # A panorama's suns share the waveform of its light, which has been yielded.
            if lamp.over_time is not None and lamp.over_time is not self.light.over_time:
                yield lamp.name, lamp.over_time, -1
        parts = ((obj.name, k, part) for obj in self.objects for k, part in enumerate(obj.parts))
        for number, (name, k, part) in enumerate(parts):
            if (wave := part.material.emission_over_time) is not None:
                called = f"{name} (object)" if name in names else name
                yield f"{called}, part {k}" if k else called, wave, number

    @cached_property
    def waveforms(self) -> dict[str, Waveform]:
        """Return the waveforms of :attr:`changing_lights` by name."""
        return {name: wave for name, wave, _ in self.changing_lights}

    @property
    def backdrop(self) -> float:
        """Return the linear radiance where nothing is hit: the background, or infinite fog."""
        return self.background if self.fog is None else self.fog.radiance

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """Return the rig's sensors."""
        return self.rig.sensors

    @property
    def camera(self) -> CameraModel:
        """Return the camera of the rig's first sensor, with which pictures of the scene are drawn."""
        return self.rig.sensors[0].camera

    @property
    def camera_path(self) -> PosePath:
        """Return T_world_cam of that camera over time."""
        return self.rig.path_of(self.rig.sensors[0])

    def with_camera(self, camera: CameraModel) -> Scene:
        """Return the scene seen by another camera from the same place."""
        first, *others = self.sensors
        return replace(self, rig=replace(self.rig, sensors=(replace(first, camera=camera), *others)))

    def seen_by(self, number: int) -> Scene:
        """Return the scene as the rig's sensor of this number sees it, with only that one. Raises ConfigError where
        there is none."""
        if not 0 <= number < len(self.sensors):
            raise ConfigError("no such sensor", where="seen_by", value=number, accepted=f"0 to {len(self.sensors) - 1}")
        return replace(self, rig=replace(self.rig, sensors=(self.sensors[number],)))
