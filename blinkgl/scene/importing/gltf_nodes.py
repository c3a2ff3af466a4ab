"""The node hierarchy of a glTF 2.0 file: which nodes its default scene has, and where they are at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.errors import AssetError
from blinkgl.scene.importing.gltf_file import index_of

MAX_NODES, _MAX_DEPTH = 200_000, 256


@dataclass(frozen=True, eq=False)
class Node:
    """name, parent (None at the root), mesh, camera and skin index (None without), rest translation, quaternion
    x y z w, scale or matrix; weights of the mesh's morph targets where the node says its own."""

    name: str
    parent: int | None
    mesh: int | None
    camera: int | None
    translation: tuple
    rotation: tuple
    scale: tuple
    matrix: np.ndarray | None
    skin: int | None = None
    weights: tuple | None = None

    def local(self) -> np.ndarray:
        """(4, 4) transform to the parent, at rest."""
        if self.matrix is not None:
            return self.matrix
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(self.rotation).as_matrix() * self.scale
        T[:3, 3] = self.translation
        return T


def nodes_of(tree: dict, where: str) -> dict[int, Node]:
    """Nodes of the default scene (of the file, when it has none), parents first."""
    raw, scenes = tree.get("nodes", []), tree.get("scenes", [])
    if len(raw) > MAX_NODES:
        raise AssetError("the file has too many nodes", where=where, value=len(raw), accepted=f"at most {MAX_NODES}")
    if scenes:
        roots = scenes[index_of(tree.get("scene", 0), len(scenes), "scene", where)].get("nodes", [])
    else:
        children = {c for n in raw for c in n.get("children", [])}
        roots = [i for i in range(len(raw)) if i not in children]
    nodes: dict[int, Node] = {}
    stack = [(r, None, 0) for r in reversed(roots)]
    while stack:
        i, parent, depth = stack.pop()
        if i in nodes or depth > _MAX_DEPTH:
            raise AssetError(
                "the nodes are no tree" if i in nodes else f"the nodes are nested more than {_MAX_DEPTH} deep",
                where=where,
                value=i,
            )
        n = raw[index_of(i, len(raw), "node", where)]
        matrix = np.array(n["matrix"], float).reshape(4, 4).T if n.get("matrix") else None
        rest = [
            tuple(map(float, n.get(k, d)))
            for k, d in (("translation", (0, 0, 0)), ("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)))
        ]
        own = tuple(n["weights"]) if "weights" in n else None
        name = str(n.get("name") or f"node-{i}")
        nodes[i] = Node(name, parent, n.get("mesh"), n.get("camera"), *rest, matrix, n.get("skin"), own)
        stack += [(c, i, depth + 1) for c in reversed(n.get("children", []))]
    return nodes
