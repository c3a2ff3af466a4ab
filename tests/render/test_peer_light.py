"""Light and surfaces beside Blender's Cycles at path depth 1, each effect by itself."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from blinkgl.blender import process
from blinkgl.config.images import LensConfig
from blinkgl.scene.types import Fog
from blinkgl.trade.cycles import KEYS, CyclesSettings, export
from lit_cases import ROUGHNESSES, cases, compared, relative
from tests.shared_data import shared

NUMBER = len(list(cases(None)))
MATT, ROUGH, SMOOTH = 128, 256, 1536
"""Paths a pixel: what mirrors finds a hall's lamps by chance."""


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


def test_fog_lens_and_exposure_are_handed_over(tmp_path):
    """As the worker reads them: poses of all that moves and of the camera, at both ends of the exposure and between."""
    by_name = {case.name: case.scene for case in cases(None)}
    scene = replace(by_name["motion blur"], fog=Fog(0.1, 0.5))
    settings = CyclesSettings(lens=LensConfig(aperture=0.2, focus=4.0), exposure_ns=scene.t1_ns)
    export(scene, [0], settings, tmp_path)
    job = json.loads((tmp_path / "job.json").read_text())
    assert job["fog"] == [0.1, 0.5] and job["lens"] == [0.2, 4.0]
    with np.load(tmp_path / "job.npz", allow_pickle=False) as arrays:
        exposed, origin = arrays["exposed"], scene.camera_path.pose(0)[:3, 3]
        assert exposed.shape == (len(scene.objects) + 1, 1, KEYS, 4, 4)
        np.testing.assert_allclose(exposed[:-1, 0, 0], arrays["poses"][:, 0])
        np.testing.assert_allclose(exposed[-1, 0, 0], arrays["camera_poses"][0])
    for k, thing in enumerate(scene.objects):
        np.testing.assert_allclose(exposed[k, 0, -1, :3, 3], thing.path.pose(scene.t1_ns)[:3, 3] - origin, atol=1e-9)
    assert np.abs(exposed[1, 0, -1] - exposed[1, 0, 0]).max() > 0.3 and not np.ptp(exposed[0, 0], axis=0).any()
    export(by_name["fog"], [0], CyclesSettings(), tmp_path)
    with np.load(tmp_path / "job.npz", allow_pickle=False) as arrays:
        assert "exposed" not in arrays.files and json.loads((tmp_path / "job.json").read_text())["lens"] is None


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
    """Matt surfaces and metal, by the same bounds and by what paths leave of noise."""
    (tmp_path / f"{name}.hdr").symlink_to(shared(f"data/assets/hdri/{name}.hdr"))
    for case in list(cases(tmp_path))[NUMBER:]:
        judged_twice(gl, case)


def judged(gl, case):
    shiny = case.name.startswith("metal")
    ours, theirs, graded, true = compared(gl, case, 512 if case.images else 256 if shiny else 32)
    error = relative(ours, theirs)
    if not shiny:
        assert graded.sum() > 1000 and np.median(error[graded]) < 0.01, case.name
        return
    for k in range(len(ROUGHNESSES)):
        on = graded & (true.instance == k + 1)
        assert not on.any() or (on.sum() > 200 and np.median(error[on]) < 0.03), (case.name, ROUGHNESSES[k])


def judged_twice(gl, case):
    """By two pictures of other paths, whose mean is what is asked for: half their difference is that mean's noise, and
    of an error b under noise of a median m the median is at most hypot(b, m). Means over blocks of pixels have less
    noise, and as much of an error that neighbours share."""
    shiny = case.name.startswith("metal")
    bound, side, paths = (0.03, 2, ROUGH) if shiny else (0.01, 4, MATT)
    if shiny and any(part.material.gloss.roughness < 0.3 for body in case.scene.objects for part in body.parts):
        paths = SMOOTH
    ours, one, graded, true = compared(gl, case, paths, seed=1)
    _, other, _, _ = compared(gl, case, paths, seed=2)
    bodies = [graded & (true.instance == k + 1) for k in range(len(ROUGHNESSES))] if shiny else [graded]
    for k, on in enumerate(bodies):
        if not on.any():
            continue
        whole = blocks(on, side) == 1.0
        a, b, c = (blocks(picture, side)[whole][None] for picture in (ours, one, other))
        mean = (b + c) / 2
        error, noise = (float(np.median(relative(picture, mean))) for picture in (a, b))
        about = case.name, ROUGHNESSES[k] if shiny else None, error, noise
        assert whole.sum() > 40 and noise < bound, about  # else nothing would be said
        assert error < np.hypot(bound, noise), about


def blocks(picture, side):
    """Means over squares of pixels."""
    height, width = (n // side * side for n in picture.shape[:2])
    cut = picture[:height, :width].astype(np.float64)
    return cut.reshape(height // side, side, width // side, side, *picture.shape[2:]).mean(axis=(1, 3))
