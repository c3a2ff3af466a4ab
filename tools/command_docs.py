"""Writes docs/commands.md, every command with its arguments and options, from the commands themselves.

    python -m blinkgl.tools.command_docs > docs/commands.md

A test fails when the page and the commands differ.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import distribution

import typer

from blinkgl.machine.help import EXAMPLES

HEADER = """# Commands

Made from the commands by `python -m blinkgl.tools.command_docs`; do not edit. `-h` prints the same.

`--debug`, before or after a command, shows the traceback of an error. Exit status: 0 done; 1 `shader diff` or
`shader check` found something wrong; 2 your input or the machine (`error: …`, one line); 3 done but for
sequences (`trade --suite`: scenes) that were set aside; 130 interrupted by Ctrl-C, 143 by SIGTERM (one line).
"""
SHARED_BY = 2
"""An argument or option of so many commands is described once."""
HEAD = "|option|meaning|default, limits|\n|---|---|---|\n"
REMARKS = re.compile(r"\s*\[([^\]]*)\]$")
"""What ``--help`` says last of an option, ``[default: 4; 1<=x<=1000]``."""


def page() -> str:
    """The page as Markdown, of the commands that the package installs."""
    scripts = distribution("blinkgl").entry_points.select(group="console_scripts")
    roots = [(script.name, import_module(f"{script.name}.cli").app) for script in sorted(scripts)]
    commands = [row for root, app in roots for row in _commands(root, typer.main.get_command(app))]
    rows = {name: _rows(name, command) for name, command in commands}
    count = Counter(row for options in rows.values() for row in options)
    shared = [row for row in count if count[row] >= SHARED_BY]
    table = f"\n## Used by several commands\n\n{HEAD}{''.join(shared)}"
    return HEADER + table + "".join(_section(name, command, rows[name], shared) for name, command in commands)


def _commands(name: str, command) -> Iterator[tuple[str, object]]:
    """The commands below one, in the order of ``--help``."""
    if not hasattr(command, "commands"):
        yield name, command
        return
    for child, below in command.commands.items():
        if below.hidden:
            continue
        yield from _commands(f"{name} {child}", below)


def _rows(name: str, command) -> list[str]:
    """The rows of a command's table, an argument or an option each."""
    context = typer.Context(command, info_name=name)
    parameters = [parameter for parameter in command.get_params(context) if parameter.name != "help"]
    return [_row(*record) for parameter in parameters if (record := parameter.get_help_record(context))]


def _section(name: str, command, rows: list[str], shared: list[str]) -> str:
    own = [row for row in rows if row not in shared]
    also = ", ".join(re.sub(r" [^-` ]+`$", "`", row.split("|")[1]) for row in rows if row in shared)
    parts = [f"## {name}", " ".join((command.help or "").split()), "\n".join(["```", *EXAMPLES[name], "```"])]
    parts += [HEAD + "".join(own).rstrip("\n")] * bool(own) + [f"Also: {also}."] * bool(also)
    return "".join(f"\n{part}\n" for part in parts)


def _row(names: str, meaning: str) -> str:
    remarks = REMARKS.search(meaning)
    limits = _cell(remarks[1]).replace("default: ", "") if remarks else ""
    return f"|`{names}`|{_cell(REMARKS.sub('', meaning))}|{limits}|\n"


def _cell(text: str) -> str:
    return text.replace("x>=", "≥ ").replace("<=x<=", " to ").replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    print(page(), end="")
