"""check and show: every variant compiles, errors point at the user's line, and production
does not know the debugger."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from blinkgl.config.sequence import RenderConfig, load_run
from blinkgl.gl.shader import ShaderError, ShaderLoader, expand, normalised, shader_folder, stages_of
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render.painter import Painter
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.shader_debugger import check, diagnostics, preprocess, timing, variants
from blinkgl.shader_debugger.moments import GpuMoment, buffers_of
from blinkgl.shader_debugger.session import DebugRenderer, moment, open_folder, open_subject
from debugger_scene import copy_shaders, edit

PRODUCTION = ("luminance.glsl", "velocity.glsl", "colour.glsl", "label.glsl", "downsample.glsl", "edges.glsl")


def scene_of(config, **camera):
    one = load_run(config, [f"camera.{k}={v}" for k, v in camera.items()]).sequence(0)
    return build_scene(one.scene, one.camera, one.time.t0_ns, one.time.t1_ns, seed=one.seed)


# ------------------------------------------------------------------------------------------------- what compiles


def test_everything_compiles_and_nothing_is_unused(shader):
    status, out, _ = shader("check", "--json")
    result = json.loads(out)
    assert status == 0 and result["errors"] == [] and result["unused"] == []
    assert result["programs"] == {
        "colour.glsl": 138,
        "debug.glsl": 14,
        "downsample.glsl": 2,
        "edges.glsl": 3,
        "gather.glsl": 3,
        "label.glsl": 140,
        "luminance.glsl": 410,
        "shadow.glsl": 28,
        "velocity.glsl": 84,
    }


def test_the_table_of_variants_is_what_the_renderer_asks_for(gl, config, monkeypatch):
    """Each label alone and all at once, and every super-sampling, on a scene with several materials."""
    asked = set()
    compile_one = ShaderLoader._compile

    def record(self, name, defines):
        asked.add((name, normalised(defines)))
        return compile_one(self, name, defines)

    monkeypatch.setattr(ShaderLoader, "_compile", record)
    monkeypatch.setattr(gl, "shaders", ShaderLoader(gl.ctx))
    # Linking is enough: llvmpipe compiles at the first draw.
    monkeypatch.setattr(Painter, "draw", lambda self, uniforms, item: None)
    world = scene_of(config, width=8, height=6)
    fields = [name for name, label in LABELS.items() if label.buffer]
    t = 100_000_000
    with Renderer(gl, world, RenderConfig(antialiasing="ssaa2", image_antialiasing="ssaa4")) as renderer:
        renderer.luminance(t), renderer.colour(t), renderer.velocity(t), renderer.velocity(t, 4)
        with Renderer(gl, world, RenderConfig(antialiasing="taps4")) as tapped:
            tapped.luminance(t, rate=True)
        with Renderer(gl, world, RenderConfig(antialiasing="edges")) as edged:
            edged.luminance(t, rate=True)
        renderer.luminance(t, rate=True)
        renderer.brightness(t, 4)
        for names in (*([name] for name in fields), fields):
            renderer.labels(t, LabelRequest(*names), t + 10**8, t - 10**8)
    gl.shaders.clear()
    table = {(name, normalised(defines)) for name in PRODUCTION for defines in variants.variants(name)}
    assert asked <= table
    outputs = {
        tuple(pair for pair in defines if pair[0].startswith("OUT_")) for name, defines in asked if name == "label.glsl"
    }
    assert outputs == {
        normalised({k: v for k, v in defines.items() if k.startswith("OUT_")})
        for defines in variants.variants("label.glsl")
    }  # and none that nobody asks for


def sources(folder=None) -> dict[str, str]:
    """SHA-256 of every production program as the compiler gets it."""
    out = {}
    for name in PRODUCTION:
        for defines in variants.variants(name):
            for stage in stages_of(defines):
                out[f"{name} {stage} {normalised(defines)}"] = hashlib.sha256(
                    expand(name, stage, defines, folder).text.encode()
                ).hexdigest()
    return out


def test_production_programs_are_the_same_without_the_debugger(tmp_path, gl, config):
    """Byte for byte, before, during and after it is used, and when neither its shader nor its package is there."""
    here = sources()
    without = copy_shaders(tmp_path)
    (without / "debug.glsl").unlink()
    assert sources(without) == here
    subject = open_subject(config)
    compiled = []
    text = ShaderLoader._compile

    class Recorder(ShaderLoader):
        def _compile(self, name, defines):
            compiled.append((name, normalised(defines)))
            return text(self, name, defines)

    before, gl.shaders = gl.shaders, Recorder(gl.ctx)
    try:
        with DebugRenderer(gl, subject.scene, RenderConfig(image_antialiasing="none")) as renderer:
            made = GpuMoment(renderer, moment(subject), 1e-3)
            for name in buffers_of(subject.scene):
                made[name]
        gl.shaders.clear()
    finally:
        gl.shaders = before
    shown = {(name, normalised(d)) for name in PRODUCTION for d in variants.lookups(name)}
    own = {entry for entry in compiled if entry[0] == "debug.glsl" or entry in shown}
    assert {name for name, _ in own} == {"debug.glsl", "colour.glsl", "luminance.glsl"}

    def of_all_labels(name, defines):
        """The key of a variant, whatever labels are drawn: the table has them alone and all at once."""
        return name, tuple(pair for pair in normalised(defines) if not pair[0].startswith("OUT_"))

    table = {of_all_labels(name, d) for name in PRODUCTION for d in variants.variants(name)}
    assert {of_all_labels(name, dict(d)) for name, d in set(compiled) - own} <= table
    assert sources() == here


def test_generation_runs_where_the_debugger_does_not_exist(config, tmp_path):
    """In a process in which blinkgl.tools cannot be imported and debug.glsl cannot be read; no
    program but production's is compiled."""
    code = f"""
import hashlib, json, sys
sys.modules["blinkgl.tools"] = None
import blinkgl.gl.shader as shader
expand, seen = shader.expand, {{}}
def recorded(name, stage, defines=None, folder=None):
    assert name != "debug.glsl"
    source = expand(name, stage, defines, folder)
    digest = hashlib.sha256(source.text.encode()).hexdigest()
    seen[f"{{name}} {{stage}} {{shader.normalised(defines)}}"] = name, stage, dict(defines or {{}}), digest
    return source
shader.expand = recorded
from blinkgl.config.sequence import load_run
from blinkgl.dataset.generate import generate_run
template = load_run({config!r}, ["camera.width=32", "camera.height=24", "time.duration=0.1"])
list(generate_run(template, {str(tmp_path / "out")!r}, 1))
assert not [m for m in sys.modules if m.startswith("blinkgl.tools.")]
print(json.dumps(seen))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert len(seen) >= 10
    for key, (name, stage, defines, digest) in seen.items():
        assert hashlib.sha256(expand(name, stage, defines).text.encode()).hexdigest() == digest, key


# ------------------------------------------------------------------------------------------------- what does not


def test_an_error_is_shown_at_its_own_line_through_the_includes(shader, shaders):
    edit(
        shaders / "include/displacement.glsl",
        "    float w_next = 1.0 / INVERSE_DEPTH + d.z;",
        "    float w_next = depht / INVERSE_DEPTH + d.z;",
    )
    line = next(
        i
        for i, text in enumerate((shaders / "include/displacement.glsl").read_text().splitlines(), 1)
        if "depht" in text
    )
    status, out, err = shader("check", shaders / "include/displacement.glsl", "--shaders", shaders)
    assert status == 1 and err == ""
    lines = out.splitlines()
    first = next(i for i, text in enumerate(lines) if "depht" in text)
    assert lines[first].startswith(f"include/displacement.glsl:{line}:20: error: ") and "fragment stage" in lines[first]
    shown = next(i for i, text in enumerate(lines) if text.startswith(">"))
    assert "float w_next = depht" in lines[shown]
    assert lines[shown + 1].index("^") == lines[shown].index("depht")
    assert "in 70 of 140 variants of label.glsl" in out  # those with a flow


def test_a_link_error_is_shown_at_the_declaration(shader, shaders):
    edit(shaders / "include/vertex.glsl", "out vec3 local;", "out vec4 local;")
    edit(shaders / "include/vertex.glsl", "local = position;", "local = vec4(position, 1.0);")
    status, out, _ = shader("check", "label.glsl", "--shaders", shaders, "--json")
    errors = json.loads(out)["errors"]
    assert status == 1 and errors and all(e["file"] == "include/vertex.glsl" and "local" in e["text"] for e in errors)
    declared = (shaders / "include/vertex.glsl").read_text().splitlines()[errors[0]["line"] - 1]
    assert declared in ("in vec3 local;", "out vec4 local;") and "^" in errors[0]["excerpt"]


def test_unused_varyings_uniforms_and_attributes_are_listed(shader, shaders):
    edit(shaders / "include/vertex.glsl", "out vec2 uv;", "out vec2 uv;\nout float left_over;\nuniform float spare;")
    edit(shaders / "include/vertex.glsl", "    uv = in_uv;", "    uv = in_uv;\n    left_over = 1.0;")
    edit(shaders / "luminance.glsl", "    vec2 uv = within_reach(uv); // hides the varying\n", "")
    edit(shaders / "luminance.glsl", "luminance = texture(albedo, uv).CHANNELS;", "luminance = ALBEDO(0.5);")
    edit(shaders / "include/light.glsl", "light_strength.y * (0.5", "0.0 * light_strength.y * (0.5")
    status, out, _ = shader("check", "luminance.glsl", "--shaders", shaders)
    assert status == 0
    for words in (
        "uniform 'spare' is never used in 342 of 410",
        "varying 'left_over' is written but the fragment stage does not take it",
        "uniform 'albedo' is never used in 114 of 410",
        "varying 'uv' is never read in 74 of 410",
    ):
        assert words in out, (words, out)
    line = (shaders / "include/vertex.glsl").read_text().splitlines().index("uniform float spare;") + 1
    assert f"include/vertex.glsl:{line}:15: uniform 'spare'" in out


def test_include_cycle_and_missing_include(shader, shaders):
    (shaders / "include/light.glsl").write_text('#include "light.glsl"\n')
    status, out, _ = shader("check", "luminance.glsl", "--shaders", shaders)
    assert status == 1 and "include/light.glsl:1:1: error: include cycle" in out and "^" in out
    (shaders / "include/light.glsl").write_text('\n#include "nothere.glsl"\n')
    status, out, _ = shader("check", "luminance.glsl", "--shaders", shaders)
    assert status == 1 and "include/light.glsl:2:1: error: no such shader file" in out


def test_files_select_programs_and_a_file_elsewhere_brings_its_folder(shader, shaders):
    (shaders / "mine.glsl").write_text(
        "#version 430 core\n#ifdef VERTEX_SHADER\nin vec3 p;\nvoid main() { gl_Position = vec4(p, 1.0); }\n#endif\n"
        "#ifdef FRAGMENT_SHADER\nout vec4 c;\nvoid main() { c = vec4(oops); }\n#endif\n"
    )
    status, out, _ = shader("check", shaders / "mine.glsl")
    assert status == 1 and "mine.glsl:8:24: error" in out
    status, out, _ = shader("check", "cover.glsl", "--json")
    assert status == 0 and set(json.loads(out)["programs"]) == {"downsample.glsl", "gather.glsl"}


@pytest.mark.parametrize(
    "log, expected",
    [
        ("0:12(5): error: `foo' undeclared", (12, "error")),
        ('0(12) : error C1503: undefined variable "foo"', (12, "error")),
        ("ERROR: 0:12: 'foo' : undeclared identifier", (12, "error")),
    ],
)
def test_messages_of_other_drivers(log, expected, tmp_path):
    (tmp_path / "p.glsl").write_text("\n" * 7 + "float a; // nothing\nvoid main() { float x = foo; }\n\n\n\n")
    source = expand("p.glsl", "fragment", {}, tmp_path)
    line = source.text.splitlines().index("void main() { float x = foo; }") + 1
    said = log.replace("12", str(line), 1)
    error = ShaderError("x", log=f"GLSL Compiler failed\n\nfragment_shader\n===============\n{said}")
    found = diagnostics.diagnose(error, {"fragment": source}, tmp_path)[0]
    assert (found.file, found.line, found.column, found.kind, found.stage) == ("p.glsl", 9, 25, "error", "fragment")


# ------------------------------------------------------------------------------------------------- show, preprocessor


def test_show_is_what_the_compiler_gets(shader):
    status, out, _ = shader("show", "label.glsl", "--define", "OUT_VELOCITY=0", "-D", "LIT", "--stage", "fragment")
    assert status == 0 and out == expand("label.glsl", "fragment", {"OUT_VELOCITY": 0, "LIT": 1}).text
    status, out, _ = shader("show", "label.glsl", "-D", "OUT_VELOCITY=0", "--active", "--numbers")
    assert "include/motion.glsl:" in out and "vec2 velocity(" in out and "flow_forward" not in out


@pytest.mark.parametrize("name", [*PRODUCTION, "debug.glsl"])
def test_active_lines_compile_to_the_same_interface(gl, name):
    """The driver's preprocessor is the oracle: what is dropped must not matter to it."""
    for defines in [*(variants.variants(name) + variants.lookups(name))[::7], *variants.lookups(name)[-1:]]:
        text = {stage: expand(name, stage, defines).text for stage in stages_of(defines)}
        kept = {}
        for stage in text:
            version = text[stage].split("\n")[0]
            kept[stage] = (
                "\n".join([version, *(line for _, line in preprocess.active_lines(text[stage], defines=True))]) + "\n"
            )
            assert "#if" not in kept[stage]
        full, bare = (gl.ctx.program(**{f"{stage}_shader": s for stage, s in one.items()}) for one in (text, kept))
        assert sorted(full) == sorted(bare)
        full.release(), bare.release()


@pytest.mark.parametrize(
    "expression, macros, truth",
    [
        ("defined(A) && !defined B", {"A": ""}, True),
        ("A > 2 || B == 1", {"A": "3"}, True),
        ("FACTOR * 2 != 4", {"FACTOR": "2"}, False),
        ("UNKNOWN", {}, False),
        ("X", {"X": "Y", "Y": "7"}, True),
        ("__import__('os')", {}, False),
        ("1 +", {}, False),
        ("1 / 0", {}, False),
        ("09", {}, False),
        ("1.5", {}, False),
        ("!!5 == 1 && !0 == 1", {}, True),
        ("1 - 1 - 1 == -1", {}, True),
        ("A", {"A": ""}, False),
        ("defined A B", {}, False),
    ],
)
def test_conditions(expression, macros, truth):
    assert preprocess.evaluate(expression, macros) is truth


@pytest.mark.parametrize(
    "expression, macros",
    [
        ("9**9**9", {}),
        ("1 << 99999999999", {}),
        ("9" * 100_000, {}),
        ("(" * 5_000 + "1" + ")" * 5_000, {}),
        ("-" * 5_000 + "1", {}),
        ("a", {"a": "a"}),
        ("a", {"a": "b", "b": "a"}),
        ("a0", {f"a{i}": f"a{i + 1} + a{i + 1}" for i in range(60)}),
        ("1 +" * 50_000 + "1", {}),
    ],
)
def test_conditions_that_would_take_for_ever(expression, macros):
    """Powers, shifts, long numbers, deep brackets, macros that name themselves or double at
    each step: read or refused at once."""
    assert preprocess.evaluate(expression, macros) is False


_expressions = st.recursive(
    st.integers(0, 40).map(str) | st.sampled_from(["A", "B", "defined(A)", "defined C"]),
    lambda inner: st.one_of(
        st.tuples(st.sampled_from("+-!"), inner).map(lambda t: f"{t[0]} {t[1]}"),
        inner.map(lambda e: f"({e})"),
        st.tuples(inner, st.sampled_from(["||", "&&", "==", "!=", "<", ">", "<=", ">=", "+", "-", "*"]), inner).map(
            lambda t: f"({t[0]}) {t[1]} ({t[2]})"
        ),
    ),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(_expressions)
def test_conditions_against_the_driver(gl, expression):
    """The driver's preprocessor is the oracle."""
    vertex = "#version 430 core\nvoid main() { gl_Position = vec4(0.0); }\n"
    text = (
        f"#version 430 core\n#define A 3\n#define B (A - 5)\n#if {expression}\nuniform float yes;\n#else\nuniform "
        "float no;\n#endif\nout vec4 c;\nvoid main() { c = vec4(\n#if "
        + expression
        + "\nyes\n#else\nno\n#endif\n); }\n"
    )
    program = gl.ctx.program(vertex_shader=vertex, fragment_shader=text)
    says = "yes" in program
    program.release()
    assert preprocess.evaluate(expression, {"A": "3", "B": "(A - 5)"}) is says


@settings(max_examples=200, deadline=None)
@given(
    st.text(alphabet="01239xXuAB()+-*/%<>&|^!~= \t.'\"\\#defined", max_size=60),
    st.dictionaries(st.sampled_from("AB"), st.text(alphabet="AB12()+<", max_size=12)),
)
def test_conditions_of_any_text_are_answered(expression, macros):
    assert preprocess.evaluate(expression, macros) in (True, False)


def test_else_branches():
    text = (
        "#if 0\na\n#elif 1\nb // c\n#elif 1\nd\n#else\ne\n#endif\n#ifndef X\n#define X 1\nf /* g\nh */ "
        "i\n#endif\n#ifdef X\nj\n#endif\n"
    )
    assert [line.strip() for _, line in preprocess.active_lines(text)] == ["b", "f", "i", "j"]


# ------------------------------------------------------------------------------------------------- time


def test_time_counts_what_is_drawn(shader, config):
    status, out, _ = shader("time", config, "--repeat", 3, "--json")
    result = json.loads(out)
    assert status == 0 and result["repeat"] == 3 and result["width"] == 96
    passes = {p["pass"]: p for p in result["passes"]}
    assert set(passes) == {
        "luminance",
        "colour",
        "labels",
        "occlusion, per direction",
    }  # a uniform timeline needs no velocity
    for p in passes.values():
        assert (
            p["gpu_ms"] > 0
            and 0 <= p["vertex_ms"] <= p["gpu_ms"]
            and p["fragment_ms"] == pytest.approx(p["gpu_ms"] - p["vertex_ms"])
        )
        assert p["triangles"] == sum(v["triangles"] for v in p["variants"]) and p["draws"] == sum(
            v["draws"] for v in p["variants"]
        )
        assert sum(v["fragments"] for v in p["variants"]) == p["fragments"]
        assert 0.3 < p["overdraw"] < 2.5
    assert passes["colour"]["fragments"] == pytest.approx(4 * passes["luminance"]["fragments"], rel=0.05)
    assert {v["variant"] for v in passes["luminance"]["variants"]} == {
        "luminance.glsl TAPS4 STRETCHED TEXTURED LIT",
        "luminance.glsl TAPS4 STRETCHED TEXTURED LIT TWO_SIDED",
        "luminance.glsl LIT",
        "luminance.glsl TWO_SIDED",
    }


class _Recorder:
    """Stands for a GL context: what a stopwatch asks of it, in order. Time stamps count the milliseconds."""

    def __init__(self, is_software: bool):
        self.is_software, self.asked, self.samples, self._stamps = is_software, [], 7, []
        self.ctx = self

    def finish(self):
        self.asked.append("finish")

    def query(self, samples):
        return self

    def __enter__(self):
        self.asked.append("count")

    def __exit__(self, *_):
        self.asked.append("counted")

    def function(self, name, *_):
        def call(*arguments):
            if name == "glQueryCounter":
                self.asked.append("stamp")
                self._stamps.append(1_000_000 * len(self._stamps))
            if name == "glGetQueryObjectui64v":
                arguments[2]._obj.value = self._stamps.pop(0)

        return call


@pytest.mark.parametrize(
    "is_software, expected",
    [
        (True, "finish finish stamp finish count draw counted finish stamp finish finish"),
        (False, "finish stamp count draw counted stamp finish"),
    ],
)
def test_a_stopwatch_waits_around_time_stamps_of_software(is_software, expected):
    """A stamp taken while llvmpipe's threads still draw would miss the rasteriser's work; a
    card must not be waited for in between."""
    gl = _Recorder(is_software)
    watch = timing.Stopwatch(gl)
    watch.start()
    gl.asked.append("draw")
    assert watch.stop() == (1.0, 7)
    assert " ".join(gl.asked) == expected


def test_overdraw_and_the_half_resolution_twin(gl):
    """Two sheets over the whole image, drawn front to back: one fragment a pixel. The twin sees the same directions."""
    scene = scene_of(str(Path(__file__).parent / "sheets.yaml"))
    half = timing.half_scene(scene)
    big, small = scene.camera, half.camera
    assert (big.width, big.height, small.width, small.height) == (64, 48, 32, 24)
    for ray in ((0.3, -0.2), (-0.1, 0.4)):
        for axis, (full, twin) in enumerate(
            (
                ((big.fx, big.cx, big.width), (small.fx, small.cx, small.width)),
                ((big.fy, big.cy, big.height), (small.fy, small.cy, small.height)),
            )
        ):
            at = [(f * ray[axis] + c + 0.5) / n for f, c, n in (full, twin)]  # as a fraction of the image
            assert at[0] == pytest.approx(at[1], abs=1e-12)
    for world, pixels in ((scene, 64 * 48), (half, 32 * 24)):
        with timing.TimedRenderer(gl, world, RenderConfig()) as renderer:
            drawn = renderer.run(lambda r: r.luminance(0), each=False)
            assert drawn.fragments == pixels and drawn.draws == 2 and drawn.triangles == 4


# ------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("passes", "CONFIG", "--out", "TMP", "--pass", "depht"), ["--pass", "depht", "depth"]),
        (("probe", "CONFIG", "--pixel", "96,0"), ["--pixel", "96,0", "X < 96"]),
        (("probe", "CONFIG", "--pixel", "-1,3"), ["--pixel", "0 <= X"]),
        (("probe", "CONFIG", "--pixel", "3"), ["--pixel", "not a pixel"]),
        (("probe", "CONFIG", "--pixel", "3,4", "--time", "9"), ["--time", "9", "0 to 0.4 s"]),
        (("diff", "CONFIG", "--time", "nan"), ["--time", "0 to 0.4 s"]),
        (("diff", "CONFIG", "--step", "0"), ["--step"]),
        (("diff", "CONFIG", "--tolerance", "depth=x"), ["--tolerance", "depth=x"]),
        (("diff", "CONFIG", "--tolerance", "dept=1"), ["--tolerance", "dept", "depth"]),
        (("diff", "CONFIG", "--pass", "triangle"), ["--pass", "triangle"]),
        (("diff", "CONFIG", "--shaders", "/nowhere/shaders"), ["--shaders", "no such shader folder"]),
        (("check", "--shaders", "TMP"), ["--shaders", "no shaders in this folder"]),
        (("check", "--shaders", "CONFIG"), ["--shaders", "not a folder"]),
        (("check", "nothing.glsl"), ["nothing.glsl", "label.glsl"]),
        (("check", "--backend", "vulkan"), ["gl.backend", "vulkan"]),
        (("check", "--device", "97", "--backend", "egl"), ["gl"]),
        (("show", "nothing.glsl"), ["nothing.glsl", "label.glsl"]),
        (("show", "label.glsl", "--stage", "tessellation"), ["--stage", "tessellation"]),
        (("show", "label.glsl", "--define", "2X"), ["2X"]),
        (("probe", "/nowhere.yaml", "--pixel", "1,1"), ["/nowhere.yaml", "no such file"]),
        (("serve", "CONFIG", "--port", "70000"), ["--port"]),
        (("passes", "CONFIG", "--out", "CONFIG"), ["is a file"]),
        (("diff", "CONFIG", "--set", "gl.device=97", "--set", "gl.backend=egl"), ["gl"]),
    ],
)
def test_bad_input_is_one_line_and_2(shader, config, tmp_path, arguments, words):
    arguments = [{"CONFIG": config, "TMP": str(tmp_path)}.get(a, a) for a in arguments]
    status, out, err = shader(*arguments)
    assert (status, out) == (2, "") and err.startswith("error: ") and err.count("\n") == 1, err
    assert all(word in err for word in words), err


def test_unreadable_shader_folder(shader, shaders, monkeypatch):
    import os

    real = os.access
    # Root may read anything.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != shaders and real(path, mode))
    status, _, err = shader("check", "--shaders", shaders)
    assert status == 2 and err.startswith("error: --shaders: shader folder cannot be read") and err.count("\n") == 1


def test_include_cycle_met_while_drawing(shader, config, shaders):
    (shaders / "include/motion.glsl").write_text('#include "motion.glsl"\n')
    status, out, err = shader("diff", config, "--shaders", shaders)
    assert (status, out) == (
        2,
        "",
    ) and err == "error: include/motion.glsl:1: include cycle: include/motion.glsl -> include/motion.glsl\n"


def test_an_older_copy_borrows_the_debug_program(shader, config, shaders):
    (shaders / "debug.glsl").unlink()
    assert shader("diff", config, "--shaders", shaders, "--pass", "depth")[0] == 0
    assert (
        "debug.glsl" in [p.name for p in Path(str(shader_folder())).iterdir()]
        and check._programs([], str(shaders))[1].count("debug.glsl") == 1
    )
    assert open_folder(str(shaders)).path == shaders
