"""One pattern: a command is one module of blinkgl.show with ``run``, and nothing else in the package prints."""

import inspect
import subprocess
import sys
from importlib import import_module

import pytest
import typer
from rich.table import Table

from blinkgl import __version__, cli
from blinkgl.machine.terminal import plain_column, plain_console, say

COMMANDS = sorted(
    name
    for name, command in typer.main.get_command(cli.app).commands.items()
    if name != "shader" and not command.hidden  # hidden: gone, and refused
)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_its_module(name):
    own = {"import": "blinkgl.show.import_", "trade": "blinkgl.tools.trade.command"}
    run = import_module(own.get(name, f"blinkgl.show.{name}")).run
    assert inspect.signature(run).return_annotation == "int", "the exit status"


def test_the_package_runs_as_a_program():
    done = subprocess.run([sys.executable, "-m", "blinkgl", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout == f"blinkgl {__version__}\n"


# --- Words in square brackets arrive: Rich takes them for markup wherever it is allowed to.


def test_texts_tables_titles_and_bars_keep_their_brackets(capsys):
    console = plain_console(width=120)
    table = Table(title="out/run[1]")
    table.add_column("column [bold]")
    table.add_row("cell [cluster] [/red]")
    console.print(table)
    console.print("path/[red]/x", soft_wrap=True)
    say(console, "path/:bug:/x " + "y" * 200)
    out = capsys.readouterr().out
    assert all(
        text in out
        for text in (
            "out/run[1]",
            "column [bold]",
            "cell [cluster] [/red]",
            "path/[red]/x",
            "path/:bug:/x " + "y" * 200,
        )
    )

    class Task:
        description = "data[train]/a"

    assert plain_column("{task.description}").render(Task()).plain == "data[train]/a"
