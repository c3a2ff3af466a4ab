"""Frames go through an emulator in one place: whoever makes an emulator of his own forgets the
read-out, or the frame that a path lags."""

import ast
from pathlib import Path

from sources import parsed

ROOT = Path(__file__).parents[2]
KERNELS_ALONE = {"tools/bench.py", "tools/draws.py"}
THE_DOOR = {"blinkgl/front/sensors.py"}  # hands an emulator to a person who steps it
OWN = {
    "make_emulator": {"blinkgl/events/camera.py", "blinkgl/events/table.py", "blinkgl/events/__init__.py"}
    | {"blinkgl/tensors/choice.py"}
    | KERNELS_ALONE
    | THE_DOOR,
    "Readout": {"blinkgl/events/camera.py", "tools/draws.py"},
    "make_timeline": {"blinkgl/sequence/rendered.py", "blinkgl/timeline/__init__.py"},
}


def test_nobody_else_makes_an_emulator_a_read_out_or_a_timeline():
    users: dict[str, set[str]] = {name: set() for name in OWN}
    for path, nodes in parsed("blinkgl", "tools", "eflow", "examples", words=tuple(OWN)):
        for node in nodes:
            names = (
                [a.name for a in node.names]
                if isinstance(node, ast.ImportFrom)
                else [node.attr]
                if isinstance(node, ast.Attribute)
                else []
            )
            for name in names:
                if name in users:
                    users[name].add(path)
    assert {name: files - OWN[name] for name, files in users.items()} == {name: set() for name in OWN}
    assert users["Readout"] and users["make_timeline"], "the look finds what is there"
