"""What a glTF file shows, by its standard alone: a reader of its JSON and a caster of rays, for small files.

It shares no code with the product. Reference: Khronos glTF 2.0 specification, 3.5 to 3.11 and appendix C."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image

TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass
class Surface:
    """Triangles (F, 3) over P (V, 3) and N (V, 3) in the z-up world; the primitive's own data."""

    P: np.ndarray
    N: np.ndarray
    F: np.ndarray
    uv: np.ndarray | None
    tint: np.ndarray
    material: dict


class Oracle:
    def __init__(self, tree: dict, data: bytes, clip: int | None = None):
        self.tree, self.data, self.clip = tree, data, clip
        self.nodes = tree["nodes"]
        self.parent = {c: i for i, n in enumerate(self.nodes) for c in n.get("children", [])}

    def view(self, number: int, offset: int, count: int, width: int, kind: str) -> np.ndarray:
        v = self.tree["bufferViews"][number]
        step = np.dtype(kind).itemsize
        strides = v.get("byteStride", width * step), step
        return np.ndarray((count, width), kind, self.data, v.get("byteOffset", 0) + offset, strides).copy()

    def read(self, number: int) -> np.ndarray:
        a = self.tree["accessors"][number]
        width, kind = WIDTHS[a["type"]], TYPES[a["componentType"]]
        out = np.zeros((a["count"], width), kind)
        if "bufferView" in a:
            out = self.view(a["bufferView"], a.get("byteOffset", 0), a["count"], width, kind)
        if "sparse" in a:
            at, new = a["sparse"]["indices"], a["sparse"]["values"]
            places = self.view(at["bufferView"], 0, a["sparse"]["count"], 1, TYPES[at["componentType"]])
            out[places.ravel()] = self.view(new["bufferView"], 0, a["sparse"]["count"], width, kind)
        if a.get("normalized"):
            return np.maximum(out / np.iinfo(out.dtype).max, -1.0)
        return out.astype(float)

    def animated(self, t: float) -> dict:
        found = {}
        animation = {"channels": []} if self.clip is None else self.tree["animations"][self.clip]
        for channel in animation["channels"]:
            sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
            times, kind = self.read(sampler["input"]).ravel(), sampler.get("interpolation", "LINEAR")
            keys = self.read(sampler["output"]).reshape(len(times), 3 if kind == "CUBICSPLINE" else 1, -1)
            value = keys[:, 1 if kind == "CUBICSPLINE" else 0]
            i = int(np.searchsorted(times, t, side="right")) - 1
            if i < 0 or i >= len(times) - 1 or kind == "STEP":
                now = value[min(max(i, 0), len(times) - 1)]
            else:
                h, s = times[i + 1] - times[i], (t - times[i]) / (times[i + 1] - times[i])
                if kind == "CUBICSPLINE":
                    a, b = h * keys[i, 2], h * keys[i + 1, 0]
                    now = (2 * s**3 - 3 * s**2 + 1) * value[i] + (s**3 - 2 * s**2 + s) * a
                    now = now + (3 * s**2 - 2 * s**3) * value[i + 1] + (s**3 - s**2) * b
                elif target["path"] == "rotation":
                    p, q = value[i], value[i + 1] * (1 if value[i] @ value[i + 1] >= 0 else -1)
                    angle = np.arccos(min(p @ q, 1.0))
                    now = p if angle < 1e-8 else (np.sin((1 - s) * angle) * p + np.sin(s * angle) * q) / np.sin(angle)
                else:
                    now = (1 - s) * value[i] + s * value[i + 1]
            found[target["node"], target["path"]] = now
        return found

    def world(self, i: int, now: dict) -> np.ndarray:
        n = self.nodes[i]
        if "matrix" in n:
            T = np.array(n["matrix"], float).reshape(4, 4).T
        else:
            get = lambda key, default: np.asarray(now.get((i, key), n.get(key, default)), float)
            x, y, z, w = (q := get("rotation", (0, 0, 0, 1))) / np.linalg.norm(q)
            K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            T = np.eye(4)
            T[:3, :3] = (np.eye(3) + 2 * w * K + 2 * K @ K) * get("scale", (1, 1, 1))
            T[:3, 3] = get("translation", (0, 0, 0))
        return self.world(self.parent[i], now) @ T if i in self.parent else T

    def visible(self, i: int) -> bool:
        own = self.nodes[i].get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True)
        return own and (i not in self.parent or self.visible(self.parent[i]))

    def surfaces(self, t: float) -> list[Surface]:
        now, out = self.animated(t), []
        stack = list(self.tree["scenes"][self.tree.get("scene", 0)]["nodes"])
        while stack:
            i = stack.pop(0)
            stack += self.nodes[i].get("children", [])
            if "mesh" in self.nodes[i] and self.visible(i):
                primitives = self.tree["meshes"][self.nodes[i]["mesh"]]["primitives"]
                out += [self.surface(i, p, now) for p in primitives if p.get("mode", 4) > 3]
        return out

    def surface(self, i: int, primitive: dict, now: dict) -> Surface:
        node, given = self.nodes[i], primitive["attributes"]
        P = self.read(given["POSITION"])
        order = self.read(primitive["indices"]).ravel().astype(int) if "indices" in primitive else np.arange(len(P))
        mode, n = primitive.get("mode", 4), len(order) - 2
        F = order.reshape(-1, 3) if mode == 4 else np.zeros((n, 3), int)
        for k in range(n if mode > 4 else 0):
            F[k] = order[[k, k + 1 + k % 2, k + 2 - k % 2]] if mode == 5 else order[[0, k + 1, k + 2]]
        uv = f"TEXCOORD_{primitive.get('_set', 0)}"
        uv = self.read(given[uv]) if uv in given else None
        tint = self.read(given["COLOR_0"])[:, :3] if "COLOR_0" in given else np.ones((len(P), 3))
        N = self.read(given["NORMAL"]) if "NORMAL" in given else None
        if N is None:  # flat: every triangle has corners of its own
            P, uv, tint = P[F.ravel()], None if uv is None else uv[F.ravel()], tint[F.ravel()]
            N = np.repeat(np.cross(P[1::3] - P[::3], P[2::3] - P[::3]), 3, axis=0)
            F = np.arange(len(P)).reshape(-1, 3)
        mesh = self.tree["meshes"][node["mesh"]]
        weights = now.get((i, "weights"), node.get("weights", mesh.get("weights", [])))
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            P = P + weight * self.read(target["POSITION"])
            N = N + weight * self.read(target["NORMAL"]) if "NORMAL" in target else N
        M = np.tile(self.world(i, now), (len(P), 1, 1))
        if "skin" in node:
            skin, M = self.tree["skins"][node["skin"]], np.zeros((len(P), 4, 4))
            bind = self.read(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
            J = np.array([self.world(j, now) @ b for j, b in zip(skin["joints"], bind, strict=True)])
            for k in range(2):
                if f"JOINTS_{k}" in given:
                    joints, w = self.read(given[f"JOINTS_{k}"]).astype(int), self.read(given[f"WEIGHTS_{k}"])
                    M += np.einsum("vk,vkij->vij", w, J[joints])
        det = np.linalg.det(M[:, :3, :3])
        P = np.einsum("vij,vj->vi", M[:, :3, :3], P) + M[:, :3, 3]
        cofactors = np.stack([np.cross(M[:, (k + 1) % 3, :3], M[:, (k + 2) % 3, :3]) for k in range(3)], axis=1)
        N = np.einsum("vij,vj->vi", cofactors, N) * np.where(det < 0, -1, 1)[:, None]
        N = N / np.maximum(np.linalg.norm(N, axis=1, keepdims=True), 1e-300)
        F = np.where((det[F] < 0).all(axis=1)[:, None], F[:, ::-1], F)
        material = self.tree["materials"][primitive["material"]] if "material" in primitive else {}
        return Surface(P @ Z_UP.T, N @ Z_UP.T, F, uv, tint, material)

    def image(self, texture: dict) -> np.ndarray:
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture)["source"]
        v = self.tree["bufferViews"][self.tree["images"][source]["bufferView"]]
        begin = v["byteOffset"]
        picture = Image.open(io.BytesIO(self.data[begin : begin + v["byteLength"]])).convert("RGBA")
        return np.asarray(picture, float) / 255

    def shade(self, s: Surface, face: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ((N, 3) linear base colour, (N,) opacity): nearest texels."""
        pbr = s.material.get("pbrMetallicRoughness", {})
        factor = np.array(pbr.get("baseColorFactor", (1, 1, 1, 1)), float)
        colour = factor[:3] * np.einsum("nk,nkc->nc", bary, s.tint[s.F[face]])
        opacity = np.full(len(face), factor[3])
        info = pbr.get("baseColorTexture")
        if info and s.uv is not None:
            texture = self.tree["textures"][info["index"]]
            sampler = self.tree["samplers"][texture["sampler"]] if "sampler" in texture else {}
            place = info.get("extensions", {}).get("KHR_texture_transform", {})
            uv = np.einsum("nk,nkc->nc", bary, s.uv[s.F[face]]) * place.get("scale", (1, 1))
            c, d = np.cos(place.get("rotation", 0)), np.sin(place.get("rotation", 0))
            uv = np.column_stack([c * uv[:, 0] + d * uv[:, 1], c * uv[:, 1] - d * uv[:, 0]])
            uv, image = uv + place.get("offset", (0, 0)), self.image(texture)
            at = []
            for k, (size, key) in enumerate(((image.shape[1], "wrapS"), (image.shape[0], "wrapT"))):
                mode, n = sampler.get(key, 10497), np.floor(uv[:, k] * size).astype(int)
                mirrored = np.minimum(n % (2 * size), 2 * size - 1 - n % (2 * size))
                at.append(n.clip(0, size - 1) if mode == 33071 else mirrored if mode == 33648 else n % size)
            texel = image[at[1], at[0]]
            code = texel[:, :3]
            colour = colour * np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
            opacity = opacity * texel[:, 3]
        return colour, opacity


@dataclass
class Seen:
    """Of N rays: depth (inf: nothing hit), normal on the camera's side and colour; surface, face and weights."""

    depth: np.ndarray
    normal: np.ndarray
    colour: np.ndarray
    surface: np.ndarray
    face: np.ndarray
    bary: np.ndarray


def cast(oracle: Oracle, surfaces: list[Surface], T: np.ndarray, rays: np.ndarray, near: float, culls: bool) -> Seen:
    """rays : (N, 3) world axes, of length 1 along the optical axis.   culls : single-sided surfaces are seen from
    their front alone."""
    n, o = len(rays), T[:3, 3]
    seen = Seen(
        np.full(n, np.inf), np.zeros((n, 3)), np.zeros((n, 3)), np.full(n, -1), np.full(n, -1), np.zeros((n, 3))
    )
    for number, s in enumerate(surfaces):
        a, b, c = (s.P[s.F[:, k]] for k in range(3))
        for face, (e1, e2, p) in enumerate(zip(b - a, c - a, a, strict=True)):
            h = np.cross(rays, e2)
            det = h @ e1
            with np.errstate(all="ignore"):
                u, q = (h @ (o - p)) / det, np.cross(o - p, e1)
                v, z = (rays @ q) / det, (q @ e2) / det
            hit = (np.abs(det) > 1e-14) & (u >= 0) & (v >= 0) & (u + v <= 1) & (z > near) & (z < seen.depth)
            front = det > 0
            if culls and not s.material.get("doubleSided", False):
                hit &= front
            at = np.flatnonzero(hit)
            bary = np.column_stack([1 - u - v, u, v])[at]
            colour, opacity = oracle.shade(s, np.full(len(at), face), bary)
            if s.material.get("alphaMode") == "MASK":
                keep = opacity >= s.material.get("alphaCutoff", 0.5)
                at, bary, colour = at[keep], bary[keep], colour[keep]
            normal = np.einsum("nk,nkc->nc", bary, np.tile(s.N[s.F[face]], (len(at), 1, 1)))
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
            seen.depth[at], seen.colour[at], seen.bary[at] = z[at], colour, bary
            seen.normal[at] = normal * np.where(front[at], 1, -1)[:, None]
            seen.surface[at], seen.face[at] = number, face
    return seen
