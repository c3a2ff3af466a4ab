"""Default textures of living primitives: clothes, flags, scales, drawn from a number.

A coat fits the texture coordinates of its primitive (:mod:`blinkgl.scene.geometry.primitives`). Neighbouring numbers
have unrelated coats.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np

from blinkgl.scene.geometry.figure import ATLAS, CHARTS
from blinkgl.scene.surfaces.images import content_hash
from blinkgl.scene.types import Texture

_SIZE = 512
_SKINS = ((241, 205, 178), (224, 172, 138), (198, 134, 96), (150, 96, 64), (104, 66, 44), (74, 46, 34))
_HAIRS = ((28, 22, 20), (62, 40, 26), (112, 72, 38), (188, 146, 84), (150, 62, 30), (150, 146, 142))


def _colour(rng: np.random.Generator, saturation: tuple[float, float], value: tuple[float, float]) -> np.ndarray:
    """Return an sRGB colour of any hue, (3,), 0 to 255."""
    return 255 * np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(*saturation), rng.uniform(*value)))


def _pattern(rng: np.random.Generator, x: np.ndarray, y: np.ndarray, size: float) -> np.ndarray:
    """Return a cloth pattern over positions in m, (h, w, 3) sRGB; ``size``: of one repeat."""
    first, second = _colour(rng, (0.35, 0.9), (0.45, 0.95)), _colour(rng, (0.1, 0.9), (0.15, 1.0))
    mark = _MARKS[int(rng.integers(len(_MARKS)))](x / size, y / size)
    return first + (second - first) * np.asarray(mark, float)[..., None]


# Where the second colour is, 0 to 1, at (h, w) places in repeats of the pattern.
_MARKS: tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], ...] = (
    lambda u, v: np.zeros_like(u),
    lambda u, v: v % 1.0 < 0.5,  # horizontal stripes
    lambda u, v: u % 1.0 < 0.4,  # vertical stripes
    lambda u, v: 0.5 * (u % 1.0 < 0.5) + 0.5 * (v % 1.0 < 0.5),  # checks of two shades
    # Dots, every second row shifted by half a repeat.
    lambda u, v: ((u + 0.5 * np.floor(v)) % 1.0 - 0.5) ** 2 + (v % 1.0 - 0.5) ** 2 < 0.07,
    lambda u, v: (v + np.abs(u % 1.0 - 0.5)) % 1.0 < 0.5,  # zigzag
)


def clothes(seed: int) -> np.ndarray:
    """Return clothes over the atlas of a figure, (512, 512, 3) uint8 sRGB."""
    rng = np.random.default_rng([seed, 21])
    skin, hair = (np.array(group[int(rng.integers(len(group)))], float) for group in (_SKINS, _HAIRS))
    at = (np.arange(_SIZE) + 0.5) / _SIZE * ATLAS
    x, y = np.meshgrid(at, at)
    image = np.broadcast_to(skin, (_SIZE, _SIZE, 3)).copy()
    shirt = _pattern(rng, x, y, float(rng.choice([0.06, 0.09, 0.14])))
    trousers = _colour(rng, (0.1, 0.7), (0.15, 0.75)) * np.ones_like(image)
    if rng.random() < 0.3:
        trousers = _pattern(rng, x, y, 0.05)
    shoes, sole = _colour(rng, (0.0, 0.9), (0.1, 0.9)), np.array([225.0, 222, 215])
    sleeves, shorts, dress = rng.random() < 0.5, rng.random() < 0.3, rng.random() < 0.15

    def inside(name: str, top: float = 0.0, bottom: float = 1.0) -> np.ndarray:
        """Return where a chart is between two fractions of its length, and slightly beyond its sides."""
        chart = CHARTS[name]
        low = chart.top + (top * chart.length if top > 0 else -0.02)
        high = chart.top + (bottom * chart.length if bottom < 1 else chart.length + 0.02)
        return (np.abs(x - chart.left - chart.around / 2) < chart.around / 2 + 0.03) & (y >= low) & (y < high)

    lower, short, foot = shirt if dress else trousers, shorts or dress, CHARTS["foot"]
    neckline = np.abs(x - CHARTS["torso"].around / 2) < 0.07
    # Later ones lie over earlier ones.
    for worn, mask, colour in (
        (True, inside("torso"), shirt),
        (True, inside("torso", 0.0, 0.09) & neckline, skin),
        (True, inside("upper_arm", 0.0, 1.0 if sleeves else 0.55), shirt),
        (sleeves, inside("forearm"), shirt),
        (True, inside("torso", 0.72), lower),
        (not dress, inside("torso", 0.70, 0.74), 0.4 * trousers),  # a belt
        (True, inside("thigh", 0.0, 0.75 if short else 1.0), lower),
        (not short, inside("shank"), lower),
        (short, inside("shank", 0.62), np.array([235.0, 235, 235])),  # socks
        (True, inside("foot"), shoes),
        (True, inside("foot") & (np.abs(x - foot.left - foot.around / 2) > 0.33 * foot.around), sole),
    ):
        if worn:
            image[mask] = colour[mask] if colour.ndim == 3 else colour
    _face(image, x, y, skin, hair, rng)
    return np.clip(image + rng.normal(0, 3, image.shape[:2])[..., None], 0, 255).astype(np.uint8)


def _face(image, x, y, skin, hair, rng) -> None:
    """Draw hair, eyes, brows and a mouth on the chart of the head."""
    head = CHARTS["head"]
    # u runs around the head and is 0 in the middle of the face; v runs from the crown, 0, downwards.
    u, v = (x - head.left) / head.around - 0.5, (y - head.top) / head.length
    on = (np.abs(u) < 0.55) & (v > -0.07) & (v < 1.07)
    long = rng.uniform(0.42, 0.80)
    front = 0.26 + 0.03 * np.cos(12 * np.pi * u)
    # The hair reaches down to ``front`` over the face, to 0.45 at the temples and to ``long`` elsewhere.
    image[on & (v < np.where(np.abs(u) < 0.16, front, np.where(np.abs(u) < 0.2, 0.45, long)))] = hair
    iris = _colour(rng, (0.3, 0.8), (0.2, 0.6))
    for side in (-1, 1):
        du, dv = (u - side * 0.062) / 0.032, (v - 0.50) / 0.026
        image[on & (du**2 + dv**2 < 1)] = 245
        image[on & ((du * 1.9) ** 2 + (dv * 1.25) ** 2 < 1)] = iris
        image[on & (np.abs(u - side * 0.062) < 0.036) & (np.abs(v - 0.452 + 6 * (u - side * 0.062) ** 2) < 0.009)] = (
            hair
        )
    smile = 0.665 - 5 * u**2
    image[on & (np.abs(u) < 0.052) & (np.abs(v - smile) < 0.012)] = 0.55 * skin + np.array([80.0, 20, 25])


def bunting(seed: int) -> np.ndarray:
    """Return a flag, (512, 512, 3) uint8 sRGB: stripes, a cross, a disc, a triangle or a chequer."""
    rng = np.random.default_rng([seed, 22])
    a, b, c = (_colour(rng, (0.55, 0.95), (0.4, 0.95)) for _ in range(3))
    b = b if rng.random() < 0.5 else np.array([245.0, 242, 235])
    u, v = np.meshgrid(*[(np.arange(_SIZE) + 0.5) / _SIZE] * 2)
    image = np.broadcast_to(a, (_SIZE, _SIZE, 3)).copy()
    # Where the second and the third colour are, one over the other.
    second, third = (
        ((v > 1 / 3) & (v < 2 / 3), v >= 2 / 3),  # three stripes
        ((u > 1 / 3) & (u < 2 / 3), u >= 2 / 3),
        tuple((np.abs(u - 0.36) < half) | (np.abs(v - 0.5) < over) for half, over in ((0.09, 0.13), (0.045, 0.065))),
        (v > 0.5, ((u - 0.5) * 1.5) ** 2 + (v - 0.5) ** 2 < 0.08),  # halves and a circle on a flag whose sides are 3:2
        ((v * 9).astype(int) % 2 == 1, u < 0.9 * np.minimum(v, 1 - v)),  # nine stripes and a triangle
        (((u * 9).astype(int) + (v * 6).astype(int)) % 2 == 1, np.zeros_like(u, bool)),  # a chequer
    )[int(rng.integers(6))]
    image[second], image[third] = b, c
    weave = 4 * np.sin(2 * np.pi * 128 * u) * np.sin(2 * np.pi * 96 * v)
    return np.clip(image + weave[..., None], 0, 255).astype(np.uint8)


def scales(seed: int) -> np.ndarray:
    """Return a fish, (512, 512, 3) uint8 sRGB: once around it from its back, its nose at the top."""
    rng = np.random.default_rng([seed, 23])
    back, belly = _colour(rng, (0.6, 1.0), (0.45, 0.95)), _colour(rng, (0.05, 0.4), (0.85, 1.0))
    band = _colour(rng, (0.4, 1.0), (0.15, 1.0))
    u, v = np.meshgrid(*[(np.arange(_SIZE) + 0.5) / _SIZE] * 2)
    low = 0.5 - 0.5 * np.cos(2 * np.pi * u)  # 0 the back, 1 the belly
    image = back + (belly - back) * np.clip(1.7 * low - 0.6, 0, 1)[..., None]
    kind = int(rng.integers(4))
    bands = (
        np.sin(2 * np.pi * v * rng.uniform(4, 8)) > 0.35 if kind < 2
        else (np.abs(low - 0.45) < 0.07) if kind == 2
        else np.sin(30 * v + 3 * np.sin(9 * low)) * np.sin(22 * low + 2 * np.cos(17 * v)) > 0.3
    )  # fmt: skip
    image[bands & (v > 0.22) & (v < 0.9)] = band
    # Scales lie in rows; every second row is shifted by half a scale.
    row = np.floor(v * 60)
    scale = np.hypot((u * 44 + 0.5 * row) % 1 - 0.5, v * 60 % 1 - 0.2)
    image *= (1 - 0.16 * np.clip(scale - 0.35, 0, 1) * ((v > 0.22) & (v < 0.85)))[..., None]
    # The eyes, a light disc with a dark one in it.
    for side in (0.19, 0.81):
        r = np.hypot((u - side) * 1.2, (v - 0.105) * 1.0)
        image[r < 0.036], image[r < 0.020] = 245, 15
    # A dark line: the edge of the gill cover.
    gill = (np.abs(v - 0.215 - 0.04 * np.sin(2 * np.pi * low * 0.5)) < 0.006) & (low > 0.15) & (low < 0.85)
    image[gill] *= 0.55
    return np.clip(image, 0, 255).astype(np.uint8)


COATS: dict[str, Callable[[int], np.ndarray]] = {"figure": clothes, "flag": bunting, "fish": scales}
"""By kind of primitive."""


def coat(kind: str, seed: float = 0) -> Texture:
    """Return the default texture of a primitive of this kind."""
    image = COATS[kind](int(seed))
    return Texture(image, f"{kind} coat {seed}", content_hash(image.tobytes()))
