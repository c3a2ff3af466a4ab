"""OpenGL resources of a scene: buffers, textures and vertex arrays, each made when first needed, shared by content, and
released together."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cached_property
from typing import TypeVar, cast

import moderngl
import numpy as np

from blinkgl.errors import AssetError
from blinkgl.gl import GLContext
from blinkgl.gl.shader import MADE, unused
from blinkgl.render.colour import LUMA, linear_image, luminance_image
from blinkgl.render.draw_items import DrawItem, draw_items, padded_rows
from blinkgl.scene.geometry.tangents import tangents
from blinkgl.scene.lights import surroundings_of
from blinkgl.scene.shapes.table import includes
from blinkgl.scene.surfaces.gloss import energy, looks, mean_energy
from blinkgl.scene.types import IDENTITY, REPEAT, Deformer, Map, Material, Mesh, Scene, Texture, Wrap
from blinkgl.types.recent import Kept

MADE.append(includes)

# OpenGL's enums: GL_TEXTURE_2D, GL_TEXTURE_LOD_BIAS; GL_TEXTURE_WRAP_S and _T; their values.
_TEXTURE_2D, _TEXTURE_LOD_BIAS = 0x0DE1, 0x8501
_TEXTURE_WRAP = 0x2802, 0x2803
_WRAPS = {"repeat": 0x2901, "mirror": 0x8370, "clamp": 0x812F}
# The interleaved vertex: name, format, bytes; 32 bytes in all.
_ATTRIBUTES = (("in_position", "3f", 12), ("in_normal", "3f", 12), ("in_uv", "2f", 8))


MAX_RADIANCE = 1e18
"""Largest radiance of a texel: times the largest colour and light of a configuration, 1e9 each, it is finite in
float32."""


class Shape:
    """GL resources of one deformer: its parameters at one time and those of other times, as the block ``Shape`` of
    deform.glsl."""

    SETS = ("now", "rate", "forward", "backward")
    BINDING = 0

    def __init__(self, ctx: moderngl.Context, deformer: Deformer):
        # std140: a row of four floats is 16 bytes.
        self.ctx, self.deformer, self._rows = ctx, deformer, padded_rows(deformer)
        size = 16 * self._rows * len(self.SETS)
        limit = ctx.info["GL_MAX_UNIFORM_BLOCK_SIZE"]
        if size > limit:
            raise AssetError(
                "a shape needs more parameters than this OpenGL supports",
                where=type(deformer).__name__,
                value=deformer.rows,
                accepted=f"at most {limit // 16 // len(self.SETS)} rows of four",
            )
        self._buffer = ctx.buffer(reserve=size)
        self._held: dict[str, object] = {}
        self._streams = {
            name: (ctx.buffer(np.ascontiguousarray(values, np.float32).tobytes()), np.atleast_2d(values.T).shape[0])
            for name, values in deformer.attributes.items()
        }
        self._textures = {name: self._texture(image) for name, image in deformer.textures.items()}

    def _texture(self, image: np.ndarray) -> moderngl.Texture:
        height, width, _ = image.shape
        texture = self.ctx.texture((width, height), 4, np.ascontiguousarray(image, np.float32).tobytes(), dtype="f4")
        texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        return texture

    def streams(self, program: moderngl.Program) -> list[tuple]:
        """Return vertex streams of those attributes that the program has."""
        return [(buffer, f"{n}f", name) for name, (buffer, n) in self._streams.items() if name in program]

    def put(self, name: str, key: object, rows: Callable[[], np.ndarray]) -> None:
        """Upload the parameters of one of SETS, unless those of the same ``key`` are there."""
        if self._held.get(name) != key:
            data = np.zeros((self._rows, 4), np.float32)
            numbers = rows()
            data[: len(numbers)] = numbers
            self._buffer.write(data.tobytes(), offset=self.SETS.index(name) * data.nbytes)
            self._held[name] = key

    def use(self, program: moderngl.Program, unit: int) -> None:
        """Bind the resources to the program that is drawn next. unit : first free texture unit."""
        if "Shape" not in program:
            raise unused(program, "Shape")
        cast(moderngl.UniformBlock, program["Shape"]).binding = self.BINDING
        self._buffer.bind_to_uniform_block(self.BINDING)
        for offset, (name, texture) in enumerate(self._textures.items()):
            if name in program:
                cast(moderngl.Uniform, program[name]).value = unit + offset
                texture.use(unit + offset)

    def release(self) -> None:
        for owned in (self._buffer, *(buffer for buffer, _ in self._streams.values()), *self._textures.values()):
            owned.release()


HALF_LEAST, HALF_MOST = 2.0**-14, 65504.0
"""Between these limits the error of a half float is at most 1/2048; below, 3e-8."""


Present = TypeVar("Present")


def _of(part: Present | None) -> Present:
    """Return a part of a material that the item drawn has."""
    assert part is not None
    return part


def half_floats(image: np.ndarray) -> np.ndarray:
    """Return (h, w, c) float32 light as float16, where the error of a texel is at most 1/2048 of its brightest channel
    and that of a mip level at most 1/2048 of the mean; else ``image``. float16 saves a tenth of a frame's time.

    For 8-bit images, whose own steps are 9 to 90 times coarser. A smooth float image would get visible steps, also in
    its rates."""
    brightest = image.max(axis=2)
    lit = brightest[brightest > 0]
    # A NaN makes the mean NaN, so the picture stays float32.
    fits = lit.size > 0 and lit.min() >= HALF_LEAST and lit.max() <= HALF_MOST
    return image.astype(np.float16) if fits and brightest.mean(dtype=np.float64) >= HALF_LEAST else image


class SceneResources:
    """GL resources of one Scene. Release them before the context."""

    def __init__(self, gl: GLContext, scene: Scene, anisotropy: float = 1.0, mip_bias: float = 0.0):
        self.ctx, self.scene, self.anisotropy, self.mip_bias = gl.ctx, scene, anisotropy, mip_bias
        self._parameter = gl.function("glTexParameterf", None, ctypes.c_uint, ctypes.c_uint, ctypes.c_float)
        self._buffers: Kept[tuple, tuple[moderngl.Buffer, ...]] = Kept()
        self._textures: Kept[tuple, moderngl.Texture] = Kept()
        self._vaos: Kept[tuple, moderngl.VertexArray] = Kept()
        self._vaos_of_items: Kept[tuple[int, int], moderngl.VertexArray] = Kept()
        self._shapes: Kept[int, Shape] = Kept()
        self._volumes: Kept[str, moderngl.Texture3D] = Kept()
        self.items = draw_items(scene)

    @property
    def triangles(self) -> int:
        return sum(len(item.mesh.faces) for item in self.items)

    def vertex_array(self, program: moderngl.Program, item: DrawItem) -> moderngl.VertexArray:
        """Return the vertex array of the attributes that ``program`` uses; the rest of the interleaved vertex is
        skipped."""
        return self._vaos_of_items.of((id(program), item.number), lambda: self._shared_array(program, item))

    def _shared_array(self, program: moderngl.Program, item: DrawItem) -> moderngl.VertexArray:
        # The texture coordinates of a buffer depend on both, so they are part of its key.
        scale, whole = item.material.uv_scale, _by_whole_repeats(item.material)
        key = (id(program), id(item.mesh), scale, whole)
        buffers = lambda: self._buffers.of((id(item.mesh), scale, whole), lambda: self._mesh(item.mesh, scale, whole))
        return self._vaos.of(key, lambda: self._vertex_array(program, item, *buffers()))

    def _vertex_array(
        self, program: moderngl.Program, item: DrawItem, vertices: moderngl.Buffer, indices: moderngl.Buffer
    ) -> moderngl.VertexArray:
        # OpenGL would draw nothing, or refuse an empty vertex.
        if "in_position" not in program:
            raise unused(program, "in_position")
        # "12x" skips the bytes of an attribute that the program does not use.
        formats = [fmt if name in program else f"{size}x" for name, fmt, size in _ATTRIBUTES]
        streams = [(vertices, " ".join(formats), *(name for name, _, _ in _ATTRIBUTES if name in program))]
        if item.deformer is not None:
            streams += self.shape(item.deformer).streams(program)
        streams += [
            (self._stream(item.mesh, name), f"{n}f", name)
            for name, n in (("in_tangent", 4), ("in_tint", 3))
            if name in program
        ]
        # The last 4 is the size of an index in bytes.
        return self.ctx.vertex_array(program, streams, indices, 4)

    def shape(self, deformer: Deformer) -> Shape:
        """Return the OpenGL resources of a deformer."""
        return self._shapes.of(id(deformer), lambda: Shape(self.ctx, deformer))

    def luminance_texture(self, material: Material) -> moderngl.Texture:
        """Return the luminance of texture * base_color, mip-mapped in linear light: R16F for 8-bit images where
        :func:`half_floats` applies, else R32F."""
        texture = _of(material.texture)
        key = ("luminance", id(texture), material.base_color, material.wrap)
        image = lambda: luminance_image(texture.image, material.base_color)[..., None]
        return self._textures.of(key, lambda: self._light(image(), texture, material.wrap))

    def shares_texture(self, material: Material) -> moderngl.Texture:
        """Return the shares of r, g and b of texture * base_color in its luminance, RGB16F or RGB32F; their sum is
        :meth:`luminance_texture`."""
        texture = _of(material.texture)
        key = ("shares", id(texture), material.base_color, material.wrap)
        # Each channel's share of the luminance, so that r + g + b of the texture is it.
        shares = lambda: (LUMA * np.asarray(material.base_color, np.float64)).astype(np.float32)
        image = lambda: linear_image(texture.image) * shares()
        return self._textures.of(key, lambda: self._light(image(), texture, material.wrap))

    def colour_texture(self, material: Material) -> moderngl.Texture:
        """Return the linear rgb of the texture alone: sRGB8 when the image is 8-bit, else RGB32F."""
        return self._colour(_of(material.texture), material.wrap)

    def _colour(self, texture: Texture, wrap: tuple[Wrap, Wrap]) -> moderngl.Texture:
        image, srgb8 = texture.image, texture.image.dtype == np.uint8
        # 0x8C41: GL_SRGB8.
        make = lambda: self._upload(
            image if srgb8 else linear_image(image), texture.name, 0x8C41 if srgb8 else None, wrap
        )
        return self._textures.of(("colour", id(texture), wrap), make)

    # ---- of materials that are more than a base colour

    def coverage_texture(self, material: Material) -> moderngl.Texture:
        """Return the opacity, R32F, one level."""
        image = lambda: _of(material.mask).alpha.astype(np.float32)[..., None] / np.float32(255)
        make = lambda: self._upload(image(), "mask", wrap=material.wrap, levels=False)
        return self._textures.of(("coverage", id(material.mask), material.wrap), make)

    def numbers_texture(self, map_: Map) -> moderngl.Texture:
        """Return three numbers per pixel as they are stored, RGB32F. Drivers filter 8-bit textures to 8 bits: smooth
        surfaces would then shine in steps, with noisy rates."""
        texture, wrap = map_.texture, map_.wrap
        make = lambda: self._upload(texture.image.astype(np.float32) / np.float32(255), texture.name, wrap=wrap)
        return self._textures.of(("numbers", id(texture), wrap), make)

    def emission_texture(self, material: Material, colour: bool) -> moderngl.Texture:
        """Return the material's own emission, linear rgb, or R16F or R32F as :meth:`luminance_texture`, scaled to a
        luminance of at most 1."""
        texels = _of(material.emission_map)
        if colour:
            return self._colour(texels.texture, texels.wrap)
        shares = lambda: tuple(np.asarray(material.emission, np.float64) / self.emitted_luminance(material))
        image = lambda: luminance_image(texels.texture.image, shares())[..., None]
        key = ("emission", id(texels.texture), material.emission, texels.wrap)
        return self._textures.of(key, lambda: self._light(image(), texels.texture, texels.wrap))

    def emitted_luminance(self, material: Material) -> float:
        return float(LUMA @ np.asarray(material.emission, np.float64))

    def energy_texture(self) -> moderngl.Texture:
        """Return RGBA32F of :func:`~blinkgl.scene.surfaces.gloss.energy`, its mean, and the weight of the first
        look."""
        return self._table("energy", _energy_table)

    def looks_texture(self) -> moderngl.Texture:
        """Return RGBA32F of :func:`~blinkgl.scene.surfaces.gloss.looks`: for both looks, the fraction of the way to the
        mirror direction, and the roughness."""
        return self._table("looks", lambda: looks()[..., :4])

    def _table(self, name: str, numbers: Callable[[], np.ndarray]) -> moderngl.Texture:
        make = lambda: self._upload(numbers().astype(np.float32), name, wrap=("clamp", "clamp"), levels=False)
        return self._textures.of((name,), make)

    def surroundings_texture(self, coloured: bool) -> moderngl.Texture3D:
        """Return RGBA32F, a: 1, of :func:`~blinkgl.scene.surfaces.gloss.blurred`: longitude, latitude, roughness; or
        R32F of its luminance."""
        name = "surroundings" if coloured else "luminance of surroundings"
        return self._volumes.of(name, lambda: self._volume(coloured))

    def _volume(self, coloured: bool) -> moderngl.Texture3D:
        levels = self._surroundings
        if coloured:
            levels = np.concatenate([levels, np.ones_like(levels[..., :1])], axis=3)
        else:
            levels = (levels @ LUMA)[..., None].astype(np.float32)
        depth, height, width, channels = levels.shape
        volume = self.ctx.texture3d((width, height, depth), channels, levels.tobytes(), dtype="f4")
        volume.filter = (moderngl.LINEAR, moderngl.LINEAR)
        # Only the longitude goes round; the poles and the ends of the roughness do not meet.
        volume.repeat_x, volume.repeat_y, volume.repeat_z = True, False, False
        return volume

    @cached_property
    def _surroundings(self) -> np.ndarray:
        return surroundings_of(self.scene.light)

    def _stream(self, mesh: Mesh, name: str) -> moderngl.Buffer:
        """Return the buffer of the vertices' tangents or colours."""
        values = lambda: tangents(mesh) if name == "in_tangent" else mesh.colours
        make = lambda: (self.ctx.buffer(np.ascontiguousarray(values(), np.float32).tobytes()),)
        return self._buffers.of((name, id(mesh)), make)[0]

    def albedo_luminance(self, material: Material) -> float:
        """Return the albedo's luminance of a material without texture."""
        return float(LUMA @ np.asarray(material.base_color, np.float64))

    def forget_vertex_arrays(self) -> None:
        """Drop all vertex arrays, before the programs they were made for are replaced."""
        for vao in self._vaos.values():
            vao.release()
        self._vaos.clear()
        self._vaos_of_items.clear()

    def release(self) -> None:
        self.forget_vertex_arrays()
        buffers = (buffer for several in self._buffers.values() for buffer in several)
        for owned in (*buffers, *self._textures.values(), *self._volumes.values(), *self._shapes.values()):
            owned.release()
        for kept in (self._buffers, self._textures, self._volumes, self._shapes):
            kept.clear()

    def _mesh(self, mesh: Mesh, uv_scale: tuple[float, float], whole: bool) -> tuple[moderngl.Buffer, ...]:
        """Return new buffers of a mesh's vertices and faces."""
        data = np.empty((len(mesh.vertices), 8), np.float32)
        data[:, :3], data[:, 3:6] = mesh.vertices, mesh.normals
        uvs = mesh.uvs * np.asarray(uv_scale, np.float64)
        data[:, 6:] = _near_zero(uvs) if whole else uvs
        # A GPU would draw infinities and NaN anywhere.
        if not np.isfinite(data).all():
            first = int(np.flatnonzero(~np.isfinite(data).all(axis=1))[0])
            raise AssetError(
                f"vertex {first} has a position, normal or texture coordinate (x, y, z; n; u, v) beyond float32",
                where=mesh.name or "mesh",
                value=data[first].tolist(),
                accepted="finite numbers",
            )
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        return self.ctx.buffer(data.tobytes()), self.ctx.buffer(faces.tobytes())

    def _light(self, image: np.ndarray, texture: Texture, wrap: tuple[Wrap, Wrap]) -> moderngl.Texture:
        """Return a texture of ``image``, (h, w, c) float32, which was made from ``texture``."""
        return self._upload(image, texture.name, wrap=wrap, half=texture.image.dtype == np.uint8)

    def _upload(
        self,
        image: np.ndarray,
        name: str,
        internal_format: int | None = None,
        wrap: tuple[Wrap, Wrap] = REPEAT,
        levels: bool = True,
        half: bool = False,
    ) -> moderngl.Texture:
        height, width, components = image.shape
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        if max(height, width) > limit:
            raise AssetError(
                "the texture is larger than this OpenGL supports",
                where=name,
                value=(width, height),
                accepted=f"at most {limit} px on a side",
            )
        # NaN too.
        if image.dtype != np.uint8 and not (image.min() >= 0 and image.max() <= MAX_RADIANCE):
            y, x, _ = np.argwhere(~((image >= 0) & (image <= MAX_RADIANCE)))[0].tolist()
            raise AssetError(
                f"texel x={x}, y={y} cannot be drawn",
                where=name or "texture",
                value=image[y, x].tolist(),
                accepted=f"linear light from 0 to {MAX_RADIANCE:g}",
            )
        if half:
            image = half_floats(image)
        dtype = {"uint8": "f1", "float16": "f2"}.get(image.dtype.name, "f4")
        texture = self.ctx.texture(
            (width, height),
            components,
            np.ascontiguousarray(image).tobytes(),
            # Rows follow each other without padding; by default OpenGL expects multiples of four bytes.
            alignment=1,
            dtype=dtype,
            internal_format=internal_format,
        )
        # moderngl supports only repeat and clamp; mirroring needs a direct call.
        if wrap != REPEAT:
            texture.use(0)
            for axis, kind in zip(_TEXTURE_WRAP, wrap):
                self._parameter(_TEXTURE_2D, axis, _WRAPS[kind])
        if not levels:
            texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            return texture
        texture.build_mipmaps()
        texture.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        texture.anisotropy = self.anisotropy
        if self.mip_bias:
            texture.use(0)
            self._parameter(_TEXTURE_2D, _TEXTURE_LOD_BIAS, self.mip_bias)
        return texture


def _energy_table() -> np.ndarray:
    """Return the numbers of :meth:`SceneResources.energy_texture`."""
    once = energy()
    mean = np.broadcast_to(mean_energy()[:, None, None], (*once.shape[:2], 1))
    return np.concatenate([once, mean, looks()[..., 4:]], axis=2)


def _by_whole_repeats(material: Material) -> bool:
    """Return whether a shift of its texture coordinates by whole numbers is invisible."""
    maps = (material.bumps, material.emission_map, material.gloss.map if material.gloss is not None else None)
    return material.wrap == REPEAT and all(m is None or (m.at == IDENTITY and m.wrap == REPEAT) for m in maps)


def _near_zero(uvs: np.ndarray) -> np.ndarray:
    """Return (V, 2) float64 texture coordinates minus whole repeats, so that 0 is in the middle of the mesh. float32 at
    50 000 repeats resolves 0.004 of a repeat: the texture of a wide ground would move in steps."""
    low, high = uvs.min(axis=0), uvs.max(axis=0)
    return uvs - np.rint((low + high) / 2) if max(-low.min(), high.max()) > 64 else uvs
