"""A camera's mathematics is in one place: nobody else asks for a focal length or a principal point."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
READS_OTHERS = {
    "blinkgl/scene/worlds/from_file.py",  # pyrender's cameras have such names
}


def test_only_the_room_of_the_cameras_asks_for_focal_lengths():
    asking = set()
    for path in (*(ROOT / "blinkgl").rglob("*.py"), *(ROOT / "tools" / "shader_debugger").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(n, ast.Attribute) and n.attr in ("fx", "fy", "cx", "cy") for n in ast.walk(tree)):
            asking.add(name)
    assert {name for name in asking if not name.startswith("blinkgl/camera/")} == READS_OTHERS
