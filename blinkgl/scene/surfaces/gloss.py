"""Surfaces that shine: the numbers of glTF's metal and roughness that shaders look up, in float64.

A lobe is GGX with the height-correlated Smith term and Schlick's Fresnel term (Walter et al. 2007, "Microfacet Models
for Refraction through Rough Surfaces"; Heitz 2014, "Understanding the Masking-Shadowing Function"; glTF 2.0, appendix
B). Once through it sends back ``F0 r + g`` of even light (Karis 2013, "Real Shading in Unreal Engine 4"), which is too
little where it is rough: light that hits twice is lost. A factor ``1 + F_ms (1 / (r + g) - 1)`` gives it back, F_ms
being what of it comes out that was reflected F_0 at a time, twice and more often (:func:`several`), so that a white
metal under even light is white and gold is the more golden the rougher. What is no metal reflects 4 %, and scatters
below that what is not reflected.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from blinkgl.scene.surfaces.environment import pixel_directions

SMOOTHEST = 0.05
"""Least roughness: its highlight of a sun is as wide as the sun."""
DIELECTRIC = 0.04
"""Reflectance of what is no metal, looked at from straight above."""
LEVELS = 8
"""Roughnesses at which surroundings are blurred: 0, 1/7, ... 1; in between linearly."""
_ANGLES, _ROUGHNESSES = 64, 32
_SAMPLES = 1024


def lobe(nl: np.ndarray, nv: np.ndarray, nh: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """pi times the lobe without its Fresnel term, D V. Cosines at the normal: of light, eye, half way."""
    a2 = np.maximum(roughness, SMOOTHEST) ** 4
    distribution = a2 / (nh**2 * (a2 - 1) + 1) ** 2
    return distribution * 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))


@lru_cache(maxsize=1)
def energy() -> np.ndarray:
    """(roughness 32, cosine 64, 2) float64 (r, g): a lobe with reflectance F0 sends back F0 r + g of even light, once
    through. Roughness and cosine are i / (n - 1); by visible half vectors (Dupuy and Benyoub 2023, "Sampling Visible
    GGX Normals with Spherical Caps"), whose weights are smooth."""
    nv = np.maximum(np.arange(_ANGLES) / (_ANGLES - 1), 1e-3)
    i = np.arange(_SAMPLES)
    u1, u2 = (i + 0.5) / _SAMPLES, (i * 0.6180339887498949 + 0.5) % 1.0
    out = np.empty((_ROUGHNESSES, _ANGLES, 2))
    sv = np.sqrt(np.maximum(1 - nv**2, 0))
    for k in range(_ROUGHNESSES):
        alpha = max(k / (_ROUGHNESSES - 1), SMOOTHEST) ** 2
        x, z = alpha * sv, nv.copy()
        length = np.hypot(x, z)
        x, z = (x / length)[:, None], (z / length)[:, None]
        cz = (1 - u2) * (1 + z) - z
        cs = np.sqrt(np.maximum(1 - cz**2, 0))
        hx, hy, hz = cs * np.cos(2 * np.pi * u1) + x, cs * np.sin(2 * np.pi * u1), cz + z
        hx, hy = alpha * hx, alpha * hy
        length = np.sqrt(hx**2 + hy**2 + hz**2)
        hx, hz = hx / length, hz / length
        vh = sv[:, None] * hx + nv[:, None] * hz
        nl = 2 * vh * hz - nv[:, None]
        a2 = alpha**2
        of_eye, of_light = np.sqrt(nv[:, None] ** 2 * (1 - a2) + a2), np.sqrt(np.maximum(nl, 0) ** 2 * (1 - a2) + a2)
        # G2 / G1: what of the light that was reflected once comes out
        weight = np.where(
            nl > 0, nl * (nv[:, None] + of_eye) / np.maximum(nl * of_eye + nv[:, None] * of_light, 1e-12), 0
        )
        edge = np.clip(1 - vh, 0, 1) ** 5
        out[k, :, 0], out[k, :, 1] = (weight * (1 - edge)).mean(axis=1), (weight * edge).mean(axis=1)
    return out


@lru_cache(maxsize=1)
def mean_energy() -> np.ndarray:
    """(roughness 32,) of :func:`energy` with reflectance 1, the mean over all directions, weighed by their cosine."""
    E, mu = energy().sum(axis=2), np.arange(_ANGLES) / (_ANGLES - 1)
    return np.trapezoid(2 * mu * E, mu, axis=1)


def several(F0: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """F_ms of (N, C) reflectances at (N,) roughnesses (Turquin 2019, "Practical Multiple Scattering Compensation for
    Microfacet Models"): with F the mean of Schlick's term and E that of the energy, F E / (1 - F (1 - E))."""
    F = F0 + (1.0 - F0) / 21.0
    at = np.clip(roughness, 0, 1) * (_ROUGHNESSES - 1)
    E = np.interp(at, np.arange(_ROUGHNESSES), mean_energy())[:, None]
    return F * E / (1.0 - F * (1.0 - E))


def looked_at(
    normal: np.ndarray, away: np.ndarray, cosine: np.ndarray, roughness: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) unit directions and (N,) roughnesses at which surroundings are looked up of surfaces that mirror towards
    ``away``: the lobe of a rough one leans towards the normal, and is narrower where the eye, at (N,) cosines, looks
    along the surface, than :func:`blurred` has it. Fitted against a path tracer (docs/results.md)."""
    share = ((1.0 - roughness**2) * (1.0 + 0.6 * roughness * (cosine - 0.5)))[:, None]
    way = share * away + (1.0 - share) * normal
    return way / np.linalg.norm(way, axis=1, keepdims=True), roughness * (0.875 + 0.25 * cosine)


def energy_at(cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """(N, 2) of :func:`energy`, bilinear, at (N,) cosines and roughnesses."""
    return _bilinear(energy(), cosine * (_ANGLES - 1), roughness * (_ROUGHNESSES - 1))


def _bilinear(table: np.ndarray, x: np.ndarray, y: np.ndarray, around: bool = False) -> np.ndarray:
    height, width = table.shape[:2]
    y = np.clip(y, 0, height - 1)
    x = x if around else np.clip(x, 0, width - 1)
    x0, y0 = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), max(height - 2, 0))
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    y1 = np.minimum(y0 + 1, height - 1)
    x0, x1 = (np.mod(x0, width), np.mod(x0 + 1, width)) if around else (x0, np.minimum(x0 + 1, width - 1))
    return (table[y0, x0] * (1 - fx) + table[y0, x1] * fx) * (1 - fy) + (
        table[y1, x0] * (1 - fx) + table[y1, x1] * fx
    ) * fy


def blurred(picture: np.ndarray) -> np.ndarray:
    """(LEVELS, h, w, 3) float32: a panorama as surfaces of the roughnesses k / (LEVELS - 1) mirror it, looked at along
    the normal: its mean over the lobe, weighed by the cosine (Karis 2013). The first is the picture itself.

    picture : (h, w, 3) float32."""
    out = np.empty((LEVELS, *picture.shape), np.float32)
    out[0] = picture
    for k in range(1, LEVELS):
        out[k] = _blurred(picture, k / (LEVELS - 1))
    return out


def _blurred(picture: np.ndarray, roughness: float) -> np.ndarray:
    """What one pixel weighs for another depends on their rows and on how many columns lie between them: along a row
    this is a convolution."""
    height, width = picture.shape[:2]
    directions, solid = pixel_directions(height, width)
    z = directions[:, 0, 2]
    across = np.sqrt(1 - z**2)
    turn = np.cos(np.arange(width) * (2 * np.pi / width))
    cosine = (z[:, None] * z)[..., None] + (across[:, None] * across)[..., None] * turn  # n.l, of v = n
    half = 0.5 + 0.5 * cosine  # (n.h)^2
    # half vectors are as dense as directions times 4 v.h, and v.h = n.h: what is left of D (n.h) is D / 4
    a2 = max(roughness, SMOOTHEST) ** 4
    weight = np.maximum(cosine, 0) / (half * (a2 - 1) + 1) ** 2 * solid[:, None]
    waves = np.fft.rfft(weight, axis=2)
    sums = np.einsum("ijf,jfc->ifc", waves, np.fft.rfft(picture.astype(np.float64), axis=1), optimize=True)
    return np.fft.irfft(sums, n=width, axis=1) / waves[..., 0].real.sum(axis=1)[:, None, None]


def mirrored(levels: np.ndarray, directions: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """(N, 3) float64 of :func:`blurred` in (N, 3) unit directions at (N,) roughnesses, linear in between."""
    height, width = levels.shape[1:3]
    x = (0.5 - np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)) * width - 0.5
    y = (0.5 - np.arcsin(np.clip(directions[:, 2], -1, 1)) / np.pi) * height - 0.5
    at = np.clip(roughness, 0, 1) * (len(levels) - 1)
    low = np.minimum(at.astype(int), len(levels) - 2)
    out = np.zeros((len(directions), 3))
    for k in np.unique(low):
        on = low == k
        part = (at[on] - k)[:, None]
        ends = [_bilinear(levels[j].astype(np.float64), x[on], y[on], around=True) for j in (k, k + 1)]
        out[on] = ends[0] * (1 - part) + ends[1] * part
    return out
