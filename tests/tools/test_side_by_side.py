"""tools/side_by_side.py: ten kinds of files, drawn by BlinkGL and by pyrender."""

from __future__ import annotations

from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from blinkgl.tools import side_by_side


@pytest.mark.skipif(find_spec("pyrender") is None, reason="needs the extra pyrender")
def test_ten_kinds_have_the_outlines_of_pyrender(tmp_path, capsys):
    assert side_by_side.main(str(tmp_path / "sheet.png")) == 0
    assert capsys.readouterr().out.count("% of the pixels differ") == 10
    sheet, size = cv2.imread(str(tmp_path / "sheet.png")).astype(int), side_by_side.SIZE
    drawn = (np.abs(sheet - sheet[0, 0]).max(axis=2) > 8).reshape(2, 2, size, 5, size)
    ours, theirs = drawn[:, 0].swapaxes(1, 2), drawn[:, 1].swapaxes(1, 2)
    assert (ours != theirs).mean(axis=(2, 3)).max() < 0.005 and (ours.mean(axis=(2, 3)) > 0.15).all()
