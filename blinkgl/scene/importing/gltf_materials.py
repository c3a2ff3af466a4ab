"""Materials and textures of a glTF 2.0 file.

Reference: Khronos glTF 2.0 specification, section 3.9; extensions KHR_materials_unlit,
KHR_materials_emissive_strength, KHR_texture_transform.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple
from urllib.parse import unquote

import numpy as np

from blinkgl.scene.importing.gltf_file import embedded, index_of, item
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.importing.parts import INVISIBLE
from blinkgl.scene.reading import RECENT, contents
from blinkgl.scene.surfaces.images import content_hash, decode_alpha, decode_image, decode_numbers
from blinkgl.scene.types import REPEAT, Gloss, Map, Mask, Material, Texture, Wrap

DRAWN = {
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_materials_variants",
    "EXT_texture_webp",
}
# Extensions without visible effect.
INVISIBLE_EXTENSIONS = {"KHR_xmp_json_ld", "KHR_xmp"}
# OpenGL's codes: GL_CLAMP_TO_EDGE, GL_MIRRORED_REPEAT, and below GL_NEAREST.
_WRAPS: dict[int, Wrap] = {33071: "clamp", 33648: "mirror"}
_NEAREST = 9728


class _Place(NamedTuple):
    """Texture coordinates of a texture: index of the set, (3, 3) transform or None."""

    coordinates: int
    matrix: np.ndarray | None

    @classmethod
    def of(cls, info: dict) -> _Place:
        transform = info.get("extensions", {}).get("KHR_texture_transform") or {}
        return cls(transform.get("texCoord", info.get("texCoord", 0)), _texture_transform(transform))


class Materials:
    """The materials of one file, each made once. wanted : False leaves out all but the base colour, and does not report
    undrawn features."""

    def __init__(self, tree: dict, buffers: list[bytes], near: Neighbours, max_texture: int, wanted: bool):
        self.tree, self.buffers, self.near, self.max_texture = tree, buffers, near, max_texture
        self.wanted, self.omissions, self.where = wanted, near.omissions, str(near.path)
        self._materials: dict = {}
        self._textures: dict = {}

    def material(self, index: int | None) -> tuple[Material | None, int, np.ndarray | None]:
        """Return (material, texture coordinate set, 3x3 texture transform or None)."""
        if index is None:
            return None, 0, None
        if index not in self._materials:
            m = item(self.tree, "materials", index, self.where)
            pbr = m.get("pbrMetallicRoughness", {})
            info = pbr.get("baseColorTexture") or {}
            base = _Place.of(info)
            red, green, blue = pbr.get("baseColorFactor", (1, 1, 1, 1))[:3]
            material = Material(
                texture=self._texture(info["index"]) if info and self.wanted else None,
                base_color=(float(red), float(green), float(blue)),
                unlit="KHR_materials_unlit" in m.get("extensions", {}),
                both_sides=m.get("doubleSided", False),
            )
            if self.wanted:
                material, base = self._surface(material, m, pbr, base)
            self._materials[index] = (material, base.coordinates, base.matrix)
        return self._materials[index]

    def mode(self, index: int | None) -> str:
        """Return what a material does with opacity: OPAQUE, MASK or BLEND."""
        return "OPAQUE" if index is None else item(self.tree, "materials", index, self.where).get("alphaMode", "OPAQUE")

    def _surface(self, material: Material, m: dict, pbr: dict, base: _Place) -> tuple[Material, _Place]:
        """Return ``material`` with everything besides its base colour, and its texture coordinates: those of the first
        of its textures."""
        for name in m.get("extensions", {}):
            if name not in DRAWN | INVISIBLE_EXTENSIONS:
                self.omissions.add(name)
        info = pbr.get("baseColorTexture") or {}
        if info and material.texture is not None:
            material = replace(material, wrap=self._wraps(info["index"]))
        material = self._masked(material, m, pbr)
        if material is INVISIBLE or material.unlit:
            return material, base
        if "occlusionTexture" in m:
            self.omissions.add("occlusion maps")
        emissive, bumps = m.get("emissiveTexture"), m.get("normalTexture")
        rough = pbr.get("metallicRoughnessTexture")
        # Without a base colour texture, the next map defines the mesh's coordinates.
        if not info:
            base = _Place.of(next((one for one in (rough, bumps, emissive) if one), {}))
        strength = m.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        red, green, blue = (float(c * strength) for c in m.get("emissiveFactor", (0, 0, 0)))
        if red or green or blue:
            material = replace(material, emission=(red, green, blue), emission_map=self._map(emissive, base, "colour"))
        # The standard's defaults are a rough metal: metallic is 1 unless given.
        metallic, roughness = (min(float(pbr.get(f"{key}Factor", 1)), 1.0) for key in ("metallic", "roughness"))
        if metallic > 0 or roughness < 1 or rough:
            material = replace(material, gloss=Gloss(metallic, roughness, self._map(rough, base, "numbers")))
        if bumps and (bumped := self._map(bumps, base, "numbers")) is not None:
            material = replace(material, bumps=bumped, bump_scale=float(bumps.get("scale", 1.0)))
        return material, base

    def _masked(self, material: Material, m: dict, pbr: dict) -> Material:
        """Return the material with its holes. A fully opaque one is not masked; a fully transparent one is
        INVISIBLE."""
        mode, factor = m.get("alphaMode", "OPAQUE"), float(pbr.get("baseColorFactor", (1, 1, 1, 1))[3])
        if mode == "OPAQUE":
            return material
        info = pbr.get("baseColorTexture") or {}
        alpha = self._texture(info["index"], "alpha") if info else None
        image = np.full((1, 1), 255, np.uint8) if alpha is None else alpha.image
        cutoff = float(m.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.5
        # The least and the greatest opacity anywhere on the surface.
        least, most = (factor * float(v) / 255 for v in (image.min(), image.max()))
        # Half-transparent surfaces are not drawn: partly opaque ones are cut out, fully opaque ones are drawn.
        if mode == "BLEND":
            if most == 0:
                self.omissions.add("a material of opacity 0")
                return INVISIBLE
            if most < cutoff:
                self.omissions.add("alpha BLEND (drawn opaque)")
                return material
            self.omissions.add("alpha BLEND (cut off at a half)" if least < cutoff else "alpha BLEND (drawn opaque)")
        if most < cutoff:
            return INVISIBLE
        return replace(material, mask=Mask(image, factor, cutoff)) if least < cutoff else material

    def _map(self, info: dict | None, base: _Place, kind: str) -> Map | None:
        """Return a texture other than the base colour's. kind : "colour" or "numbers"."""
        if not info:
            return None
        place, texture = _Place.of(info), self._texture(info["index"], kind)
        if texture is None:
            return None
        if place.coordinates != base.coordinates:
            self.omissions.add("maps on a second set of texture coordinates (left out)")
            return None
        own, first = (np.eye(3) if one.matrix is None else one.matrix for one in (place, base))
        # The mesh's coordinates already include the first texture's transform, which is undone here.
        at = own if abs(np.linalg.det(first)) < 1e-12 else own @ np.linalg.inv(first)
        a, b, c, d, e, f = (float(v) for v in np.round(at[:2], 12).ravel())
        return Map(texture, (a, b, c, d, e, f), self._wraps(info["index"]))

    def _wraps(self, index: int) -> tuple[Wrap, Wrap]:
        """Return the wrap modes of a texture."""
        sampler = item(self.tree, "textures", index, self.where).get("sampler")
        if sampler is None:
            return REPEAT
        settings = item(self.tree, "samplers", sampler, self.where)
        if settings.get("magFilter") == _NEAREST:
            self.omissions.add("unfiltered textures (drawn smooth)")
        s, t = (_WRAPS.get(settings.get(key, 10497), "repeat") for key in ("wrapS", "wrapT"))
        return s, t

    def _texture(self, index: int, kind: str = "colour") -> Texture | None:
        """Return a texture. kind : "colour"; "numbers", as they are stored; "alpha", (h, w), None where the image is
        opaque."""
        texture = item(self.tree, "textures", index, self.where)
        # EXT_texture_webp gives an image of its own, before which the texture's is only a fallback.
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            names = ", ".join(texture.get("extensions", {})) or "without an image"
            self.omissions.add(f"textures of another kind ({names})")
            return None
        if (source, kind) not in self._textures:
            image = item(self.tree, "images", source, self.where)
            if "bufferView" in image:
                v = item(self.tree, "bufferViews", image["bufferView"], self.where)
                buffer = self.buffers[index_of(v["buffer"], len(self.buffers), "buffer", self.where)]
                begin = v.get("byteOffset", 0)
                data = buffer[begin : begin + v.get("byteLength", 0)]
            elif (uri := image.get("uri") or "").startswith("data:"):
                data = embedded(uri, "image", self.where)
            else:
                file = self.near.optional((unquote(uri), uri))
                if file is None:
                    self._textures[source, kind] = None
                    return None
                data = contents(file, "image")
            name = str(image.get("name") or f"image-{source}")
            decode = {"colour": partial(decode_image, gamma=False), "numbers": decode_numbers, "alpha": decode_alpha}[
                kind
            ]
            key = content_hash(data), kind, self.max_texture
            decoded = partial(decode, data, self.max_texture, f"{self.where} (image '{name}')")
            pixels = RECENT.get(key, decoded, lambda pixels: 0 if pixels is None else pixels.nbytes)
            self._textures[source, kind] = None if pixels is None else Texture(pixels, name, key[0])
        return self._textures[source, kind]


def _texture_transform(transform: dict | None) -> np.ndarray | None:
    if not transform:
        return None
    (ox, oy), (sx, sy), r = (
        transform.get("offset", (0, 0)),
        transform.get("scale", (1, 1)),
        float(transform.get("rotation", 0)),
    )
    c, s = np.cos(r), np.sin(r)
    # Translation times rotation times scale, in the order that KHR_texture_transform defines.
    return (
        np.array([[1, 0, ox], [0, 1, oy], [0, 0, 1]])
        @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        @ np.diag([sx, sy, 1.0])
    )
