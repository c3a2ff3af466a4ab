"""A small scene with everything the debugger has to explain, and a copy of the shaders to break."""

from __future__ import annotations

import shutil
from pathlib import Path

from blinkgl.gl.shader import shader_folder

WIDTH, HEIGHT = 96, 72
YAML = """
seed: 3
camera: {width: 96, height: 72, fov: 60}
time: {duration: 0.3, label_rate: 10}
timeline: {kind: uniform, fps: 50}
labels: {flow: [forward, backward], depth: true, ids: true}
preview: {enabled: false}
scene:
  kind: explicit
  meshes:
    floor: {primitive: grid, parameters: {width: 12, depth: 12, subdivisions: 6}}
    ball: {primitive: icosphere, parameters: {radius: 0.6, subdivisions: 4}}
    box: {primitive: cuboid, parameters: {extents: [0.8, 0.8, 0.8]}}
    pane: {primitive: grid, parameters: {width: 0.3, depth: 0.3}}
  materials:
    stone: {procedural: bricks, color: [0.8, 0.7, 0.6], uv_scale: [5, 5]}
    paint: {procedural: fbm, seed: 1}
    red: {color: [0.9, 0.3, 0.2]}
    lamp: {color: [0.9, 0.9, 0.5], unlit: true, both_sides: true}
  objects:
    - {mesh: floor, material: stone, category: ground, name: floor, position: [0, 5, 0]}
    - mesh: ball
      material: paint
      name: ball
      keyframes: [{time: 0, position: [-1.2, 4, 0.9]}, {time: 0.4, position: [0.2, 4.4, 1.1], euler: [20, 30, 40]}]
    - mesh: box
      material: red
      name: box
      keyframes: [{time: 0, position: [1.1, 3.4, 0.6]}, {time: 0.4, position: [-0.3, 3.0, 0.7], euler: [0, 0, 60]}]
    - mesh: pane
      material: lamp
      name: passing
      interpolation: linear
      keyframes:
      - {time: 0, position: [-0.5, 3.3, 1.4], euler: [90, 0, 0]}
      - {time: 0.4, position: [-0.5, -3.9, 1.4], euler: [90, 0, 0]}
  camera:
    keyframes:
    - {time: 0, position: [0, 0, 1], look_at: [0, 4, 0.9]}
    - {time: 0.4, position: [0.1, 0.1, 1.05], look_at: [0.1, 4, 0.9]}
"""


def write_config(folder: Path) -> str:
    path = folder / "scene.yaml"
    path.write_text(YAML)
    return str(path)


def copy_shaders(folder: Path) -> Path:
    """A copy of the shipped shaders in ``folder``/shaders."""
    copy = folder / "shaders"
    shutil.copytree(Path(str(shader_folder())), copy, ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    return copy


def edit(path: Path, right: str, wrong: str) -> None:
    text = path.read_text()
    assert right in text, f"{path.name} has changed: break it in another way"
    # As editors do: a server that watches the folder never sees half a file.
    whole = path.with_name(f".{path.name}.new")
    whole.write_text(text.replace(right, wrong))
    whole.replace(path)


MISTAKES = {
    "sign of the flow": (
        "include/displacement.glsl",
        "(d.xy - ndc_of_fragment(image_size) * d.z) / w_next",
        "(ndc_of_fragment(image_size) * d.z - d.xy) / w_next",
    ),
    "no perspective division": ("include/displacement.glsl", "* d.z) / w_next", "* d.z)"),
    "depth off by near": ("include/labels/depth.glsl", "1.0 / INVERSE_DEPTH", "1.0 / INVERSE_DEPTH - 0.05"),
}

_UV = "return texture(albedo, uv).CHANNELS;"

LOOKUP_MISTAKES = {
    # name: ([(file, right, wrong), …], the first buffer that is wrong, words of the suspicion, the objects)
    "noperspective varying": (
        [
            ("include/vertex.glsl", "out vec2 uv;", "noperspective out vec2 uv;"),
            ("include/vertex.glsl", "in vec2 uv;", "noperspective in vec2 uv;"),
        ],
        "luminance_uv",
        "",
        {"floor"},
    ),
    "sRGB decoded twice": (
        [
            (
                "colour.glsl",
                "radiance *= texture(albedo, uv).rgb;",
                "radiance *= pow(texture(albedo, uv).rgb, vec3(2.2));",
            )
        ],
        "colour_albedo",
        "sRGB is decoded twice",
        {"floor", "ball"},
    ),
    "mip bias +1": (
        [("include/albedo.glsl", _UV, _UV.replace("uv)", "uv, 1.0)"))],
        "luminance_level",
        "a mip bias of +1",
        {"floor", "ball"},
    ),
    "uv off by half a texel": (
        [("include/albedo.glsl", _UV, _UV.replace("uv)", "uv + 0.5 / vec2(textureSize(albedo, 0)))"))],
        "luminance_uv",
        "shifted by half a texel (+0.5, +0.5)",
        {"floor", "ball"},
    ),
    # thought of when the debugger was done
    "normal not normalised": (
        [
            (
                "include/light.glsl",
                "vec3 n = normal * inversesqrt(max(dot(normal, normal), 1e-30));\n    float facing",
                "vec3 n = normal;\n    float facing",
            )
        ],
        "luminance_direct",
        "",
        {"ball"},
    ),
    "width and height exchanged": (
        [("include/motion.glsl", "* INVERSE_DEPTH * 0.5 * image_size;", "* INVERSE_DEPTH * 0.5 * image_size.yx;")],
        "velocity_pass",
        "x is 0.75 times, y 1.333 times",
        {"floor", "ball", "box", "passing"},
    ),
    "two-sided normal reversed": (
        [("include/needs.glsl", "gl_FrontFacing ? (way) : -(way)", "gl_FrontFacing ? -(way) : (way)")],
        "luminance_direct",
        "the normal points the other way",
        {"floor"},
    ),
}
