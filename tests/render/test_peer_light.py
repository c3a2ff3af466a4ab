"""Light and surfaces beside Blender's Cycles at path depth 1, each effect by itself."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from blinkgl.blender import process
from blinkgl.errors import BlinkGLError
from blinkgl.scene.types import Fog
from blinkgl.tools.peer_cycles import CyclesSettings, export
from blinkgl.tools.peer_light import ROUGHNESSES, cases, compared
from tests.shared_data import shared

NUMBER = len(list(cases(None)))


def test_every_surface_is_handed_over(tmp_path):
    """What the worker reads of maps, masks and colours: one of each, and the texture that it names."""
    for case in cases(None):
        export(case.scene, [0], CyclesSettings(1, shadows=case.shadows, occlusion=False, bounces=0), tmp_path)
        materials = json.loads((tmp_path / "job.json").read_text())["materials"]
        with np.load(tmp_path / "job.npz", allow_pickle=False) as arrays:
            named = {m[key] for m in materials for key in ("texture", "bumps", "alpha")} - {None}
            assert all(f"texture{k}" in arrays.files for k in named)
            assert any(m["tinted"] for m in materials) == any(name.startswith("colours") for name in arrays.files)
        if case.name == "normal map":
            assert sum(m["bumps"] is not None for m in materials) == 3
        if case.name == "holes":
            assert {m["threshold"] for m in materials} == {None, 0.5}
        if case.name.startswith("metal"):
            assert {m["gloss"][1] for m in materials} <= set(ROUGHNESSES)


def test_fog_is_refused_in_one_line(tmp_path):
    scene = replace(next(cases(None)).scene, fog=Fog(0.1, 0.5))
    with pytest.raises(BlinkGLError, match=r"^scene\.fog: the path tracer knows no fog; expected a scene without fog$"):
        export(scene, [0], CyclesSettings(), tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(bool(process.available()), reason=process.available() or "there")
@pytest.mark.parametrize("number", range(NUMBER))
def test_an_effect_is_the_path_tracers(gl, number):
    """Median relative difference: 1 % of matt surfaces, 3 % of each ball of metal, whose paths are noisy."""
    judged(gl, list(cases(None))[number])


@pytest.mark.slow
@pytest.mark.skipif(bool(process.available()), reason=process.available() or "there")
@pytest.mark.parametrize("name", ["city", "park", "warehouse"])
def test_a_panorama_is_the_path_tracers(gl, tmp_path, name):
    """Matt surfaces and metal, by the same bounds."""
    (tmp_path / f"{name}.hdr").symlink_to(shared(f"data/assets/hdri/{name}.hdr"))
    for case in list(cases(tmp_path))[NUMBER:]:
        judged(gl, case)


def judged(gl, case):
    shiny = case.name.startswith("metal")
    ours, theirs, graded, true = compared(gl, case, 256 if shiny else 32)
    error = np.abs(theirs - ours).mean(axis=2) / (theirs.mean(axis=2) + 0.01)
    if not shiny:
        assert graded.sum() > 1000 and np.median(error[graded]) < 0.01, case.name
        return
    for k in range(len(ROUGHNESSES)):
        on = graded & (true.instance == k + 1)
        assert not on.any() or (on.sum() > 200 and np.median(error[on]) < 0.03), (case.name, ROUGHNESSES[k])
