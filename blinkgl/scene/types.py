"""A scene is data: meshes, materials, poses over time, what looks at them, one light. No OpenGL and no YAML here.

Frames and units
----------------
World: right-handed, z up, units of the user's choice (metres in the shipped configs).
Camera: OpenCV axes (x right, y down, z forward). ``T_world_cam`` maps camera to world coordinates.
Pixels: (x, y) with (0, 0) the centre of the top-left pixel; where a point is seen is :mod:`blinkgl.camera`'s affair.
Time: int64 nanoseconds. Poses: 4x4 float64, rigid (scale is baked into the vertices).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.config.lights import LightConfig

if TYPE_CHECKING:
    from blinkgl.scene.rig import Rig, Sensor
    from blinkgl.scene.shapes.deformer import Deformer


@runtime_checkable
class PosePath(Protocol):
    """A rigid motion over [t0_ns, t1_ns]; outside it the end poses are held (and the derivative is zero)."""

    t0_ns: int
    t1_ns: int

    @property
    def is_static(self) -> bool:
        """True when the pose is the same at all times (lets a renderer cache what it drew)."""

    def pose(self, t_ns: int) -> np.ndarray:
        """(4, 4) float64 T_world_body at t_ns."""

    def derivative(self, t_ns: int) -> np.ndarray:
        """(4, 4) float64 dT/dt in 1/s, analytic; last row zero. With body rate w: dR/dt = R [w]x."""

    def poses(self, t_ns: np.ndarray) -> np.ndarray:
        """(N, 4, 4) float64 poses at (N,) int64 times; equals stacking :meth:`pose`."""

    def speed_bound(self, ta_ns: int, tb_ns: int) -> tuple[float, float]:
        """Upper bounds over [ta, tb] of (|velocity of the body's origin| in units/s, |angular rate| in rad/s)."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in object-local coordinates, of a mesh that deforms at rest.

    vertices : (V, 3) float64.   faces : (F, 3) int32, counter-clockwise seen from outside.
    normals  : (V, 3) float32, unit.
    uvs      : (V, 2) float32; (0, 0) is the top-left corner of the texture image, v grows downwards; repeats.
    closed   : watertight with consistent outward winding, so back faces can be culled.
    name, source_hash : where it came from; ``source_hash`` is a stable hash of the content (train/test splits).
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
        """Radius of the bounding sphere around the local origin."""
        return float(np.sqrt((self.vertices**2).sum(axis=1).max())) if len(self.vertices) else 0.0


@dataclass(frozen=True, eq=False)
class Texture:
    """image: (h, w, 3) uint8 sRGB-encoded, or (h, w, 3) float32 linear light. Row 0 is the top."""

    image: np.ndarray
    name: str = ""
    source_hash: str = ""


Wrap = Literal["repeat", "mirror", "clamp"]
FARTHEST = 2.0**36
"""World units: what is farther along the optical axis has an infinite depth. A sky is a box 16 times as large: a power
of two, by which float32 multiplies without rounding, and whose square is far below float32's limit."""
REPEAT: tuple[Wrap, Wrap] = ("repeat", "repeat")
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class Map:
    """Numbers over a surface, (h, w, 3) uint8 standing for 0 to 1 as they are, or sRGB where it is a colour.

    at   : (a, b, c, d, e, f): looked up at (a u + b v + c, d u + e v + f), (u, v) those of the base colour.
    wrap : what lies beside the picture, along u and v.
    """

    texture: Texture
    at: tuple[float, float, float, float, float, float] = IDENTITY
    wrap: tuple[Wrap, Wrap] = REPEAT


@dataclass(frozen=True, eq=False)
class Gloss:
    """A surface that shines: glTF's metal and roughness (docs/materials.md).

    metallic, roughness : 0 to 1; times the blue and the green channel of ``map``, where there is one.
    """

    metallic: float = 0.0
    roughness: float = 1.0
    map: Map | None = None


@dataclass(frozen=True, eq=False)
class Mask:
    """Where a surface has holes. alpha : (h, w) uint8 over the texture coordinates and with the wrap modes of the base
    colour, bilinear, never mip-mapped: a hole is where ``factor`` times it, 0 to 1, is below ``cutoff``."""

    alpha: np.ndarray
    factor: float = 1.0
    cutoff: float = 0.5

    @property
    def threshold(self) -> float:
        """What the picture's own alpha, 0 to 1, is compared with."""
        return self.cutoff / self.factor


@dataclass(frozen=True, eq=False)
class Material:
    """albedo(u, v) = texture(uv * uv_scale) * base_color * the mesh's colours, linear light; matt without a gloss.

    texture      : None means white.
    base_color   : (3,) linear factor.
    unlit        : radiance = albedo, whatever the light (sky boxes, screens).
    double_sided : draw back faces with the normal turned round; otherwise they are culled when the mesh is closed.
    wrap         : what lies beside the texture, along u and v.
    gloss        : None: Lambert.
    bumps        : normal map, x to the right in the texture, y up, z outwards, 0 to 1 for -1 to 1; None: none.
    bump_scale   : of its x and y.
    emission     : (3,) radiance of its own, linear; times ``emission_map``, a colour.
    mask         : where it has holes; None: nowhere.
    """

    texture: Texture | None = None
    base_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    uv_scale: tuple[float, float] = (1.0, 1.0)
    unlit: bool = False
    double_sided: bool = False
    wrap: tuple[Wrap, Wrap] = REPEAT
    gloss: Gloss | None = None
    bumps: Map | None = None
    bump_scale: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emission_map: Map | None = None
    mask: Mask | None = None


@dataclass(frozen=True, eq=False)
class Part:
    """One mesh with one material; an object has one or several."""

    mesh: Mesh
    material: Material

    @property
    def culled(self) -> bool:
        """Whether its back faces are not drawn: of closed surfaces without holes that are not asked for from behind."""
        return self.mesh.closed and not self.material.double_sided and self.material.mask is None


@dataclass(frozen=True, eq=False)
class SceneObject:
    """A body on its path, rigid but for parts that deform. ``instance_id`` >= 1 is what the id pass writes (0 is
    'nothing hit').

    at_infinity : a sky whose points are at no distance but in a direction. Its vertices are :data:`FARTHEST` from its
    origin or farther, and the scene puts it around whichever camera looks (:meth:`Rig.path_of_sky`)."""

    name: str
    instance_id: int
    parts: tuple[Part, ...]
    path: PosePath
    category: Literal["object", "ground", "wall", "sky"] = "object"
    at_infinity: bool = False

    @property
    def deforms(self) -> bool:
        """Whether the shape of any of its parts changes with time."""
        return any(part.mesh.deformer is not None and not part.mesh.deformer.is_static for part in self.parts)

    @property
    def is_static(self) -> bool:
        """True when it looks the same at all times."""
        return self.path.is_static and not self.deforms

    @property
    def radius(self) -> float:
        return max((part.mesh.radius for part in self.parts), default=0.0)


@dataclass(frozen=True)
class Lamp:
    """A sun, a point light or a spot light. It shines along the -z axis of its path's poses, as glTF's lights do, and
    a point light to all sides; what it sends where is :func:`blinkgl.scene.lights.beam`.

    strength : (3,) linear rgb, the radiance of a white surface that faces it: of a point or spot light 1 world unit
               away, whence it falls with the square of the distance.
    path     : T_world_lamp.
    reach    : world units at which a point or spot light has faded to nothing, inf: nowhere. With d the distance its
               light is multiplied by max(0, 1 - (d / reach)^4).
    inner, outer : rad, angles from the axis of a spot light up to which it shines fully, and from which on not at all;
               between them by the square of what goes from 1 to 0 linearly in the cosine (KHR_lights_punctual).
    size     : what a soft shadow is soft by: a sun's angular diameter, rad; the diameter of others, world units.
    """

    kind: Literal["sun", "point", "spot"]
    strength: tuple[float, float, float]
    path: PosePath
    reach: float = math.inf
    inner: float = 0.0
    outer: float = math.pi / 4
    size: float = 0.0

    @property
    def cone(self) -> tuple[float, float]:
        """(scale, offset): a spot light shines by clamp(scale cos + offset, 0, 1)² at an angle from its axis."""
        scale = 1.0 / max(1e-3, math.cos(self.inner) - math.cos(self.outer))
        return scale, -math.cos(self.outer) * scale


WHITE = (1.0, 1.0, 1.0)


class Panorama(NamedTuple):
    """pixels : (h, w, 3) float32 radiance from all around, as of
    :func:`~blinkgl.scene.surfaces.environment.pixel_directions`."""

    pixels: np.ndarray


@dataclass(frozen=True)
class Light:
    """Sun + sky: irradiance factor E(n) = sun * max(0, n.s) + sky * (0.5 + 0.5 * n_z); radiance = albedo * E. Both are
    white unless said otherwise, and all there is unless there are lamps.

    sun_direction : unit vector in the world, from the surface towards the sun (s).
    sun_color, sky_color : (3,) linear factors.   sun_size : rad, as of a lamp.
    lamps : what shines beside them.
    around : quadric of what else comes from all around (:func:`blinkgl.scene.lights.ambient`), 3 x 4 x 4 numbers; None:
        nothing.
    finer : quartic of the same, 3 x 9 x 9 numbers, where ``around`` alone is not near enough.
    surroundings : the same as a picture, its suns taken out, for what shines; lights that differ in nothing else are
        equal. None: the sky alone, ``sky`` above the horizon.
    shadows : of suns and spot lights; soft by their size.   shadow_size : px a side of the map of each.

    The defaults are those of ``light:`` in the configuration, where nothing is random.
    """

    sun_direction: tuple[float, float, float] = LightConfig().sun_direction()
    sun: float = LightConfig().sun
    sky: float = LightConfig().sky
    sun_color: tuple[float, float, float] = WHITE
    sky_color: tuple[float, float, float] = WHITE
    sun_size: float = math.radians(LightConfig().sun_size)
    lamps: tuple[Lamp, ...] = ()
    around: tuple[tuple[tuple[float, ...], ...], ...] | None = None
    finer: tuple[tuple[tuple[float, ...], ...], ...] | None = None
    surroundings: Panorama | None = field(default=None, compare=False, repr=False)
    shadows: Literal["off", "hard", "soft"] = "off"
    shadow_size: int = LightConfig().shadow_size

    @property
    def plain(self) -> bool:
        """Whether a white sun and sky are all there is: the formula above."""
        lone = not self.lamps and self.around is None and self.shadows == "off"
        return lone and self.sun_color == WHITE == self.sky_color


@dataclass(frozen=True)
class Fog:
    """A medium that swallows light and sends its own: at a distance d from the camera L becomes
    L e^(-density d) + radiance (1 - e^(-density d)). density : per world unit.   radiance : linear, of fog alone."""

    density: float
    radiance: float


@dataclass(frozen=True)
class Dynamics:
    """How the paths of a scene's falling bodies came about.

    engine, version : what computed them.   bodies : how many.   steps : of the engine.
    impacts_ns : times at which a velocity changes abruptly, increasing: frames at these times keep what turns there.
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

    rig        : what looks at it, on its way.
    background : linear radiance where nothing is hit.
    log        : one line per decision worth keeping (collisions cut, objects dropped), for the manifest.
    omissions  : one line per file that asks for what is not drawn (:mod:`blinkgl.scene.omissions`), for the user and
    the manifest.
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
        if any(thing.at_infinity for thing in self.objects):
            sky = self.rig.path_of_sky()
            placed = tuple(replace(thing, path=sky) if thing.at_infinity else thing for thing in self.objects)
            object.__setattr__(self, "objects", placed)

    @property
    def backdrop(self) -> float:
        """Linear radiance that is seen where nothing is hit: the background, or fog without end."""
        return self.background if self.fog is None else self.fog.radiance

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """What the rig carries."""
        return self.rig.sensors

    @property
    def camera(self) -> CameraModel:
        """Of the rig's first sensor: what pictures of the scene are drawn with."""
        return self.rig.sensors[0].camera

    @property
    def camera_path(self) -> PosePath:
        """T_world_cam of that camera over time."""
        return self.rig.path_of(self.rig.sensors[0])

    def with_camera(self, camera: CameraModel) -> Scene:
        """The scene seen by another camera from the same place."""
        return replace(self, rig=self.rig.with_first(camera=camera))

    def seen_by(self, number: int) -> Scene:
        """The scene as the rig's sensor of this number sees it: with that one alone. Raises
        ConfigError where there is none."""
        return replace(self, rig=self.rig.seen_by(number))

    def with_path(self, path: PosePath) -> Scene:
        """The scene with its rig on another way."""
        return replace(self, rig=replace(self.rig, path=path))
