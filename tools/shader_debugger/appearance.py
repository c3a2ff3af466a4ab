"""Appearance of the surface points hit by rays, in float64: normals, textures, light, shadows, gloss, fog.

The shading normal of a surface seen from behind is reversed. Textures are sampled bilinearly at their full resolution,
without mip maps: those are the GPU's anti-aliasing, not a property of the scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from blinkgl.render.casting import Hits, by_part, nearest, rays_of, scene_parts
from blinkgl.scene.geometry.tangents import tangents
from blinkgl.scene.lights import ambient, beam, lamps_of, quadric_of, quartic_of, shadowing, surroundings_of
from blinkgl.scene.shapes.sweep import normals_at
from blinkgl.scene.surfaces import gloss
from blinkgl.scene.types import REPEAT, Lamp, Map, Material, Part, Scene, Texture
from blinkgl.scene.waveforms import factor_at
from blinkgl.srgb import linear_from_srgb

LUMA = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709, of linear R, G, B


@dataclass(frozen=True, eq=False)
class Surface:
    """Appearance of the surface at some :class:`Hits`.

    normal : (..., 3) unit shading normal in world coordinates, on the camera's side.   uv : (..., 2) before uv_scale.
    albedo, colour : (..., 3) linear light.   luminance : (...) Rec. 709 luma of colour.
    Where nothing is hit: normal and uv nan, albedo 0, colour and luminance the scene's background.
    """

    normal: np.ndarray
    uv: np.ndarray
    albedo: np.ndarray
    colour: np.ndarray
    luminance: np.ndarray


def surface(scene: Scene, hits: Hits) -> Surface:
    """Return normals, texture coordinates, albedo and radiance at every hit."""
    n = len(hits.hit)
    normal, uv = np.full((n, 3), np.nan), np.full((n, 2), np.nan)
    albedo, colour = np.zeros((n, 3)), np.full((n, 3), float(scene.backdrop))
    parts = scene_parts(scene)
    for p, rows in by_part(hits.part):
        body, part = parts[p]
        corners = part.mesh.faces[hits.triangle[rows]]
        bary = hits.bary[rows]
        # Interpolated over the triangle, as the rasteriser does, then made unit.
        blend = np.einsum("nc,nck->nk", bary, normals_at(part.mesh, hits.t_ns)[corners].astype(np.float64))
        # The maximum keeps a zero normal zero instead of NaN.
        length = np.maximum(np.linalg.norm(blend, axis=1, keepdims=True), 1e-15)
        # A surface seen from behind is lit from that side.
        sign = np.where(hits.front[rows], 1.0, -1.0)[:, None]
        normal[rows] = sign * (blend / length) @ body.path.pose(hits.t_ns)[:3, :3].T
        uv[rows] = np.einsum("nc,nck->nk", bary, part.mesh.uvs[corners].astype(np.float64))
        albedo[rows] = sample_albedo(part.material, uv[rows])
        if part.mesh.colours is not None:
            albedo[rows] *= np.einsum("nc,nck->nk", bary, part.mesh.colours[corners].astype(np.float64))
        colour[rows] = albedo[rows]
        if not part.material.unlit:
            sent = radiated(scene, hits, rows, albedo[rows], normal[rows], uv[rows])
            colour[rows] = albedo[rows] * sent.matt + sent.added
    colour = seen_through_fog(scene, hits, colour)
    return Surface(normal, uv, albedo, colour, colour @ LUMA)


def seen_through_fog(scene: Scene, hits: Hits, colour: np.ndarray) -> np.ndarray:
    """Return the radiance of the hits as it arrives at the camera, (N, 3); unchanged where nothing is hit."""
    if scene.fog is None:
        return colour
    rays = rays_of(scene.camera, hits.xy)
    # The distance is Z times the length of the ray (X, Y, Z) / Z.
    distance = hits.depth * np.linalg.norm(rays / rays[:, 2:], axis=1)
    arrives = np.exp(-scene.fog.density * distance)[:, None]
    return np.where(hits.hit[:, None], colour * arrives + scene.fog.radiance * (1 - arrives), colour)


@dataclass(frozen=True, eq=False)
class Radiated:
    """Radiance that N points of one part send to the camera, (N, 3) each: albedo * matt + mirrored + emission.

    light : the received light.   matt : radiance scattered by a white surface of this kind.   mirrored : reflection of
    the lamps and the surroundings."""

    light: Received
    matt: np.ndarray
    mirrored: np.ndarray
    emission: np.ndarray

    @property
    def added(self) -> np.ndarray:
        """Return the radiance that is not multiplied by the albedo."""
        return self.mirrored + self.emission


def radiated(
    scene: Scene, hits: Hits, rows: np.ndarray, albedo: np.ndarray, normal: np.ndarray, uv: np.ndarray
) -> Radiated:
    """Return the radiance of the hits ``rows``, all of one lit part. albedo, normal : (N, 3), (N, 3) unit, world axes,
    without a normal map.   uv : (N, 2)."""
    body, part = scene_parts(scene)[int(hits.part[rows[0]])]
    material, pose = part.material, body.path.pose(hits.t_ns)
    # Maps are looked up at the base colour's coordinates.
    at = uv * np.asarray(material.uv_scale)
    emission = np.broadcast_to(np.asarray(material.emission, np.float64), albedo.shape)
    emission = emission * factor_at(material.emission_over_time, hits.t_ns, scene.t0_ns)
    if material.emission_map is not None:
        emission = emission * sample_map(material.emission_map, at, colour=True)
    if material.bumps is not None:
        normal = bumped(hits, rows, part, pose, normal, at)
    points = hits.local[rows] @ pose[:3, :3].T + pose[:3, 3]
    own = np.column_stack([hits.part[rows], hits.triangle[rows]])
    light = received(scene, hits.t_ns, points, normal, own)
    if material.gloss is None:
        return Radiated(light, light.total, np.zeros_like(albedo), emission)
    metallic, roughness = np.full(len(at), material.gloss.metallic), np.full(len(at), material.gloss.roughness)
    if material.gloss.map is not None:
        texels = sample_map(material.gloss.map, at)
        metallic, roughness = metallic * texels[:, 2], roughness * texels[:, 1]
    eye = scene.camera_path.pose(hits.t_ns)[:3, 3] - points
    eye /= np.linalg.norm(eye, axis=1, keepdims=True)
    matt, mirrored = shone(scene, hits.t_ns, light, points, normal, eye, albedo, metallic, roughness)
    return Radiated(light, matt * light.total, mirrored, emission)


def bumped(
    hits: Hits, rows: np.ndarray, part: Part, pose: np.ndarray, normal: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Return unit normals of the part's normal map, (N, 3), world axes. normal : without it, on the camera's side."""
    mesh, bumps = part.mesh, part.material.bumps
    assert bumps is not None
    corners, bary = mesh.faces[hits.triangle[rows]], hits.bary[rows]
    tangent = tangents(mesh).astype(np.float64)
    # The tangent of the texture is transformed like a normal.
    if mesh.deformer is not None:
        turned = mesh.deformer.normals(replace(mesh, normals=tangent[:, :3].astype(np.float32)), hits.t_ns)
        tangent = np.column_stack([turned, tangent[:, 3]])
    side = np.where(hits.front[rows], 1.0, -1.0)[:, None]
    # Everything below is for the front; the result is turned back to the visible side.
    n = normal * side
    along = np.einsum("nc,nck->nk", bary, tangent[:, :3][corners]) @ pose[:3, :3].T
    # Gram-Schmidt: the tangent without its part along the normal.
    along = along - n * (along * n).sum(axis=1, keepdims=True)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-15)
    hand = np.sign(np.einsum("nc,nc->n", bary, tangent[:, 3][corners]))[:, None]
    # Stored as 0 to 1, used as -1 to 1.
    bump = 2.0 * sample_map(bumps, at) - 1.0
    x, y, z = (bump[:, k : k + 1] for k in range(3))
    scale = part.material.bump_scale
    mapped = side * (along * x * scale + np.cross(n, along) * hand * y * scale + n * z)
    return mapped / np.maximum(np.linalg.norm(mapped, axis=1, keepdims=True), 1e-15)


def shone(
    scene: Scene,
    t_ns: int,
    light: Received,
    points: np.ndarray,
    normal: np.ndarray,
    eye: np.ndarray,
    albedo: np.ndarray,
    metallic: np.ndarray,
    roughness: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return ((N, 1) share of the light that is multiplied by the albedo, (N, 3) mirrored radiance) of a glossy surface
    (:mod:`blinkgl.scene.surfaces.gloss`). light : received by a matt one.   eye : (N, 3) unit vectors."""
    # The same limits as in surface.glsl; the lobe of a perfect mirror would divide by 0.
    roughness = np.maximum(roughness, gloss.SMOOTHEST)
    nv = np.clip((normal * eye).sum(axis=1), 1e-3, 1.0)
    part = gloss.energy_at(nv, roughness)
    # Energy of uniform light that single reflection loses and multiple reflections return.
    lost = (1.0 / part.sum(axis=1) - 1.0)[:, None]
    mix = metallic[:, None]
    clear = 1.0 + gloss.several(np.full((1, 1), gloss.DIELECTRIC), roughness) * lost
    metal = 1.0 + gloss.several(albedo, roughness) * lost
    even_clear = clear * (gloss.DIELECTRIC * part[:, :1] + part[:, 1:])
    even_metal = metal * (albedo * part[:, :1] + part[:, 1:])
    # The mirror direction 2 (n.v) n - v.
    away = 2.0 * (normal * eye).sum(axis=1, keepdims=True) * normal - eye
    if id(scene.light) not in _surroundings:
        _surroundings.clear()
        _surroundings[id(scene.light)] = scene.light, surroundings_of(scene.light)
    around = gloss.mirrored_radiance(_surroundings[id(scene.light)][1], normal, away, nv, roughness)
    around = around * factor_at(scene.light.over_time, t_ns, scene.t0_ns)
    out = around * (even_clear * (1 - mix) + even_metal * mix)
    # Lamps: GGX lobe with Schlick's Fresnel term, half vector between lamp and eye.
    for k, lamp in enumerate(lamps_of(scene.light)):
        towards, _ = beam(lamp, lamp.path.pose(t_ns), points)
        nl = (towards * normal).sum(axis=1)
        half = towards + eye
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-15)
        lit = nl > 0
        edge = (1.0 - np.clip((half * eye).sum(axis=1, keepdims=True), 0, 1)) ** 5
        lobe = gloss.lobe(np.maximum(nl, 1e-12), nv, (half * normal).sum(axis=1), roughness)
        of_clear = clear * (gloss.DIELECTRIC + (1 - gloss.DIELECTRIC) * edge)
        of_metal = metal * (albedo + (1 - albedo) * edge)
        # ``direct`` includes the cosine, the strength and the shadow
        out += np.where(lit, lobe, 0.0)[:, None] * light.direct[k] * (of_clear * (1 - mix) + of_metal * mix)
    return (1 - mix) * (1 - even_clear), out


_surroundings: dict[int, tuple] = {}


@dataclass(frozen=True, eq=False)
class Received:
    """Light that N points of a scene receive, as the radiance of a white Lambert surface there, (N, 3) each.

    direct : (lamps, N, 3) of each of :func:`blinkgl.scene.lights.lamps_of`, with shadows.   open : without shadows.
    around : from the surroundings."""

    direct: np.ndarray
    open: np.ndarray
    around: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Return the sum of all light."""
        return self.direct.sum(axis=0) + self.around


def received(
    scene: Scene, t_ns: int, points: np.ndarray, normal: np.ndarray, own: np.ndarray | None = None
) -> Received:
    """Return the light of the scene at t_ns at (N, 3) points with (N, 3) unit normals, world axes.

    own : (N, 2) part and triangle of each point, which do not shade it; None: no shadows."""
    lamps = lamps_of(scene.light)
    direct, open_ = np.zeros((2, len(lamps), *points.shape))
    casting = shadowing(scene.light)
    for k, lamp in enumerate(lamps):
        towards, strength = beam(lamp, lamp.path.pose(t_ns), points)
        facing = np.maximum(0.0, (towards * normal).sum(axis=1))
        direct[k] = open_[k] = facing[:, None] * strength * factor_at(lamp.over_time, t_ns, scene.t0_ns)
        if own is not None and k in casting:
            direct[k] *= seen_share(scene, t_ns, lamp, points, own)[:, None]
    around = ambient(quadric_of(scene.light), normal, quartic_of(scene.light))
    return Received(direct, open_, around * factor_at(scene.light.over_time, t_ns, scene.t0_ns))


SOFT_SAMPLES = 64
"""Points on a lamp that are tested for a soft shadow."""
_FAR_AWAY = 1e5
"""Distance of a sun's ray origins, times the scene's size: parallel to 1e-5."""


def seen_share(scene: Scene, t_ns: int, lamp: Lamp, points: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return the fraction of a lamp that is visible from (N, 3) points, world axes, past all casters, (N,): 0 or 1, for
    soft shadows a mean over the lamp. own : as for :func:`received`."""
    casters, number = _casters(scene)
    if not casters.objects or not len(points):
        return np.ones(len(points))
    # Part numbers among the casters.
    skip = np.ascontiguousarray(np.column_stack([number[own[:, 0]], own[:, 1]]).astype(np.int32))
    # A lamp shines along -z, a camera looks along +z: y and z are negated.
    pose = lamp.path.pose(t_ns) @ np.diag([1.0, -1.0, -1.0, 1.0])
    middle = points.mean(axis=0)
    size = 1.0 + float(np.linalg.norm(points - middle, axis=1).max())
    count = SOFT_SAMPLES if scene.light.shadows == "soft" and lamp.size > 0 else 1
    total = np.zeros(len(points))
    # Sunflower pattern over the lamp's disc: 2.39996323 rad is the golden angle.
    for i in range(count):
        radius, angle = math.sqrt((i + 0.5) / count), i * 2.39996323
        aside = (0.5 * lamp.size * radius if count > 1 else 0.0) * np.array([math.cos(angle), math.sin(angle)])
        eye = pose.copy()
        # A sun: the direction is turned by the angle, and the eye is far away in it.
        if lamp.kind == "sun":
            ahead = eye[:3, 2] + eye[:3, :2] @ np.tan(aside)
            eye[:3, 3] = middle - ahead * (_FAR_AWAY * size)
        else:
            eye[:3, 3] += eye[:3, :2] @ aside
        # Points in the lamp's axes: Z is the distance along it.
        there = (points - eye[:3, 3]) @ eye[:3, :3]
        before = there[:, 2] > 0
        # Ends a little before the point, so that it does not shade itself.
        far = np.where(before, there[:, 2] - 1e-7 * size, 0.0)
        rays = np.where(before[:, None], there[:, :2] / np.where(before, there[:, 2], 1.0)[:, None], 0.0)
        hit, _, _ = nearest(casters, t_ns, np.ascontiguousarray(rays), far=far, skip=skip, eye=eye, near=1e-9)
        total += ~(before & (hit[:, 0] >= 0))
    return total / count


_shadowers: WeakKeyDictionary = WeakKeyDictionary()


def seen_by_lamp(
    scene: Scene, t_ns: int, eye: np.ndarray, rays: np.ndarray, near: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the content of a shadow map: (N,) depth along the axis of a lamp that looks from the (4, 4) pose ``eye``
    along (N, 3) rays of length 1 there, inf where nothing casts, and (N,) number of the part among all that cast,
    -1."""
    casters, _ = _casters(scene)
    if not casters.objects:
        return np.full(len(rays), np.inf), np.full(len(rays), -1, np.int32)
    hit, _, depth = nearest(casters, t_ns, np.ascontiguousarray(rays[:, :2]), eye=eye, near=near)
    return depth, hit[:, 0]


def casts(scene: Scene) -> bool:
    """Return whether anything in the scene casts shadows."""
    return bool(_casters(scene)[0].objects)


def _casters(scene: Scene) -> tuple[Scene, np.ndarray]:
    """Return the scene with only the parts that cast shadows, and each part's number in it, -1 for none (and for no
    part)."""
    if scene not in _shadowers:
        kept, number, count = [], [], 0
        for body in scene.objects:
            casting = [body.category in ("object", "wall") and not part.material.unlit for part in body.parts]
            # Numbers among the casting parts, in the scene's order.
            number += [count + sum(casting[:k]) if one else -1 for k, one in enumerate(casting)]
            count += sum(casting)
            if any(casting):
                kept.append(replace(body, parts=tuple(p for p, one in zip(body.parts, casting) if one)))
        _shadowers[scene] = replace(scene, objects=tuple(kept)), np.array([*number, -1])
    return _shadowers[scene]


def sample_albedo(material: Material, uv: np.ndarray) -> np.ndarray:
    """Return linear albedo at (N, 2) texture coordinates, (N, 3)."""
    base = np.asarray(material.base_color, np.float64)
    if material.texture is None:
        return np.broadcast_to(base, (len(uv), 3)).copy()
    return sample_bilinear(material.texture, uv * np.asarray(material.uv_scale), material.wrap) * base


def sample_map(texture_map: Map, at: np.ndarray, colour: bool = False) -> np.ndarray:
    """Return a map's values at (N, 2) coordinates of the base colour, (N, 3): numbers as stored, 0 to 1, or linear
    light."""
    a, b, c, d, e, f = texture_map.at
    # The map's own affine transform of the coordinates.
    there = at @ np.array([[a, b], [d, e]]).T + [c, f]
    texture = texture_map.texture
    if not colour:
        if texture not in _as_numbers:
            _as_numbers[texture] = Texture(texture.image.astype(np.float32) / np.float32(255))
        texture = _as_numbers[texture]
    return sample_bilinear(texture, there, texture_map.wrap)


_as_numbers: WeakKeyDictionary = WeakKeyDictionary()


def _wrapped(index: np.ndarray, size: int, wrap: str) -> np.ndarray:
    """Return (N,) texel numbers inside the picture, continued beyond its edges as ``wrap`` says."""
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "mirror":
        # The texture mirrored and not, one period of 2 size.
        index = np.mod(index, 2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    return np.mod(index, size)


def sample_bilinear(texture: Texture, uv: np.ndarray, wrap: tuple[str, str] = REPEAT) -> np.ndarray:
    """Return linear light, bilinear over the four nearest texels, (N, 3); texel centres at (i + 0.5) / size."""
    image = texture.image
    size = np.array([image.shape[1], image.shape[0]])
    at = uv * size - 0.5
    low = np.floor(at)
    # Column and row of the first of the four texels, and the fraction to the next.
    frac = at - low
    x0, x1 = (_wrapped(low[:, 0].astype(np.int64) + k, size[0], wrap[0]) for k in (0, 1))
    y0, y1 = (_wrapped(low[:, 1].astype(np.int64) + k, size[1], wrap[1]) for k in (0, 1))
    fx, fy = frac[:, :1], frac[:, 1:]

    def texel(y, x):
        values = image[y, x]
        return _SRGB_TO_LINEAR[values] if values.dtype == np.uint8 else values.astype(np.float64)

    top = texel(y0, x0) * (1.0 - fx) + texel(y0, x1) * fx
    bottom = texel(y1, x0) * (1.0 - fx) + texel(y1, x1) * fx
    return top * (1.0 - fy) + bottom * fy


_SRGB_TO_LINEAR = linear_from_srgb(np.arange(256) / 255.0)
