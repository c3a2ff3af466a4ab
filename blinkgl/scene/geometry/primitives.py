"""Primitive bodies with analytic normals and proper texture coordinates, z up, centred on the origin.

All but :func:`grid` are closed. Every function takes keyword parameters in the user's units and returns a
:class:`~blinkgl.scene.types.Mesh` whose ``source_hash`` is a hash of the parameters. Texture coordinates run once round
a body and from its top (v = 0) to its bottom; caps carry the texture's inscribed disc.
"""

from __future__ import annotations

import hashlib
import inspect
import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike

from blinkgl.config.primitives import PRIMITIVES, PrimitiveKind
from blinkgl.errors import AssetError
from blinkgl.scene.geometry.meshes import closedness, make_mesh, quartered, weld
from blinkgl.scene.geometry.polygons import face_cross
from blinkgl.scene.shapes.gait import CLIPS
from blinkgl.scene.types import Deformer, Mesh

PARAMETERS = {
    "size": "edge length, m",
    "rounding": "radius of the rounded edges, a fraction of size; 0.5: a ball",
    "extents": "edge lengths in x, y, z, m",
    "width": "edge in x, m; flag: from the pole to the free end",
    "depth": "edge in y, m",
    "radius": "m; prism, pyramid: of the circle through the corners; torus: to the middle of the tube",
    "tube": "radius of the tube, m, less than radius",
    "height": "along z, m; capsule: without the two half spheres",
    "length": "m",
    "deep": "fish: height relative to an average fish, 0.6 to 1.6",
    "build": "figure: thickness relative to an average body, 0.7 to 1.4",
    "legs": "figure: length relative to an average body of this height, 0.7 to 1.4; likewise arms, head",
    "arms": "figure: see legs",
    "head": "figure: see legs",
    "clip": "figure: " + ", ".join(CLIPS),
    "variant": "figure: number of the dance or gait; 0 is the plain one",
    "tempo": "speed of the motion, 0.1 to 4; 1 is natural for a body of this size",
    "phase": "fraction of a period at time 0",
    "wind": "flag: 0.1 to 4, 1 is a breeze; with more the cloth flies higher and moves faster",
    "coat": "figure, flag, fish: number of the colours, if the object has no material",
    "segments": "faces round the z axis",
    "tube_segments": "faces round the tube",
    "rings": "rows of faces along z; cylinder, cone: rows of vertices",
    "sides": "corners of the polygon",
    "subdivisions": "cells per edge; die: per rounded edge; icosphere: 20 * 4**subdivisions triangles, 0 to 7",
}
"""The builders' parameters, for the documentation. Metres are world units, before the object's scale."""

_LEAST = {"segments": 3, "sides": 3, "tube_segments": 3, "rings": 2, "subdivisions": 1, "variant": 0, "coat": 0}
_MAX_SEGMENTS = 4096
# "variant" and "coat" are indices, not sizes.
_MOST = {"variant": 10**9, "coat": 10**9}
_WORDS = {"clip": tuple(CLIPS)}
_PART = (0.7, 1.4)
_RANGES = {"figure.build": _PART, "figure.legs": _PART, "figure.arms": _PART, "figure.head": _PART}
_RANGES |= {"fish.deep": (0.6, 1.6), "phase": (0.0, 1.0), "tempo": (0.1, 4.0), "wind": (0.1, 4.0)}


class Builder(Protocol):
    """Builds the mesh of a primitive. ``checked`` binds its parameters without building; ``at_level`` builds a coarser
    mesh, None for a primitive without levels of detail."""

    checked: Callable[..., inspect.BoundArguments]
    at_level: Callable[..., Mesh] | None

    def __call__(self, **parameters: object) -> Mesh:
        """Return the mesh with these parameters."""


BUILDERS: dict[str, Builder] = {}
"""Builders by kind."""
Surface = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""positions (V, 3), normals (V, 3), uvs (V, 2), faces (F, 3)"""


def parameter_hash(*parts: object) -> str:
    """Return 32 hex digits, stable across platforms and load order."""
    return hashlib.blake2b(repr(parts).encode(), digest_size=16).hexdigest()


def _checked(where: str, key: str, value: Any, default: Any) -> Any:
    """Return a parameter's value, of its default's type. Raises AssetError naming ``where`` and ``key``."""
    # A range for this primitive alone precedes the general one.
    within = _RANGES.get(f"{where}.{key}", _RANGES.get(key))
    if isinstance(default, str):
        right, accepted = value in _WORDS[key], "one of " + ", ".join(_WORDS[key])
    elif isinstance(value, str):
        right, accepted = False, "a number"
    elif within is not None:
        right = not np.shape(value) and within[0] <= value <= within[1]
        accepted = f"a number from {within[0]:g} to {within[1]:g}"
    elif isinstance(default, int):
        # Each subdivision has four times the triangles: 7 are 327,680.
        low, high = (0, 7) if where == "icosphere" else (_LEAST.get(key, 1), _MOST.get(key, _MAX_SEGMENTS))
        right = not np.shape(value) and low <= value <= high and float(value) == int(value)
        accepted = f"a whole number in {low}..{high}"
    else:
        right = np.shape(value) == np.shape(default) and np.isfinite(value).all() and np.min(value) > 0
        accepted = f"{len(default)} numbers greater than 0" if np.shape(default) else "a number greater than 0"
    if not right:
        problem = f"no such {key}" if isinstance(default, str) else "bad parameter"
        raise AssetError(problem, where=f"{where}.{key}", value=value, accepted=accepted)
    if np.shape(default):
        return tuple(map(float, value))
    return type(default)(value)


def primitive(build: Callable[..., Surface | tuple[Surface, Deformer]]) -> Callable[..., Mesh]:
    """Return a builder of a kind in ``config/primitives.py`` that checks the parameters and sets name, hash and
    closedness; add it to :data:`BUILDERS`. Raises TypeError for a name that is not there."""
    if build.__name__ not in PRIMITIVES:
        raise TypeError(f"no primitive '{build.__name__}' in config/primitives.py")
    whole = inspect.signature(build)
    # ``level``, of living ones, is no parameter of the configuration: scenes choose it (:func:`coarser`).
    keywords = [p for p in whole.parameters.values() if p.kind is not p.KEYWORD_ONLY]
    signature = whole.replace(parameters=keywords)

    def checked(**parameters: object) -> inspect.BoundArguments:
        where = build.__name__
        unknown = set(parameters) - set(signature.parameters)
        if unknown:
            raise AssetError(
                "unknown parameter",
                where=where,
                value=min(unknown),
                accepted="one of " + ", ".join(signature.parameters),
            )
        bound = signature.bind(**parameters)
        bound.apply_defaults()
        for key, value in bound.arguments.items():
            bound.arguments[key] = _checked(where, key, value, signature.parameters[key].default)
        return bound

    def at_level(level: int, **parameters: object) -> Mesh:
        where, bound = build.__name__, checked(**parameters)
        coarse = {"level": level} if level else {}
        built = build(**bound.arguments, **coarse)
        (positions, normals, uvs, faces), deformer = built if len(built) == 2 else (built, None)
        return Mesh(
            vertices=np.ascontiguousarray(positions, np.float64),
            faces=np.ascontiguousarray(faces, np.int32),
            normals=np.ascontiguousarray(normals, np.float32),
            uvs=np.ascontiguousarray(uvs, np.float32),
            closed=closedness(*weld(positions, faces)),
            name=where,
            source_hash=parameter_hash("primitive", 1, where, tuple((bound.arguments | coarse).items())),
            deformer=deformer,
        )

    @wraps(build)
    def made(**parameters: object) -> Mesh:
        return at_level(0, **parameters)

    made.__signature__ = signature  # type: ignore[attr-defined]
    builder = cast(Builder, made)
    builder.checked, builder.at_level = checked, at_level if whole != signature else None
    BUILDERS[build.__name__] = builder
    return builder


def register(build: Callable[..., Surface]) -> Callable[..., Mesh]:
    """Add a primitive of one's own to the scenes that name it, and return its builder. Parameters are numbers. Raises
    TypeError: there is one of this name."""
    if build.__name__ in PRIMITIVES:
        raise TypeError(f"primitive '{build.__name__}': there is one already")
    PRIMITIVES[build.__name__] = PrimitiveKind("prop")
    return primitive(build)


def join(pieces: Sequence[Surface]) -> Surface:
    """Return one body of several (positions, normals, uvs, faces)."""
    # Vertex numbers are continued from piece to piece.
    offsets = np.cumsum([0] + [len(p[0]) for p in pieces[:-1]])
    positions, normals, uvs = (np.concatenate([p[i] for p in pieces]) for i in range(3))
    return positions, normals, uvs, np.concatenate([p[3] + o for p, o in zip(pieces, offsets)])


def lattice(columns: int, rows: int) -> np.ndarray:
    """Return (2*columns*rows, 3) faces of a vertex lattice numbered row by row (row r+1 above row r),
    counter-clockwise."""
    # A cell's two triangles: (i, right, above right) and (i, above right, above).
    c, r = np.meshgrid(np.arange(columns), np.arange(rows))
    i = (r * (columns + 1) + c).ravel()
    right, up = i + 1, i + columns + 1
    return np.stack([np.stack([i, right, up + 1], 1), np.stack([i, up + 1, up], 1)], axis=1).reshape(-1, 3)


def square(origin: ArrayLike, right: ArrayLike, up: ArrayLike, columns: int, rows: int) -> Surface:
    """Return a flat parallelogram seen counter-clockwise; uv (0, 0) at its top left."""
    s, t = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1)))
    origin, right, up = (np.asarray(a, float) for a in (origin, right, up))
    positions = origin + s[:, None] * right + t[:, None] * up
    normal = np.cross(right, up)
    normal = normal / np.linalg.norm(normal)
    return positions, np.broadcast_to(normal, positions.shape), np.stack([s, 1 - t], 1), lattice(columns, rows)


def _revolve(profile: np.ndarray, normals: np.ndarray, v: np.ndarray, segments: int) -> Surface:
    """Return a surface of revolution about z.

    profile : (K, 2) r, z from bottom to top as seen with the outside on the right.   normals : (K, 2) likewise.
    A row with r = 0 is a pole: the triangles that would collapse there are left out.
    """
    angle = 2 * math.pi * np.arange(segments + 1) / segments
    # The seam has two columns, at u = 0 and u = 1.
    cos, sin = np.cos(angle), np.sin(angle)
    # The seam's two columns coincide exactly.
    cos[-1], sin[-1] = 1.0, 0.0
    r, z = profile[:, :1], profile[:, 1:]
    positions = np.stack([r * cos, r * sin, np.broadcast_to(z, (len(profile), segments + 1))], axis=2).reshape(-1, 3)
    n = np.stack(
        [normals[:, :1] * cos, normals[:, :1] * sin, np.broadcast_to(normals[:, 1:], (len(profile), segments + 1))],
        axis=2,
    )
    uvs = np.stack(np.broadcast_arrays(angle / (2 * math.pi), v[:, None]), axis=2).reshape(-1, 2).copy()
    faces = lattice(segments, len(profile) - 1)
    pole = np.repeat(np.abs(profile[:, 0]) < 1e-12, segments + 1)
    positions[pole, :2] = 0.0
    # A pole has a vertex for each segment, with the u of the segment's middle.
    uvs[pole, 0] += 0.5 / segments
    # A triangle with two corners in a pole has no area.
    return positions, n.reshape(-1, 3), uvs, faces[pole[faces].sum(axis=1) < 2]


def _rim(radius: float, z: float, segments: int) -> np.ndarray:
    """Return the (segments, 3) corners of a regular polygon at height ``z``."""
    angle = 2 * math.pi * np.arange(segments) / segments
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(segments, z)], axis=1)


def _disc(radius: float, z: float, up: bool, segments: int) -> Surface:
    """Return a flat cap with the texture's inscribed disc, seen from outside."""
    # A fan round the middle.
    positions = np.concatenate([[[0.0, 0.0, z]], _rim(radius, z, segments)])
    # A lower cap is seen from below, where x is mirrored.
    side = 1.0 if up else -1.0
    uvs = np.stack([0.5 + 0.5 * side * positions[:, 0] / radius, 0.5 - 0.5 * positions[:, 1] / radius], axis=1)
    i = np.arange(segments)
    faces = np.stack([np.zeros(segments, int), 1 + i, 1 + (i + 1) % segments], axis=1)
    return positions, np.broadcast_to([0.0, 0.0, side], positions.shape), uvs, faces if up else faces[:, ::-1]


@primitive
def cuboid(extents: Sequence[float] = (1.0, 1.0, 1.0), subdivisions: int = 1) -> Surface:
    """Box of edge lengths ``extents``; the texture once on each side."""
    x, y, z = np.array(extents) / 2
    n = subdivisions
    # Sides +x, -x, +y, -y, +z, -z, each seen from outside.
    return join(
        [
            square((x, -y, -z), (0, 2 * y, 0), (0, 0, 2 * z), n, n),
            square((-x, y, -z), (0, -2 * y, 0), (0, 0, 2 * z), n, n),
            square((x, y, -z), (-2 * x, 0, 0), (0, 0, 2 * z), n, n),
            square((-x, -y, -z), (2 * x, 0, 0), (0, 0, 2 * z), n, n),
            square((-x, -y, z), (2 * x, 0, 0), (0, 2 * y, 0), n, n),
            square((x, -y, -z), (-2 * x, 0, 0), (0, 2 * y, 0), n, n),
        ]
    )


DIE_FACES = 2, 3
"""Rows and columns of a die's texture: 1 2 3 above 4 5 6, one face each."""


@primitive
def die(size: float = 1.0, rounding: float = 0.12, subdivisions: int = 4) -> Surface:
    """Cube with rounded edges and corners. Its six faces are in one texture, 1 2 3 above 4 5 6; opposite ones sum to 7:
    see `procedural: pips`."""
    if rounding > 0.5:
        raise AssetError("bad parameter", where="die.rounding", value=rounding, accepted="at most 0.5")
    half, radius = 0.5 * size, rounding * size
    # Equal angles over an edge, not equal lengths.
    turn = np.tan(np.linspace(0, math.pi / 4, subdivisions + 1))
    edge = half - radius + radius * turn
    # Without a flat part, a ball, both halves share the line in the middle.
    ticks = np.concatenate([-edge[::-1], edge]) if rounding < 0.5 else np.concatenate([-edge[:0:-1], edge])
    across, up = np.meshgrid(ticks, ticks)
    n, cells, sides = len(ticks) - 1, lattice(len(ticks) - 1, len(ticks) - 1), []
    x, y, z = np.eye(3)
    # Seen from outside: the directions out of the face, to its right, and up.
    faces = ((z, x, y), (x, y, z), (y, -x, z), (-y, x, z), (-x, -y, z), (-z, -x, y))
    for number, (out, right, above) in enumerate(faces):
        # A point of the cube, the nearest point of the core inside it, and the rounding's normal between them.
        cube = half * out + across[..., None] * right + up[..., None] * above
        core = np.clip(cube, -(half - radius), half - radius)
        normals = (cube - core) / np.linalg.norm(cube - core, axis=2, keepdims=True)
        # The number of the face is its place in the texture, row by row.
        row, column = divmod(number, DIE_FACES[1])
        uvs = np.stack([(column + 0.5 + across / size) / DIE_FACES[1], (row + 0.5 - up / size) / DIE_FACES[0]], axis=2)
        sides.append((*(a.reshape((n + 1) ** 2, -1) for a in (core + radius * normals, normals, uvs)), cells))
    return join(sides)


@primitive
def grid(width: float = 1.0, depth: float = 1.0, subdivisions: int = 1) -> Surface:
    """Rectangle in z = 0 facing +z, ``width`` in x and ``depth`` in y; the texture once on it. Not closed."""
    return square((-width / 2, -depth / 2, 0), (width, 0, 0), (0, depth, 0), subdivisions, subdivisions)


@primitive
def sphere(radius: float = 0.5, segments: int = 32, rings: int = 16) -> Surface:
    """Sphere by longitude and latitude."""
    latitude = np.linspace(-math.pi / 2, math.pi / 2, rings + 1)
    direction = np.stack([np.cos(latitude), np.sin(latitude)], axis=1)
    # The poles are exact, so that _revolve recognises them.
    direction[[0, -1]] = [[0, -1], [0, 1]]
    return _revolve(radius * direction, direction, 1 - np.arange(rings + 1) / rings, segments)


POINT_AREA = 1e-8
"""Mean silhouette of a ``point``, in square world units: 7e-4 px wide at 50 m before a camera of 600 px focal
length."""


@primitive
def point() -> Surface:
    """Point of light: a ball far smaller than a pixel. Its material's emission is its intensity, radiance times area:
    at a distance of d focal lengths, in px, it adds emission / d² to the sum of its pixels."""
    ball = _ball(1.0, 2)
    # Cauchy: the mean silhouette of a convex body is a quarter of its surface.
    area = np.linalg.norm(face_cross(ball[0], ball[3]), axis=1).sum() / 8
    return ball[0] * math.sqrt(POINT_AREA / area), *ball[1:]


@primitive
def icosphere(radius: float = 0.5, subdivisions: int = 3) -> Surface:
    """Sphere of 20 * 4**subdivisions nearly equal triangles, box-projected texture."""
    return _ball(radius, subdivisions)


def _ball(radius: float, subdivisions: int) -> Surface:
    # The golden ratio: three rectangles with these sides span the icosahedron's corners.
    g = (1 + math.sqrt(5)) / 2
    points = np.array(
        [
            (-1, g, 0),
            (1, g, 0),
            (-1, -g, 0),
            (1, -g, 0),
            (0, -1, g),
            (0, 1, g),
            (0, -1, -g),
            (0, 1, -g),
            (g, 0, -1),
            (g, 0, 1),
            (-g, 0, -1),
            (-g, 0, 1),
        ]
    )
    points /= np.linalg.norm(points[0])
    faces = np.array(
        [
            (0, 11, 5),
            (0, 5, 1),
            (0, 1, 7),
            (0, 7, 10),
            (0, 10, 11),
            (1, 5, 9),
            (5, 11, 4),
            (11, 10, 2),
            (10, 7, 6),
            (7, 1, 8),
            (3, 9, 4),
            (3, 4, 2),
            (3, 2, 6),
            (3, 6, 8),
            (3, 8, 9),
            (4, 9, 5),
            (2, 4, 11),
            (6, 2, 10),
            (8, 6, 7),
            (9, 8, 1),
        ]
    )
    # Every edge gets a vertex on the sphere, every triangle becomes four.
    for _ in range(subdivisions):
        edges, faces = quartered(faces, len(points))
        middle = points[edges].sum(axis=1)
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
    mesh = make_mesh(points, faces, normals=points, name="icosphere")
    return radius * mesh.vertices, mesh.normals, mesh.uvs, mesh.faces


@primitive
def cylinder(radius: float = 0.5, height: float = 1.0, segments: int = 32, rings: int = 2) -> Surface:
    """Circular cylinder along z."""
    t = np.linspace(0, 1, rings)
    profile = np.stack([np.full(rings, radius), (t - 0.5) * height], axis=1)
    side = _revolve(profile, np.broadcast_to([1.0, 0.0], profile.shape), 1 - t, segments)
    return join([side, _disc(radius, height / 2, True, segments), _disc(radius, -height / 2, False, segments)])


@primitive
def cone(radius: float = 0.5, height: float = 1.0, segments: int = 32, rings: int = 4) -> Surface:
    """Circular cone with its tip at z = height/2."""
    t = np.linspace(0, 1, rings)
    profile = np.stack([radius * (1 - t), (t - 0.5) * height], axis=1)
    profile[-1, 0] = 0.0
    # The normal of a cone's side is the same along a line to its tip.
    slope = np.array([height, radius]) / math.hypot(height, radius)
    positions, normals, uvs, faces = _revolve(profile, np.broadcast_to(slope, profile.shape), 1 - t, segments)
    # The normals at the tip belong to the middle of their segment, as the uvs there do.
    tip = slice(-(segments + 1), None)
    angle = 2 * math.pi * (np.arange(segments + 1) + 0.5) / segments
    normals[tip] = np.stack(
        [slope[0] * np.cos(angle), slope[0] * np.sin(angle), np.full(segments + 1, slope[1])], axis=1
    )
    return join([(positions, normals, uvs, faces), _disc(radius, -height / 2, False, segments)])


@primitive
def torus(radius: float = 0.35, tube: float = 0.15, segments: int = 32, tube_segments: int = 16) -> Surface:
    """Ring about z."""
    if tube >= radius:
        raise AssetError("bad parameter", where="torus.tube", value=tube, accepted=f"less than radius {radius:g}")
    angle = 2 * math.pi * np.arange(tube_segments + 1) / tube_segments
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # The sine of 2 pi is not exactly 0, and the tube has to close.
    direction[-1] = direction[0]
    return _revolve(
        np.array([radius, 0.0]) + tube * direction,
        direction,
        1 - np.arange(tube_segments + 1) / tube_segments,
        segments,
    )


@primitive
def capsule(radius: float = 0.25, height: float = 0.5, segments: int = 32, rings: int = 16) -> Surface:
    """Cylinder of ``height`` between two half spheres, which have ``rings`` rows together."""
    half = max(rings // 2, 1)
    latitude = np.linspace(0, math.pi / 2, half + 1)
    top = np.stack([np.cos(latitude), np.sin(latitude)], axis=1)
    top[-1], top[0] = (0, 1), (1, 0)
    # The lower half is the upper one mirrored, its rows from the pole upwards.
    direction = np.concatenate([top[::-1] * [1, -1], top])
    profile = radius * direction + np.concatenate(
        [np.full((half + 1, 2), [0, -height / 2]), np.full((half + 1, 2), [0, height / 2])]
    )
    # v by the length along the profile, so that the texture is not stretched over the caps.
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    return _revolve(profile, direction, 1 - length / length[-1], segments)


@primitive
def prism(sides: int = 6, radius: float = 0.5, height: float = 1.0) -> Surface:
    """Upright prism over a regular polygon of circumradius ``radius``, flat-shaded; the texture once on each side."""
    rim = _rim(radius, -height / 2, sides)
    walls = [square(a, b - a, (0, 0, height), 1, 1) for a, b in zip(rim, np.roll(rim, -1, axis=0))]
    return join([*walls, _disc(radius, height / 2, True, sides), _disc(radius, -height / 2, False, sides)])


@primitive
def pyramid(sides: int = 4, radius: float = 0.5, height: float = 1.0) -> Surface:
    """Pyramid over a regular polygon, flat-shaded; each side has the texture's triangle."""
    rim, tip = _rim(radius, -height / 2, sides), np.array([0, 0, height / 2])
    walls = []
    for a, b in zip(rim, np.roll(rim, -1, axis=0)):
        normal = np.cross(b - a, tip - a)
        walls.append(
            (
                np.stack([a, b, tip]),
                np.broadcast_to(normal / np.linalg.norm(normal), (3, 3)),
                np.array([[0.0, 1.0], [1.0, 1.0], [0.5, 0.0]]),
                np.array([[0, 1, 2]]),
            )
        )
    return join([*walls, _disc(radius, -height / 2, False, sides)])


def parameters(kind: str) -> dict[str, float | int | str | tuple[float, ...]]:
    """Return names and defaults of a builder's parameters."""
    return {name: parameter.default for name, parameter in inspect.signature(BUILDERS[kind]).parameters.items()}
