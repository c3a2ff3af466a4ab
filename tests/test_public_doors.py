"""Every parameter of every public function and class is given values that it cannot have: the answer is right, or one
BlinkGLError of one line, never another exception."""

from __future__ import annotations

import inspect

import pytest

import blinkgl


class Wrong:
    def __repr__(self):
        return "Wrong()"


WRONG = (Wrong(), 1 + 2j, "no such", -7, [Wrong()], {}, float("nan"), b"x")
MADE_HERE = {"LabelFrame"}
"""Classes that only BlinkGL makes."""


def _parameters():
    for name in sorted({*blinkgl.__all__} - MADE_HERE):
        door = getattr(blinkgl, name)
        if not callable(door) or (inspect.isclass(door) and issubclass(door, BaseException)):
            continue
        for one in inspect.signature(door).parameters.values():
            if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY):
                yield pytest.param(door, one.name, id=f"{name}-{one.name}")


@pytest.mark.parametrize("door, parameter", [*_parameters()])
def test_a_wrong_value_is_one_line(door, parameter, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    camera = blinkgl.Camera(16, 12)
    scene = blinkgl.Scene(camera, duration=0.1)
    right = {"source": scene, "scene": scene, "camera": camera, "t": 0.05, "height": 12, "width": 16, "out": "out"}
    needed = [one.name for one in inspect.signature(door).parameters.values() if one.default is one.empty]
    for value in WRONG:
        given = {name: right.get(name, Wrong()) for name in needed if name not in ("args", "kwargs", "keys", "changes")}
        try:
            made = door(**{**given, parameter: value})
            if hasattr(made, "__next__"):
                next(made, None)
            if hasattr(made, "close"):
                made.close()
        except blinkgl.BlinkGLError as error:
            assert "\n" not in str(error), (value, str(error))
