"""The help of every command: words instead of Python's types, examples that parse, 80 columns."""

from __future__ import annotations

import re
import shlex
from importlib import import_module

import pytest
import typer

from blinkgl.events.table import EMULATORS
from blinkgl.io.formats import FORMATS
from blinkgl.machine.help import EXAMPLES
from blinkgl.tools.command_docs import _commands

COMMANDS = {
    name: command
    for program in ("blinkgl", "eflow")
    for name, command in _commands(program, typer.main.get_command(import_module(f"{program}.cli").app))
}


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def help_of(name: str) -> str:
    return COMMANDS[name].get_help(typer.Context(COMMANDS[name], info_name=name))


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_shows_two_examples_that_parse(name):
    text = help_of(name)
    shown = text.partition("\nExamples:\n")[2].splitlines()
    assert len(shown) >= 2 and [line.strip() for line in shown] == list(EXAMPLES[name])
    for line in shown:
        assert len(line) <= 80, line
        # Parsing fails at an option that is not there, a missing one, a value out of range.
        COMMANDS[name].make_context(
            name, shlex.split(line.partition(" | ")[0])[len(name.split()) :], resilient_parsing=False
        )


@pytest.mark.parametrize("name", COMMANDS)
def test_no_type_of_python_is_shown(name):
    text = help_of(name)
    assert not re.search(r"<[a-z\[\], ]+>|\b(INTEGER|FLOAT|RANGE)\b", text), text
    assert max(map(len, text.splitlines())) <= 80


def test_simulate_names_every_format_that_is_written():
    text = help_of("blinkgl simulate")
    stated = text[text.index("--out") : text.index("--emulator")]
    for written in FORMATS.values():
        named = not written.writer or any(ending in stated for ending in written.endings)
        assert named, f"name {written.name} in the help of simulate --out, blinkgl/cli_recordings.py"


@pytest.mark.parametrize("command", ["simulate", "saccade", "calibrate"])
def test_every_emulator_is_named(command):
    text = " ".join(help_of(f"blinkgl {command}").split())
    stated = text[text.index("--emulator") :][:200]
    for name in ("esim", "v2e", "voltmeter", *EMULATORS):
        assert name in stated, f"name {name} in the help of {command} --emulator, blinkgl/cli_recordings.py"


def test_every_example_belongs_to_a_command():
    assert set(EXAMPLES) == set(COMMANDS)


@pytest.mark.parametrize("program", ["blinkgl", "eflow"])
def test_completion_is_offered(program, capsys, monkeypatch):
    run = import_module(f"{program}.cli").run
    monkeypatch.setenv(f"_{program.upper()}_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"{program} ex")
    monkeypatch.setenv("COMP_CWORD", "1")
    with pytest.raises(SystemExit, match="0"):
        run([])
    assert "export" in capsys.readouterr().out.split()
