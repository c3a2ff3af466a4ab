"""One pattern: a command is one module of blinkgl.show with ``run``, and nothing else in the package prints."""

import ast
import inspect
import subprocess
import sys
from importlib import import_module
from keyword import iskeyword
from pathlib import Path

import pytest
import typer
from sources import parsed

from blinkgl import cli

PACKAGE = Path(cli.__file__).parent
COMMANDS = sorted(
    name
    for name, command in typer.main.get_command(cli.app).commands.items()
    if name != "shader" and not command.hidden  # hidden: gone, and refused
)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_module(name):
    run = import_module(f"blinkgl.show.{name}_" if iskeyword(name) else f"blinkgl.show.{name}").run
    assert inspect.signature(run).return_annotation == "int", "the exit status"


def test_no_other_room_prints():
    """Benchmarks' and tools' own words are theirs; how a command line ends is said for both commands in one place."""
    for path, nodes in parsed("blinkgl", words=("print", "rich", "blinkgl.show")):
        place = path.removeprefix("blinkgl/")
        if place.startswith(("show/", "shader_debugger/")) or place in (
            "cli.py",
            "machine/command_line.py",
            "machine/terminal.py",
        ):
            continue
        for node in nodes:
            printed = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
            rich = isinstance(node, (ast.Import, ast.ImportFrom)) and "rich" in [getattr(node, "module", "") or ""] + [
                n.name for n in node.names
            ]
            rich = rich or (
                isinstance(node, ast.ImportFrom) and (node.module or "").startswith(("rich.", "blinkgl.show"))
            )
            assert not printed and not rich, f"{place}:{node.lineno}"


def test_the_package_runs_as_a_program():
    done = subprocess.run([sys.executable, "-m", "blinkgl", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == f"blinkgl {cli.__version__}\n"
