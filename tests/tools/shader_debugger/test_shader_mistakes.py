"""`shader diff` behind a lens, in soft shadows, of skins, of silhouettes and in fog: right shaders pass, and mistakes
that nobody had thought of when the debugger was written are caught and named."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from debugger_scene import edit

from blinkgl.gl import ShaderLoader
from blinkgl.tools.shader_debugger import compare, moments
from blinkgl.tools.shader_debugger.compare import as_text, verdict
from blinkgl.tools.shader_debugger.session import moment, open_renderer, open_subject
from tests.scene.gltf_files import arm_file

EQUIDISTANT = ("camera.lens=equidistant", "camera.distortion=[-0.1, 0.05, 0.01, 0.0]")


class Judge:
    """One moment, whose reference is computed once."""

    def __init__(self, path: str, overrides: tuple[str, ...]):
        subject = open_subject(path, overrides=overrides)
        self.when = moment(subject)
        self._context = open_renderer(subject)
        self.renderer = self._context.__enter__()
        self.reference = moments.open_reference(subject, self.when, self.renderer.maps)
        self.shipped = self.renderer.gl.shaders

    def close(self) -> None:
        self._context.__exit__(None, None, None)

    def found(self, folder: Path | None = None) -> dict:
        """The verdict on the shaders of a folder, up to the first buffer that is wrong; None: on those that ship."""
        self.renderer.gl.make_current()
        # OpenGL's objects outlive Python's: the programs of the judge before would stay until the context ends.
        if self.renderer.gl.shaders is not self.shipped:
            self.renderer.gl.shaders.clear()
        self.renderer.use_shaders(ShaderLoader(self.renderer.gl.ctx, folder) if folder else self.shipped)
        gpu = moments.GpuMoment(self.renderer, self.when)
        comparison = compare.Comparison(gpu, self.reference)
        reports = []
        for name in comparison.names():
            reports.append(comparison.report(name))
            if not reports[-1].passed:
                break
        return verdict(reports, self.renderer.unused)


@pytest.fixture(scope="module")
def judges(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seen")
    (folder / "arm.glb").write_bytes(arm_file(morphs=True).glb())
    shutil.copy(Path(__file__).with_name("seen.yaml"), folder)
    path = str(folder / "seen.yaml")
    both = {"radtan": Judge(path, ()), "equidistant": Judge(path, EQUIDISTANT)}
    yield both
    for judge in both.values():
        judge.close()


@pytest.mark.parametrize("lens", ["radtan", "equidistant"])
def test_right_shaders_pass_behind_a_lens(judges, lens):
    found = judges[lens].found()
    assert found["passed"], as_text(found)


@pytest.mark.parametrize("name", ["fast_rotation", "grazing"])
def test_right_shaders_pass_at_an_odd_size(shader, name):
    """Mip levels of these were outside of a fixed tolerance, and inside of what OpenGL allows."""
    size = ("--set", "camera.width=33", "--set", "camera.height=47")
    status, out, _ = shader("diff", f"configs/trade/{name}.yaml", *size)
    assert status == 0, out
    assert re.search(r"all \d+ buffers agree with the reference; not graded: up to \d+ of 1551 px", out)


LENS, SHADOWS, SKIN = (f"include/{name}.glsl" for name in ("lens", "shadows", "deform/skin"))
MISTAKES = {
    # name: (lens, file, right, wrong, title of the first buffer that is wrong, words of the verdict)
    "radial term counted once": ("radtan", LENS, "2.0 * u.x * u.x * slope", "u.x * u.x * slope", "velocity", LENS),
    "tangential terms exchanged": (
        "radtan",
        "include/lens_far.glsl",
        "2.0 * product * vec2(lens_k[2], lens_k[3])",
        "2.0 * product * vec2(lens_k[3], lens_k[2])",
        "forward flow",
        "",
    ),
    "slope of the angle left out": (
        "equidistant",
        LENS,
        "lens_g_rate(t) / (1.0 + r * r)",
        "lens_g_rate(t)",
        "velocity",
        LENS,
    ),
    "pixel's corner for its centre": (
        "radtan",
        "gather.glsl",
        "at.x / float(COLUMNS) - 0.5",
        "at.x / float(COLUMNS)",
        "luminance, lens",
        "",
    ),
    "radius for diameter": (
        "radtan",
        SHADOWS,
        "clamp(0.5 * width / texel",
        "clamp(width / texel",
        "shadow factor",
        "include/shadows.glsl",
    ),
    "one tap too few": (
        "radtan",
        SHADOWS,
        "i < taps; ++i",
        "i < taps - 1; ++i",
        "shadow factor",
        "include/shadows.glsl",
    ),
    "blocker seen from itself": (
        "radtan",
        SHADOWS,
        "max(blocker / at.z - 1.0, 0.0)",
        "max(1.0 - at.z / blocker, 0.0)",
        "shadow factor",
        "include/shadows.glsl",
    ),
    "matrix of the map transposed": (
        "radtan",
        "include/vertex.glsl",
        "vec4(position, 1.0) * shadow_rows[i]",
        "shadow_rows[i] * vec4(position, 1.0)",
        "shadow factor",
        "include/shadows.glsl",
    ),
    "the next joint": ("radtan", SKIN, "int(joint + 0.5)", "int(joint + 1.5)", "local position", "arm"),
    "normal by a wrong cofactor": (
        "radtan",
        SKIN,
        "return vec3(dot(cross(b, c), m), dot(cross(c, a), m), dot(cross(a, b), m));",
        "return vec3(dot(cross(b, c), m), dot(cross(a, c), m), dot(cross(a, b), m));",
        "normals",
        "arm",
    ),
    "corners weigh as sides do": (
        "radtan",
        "edges.glsl",
        "DIAGONAL = 0.25",
        "DIAGONAL = 1.0",
        "luminance, edges",
        "",
    ),
    "fog of the depth": (
        "radtan",
        "include/fog.glsl",
        "exp(-fog.x * fog_ray_length() / gl_FragCoord.w)",
        "exp(-fog.x / gl_FragCoord.w)",
        "luminance (",
        "fog",
    ),
    "fog of the square": (
        "radtan",
        "include/fog.glsl",
        "exp(-fog.x * fog_ray_length() / gl_FragCoord.w)",
        "exp(-pow(fog.x * fog_ray_length() / gl_FragCoord.w, 2.0))",
        "luminance (",
        "",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_caught_and_named(judges, shaders, mistake):
    lens, file, right, wrong, title, words = MISTAKES[mistake]
    edit(shaders / file, right, wrong)
    found = judges[lens].found(shaders)
    text = as_text(found)
    assert not found["passed"]
    assert any(line.startswith(f"The first that is wrong: {title}") for line in text), text
    assert words in "\n".join(text[:2]), text
