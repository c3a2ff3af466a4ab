"""Polygons of a file, whose corners have texture coordinates, normals and colours of their own, as raw meshes; and the
images beside such a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.scene.geometry.meshes import MAX_COORDINATE, crease_normals, weld
from blinkgl.scene.geometry.polygons import face_cross, triangulate
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.importing.parts import INVISIBLE, RawMesh, tinted
from blinkgl.scene.reading import Omissions, contents, limit_faces
from blinkgl.scene.surfaces.images import IMAGE_SUFFIXES, UNKNOWN_FORMAT, content_hash, decode_image
from blinkgl.scene.types import Material, Texture
from blinkgl.srgb import linear_from_srgb

OPACITY = "opacity of vertex colours (left out)"
# Most corners of a polygon: ear clipping may take a time that grows with their square.
MAX_CORNERS = 50_000


@dataclass(eq=False)
class Polygons:
    """P polygons with C corners in all, one polygon after the other.

    points : (V, 3).   places : (C,) index in ``points``.   sizes : (P,) corners of each.
    uvs : (C, 2), v upwards, normals : (C, 3), NaN where a corner has none, or None; colours : (C, 3) linear, or None.
    surfaces : (P,) number of the material.   smoothing : (P,) groups for corners without a normal, 0: flat; None: by
    the angle between faces.   lines : (P,) of the file, for messages, or None."""

    points: np.ndarray
    places: np.ndarray
    sizes: np.ndarray
    uvs: np.ndarray | None = None
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    surfaces: np.ndarray | None = None
    smoothing: np.ndarray | None = None
    lines: np.ndarray | None = None


def raw_meshes(
    given: Polygons, materials: Sequence[Material | None], max_faces: int, where: str, log: list[str]
) -> list[RawMesh]:
    """Return a raw mesh for each material, and one for those of its triangles that have no texture coordinates.

    log : gets a line where polygons have no triangle. Raises AssetError: indices that do not exist, too many corners or
    triangles."""
    _check(given, max_faces, where)
    triangles, owner, repeated = triangulate(given.points, given.places, given.sizes)
    if not len(triangles):
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    lost = len(given.sizes) - int(np.count_nonzero(np.bincount(owner)))
    if repeated or lost:
        log.append(f"{Path(where).stem}: {repeated} repeated corners and {lost} faces of fewer than three left out")
    at = given.places[triangles]
    normals = None if given.normals is None else given.normals[triangles]
    # NaN compares false.
    missing = np.ones(at.shape, bool) if normals is None else ~(np.linalg.norm(normals, axis=2) > 0)
    if missing.any():
        groups = None if given.smoothing is None else given.smoothing[owner]
        used = np.zeros(len(given.points), bool)  # a point that no face has may lie anywhere
        used[at] = True
        points, inner = given.points[used], (np.cumsum(used) - 1)[at]
        welded = weld(points, inner)[1] if groups is None else inner
        made = crease_normals(points, inner, welded, groups=groups)
        normals = made if normals is None else np.where(missing[..., None], made, normals)
        del inner, welded, points, made
    assert normals is not None
    # Both sides are drawn; which one is the front, for light, the normals say where they contradict the winding.
    behind = (face_cross(given.points, at) * normals.sum(axis=1)).sum(axis=1) < 0
    for array in (triangles, at, normals):
        array[behind] = array[behind, ::-1]
    # v upwards becomes v downwards.
    uvs = None if given.uvs is None else given.uvs * [1, -1] + [0, 1]
    surfaces = np.zeros(len(at), np.int64) if given.surfaces is None else given.surfaces[owner]
    mapped = 0 if uvs is None else np.isfinite(uvs[triangles]).all(axis=(1, 2))
    kind = np.asarray(2 * surfaces + 1 - mapped)  # odd: without coordinates
    # One raw mesh for each material and for each of the two kinds of coordinates; faces keep the file's order.
    order, raws = np.argsort(kind, kind="stable"), []
    for chosen in np.split(order, np.flatnonzero(np.diff(kind[order])) + 1) if len(order) else ():
        (number, bare), corners, tint = divmod(int(kind[chosen[0]]), 2), triangles[chosen].ravel(), None
        drawn = materials[number]
        if drawn is INVISIBLE:
            continue
        if given.colours is not None:
            drawn, tint = tinted(drawn, given.colours[corners])
        faces = np.arange(len(corners)).reshape(-1, 3)
        shape = given.points[at[chosen]].reshape(-1, 3), faces, normals[chosen].reshape(-1, 3)
        raws.append(RawMesh(*shape, None if bare or uvs is None else uvs[corners], drawn, colours=tint))
    return raws


def _check(given: Polygons, max_faces: int, where: str) -> None:
    limit_faces(int(np.maximum(given.sizes - 2, 0).sum()), max_faces, where)
    if (most := int(given.sizes.max(initial=0))) > MAX_CORNERS:
        raise AssetError(
            "a polygon has too many corners", where=where, value=most, accepted=f"at most {MAX_CORNERS}, or triangles"
        )
    last = len(given.points) - 1
    beyond = (given.places < 0) | (given.places > last)
    large = ~(np.abs(given.points[given.places.clip(0, max(last, 0))]) < MAX_COORDINATE).all(axis=1)  # NaN, too
    wrong = np.flatnonzero(beyond | large)
    if len(wrong):
        corner, face = wrong[0], int(np.searchsorted(np.cumsum(given.sizes), wrong[0], "right"))
        place = f"{where}, face {face}" if given.lines is None else f"{where}, line {given.lines[face]}"
        if not beyond[corner]:
            problem, value = "a face has a vertex that is NaN or infinite", given.points[given.places[corner]].tolist()
            raise AssetError(problem, where=place, value=value, accepted=f"numbers below {MAX_COORDINATE:g}")
        problem, value = "a face refers to a vertex that does not exist", int(given.places[corner])
        raise AssetError(problem, where=place, value=value, accepted=f"0 to {last}")


def texture_beside(image: Path | None, max_texture: int, omissions: Omissions) -> Texture | None:
    """Return the texture of a file beside a mesh; None: there is none, or none of a known format, which is noted."""
    if image is None:
        return None
    try:
        return texture_of(image, max_texture)
    except AssetError as error:
        if UNKNOWN_FORMAT not in error.problem or image.suffix.lower() in IMAGE_SUFFIXES:
            raise
        omissions.add(f"'{image.name}', whose format is not known")
        return None


def texture_of(image: Path, max_texture: int) -> Texture:
    """Return the texture of an image file. Raises AssetError naming it."""
    data = contents(image, "image")
    return Texture(decode_image(data, max_texture, str(image)), image.name, content_hash(data))


def linear_colours(
    codes: np.ndarray, near: Neighbours, most: float | None = None, opacity: np.ndarray | float = 1.0
) -> np.ndarray:
    """Return (n, 3) linear light of (n, 3) sRGB codes; white where one is no number. What is guessed is noted.

    most : the code of white; None: 1, or 255 or 65535 where whole numbers, or one beyond 2, say so.   opacity : the
    codes of what is not drawn, 1 without."""
    unknown = ~np.isfinite(codes).all(axis=1)
    if unknown.any():
        missing = f"{unknown.sum()} of {len(codes)} colours are missing or NaN"
        near.log.append(f"{near.path.stem}: {missing}: they are white")
    largest = float(codes[~unknown].max(initial=0))
    if most is None:
        whole = largest > 2 or bool((codes[~unknown] % 1 == 0).all())
        most = next((m for m in (1.0, 255.0) if largest <= m), 65535.0) if whole else 1.0
        if most > 1:
            near.log.append(f"{near.path.stem}: colours up to {largest:g} are taken as parts of {most:g}")
    if largest > most:
        near.log.append(f"{near.path.stem}: colours up to {largest:g} are drawn as {most:g}")
    if (smallest := float(codes[~unknown].min(initial=0))) < 0:
        near.log.append(f"{near.path.stem}: colours down to {smallest:g} are drawn as 0")
    if np.size(opacity) and float(np.min(opacity)) < (most if np.ndim(opacity) else 1):
        near.omissions.add(OPACITY)
    return linear_from_srgb(np.where(unknown.reshape(-1, 1), 1.0, codes / most).clip(0, 1))
