"""What a glTF file leaves out is as the specification says, and what it may say has an end."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from blinkgl.scene.importing import gltf_schema as schema

DEFAULTS = {  # glTF 2.0, section 5; extensions: KHR_texture_transform
    schema.Buffer: {"byteLength": 0},
    schema.BufferView: {"buffer": 0, "byteOffset": 0, "byteStride": 0},
    schema.Accessor: {"componentType": 5126, "type": "VEC3", "count": 1, "byteOffset": 0, "normalized": False},
    schema.Transform: {"offset": [0, 0], "scale": [1, 1], "rotation": 0.0},
    schema.TextureInfo: {"index": 0, "texCoord": 0},
    schema.Pbr: {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 1.0, "roughnessFactor": 1.0},
    schema.Material: {"emissiveFactor": [0, 0, 0], "alphaMode": "OPAQUE", "doubleSided": False},
    schema.Primitive: {"attributes": {}, "mode": 4},
    schema.Node: {"children": [], "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]},
    schema.Sampler: {"wrapS": 10497, "wrapT": 10497, "magFilter": None},
    schema.AnimationSampler: {"input": 0, "output": 0, "interpolation": "LINEAR"},
}
NEEDED = ("buffer", "componentType", "type", "count", "index", "attributes", "input", "output")


@pytest.mark.parametrize("part", DEFAULTS, ids=lambda part: part.__name__)
def test_what_is_left_out(part):
    given = {k: v for k, v in DEFAULTS[part].items() if k in NEEDED}
    made = part.model_validate(given)
    assert {k: getattr(made, k) for k in DEFAULTS[part]} == DEFAULTS[part]


@pytest.mark.parametrize(
    "part, key, fine, bad",
    [
        (schema.Node, "translation", [1e12, -1e12, 0], [1.1e12, 0, 0]),
        (schema.Node, "translation", [0, 0, -1e12], [0, -1.1e12, 0]),
        (schema.Node, "translation", [1, 2, 3], [1, 2]),
        (schema.Node, "scale", [1, 2, 3], [1, 2, 3, 4]),
        (schema.Node, "rotation", [0, 0, 0, 1e-8], [0, 0, 0, 1e-10]),
        (schema.Node, "rotation", [1, 0, 0, 0], [0, 0, 1]),
        (schema.Node, "rotation", [0, 1, 0, 0], [0, 0, 0, 0, 1]),
        (schema.Node, "matrix", [1.0] * 16, [1.0] * 15),
        (schema.Node, "matrix", [1.0] * 16, [1.0] * 17),
        (schema.Node, "mesh", 2**31 - 1, 2**31),
        (schema.Node, "mesh", 0, -1),
        (schema.Buffer, "byteLength", 2**53, 2**53 + 1),
        (schema.Buffer, "byteLength", 0, -1),
        (schema.BufferView, "byteStride", 65536, 65537),
        (schema.BufferView, "byteStride", 0, -1),
        (schema.TextureInfo, "texCoord", 255, 256),
        (schema.TextureInfo, "texCoord", 0, -1),
        (schema.Transform, "texCoord", 255, 256),
        (schema.Transform, "offset", [1, 2], [1, 2, 3]),
        (schema.Transform, "scale", [1, 2], [1]),
        (schema.Pbr, "baseColorFactor", [0, 1e9, 0, 1], [0, 1.1e9, 0, 1]),
        (schema.Pbr, "baseColorFactor", [0, 0, 0, 0], [0, -0.1, 0, 1]),
        (schema.Pbr, "baseColorFactor", [0, 0, 0, 0], [0, 0, 0]),
        (schema.Pbr, "baseColorFactor", [0, 0, 0, 0], [0, 0, 0, 0, 0]),
        (schema.Pbr, "metallicFactor", 0, None),
        (schema.Pbr, "roughnessFactor", 0.5, "0.5"),
        (schema.Pbr, "roughnessFactor", 0.5, float("nan")),
        (schema.Material, "emissiveFactor", [0, 0, 1], [0, 1]),
        (schema.Material, "emissiveFactor", [0, 0, 1], [0, 1, 1, 1]),
        (schema.Material, "alphaMode", "BLEND", "GLASS"),
        (schema.Material, "doubleSided", True, 1),
        (schema.Primitive, "mode", 6, 7),
        (schema.Primitive, "mode", 0, -1),
        (schema.Perspective, "yfov", 3.1414, 3.1415),
        (schema.Perspective, "yfov", 1.1e-4, 1e-4),
    ],
)
def test_what_may_be_said_ends_somewhere(part, key, fine, bad):
    given = {k: v for k, v in DEFAULTS.get(part, {}).items() if k in NEEDED}
    assert getattr(part.model_validate({**given, key: fine}), key) == fine
    with pytest.raises(ValidationError):
        part.model_validate({**given, key: bad})
