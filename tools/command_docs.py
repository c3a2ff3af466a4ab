"""Writes docs/commands.md, every command with its arguments and options, from the commands themselves.

    python -m blinkgl.tools.command_docs > docs/commands.md

A test fails when the page and the commands differ.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import typer

from blinkgl.cli import app as blinkgl_app
from eflow.cli import app as eflow_app

HEADER = """# Commands

Made from the commands by `python -m blinkgl.tools.command_docs`; do not edit. `--help` prints the same.

`--debug`, before or after a command, shows the traceback of an error. Exit status: 0 done; 1 `shader diff` or
`shader check` found something wrong; 2 your input or the machine (`error: …`, one line); 3 done but for
sequences (`trade --suite`: scenes) that were set aside; 130 interrupted.
"""
REMARKS = re.compile(r"\s*\[([^\]]*)\]$")
"""What ``--help`` says last of an option, ``[default: 4; 1<=x<=1000]``."""


def page() -> str:
    """The page as Markdown."""
    roots = (("blinkgl", blinkgl_app), ("eflow", eflow_app))
    return HEADER + "".join(
        _section(name, command) for root, app in roots for name, command in _commands(root, typer.main.get_command(app))
    )


def _commands(name: str, command) -> Iterator[tuple[str, object]]:
    """The commands below one, in the order of ``--help``."""
    if not hasattr(command, "commands"):
        yield name, command
        return
    for child, below in command.commands.items():
        if below.hidden:
            continue
        yield from _commands(f"{name} {child}", below)


def _section(name: str, command) -> str:
    context = typer.Context(command, info_name=name)
    records = [record for parameter in command.params if (record := parameter.get_help_record(context))]
    rows = "".join(_row(*record) for record in records)
    usage = " ".join([name, *(piece.strip("{}") for piece in command.collect_usage_pieces(context))])
    table = f"\n| | meaning | |\n|---|---|---|\n{rows}" if records else ""
    return f"\n## {name}\n\n{' '.join((command.help or '').split())}\n\n```\n{usage}\n```\n{table}"


def _row(names: str, meaning: str) -> str:
    remarks = REMARKS.search(meaning)
    names = names.replace(" range>", ">")
    return f"| `{names}` | {_cell(REMARKS.sub('', meaning))} | {_cell(remarks[1]) if remarks else ''} |\n"


def _cell(text: str) -> str:
    return text.replace("x>=", "≥ ").replace("<=x<=", " to ").replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    print(page(), end="")
