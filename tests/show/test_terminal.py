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


def test_extras_are_named_in_help(capsys):
    assert cli.run(["generate", "--help"]) == 0 and "[cluster]" in capsys.readouterr().out
    assert cli.run(["import", "--help"]) == 0 and "[cycles]" in capsys.readouterr().out


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


def test_there_is_no_other_console():
    """Whatever is printed for people goes through blinkgl.machine.terminal; benchmarks, which
    print their own words alone, need not."""
    for folder in ("blinkgl", "eflow", "blinkgl/shader_debugger"):
        for path in (ROOT / folder).rglob("*.py"):
            if path != ROOT / "blinkgl/machine/terminal.py":
                text = path.read_text(encoding="utf-8")
                assert not re.search(r"(?<![\w.])(Console|TextColumn)\(|from_markup|rich_markup_mode=(?!None)", text), (
                    path
                )
                assert text.count("typer.Typer(") == text.count("rich_markup_mode=None"), path
