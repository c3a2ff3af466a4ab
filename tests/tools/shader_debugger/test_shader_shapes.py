"""`shader diff` on shapes that change with time: it passes, and a mistake in any term of theirs is found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from debugger_scene import edit

from blinkgl.gl import ShaderLoader, create_context
from blinkgl.gl.shader import ShaderError
from blinkgl.render.renderer import Renderer
from blinkgl.tools.shader_debugger import compare, moments, session
from blinkgl.tools.shader_debugger.session import moment, open_renderer, open_subject
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
        ("return vec3(0.0);", 2, "error: debug.glsl: the shader no longer uses 'in_position'"),
        ("return p;", 1, "label.glsl: the shader no longer uses 'in_weights_0'"),
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
            with pytest.raises(ShaderError, match=r"^luminance.glsl: the shader no longer uses 'in_position'"):
                renderer.luminance(0)
            gl.shaders.clear()
            edit(shaders / "include/motion.glsl", "vec3 d = rate * vec4(local, 1.0);", "vec3 d = local;")
            with pytest.raises(ShaderError, match=r"^velocity.glsl: the shader no longer uses 'rate'"):
                renderer.velocity(0)


# --- The shader debugger takes light apart: shadow maps, lamps, their shadows, the environment, what is mirrored,
# emission; and a mistake in any of them is named by the first term that is wrong.

LIT = str(Path(__file__).with_name("lit.yaml"))
LOOKUPS = {f"{of}_{name}" for of in ("luminance", "colour") for name in moments.LOOKUPS[:3]}
TERMS = ("direct", "shadow", "around", "mirrored", "emission")


class Judge:
    """Names the buffers of one moment that are over their tolerance with other shaders."""

    def __init__(self, renderer, subject, when):
        self.renderer, self.when = renderer, when
        self.right = moments.GpuMoment(renderer, when)
        self.comparison = compare.Comparison(self.right, moments.open_reference(subject, when, renderer.maps))

    def wrong(self, loader: ShaderLoader) -> list[str]:
        """Those of the first pass that has one."""
        gpu = moments.GpuMoment(self.renderer, self.when)
        ours = self.renderer.gl.shaders
        self.renderer.use_shaders(loader)
        try:
            comparison = compare.Comparison(gpu, self.comparison.ref)
            for of in ("shadow_map", "luminance", "colour"):
                names = [n for n in comparison.names() if n.startswith(of) and n not in LOOKUPS]
                if found := [n for n in names if not comparison.report(n).passed]:
                    return found
            return []
        finally:
            self.renderer.use_shaders(ours)
            loader.clear()  # OpenGL's objects outlive Python's


@pytest.fixture(scope="module")
def lit() -> str:
    return LIT


@pytest.fixture(scope="module")
def looked_at(lit):
    subject = open_subject(lit)
    when = moment(subject)
    with open_renderer(subject) as renderer:
        one = Judge(renderer, subject, when)
        reports = {name: one.comparison.report(name) for name in one.comparison.names()}
        yield one.right, one.comparison, reports, one


@pytest.fixture(scope="module")
def judge(looked_at):
    return looked_at[3]


def test_every_term_agrees_with_the_reference(looked_at):
    gpu, comparison, reports, _ = looked_at
    for name, report in reports.items():
        assert report.passed, (name, report.value, report.objects[:1])
    for of in ("luminance", "colour"):
        for term in TERMS:
            assert reports[f"{of}_{term}"].graded.mean() > 0.6, term
        shadow = gpu[f"{of}_shadow"][comparison.ref.frame.hit]
        assert (shadow < 0.7).mean() > 0.02 and (shadow == 1).mean() > 0.3
        assert all(np.ptp(gpu[f"{of}_{term}"]) > 0.1 for term in TERMS)
    assert {"shadow_map_0", "shadow_map_1"} < set(reports) and "shadow_map_2" not in reports
    for name in ("shadow_map_0", "shadow_map_1"):
        there = gpu[name] > 0
        assert 0.05 < there.mean() < 0.9 and reports[name].graded[there].mean() > 0.7


def test_maps_and_terms_as_pictures_and_of_a_pixel(shader, lit, tmp_path):
    names = ("shadow_map_0", "luminance_shadow", "colour_emission")
    asked = [word for name in names for word in ("--pass", name)]
    assert shader("passes", lit, "--out", tmp_path, *asked)[0] == 0
    assert np.load(tmp_path / "shadow_map_0.npy").shape == (256, 256)
    assert (tmp_path / "contact_sheet.png").exists()
    status, out, _ = shader("probe", lit, "--pixel", "36,40", "--json")
    found = json.loads(out)
    assert status == 0 and "luminance_around" in {row["name"] for row in found["buffers"]}
    places = [row for row in found["positions"] if row["name"].startswith("shadow_map_")]
    assert len(places) == 2
    for row in places:
        np.testing.assert_allclose(row["gpu"], row["reference"], atol=1e-3)


LIGHTS, SURFACE, SHADOWS = (f"include/{name}.glsl" for name in ("lights", "surface", "shadows"))
SUN = "float facing = {}(0.0, dot(n, beam.towards));\n        SHOW(direct, facing * beam.strength)\n#ifdef SHADOW_SUNS"
SKY = "dot(even.xyz, n) + even.w"
MISTAKES = {
    # name: (file, right, wrong, the first term that is wrong)
    "a lamp falls with its distance": (LIGHTS, "fall = inverse * inverse", "fall = inverse", "luminance_direct"),
    "a cone that is not squared": (LIGHTS, "fall *= share * share;", "fall *= share;", "luminance_direct"),
    "a sun from behind": (LIGHTS, SUN.format("max"), SUN.format("min"), "luminance_direct"),
    "no shadow of the sun": (LIGHTS, "facing *= shadow_share[i];", "", "luminance_shadow"),
    "no shadow of the spot light": (
        LIGHTS,
        "facing *= shadow_share[map];",
        "facing *= 0.5 + 0.5 * shadow_share[map];",
        "luminance_shadow",
    ),
    "its own shadow": (SHADOWS, "min(1.5 * slant + SPARE, FARTHEST)", "-1.0", "luminance_shadow"),
    "a shadow that floats": (SHADOWS, "+ SPARE, FARTHEST)", "+ 40.0, 50.0)", "luminance_shadow"),
    "the wrong map": (SHADOWS, "if (k == 1)", "if (k == 0)", "luminance_shadow"),
    "the sky from below": (LIGHTS, SKY, "even.w - dot(even.xyz, n)", "luminance_around"),
    "half of the emission": ("luminance.glsl", "own = emission;", "own = 0.5 * emission;", "luminance_emission"),
    "a lobe without its cosine": (SURFACE, "lobe * facing * share", "lobe * share", "luminance_mirrored"),
    "a mirror turned round": (SURFACE, "TO_WORLD * reflect(-v, n)", "TO_WORLD * reflect(v, n)", "luminance_mirrored"),
    "one look for both": (SURFACE, "look.b)), look.a)", "look.r)), look.g)", "luminance_mirrored"),
    "a gloss without shadow": (SURFACE, "share = shadow_share[i];", "share = 1.0;", "luminance_mirrored"),
    "colours that glow twice": ("colour.glsl", "added += emission;", "added += 2.0 * emission;", "colour_emission"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_by_its_term(judge, shaders, mistake):
    """The first of the terms, in the order of ``diff``; the surface is where it was."""
    file, good, bad, term = MISTAKES[mistake]
    edit(shaders / file, good, bad)
    gpu = judge.right
    gpu.renderer.gl.make_current()
    wrong = judge.wrong(ShaderLoader(gpu.renderer.gl.ctx, session.open_folder(str(shaders))))
    assert wrong and wrong[0] == term, wrong
