"""Colours that tell things apart do so for colour-blind readers: distances in CIELAB of what they see, by the matrices
of Machado, Oliveira and Fernandes (2009, severity 1) on linear sRGB."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from blinkgl.report import calibration
from blinkgl.show import compare
from blinkgl.viewer import page, stage

SEEN = {
    "everybody": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
JUST = 2.3
"""A difference that is just noticeable (Mahy et al. 1994)."""
STYLE = Path(page.__file__).parents[1] / "report/templates/style.css"

PALETTES = {
    "the report's stacks": re.findall(r"--s\d: (#\w{6})", STYLE.read_text(encoding="utf-8")),
    "the calibration's curves": list(calibration._COLOURS.values()),
    "the comparison's curves": [compare._A, compare._B],
    "the viewer's axes": list(page.XYZ),
    "ON and OFF": ["#" + bytes(colour).hex() for colour in (stage.ON, stage.OFF)],
}


def lab(colour: str, matrix) -> np.ndarray:
    """CIELAB (D65) of a colour as it is seen."""
    coded = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = to_xyz @ np.clip(np.asarray(matrix) @ linear, 0, 1) / (0.9505, 1, 1.089)
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("eyes", SEEN)
@pytest.mark.parametrize("palette", PALETTES)
def test_colours_of_a_picture_differ_by_five_steps(palette, eyes):
    seen = {colour: lab(colour, SEEN[eyes]) for colour in PALETTES[palette]}
    assert len(seen) >= 2
    for (a, one), (b, other) in itertools.combinations(seen.items(), 2):
        assert np.linalg.norm(one - other) > 5 * JUST, (a, b)
