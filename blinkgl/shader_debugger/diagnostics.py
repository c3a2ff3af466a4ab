"""Compiler messages at the user's own file, line and column."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from blinkgl.gl.shader import ShaderError, ShaderSource, made_includes

# Mesa "0:12(5): error: …", NVIDIA "0(12) : error C1503: …", AMD, Intel, Apple "ERROR: 0:12: …".
_MESSAGES = (
    re.compile(r"\d+:(?P<line>\d+)\((?P<column>\d+)\): (?:preprocessor )?(?P<kind>error|warning): (?P<text>.*)"),
    re.compile(r"\d+\((?P<line>\d+)\) : (?P<kind>error|warning) (?P<text>.*)"),
    re.compile(r"(?P<kind>ERROR|WARNING): \d+:(?P<line>\d+): (?P<text>.*)"),
)
_STAGE = re.compile(r"(vertex|fragment)_shader$")
_QUOTED = re.compile(r"[`'\"]([A-Za-z_][\w.]*)['\"]")


@dataclass(frozen=True)
class Diagnostic:
    """line, column : from 1; 0 when unknown.   excerpt : the lines around, with a caret under the column."""

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

    def as_dict(self) -> dict:
        return asdict(self)


def diagnose(error: ShaderError, sources: Mapping[str, ShaderSource], folder: Any) -> list[Diagnostic]:
    """Every message behind a ShaderError. ``sources``: by stage, empty when the program could
    not even be put together."""
    found, stage = [], ""
    for line in error.log.splitlines():
        if header := _STAGE.match(line.strip()):
            stage = header[1]
        match = next(filter(None, (p.match(line.strip()) for p in _MESSAGES)), None)
        if match and stage in sources:
            number = int(match["line"])
            file, own = sources[stage].locate(number)
            text = _line(sources[stage].text, number)
            column = _column(text, match["text"], int(match.groupdict().get("column") or 0))
            if not file:  # a line that nobody wrote: an include guard, a #define
                found.append(
                    Diagnostic(
                        sources[stage].name,
                        0,
                        0,
                        match["kind"].lower(),
                        match["text"],
                        stage,
                        f"generated line: {text}",
                    )
                )
                continue
            found.append(
                Diagnostic(
                    file, own, column, match["kind"].lower(), match["text"], stage, excerpt(folder, file, own, column)
                )
            )
    if any(d.kind == "error" for d in found):
        return found
    if error.log and sources:  # linking: no lines, but names
        text = " ".join(
            line.strip() for line in error.log.splitlines() if line.strip(" =") and not _STAGE.match(line.strip())
        )
        for stage in reversed(sources):
            for name in _QUOTED.findall(text):
                if place := _declaration(sources[stage], name):
                    return [Diagnostic(*place, "error", text, stage, excerpt(folder, *place))]
        return [Diagnostic(next(iter(sources.values())).name, 0, 0, "error", text)]
    file, _, line = (error.where or "").rpartition(":")
    if file and line.isdigit():
        return [
            Diagnostic(
                file,
                int(line),
                1,
                "error",
                str(error).removeprefix(f"{error.where}: "),
                "",
                excerpt(folder, file, int(line), 1),
            )
        ]
    return [Diagnostic(error.where or "shaders", 0, 0, "error", str(error).removeprefix(f"{error.where}: "))]


def _line(text: str, number: int) -> str:
    lines = text.split("\n")
    return lines[number - 1] if 1 <= number <= len(lines) else ""


def _column(text: str, message: str, column: int) -> int:
    """A name that the message quotes, if the line has it: drivers count columns after their
    preprocessor squeezed the blanks."""
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
    """Lines around ``line`` of a file in the shader folder, a caret under ``column``."""
    path = folder
    for part in file.split("/"):
        path = path / part
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError):
        lines = made_includes().get(file.removeprefix("include/"), "").split("\n")
    out = []
    for i in range(max(1, line - around), min(len(lines), line + around) + 1):
        out.append(f"{'>' if i == line else ' '} {i:4d} | {lines[i - 1]}")
        if i == line and column:
            pad = re.sub(r"[^\t]", " ", lines[i - 1][: column - 1])
            out.append(f"       | {pad}^")
    return "\n".join(out)
