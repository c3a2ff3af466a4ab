"""`shader diff` on shapes that change with time: it passes, and a mistake in any term of theirs is found."""

from __future__ import annotations

import json

import pytest

from blinkgl.gl import ShaderLoader, create_context
from blinkgl.gl.shader import ShaderError
from blinkgl.render.renderer import Renderer
from blinkgl.shader_debugger.session import open_subject
from debugger_scene import edit
from tests.scene.gltf_files import arm_file

YAML = """
seed: 3
camera: {width: 72, height: 54, fov: 60}
time: {duration: 0.3, label_rate: 10}
timeline: {kind: uniform, fps: 50}
labels: {flow: [forward, backward], depth: true, ids: true, velocity: true, normals: true}
preview: {enabled: false}
scene:
  kind: explicit
  meshes:
    ball: {primitive: icosphere, parameters: {radius: 0.6, subdivisions: 4}}
    arm: {file: arm.glb}
  materials:
    paint: {procedural: fbm, seed: 1}
    red: {color: [0.9, 0.3, 0.2]}
  objects:
    - mesh: ball
      material: paint
      name: wave
      position: [-0.9, 3, 0.7]
      deform: {kind: flag, along: z, towards: x, amplitude: 0.25, period: 0.8}
    - mesh: ball
      material: red
      name: turn
      position: [0.5, 3, 0.9]
      scale: [1, 0.5, 1]
      deform: {kind: twist, angle: 150}
    - mesh: ball
      material: red
      name: scale
      position: [-0.7, 3, -0.8]
      deform: {kind: breathe, amount: [0.3, -0.2, 0.4]}
    - mesh: arm
      material: red
      name: skin
      position: [0.7, 3, -0.7]
      scale: 0.6
      euler: [0, 0, 50]
      animation: {clip: 0, speed: 1.5, phase: 0.1}
  camera:
    keyframes:
    - {time: 0, position: [0, 0, 0], look_at: [0, 3, 0]}
    - {time: 0.4, position: [0.1, 0.1, 0.05], look_at: [0.1, 3, 0]}
"""
VERTEX, WAVES, TURN, SCALE, SKIN = (
    "include/vertex.glsl",
    *(f"include/deform/{name}.glsl" for name in ("waves", "turn", "scale", "skin")),
)
MUTANTS = {
    # what is wrong: the edits (file, right, wrong), the buffers that are wrong then, the object that is worst
    "terms of the motion": (
        [
            ("include/labels/flow_forward.glsl", "d += shape_forward", "d -= shape_forward"),
            ("include/labels/flow_backward.glsl", "d += shape_backward;", ";"),
            ("include/motion.glsl", "d += shape_rate;", ";"),
            (VERTEX, "normal = deformed_normal(in_position, in_normal);", "normal = in_normal;"),
        ],
        ["flow_forward", "flow_backward", "velocity", "normals"],
        None,
    ),
    "the other direction": ([(VERTEX, "SHAPE_BACKWARD)", "SHAPE_FORWARD)")], ["flow_backward"], None),
    "the place at rest": ([(VERTEX, "local = position;", "local = in_position;")], ["local", "velocity"], None),
    "waves": (
        [
            (WAVES, "wave_angles(p) + change.xy", "wave_angles(p)"),
            (WAVES, "rate.y * cosine(a.y)));", "rate.y * sine(a.y)));"),
            (WAVES, "- slope * dot(shape[0].xyz, n)", "+ slope * dot(shape[0].xyz, n)"),
        ],
        ["flow_forward", "velocity", "normals"],
        "wave",
    ),
    "turns": (
        [
            (TURN, "shape[3].x * u + half_turn)", "shape[3].x * u)"),
            (TURN, "(shape[SHAPE_RATE + 3].x * u)", "shape[SHAPE_RATE + 3].x"),
            (TURN, "- g * dot(w, N);", ";"),
        ],
        ["flow_forward", "velocity", "normals"],
        "turn",
    ),
    "scales": (
        [
            (SCALE, "return n / shape[1].xyz", "return n * shape[1].xyz"),
            (SCALE, "shape[other + 1].xyz * (p", "shape[SHAPE_RATE + 1].xyz * (p"),
        ],
        ["flow_forward", "normals"],
        "scale",
    ),
    "morphs left out": (
        [(SKIN, "return vec4(p + skin_morphed(0, 0), 1.0) * skin_blend(0);", "return vec4(p, 1.0) * skin_blend(0);")],
        ["flow_forward", "velocity"],
        "skin",
    ),
    "morphs' place in the change": (
        [(SKIN, "+ skin_morphed(0, 0) + change, 1.0)", "+ change, 1.0)")],
        ["flow_forward"],
        "skin",
    ),
    "morphs' change among the joints'": (
        [(SKIN, "+ skin_morphed(0, 0) + change, 1.0)", "+ skin_morphed(0, 0), 1.0)")],
        ["flow_forward"],
        "skin",
    ),
    "morphs' own change and rate, normals": (
        [
            (SKIN, "q += vec4(change, 0.0) * skin_blend(0);", ";"),
            (SKIN, "q += vec4(skin_morphed(SHAPE_RATE, 0), 0.0) * skin_blend(0);", ";"),
            (SKIN, "return vec3(dot(cross(b, c), m), dot(cross(c, a), m), dot(cross(a, b), m));", "return m;"),
        ],
        ["flow_forward", "velocity", "normals"],
        "skin",
    ),
}


@pytest.fixture(scope="module")
def living(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("living")
    (folder / "arm.glb").write_bytes(arm_file(morphs=True).glb())
    (folder / "scene.yaml").write_text(YAML)
    return str(folder / "scene.yaml")


def test_shapes_that_change_are_what_the_reference_makes_of_them(shader, living):
    status, out, _ = shader("diff", living, "--json")
    reports = {b["buffer"]: b for b in json.loads(out)["buffers"]}
    assert status == 0, [name for name, report in reports.items() if not report["passed"]]
    assert {"flow_forward", "flow_backward", "velocity", "normals", "depth", "id", "local"} <= reports.keys()
    status, out, _ = shader("probe", living, "--pixel", "20,18")
    assert status == 0 and not [line for line in out.splitlines() if line.startswith("!!")]


ALWAYS = ("terms of the motion", "waves", "morphs left out")
"""The others take their turn with `make slow`."""


@pytest.mark.parametrize(
    "mutant", [pytest.param(name, marks=[pytest.mark.slow] * (name not in ALWAYS)) for name in MUTANTS]
)
def test_a_mistake_in_a_term_is_found(shader, living, shaders, mutant):
    edits, buffers, who = MUTANTS[mutant]
    for file, right, wrong in edits:
        edit(shaders / file, right, wrong)
    status, out, _ = shader("diff", living, "--shaders", shaders, "--json")
    reports = {b["buffer"]: b for b in json.loads(out)["buffers"]}
    assert status == 1
    for buffer in buffers:
        assert not reports[buffer]["passed"], buffer
        if who is not None:
            assert reports[buffer]["objects"][0]["object"] == who, buffer  # the worst first


@pytest.mark.parametrize(
    "wrong, status, words",
    [
        # With every vertex at one place the compiler leaves no attribute at all.
        ("return vec3(0.0);", 2, "error: debug.glsl: the shader does not use 'in_position' any more"),
        ("return p;", 1, "label.glsl: the shader does not use 'in_weights_0' any more"),
    ],
)
def test_what_the_compiler_removed_is_named(shader, living, shaders, wrong, status, words):
    edit(shaders / SKIN, "return vec4(p + skin_morphed(0, 0), 1.0) * skin_blend(0);", wrong)
    got, out, err = shader("diff", living, "--shaders", shaders, "--pass", "depth", "--pass", "local")
    assert got == status and "Traceback" not in err
    assert any(line.startswith(words) for line in (out + err).splitlines()), out + err


def test_a_run_with_edited_shaders_names_what_they_do_not_use(living, shaders):
    """As `generate` draws: without the debugger's painter, which goes on."""
    edit(shaders / SKIN, "return vec4(p + skin_morphed(0, 0), 1.0) * skin_blend(0);", "return vec3(0.0);")
    subject = open_subject(living)
    with create_context() as gl:
        gl.shaders = ShaderLoader(gl.ctx, shaders)
        with Renderer(gl, subject.scene, subject.config.render) as renderer:
            with pytest.raises(ShaderError, match=r"^luminance.glsl: the shader does not use 'in_position' any more"):
                renderer.luminance(0)
            gl.shaders.clear()
            edit(shaders / "include/motion.glsl", "vec3 d = rate * vec4(local, 1.0);", "vec3 d = local;")
            with pytest.raises(ShaderError, match=r"^velocity.glsl: the shader does not use 'rate' any more"):
                renderer.velocity(0)
