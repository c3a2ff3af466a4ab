"""The body of a figure: one watertight skin around a skeleton's capsules, with weights and texture coordinates.

Each bone has capsules; they are blended where they meet, and a vertex follows the nearby bones, so that joints bend
smoothly. Texture coordinates are an atlas: each part of the body has its own rectangle (:data:`CHARTS`), once around it
from left to right, from its upper end down, all in one scale, so that any pattern looks like cloth; the seams are at
the back, under the soles and at the palms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix

from blinkgl.scene.shapes.gait import JOINTS, PARENTS, J, Proportions
from blinkgl.scene.shapes.skeleton import Locals, Skeleton, Still

# ---------------------------------------------------------------------------------------------------------------------
# The closed surface of an implicit function: naive surface nets (Gibson 1998), then Newton's method.
#
# points, faces, normals = isosurface(distance, low, high, step)

# The twelve edges of a cell, from the lower to the upper corner.
_EDGES = [
    (np.array(a), np.array(b))
    for a in np.ndindex(2, 2, 2)
    for b in np.ndindex(2, 2, 2)
    if sum(b) - sum(a) == 1 and all(q >= p for p, q in zip(a, b))
]


def isosurface(
    distance: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ((V, 3) points, (F, 3) int32 faces, (V, 3) unit normals) of where ``distance`` ((N, 3) points to (N,)) is
    zero; it is negative inside, changes by at most 1.2 per unit and need not be exact. Cells of edge ``step`` fill the
    box low to high, (3,); its outermost cells must lie outside. Faces are counter-clockwise seen from outside."""
    shape = np.ceil((np.asarray(high) - low) / step).astype(int) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    values = _values(distance, low + step * grid, step)
    inside = values < 0
    # Number of a cell's eight corners that are inside: 1 to 7 where the surface passes.
    count = sum(
        inside[tuple(slice(o, n - 1 + o) for o, n in zip(corner, shape))].astype(int) for corner in np.ndindex(2, 2, 2)
    )
    cells = np.argwhere((count > 0) & (count < 8))
    number = np.full(shape - 1, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    # The cell's vertex is the mean of the surface's crossings of its edges.
    total, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in _EDGES:
        u, v = values[tuple((cells + a).T)], values[tuple((cells + b).T)]
        crossed = (u < 0) != (v < 0)
        share = np.where(crossed, u / np.where(crossed, u - v, 1.0), 0.0)
        total += np.where(crossed[:, None], a + share[:, None] * (b - a), 0.0)
        crossings += crossed
    points = low + step * (cells + total / crossings[:, None])
    faces = []
    # Where the sign changes between neighbours on the grid, the four cells around that edge form a quadrilateral.
    for axis in range(3):
        turned = [axis, (axis + 1) % 3, (axis + 2) % 3]
        solid, cell = np.transpose(inside, turned), np.transpose(number, turned)
        out, back = solid[:-1] & ~solid[1:], ~solid[:-1] & solid[1:]
        for way, mask in ((1, out), (-1, back)):
            i, j, k = np.nonzero(mask[:, 1:-1, 1:-1])
            faces.append(
                np.stack([cell[i, j, k], cell[i, j + 1, k], cell[i, j + 1, k + 1], cell[i, j, k + 1]], 1)[:, ::way]
            )
    quads = np.concatenate(faces)
    # Newton's method along the gradient, at most half a cell at a time.
    for _ in range(2):
        gradient = _gradient(distance, points, 1e-3 * step)
        move = distance(points) / np.maximum((gradient**2).sum(axis=1), 1e-12)
        points = points - np.clip(move, -step / 2, step / 2)[:, None] * gradient
    # Cut along the shorter diagonal.
    a, b, c, d = (points[quads[:, k]] for k in range(4))
    short = ((a - c) ** 2).sum(axis=1) < ((b - d) ** 2).sum(axis=1)
    halves = [(0, 1, 2), (0, 2, 3)], [(0, 1, 3), (1, 2, 3)]
    triangles = [quads[mask][:, half] for mask, pair in zip((short, ~short), halves) for half in pair]
    normals = _gradient(distance, points, 1e-2 * step)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, np.concatenate(triangles).astype(np.int32), normals


def _values(distance: Callable[[np.ndarray], np.ndarray], grid: np.ndarray, step: float) -> np.ndarray:
    """Return the values at the points of a (X, Y, Z, 3) grid: exact where the surface may be near, with the right sign
    elsewhere."""
    # Each block of four points per side is tested at its middle.
    shape, middles = grid.shape[:3], [np.minimum(np.arange(2, n + 4, 4), n - 1) for n in grid.shape[:3]]
    coarse = distance(grid[np.ix_(*middles)].reshape(-1, 3)).reshape([len(m) for m in middles])
    values = coarse[np.ix_(*(np.arange(n) // 4 for n in shape))]
    # Values change by at most 1.2 per unit: farther than 1.2 diagonals of a block the sign is certain.
    near = np.abs(values) < 1.2 * 4 * math.sqrt(3) * step
    values[near] = distance(grid[near])
    return values


def _gradient(distance: Callable[[np.ndarray], np.ndarray], points: np.ndarray, h: float) -> np.ndarray:
    return np.stack([(distance(points + e) - distance(points - e)) / (2 * h) for e in h * np.eye(3)], axis=1)


ATLAS = 1.5
"""m of an average body that the texture covers in both directions."""


class Chart(NamedTuple):
    """A part of the body in the texture, in m of the atlas: left and upper edge, circumference, length."""

    left: float
    top: float
    around: float
    length: float


CHARTS = {
    "torso": Chart(0.0, 0.0, 0.95, 0.66),
    "upper_arm": Chart(1.0, 0.0, 0.34, 0.33),
    "forearm": Chart(1.0, 0.35, 0.27, 0.31),
    "thigh": Chart(0.0, 0.68, 0.54, 0.48),
    "shank": Chart(0.56, 0.68, 0.40, 0.48),
    "hand": Chart(1.0, 0.68, 0.23, 0.20),
    "head": Chart(0.0, 1.18, 0.60, 0.32),
    "foot": Chart(0.64, 1.18, 0.30, 0.30),
}
_MARGIN = 0.03  # m above and below each chart that belong to it
_CHART_OF = {
    "pelvis": "torso", "spine": "torso", "chest": "torso", "clavicle": "torso", "neck": "head", "head": "head",
    "arm": "upper_arm", "forearm": "forearm", "hand": "hand", "thigh": "thigh", "shank": "shank", "foot": "foot",
    "toes": "foot",
}  # fmt: skip
SPACINGS = (0.026, 0.037, 0.052)
"""m between the vertices of an average body, finest first: about 4,000, 2,000 and 1,000 of them."""
_BLEND = 0.014
_SOFT = 0.022  # m over which the weights of neighbouring bones change
_BIND = {"arm_l": 42.0, "arm_r": -42.0, "thigh_l": 4.0, "thigh_r": -4.0, "foot_l": -4.0, "foot_r": 4.0}
"""Bind pose of limbs, degrees about x: apart from each other."""


class Body(NamedTuple):
    """A bound body. vertices, normals : (V, 3).   faces : (F, 3).   uvs : (V, 2).   joints, weights : (V, 4).
    inverse_bind : (21, 4, 4)."""

    vertices: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    inverse_bind: np.ndarray


class _Piece(NamedTuple):
    """A capsule from a to b with radii at both ends, ``flat`` times as thick along x and y of the body."""

    bone: int
    a: np.ndarray
    b: np.ndarray
    radii: tuple[float, float]
    flat: tuple[float, float]

    def distance(self, points: np.ndarray) -> np.ndarray:
        scale = 1 / np.array([*self.flat, 1.0])
        # Space is scaled so that the flattened capsule is round.
        along, p = (self.b - self.a) * scale, (points - self.a) * scale
        t = np.clip(p @ along / max(along @ along, 1e-12), 0, 1)
        radius = self.radii[0] + (self.radii[1] - self.radii[0]) * t
        # At most the distance in space that is not scaled.
        return (np.linalg.norm(p - t[:, None] * along, axis=1) - radius) * min(*self.flat, 1.0)


_ROUND = (1.0, 1.0)


@lru_cache(maxsize=64)
def body_of(body: Proportions, level: int = 0) -> Body:
    """Return the skin of a body in the bind pose, its limbs apart, its soles on z = 0: the average one with each bone
    scaled in length and thickness. level : of :data:`SPACINGS`. Read only."""
    points, normals, faces, uvs, joints, weights = _average(SPACINGS[level])
    bind, shape = _bind(body), _shape(body)
    turns = bind[:, :3, :3]
    # The scale acts in each joint's own axes: R S R^T.
    shape = turns * shape[:, None] @ turns.transpose(0, 2, 1)
    # Relative to the joint, scaled, and placed at the joint of the new body; weighted over the bones.
    local = points[:, None] - _bind(Proportions())[joints, :3, 3]
    placed = (shape[joints] @ local[..., None])[..., 0] + bind[joints, :3, 3]
    vertices = (weights[..., None] * placed).sum(axis=1)
    # Normals are transformed by the inverse of the positions' scale.
    outward = (weights[..., None] * (np.linalg.inv(shape)[joints] @ normals[:, None, :, None])[..., 0]).sum(axis=1)
    floor = bind[J["foot_l"], 2, 3] - body.ankle
    # The soles go to z = 0, and the joints with them.
    vertices[:, 2] -= floor
    bind[:, 2, 3] -= floor
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    made = Body(
        vertices=vertices,
        normals=outward,
        uvs=uvs,
        faces=faces,
        joints=joints,
        weights=weights,
        inverse_bind=np.linalg.inv(bind),
    )
    for array in made:
        array.setflags(write=False)
    return made


def _shape(body: Proportions) -> np.ndarray:
    """Return the scale of each bone relative to an average body, in its own frame, (21, 3): z along it, except for the
    feet."""
    out = np.full((len(JOINTS), 3), body.unit)
    for number, name in enumerate(JOINTS):
        bone = name.partition("_")[0]
        if bone == "head":
            out[number] *= body.head
        elif bone == "neck":
            out[number] *= [0.8 + 0.2 * body.build] * 2 + [body.head]
        elif bone in ("foot", "toes", "hand"):
            out[number, 2] *= body.arms if bone == "hand" else body.legs
        else:
            length = body.arms if "arm" in bone else body.legs if bone in ("thigh", "shank") else 1.0
            out[number] *= [body.build, body.build, length]
    return out


@lru_cache(maxsize=len(SPACINGS))
def _average(spacing: float) -> tuple[np.ndarray, ...]:
    """Return an average body in the bind pose, with vertices about ``spacing`` m apart: (V, 3) points, (V, 3) normals,
    (F, 3) faces, (V, 2) texture coordinates, (V, 4) joints and their weights. Vertices are split at the texture's
    seams."""
    body = Proportions()
    bind = _bind(body)
    pieces = _pieces(body, bind)
    floor = bind[J["foot_l"], 2, 3] - body.ankle

    def distance(points: np.ndarray) -> np.ndarray:
        """Return the distance to the blend of all capsules, cut off below the soles."""
        near = np.stack([p.distance(points) for p in pieces])
        least = near.min(axis=0)
        # A smooth minimum: -b ln sum exp(-d / b), relative to the smallest so that nothing overflows.
        blend = least - _BLEND * np.log(np.exp(-np.maximum(near - least, 0) / _BLEND).sum(axis=0))
        return np.maximum(blend, floor - points[:, 2])

    ends = np.concatenate([[p.a, p.b] for p in pieces])
    low, high = ends.min(axis=0) - 0.2, ends.max(axis=0) + 0.2
    low[2] = floor - 2.4 * spacing
    points, faces, normals = isosurface(distance, low, high, spacing)
    weights = _weights(points, faces, pieces)
    uvs = _unwrapped(points, faces, normals, weights, bind)
    # The four largest weights are kept, as the shader takes four.
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    four = np.take_along_axis(weights, order, 1)
    # Corners with the same vertex and texture coordinates are one vertex of the mesh.
    corners = np.concatenate([faces.reshape(-1, 1), np.round(uvs.reshape(-1, 2) * 1e6).astype(np.int64)], axis=1)
    _, first, index = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    old = faces.reshape(-1)[first]
    return (
        points[old],
        normals[old],
        index.reshape(-1, 3).astype(np.int32),
        uvs.reshape(-1, 2)[first],
        order[old],
        (four / four.sum(axis=1, keepdims=True))[old],
    )


def _bind(body: Proportions) -> np.ndarray:
    """Return the (21, 4, 4) poses of the joints in the bind pose."""
    rest = Locals.rest(len(JOINTS))
    rest.translation[:] = body.offsets
    for name, degrees in _BIND.items():
        half = math.radians(degrees) / 2
        rest.rotation[J[name]] = [math.sin(half), 0, 0, math.cos(half)]
    return Skeleton(PARENTS, Still(rest)).at(0)[0]


def _pieces(body: Proportions, bind: np.ndarray) -> list[_Piece]:
    """Return the capsules of an average body's bones. Positions are m in the joint's frame."""
    sole = body.ankle
    # Joint, both ends, both radii, flatness.
    middle = (
        ("pelvis", (-0.005, 0, -0.055), (0, 0, 0.04), (0.118, 0.112), (0.92, 1.30)),
        ("pelvis", (-0.045, 0.06, -0.06), (-0.045, -0.06, -0.06), (0.083, 0.083), _ROUND),
        ("spine", (0.0, 0, 0), (0.002, 0, 0.12), (0.106, 0.112), (0.88, 1.22)),
        ("chest", (0.0, 0, 0.02), (-0.005, 0, 0.15), (0.120, 0.108), (0.90, 1.40)),
        ("neck", (-0.005, 0, -0.02), (0.01, 0, 0.09), (0.056, 0.052), _ROUND),
        ("head", (0.012, 0, 0.085), (0.002, 0, 0.115), (0.082, 0.095), (1.08, 0.84)),
        ("head", (0.035, 0, 0.012), (0.03, 0, 0.07), (0.048, 0.062), (1.0, 0.92)),
        ("head", (0.10, 0, 0.055), (0.09, 0, 0.085), (0.014, 0.008), _ROUND),  # the nose
    )
    left = (
        ("head", (0.0, 0.078, 0.06), (-0.006, 0.082, 0.085), (0.016, 0.018), (1, 0.6)),
        ("clavicle", (-0.005, 0, -0.035), (-0.005, 0.12, -0.02), (0.066, 0.060), _ROUND),
        ("arm", (-0.004, 0, -0.005), (0, 0, -0.27), (0.060, 0.043), _ROUND),
        ("forearm", (0, 0, -0.005), (0, 0, -0.23), (0.042, 0.029), _ROUND),
        ("hand", (0, 0, -0.02), (0.004, 0, -0.085), (0.029, 0.033), (1.25, 0.62)),
        ("hand", (0.006, 0, -0.09), (0.002, 0, -0.155), (0.030, 0.022), (1.2, 0.5)),
        ("hand", (0.02, 0, -0.03), (0.05, 0, -0.085), (0.015, 0.012), _ROUND),  # the thumb
        ("thigh", (0.0, 0, -0.02), (0.004, 0, -0.40), (0.089, 0.057), _ROUND),
        ("shank", (0.002, 0, 0), (0, 0, -0.38), (0.055, 0.037), _ROUND),
        ("shank", (-0.018, 0, -0.09), (-0.014, 0, -0.18), (0.047, 0.040), _ROUND),  # the calf
        ("foot", (-0.018, 0, 0.037 - sole), (0.07, 0, 0.039 - sole), (0.042, 0.043), (1, 0.92)),
        ("foot", (0, 0, -0.01), (0.03, 0, 0.042 - sole), (0.040, 0.043), (1, 0.92)),
        ("foot", (0.04, 0, 0.037 - sole), (0.125, 0, 0.028 - sole), (0.041, 0.034), (1, 1.15)),
        ("toes", (0.005, 0, 0.008), (0.045, 0, 0.004), (0.032, 0.027), (1, 1.35)),
    )
    made = []
    for side, sign, capsules in (("", 1.0, middle), ("_l", 1.0, left), ("_r", -1.0, left)):
        for name, a, b, radii, flat in capsules:
            joint = J[name if name in J else name + side]
            T = bind[joint]
            start, end = (T[:3, :3] @ (np.array(p) * [1, sign, 1]) + T[:3, 3] for p in (a, b))
            made.append(_Piece(joint, start, end, radii, flat))
    return made


def _weights(points: np.ndarray, faces: np.ndarray, pieces: list[_Piece]) -> np.ndarray:
    """Return (V, 21) weights: larger for nearer bones; only bones within two joints of the nearest one."""
    far = np.full((len(points), len(JOINTS)), np.inf)
    for piece in pieces:
        far[:, piece.bone] = np.minimum(far[:, piece.bone], piece.distance(points))
    # Two joints apart: the product of the relation with itself.
    near = np.zeros((len(JOINTS), len(JOINTS)), bool)
    for joint, parent in enumerate(PARENTS):
        near[joint, joint] = True
        if parent >= 0:
            near[joint, parent] = near[parent, joint] = True
    near = near.astype(int) @ near.astype(int) > 0
    least = far.argmin(axis=1)
    weights = np.exp(-(far - far.min(axis=1, keepdims=True)) / _SOFT) * near[least]
    weights[weights < 0.02] = 0
    # Weights are smoothed over the mesh's edges, three times half the neighbours' mean.
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    links = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(points),) * 2).tocsr()
    links = links.multiply(1 / np.maximum(links.sum(axis=1), 1))
    for _ in range(3):
        weights = weights / weights.sum(axis=1, keepdims=True)
        weights = 0.5 * weights + 0.5 * (links @ weights)
    return weights / weights.sum(axis=1, keepdims=True)


_AXES = {  # chart: (joint, its upper and its lower end in m of an average body, what is in the middle of the chart)
    "torso": ("spine", (0, 0, 0.42), (0, 0, -0.20), (1, 0, 0)),
    "head": ("head", (0.01, 0, 0.21), (0.01, 0, -0.09), (1, 0, 0)),
    "upper_arm": ("arm", (0, 0, 0.02), (0, 0, -0.29), (0, 1, 0)),
    "forearm": ("forearm", (0, 0, 0.0), (0, 0, -0.25), (0, 1, 0)),
    "hand": ("hand", (0, 0, 0.0), (0, 0, -0.17), (0, 1, 0)),
    "thigh": ("thigh", (0, 0, 0.0), (0, 0, -0.43), (1, 0, 0)),
    "shank": ("shank", (0, 0, 0.0), (0, 0, -0.41), (1, 0, 0)),
    "foot": ("foot", (0.20, 0, -0.05), (-0.055, 0, -0.05), (0, 0, 1)),
}


def _unwrapped(
    points: np.ndarray, faces: np.ndarray, normals: np.ndarray, weights: np.ndarray, bind: np.ndarray
) -> np.ndarray:
    """Return (F, 3, 2) texture coordinates of the corners of an average body's faces."""
    names = list(CHARTS)
    # A column for each chart, left and right.
    share = np.zeros((len(points), 2 * len(names)))
    # Each face goes to the chart in which its corners have most weight.
    for joint, name in enumerate(JOINTS):
        bone, _, side = name.partition("_")
        share[:, 2 * names.index(_CHART_OF[bone]) + (side == "r")] += weights[:, joint]
    chart = share[faces].sum(axis=1).argmax(axis=1)
    uvs = np.empty((len(faces), 3, 2))
    for number, name in enumerate(names):
        joint, top, bottom, middle = _AXES[name]
        area = CHARTS[name]
        for right in (0, 1):
            here = chart == 2 * number + right
            if not here.any():
                continue
            paired = f"{joint}_l" in J
            T = bind[J[f"{joint}_{'lr'[right]}" if paired else joint]]
            local = (points[faces[here]] - T[:3, 3]) @ T[:3, :3]
            outward = normals[faces[here]] @ T[:3, :3]
            top_, bottom_, ahead = (np.array(v, float) for v in (top, bottom, middle))
            mirror = paired and right
            # Right limbs are the mirror image of left ones, so that the pattern is symmetric.
            if mirror:
                local, outward, ahead = (v * [1, -1, 1] for v in (local, outward, ahead))
                ahead = np.array(middle, float)
            down = (bottom_ - top_) / np.linalg.norm(bottom_ - top_)
            across = np.cross(down, ahead)
            # Cylindrical coordinates about the part's axis.
            p = local - top_
            # Caps: the direction of the surface determines the angle better than the position does.
            q = p + 0.03 * outward
            angle = np.arctan2(q @ across, q @ ahead) / (2 * math.pi)
            # Angles of a face are brought within half a turn of its first, so that no face spans the chart.
            first = angle[:, :1]
            angle = first + (angle - first + 0.5) % 1.0 - 0.5
            if mirror:
                angle = -angle
            length = np.linalg.norm(bottom_ - top_)
            inner = area.length - 2 * _MARGIN
            below = np.clip(p @ down / length * inner + _MARGIN, 0.0, area.length)
            uvs[here, :, 0] = (area.left + area.around * (0.5 + angle)) / ATLAS
            uvs[here, :, 1] = (area.top + below) / ATLAS
    return uvs
