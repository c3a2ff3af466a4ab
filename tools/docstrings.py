"""Reads BlinkGL's docstrings for the documentation site: a Griffe extension, named in mkdocs.yml.

The docstrings are written to be read in the source. Two habits in them mean nothing to Markdown and are translated:
``:class:`~blinkgl.types.events.Events```, which becomes code, and the lines that explain arguments,

    width, height : px.   fov : horizontal field of view, degrees,
    default 60.

which become a list, one entry each.
"""

from __future__ import annotations

import re

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod|attr|data|exc|obj):`~?([^`]+)`")
NAMES = r"(?:\*{0,2}\w+(?: ?, \*{0,2}\w+)*)"
"""What stands before `` : ``: one name or several."""
ENTRY = re.compile(rf"^({NAMES}) : (?=\S)(.*)$")
NEXT = re.compile(rf"(?:(?<=\.) +|(?<=\S) {{3,}})(?={NAMES} : \S)")
"""Between two entries on one line: a full stop, or three blanks."""
ROOM = re.compile(r"^(In|Out|Start): +(?=\S)(.*)$")
"""The three lines of a package."""
ONLY = "\0"
"""Marks an entry that is a name alone, with its meaning in the lines below."""
LAST = re.compile(r"^(Raises?|Returns?|Times?|Yields?)\b")
"""A line that speaks of the whole again."""


def markdown(text: str) -> str:
    """A docstring as Markdown."""
    return "\n".join(_listed(_joined(_headed(ROLE.sub(_code, text).splitlines()))))


def _code(role: re.Match) -> str:
    name = role[1].lstrip(".")
    return f"`{name.rpartition('.')[2] if '~' in role[0] else name}`"


def _headed(lines: list[str]) -> list[str]:
    """Underlined headings (``Parameters``) as a line in bold; what follows them are entries and nothing else."""
    out: list[str] = []
    section = False
    for line, below in zip(lines, [*lines[1:], ""]):
        if line.strip() and re.fullmatch("-{3,}", below.strip()):
            out += ["", f"**{line.strip()}**", ""]
            section = True
        elif not line.strip():
            out.append(line)
            section = False
        elif section and re.fullmatch("-{3,}", line.strip()):
            continue
        elif section and not line.startswith(" ") and not ENTRY.match(line):
            out.append(f"{ONLY}{line}")
        else:
            out.append(line)
    return out


def _joined(lines: list[str]) -> list[str]:
    """Entries broken into one a line."""
    return [part for line in lines for part in NEXT.split(line)]


def _listed(lines: list[str]) -> list[str]:
    """Entries as a list; lines below one belong to it until a blank line, or one that speaks of the whole."""
    out: list[str] = []
    inside = fenced = False
    for line in lines:
        fenced ^= line.lstrip().startswith("```")
        entry = None if fenced or line.startswith("    ") else ENTRY.match(line) or ROOM.match(line)
        if entry or line.startswith(ONLY):
            if not inside:
                out.append("")
            out.append(f"- **{entry[1]}**: {entry[2]}" if entry else f"- **{line.removeprefix(ONLY)}**:")
            inside = True
        elif inside and (not line.strip() or LAST.match(line)):
            out += ["", line] if line.strip() else [""]
            inside = False
        elif inside:
            out.append(f"  {line.strip()}")
        else:
            out.append(line)
    return out


class Docstrings(griffe.Extension):
    """Translates every docstring once. A room shows its modules, not besides what it hands on of them."""

    def on_module(self, *, mod: griffe.Module, **_: object) -> None:
        if mod.is_init_module and mod.parent is not None:
            mod.exports = None
            modules = {
                name: member for name, member in sorted(mod.members.items()) if isinstance(member, griffe.Module)
            }
            mod.members = {name: member for name, member in mod.members.items() if name not in modules} | modules

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        if obj.docstring is not None:
            obj.docstring.value = markdown(obj.docstring.value)

    def on_package(self, *, pkg: griffe.Module, **_: object) -> None:
        # The root of a package is no object of another one, so the hook above does not see it.
        if pkg.docstring is not None:
            pkg.docstring.value = markdown(pkg.docstring.value)
