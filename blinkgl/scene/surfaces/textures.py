"""Procedural textures: each is one function of a seed, tileable, in colour, never black.

A scalar field in [0, 1] is mapped to a palette of random sRGB colours. Fields are built from integer lattices with
wrap-around, so that a texture repeats without a seam.
"""

from __future__ import annotations

import numpy as np

from blinkgl.config.scene import TEXTURE_KINDS
from blinkgl.scene.geometry.primitives import DIE_FACES, parameter_hash
from blinkgl.scene.types import Texture

DARKEST, BRIGHTEST = 20, 240  # sRGB: radiance is within about (0.007, 0.87)
MIN_CONTRAST = 70  # smallest difference in sRGB luma between a palette's darkest and brightest colour


def procedural_hash(kind: str, index: int) -> str:
    """Return the identity of a procedural texture for splits; independent of its size."""
    return parameter_hash("procedural", 1, kind, index)


def procedural_texture(kind: str, index: int, size: int = 512) -> Texture:
    """Return the ``index``-th texture of a kind, (size, size, 3) uint8 sRGB; the same on every run."""
    # By the kind's index in the list, which data sets depend on: add new kinds only at the end.
    rng = np.random.default_rng([_ALL_KINDS.index(kind), index])
    image = _pips(rng, size) if kind == "pips" else _grade(_FIELDS[kind](rng, size), _palette(rng))
    return Texture(image=image, name=f"{kind}-{index}", source_hash=procedural_hash(kind, index))


def _palette(rng: np.random.Generator) -> np.ndarray:
    """Return (2..5, 3) sRGB colours in 0..255 with at least MIN_CONTRAST between darkest and brightest."""
    colours = rng.uniform(DARKEST, BRIGHTEST, (int(rng.integers(2, 6)), 3))
    # Luma weights of Rec. 601.
    luma = colours @ [0.299, 0.587, 0.114]
    lack = MIN_CONTRAST - (luma.max() - luma.min())
    if lack > 0:
        colours[luma.argmax()] += lack / 2 + 10
        colours[luma.argmin()] -= lack / 2 + 10
    return np.clip(colours, DARKEST, BRIGHTEST)


def _grade(field: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Return (h, w, 3) uint8 of a field (h, w) in [0, 1], or of (h, w) integer labels."""
    if field.dtype.kind in "iu":
        return np.round(palette).astype(np.uint8).take(field % len(palette), axis=0)
    stops = np.linspace(0, 1, len(palette))
    table = np.stack([np.interp(np.linspace(0, 1, 1024), stops, palette[:, c]) for c in range(3)], axis=1)
    return np.round(table).astype(np.uint8).take(np.clip(field * 1023, 0, 1023).astype(np.intp), axis=0)


def _stretch(field: np.ndarray) -> np.ndarray:
    low, high = field.min(), field.max()
    return ((field - low) / max(high - low, 1e-9)).astype(np.float32)


def _coordinates(size: int) -> tuple[np.ndarray, ...]:
    return np.meshgrid(*[(np.arange(size) + 0.5) / size] * 2)


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * t * (t * (6 * t - 15) + 10)  # Perlin's quintic: C2 across cells


def _lattice(size: int, cells: int):
    """Return per pixel along one axis: cell before, cell after (wrapped), fraction."""
    x = (np.arange(size) + 0.5) / size * cells
    low = np.floor(x).astype(int)
    # Wrapped round, so that the texture repeats without a seam.
    return low % cells, (low + 1) % cells, x - low


def _value_noise(rng, size: int, cells: int) -> np.ndarray:
    corner = rng.random((cells, cells))
    i, j, f = _lattice(size, cells)
    w = _smooth(f)
    # Bilinear with smooth weights: along axis 0, then along axis 1.
    rows = corner[i] * (1 - w)[:, None] + corner[j] * w[:, None]
    return rows[:, i] * (1 - w) + rows[:, j] * w


def _perlin_noise(rng, size: int, cells: int) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi, (cells, cells))
    gx, gy = np.cos(angle), np.sin(angle)
    i, j, f = _lattice(size, cells)
    w = _smooth(f)
    total = np.zeros((size, size))
    # The four corners of each pixel's cell: those before and after it, in y and in x.
    for rows, dy, wy in ((i, f, 1 - w), (j, f - 1, w)):
        across, along = gx[rows], gy[rows] * dy[:, None]
        for columns, dx, wx in ((i, f, 1 - w), (j, f - 1, w)):
            dot = across.take(columns, axis=1) * dx
            dot += along.take(columns, axis=1)
            dot *= wy[:, None]
            dot *= wx
            total = total + dot
    return total


def _fbm(rng, size):
    cells, gain = int(rng.integers(2, 7)), rng.uniform(0.45, 0.75)
    # Each octave has twice the frequency of the one before and ``gain`` of its amplitude.
    octaves = [gain**k * _perlin_noise(rng, size, cells * 2**k) for k in range(6)]
    return _stretch(sum(octaves[1:], octaves[0]))


def _stripes(rng, size):
    x, y = _coordinates(size)
    a, b = int(rng.integers(0, 12)), int(rng.integers(0, 12))
    # Without this, a and b may both be 0, which gives no stripes.
    a = a or (b == 0) * 5
    phase = (a * x + b * y) + rng.uniform(0, 0.3) * _perlin_noise(rng, size, 4)
    if rng.random() < 0.5:
        return (0.5 + 0.5 * np.sin(2 * np.pi * phase)).astype(np.float32)
    # Labels, not values: a sum keeps them positive for the palette's remainder.
    return np.floor(2 * phase).astype(np.int64) + 1000


def _checks(rng, size):
    x, y = _coordinates(size)
    # Even numbers, so that two colours alternate across the seam as well.
    n, m = 2 * int(rng.integers(1, 10)), 2 * int(rng.integers(1, 10))
    if rng.random() < 0.5:
        return (np.floor(n * x) + np.floor(m * y)).astype(np.int64)
    return rng.integers(0, 5, (m, n))[np.floor(m * y).astype(int), np.floor(n * x).astype(int)]


def _glyphs(rng, size):
    """Return lines of words in an invented alphabet of 5x7 strokes."""
    # Strokes lie on the columns 0, 2, 4 and the rows 0, 3, 6 of a letter.
    alphabet = np.zeros((24, 7, 5), bool)
    for letter in alphabet:
        for _ in range(int(rng.integers(2, 5))):
            if rng.random() < 0.5:
                r, c0 = 3 * int(rng.integers(0, 3)), int(rng.integers(0, 2))
                letter[r, c0 : c0 + int(rng.integers(3, 6))] = True
            else:
                c, r0 = 2 * int(rng.integers(0, 3)), 3 * int(rng.integers(0, 2))
                letter[r0 : r0 + int(rng.integers(4, 8)), c] = True
    columns, rows = int(rng.integers(6, 22)), int(rng.integers(4, 16))
    # A letter of 7 x 5 texels has a cell of 10 x 6, which leaves space between lines and letters.
    page = np.zeros((rows * 10, columns * 6), np.int64)
    for row in range(rows):
        ink = 1 + int(rng.integers(0, 4))
        for column in range(columns):
            # 18 % of the places stay empty and separate words.
            if rng.random() > 0.18:
                page[row * 10 + 2 : row * 10 + 9, column * 6 : column * 6 + 5] = ink * alphabet[rng.integers(0, 24)]
    y = np.minimum((np.arange(size) + 0.5) / size * page.shape[0], page.shape[0] - 1).astype(int)
    x = np.minimum((np.arange(size) + 0.5) / size * page.shape[1], page.shape[1] - 1).astype(int)
    return page[np.ix_(y, x)]


def _dots(rng, size):
    """Return discs of random radius and colour, wrapped around the edges."""
    field = np.zeros((size, size), np.int64)
    smallest, largest = 0.01, rng.uniform(0.03, 0.12)
    for colour in range(int(rng.integers(40, 160))):
        cx, cy = rng.random(2) * size
        radius = max(rng.uniform(smallest, largest) * size, 1.0)
        x = np.arange(int(cx - radius), int(cx + radius) + 2)
        y = np.arange(int(cy - radius), int(cy + radius) + 2)
        inside = (x[None, :] + 0.5 - cx) ** 2 + (y[:, None] + 0.5 - cy) ** 2 < radius**2
        # The texture repeats, so a disc goes on at the opposite side.
        patch = np.ix_(y % size, x % size)
        # 0: no disc covers the pixel.
        field[patch] = np.where(inside, colour + 1, field[patch])
    return field


def _gradient(rng, size):
    """Return a few smooth waves: low contrast almost everywhere, the hardest case for event cameras."""
    x, y = _coordinates(size)
    waves = [
        rng.uniform(0.3, 1) * np.cos(2 * np.pi * (rng.integers(-2, 3) * x + rng.integers(-2, 3) * y + rng.random()))
        for _ in range(4)
    ]
    return _stretch(sum(waves) + 0.3 * np.cos(2 * np.pi * (x + rng.random())))


def _bricks(rng, size):
    rows, columns = 2 * int(rng.integers(2, 9)), int(rng.integers(2, 9))
    x, y = _coordinates(size)
    row = np.floor(y * rows).astype(int)
    # Every second row is shifted by half a brick.
    along = x * columns + 0.5 * (row % 2)
    brick = np.floor(along).astype(int) % columns
    tone = 0.35 + 0.6 * rng.random((rows, columns))[row, brick] + 0.25 * _perlin_noise(rng, size, 32)
    # Distances to the joints are in heights of a brick, so sideways ones are scaled by its proportions.
    joint = rng.uniform(0.04, 0.1)
    mortar = (np.minimum(along % 1, 1 - along % 1) * rows / columns < joint) | (
        np.minimum(y * rows % 1, 1 - y * rows % 1) < joint
    )
    return np.where(mortar, 0.0, np.clip(tone, 0.2, 1)).astype(np.float32)


_PIPS = ("4", "08", "048", "0268", "02468", "023568")
"""Pips of the faces 1 to 6, on a lattice of three by three, numbered row by row."""


_STUFFS = ((236, 226, 198), (196, 34, 40), (38, 38, 44), (32, 84, 176), (30, 128, 72), (226, 150, 34), (112, 52, 148))
"""Ivory, red, black, blue, green, amber, violet."""


def _pips(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return the six faces of a :func:`~blinkgl.scene.geometry.primitives.die`, (size, size, 3) uint8, of a marbled
    material, the pips light on dark or dark on light. It is not one of the pools' kinds, because it fits only a die."""
    base = np.array(_STUFFS[int(rng.integers(len(_STUFFS)))], float) * rng.uniform(0.85, 1.1, 3)
    grain = rng.uniform(0.1, 0.4)
    warped = _stretch(np.sum([0.6**k * _perlin_noise(rng, size, 8 * 2**k) for k in range(4)], axis=0))
    vein = 0.5 + 0.5 * np.sin(rng.uniform(4, 14) * warped)
    stuff = np.clip((1 - grain * vein)[..., None] * base, DARKEST, BRIGHTEST)
    light = float((stuff @ [0.299, 0.587, 0.114]).mean()) > 110
    ink = np.full(3, 22.0) if light else np.full(3, 232.0)
    rows, columns = DIE_FACES
    at, soft = (np.arange(size) + 0.5) / size, rows / size  # soft: a texel's height in a face
    for face, lattice in enumerate(_PIPS):
        row, column = divmod(face, columns)
        for r, c in (divmod(int(place), 3) for place in lattice):
            # Pips lie at 0.27, 0.50 and 0.73 of a face's side.
            v, u = at * rows - row - (0.27 + 0.23 * r), at * columns - column - (0.27 + 0.23 * c)
            down, across = (np.flatnonzero(np.abs(d) < 0.1 + soft) for d in (v, u))
            distance = np.hypot(v[down, None], u[None, across])
            pip = np.clip((0.082 - distance) / soft + 0.5, 0, 1)[..., None]
            patch = np.ix_(down, across)
            stuff[patch] = stuff[patch] * (1 - pip) + ink * pip
    return np.round(stuff).astype(np.uint8)


_FIELDS = {
    "value": lambda rng, size: _stretch(_value_noise(rng, size, int(rng.integers(6, 40)))),
    "perlin": lambda rng, size: _stretch(_perlin_noise(rng, size, int(rng.integers(4, 24)))),
    "fbm": _fbm,
    "stripes": _stripes,
    "checks": _checks,
    "glyphs": _glyphs,
    "dots": _dots,
    "gradient": _gradient,
    "bricks": _bricks,
}
assert tuple(_FIELDS) == TEXTURE_KINDS
_ALL_KINDS = (*TEXTURE_KINDS, "pips")
