"""Panoramas that light a scene: the light that a matt surface receives from an image of its surroundings, in closed
form.

Diffuse light of an environment is given by its spherical harmonics up to order 2 (Ramamoorthi and Hanrahan, "An
Efficient Representation for Irradiance Environment Maps", SIGGRAPH 2001): nine numbers per channel, a quadratic form of
the normal. Small, very bright sources are not smooth enough for that: a sun is found in the image, removed from it, and
used as a lamp, which also casts shadows. Irradiance from order 3 is zero; that from order 4 is measured, and used where
it matters (:func:`quartic`): nine more numbers, a form of degree 4.

Directions are those of :func:`blinkgl.scene.surfaces.images.cube_faces`: the middle column is in direction +x, and
longitude grows to the right, clockwise from above.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

_WIDTH = 1024  # for integration: harmonics of order 2 do not need more
PICTURE_WIDTH = 256  # of the picture for reflections
_BRIGHTER = 30.0  # times the mean radiance: the least for a sun
_EDGE = 0.1  # fraction of a sun's peak: the edge of its disc
_LARGEST = math.radians(12.0)  # largest radius of a sun; a photograph's glare is several times its disc
MOST_SUNS = 4
"""Largest number of lamps removed from an image, the brightest first: a room has several instead of one sun."""
_SHARE = 0.05  # smallest share of the light on a surface that faces it for a lamp of its own
FINER = 0.0075
"""Largest error without order 4, relative to the mean light that a surface receives: the root mean square over all
normals. Nine numbers are accurate to 1 % on average below it."""
_FOURTH = -1 / 24  # a surface's response to order 4, / pi; of orders 0, 1, 2: 1, 2/3, 1/4


class Sun(NamedTuple):
    """A sun of a panorama. towards : (3,) unit vector.   strength : (3,) radiance of a white surface that faces it.
    size : rad, diameter of its disc."""

    towards: np.ndarray
    strength: np.ndarray
    size: float


class Environment(NamedTuple):
    """The light of a panorama: the quadric of :func:`blinkgl.scene.lights.ambient`, (3, 4, 4), and its sun or brightest
    lamps, if any, which are not in the quadric.

    picture : (h, w, 3) float32 radiance, at most 256 px wide, without those suns: for reflections.
    quartic : (3, 9, 9), the further argument of :func:`blinkgl.scene.lights.ambient`, or None where it is below
    :data:`FINER` of the whole, in every channel."""

    quadric: np.ndarray
    suns: tuple[Sun, ...]
    picture: np.ndarray
    quartic: np.ndarray | None = None


def environment(radiance: np.ndarray, suns: int = MOST_SUNS) -> Environment:
    """Return the light of an equirectangular image (h, w, 3) float32, linear radiance. suns : largest number."""
    image = np.asarray(radiance, np.float32)
    height, width = image.shape[:2]
    if width > _WIDTH:
        image = cv2.resize(image, (_WIDTH, max(1, round(height * _WIDTH / width))), interpolation=cv2.INTER_AREA)
    directions, solid = pixel_directions(*image.shape[:2])
    cut_out: list[Sun] = []
    while len(cut_out) < suns:
        sun, image = _without_sun(image, directions, solid)
        if sun is None:
            break
        cut_out.append(sun)
    small = (min(image.shape[1], PICTURE_WIDTH), min(image.shape[0], PICTURE_WIDTH // 2))
    picture = cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.float32)
    quadric = quadric_of_harmonics(harmonics(image, directions, solid))
    # The mean over all normals of n^T A n is a third of the trace of A, and that of the linear terms is 0.
    mean = np.trace(quadric, axis1=1, axis2=2) - (2 / 3) * np.trace(quadric[:, :3, :3], axis1=1, axis2=2)
    mean = mean + sum((sun.strength / 4 for sun in cut_out), np.zeros(3))  # the mean of a sun over all normals is 1/4
    finer, size = quartic(picture, *pixel_directions(*picture.shape[:2]))
    return Environment(quadric, tuple(cut_out), picture, finer if (size > FINER * mean).any() else None)


def turned(given: Environment, angle: float) -> Environment:
    """Return the light rotated by an angle, rad, about the vertical, from +x towards +y."""
    T = np.eye(4)
    T[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    suns = tuple(sun._replace(towards=T[:3, :3] @ sun.towards) for sun in given.suns)
    columns = angle * given.picture.shape[1] / (2 * np.pi)  # azimuth decreases to the right
    # A rotation by a part of a column is linear between two whole shifts.
    whole, part = math.floor(columns), np.float32(columns - math.floor(columns))
    a, b = (np.roll(given.picture, -k, axis=1) for k in (whole, whole + 1))
    # The quartic is a quadratic form of the nine products n n^T, which K rotates.
    K = np.kron(T[:3, :3], T[:3, :3])
    finer = None if given.quartic is None else K @ given.quartic @ K.T
    return Environment(T @ given.quadric @ T.T, suns, a * (1 - part) + b * part, finer)


def pixel_directions(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors of a panorama's pixels, (h, w, 3) float64, and the solid angle of a pixel of each row, (h,)
    sr."""
    edges = np.pi / 2 - np.arange(height + 1) * (np.pi / height)
    latitude = 0.5 * (edges[1:] + edges[:-1])
    # The azimuth falls from pi at the left edge to -pi at the right one; +x is in the middle.
    azimuth = np.pi - (np.arange(width) + 0.5) * (2 * np.pi / width)
    flat = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(width)], axis=1)
    directions = np.cos(latitude)[:, None, None] * flat
    directions[..., 2] = np.sin(latitude)[:, None]
    # A zone of the unit sphere has an area of 2 pi times its height.
    return directions, (np.sin(edges[:-1]) - np.sin(edges[1:])) * (2 * np.pi / width)


def harmonics(image: np.ndarray, directions: np.ndarray, solid: np.ndarray) -> np.ndarray:
    """Return the coefficients of the radiance, (9, 3): 1; y, z, x; xy, yz, 3 z² - 1, xz, x² - y²."""
    x, y, z = np.moveaxis(directions, -1, 0)
    # Norms of the real spherical harmonics: sqrt(1/pi)/2, sqrt(3/pi)/2, sqrt(15/pi)/2, sqrt(5/pi)/4, sqrt(15/pi)/4.
    c = 0.282094792, 0.488602512, 1.092548431, 0.315391565, 0.546274215
    basis = (
        np.full_like(x, c[0]), c[1] * y, c[1] * z, c[1] * x,
        c[2] * x * y, c[2] * y * z, c[3] * (3 * z * z - 1), c[2] * x * z, c[4] * (x * x - y * y),
    )  # fmt: skip
    weighted = image.astype(np.float64) * solid[:, None, None]
    return np.stack([np.tensordot(b, weighted, axes=2) for b in basis])


def quadric_of_harmonics(L: np.ndarray) -> np.ndarray:
    """Return (3, 4, 4) of (9, 3) coefficients: the radiance of a white surface with unit normal n is (n, 1) Q (n,
    1)."""
    # The constants c1 to c5 of Ramamoorthi and Hanrahan give irradiance; the radiance of a white surface is that / pi.
    c1, c2, c3, c4, c5 = 0.429042738, 0.511663354, 0.743123868, 0.886226925, 0.247707956
    one, y, z, x, xy, yz, zz, xz, xxyy = L
    rows = [
        [c1 * xxyy, c1 * xy, c1 * xz, c2 * x],
        [c1 * xy, -c1 * xxyy, c1 * yz, c2 * y],
        [c1 * xz, c1 * yz, c3 * zz, c2 * z],
        [c2 * x, c2 * y, c2 * z, c4 * one - c5 * zz],
    ]
    return np.moveaxis(np.array(rows), -1, 0) / np.pi


def quartic(image: np.ndarray, directions: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the irradiance from the image's order 4: (3, 9, 9) symmetric, the radiance of a white surface with unit
    normal n being m Q m with m = n n^T, its nine numbers in a row; and (3,) the root of its mean square over all n."""
    rows = np.einsum("hwi,hwj->hwij", directions, directions).reshape(-1, 9)
    flux = (image.astype(np.float64) * solid[:, None, None]).reshape(-1, 3)
    M = np.stack(
        [(rows * flux[:, c : c + 1]).T @ rows for c in range(3)]
    )  # moments of degree 4, which include the lower ones
    # For light from d it is 9/4pi P4(n.d), P4(c) = (35 c^4 - 30 c^2 + 3) / 8 (the addition theorem), and d.d = 1.
    one = np.eye(3).ravel()
    # Contractions by the identity turn d.d into 1: moments of degree 2, then the whole flux.
    second = M @ one
    total = second @ one
    mixed = np.einsum("ci,j->cij", second, one)
    band = 35 * M - 15 * (mixed + mixed.swapaxes(1, 2)) + 3 * total[:, None, None] * np.outer(one, one)
    # The mean of P4(n.d) P4(n.e) over n is P4(d.e) / 9: for two lights, the form of one applied to the other's moments.
    energy = np.einsum("cij,cij->c", band, M) / 8 / 9
    scale = _FOURTH * 9 / (4 * np.pi)
    return scale * band / 8, abs(scale) * np.sqrt(np.maximum(energy, 0.0))


def _without_sun(image: np.ndarray, directions: np.ndarray, solid: np.ndarray) -> tuple[Sun | None, np.ndarray]:
    """Return the sun, and the image with the surrounding sky in its place. None where nothing is small and bright
    enough."""
    # A coloured lamp counts by its brightest channel.
    grey = image.max(axis=2)
    mean = float((grey * solid[:, None]).sum() / (solid.sum() * image.shape[1]))
    peak = np.unravel_index(int(grey.argmax()), grey.shape)
    if not grey[peak] > _BRIGHTER * mean:
        return None, image
    wide = np.concatenate([grey, grey, grey], axis=1) > _EDGE * grey[peak]  # a disc cut by the seam is one
    parts, _ = ndimage.label(wide)
    middle = slice(grey.shape[1], 2 * grey.shape[1])
    disc = (parts == parts[peak[0], peak[1] + grey.shape[1]])[:, middle]
    centre = (directions * (grey * solid[:, None])[..., None])[disc].sum(axis=0)
    angle = np.arccos(np.clip(directions @ (centre / np.linalg.norm(centre)), -1.0, 1.0))
    if angle[disc].max() > _LARGEST:
        return None, image
    # Twice the radius of the disc, at least three pixels, and at most the largest radius of a sun.
    glare = (angle < max(2.0 * angle[disc].max(), 2 * np.pi / image.shape[1] * 3)) & (angle < _LARGEST)
    ring = (angle < 1.5 * angle[glare].max()) & ~glare
    around = np.median(image[ring], axis=0) if ring.any() else np.zeros(3, np.float32)
    weight = np.broadcast_to(solid[:, None], grey.shape)[glare]
    excess = np.maximum(image[glare] - around, 0.0).astype(np.float64) * weight[:, None]
    towards = (excess.sum(axis=1)[:, None] * directions[glare]).sum(axis=0)
    towards /= np.linalg.norm(towards)
    # The irradiance of a surface that faces the sun, divided by pi: the radiance of a white one.
    strength = excess.sum(axis=0) / np.pi
    rest = image.copy()
    rest[glare] = np.minimum(image[glare], around)
    if strength.max() < _SHARE * mean:
        return None, image
    area = float(np.broadcast_to(solid[:, None], grey.shape)[disc].sum())
    # The diameter of a flat disc of the same solid angle.
    return Sun(towards, strength, 2.0 * math.sqrt(area / np.pi)), rest
