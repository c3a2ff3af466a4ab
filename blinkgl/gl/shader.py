"""GLSL programs from files: one file per program, ``#include``, ``#define`` variants, errors that name the user's line.

A file in ``shaders/`` holds all stages of one program, separated by ``#ifdef VERTEX_SHADER`` / ``#ifdef
FRAGMENT_SHADER``; it is compiled once per stage. ``#include "lens.glsl"`` reads ``shaders/include/lens.glsl``, with an
automatic include guard, so that two includes may share a third. The compiler gets one text, with a table of the file
and line that each of its lines came from: drivers disagree about ``#line`` with a file number, but all of them count
lines.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import moderngl

from blinkgl.errors import GLError

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable  # from 3.11 on; annotations only

STAGES = ("vertex", "fragment")
"""Stages of a program that draws."""
GEOMETRY = "geometry"
"""The stage between them, in variants that define ``GEOMETRY_STAGE``."""
DEFAULT_VERSION = "#version 430 core"

MADE: list[Callable[[], Mapping[str, str]]] = []
"""Generated includes: each function returns texts by their include name. Rooms add theirs here; a file of the shader
folder has priority."""

_VERSION = re.compile(r"\s*#\s*version\b")
_INCLUDE = re.compile(r"\s*#\s*include\b\s*(?P<argument>.*?)\s*(//.*)?$")
_QUOTED = re.compile(r'"([^"]+)"$')
# GLSL reserves names that begin with gl_ and names with two underscores in a row.
_NAME = re.compile(r"(?!gl_|GL_)[A-Za-z](?!\w*__)\w*$")
# Where drivers put the line number: Mesa "0:12(5): error: …", NVIDIA "0(12) : error C1503: …", AMD/Intel/Apple "ERROR:
# 0:12: …".
_MESSAGES = (
    re.compile(r"\d+:(?P<line>\d+)\((?P<column>\d+)\): (?:preprocessor )?(?P<kind>error|warning): (?P<text>.*)"),
    re.compile(r"\d+\((?P<line>\d+)\) : (?P<kind>error|warning) (?P<text>.*)"),
    re.compile(r"(?P<kind>ERROR|WARNING): \d+:(?P<line>\d+): (?P<text>.*)"),
)
_STAGE_HEADER = re.compile(r"(vertex|geometry|fragment)_shader$")


def stages_of(defines: Mapping[str, object] | None) -> tuple[str, ...]:
    """Return the stages of a variant of a program that draws, in the order in which they run."""
    return (STAGES[0], GEOMETRY, STAGES[1]) if (defines or {}).get("GEOMETRY_STAGE") else STAGES


@dataclass(frozen=True)
class ShaderSource:
    """The source of one stage. text : GLSL for the compiler.
    origin : (file, line) of each of its lines, 1-based, the file relative to the shader folder; ("", 0) for generated
    lines.
    files : text of every file in it, by the same names.   made : names of generated includes (:data:`MADE`)."""

    name: str
    stage: str
    text: str
    origin: tuple[tuple[str, int], ...]
    files: Mapping[str, str] = field(default_factory=dict)
    made: tuple[str, ...] = ()

    def locate(self, line: int) -> tuple[str, int]:
        """Return the file and line that line ``line`` (1-based) of ``text`` came from."""
        return self.origin[line - 1] if 1 <= line <= len(self.origin) else ("", 0)


class ShaderError(GLError):
    """A shader that does not load, compile or link. ``str``: one line; ``detail``: every message with the source around
    it."""

    def __init__(self, problem: str, *, where: str | None = None, detail: str = "", log: str = "", **more: Any):
        super().__init__(problem, where=where, **more)
        self.detail, self.log = detail, log


def shader_folder() -> Traversable:
    """Return the folder of the shipped shaders."""
    return resources.files("blinkgl.shaders")


def expand(
    name: str, stage: str, defines: Mapping[str, object] | None = None, folder: Traversable | None = None
) -> ShaderSource:
    """Return the source of one stage with includes and defines expanded.

    name    : file in ``folder`` (default: the shipped shaders), or an absolute path; includes are always the folder's.
    stage   : "vertex", "geometry" or "fragment".
    defines : NAME -> number, True (1), text, or False/None (left undefined).

    Raises ShaderError for a missing file, an include cycle, or a define that is not a GLSL identifier.
    """
    if stage not in (*STAGES, GEOMETRY):
        raise ValueError(f"stage must be one of {(*STAGES, GEOMETRY)}, not {stage!r}")
    folder = shader_folder() if folder is None else folder
    body = _Expansion(folder)
    body.file(name, Path(name) if Path(name).is_absolute() else folder / name, chain=())
    # #version must come before everything else, so it is taken out of the file and put first.
    head = [body.version or DEFAULT_VERSION, f"#define {stage.upper()}_SHADER 1"]
    head += [f"#define {key} {value}" for key, value in normalised(defines)]
    return ShaderSource(
        name,
        stage,
        "\n".join(head + body.lines) + "\n",
        (("", 0),) * len(head) + tuple(body.origin),
        body.files,
        tuple(body.made),
    )


def made_includes() -> dict[str, str]:
    """Return all present texts of :data:`MADE`."""
    return {name: text for make in MADE for name, text in make().items()}


def normalised(defines: Mapping[str, object] | None) -> tuple[tuple[str, str], ...]:
    """Return sorted (name, GLSL text) pairs: the key under which a variant is cached."""
    pairs = []
    for key, value in sorted((defines or {}).items()):
        if not _NAME.match(key):
            raise ShaderError(
                "not a valid GLSL name", value=key, accepted="letters, digits, single _; not starting with gl_"
            )
        if value is None or value is False:
            continue
        text = "1" if value is True else str(value)
        if "\n" in text or (isinstance(value, float) and not math.isfinite(value)):
            raise ShaderError(f"#define {key} needs a finite number or one line of text", value=value)
        pairs.append((key, text))
    return tuple(pairs)


class _Expansion:
    """Collects the lines of a file and its includes, and their origins."""

    def __init__(self, folder: Traversable):
        self.folder = folder
        self.version: str | None = None
        self.files: dict[str, str] = {}
        self.made: dict[str, None] = {}
        self.lines: list[str] = []
        self.origin: list[tuple[str, int]] = []

    def file(self, shown: str, path: Traversable, chain: tuple[str, ...], included_at: str | None = None) -> None:
        if shown in chain:
            raise ShaderError("include cycle: " + " -> ".join([*chain[chain.index(shown) :], shown]), where=included_at)
        try:
            # Edited text in memory precedes the file; includes that are made of tables come last.
            text = self.files[shown] if shown in self.files else path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            name = shown.removeprefix("include/")
            if isinstance(error, UnicodeDecodeError) or name == shown or name not in (made := made_includes()):
                reason = "not UTF-8 text" if isinstance(error, UnicodeDecodeError) else "no such shader file"
                raise ShaderError(
                    reason, where=included_at or "shaders", value=shown, accepted=self._available(path)
                ) from None
            text = made[name]
            self.made[name] = None
        self.files[shown] = text
        for lines, origin, end, argument in _parts(shown, text):
            self.lines += lines
            self.origin += origin
            if argument is None:
                if chain:
                    raise ShaderError(
                        "#version must be in the program's file, not in an include", where=f"{shown}:{end}"
                    )
                self.version = text.splitlines()[end - 1].strip()
            elif end:
                self._include(argument, (*chain, shown), f"{shown}:{end}")

    def _include(self, argument: str, chain: tuple[str, ...], at: str) -> None:
        quoted = _QUOTED.match(argument)
        if not quoted:
            raise ShaderError("malformed #include", where=at, value=argument, accepted='#include "file.glsl"')
        name = quoted[1]
        if name.startswith("/") or ".." in name.split("/"):
            raise ShaderError(
                "include outside the shader folder", where=at, value=name, accepted="a file in shaders/include"
            )
        # A preprocessor guard, not one of this loader: only the preprocessor knows which #ifdef branches are active.
        guard = _guard(name)
        self.lines += (f"#ifndef {guard}", f"#define {guard}")
        self.origin += (("", 0), ("", 0))
        self.file(f"include/{name}", self.folder / "include" / name, chain, at)
        self.lines.append("#endif")
        self.origin.append(("", 0))

    def _available(self, path: Traversable) -> str | None:
        folder = self.folder / "include" if isinstance(path, Path) and path.parent.name == "include" else self.folder
        try:
            names = sorted(entry.name for entry in folder.iterdir() if entry.name.endswith(".glsl"))
        except OSError:
            return None
        return "one of " + ", ".join(names) if names else None


@lru_cache(maxsize=256)
def _guard(name: str) -> str:
    # Other characters become their codes, so that two names never share a guard.
    return "INCLUDED_" + "".join(c if c.isalnum() else f"_{ord(c):x}x" for c in name)


@lru_cache(maxsize=256)
def _parts(shown: str, text: str) -> tuple[tuple[tuple[str, ...], tuple[tuple[str, int], ...], int, str | None], ...]:
    """Return a file in pieces: (lines, their origins, number of the line that ends them, what that line includes; None
    where it is a #version). The last one ends at 0. Cached, since all programs of a scene include the same dozen
    files."""
    parts, lines, origin = [], [], []
    in_comment = False
    for number, line in enumerate(text.splitlines(), 1):
        include = None if in_comment else _INCLUDE.match(line)
        if include:
            parts.append((tuple(lines), tuple(origin), number, include["argument"]))
            lines, origin = [], []
        elif not in_comment and _VERSION.match(line):
            parts.append((tuple(lines), tuple(origin), number, None))
            # An empty line stands for #version, which goes to the head.
            lines, origin = [""], [(shown, number)]
        else:
            # Left over: includes in comments, which moderngl's own resolver would try to follow.
            lines.append(line.replace("#include", "# include"))
            origin.append((shown, number))
        in_comment = _ends_in_comment(line, in_comment)
    return (*parts, (tuple(lines), tuple(origin), 0, ""))


def _ends_in_comment(line: str, inside: bool) -> bool:
    """Return whether a /* comment is open after ``line``."""
    position = 0
    while True:
        if inside:
            end = line.find("*/", position)
            if end < 0:
                return True
            inside, position = False, end + 2
        start, slashes = line.find("/*", position), line.find("//", position)
        # A // before it comments out the opening of a block comment.
        if start < 0 or 0 <= slashes < start:
            return False
        inside, position = True, start + 2


def link(ctx: moderngl.Context, sources: Mapping[str, ShaderSource]) -> moderngl.Program:
    """Return the program of its stages. Raises ShaderError."""
    try:
        return ctx.program(
            vertex_shader=sources["vertex"].text,
            geometry_shader=sources[GEOMETRY].text if GEOMETRY in sources else None,
            fragment_shader=sources["fragment"].text,
        )
    except moderngl.Error as error:
        raise translate(str(error), sources) from None


def unused(program: moderngl.Program, name: str) -> ShaderError:
    """Return the error for an attribute or a uniform that a program declares but that its compiler removed."""
    return ShaderError(f"the shader no longer uses '{name}'", where=program.extra, accepted="a program that uses it")


class Uniforms(dict[str, Any]):
    """The uniforms of one program by name; "" is the program itself. A missing one raises ShaderError."""

    def __init__(self, program: moderngl.Program):
        super().__init__({name: program[name] for name in program if isinstance(program[name], moderngl.Uniform)})
        self[""] = program

    def __missing__(self, name: str) -> Any:
        raise unused(self[""], name)


class ShaderLoader:
    """Compiles and caches the programs of one context.

    All requests with the same defines share a cached program, including its uniforms.
    """

    def __init__(self, ctx: moderngl.Context, folder: Traversable | None = None):
        self.ctx = ctx
        self.folder = shader_folder() if folder is None else folder
        self._programs: dict[tuple[str, tuple[tuple[str, str], ...]], moderngl.Program] = {}
        self._made: dict[
            tuple[str, tuple[tuple[str, str], ...]], dict[str, str]
        ] = {}  # generated includes of a program

    def program(self, name: str, defines: Mapping[str, object] | None = None) -> moderngl.Program:
        """Return the program of file ``name`` with ``defines``; it is compiled when first requested, and again when a
        generated include has changed. Raises ShaderError."""
        key = (name, normalised(defines))
        # A plug-in may have registered another source of a generated include since the program was compiled.
        if key not in self._programs or not self._made.get(key, {}).items() <= made_includes().items():
            self._programs[key] = self._compile(name, defines)
        return self._programs[key]

    @property
    def compiled(self) -> tuple[tuple[str, tuple[tuple[str, str], ...]], ...]:
        """Return (file, sorted defines) of every program requested so far."""
        return tuple(self._programs)

    def _compile(self, name: str, defines: Mapping[str, object] | None) -> moderngl.Program:
        sources = {stage: expand(name, stage, defines, self.folder) for stage in stages_of(defines)}
        program = link(self.ctx, sources)
        program.extra = name  # for messages
        self._made[name, normalised(defines)] = {
            made: source.files[f"include/{made}"] for source in sources.values() for made in source.made
        }
        return program

    def clear(self) -> None:
        """Release every program; the next call of :meth:`program` reads its file again (live reload)."""
        for program in self._programs.values():
            program.release()
        self._programs.clear()


def translate(log: str, sources: Mapping[str, ShaderSource]) -> ShaderError:
    """Return moderngl's error text as a ShaderError that names the user's files."""
    # moderngl writes the stage above the driver's own log.
    stage = next((m[1] for m in map(_STAGE_HEADER.match, log.splitlines()) if m), None)
    name = next(iter(sources.values())).name
    first: ShaderError | None = None
    blocks: list[str] = []
    for own, line, _, kind, text in messages(log):
        source = sources.get(own)
        if source is None:
            continue
        file, number = source.locate(line)
        where = f"{file}:{number}" if file else f"{name} (generated line {line}: {_line(source.text, line)})"
        blocks.append(f"{where}: {kind}: {text}\n{_excerpt(source.files.get(file, ''), number)}")
        if first is None and kind == "error":
            first = ShaderError(f"{text} [{stage} stage]", where=where)
    if first is None:
        meaningful = [line.strip() for line in log.splitlines() if line.strip() and not set(line.strip()) <= {"="}]
        meaningful = [line for line in meaningful if not _STAGE_HEADER.match(line)]
        first = ShaderError(" ".join(meaningful) + (f" [{stage} stage]" if stage else ""), where=name)
    first.detail, first.log = "\n".join(blocks), log
    return first


def messages(log: str) -> Iterator[tuple[str, int, int, str, str]]:
    """Yield (stage, line, column, kind, text) of each message of a compiler, line and column of the compiled text, from
    1.

    stage : "" where the log does not give it.   column : 0 where the driver does not give it.   kind : error or
    warning."""
    stage = ""
    for line in map(str.strip, log.splitlines()):
        if header := _STAGE_HEADER.match(line):
            stage = header[1]
        for match in filter(None, (pattern.match(line) for pattern in _MESSAGES)):
            column = int(match.groupdict().get("column") or 0)
            yield stage, int(match["line"]), column, match["kind"].lower(), match["text"]
            break


def _line(text: str, number: int) -> str:
    lines = text.splitlines()
    return lines[number - 1].strip() if 1 <= number <= len(lines) else ""


def _excerpt(text: str, number: int, around: int = 2) -> str:
    if not text:
        return ""
    lines = text.splitlines()
    shown = range(max(1, number - around), min(len(lines), number + around) + 1)
    return "\n".join(f"{'>' if i == number else ' '} {i:4d} | {lines[i - 1]}" for i in shown) + "\n"
