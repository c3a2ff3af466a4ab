"""Schema of a glTF 2.0 file's JSON: types, ranges and lengths of everything that is read.

The reader (:mod:`blinkgl.scene.importing.gltf`) works on the plain dictionaries; :func:`check` guarantees their form.
References from one list into another are checked where they are used. Names are those of the specification. Properties
that are not read are not checked; those that the specification does not have are found by :func:`unknown`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model

from blinkgl.errors import AssetError
from blinkgl.types.trees import Tree

# Bounds are far above those of any real file: what is beyond them is damage.
Index = Annotated[int, Field(ge=0, lt=2**31)]
Size = Annotated[int, Field(ge=0, le=2**53)]
# A larger value has the wrong unit, and products of a few of them overflow.
Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Factor = Annotated[float, Field(ge=0, le=1e9)]
Vector2 = Annotated[list[Number], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
Vector4 = Annotated[list[Number], Field(min_length=4, max_length=4)]
Matrix4 = Annotated[list[Number], Field(min_length=16, max_length=16)]
Extensions = dict[str, Tree]


class _Part(BaseModel):
    # A default of None means "not there"; the specification does not allow JSON's null, so it is refused.
    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


def _turned(rotation: list[float]) -> list[float]:
    if sum(q * q for q in rotation) < 1e-18:
        raise ValueError("a node's rotation is zero")
    return rotation


def _part(name: str, effectless: str = "", **fields: object) -> Any:
    """Return the schema of a part of a file: type and default of each property, ... for one that must be there.
    effectless : names of properties that change nothing of what is drawn."""
    plain = {"name": (Any, None), "extras": (Any, None)} | dict.fromkeys(effectless.split(), (Any, None))
    return create_model(name, __base__=_Part, **plain, **fields)  # type: ignore[no-matching-overload]


# The closed list of glTF 2.0: every property of the specification, its type, its default. `extensions` are listed where
# they are drawn (gltf.py, gltf_materials.py).
Asset = _part("Asset", "copyright generator extensions", version=(str, ...), minVersion=(str, None))
Buffer = _part("Buffer", uri=(str, None), byteLength=(Size, 0), extensions=(Extensions, {}))
BufferView = _part(
    "BufferView",
    "target extensions",
    buffer=(Index, ...),
    byteOffset=(Size, 0),
    byteLength=(Size, 0),
    byteStride=(Annotated[int, Field(ge=0, le=65536)], 0),
)
SparseValues = _part("SparseValues", "extensions", bufferView=(Index, ...), byteOffset=(Size, 0))
SparseIndices = _part(
    "SparseIndices",
    "extensions",
    bufferView=(Index, ...),
    byteOffset=(Size, 0),
    componentType=(Literal[5121, 5123, 5125], ...),
)
Sparse = _part("Sparse", "extensions", count=(Size, ...), indices=(SparseIndices, ...), values=(SparseValues, ...))
Accessor = _part(
    "Accessor",
    "min max extensions",
    bufferView=(Index, None),
    byteOffset=(Size, 0),
    componentType=(Literal[5120, 5121, 5122, 5123, 5125, 5126], ...),
    type=(Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"], ...),
    count=(Size, ...),
    normalized=(bool, False),
    sparse=(Sparse, None),
)
_Set = Annotated[int, Field(ge=0, le=255)]
Transform = _part(
    "KHR_texture_transform",
    offset=(Vector2, [0, 0]),
    scale=(Vector2, [1, 1]),
    rotation=(Number, 0.0),
    texCoord=(_Set, None),
)
TextureExtensions = _part("TextureExtensions", KHR_texture_transform=(Transform, None))
_PLACED = {"index": (Index, ...), "texCoord": (_Set, 0), "extensions": (TextureExtensions, TextureExtensions())}
TextureInfo = _part("TextureInfo", **_PLACED)
NormalTextureInfo = _part("NormalTextureInfo", scale=(Number, 1.0), **_PLACED)
OcclusionTextureInfo = _part("OcclusionTextureInfo", "strength", **_PLACED)
Colour = Annotated[list[Factor], Field(min_length=3, max_length=3)]
Pbr = _part(
    "Pbr",
    "extensions",
    baseColorFactor=(Annotated[list[Factor], Field(min_length=4, max_length=4)], [1, 1, 1, 1]),
    baseColorTexture=(TextureInfo, None),
    metallicFactor=(Factor, 1.0),
    roughnessFactor=(Factor, 1.0),
    metallicRoughnessTexture=(TextureInfo, None),
)
_Strength = _part("KHR_materials_emissive_strength", emissiveStrength=(Factor, 1.0))
MaterialExtensions = _part("MaterialExtensions", KHR_materials_emissive_strength=(_Strength, None))
Material = _part(
    "Material",
    pbrMetallicRoughness=(Pbr, Pbr()),
    normalTexture=(NormalTextureInfo, None),
    occlusionTexture=(OcclusionTextureInfo, None),
    emissiveTexture=(TextureInfo, None),
    emissiveFactor=(Colour, [0, 0, 0]),
    alphaMode=(Literal["OPAQUE", "MASK", "BLEND"], "OPAQUE"),
    alphaCutoff=(Factor, 0.5),
    doubleSided=(bool, False),
    extensions=(MaterialExtensions, MaterialExtensions()),
)
Primitive = _part(
    "Primitive",
    attributes=(dict[str, Index], ...),
    indices=(Index, None),
    material=(Index, None),
    mode=(Annotated[int, Field(ge=0, le=6)], 4),  # 4: separate triangles
    targets=(list[dict[str, Index]], []),
    extensions=(Extensions, {}),
)
Mesh = _part("Mesh", "extensions", primitives=(list[Primitive], ...), weights=(list[Number], []))
Node = _part(
    "Node",
    children=(list[Index], []),
    mesh=(Index, None),
    camera=(Index, None),
    skin=(Index, None),
    matrix=(Matrix4, None),
    translation=(Vector3, [0, 0, 0]),
    rotation=(Annotated[Vector4, AfterValidator(_turned)], [0, 0, 0, 1]),
    scale=(Vector3, [1, 1, 1]),
    weights=(list[Number], None),
    extensions=(Extensions, {}),
)
Skin = _part(
    "Skin",
    "skeleton extensions",
    joints=(Annotated[list[Index], Field(min_length=1)], ...),
    inverseBindMatrices=(Index, None),
)
Scene = _part("Scene", "extensions", nodes=(list[Index], []))
Texture = _part("Texture", source=(Index, None), sampler=(Index, None), extensions=(Extensions, {}))
Image = _part("Image", "mimeType extensions", uri=(str, None), bufferView=(Index, None))
# OpenGL's codes; 10497 is GL_REPEAT, the default of the specification.
Sampler = _part("Sampler", "minFilter extensions", magFilter=(int, None), wrapS=(int, 10497), wrapT=(int, 10497))
Perspective = _part(
    "Perspective",
    "aspectRatio zfar extensions",
    yfov=(Annotated[float, Field(gt=1e-4, lt=3.1415)], ...),
    znear=(Factor, None),
)
Camera = _part(
    "Camera",
    "orthographic extensions",
    type=(Literal["perspective", "orthographic"], ...),
    perspective=(Perspective, None),
)
Target = _part("Target", node=(Index, None), path=(str, ...), extensions=(Extensions, {}))
Channel = _part("Channel", "extensions", sampler=(Index, ...), target=(Target, ...))
AnimationSampler = _part(
    "AnimationSampler",
    "extensions",
    input=(Index, ...),
    output=(Index, ...),
    interpolation=(Literal["LINEAR", "STEP", "CUBICSPLINE"], "LINEAR"),
)
Animation = _part("Animation", "extensions", channels=(list[Channel], ...), samplers=(list[AnimationSampler], ...))
# KHR_lights_punctual: candela and lux.
Spot = _part(
    "Spot",
    innerConeAngle=(Annotated[float, Field(ge=0, le=1.5708)], 0.0),
    outerConeAngle=(Annotated[float, Field(gt=0, le=1.5708)], 0.7853981633974483),
)
PunctualLight = _part(
    "PunctualLight",
    type=(Literal["directional", "point", "spot"], ...),
    color=(Colour, [1, 1, 1]),
    intensity=(Factor, 1.0),
    range=(Annotated[float, Field(gt=0, le=1e9)], None),
    spot=(Spot, Spot()),
)
PunctualLights = _part("PunctualLights", lights=(list[PunctualLight], []))
_LISTS = {
    "buffers": Buffer, "bufferViews": BufferView, "accessors": Accessor, "images": Image, "samplers": Sampler,
    "textures": Texture, "materials": Material, "meshes": Mesh, "cameras": Camera, "nodes": Node, "skins": Skin,
    "scenes": Scene, "animations": Animation,
}  # fmt: skip
File = _part(
    "File",
    "extensions",
    asset=(Asset, ...),
    extensionsUsed=(list[str], []),
    extensionsRequired=(list[str], []),
    scene=(Index, 0),
    **{key: (list[part], []) for key, part in _LISTS.items()},
)


def unknown(part: Any, path: str = "") -> Iterator[str]:
    """Yield the properties in a checked part that the closed list does not have, as in "materials.iridescence"."""
    for key in part.model_extra or ():
        yield f"{path}{key}"
    for key in part.model_fields_set & type(part).model_fields.keys():
        value = None if key == "extensions" else getattr(part, key)
        for inner in value if isinstance(value, list) else (value,):
            if isinstance(inner, _Part):
                yield from unknown(inner, f"{key}.")


def check(tree: Any, where: str, model: Any = File) -> Any:
    """Return the checked part. Raise AssetError naming the first property that violates the specification, and its
    value.   model : the schema; an extension has its own."""
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        path = ".".join(str(step) for step in first["loc"]) or "its JSON"
        message = first["msg"].removeprefix("Value error, ")
        raise AssetError(
            f"the file is no valid glTF ({path}: {message[0].lower() + message[1:]})",
            where=where,
            value=... if first["type"] in ("missing", "value_error") else first["input"],
        ) from None
