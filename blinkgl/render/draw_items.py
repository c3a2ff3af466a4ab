"""The drawn parts of a scene in the order of their layers, and the properties that select their programs."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.scene.lights import is_coloured
from blinkgl.scene.shapes.sweep import sweep
from blinkgl.scene.shapes.table import define_of
from blinkgl.scene.types import Deformer, Light, Material, Mesh, Part, Scene, SceneObject
from blinkgl.types.recent import Kept


class Kind(NamedTuple):
    """Properties of a material, and of a deforming shape, that select a program. shape : macros of the latter.   rgb :
    whether its luminance needs three channels: where its colour and that of the light, or two of its colours, vary
    independently.
    masked : it has holes.   more : of MORE, for lit passes.   faceted : the corners of each face have one normal; set
    only where the light is not plain."""

    textured: bool
    lit: bool
    two_sided: bool
    shape: tuple[tuple[str, int], ...] = ()
    rgb: bool = False
    masked: bool = False
    more: tuple[str, ...] = ()
    faceted: bool = False

    def defines(self, lit: bool) -> dict[str, int]:
        """Return the defines of its variants. lit : for a lit pass."""
        plain = ("TEXTURED", self.textured), ("LIT", self.lit), ("TWO_SIDED", self.two_sided), ("MASKED", self.masked)
        return {name: 1 for name, on in plain if on} | dict(self.shape) | (dict.fromkeys(self.more, 1) if lit else {})

    @property
    def whole(self) -> bool:
        """Return whether light is not just a factor on the albedo that the normal determines: it then uses the general
        light's programs."""
        return self.lit and (self.rgb or "GLOSSY" in self.more or "BUMPED" in self.more)


MORE = ("TINTED", "EMISSIVE", "EMISSION_MAP", "GLOSSY", "GLOSS_MAP", "BUMPED")


def more_of(material: Material, mesh: Mesh) -> tuple[str, ...]:
    """Return those of MORE that a part needs."""
    lit = not material.unlit
    gloss, emissive = material.gloss if lit else None, lit and any(material.emission)
    on = (
        mesh.colours is not None,
        emissive,
        emissive and material.emission_map is not None,
        gloss is not None,
        gloss is not None and gloss.map is not None,
        lit and material.bumps is not None,
    )
    return tuple(name for name, one in zip(MORE, on) if one)


def shape_of(deformer: Deformer | None) -> tuple[tuple[str, int], ...]:
    """Return the macros of a deformer's variants."""
    if deformer is None:
        return ()
    return (
        ("DEFORM", 1),
        (define_of(deformer.glsl), 1),
        ("SHAPE_ROWS", padded_rows(deformer)),
        *sorted(deformer.sizes.items()),
    )


def padded_rows(deformer: Deformer) -> int:
    """Return the rows of parameters in its programs: the next power of two, so that one program serves many
    skeletons."""
    # At least 4 rows.
    return 1 << max(deformer.rows - 1, 3).bit_length()


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the corners, (8, 3), of the box between two of its corners, (3,) each."""
    return np.array(list(itertools.product(*zip(low, high))))


@dataclass(eq=False)
class DrawItem:
    """One part of one object, ready to draw.

    object_index : row of a moment's matrices.   part : number of the part in the scene, object by object.
    number : of this item among all, in the order of the layers.   moves : whether the object does.
    centre, radius; low, high : bounding sphere and box, object frame; for a deforming shape they contain it at all
    times.
    corners : (8, 3) of the box.
    layer : 0 objects, 1 ground and walls, 2 sky; drawn in this order so that depth rejects hidden fragments early.
    two_sided : the normal is turned towards the camera; faces are drawn from both sides unless the shape ``mirrors``:
    then from one, which its deformer knows (:meth:`side`).   rgb, faceted : as in :class:`Kind`.
    casts : whether it casts shadows: objects and walls do, unless they are unlit (screens, skies of files).
    facet_slope : tangent of the angle between its facets and the normals that smooth them.
    extended : whether its material has more than a base colour: maps and numbers to pass to programs.
    """

    object_index: int
    mesh: Mesh
    material: Material
    centre: np.ndarray
    radius: float
    low: np.ndarray
    high: np.ndarray
    layer: int
    two_sided: bool
    lit: bool
    moves: bool
    part: int = -1
    number: int = -1
    rgb: bool = False
    casts: bool = False
    faceted: bool = False
    facet_slope: float = 0.0
    mirrors: bool = False

    def __post_init__(self) -> None:
        self.textured = self.material.texture is not None
        self.deformer = self.mesh.deformer
        shape, more = shape_of(self.deformer), more_of(self.material, self.mesh)
        masked = self.material.mask is not None
        self.kind = Kind(
            textured=self.textured,
            lit=self.lit,
            two_sided=self.two_sided,
            shape=shape,
            rgb=self.rgb,
            masked=masked,
            more=more,
            faceted=self.faceted,
        )
        self.extended = masked or bool(more)
        self.corners = box_corners(self.low, self.high)

    def side(self, t_ns: int) -> int:
        """Return the side from which faces are drawn, as :meth:`blinkgl.scene.types.Part.side`."""
        if self.mirrors:
            assert self.deformer is not None
            return self.deformer.side(t_ns)
        return 0 if self.two_sided else 1


MAX_RADIUS = 1e18
"""Largest radius: times the largest focal length, 1e9 px, it is far below float32's 3e38."""
SKY = 2
_LAYER = {"object": 0, "ground": 1, "wall": 1, "sky": SKY}


class _Greys:
    """Finds the materials that need three channels of luminance; each picture is examined at most once."""

    def __init__(self, coloured_light: bool):
        self._coloured_light = coloured_light
        self._known: Kept[int, bool] = Kept()

    def _grey(self, values: np.ndarray) -> bool:
        equal = lambda: all(np.array_equal(values[..., 0], values[..., k]) for k in (1, 2))
        return self._known.of(id(values), equal)

    def rgb(self, material: Material, mesh: Mesh) -> bool:
        gloss = None if material.unlit else material.gloss
        metal = gloss is not None and gloss.metallic > 0
        # One channel is enough unless light, metal or vertex colours may change the hue.
        if not (metal or mesh.colours is not None or (self._coloured_light and not material.unlit)):
            return False
        pictured = material.texture is not None and not self._grey(material.texture.image)
        tinted = mesh.colours is not None and not self._grey(mesh.colours)
        # Two pictures in colour multiply: no single colour times a brightness is their product.
        if pictured and tinted:
            return True
        if material.unlit:
            return False
        coloured = pictured or tinted
        if gloss is None:
            return self._coloured_light and coloured
        # A reflection has another colour than scattered light.
        return (self._coloured_light or metal) and (coloured or len(set(material.base_color)) > 1)


class _Facets:
    """Finds the meshes with only flat facets, and the angles between normals and the facets that they smooth; each is
    examined once, and none where the light is plain."""

    def __init__(self, light: Light):
        self._asked, self._shadows = not light.plain, light.shadows != "off"
        self._known: Kept[int, bool] = Kept()
        self._slopes: Kept[int, float] = Kept()

    def slope(self, mesh: Mesh) -> float:
        """Return the tangent of the angle that 95 % of the corners keep to their facet; 0 without shadows."""
        return self._slopes.of(id(mesh), lambda: _slope(mesh)) if self._shadows else 0.0

    def flat(self, mesh: Mesh) -> bool:
        return self._asked and mesh.deformer is None and self._known.of(id(mesh), lambda: _is_flat(mesh))


def _slope(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    flat = np.cross(b - a, c - a)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
    cosine = np.einsum("fk,fck->fc", flat, mesh.normals[mesh.faces].astype(np.float64))
    # A quantile, so that a few corners do not count; cosines below 0.1 would make the tangent large.
    return math.tan(math.acos(min(1.0, max(0.1, float(np.quantile(cosine, 0.05))))))


def _is_flat(mesh: Mesh) -> bool:
    # The normals of each face's corners are those of its first one.
    corners = mesh.normals[mesh.faces]
    return bool((np.abs(corners[:, 1:] - corners[:, :1]) <= 1e-6).all())


def _draw_item(index: int, obj: SceneObject, part: Part, scene: Scene, grey: _Greys, facets: _Facets) -> DrawItem:
    mesh, material, category = part.mesh, part.material, obj.category
    if mesh.deformer is None:
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        centre = (low + high) / 2
        radius = float(np.sqrt(((mesh.vertices - centre) ** 2).sum(axis=1).max()))
    else:
        # The box of a deforming shape at all times.
        swept = sweep(mesh, scene.t0_ns, scene.t1_ns)
        low, high = swept.low, swept.high
        centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    # Also refuses NaN.
    if not radius <= MAX_RADIUS:
        raise AssetError(
            "mesh is too large to be drawn in float32",
            where=mesh.name or f"object {index}",
            value=radius,
            accepted=f"at most {MAX_RADIUS:g} units from its centre, all coordinates finite",
        )
    mirrors = part.culled and mesh.deformer is not None and mesh.deformer.mirrors
    return DrawItem(
        object_index=index,
        mesh=mesh,
        material=material,
        centre=centre,
        radius=radius,
        low=low,
        high=high,
        layer=_LAYER[category],
        two_sided=not part.culled or mirrors,
        lit=not material.unlit,
        moves=not obj.is_static,
        rgb=grey.rgb(material, mesh),
        casts=category in ("object", "wall") and not material.unlit,
        faceted=not material.unlit and facets.flat(mesh),
        facet_slope=0.0 if material.unlit else facets.slope(mesh),
        mirrors=mirrors,
    )


def draw_items(scene: Scene) -> list[DrawItem]:
    """Return all drawn parts of a scene in the order of their layers. Parts are numbered object by object."""
    grey, facets = _Greys(is_coloured(scene.light)), _Facets(scene.light)
    items = [
        _draw_item(index, obj, part, scene, grey, facets)
        for index, obj in enumerate(scene.objects)
        for part in obj.parts
    ]
    for part, item in enumerate(items):
        item.part = part
    # Stable: within a layer the scene's order stays, which decides between equal depths.
    items.sort(key=lambda item: item.layer)
    for number, item in enumerate(items):
        item.number = number
    return items
