"""The house, as docs/architecture.md draws it: every room says what it is for."""

from __future__ import annotations

import ast
import graphlib
import importlib
import inspect
import re
from collections.abc import Sequence
from pathlib import Path

import pytest

from blinkgl.tools import draws

ROOT = Path(__file__).parents[1]
ROOMS = sorted(
    p.parent
    for folder in ("blinkgl", "eflow", "shaders", "configs", "tools")
    for p in (ROOT / folder).rglob("__init__.py")
    if p.parent != ROOT / "blinkgl"
)


@pytest.mark.parametrize("room", ROOMS, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_a_room_says_what_comes_in_what_goes_out_and_where_to_start(room):
    said = ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8"))) or ""
    lines = dict(re.findall(r"^(In|Out|Start):\s+(.+)$", said, re.M))
    assert list(lines) == ["In", "Out", "Start"], f"{room}/__init__.py: one line each of 'In:', 'Out:', 'Start:'"
    named = re.findall(r"\b[\w/]+\.(?:py|glsl|yaml)\b", lines["Start"])
    assert named, "a file to start with"
    for name in named:
        assert (room / name).is_file(), name


def test_every_room_is_installed():
    """setup.cfg names packages one by one; a forgotten one is missing from the wheel only."""
    text = (ROOT / "setup.cfg").read_text(encoding="utf-8")
    named = set(re.search(r"\npackages =\n((?:    .+\n)+)", text).group(1).split())
    here = {p.relative_to(ROOT).as_posix().replace("/", ".") for p in ROOMS}
    assert named == {"blinkgl", "blinkgl.docs", "blinkgl.docs.decisions"} | {
        name if name.startswith(("blinkgl", "eflow")) else f"blinkgl.{name}" for name in here
    }


FLOORS = (
    "version errors rng srgb types camera gl machine",
    "config",
    "io events",
    "labels scene timeline tensors",
    "render sequence_files blender",
    "imaging recordings",
    "sequence",
    "dataset",
    "layouts online report",
    "trade front eflow viewer",
    "show shader_debugger",
    "cli cli_examples cli_recordings __main__ tools",
)
"""From the ground up. ``import blinkgl`` itself fetches its names when they are first used."""


def names_imported(path: Path) -> set[str]:
    """Dotted names that a module imports, at its top, inside a function, or for annotations alone."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{name.name}" for name in node.names}
    return names


def test_no_file_imports_itself_by_way_of_others():
    files = {}
    for path in (p for folder in ("blinkgl", "eflow", "tools") for p in (ROOT / folder).rglob("*.py")):
        name = path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
        files[f"blinkgl.{name}" if name.startswith("tools") else name] = path
    arrows = {}
    for name, path in files.items():
        there = {other if other in files else other.rpartition(".")[0] for other in names_imported(path)}
        arrows[name] = (there & files.keys()) - {name}
    graphlib.TopologicalSorter(arrows).prepare()  # raises CycleError, which names the circle


def room_of(parts: Sequence[str]) -> str:
    """The room of a dotted name or a file: shipped packages of tools/ are rooms of their own."""
    first, second = ([*parts, ""][parts[0] == "blinkgl" :] + [""])[:2]
    return second if first == "tools" and second in SHIPPED_TOOLS else first


SHIPPED_TOOLS = ("shader_debugger", "trade")


def test_imports_lead_down():
    """Of every module, wherever the import stands: to the same floor or further down, and never in a circle."""
    floor = {room: k for k, rooms in enumerate(FLOORS) for room in rooms.split()}
    arrows: dict[str, set[str]] = {room: set() for room in floor}
    upwards = []
    for folder in ("blinkgl", "eflow", "tools"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            room = room_of(path.relative_to(ROOT).with_suffix("").parts)
            if room == "__init__":
                continue
            there = {room_of(name.split(".")) for name in names_imported(path)} & floor.keys() - {room}
            arrows[room] |= there
            upwards += [f"{path.relative_to(ROOT)} imports {other}" for other in there if floor[other] > floor[room]]
    assert not upwards, "\n".join(upwards)
    graphlib.TopologicalSorter(arrows).prepare()  # raises CycleError, which names the circle


# --- defaults ---------------------------------------------------------------------------------------------------------

DOORS = {
    "simulate": """blinkgl.cli.simulate blinkgl.simulate blinkgl.simulate_file
        blinkgl.recordings.simulation.frames_to_events blinkgl.recordings.simulation.simulated_steps
        blinkgl.recordings.simulation.file_to_events""",
    "compare": "blinkgl.cli.compare blinkgl.compare blinkgl.recordings.comparison.compare",
    "calibrate": """blinkgl.cli.calibrate blinkgl.calibrate blinkgl.recordings.calibration.calibrate
        blinkgl.recordings.clip.FrameReading""",
    "convert": "blinkgl.cli.convert blinkgl.convert blinkgl.io.formats.convert",
    "write": "blinkgl.write_events blinkgl.io.formats.event_writer",
    "verify": "blinkgl.cli.verify blinkgl.verify blinkgl.dataset.verify.verify_dataset",
    "generate": "blinkgl.cli.generate blinkgl.generate blinkgl.dataset.run.run_dataset",
    "explain": "blinkgl.cli.explain blinkgl.dataset.explain.explain",
    "sequence": "blinkgl.simulate_sequence blinkgl.sequence.SequenceRequest",
    "report": "blinkgl.cli.report blinkgl.report.page.write_report",
}
OTHERWISE = {
    "overwrite": "a command asks first",
    "workers": "a command's own word for one process",
    "executor": "a name, or the thing itself",
    "labels": "which ones, or whether any",
}


@pytest.mark.parametrize("what", DOORS)
def test_doors_to_one_thing_have_the_same_defaults(what):
    """A command, the function of the front door and the one of the room behind it."""
    said: dict[str, dict[str, object]] = {}
    for name in DOORS[what].split():
        place, _, function = name.rpartition(".")
        for parameter in inspect.signature(getattr(importlib.import_module(place), function)).parameters.values():
            if parameter.default is not parameter.empty and parameter.name not in OTHERWISE:
                said.setdefault(parameter.name, {})[name] = parameter.default
    assert any(len(doors) > 1 for doors in said.values())
    assert {name: doors for name, doors in said.items() if len(set(doors.values())) > 1} == {}


# --- The same configuration and seed draw the same textures, bodies, worlds and noise in every version: against
# ``tests/golden/draws.json``.


@pytest.mark.parametrize("part", draws.PARTS, ids=lambda part: part.__name__)
def test_what_seeds_draw(part):
    """After a change that is meant: ``python -m blinkgl.tools.draws``, and a look at what has become of the file."""
    golden = {key: value for key, value in draws.known().items() if key.startswith(part.__name__ + "/")}
    assert golden and draws.differences(golden, draws.drawn((part,))) == []
