"""What an edit of the code does to ``--resume``: exactly the code that a sequence is made with ends a run."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from blinkgl.dataset import work

ROOT = Path(__file__).parents[2]
HARMLESS = {"annotated_types", "glcontext", "moderngl", "pydantic", "pydantic_core"}
"""Libraries that check values, or call the driver, whose name and version are compared themselves."""
SOMETIMES = {"mujoco", "torch"}
"""Libraries that some recipes use; their versions are added by those."""
MODULES = {"cv2": "opencv", "PIL": "pillow", "fcl": "python-fcl", "yaml": "PyYAML", "skimage": "scikit-image"}


def file_of(name: str) -> Path | None:
    path = ROOT.joinpath(*name.split("."))
    return next((p for p in (path / "__init__.py", path.with_suffix(".py")) if p.is_file()), None)


def imported(path: Path) -> set[str]:
    """Names that a module imports, inside functions, too, but for annotations."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    apart = {
        id(inside)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for inside in ast.walk(node)
    }
    names = set()
    for node in ast.walk(tree):
        if id(node) in apart:
            continue
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
    return names


def walked(first: str) -> tuple[set[Path], set[str]]:
    """The files of the package that ``first`` leads to, and the other libraries."""
    waiting, seen, others = {first}, {}, set()
    while waiting:
        name = waiting.pop()
        seen[name] = path = file_of(name)
        parents = {name.rsplit(".", n)[0] for n in range(1, name.count(".") + 1)}
        for other in imported(path) | parents:
            if not other.startswith("blinkgl"):
                others.add(other.partition(".")[0])
            elif other not in seen and file_of(other):
                waiting.add(other)
    return set(seen.values()), others - sys.stdlib_module_names


def test_the_list_is_what_a_sequence_imports():
    files, others = walked("blinkgl.dataset.generate")
    used = {p.relative_to(ROOT / "blinkgl").as_posix() for p in files} - {"__init__.py"}
    rooms = {name for name in work.MAKES_BYTES if not name.endswith(".py")}
    assert {n for n in used if n.split("/")[0] not in rooms} == set(work.MAKES_BYTES) - rooms
    assert {n.split("/")[0] for n in used} >= rooms
    needed = {MODULES.get(name, name) for name in others - HARMLESS - SOMETIMES}
    assert needed <= {*work.NUMERICS, "opencv"}


ENDS = "camera config dataset events gl imaging io labels machine recordings render scene sequence sequence_files"
ENDS += " tensors timeline types shaders configs/emulators configs/quality configs/rigs configs/sensors"
GOES_ON = "blender front layouts online report show viewer tools docs eflow configs/scenes configs/eflow"


def test_the_table_has_every_room():
    rooms = {p.parent.name for p in (ROOT / "blinkgl").glob("*/__init__.py")}
    assert rooms <= {*ENDS.split(), *GOES_ON.split()}
    folders = {p.relative_to(ROOT).as_posix() for p in (ROOT / "configs").iterdir() if any(p.glob("*.yaml"))}
    assert folders - {"configs/trade"} <= {*ENDS.split(), *GOES_ON.split()}


@pytest.fixture(scope="module")
def edited(tmp_path_factory) -> dict[str, list[str]]:
    """Room -> the entries of the run's record that an edit of one of its files changes, in a copy of the code."""
    copy = tmp_path_factory.mktemp("code")
    ignored = shutil.ignore_patterns("__pycache__", "weights", "*.glb", "*.png")
    for folder in ("blinkgl", "eflow"):
        shutil.copytree(ROOT / folder, copy / folder, ignore=ignored)
    for folder in ("shaders", "configs", "docs", "tools"):
        shutil.copytree(ROOT / folder, copy / "blinkgl" / folder, ignore=ignored)
    (copy / "blinkgl/docs/__init__.py").write_text("")
    (copy / "ask.py").write_text(
        "import sys, yaml\n"
        "from pathlib import Path\n"
        "from blinkgl.dataset import work\n"
        "assert Path(work.__file__).is_relative_to(Path(__file__).parent)\n"
        "before, found = work._code(), {}\n"
        "for room in sys.argv[1:]:\n"
        "    place = Path(__file__).parent / ('' if room == 'eflow' else 'blinkgl') / room\n"
        "    endings = ('.glsl',) if room == 'shaders' else ('.yaml',) if 'configs' in room else ('.py',)\n"
        "    file = place if place.is_file() else sorted(p for p in place.rglob('*') if p.suffix in endings)[0]\n"
        "    text = file.read_text()\n"
        "    file.write_text(text + '\\n# a comment\\n')\n"
        "    work._code.cache_clear()\n"
        "    found[room] = [k for k, v in work._code().items() if before.get(k) != v]\n"
        "    file.write_text(text)\n"
        "print(yaml.safe_dump(found))\n"
    )
    rooms = [*ENDS.split(), *GOES_ON.split(), "cli.py", "dataset/verify.py", "show/doctor.py", "errors.py"]
    environment = {k: v for k, v in os.environ.items() if k != "BLINKGL_BUILD"}
    done = subprocess.run(
        [sys.executable, str(copy / "ask.py"), *rooms],
        cwd=copy,
        env={**environment, "PYTHONPATH": str(copy)},
        capture_output=True,
        text=True,
        check=True,
    )
    return yaml.safe_load(done.stdout)


def test_an_edit_of_each_room(edited):
    ends = {
        room: [f"code of {room if room.startswith(('shaders', 'configs')) else 'blinkgl/' + room}"]
        for room in ENDS.split()
    }
    goes_on = {room: [] for room in (*GOES_ON.split(), "cli.py", "dataset/verify.py", "show/doctor.py")}
    assert edited == {**ends, **goes_on, "errors.py": ["code of blinkgl"]}
