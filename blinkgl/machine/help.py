"""Help of a command line in words of its users: examples below every command, NUMBER and FILE instead of Python's
types. ``docs/commands.md`` is made from the same text."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import typer
from typer.core import TyperCommand

_TYPE = re.compile(r" (?:<[^>]*>|TEXT|INTEGER|FLOAT|INTEGER RANGE|FLOAT RANGE)(?=$|\.\.\.|,)")
"""What typer says of a parameter's type; before 0.29 in capitals."""
_NUMBERS = re.compile(r"int|float|INTEGER|FLOAT")
_WORDS = {
    **dict.fromkeys(("out", "frames"), "PATH"),
    **dict.fromkeys(("base", "data", "shaders"), "FOLDER"),
    **dict.fromkeys(("config", "timestamps", "card", "preview", "video", "onnx", "torchscript"), "FILE"),
    **dict.fromkeys(("emulator", "layout", "model", "name", "sensor", "split", "backend", "stream"), "NAME"),
    **dict.fromkeys(("size",), "WxH"),
}
"""What an option takes, by the name of its parameter, where it is neither a number nor a plain text."""


def in_words(parameter: Any) -> Callable[[Any], tuple[str, str] | None]:
    """Return ``parameter.get_help_record`` with a word in place of the type: "--fps NUMBER"."""
    record = parameter.get_help_record

    def shown(context: Any) -> tuple[str, str] | None:
        row = record(context)
        if row is None:
            return None
        names, meaning = row
        typed = _TYPE.search(names)
        if typed is None:
            return row
        word = _WORDS.get(parameter.name) or ("NUMBER" if _NUMBERS.search(typed[0]) else "TEXT")
        # An argument's own name says what it is.
        word = f" {word}" if names.startswith("-") else ""
        return names[: typed.start()] + word + names[typed.end() :], meaning

    return shown


class Command(TyperCommand):
    """A command whose help says types in words and ends with its examples."""

    def get_params(self, ctx: Any) -> list[Any]:
        parameters = super().get_params(ctx)
        for parameter in parameters:
            if "get_help_record" not in vars(parameter):
                vars(parameter)["get_help_record"] = in_words(parameter)
        return parameters

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        super().format_epilog(ctx, formatter)
        if lines := EXAMPLES.get(ctx.command_path, ()):
            formatter.write("\nExamples:\n" + "".join(f"  {line}\n" for line in lines))


EXAMPLES: dict[str, tuple[str, ...]] = {}
"""Lines by command, "blinkgl generate". A program adds its own (:meth:`App.add_examples`)."""


class App(typer.Typer):
    """A typer application whose commands are :class:`Command`."""

    def command(self, name: str | None = None, **options: Any) -> Any:
        """Return the decorator of typer's own method."""
        options.setdefault("cls", Command)
        return super().command(name, **options)

    def add_examples(self, program: str, examples: Mapping[str, tuple[str, ...]]) -> None:
        """Show these lines below the help of ``program``'s commands. examples : command -> lines without the program's
        name, "demo --out out/demo"."""
        for command, lines in examples.items():
            EXAMPLES[f"{program} {command}"] = tuple(f"{program} {command} {line}".rstrip() for line in lines)
