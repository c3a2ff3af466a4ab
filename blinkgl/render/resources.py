"""What a scene occupies in OpenGL: buffers, textures and vertex arrays, each made when first needed, shared by
content, and released together."""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import moderngl
import numpy as np

from blinkgl.errors import AssetError
from blinkgl.gl import GLContext
from blinkgl.gl.shader import MADE
from blinkgl.render.colour import LUMA, linear_image, luminance_image
from blinkgl.scene.lights import is_coloured
from blinkgl.scene.shapes.deformer import Deformer
from blinkgl.scene.shapes.table import define_of, includes
from blinkgl.scene.types import Material, Mesh, Scene

MADE.append(includes)

_TEXTURE_2D, _TEXTURE_LOD_BIAS = 0x0DE1, 0x8501
_ATTRIBUTES = (("in_position", "3f", 12), ("in_normal", "3f", 12), ("in_uv", "2f", 8))


class Kind(NamedTuple):
    """What of a material, and of a shape that changes with time, makes another program. shape : macros of the
    latter.   hued : lit, and of several colours under light that is not white, so that its luminance takes three
    channels."""

    textured: bool
    lit: bool
    two_sided: bool
    shape: tuple[tuple[str, int], ...] = ()
    hued: bool = False

    @property
    def defines(self) -> dict[str, int]:
        return {name: 1 for name, on in zip(("TEXTURED", "LIT", "TWO_SIDED"), self) if on} | dict(self.shape)


def shape_of(deformer: Deformer | None) -> tuple[tuple[str, int], ...]:
    """The macros of a deformer's variants."""
    if deformer is None:
        return ()
    return (
        ("DEFORM", 1),
        (define_of(deformer.glsl), 1),
        ("SHAPE_ROWS", padded_rows(deformer)),
        *sorted(deformer.sizes.items()),
    )


def padded_rows(deformer: Deformer) -> int:
    """Rows of numbers that its programs have room for: the next power of two, so that one program serves many
    skeletons."""
    return 1 << max(deformer.rows - 1, 3).bit_length()


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(8, 3) of the box between two of its corners, (3,) each."""
    return np.array(list(itertools.product(*zip(low, high))))


@dataclass(eq=False)
class DrawItem:
    """One part of one object, ready to draw.

    object_index : row of a moment's matrices.   part : number of the part among those of the scene, object by object.
    number : of this item among all, in the order of the layers.   moves : whether the object does.
    centre, radius; low, high : bounding sphere and box, object frame; of a shape that changes those of all that it
    sweeps.   corners : (8, 3) of the box.
    layer : 0 objects, 1 ground and walls, 2 sky; drawn in this order so that depth rejects hidden fragments early.
    two_sided : no culling, and the normal is turned towards the camera.   hued : as of :class:`Kind`.
    casts : whether it throws shadows: objects and walls do, unless they are unlit (screens, skies of files).
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
    hued: bool = False
    casts: bool = False

    def __post_init__(self) -> None:
        self.textured = self.material.texture is not None
        self.deformer = self.mesh.deformer
        self.kind = Kind(self.textured, self.lit, self.two_sided, shape_of(self.deformer), self.hued)
        self.corners = box_corners(self.low, self.high)


MAX_RADIUS = 1e18
"""Times the largest focal length, 1e9 px, still far below float32's 3e38."""
MAX_RADIANCE = 1e18
"""Of a texel: times the largest colour and the largest light of a configuration, 1e9 each,
it is still finite in float32."""
_LAYER = {"object": 0, "ground": 1, "wall": 1, "sky": 2}


class Shape:
    """GL side of one deformer: its numbers at one time and those that lead to others, as the block ``Shape`` of
    deform.glsl."""

    SETS = ("now", "rate", "forward", "backward")
    BINDING = 0

    def __init__(self, ctx: moderngl.Context, deformer: Deformer):
        self.ctx, self.deformer, self._rows = ctx, deformer, padded_rows(deformer)
        size = 16 * self._rows * len(self.SETS)
        limit = ctx.info["GL_MAX_UNIFORM_BLOCK_SIZE"]
        if size > limit:
            raise AssetError(
                "a shape needs more numbers than this OpenGL takes",
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
        """Vertex streams of those attributes that the program has."""
        return [(buffer, f"{n}f", name) for name, (buffer, n) in self._streams.items() if name in program]

    def put(self, name: str, key: object, rows: Callable[[], np.ndarray]) -> None:
        """Numbers of one of SETS, unless those of the same ``key`` are there."""
        if self._held.get(name) != key:
            data = np.zeros((self._rows, 4), np.float32)
            given = rows()
            data[: len(given)] = given
            self._buffer.write(data.tobytes(), offset=self.SETS.index(name) * data.nbytes)
            self._held[name] = key

    def use(self, program: moderngl.Program, unit: int) -> None:
        """Of the program that is drawn with next. unit : first texture unit that is free."""
        program["Shape"].binding = self.BINDING
        self._buffer.bind_to_uniform_block(self.BINDING)
        for offset, (name, texture) in enumerate(self._textures.items()):
            if name in program:
                program[name].value = unit + offset
                texture.use(unit + offset)

    def release(self) -> None:
        for owned in (self._buffer, *(buffer for buffer, _ in self._streams.values()), *self._textures.values()):
            owned.release()


class _Greys:
    """Whether materials are all of one colour: looked at where the light is not white, once per texture."""

    def __init__(self, coloured_light: bool):
        self._coloured_light = coloured_light
        self._known: dict[int, bool] = {}

    def hued(self, material: Material) -> bool:
        if not self._coloured_light or material.texture is None or material.unlit:
            return False
        key = id(material.texture)
        if key not in self._known:
            image = material.texture.image
            self._known[key] = all(np.array_equal(image[..., 0], image[..., k]) for k in (1, 2))
        return not self._known[key]


class SceneResources:
    """GL side of one Scene. Release it before the context."""

    def __init__(self, gl: GLContext, scene: Scene, anisotropy: float = 1.0, mip_bias: float = 0.0):
        self.ctx, self.scene, self.anisotropy, self.mip_bias = gl.ctx, scene, anisotropy, mip_bias
        self._parameter = gl.function("glTexParameterf", None, ctypes.c_uint, ctypes.c_uint, ctypes.c_float)
        self._buffers: dict[tuple, tuple[moderngl.Buffer, moderngl.Buffer]] = {}
        self._textures: dict[tuple, moderngl.Texture] = {}
        self._vaos: dict[tuple, moderngl.VertexArray] = {}
        self._shapes: dict[int, Shape] = {}
        grey = _Greys(is_coloured(scene.light))
        self.items = [
            _draw_item(index, part.mesh, part.material, obj.category, not obj.is_static, scene.t0_ns, scene.t1_ns, grey)
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
            streams = [(vertices, " ".join(formats), *names)]
            if item.deformer is not None:
                streams += self.shape(item.deformer).streams(program)
            self._vaos[key] = self.ctx.vertex_array(program, streams, indices, 4)
        return self._vaos[key]

    def shape(self, deformer: Deformer) -> Shape:
        """What a deformer occupies in OpenGL."""
        if id(deformer) not in self._shapes:
            self._shapes[id(deformer)] = Shape(self.ctx, deformer)
        return self._shapes[id(deformer)]

    def luminance_texture(self, material: Material) -> moderngl.Texture:
        """R32F: luminance of texture * base_color (mip-mapped in linear light)."""
        key = ("luminance", id(material.texture), material.base_color)
        if key not in self._textures:
            image = luminance_image(material.texture.image, material.base_color)
            self._textures[key] = self._upload(image[..., None], material.texture.name)
        return self._textures[key]

    def shares_texture(self, material: Material) -> moderngl.Texture:
        """RGB32F: what r, g and b of texture * base_color have in its luminance; their sum is
        :meth:`luminance_texture`."""
        key = ("shares", id(material.texture), material.base_color)
        if key not in self._textures:
            shares = (LUMA * np.asarray(material.base_color, np.float64)).astype(np.float32)
            self._textures[key] = self._upload(linear_image(material.texture.image) * shares, material.texture.name)
        return self._textures[key]

    def colour_texture(self, material: Material) -> moderngl.Texture:
        """Linear rgb of the texture alone: sRGB8 when the image is 8-bit, else RGB32F."""
        key = ("colour", id(material.texture))
        if key not in self._textures:
            image = material.texture.image
            srgb8 = image.dtype == np.uint8
            # 0x8C41: GL_SRGB8.
            self._textures[key] = self._upload(
                image if srgb8 else linear_image(image),
                material.texture.name,
                internal_format=0x8C41 if srgb8 else None,
            )
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
        for owned in (*self._textures.values(), *self._shapes.values()):
            owned.release()
        self._buffers, self._textures, self._shapes = {}, {}, {}

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


def _draw_item(
    index: int, mesh: Mesh, material: Material, category: str, moves: bool, t0_ns: int, t1_ns: int, grey: _Greys
) -> DrawItem:
    if mesh.deformer is None:
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        centre = (low + high) / 2
        radius = float(np.sqrt(((mesh.vertices - centre) ** 2).sum(axis=1).max()))
    else:
        low, high = mesh.deformer.bounds(mesh, t0_ns, t1_ns)
        centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    if not radius <= MAX_RADIUS:  # NaN too
        raise AssetError(
            "mesh is too large to be drawn in float32",
            where=mesh.name or f"object {index}",
            value=radius,
            accepted=f"at most {MAX_RADIUS:g} units from its centre, all coordinates finite",
        )
    two_sided = material.double_sided or not mesh.closed
    return DrawItem(
        index,
        mesh,
        material,
        centre,
        radius,
        low,
        high,
        _LAYER[category],
        two_sided,
        not material.unlit,
        moves,
        hued=grey.hued(material),
        casts=category in ("object", "wall") and not material.unlit,
    )
