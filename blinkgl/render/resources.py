"""What a scene occupies in OpenGL: buffers, textures and vertex arrays, each made when first needed, shared by
content, and released together."""

from __future__ import annotations

import ctypes
import itertools
from dataclasses import dataclass
from typing import NamedTuple

import moderngl
import numpy as np

from blinkgl.errors import AssetError
from blinkgl.gl import GLContext
from blinkgl.render.colour import LUMA, linear_image, luminance_image
from blinkgl.scene.types import Material, Mesh, Scene

_TEXTURE_2D, _TEXTURE_LOD_BIAS = 0x0DE1, 0x8501
_ATTRIBUTES = (("in_position", "3f", 12), ("in_normal", "3f", 12), ("in_uv", "2f", 8))


class Kind(NamedTuple):
    """What of a material makes another program."""

    textured: bool
    lit: bool
    two_sided: bool

    @property
    def defines(self) -> dict[str, int]:
        return {name: 1 for name, on in zip(("TEXTURED", "LIT", "TWO_SIDED"), self) if on}


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(8, 3) of the box between two of its corners, (3,) each."""
    return np.array(list(itertools.product(*zip(low, high))))


@dataclass(eq=False)
class DrawItem:
    """One part of one object, ready to draw.

    object_index : row of a moment's matrices.   part : number of the part among those of the scene, object by object.
    number : of this item among all, in the order of the layers.   moves : whether the object does.
    centre, radius; low, high : bounding sphere and box, object frame.   corners : (8, 3) of the box.
    layer : 0 objects, 1 ground and walls, 2 sky; drawn in this order so that depth rejects hidden fragments early.
    two_sided : no culling, and the normal is turned towards the camera.
    """

    object_index: int
    mesh: Mesh
    material: Material
    centre: np.ndarray
    radius: float
    low: np.ndarray
    high: np.ndarray
    layer: int
    two_sided: bool
    lit: bool
    moves: bool
    part: int = -1
    number: int = -1

    def __post_init__(self) -> None:
        self.textured = self.material.texture is not None
        self.kind = Kind(self.textured, self.lit, self.two_sided)
        self.corners = box_corners(self.low, self.high)


MAX_RADIUS = 1e18
"""Times the largest focal length, 1e9 px, still far below float32's 3e38."""
MAX_RADIANCE = 1e18
"""Of a texel: times the largest colour and the largest light of a configuration, 1e9 each,
it is still finite in float32."""
_LAYER = {"object": 0, "ground": 1, "wall": 1, "sky": 2}


class SceneResources:
    """GL side of one Scene. Release it before the context."""

    def __init__(self, gl: GLContext, scene: Scene, anisotropy: float = 1.0, mip_bias: float = 0.0):
        self.ctx, self.scene, self.anisotropy, self.mip_bias = gl.ctx, scene, anisotropy, mip_bias
        self._parameter = gl.function("glTexParameterf", None, ctypes.c_uint, ctypes.c_uint, ctypes.c_float)
        self._buffers: dict[tuple, tuple[moderngl.Buffer, moderngl.Buffer]] = {}
        self._textures: dict[tuple, moderngl.Texture] = {}
        self._vaos: dict[tuple, moderngl.VertexArray] = {}
        self.items = [
            _draw_item(index, part.mesh, part.material, obj.category, not obj.path.is_static)
            for index, obj in enumerate(scene.objects)
            for part in obj.parts
        ]
        for part, item in enumerate(self.items):
            item.part = part
        self.items.sort(key=lambda item: item.layer)
        for number, item in enumerate(self.items):
            item.number = number

    @property
    def triangles(self) -> int:
        return sum(len(item.mesh.faces) for item in self.items)

    def vertex_array(self, program: moderngl.Program, item: DrawItem) -> moderngl.VertexArray:
        """VAO of the attributes ``program`` uses; the rest of the interleaved vertex is skipped."""
        key = (id(program), id(item.mesh), item.material.uv_scale)
        if key not in self._vaos:
            vertices, indices = self._mesh_buffers(item.mesh, item.material.uv_scale)
            formats, names = [], []
            for name, fmt, size in _ATTRIBUTES:
                used = name in program
                formats.append(fmt if used else f"{size}x")
                if used:
                    names.append(name)
            self._vaos[key] = self.ctx.vertex_array(program, [(vertices, " ".join(formats), *names)], indices, 4)
        return self._vaos[key]

    def luminance_texture(self, material: Material) -> moderngl.Texture:
        """R32F: luminance of texture * base_color (mip-mapped in linear light)."""
        key = ("luminance", id(material.texture), material.base_color)
        if key not in self._textures:
            image = luminance_image(material.texture.image, material.base_color)
            self._textures[key] = self._upload(image[..., None], material.texture.name)
        return self._textures[key]

    def colour_texture(self, material: Material) -> moderngl.Texture:
        """Linear rgb of the texture alone: sRGB8 when the image is 8-bit, else RGB32F."""
        key = ("colour", id(material.texture))
        if key not in self._textures:
            image = material.texture.image
            srgb8 = image.dtype == np.uint8
            self._textures[key] = self._upload(
                image if srgb8 else linear_image(image),
                material.texture.name,
                internal_format=0x8C41 if srgb8 else None,
            )  # GL_SRGB8
        return self._textures[key]

    def albedo_luminance(self, material: Material) -> float:
        """Of a material without texture."""
        return float(LUMA @ np.asarray(material.base_color, np.float64))

    def forget_vertex_arrays(self) -> None:
        """To be called before the programs they were made for are replaced."""
        for vao in self._vaos.values():
            vao.release()
        self._vaos = {}

    def release(self) -> None:
        self.forget_vertex_arrays()
        for pair in self._buffers.values():
            for buffer in pair:
                buffer.release()
        for texture in self._textures.values():
            texture.release()
        self._buffers, self._textures = {}, {}

    def _mesh_buffers(self, mesh: Mesh, uv_scale: tuple[float, float]) -> tuple[moderngl.Buffer, moderngl.Buffer]:
        key = (id(mesh), uv_scale)
        if key not in self._buffers:
            data = np.empty((len(mesh.vertices), 8), np.float32)
            data[:, :3], data[:, 3:6] = mesh.vertices, mesh.normals
            data[:, 6:] = _near_zero(mesh.uvs * np.asarray(uv_scale, np.float64))
            if not np.isfinite(data).all():
                first = int(np.flatnonzero(~np.isfinite(data).all(axis=1))[0])
                raise AssetError(
                    f"vertex {first} has a position, normal or texture coordinate (x, y, z; n; u, v) beyond float32",
                    where=mesh.name or "mesh",
                    value=data[first].tolist(),
                    accepted="finite numbers",
                )
            self._buffers[key] = (
                self.ctx.buffer(data.tobytes()),
                self.ctx.buffer(np.ascontiguousarray(mesh.faces, np.int32).tobytes()),
            )
        return self._buffers[key]

    def _upload(self, image: np.ndarray, name: str, internal_format: int | None = None) -> moderngl.Texture:
        height, width, components = image.shape
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        if max(height, width) > limit:
            raise AssetError(
                "texture is larger than this OpenGL takes",
                where=name,
                value=(width, height),
                accepted=f"at most {limit} px on a side",
            )
        if image.dtype != np.uint8 and not (image.min() >= 0 and image.max() <= MAX_RADIANCE):  # NaN too
            y, x, _ = np.argwhere(~((image >= 0) & (image <= MAX_RADIANCE)))[0].tolist()
            raise AssetError(
                f"texel x={x}, y={y} cannot be drawn",
                where=name or "texture",
                value=image[y, x].tolist(),
                accepted=f"linear light from 0 to {MAX_RADIANCE:g}",
            )
        dtype = "f1" if image.dtype == np.uint8 else "f4"
        texture = self.ctx.texture(
            (width, height),
            components,
            np.ascontiguousarray(image).tobytes(),
            alignment=1,
            dtype=dtype,
            internal_format=internal_format,
        )
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        texture.anisotropy = self.anisotropy
        if self.mip_bias:
            texture.use(0)
            self._parameter(_TEXTURE_2D, _TEXTURE_LOD_BIAS, self.mip_bias)
        return texture


def _near_zero(uvs: np.ndarray) -> np.ndarray:
    """(V, 2) float64 texture coordinates less whole repeats, so that a mesh with thousands of them has zero in its
    middle. float32 at 50 000 repeats resolves 0.004 of a repeat: the texture of a wide ground would move in steps."""
    low, high = uvs.min(axis=0), uvs.max(axis=0)
    return uvs - np.rint((low + high) / 2) if max(-low.min(), high.max()) > 64 else uvs


def _draw_item(index: int, mesh: Mesh, material: Material, category: str, moves: bool) -> DrawItem:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre = (low + high) / 2
    radius = float(np.sqrt(((mesh.vertices - centre) ** 2).sum(axis=1).max()))
    if not radius <= MAX_RADIUS:  # NaN too
        raise AssetError(
            "mesh is too large to be drawn in float32",
            where=mesh.name or f"object {index}",
            value=radius,
            accepted=f"at most {MAX_RADIUS:g} units from its centre, all coordinates finite",
        )
    two_sided = material.double_sided or not mesh.closed
    return DrawItem(
        index, mesh, material, centre, radius, low, high, _LAYER[category], two_sided, not material.unlit, moves
    )
