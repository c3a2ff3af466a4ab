"""One pattern: a command is one module of blinkgl.show with ``run``, and nothing else in the package prints."""

import inspect
import subprocess
import sys
from importlib import import_module
from keyword import iskeyword

import pytest
import typer

from blinkgl import cli

COMMANDS = sorted(
    name
    for name, command in typer.main.get_command(cli.app).commands.items()
    if name != "shader" and not command.hidden  # hidden: gone, and refused
)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_module(name):
    run = import_module(f"blinkgl.show.{name}_" if iskeyword(name) else f"blinkgl.show.{name}").run
    assert inspect.signature(run).return_annotation == "int", "the exit status"


def test_the_package_runs_as_a_program():
    done = subprocess.run([sys.executable, "-m", "blinkgl", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == f"blinkgl {cli.__version__}\n"
