"""Compiler messages with the user's own file, line and column."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from blinkgl.gl.shader import ShaderError, ShaderSource, made_includes, messages

_QUOTED = re.compile(r"[`'\"]([A-Za-z_][\w.]*)['\"]")


@dataclass(frozen=True)
class Diagnostic:
    """One message. line, column : from 1; 0 when unknown.   excerpt : the lines around, with a caret under the
    column."""

    file: str
    line: int
    column: int
    kind: str
    text: str
    stage: str = ""
    excerpt: str = ""

    @property
    def where(self) -> str:
        return ":".join([self.file, *(str(n) for n in (self.line, self.column) if n)])


def diagnose(error: ShaderError, sources: Mapping[str, ShaderSource], folder: object) -> list[Diagnostic]:
    """Return every message of a ShaderError. ``sources``: by stage, empty when the includes of the program could not be
    resolved."""
    diagnostics = []
    for stage, number, column, kind, text in messages(error.log):
        if stage not in sources:
            continue
        source = sources[stage]
        line, (file, own) = _line(source.text, number), source.locate(number)
        if not file:  # a generated line: an include guard, a #define
            diagnostics.append(
                Diagnostic(
                    file=source.name,
                    line=0,
                    column=0,
                    kind=kind,
                    text=text,
                    stage=stage,
                    excerpt=f"generated line: {line}",
                )
            )
            continue
        column = _column(line, text, column)
        diagnostics.append(
            Diagnostic(
                file=file,
                line=own,
                column=column,
                kind=kind,
                text=text,
                stage=stage,
                excerpt=excerpt(folder, file, own, column),
            )
        )
    if any(d.kind == "error" for d in diagnostics):
        return diagnostics
    reason = str(error).removeprefix(f"{error.where}: ")
    if error.log and sources:  # linking: names, but no lines
        # The later stage first: it uses what the earlier one does not provide.
        for stage in reversed(list(sources)):
            for name in _QUOTED.findall(reason):
                if place := _declaration(sources[stage], name):
                    return [Diagnostic(*place, "error", reason, stage, excerpt(folder, *place))]
        return [Diagnostic(next(iter(sources.values())).name, 0, 0, "error", reason)]
    file, _, number = (error.where or "").rpartition(":")
    if file and number.isdigit():
        return [
            Diagnostic(
                file=file,
                line=int(number),
                column=1,
                kind="error",
                text=reason,
                stage="",
                excerpt=excerpt(folder, file, int(number), 1),
            )
        ]
    return [Diagnostic(error.where or "shaders", 0, 0, "error", reason)]


def _line(text: str, number: int) -> str:
    lines = text.split("\n")
    return lines[number - 1] if 1 <= number <= len(lines) else ""


def _column(text: str, message: str, column: int) -> int:
    """Return the column of a name that the message quotes, if the line contains it: drivers count columns after their
    preprocessor removed blanks."""
    # Drivers count columns after preprocessing, but names stay the same.
    for name in _QUOTED.findall(message):
        if match := re.search(rf"\b{re.escape(name.split('.')[0])}\b", text):
            return match.start() + 1
    stripped = len(text) - len(text.lstrip())
    return min(max(column, stripped + 1), len(text) or 1)


def _declaration(source: ShaderSource, name: str) -> tuple[str, int, int] | None:
    for number, line in enumerate(source.text.split("\n"), 1):
        file, own = source.locate(number)
        qualifiers = r"\s*(layout\s*\(.*?\)\s*)?(flat\s+|smooth\s+|noperspective\s+|invariant\s+)*(in|out|uniform)\b"
        declares = rf"{qualifiers}.*\b{re.escape(name)}\b"
        if file and re.match(declares, line):
            return file, own, line.index(name) + 1
    return None


def excerpt(folder: Any, file: str, line: int, column: int = 0, around: int = 2) -> str:
    """Return the lines around ``line`` of a file in the shader folder, with a caret under ``column``."""
    try:
        path = Path(file) if Path(file).is_absolute() else folder.joinpath(*file.split("/"))
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError):
        # Includes generated from the tables of labels and shapes are in no file.
        lines = made_includes().get(file.removeprefix("include/"), "").split("\n")
    out = []
    for i in range(max(1, line - around), min(len(lines), line + around) + 1):
        out.append(f"{'>' if i == line else ' '} {i:4d} | {lines[i - 1]}")
        if i == line and column:
            # Tabs are kept, so that the caret is below its column at any tab width.
            pad = re.sub(r"[^\t]", " ", lines[i - 1][: column - 1])
            out.append(f"       | {pad}^")
    return "\n".join(out)
