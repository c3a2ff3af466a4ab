"""One pattern: a command is one module of blinkgl.show with ``run``, and nothing else in the package prints."""

import inspect
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import typer
from rich.table import Table

from blinkgl import __version__, cli
from blinkgl.dataset.run import Outcome
from blinkgl.machine.terminal import plain_column, plain_console, say
from blinkgl.show import generate

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


@pytest.mark.parametrize("out, place", [(".", "parent/set"), ("..", "parent"), ("new/", "parent/set/new")])
def test_an_export_lies_beside_its_data_set(tmp_path, monkeypatch, out, place):
    (tmp_path / "parent/set").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "parent/set")
    exported = []
    monkeypatch.setattr(generate, "run_dataset", lambda *arguments, **options: Outcome(1))
    monkeypatch.setattr(generate, "show_outcome", lambda *arguments: None)
    monkeypatch.setattr(generate.export, "run", lambda root, to, **options: exported.append(to))
    assert cli.run(["generate", "demo", "--out", out, "--layout", "webdataset", "--quiet"]) == 0
    assert [Path(to).absolute() for to in exported] == [tmp_path / f"{place}-webdataset"]


@pytest.mark.parametrize(
    "words, message",
    [
        (["generate", "demo", "--out", ""], "--out: is empty (got ''); expected a name"),
        (["export", ".", "--out="], "--out: is empty (got ''); expected a name"),
        (["convert", "a.h5", "b.h5", "-o", ""], "-o: is empty"),
        (
            ["generate", "demo", "--out", "new", "--devices", "0,²"],
            "--devices: not a list of device numbers (got '0,²')",
        ),
        (
            ["generate", "demo", "--out", "new", "--set", "labels.flow=[backward]", "--set", "labels.flow.²=forward"],
            "--set labels.flow.²: no such list entry",
        ),
    ],
)
def test_names_and_numbers_that_are_none(tmp_path, monkeypatch, words, message, capsys):
    """An unset variable of the shell is an empty name, which Python takes for the current folder."""
    monkeypatch.chdir(tmp_path)
    assert cli.run(words) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not list(tmp_path.iterdir())
