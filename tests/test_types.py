"""What a type checker sees: every public signature says its types, a right program is clean
and a wrong call is an error."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from pinned import only_with_pinned

REPOSITORY = Path(__file__).resolve().parents[1]

PROGRAM = """
from pathlib import Path

import numpy as np

import blinkgl
from blinkgl import Camera, Esim, Events, Keyframes, LabelFrame, Material, Mesh, Primitive, Recording, Renderer, Scene
from blinkgl import Timeline, look_at

flight = Keyframes({0: look_at((-2, -0.3, 0.8), (0, 0, 0)), 0.2: look_at((-2, 0.3, 0.8), (0, 0, 0))})
orange = Material(color=(1, 0.5, 0))
scene = Scene(Camera(32, 24, pose=flight), duration=0.1) + Primitive("cuboid", extents=(1, 1, 2), material=orange)
scene = scene + Mesh(vertices=np.eye(3), faces=[[0, 1, 2]], pose=(0, 0, 1))
uniform = Timeline("uniform", fps=500)
recording: Recording = blinkgl.record(scene, emulator={"emulator": "v2e", "cutoff_hz": 200}, timeline=uniform)
flow: np.ndarray = recording.flow
events: Events = recording.window(0)
emulator = Esim(24, 32, seed=1, contrast_threshold=0.2)
more: Events = emulator.step(np.zeros((24, 32), np.float32), 0)
with Renderer(scene) as renderer:
    frame: LabelFrame = renderer.frame(0.05, ["forward", "depth"], to=0.1)
    picture: np.ndarray = renderer.image(0.05)
blinkgl.write_events(Path("a.h5"), events, 24, 32)
again: Events = blinkgl.read_events("a.h5")
for run in (blinkgl.load("scene.yaml"), scene):
    blinkgl.generate(run, "out", num=2)
problems = blinkgl.verify("out", deep=1).problems
values, valid = blinkgl.read_flow("flow.png")
mean: float = float(np.hypot(values[..., 0], values[..., 1])[valid].mean())

Camera("wide", 24)  # wrong
Scene(camera=3)  # wrong
scene + "cuboid"  # wrong
look_at((0, 0, 0))  # wrong
blinkgl.record(scene, label=["images"])  # wrong
Primitive("cuboid", category="roof")  # wrong
emulator.step([[1, 2]], 0)  # wrong
emulator.step(picture, "now")  # wrong
blinkgl.write_events("a.h5", 3, 24, 32)  # wrong
blinkgl.verify("out", deep="yes")  # wrong
not_events: int = recording.window(0)  # wrong
not_flow: str = recording.flow  # wrong
not_a_frame: int = blinkgl.render_frame(scene, 0.1)  # wrong
not_read: Events = blinkgl.read_flow("flow.png")  # wrong
recording.no_such_thing  # wrong
blinkgl.no_such_name  # wrong
"""


def public_functions(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef | ast.AsyncFunctionDef, bool]]:
    """(function, whether its first parameter is the object or class) of the public functions of
    a module and of its public classes."""
    waiting: list[tuple[list[ast.stmt], bool]] = [(tree.body, False)]
    while waiting:
        body, inside = waiting.pop()
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                waiting.append((node.body, True))
            elif isinstance(node, (ast.If, ast.Try, ast.With)):
                waiting.append((node.body, inside))
            elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and (
                not node.name.startswith("_") or node.name.endswith("__")
            ):
                yield node, inside and not any("staticmethod" in ast.unparse(d) for d in node.decorator_list)


@pytest.mark.parametrize(
    "room", sorted({p.relative_to(REPOSITORY).parts[1] for p in (REPOSITORY / "blinkgl").rglob("*.py")})
)
def test_public_signatures_say_their_types(room):
    place = REPOSITORY / "blinkgl" / room
    bare = []
    for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
        for function, bound in public_functions(ast.parse(file.read_text(encoding="utf-8"))):
            a = function.args
            parameters = [*a.posonlyargs, *a.args][bound:] + [*a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
            bare += [f"{file.name}:{p.lineno} {function.name}({p.arg})" for p in parameters if p.annotation is None]
            if function.returns is None and function.name != "__init__":
                bare.append(f"{file.name}:{function.lineno} {function.name} -> ?")
    assert bare == []


def test_a_users_program_is_checked(tmp_path):
    """Errors at the lines that are wrong and nowhere else: a class that a checker takes for
    Any would be an error nowhere."""
    pytest.importorskip("pyrefly", reason="the extra [dev] is not installed")
    only_with_pinned("numpy", "pyrefly")
    (tmp_path / "program.py").write_text(PROGRAM, encoding="utf-8")
    program = next(file.locate() for file in metadata.files("pyrefly") or () if file.name == "pyrefly")
    command = [
        program,
        "check",
        "--preset",
        "strict",
        "--output-format",
        "json",
        "--python-interpreter-path",
        sys.executable,
        "--search-path",
        REPOSITORY,
        "program.py",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    errors = json.loads(done.stdout)["errors"]
    wrong = {number for number, line in enumerate(PROGRAM.split("\n"), 1) if line.endswith("# wrong")}
    assert done.returncode == 1 and len(wrong) == 16
    assert {e["line"] for e in errors} == wrong, "\n".join(
        f"{e['line']}: {e['description']}" for e in errors if e["line"] not in wrong
    )
