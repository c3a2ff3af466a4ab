"""A camera's mathematics is in one place: nobody else asks for a focal length or a principal point."""

import ast

from sources import parsed


def test_only_the_room_of_the_cameras_asks_for_focal_lengths():
    names = ("fx", "fy", "cx", "cy")
    asking = {
        path
        for path, nodes in parsed("blinkgl", "blinkgl/shader_debugger", words=tuple(f".{name}" for name in names))
        if any(isinstance(n, ast.Attribute) and n.attr in names for n in nodes)
    }
    assert not {name for name in asking if not name.startswith("blinkgl/camera/")}
