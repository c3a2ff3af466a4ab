"""Schema of a glTF 2.0 file's JSON: types, ranges and lengths of everything that is read.

The reader (:mod:`blinkgl.scene.importing.gltf`) works on the plain dictionaries; :func:`check` guarantees their form.
References from one list into another are checked where they are used. Names are those of the specification. Properties
that are not read are not checked.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from blinkgl.errors import AssetError

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
Extensions = dict[str, dict[str, Any]]


class _Part(BaseModel):
    # A default of None means "not there"; the specification does not allow JSON's null, so it is refused.
    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)


class Asset(_Part):
    version: str
    minVersion: str = None


class Buffer(_Part):
    uri: str = None
    byteLength: Size = 0
    extensions: Extensions = {}


class BufferView(_Part):
    buffer: Index
    byteOffset: Size = 0
    byteLength: Size = 0
    byteStride: Annotated[int, Field(ge=0, le=65536)] = 0


class SparseValues(_Part):
    bufferView: Index
    byteOffset: Size = 0


class SparseIndices(SparseValues):
    componentType: Literal[5121, 5123, 5125]


class Sparse(_Part):
    count: Size
    indices: SparseIndices
    values: SparseValues


class Accessor(_Part):
    bufferView: Index = None
    byteOffset: Size = 0
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    count: Size
    normalized: bool = False
    sparse: Sparse = None


class Transform(_Part):
    offset: Vector2 = [0, 0]
    scale: Vector2 = [1, 1]
    rotation: Number = 0.0
    texCoord: Annotated[int, Field(ge=0, le=255)] = None


class TextureExtensions(_Part):
    KHR_texture_transform: Transform = None


class TextureInfo(_Part):
    index: Index
    texCoord: Annotated[int, Field(ge=0, le=255)] = 0
    extensions: TextureExtensions = TextureExtensions()


class NormalTextureInfo(TextureInfo):
    scale: Number = 1.0


class Pbr(_Part):
    baseColorFactor: Annotated[list[Factor], Field(min_length=4, max_length=4)] = [1, 1, 1, 1]
    baseColorTexture: TextureInfo = None
    metallicFactor: Factor = 1.0
    roughnessFactor: Factor = 1.0
    metallicRoughnessTexture: TextureInfo = None


class EmissiveStrength(_Part):
    emissiveStrength: Factor = 1.0


class MaterialExtensions(_Part):
    KHR_materials_emissive_strength: EmissiveStrength = None


class Material(_Part):
    pbrMetallicRoughness: Pbr = Pbr()
    normalTexture: NormalTextureInfo = None
    occlusionTexture: TextureInfo = None
    emissiveTexture: TextureInfo = None
    emissiveFactor: Annotated[list[Factor], Field(min_length=3, max_length=3)] = [0, 0, 0]
    alphaMode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alphaCutoff: Factor = 0.5
    doubleSided: bool = False
    extensions: MaterialExtensions = MaterialExtensions()


class Primitive(_Part):
    attributes: dict[str, Index]
    indices: Index = None
    material: Index = None
    # 4: separate triangles.
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    targets: list[dict[str, Index]] = []
    extensions: Extensions = {}


class Mesh(_Part):
    primitives: list[Primitive]
    weights: list[Number] = []


class Node(_Part):
    children: list[Index] = []
    mesh: Index = None
    camera: Index = None
    skin: Index = None
    matrix: Matrix4 = None
    translation: Vector3 = [0, 0, 0]
    rotation: Vector4 = [0, 0, 0, 1]
    scale: Vector3 = [1, 1, 1]
    weights: list[Number] = None
    extensions: Extensions = {}

    @model_validator(mode="after")
    def _turned(self):
        if sum(q * q for q in self.rotation) < 1e-18:
            raise ValueError("a node's rotation is zero")
        return self


class Skin(_Part):
    joints: Annotated[list[Index], Field(min_length=1)]
    inverseBindMatrices: Index = None


class Scene(_Part):
    nodes: list[Index] = []


class Texture(_Part):
    source: Index = None
    sampler: Index = None
    extensions: Extensions = {}


class Image(_Part):
    uri: str = None
    bufferView: Index = None


class Sampler(_Part):
    magFilter: int = None
    # OpenGL's codes; 10497 is GL_REPEAT, the default of the specification.
    wrapS: int = 10497
    wrapT: int = 10497


class Perspective(_Part):
    yfov: Annotated[float, Field(gt=1e-4, lt=3.1415)]
    znear: Factor = None


class Camera(_Part):
    type: Literal["perspective", "orthographic"]
    perspective: Perspective = None


class Target(_Part):
    node: Index = None
    path: str


class Channel(_Part):
    sampler: Index
    target: Target


class AnimationSampler(_Part):
    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(_Part):
    channels: list[Channel]
    samplers: list[AnimationSampler]


class Spot(_Part):
    innerConeAngle: Annotated[float, Field(ge=0, le=1.5708)] = 0.0
    outerConeAngle: Annotated[float, Field(gt=0, le=1.5708)] = 0.7853981633974483


class PunctualLight(_Part):
    """A light of KHR_lights_punctual: candela and lux."""

    type: Literal["directional", "point", "spot"]
    color: Annotated[list[Factor], Field(min_length=3, max_length=3)] = [1, 1, 1]
    intensity: Factor = 1.0
    range: Annotated[float, Field(gt=0, le=1e9)] = None
    spot: Spot = Spot()


class PunctualLights(_Part):
    lights: list[PunctualLight] = []


class File(_Part):
    asset: Asset
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []
    buffers: list[Buffer] = []
    bufferViews: list[BufferView] = []
    accessors: list[Accessor] = []
    images: list[Image] = []
    samplers: list[Sampler] = []
    textures: list[Texture] = []
    materials: list[Material] = []
    meshes: list[Mesh] = []
    cameras: list[Camera] = []
    nodes: list[Node] = []
    skins: list[Skin] = []
    scenes: list[Scene] = []
    scene: Index = 0
    animations: list[Animation] = []


def check(tree: Any, where: str, model: type[_Part] = File) -> None:
    """Raise AssetError naming the first property that violates the specification, and its value.
    model : the schema; an extension has its own."""
    try:
        model.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        path = ".".join(str(step) for step in first["loc"]) or "its JSON"
        message = first["msg"].removeprefix("Value error, ")
        raise AssetError(
            f"the file is no valid glTF ({path}: {message[0].lower() + message[1:]})",
            where=where,
            value=... if first["type"] in ("missing", "value_error") else first["input"],
        ) from None
