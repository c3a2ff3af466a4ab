"""Words in square brackets arrive: Rich takes them for markup wherever it is allowed to."""

import re
from pathlib import Path

import click
import pytest
import typer
from rich.table import Table

from blinkgl import cli
from blinkgl.machine.terminal import plain_column, plain_console, say

ROOT = Path(__file__).parents[2]


def commands(command, path=()):
    if isinstance(command, click.Group) or hasattr(command, "commands"):
        for name, child in command.commands.items():
            yield from commands(child, (*path, name))
    yield path, command


def apps():
    from eflow.cli import app as eflow_app

    return {"blinkgl": cli.app, "eflow": eflow_app}


@pytest.mark.parametrize("name", ["blinkgl", "eflow"])
def test_help_says_every_word_of_every_option(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    app = apps()[name]
    for path, command in commands(typer.main.get_command(app)):
        app([*path, "--help"], prog_name=name, standalone_mode=False)
        shown = re.sub(r"[\s│]+", "", capsys.readouterr().out)
        texts = [p.help for p in command.params if getattr(p, "help", None)] + [command.help or ""]
        for text in texts:
            assert re.sub(r"\s+", "", text) in shown, (path, text)


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
