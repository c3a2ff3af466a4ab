"""What a GLB looks like at a time, in float64 and straight from the specification: node tree, skins, morph targets. A
judge of what Blender exported and of what BlinkGL draws, independent of both."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.raw_mesh import Z_UP


class Played:
    """A GLB with one of its animations. Positions are z up, in the scene's units."""

    def __init__(self, path, animation=0):
        self.document = gltf.read(path)
        self.tree = self.document.tree
        listed = self.tree.get("animations", [])
        self.moved = self._channels(listed[animation]) if listed else {}

    def _channels(self, animation):
        found = {}
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times = self.document.accessor(sampler["input"]).astype(float).ravel()
            values = self.document.accessor(sampler["output"]).astype(float)
            kind = sampler.get("interpolation", "LINEAR")
            parts = values.reshape(len(times), 3 if kind == "CUBICSPLINE" else 1, -1)
            found[channel["target"]["node"], channel["target"]["path"]] = times, parts, kind
        return found

    @property
    def duration(self) -> float:
        return max(times[-1] for times, *_ in self.moved.values())

    def value(self, node: int, path: str, t: float):
        if (node, path) not in self.moved:
            return None
        times, parts, kind = self.moved[node, path]
        i = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, max(len(times) - 2, 0)))
        if len(times) == 1 or t <= times[0]:
            return parts[0, parts.shape[1] // 2]
        if t >= times[-1]:
            return parts[-1, parts.shape[1] // 2]
        h = times[i + 1] - times[i]
        u = (t - times[i]) / h
        if kind == "STEP":
            return parts[i, 0]
        if kind == "CUBICSPLINE":
            (_, a, out), (into, b, _) = parts[i], parts[i + 1]
            q = (2 * u**3 - 3 * u**2 + 1) * a + h * (u**3 - 2 * u**2 + u) * out
            q = q + (3 * u**2 - 2 * u**3) * b + h * (u**3 - u**2) * into
            return q / np.linalg.norm(q) if path == "rotation" else q
        a, b = parts[i, 0], parts[i + 1, 0]
        return slerp(a, b, u) if path == "rotation" else (1 - u) * a + u * b

    def world(self, node: int, t: float) -> np.ndarray:
        """(4, 4) of a node, y up."""
        T, step = np.eye(4), node
        while step is not None:
            T = self.local(step, t) @ T
            step = self.document.nodes[step].parent
        return T

    def local(self, node: int, t: float) -> np.ndarray:
        raw, T = self.tree["nodes"][node], np.eye(4)
        if "matrix" in raw:
            return np.array(raw["matrix"], float).reshape(4, 4).T
        place, turn, size = (
            raw.get(path, rest) if (found := self.value(node, path, t)) is None else found
            for path, rest in (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))
        )
        T[:3, :3] = Rotation.from_quat(turn).as_matrix() * size
        T[:3, 3] = place
        return T

    def node(self, name: str) -> int:
        return next(i for i, n in self.document.nodes.items() if n.name == name)

    def camera(self, name: str, t: float) -> np.ndarray:
        """(4, 4) of a camera in Blender's world: it looks along its -z."""
        return Z_UP @ self.world(self.node(name), t)

    def positions(self, name: str, t: float) -> np.ndarray:
        """(V, 3) of all primitives of a node, one after the other, in Blender's world."""
        return self.of(self.node(name), t)

    def of(self, index: int, t: float) -> np.ndarray:
        """The same of a node by its index."""
        raw = self.tree["nodes"][index]
        mesh = self.tree["meshes"][raw["mesh"]]
        found = []
        for primitive in mesh["primitives"]:
            p = self.document.accessor(primitive["attributes"]["POSITION"]).astype(float)
            weights = self.value(index, "weights", t)
            weights = raw.get("weights", mesh.get("weights", [])) if weights is None else weights
            for weight, target in zip(weights, primitive.get("targets", [])):
                p = p + weight * self.document.accessor(target["POSITION"])
            if "skin" not in raw:
                T = self.world(index, t)
                found.append(p @ T[:3, :3].T + T[:3, 3])
                continue
            found.append(self._skinned(p, primitive["attributes"], self.tree["skins"][raw["skin"]], t))
        turn = Z_UP[:3, :3]
        return np.concatenate(found) @ turn.T

    def _skinned(self, p, attributes, skin, t):
        inverse = self.document.accessor(skin["inverseBindMatrices"]).astype(float).reshape(-1, 4, 4)
        joints = np.stack([self.world(j, t) @ M.T for j, M in zip(skin["joints"], inverse)])
        sets = range(sum(key.startswith("JOINTS_") for key in attributes))
        chosen = np.concatenate([self.document.accessor(attributes[f"JOINTS_{k}"]) for k in sets], axis=1)
        weights = np.concatenate([self.document.accessor(attributes[f"WEIGHTS_{k}"]) for k in sets], axis=1).astype(
            float
        )
        weights /= weights.sum(axis=1, keepdims=True)
        homogeneous = np.concatenate([p, np.ones((len(p), 1))], axis=1)
        return np.einsum("vk,vkij,vj->vi", weights, joints[chosen.astype(int)], homogeneous)[:, :3]


def slerp(a, b, u):
    """The shortest way between two unit quaternions."""
    b = b if a @ b >= 0 else -b
    angle = np.arccos(np.clip(a @ b, -1, 1))
    q = a + u * (b - a) if angle < 1e-9 else (np.sin((1 - u) * angle) * a + np.sin(u * angle) * b) / np.sin(angle)
    return q / np.linalg.norm(q)
