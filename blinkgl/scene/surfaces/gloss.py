"""Glossy surfaces: lookup tables of glTF's metal and roughness for the shaders, in float64.

A lobe is GGX with the height-correlated Smith term and Schlick's Fresnel term (Walter et al. 2007, "Microfacet Models
for Refraction through Rough Surfaces"; Heitz 2014, "Understanding the Masking-Shadowing Function"; glTF 2.0, appendix
B). With single reflection it returns ``F0 r + g`` of uniform light (Karis 2013, "Real Shading in Unreal Engine 4"),
which is too little for rough surfaces, because light that is reflected twice is lost. A factor ``1 + F_ms (1 / (r + g)
- 1)`` restores it; F_ms is the part of it that leaves after being reflected by F_0 at a time, twice and more often
(:func:`several`), so that a white metal under uniform light is white, and gold is more saturated the rougher it is. A
non-metal reflects 4 %, and scatters the rest below.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from scipy.integrate import trapezoid

from blinkgl.scene.surfaces.environment import pixel_directions

SMOOTHEST = 0.05
"""Smallest roughness: its highlight of a sun is as wide as the sun."""
DIELECTRIC = 0.04
"""Reflectance of non-metals at normal incidence."""
LEVELS = 15
"""Number of roughnesses at which surroundings are blurred: 0, 1/14, ... 1; linear in between."""
COSINES = 8
"""Number of cosines of the eye at the normal in the table of looks: 0, 1/7, ... 1."""
_ANGLES, _ROUGHNESSES = 64, 32
_SAMPLES = 1024
_WIDE = 0.45  # roughness from which blurred pictures have half the pixels
# Thousandths; by roughness, five numbers for each cosine.
_LOOKS = """
1000 0 1000 0 543  1000 0 1000 0 568  1000 0 1000 0 551  1000 0 1000 0 568
1000 0 1000 0 695  1000 0 1000 0 676  1000 0 1000 0 616  1000 0 1000 0 591
1004 0 988 77 543  1007 20 989 73 568  1007 69 991 30 551  1008 72 990 26 568
1006 72 987 70 695  1007 74 986 71 676  1012 75 982 72 616  1054 77 920 72 591
982 81 901 168 713  1013 86 965 111 538  1023 83 976 118 391  1022 104 973 113 498
1027 116 973 118 478  1018 127 961 120 667  1020 135 958 130 678  1053 143 934 141 555
923 141 650 328 809  988 138 827 206 812  1022 140 909 177 635  1035 149 925 182 567
1051 160 946 185 453  1059 178 943 193 472  1058 199 936 199 518  1059 213 922 213 569
879 168 600 385 674  957 147 731 306 699  1000 184 793 252 735  1035 195 835 248 652
1051 214 843 262 641  1073 241 871 258 586  1106 263 891 270 486  1056 284 910 286 611
820 214 510 460 600  911 184 610 382 638  972 214 672 339 679  1031 228 750 330 602
1085 260 798 323 545  1129 286 831 330 478  1206 313 856 342 371  1143 355 797 358 577
744 280 301 588 654  846 245 494 466 589  930 256 552 424 634  990 275 619 404 621
1054 301 660 408 593  1100 341 657 411 616  1214 360 763 424 427  1236 424 743 430 492
707 304 236 647 568  786 287 368 554 553  871 292 433 516 573  954 313 506 481 556
1006 357 480 491 636  1125 370 598 491 502  1117 429 436 523 664  1464 481 560 511 422
640 372 50 750 576  717 357 166 647 573  799 357 274 596 572  902 357 373 562 519
959 397 348 582 579  1044 429 367 589 573  1103 481 291 612 632  1478 535 317 603 455
619 416 0 811 496  658 420 62 735 534  726 417 99 705 560  803 429 168 680 547
912 429 249 666 494  942 485 168 697 587  1131 500 238 697 489  1500 585 133 692 434
592 439 0 992 393  623 448 2 829 444  700 434 87 768 421  744 471 82 768 470
798 500 75 778 499  929 500 153 773 432  1011 561 94 799 474  1500 641 1 772 390
601 478 0 1000 295  590 489 0 981 343  628 500 5 901 374  696 500 60 864 352
786 505 91 841 331  844 555 78 857 359  1013 571 107 861 311  1498 675 4 845 278
661 517 0 1000 199  626 502 1 1000 211  617 528 5 1000 241  641 543 27 975 250
700 557 42 947 246  792 571 55 934 232  1047 571 89 911 168  1475 712 16 906 176
763 550 0 1000 119  756 527 0 1000 105  723 548 0 1000 112  728 561 9 1000 113
740 571 22 1000 107  774 577 35 1000 99  1016 594 40 977 78  1469 752 1 958 85
1056 916 0 1000 102  1113 994 0 1000 62  1065 999 0 1000 50  690 999 0 1000 50
406 999 1 1000 50  659 999 1 1000 51  1458 962 0 997 50  1462 957 0 999 50
"""


def lobe(nl: np.ndarray, nv: np.ndarray, nh: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Return pi times the lobe without its Fresnel term, D V. Cosines at the normal: of light, eye, half vector."""
    # glTF's alpha is the square of the roughness, and a2 is the square of alpha.
    a2 = np.maximum(roughness, SMOOTHEST) ** 4
    distribution = a2 / (nh**2 * (a2 - 1) + 1) ** 2
    return distribution * 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))


def visible(
    nv: np.ndarray, roughness: float, count: int
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Return directions from which light is mirrored to eyes at (N,) cosines, with the density of the visible half
    vectors (Dupuy and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps"): ((N, count) each of x, towards
    the eye, y, z, along the normal), and the fraction that leaves, (N, count); its mean is the energy of uniform
    light."""
    i = np.arange(count)
    # A lattice by the golden ratio: it converges faster than random points, and is the same everywhere.
    u1, u2 = (i + 0.5) / count, (i * 0.6180339887498949 + 0.5) % 1.0
    sv = np.sqrt(np.maximum(1 - nv**2, 0))
    alpha = max(roughness, SMOOTHEST) ** 2
    # Stretched by alpha, the surface is a hemisphere. Its visible normals bisect the eye and a spherical cap.
    x, z = alpha * sv, nv.copy()
    length = np.hypot(x, z)
    x, z = (x / length)[:, None], (z / length)[:, None]
    cz = (1 - u2) * (1 + z) - z
    cs = np.sqrt(np.maximum(1 - cz**2, 0))
    hx, hy, hz = cs * np.cos(2 * np.pi * u1) + x, cs * np.sin(2 * np.pi * u1), cz + z
    hx, hy = alpha * hx, alpha * hy
    length = np.sqrt(hx**2 + hy**2 + hz**2)
    hx, hy, hz = hx / length, hy / length, hz / length
    vh = sv[:, None] * hx + nv[:, None] * hz
    # The half vector mirrors the eye to the light, l = 2 (v . h) h - v; nl is its z component.
    nl = 2 * vh * hz - nv[:, None]
    a2 = alpha**2
    of_eye, of_light = np.sqrt(nv[:, None] ** 2 * (1 - a2) + a2), np.sqrt(np.maximum(nl, 0) ** 2 * (1 - a2) + a2)
    # G2 / G1: the fraction of the singly reflected light that leaves
    weight = np.where(nl > 0, nl * (nv[:, None] + of_eye) / np.maximum(nl * of_eye + nv[:, None] * of_light, 1e-12), 0)
    return (2 * vh * hx - sv[:, None], 2 * vh * hy, nl), weight


@lru_cache(maxsize=1)
def energy() -> np.ndarray:
    """Return (roughness 32, cosine 64, 2) float64 (r, g): a lobe with reflectance F0 returns F0 r + g of uniform light
    with single reflection. Roughness and cosine are i / (n - 1); by visible half vectors, whose weights are smooth."""
    # At the cosine 0 the eye sees no surface, and the quotients below are 0 / 0.
    nv = np.maximum(np.arange(_ANGLES) / (_ANGLES - 1), 1e-3)
    out = np.empty((_ROUGHNESSES, _ANGLES, 2))
    sv = np.sqrt(np.maximum(1 - nv**2, 0))[:, None]
    for k in range(_ROUGHNESSES):
        (x, _, z), weight = visible(nv, k / (_ROUGHNESSES - 1), _SAMPLES)
        edge = np.clip(1 - np.sqrt(np.maximum(0.5 + 0.5 * (sv * x + nv[:, None] * z), 0)), 0, 1) ** 5  # 1 - v.h
        out[k, :, 0], out[k, :, 1] = (weight * (1 - edge)).mean(axis=1), (weight * edge).mean(axis=1)
    return out


@lru_cache(maxsize=1)
def mean_energy() -> np.ndarray:
    """Return :func:`energy` with reflectance 1, (roughness 32,), averaged over all directions with their cosine as
    weight."""
    E, mu = energy().sum(axis=2), np.arange(_ANGLES) / (_ANGLES - 1)
    return trapezoid(2 * mu * E, mu, axis=1)


def several(F0: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Return F_ms of (N, C) reflectances at (N,) roughnesses (Turquin 2019, "Practical Multiple Scattering Compensation
    for Microfacet Models"): with F the mean of Schlick's term and E that of the energy, F E / (1 - F (1 - E))."""
    # The mean of Schlick's term: the integral of 2 c (1 - c)^5 over the cosine c is 1/21.
    F = F0 + (1.0 - F0) / 21.0
    at = np.clip(roughness, 0, 1) * (_ROUGHNESSES - 1)
    E = np.interp(at, np.arange(_ROUGHNESSES), mean_energy())[:, None]
    return F * E / (1.0 - F * (1.0 - E))


@lru_cache(maxsize=1)
def looks() -> np.ndarray:
    """Return (roughness 32, cosine 64, 5) float64, at the places of :func:`energy`: the directions in which a surface
    looks up its surroundings, for :func:`both`. A lobe seen from the side is longer than the one along the normal, by
    which the surroundings are blurred, and cut off at the horizon: two looks approximate it
    (``tests/scene/surfaces/lobes.py``)."""
    table = np.array(_LOOKS.split(), np.float64).reshape(LEVELS, COSINES, 5) * 1e-3
    # From the 15 x 8 fitted places to the 32 x 64 of the table.
    x = np.linspace(0, COSINES - 1, _ANGLES)
    rows = [_bilinear(table, x, np.full(_ANGLES, y)) for y in np.linspace(0, LEVELS - 1, _ROUGHNESSES)]
    return np.stack(rows)


Look = tuple[np.ndarray, np.ndarray, np.ndarray]
"""(N, 3) unit directions, (N,) roughnesses, (N, 1) weights."""


def both(normal: np.ndarray, away: np.ndarray, cells: np.ndarray) -> tuple[Look, Look]:
    """Return the looks of (N, 5) numbers of :func:`looks`: for each, the share of the mirror direction ``away`` (the
    rest is the normal) and the roughness; the first one's weight. All unit vectors (N, 3)."""
    first, r1, second, r2, weight = np.moveaxis(cells[..., None], 1, 0)

    def look(share: np.ndarray, roughness: np.ndarray, weight: np.ndarray) -> Look:
        way = share * away + (1.0 - share) * normal
        return way / np.linalg.norm(way, axis=1, keepdims=True), roughness[:, 0], weight

    return look(first, r1, weight), look(second, r2, 1.0 - weight)


def mirrored_radiance(
    levels: np.ndarray, normal: np.ndarray, away: np.ndarray, cosine: np.ndarray, roughness: np.ndarray
) -> np.ndarray:
    """Return the radiance, (N, 3), of :func:`blurred` surroundings mirrored by surfaces of (N,) roughnesses, relative
    to uniform light. cosine : (N,) of the eye at the normal."""
    cells = _bilinear(looks(), cosine * (_ANGLES - 1), roughness * (_ROUGHNESSES - 1))
    first, second = (weight * mirrored(levels, way, rough) for way, rough, weight in both(normal, away, cells))
    return first + second


def energy_at(cosine: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Return :func:`energy`, bilinear, at (N,) cosines and roughnesses, (N, 2)."""
    return _bilinear(energy(), cosine * (_ANGLES - 1), roughness * (_ROUGHNESSES - 1))


def _bilinear(table: np.ndarray, x: np.ndarray, y: np.ndarray, wraps: bool = False) -> np.ndarray:
    height, width = table.shape[:2]
    y = np.clip(y, 0, height - 1)
    x = x if wraps else np.clip(x, 0, width - 1)
    x0, y0 = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), max(height - 2, 0))
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    y1 = np.minimum(y0 + 1, height - 1)
    # A panorama's columns go around.
    x0, x1 = (np.mod(x0, width), np.mod(x0 + 1, width)) if wraps else (x0, np.minimum(x0 + 1, width - 1))
    return (table[y0, x0] * (1 - fx) + table[y0, x1] * fx) * (1 - fy) + (
        table[y1, x0] * (1 - fx) + table[y1, x1] * fx
    ) * fy


def blurred(picture: np.ndarray) -> np.ndarray:
    """Return (LEVELS, h, w, 3) float32: a panorama mirrored by surfaces of the roughnesses k / (LEVELS - 1), seen along
    the normal: its mean over the lobe, weighted by the cosine. The first is the image itself.

    picture : (h, w, 3) float32."""
    height, width = picture.shape[:2]
    out = np.empty((LEVELS, *picture.shape), np.float32)
    out[0] = picture
    half = (
        cv2.resize(picture, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        if min(height, width) > 32
        else None
    )
    for k in range(1, LEVELS):
        roughness = k / (LEVELS - 1)
        if half is None or roughness < _WIDE:
            out[k] = _blurred(picture, roughness)
            continue
        few = _blurred(half, roughness)
        few = np.concatenate([few[:, -1:], few, few[:, :1]], axis=1).astype(np.float32)  # across the seam
        # Each added column is two pixels wide after the enlargement and is cut off.
        out[k] = cv2.resize(few, (2 * few.shape[1], height), interpolation=cv2.INTER_LINEAR)[:, 2 : 2 + width]
    return out


def _blurred(picture: np.ndarray, roughness: float) -> np.ndarray:
    """Return the blurred image. The weight between two pixels depends on their rows and the distance of their columns,
    so along a row this is a convolution."""
    height, width = picture.shape[:2]
    directions, solid = pixel_directions(height, width)
    # z and across: sine and cosine of the latitude of each row.
    z = directions[:, 0, 2]
    across = np.sqrt(1 - z**2)
    turn = np.cos(np.arange(width) * (2 * np.pi / width))
    cosine = (z[:, None] * z)[..., None] + (across[:, None] * across)[..., None] * turn  # n.l, of v = n
    nl = np.maximum(cosine, 0)
    a2 = max(roughness, SMOOTHEST) ** 4
    # the lobe for v = n, where (n.h)^2 = (1 + n.l) / 2, times the cosine, except for a common factor
    lobe = nl / ((0.5 + 0.5 * nl) * (a2 - 1) + 1) ** 2 / (nl + np.sqrt(nl**2 * (1 - a2) + a2))
    # A convolution along the rows, by Fourier transform; frequency 0 of the weights is their sum, which normalises.
    waves = np.fft.rfft(lobe * solid[:, None], axis=2)
    sums = np.einsum("ijf,jfc->ifc", waves, np.fft.rfft(picture.astype(np.float64), axis=1), optimize=True)
    return np.fft.irfft(sums, n=width, axis=1) / waves[..., 0].real.sum(axis=1)[:, None, None]


def mirrored(levels: np.ndarray, directions: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Return :func:`blurred` in (N, 3) unit directions at (N,) roughnesses, linear in between, (N, 3) float64."""
    height, width = levels.shape[1:3]
    # The inverse of pixel_directions.
    x = (0.5 - np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)) * width - 0.5
    y = (0.5 - np.arcsin(np.clip(directions[:, 2], -1, 1)) / np.pi) * height - 0.5
    at = np.clip(roughness, 0, 1) * (len(levels) - 1)
    low = np.minimum(at.astype(int), len(levels) - 2)
    out = np.zeros((len(directions), levels.shape[3]))
    for k in np.unique(low):
        on = low == k
        part = (at[on] - k)[:, None]
        ends = [_bilinear(levels[j].astype(np.float64), x[on], y[on], wraps=True) for j in (k, k + 1)]
        out[on] = ends[0] * (1 - part) + ends[1] * part
    return out
