"""Which lines of an expanded shader the preprocessor leaves alive: #if, #ifdef, #elif, #else, #define of plain values.

Function-like macros are not expanded: lines are kept or dropped whole, which is all that listing declarations needs. The driver's
own preprocessor remains the one that compiles."""

from __future__ import annotations

import re

_DIRECTIVE = re.compile(r"^\s*#\s*(\w+)\s*(.*?)\s*$")
_DEFINED = re.compile(r"\bdefined\s*(?:\(\s*(\w+)\s*\)|(\w+))")
_WORD = re.compile(r"\b[A-Za-z_]\w*\b")
_SAFE = re.compile(r"^[\s\d()!<>=&|+\-*/%^~x0-9a-fA-F]*$")


def without_comments(text: str) -> list[str]:
    """Lines of ``text``, comments blanked, line numbers and columns kept."""
    def blank(match: re.Match) -> str:
        return re.sub(r"[^\n]", " ", match[0])

    return re.sub(r"//[^\n]*|/\*.*?\*/", blank, text, flags=re.DOTALL).split("\n")


def active_lines(text: str) -> list[tuple[int, str]]:
    """(line number from 1, line without comments) of the lines that are compiled; directives and blank lines left out."""
    macros: dict[str, str] = {}
    stack: list[tuple[bool, bool, bool]] = []  # (enclosing alive, this branch alive, some branch was taken)
    alive, out = True, []
    for number, line in enumerate(without_comments(text), 1):
        match = _DIRECTIVE.match(line)
        if not match:
            if alive and line.strip():
                out.append((number, line))
            continue
        word, rest = match[1], match[2]
        if word in ("if", "ifdef", "ifndef"):
            truth = evaluate(rest, macros) if word == "if" else ((rest.split() or [""])[0] in macros) == (word == "ifdef")
            stack.append((alive, truth, truth))
            alive = alive and truth
        elif word in ("elif", "else") and stack:
            outer, _, taken = stack.pop()
            truth = not taken and (word == "else" or evaluate(rest, macros))
            stack.append((outer, truth, taken or truth))
            alive = outer and truth
        elif word == "endif" and stack:
            alive = stack.pop()[0]
        elif word == "define" and alive and rest:
            name, _, value = rest.partition(" ")
            macros[name.split("(")[0]] = value.strip()
        elif word == "undef":
            macros.pop(rest, None)
    return out


def evaluate(expression: str, macros: dict[str, str]) -> bool:
    """Truth of an #if expression; an undefined name is 0, and so is an expression that cannot be read."""
    text = _DEFINED.sub(lambda m: "1" if (m[1] or m[2]) in macros else "0", expression)
    for _ in range(8):  # macros that name macros
        replaced = _WORD.sub(lambda m: macros.get(m[0], "0") or "0", text)
        if replaced == text:
            break
        text = replaced
    if not _SAFE.match(text):
        return False
    text = text.replace("&&", " and ").replace("||", " or ")
    text = re.sub(r"!(?!=)", " not ", text)
    try:
        return bool(eval(text, {"__builtins__": {}}))  # noqa: S307 (digits and operators only, see _SAFE)
    except (SyntaxError, ZeroDivisionError, TypeError, ValueError):
        return False
