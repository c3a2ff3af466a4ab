"""Skins and morph targets: vertices that follow joints, and vertices that are displaced towards other shapes.

    q(p, t) = sum_i w_i J_i(t) (p + sum_k m_k(t) d_k),     J_i = after . joint_i(t) . inverse bind_i . before

and the difference to another time, with p_m the morphed vertex and D = sum_k (m_k' - m_k) d_k,

    q' - q = sum_i w_i (J_i' - J_i) (p_m + D) + sum_i w_i J_i D        (the last J without its translation),

whose matrices are subtracted in float64 (``changes``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from blinkgl.errors import AssetError
from blinkgl.machine.kernels import kernel
from blinkgl.scene.motion.pose_path import no_jumps
from blinkgl.scene.shapes.skeleton import NEVER, Locals, Skeleton, Still
from blinkgl.scene.types import Deformer, Mesh

MAX_ROWS = 1024
"""Largest number of rows per time: OpenGL's blocks of 64 kB hold four times as many."""
MAX_WEIGHTS = 8
"""Largest number of joints of a vertex."""
_TEXTURE_WIDTH = 4096


@dataclass(frozen=True, eq=False)
class Morphs:
    """Morph targets of a mesh. positions : (k, V, 3) displacements at weight 1.   normals : likewise, or None.
    weights : ((k,), (k,)) at a time in ns: weight of each, and its rate per second.
    is_static, period_ns, span_ns, timescale_ns, jumps : as of :class:`~blinkgl.scene.shapes.skeleton.Motion`."""

    positions: np.ndarray
    normals: np.ndarray | None
    weights: Callable[[int], tuple[np.ndarray, np.ndarray]]
    is_static: bool = False
    period_ns: int | None = None
    span_ns: int = 0
    timescale_ns: int = NEVER
    jumps: Callable[[int, int], list[int]] = no_jumps

    def taken(self, vertices: np.ndarray) -> Morphs:
        """Return the targets of some of the vertices, in their order."""
        normals = None if self.normals is None else self.normals[:, vertices]
        return replace(self, positions=self.positions[:, vertices], normals=normals)

    def transformed(self, linear: np.ndarray) -> Morphs:
        """Return the targets of the mesh under a (3, 3) map; exact for rotations and uniform scales, which keep unit
        normals."""
        scale = abs(float(np.linalg.det(linear))) ** (1 / 3)
        # Directions of normals transform by the inverse transpose, which the scale brings back to their length.
        normals = None if self.normals is None else self.normals @ np.linalg.inv(linear) * scale
        return replace(self, positions=self.positions @ linear.T, normals=normals)


class Skin(Deformer):
    """Vertices that follow joints.

    skeleton : :class:`~blinkgl.scene.shapes.skeleton.Skeleton`, in the object's frame.
    bones : (m,) its joints that vertices follow.   inverse_bind : (m, 4, 4) from the mesh to each joint in the bind
    pose.
    joints : (V, k) indices in ``bones``.   weights : (V, k), normalised to sum 1.   morphs : :class:`Morphs` or None.
    after, before : (4, 4) of the object and of the mesh, where these are rotated or scaled (:meth:`transformed`).

    Raises AssetError naming ``where``: joints that do not exist, weights that are negative, not finite or sum to zero,
    a matrix that is not finite, more joints than fit."""

    glsl = "skin"
    examples = (
        {"SKIN_WEIGHTS": 4},
        {"SKIN_WEIGHTS": 8, "SKIN_MORPHS": 2, "SKIN_MORPH_ROW": 60, "SKIN_VERTICES": 100},
    )

    def __init__(
        self,
        skeleton: Skeleton,
        bones: ArrayLike,
        inverse_bind: ArrayLike,
        joints: ArrayLike,
        weights: ArrayLike,
        morphs: Morphs | None = None,
        *,
        after: ArrayLike | None = None,
        before: ArrayLike | None = None,
        where: str = "skin",
    ):
        self.skeleton, self.morphs, self.where = skeleton, morphs, where
        self.bones = np.asarray(bones, np.int64).reshape(-1)
        self.inverse_bind = np.asarray(inverse_bind, np.float64)
        self.after = np.eye(4) if after is None else np.asarray(after, np.float64)
        self.before = np.eye(4) if before is None else np.asarray(before, np.float64)
        self.joints, self.weights = _checked_weights(
            np.asarray(joints), np.asarray(weights, np.float64), len(self.bones), where
        )
        _check_bones(self.inverse_bind, where)
        # The constant matrices are multiplied once.
        self._bind = self.inverse_bind @ self.before
        targets = 0 if morphs is None else len(morphs.positions)
        # A joint's matrix is three rows of four; morph weights are packed four per row after them.
        self._rows = 3 * len(self.bones) + -(-targets // 4)
        if self._rows > MAX_ROWS:
            raise AssetError(
                "a skin has too many joints and morph targets",
                where=where,
                value=(len(self.bones), targets),
                accepted=f"three per joint and a quarter per target, at most {MAX_ROWS} together",
            )
        moving = [part for part in (skeleton.motion, morphs) if part is not None and not part.is_static]
        # Joints and targets with different periods have no useful common period.
        periods = {part.period_ns for part in moving}
        self.period_ns = periods.pop() if len(periods) == 1 else None
        self.span_ns = max((part.span_ns for part in moving), default=0)
        # A motion of somebody's own may not say it.
        scales = [getattr(part, "timescale_ns", None) for part in moving]
        self.timescale_ns = None if None in scales else min(filter(None, scales), default=NEVER)
        self._jumps = [getattr(part, "jumps", no_jumps) for part in moving]
        self.locomotion = getattr(skeleton.motion, "locomotion", "free")
        # The body moves along its x axis, whose scale is the length of the first column.
        self.speed = getattr(skeleton.motion, "speed", 0.0) * float(np.linalg.norm(self.after[:3, 0]))
        self.mirrors = getattr(skeleton.motion, "mirrors", False) or self.side(0) != 1
        self.sizes = {"SKIN_WEIGHTS": self.weights.shape[1]}
        if targets:
            self.sizes |= {
                "SKIN_MORPHS": targets,
                "SKIN_MORPH_ROW": 3 * len(self.bones),
                "SKIN_VERTICES": len(self.joints),
            }
        self.attributes = _streams(self.joints, self.weights)
        self.textures = {} if morphs is None else {"skin_morphs": _deltas_texture(morphs)}

    def jumps(self, t0_ns: int, t1_ns: int) -> list[int]:
        return sorted({t for jumps in self._jumps for t in jumps(t0_ns, t1_ns)})

    @classmethod
    def rigid(
        cls,
        skeleton: Skeleton,
        joint: int,
        vertices: int,
        morphs: Morphs | None = None,
        *,
        inverse_bind: ArrayLike | None = None,
        after: ArrayLike | None = None,
        where: str = "skin",
    ) -> Skin:
        """Return a skin whose vertices all follow one joint; they are in its frame, or are transformed there by
        ``inverse_bind`` (4, 4)."""
        bind = np.eye(4) if inverse_bind is None else np.asarray(inverse_bind)
        bound = np.zeros((vertices, 1)), np.ones((vertices, 1))
        return cls(skeleton, [joint], bind[None], *bound, morphs, after=after, where=where)

    @classmethod
    def morphing(cls, morphs: Morphs, where: str = "morph targets") -> Skin:
        """Return a skin with morph targets and one static joint."""
        still = Skeleton([-1], Still(Locals.rest(1)))
        return cls.rigid(still, 0, morphs.positions.shape[1], morphs, where=where)

    def of_vertices(self, vertices: np.ndarray) -> Skin:
        morphs = None if self.morphs is None else self.morphs.taken(vertices)
        bound = self.joints[vertices], self.weights[vertices]
        after, before = self.after, self.before
        return Skin(
            self.skeleton, self.bones, self.inverse_bind, *bound, morphs, after=after, before=before, where=self.where
        )

    @property
    def rows(self) -> int:
        return self._rows

    @property
    def is_static(self) -> bool:
        return self.skeleton.is_static and (self.morphs is None or self.morphs.is_static)

    def transformed(self, matrix: np.ndarray) -> Skin:
        matrix = np.asarray(matrix, np.float64)
        morphs = None if self.morphs is None else self.morphs.transformed(matrix[:3, :3])
        parts = self.skeleton, self.bones, self.inverse_bind, self.joints, self.weights, morphs
        return Skin(*parts, after=matrix @ self.after, before=self.before @ np.linalg.inv(matrix), where=self.where)

    # ---- the shape, on the CPU -----------------------------------------------------------------------------------

    def matrices(self, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return J_i and dJ_i/dt, ((m, 4, 4), (m, 4, 4)) float64."""
        world, rate = self.skeleton.at(t_ns)
        return self.after @ world[self.bones] @ self._bind, self.after @ rate[self.bones] @ self._bind

    def side(self, t_ns: int) -> int:
        signs = np.sign(np.linalg.det(self.matrices(t_ns)[0][:, :3, :3]))
        # A joint of scale 0 hides its part and has no side.
        return 1 if (signs >= 0).all() else -1 if (signs <= 0).all() else 0

    def _blend(self, matrices: np.ndarray) -> np.ndarray:
        """Return the vertices' blends, (V, 3, 4), of (m, 4, 4)."""
        # Sum over a vertex' joints k of w_k J_k, without the last row, which is (0, 0, 0, 1).
        return np.einsum("vk,vkij->vij", self.weights, matrices[:, :3][self.joints])

    def mirrored(self, t_ns: int) -> np.ndarray:
        """Return (V,) bool: whether a vertex' joints mirror it at a time."""
        return np.linalg.det(self._blend(self.matrices(t_ns)[0])[:, :, :3]) < 0

    def _morphed(self, vectors: np.ndarray, deltas: np.ndarray | None, weights: np.ndarray) -> np.ndarray:
        vectors = np.asarray(vectors, np.float64)
        return vectors if deltas is None else vectors + np.tensordot(weights, deltas, 1)

    def _follow(self, points: np.ndarray, matrices: np.ndarray, place: float = 1.0) -> np.ndarray:
        """Return the vertices' blends of (m, 4, 4) times (V, 3) points, (V, 3); place : 0 for directions."""
        return _followed(
            np.ascontiguousarray(points), self.joints, self.weights, np.ascontiguousarray(matrices[:, :3]), place
        )

    def positions(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        points = mesh.vertices
        if self.morphs is not None:
            points = self._morphed(points, self.morphs.positions, self.morphs.weights(t_ns)[0])
        return self._follow(points, self.matrices(t_ns)[0])

    def velocity(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        J, dJ = self.matrices(t_ns)
        if self.morphs is None:
            return self._follow(mesh.vertices, dJ)
        weights, d_weights = self.morphs.weights(t_ns)
        points = self._morphed(mesh.vertices, self.morphs.positions, weights)
        rates = np.tensordot(d_weights, self.morphs.positions, 1)
        return self._follow(points, dJ) + self._follow(rates, J, 0.0)

    def normals(self, mesh: Mesh, t_ns: int) -> np.ndarray:
        # a, b, c: the first, second and third rows of the vertices' matrices.
        a, b, c = np.moveaxis(self._blend(self.matrices(t_ns)[0])[:, :, :3], 1, 0)
        n = np.asarray(mesh.normals, np.float64)
        if self.morphs is not None:
            n = self._morphed(n, self.morphs.normals, self.morphs.weights(t_ns)[0])
        # The rows of the cofactor matrix are cross products of the blended matrix's rows: valid for any linear map.
        return np.stack([(np.cross(p, q) * n).sum(axis=1) for p, q in ((b, c), (c, a), (a, b))], axis=1)

    # ---- the shape, for the vertex stage -------------------------------------------------------------------------

    def _packed(self, matrices: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
        out = np.zeros((self._rows, 4))
        out[: 3 * len(self.bones)] = matrices[:, :3].reshape(-1, 4)
        if weights is not None:
            out[3 * len(self.bones) :].reshape(-1)[: len(weights)] = weights
        return out

    def numbers(self, t_ns: int) -> np.ndarray:
        return self._packed(self.matrices(t_ns)[0], None if self.morphs is None else self.morphs.weights(t_ns)[0])

    def rates(self, t_ns: int) -> np.ndarray:
        return self._packed(self.matrices(t_ns)[1], None if self.morphs is None else self.morphs.weights(t_ns)[1])

    def changes(self, t_ns: int, there_ns: int) -> np.ndarray:
        weights = None
        if self.morphs is not None:
            weights = self.morphs.weights(there_ns)[0] - self.morphs.weights(t_ns)[0]
        return self._packed(self.matrices(there_ns)[0] - self.matrices(t_ns)[0], weights)


@kernel
def _followed(points, joints, weights, matrices, place):
    """Return (V, 3) from (V, 3) points, (V, k) joints and weights, (m, 3, 4) matrices whose last columns are multiplied
    by ``place``."""
    out = np.empty((len(points), 3))
    for v in range(len(points)):
        x, y, z = points[v]
        for i in range(3):
            # Row i of the vertex's blended matrix; d is its translation.
            a = b = c = d = 0.0
            for k in range(weights.shape[1]):
                w, j = weights[v, k], joints[v, k]
                a += w * matrices[j, i, 0]
                b += w * matrices[j, i, 1]
                c += w * matrices[j, i, 2]
                d += w * matrices[j, i, 3]
            out[v, i] = a * x + c * z + b * y + place * d
    return out


def joined(skins: Sequence[Skin]) -> Skin | None:
    """Return one skin of several meshes' vertices, one after the other; None where they cannot be joined: different
    skeletons, morph targets, too many joints."""
    first = skins[0]
    if any(
        s.skeleton is not first.skeleton or s.morphs is not None or not np.array_equal(s.after, first.after)
        for s in skins
    ):
        return None
    sets: dict[tuple[bytes, bytes, bytes], tuple[int, Skin]] = {}
    joints, weights, count = [], [], 0
    width = max(s.weights.shape[1] for s in skins)
    for s in skins:
        key = (s.bones.tobytes(), s.inverse_bind.tobytes(), s.before.tobytes())
        if key not in sets:
            sets[key] = count, s
            count += len(s.bones)
        # Columns that a skin with fewer joints per vertex lacks are filled with weights of 0.
        room = ((0, 0), (0, width - s.weights.shape[1]))
        joints.append(np.pad(s.joints, room) + sets[key][0])
        weights.append(np.pad(s.weights, room))
    if 3 * count > MAX_ROWS:
        return None
    kinds = [s for _, s in sets.values()]
    # ``before`` differs from skin to skin, so it becomes part of the inverse bind matrices.
    bind = np.concatenate([s.inverse_bind @ s.before for s in kinds])
    bones = np.concatenate([s.bones for s in kinds])
    return Skin(
        first.skeleton, bones, bind, np.vstack(joints), np.vstack(weights), after=first.after, where=first.where
    )


def _checked_weights(joints: np.ndarray, weights: np.ndarray, bones: int, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return ((V, k) int64, (V, k) float64), the weights of each vertex in descending order with sum 1, exact in
    float32."""
    bad = ~(np.isfinite(weights) & (weights >= 0)).all(axis=1)
    _refuse(bad, "vertex {} of a skin has a weight that is negative or no number", weights, where)
    empty = ~(weights.sum(axis=1) > 1e-12)
    _refuse(empty, "the weights of vertex {} of a skin sum to zero", weights, where, "one joint or more")
    used = weights > 0
    outside = used & ~((joints >= 0) & (joints < bones))
    if outside.any():
        vertex = int(np.flatnonzero(outside.any(axis=1))[0])
        raise AssetError(
            f"vertex {vertex} of a skin follows a joint that does not exist",
            where=where,
            value=int(joints[vertex][outside[vertex]][0]),
            accepted=f"0 to {bones - 1}",
        )
    # Largest first, so that the smallest weights are cut off.
    order = np.argsort(-weights, axis=1, kind="stable")
    weights, joints = np.take_along_axis(weights, order, 1), np.take_along_axis(np.where(used, joints, 0), order, 1)
    width = min(max(int(used.sum(axis=1).max()), 1), MAX_WEIGHTS)
    weights, joints = weights[:, :width], joints[:, :width].astype(np.int64)
    # Rounded as for the vertex stage: CPU and GPU then use the same weights.
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32).astype(np.float64)
    return joints, weights


def _check_bones(inverse_bind: np.ndarray, where: str) -> None:
    broken = ~np.isfinite(inverse_bind).all(axis=(1, 2))
    _refuse(broken, "the inverse bind matrix of joint {} of a skin is not finite", inverse_bind, where)
    # A singular matrix is not an inverse; the ranks are those of the linear parts.
    flat, accepted = np.linalg.matrix_rank(inverse_bind[:, :3, :3]) < 3, "a matrix with an inverse"
    _refuse(flat, "the inverse bind matrix of joint {} of a skin is singular", inverse_bind, where, accepted)


def _refuse(
    wrong: np.ndarray | np.bool, problem: str, values: np.ndarray, where: str, accepted: str | None = None
) -> None:
    """Raise AssetError for the first of ``values`` that is wrong, whose number goes into the text of the problem."""
    if wrong.any():
        first = int(wrong.argmax())
        raise AssetError(problem.format(first), where=where, value=values[first].tolist(), accepted=accepted)


def _streams(joints: np.ndarray, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Return vertex attributes, four joints each."""
    streams = {}
    for number, start in enumerate(range(0, weights.shape[1], 4)):
        # The last four are filled up with joint 0 at weight 0.
        room = ((0, 0), (0, 4 - weights[:, start : start + 4].shape[1]))
        streams[f"in_joints_{number}"] = np.pad(joints[:, start : start + 4], room).astype(np.float32)
        streams[f"in_weights_{number}"] = np.pad(weights[:, start : start + 4], room).astype(np.float32)
    return streams


def _deltas_texture(morphs: Morphs) -> np.ndarray:
    """Return (h, 4096, 4) float32: for target k and vertex v, texel 2 (k V + v) is the position and the next the
    normal."""
    count, vertices = morphs.positions.shape[:2]
    texels = np.zeros((count, vertices, 2, 4), np.float32)
    texels[:, :, 0, :3] = morphs.positions
    if morphs.normals is not None:
        texels[:, :, 1, :3] = morphs.normals
    flat = texels.reshape(-1, 4)
    # The quotient, rounded up.
    height = -(-len(flat) // _TEXTURE_WIDTH)
    return np.pad(flat, ((0, height * _TEXTURE_WIDTH - len(flat)), (0, 0))).reshape(height, _TEXTURE_WIDTH, 4)
