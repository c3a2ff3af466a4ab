"""Light and surfaces beside Blender's Cycles at path depth 1, each effect by itself.

``golden/cycles_light.npz`` holds what Cycles of Blender 4.5.15 made of each case: (H, W, 3) float16 linear radiance,
512 to 4,096 paths a pixel. ``tools/cycles_light.py`` makes it where Blender is installed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lit_cases import ROUGHNESSES, cases, graded
from tests.shared_data import shared

with np.load(Path(__file__).parents[1] / "golden" / "cycles_light.npz") as stored:
    GOLDEN = {name: stored[name].astype(np.float32) for name in stored.files}
PANORAMAS = ["city", "park", "warehouse"]


def judged(gl, case, matt: float, metal: float) -> None:
    """The median relative difference of matt surfaces, and of each ball of metal, is below these bounds."""
    error, ids = graded(gl, case, GOLDEN[case.name])
    if not case.name.startswith("metal"):
        assert (ids > 0).sum() > 250 and np.median(error[ids > 0]) < matt, (case.name, float(np.median(error[ids > 0])))
        return
    for k, roughness in enumerate(ROUGHNESSES, start=1):
        on = ids == k
        assert not on.any() or (on.sum() > 40 and np.median(error[on]) < metal), (
            case.name,
            roughness,
            float(np.median(error[on])),
        )


@pytest.mark.parametrize("number", range(len(list(cases(None)))))
def test_an_effect_is_the_path_tracers(gl, number):
    judged(gl, list(cases(None))[number], 0.01, 0.03)


@pytest.mark.parametrize("name", PANORAMAS)
def test_a_panorama_is_the_path_tracers(gl, tmp_path, name):
    """Surroundings are nine harmonics for matt surfaces, and blurred once for metal."""
    (tmp_path / f"{name}.hdr").symlink_to(shared(f"data/assets/hdri/{name}.hdr"))
    for case in list(cases(tmp_path))[len(list(cases(None))) :]:
        judged(gl, case, 0.015, 0.05)
