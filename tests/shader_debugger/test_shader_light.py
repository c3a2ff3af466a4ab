"""The shader debugger takes light apart: shadow maps, lamps, their shadows, the environment, what is mirrored,
emission; and a mistake in any of them is named by the first term that is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from blinkgl.gl import ShaderLoader
from blinkgl.shader_debugger import compare, moments, session
from blinkgl.shader_debugger.session import moment, open_renderer, open_subject
from debugger_scene import edit

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
