"""Which lines of an expanded shader the preprocessor leaves alive: #if, #ifdef, #elif, #else, #define of plain values.

Function-like macros are not expanded: lines are kept or dropped whole, which is all that listing declarations needs.
The driver's own preprocessor remains the one that compiles. Conditions are of names, decimal numbers, ``defined``,
brackets, + - *, comparisons, ! && and ||; one of anything else counts as false.
"""

from __future__ import annotations

import ast
import operator
import re
from functools import lru_cache

_DIRECTIVE = re.compile(r"^\s*#\s*(\w+)\s*(.*?)\s*$")
_DEFINED = re.compile(r"\bdefined\b\s*(?:\(\s*([A-Za-z_]\w*)\s*\)|([A-Za-z_]\w*))")
_NAME = re.compile(r"\b[A-Za-z_]\w*\b")
_READABLE = re.compile(r"[\d\s()+*<>=!&|-]*")
_BINARY = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Eq: operator.eq, ast.NotEq: operator.ne,
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
}  # fmt: skip
_UNARY = {ast.UAdd: operator.pos, ast.USub: operator.neg, ast.Invert: operator.not_}
LONGEST = 500
"""Characters of a condition with its macros written out."""
DEEPEST = 10
"""Macros inside each other."""

_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)


def without_comments(text: str) -> list[str]:
    """Lines of ``text``, comments blanked, line numbers and columns kept."""
    out = []
    for line in text.split("\n"):
        told = _without_comments(line)
        if told is None:
            return _blanked(text).split("\n")
        out.append(told)
    return out


def _blanked(text: str) -> str:
    return _COMMENT.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)


@lru_cache(maxsize=1 << 14)  # the variants of a program have most of their lines in common
def _without_comments(line: str) -> str | None:
    """None: a comment goes on into the next line."""
    told = _blanked(line)
    return None if "/*" in told else told


@lru_cache(maxsize=1 << 14)
def _directive(line: str) -> tuple[str, str] | None:
    match = _DIRECTIVE.match(line)
    return match and (match[1], match[2])


def active_lines(text: str, defines: bool = False) -> list[tuple[int, str]]:
    """(line number from 1, line without comments) of the lines that are compiled; blank lines and directives left out.

    defines : keep the #define and #undef lines that are alive."""
    macros: dict[str, str] = {}
    stack: list[tuple[bool, bool, bool]] = []  # (enclosing alive, this branch alive, some branch was taken)
    alive, out = True, []
    for number, line in enumerate(without_comments(text), 1):
        directive = _directive(line)
        if not directive:
            if alive and line and not line.isspace():
                out.append((number, line))
            continue
        word, rest = directive
        if word in ("if", "ifdef", "ifndef"):
            truth = alive and (
                evaluate(rest, macros) if word == "if" else ((rest.split() or [""])[0] in macros) == (word == "ifdef")
            )
            stack.append((alive, truth, truth))
            alive = truth
        elif word in ("elif", "else") and stack:
            outer, _, taken = stack.pop()
            truth = outer and not taken and (word == "else" or evaluate(rest, macros))
            stack.append((outer, truth, taken or truth))
            alive = truth
        elif word == "endif" and stack:
            alive = stack.pop()[0]
        elif word in ("define", "undef") and alive:
            if defines:
                out.append((number, line))
            name, _, value = rest.partition(" ")
            if word == "undef":
                macros.pop(name, None)
            elif name:
                macros[name.split("(")[0]] = value.strip()
    return out


def evaluate(expression: str, macros: dict[str, str]) -> bool:
    """Truth of an #if expression; an undefined name is 0, and an expression that cannot be read is false."""
    text = _DEFINED.sub(lambda match: str(int((match[1] or match[2]) in macros)), expression)
    for _ in range(DEEPEST):
        text = _NAME.sub(lambda match: f"({macros[match[0]]})" if match[0] in macros else "0", text)
        if len(text) > LONGEST:
            return False
    if not _READABLE.fullmatch(text):
        return False
    # Python's ~ binds as tightly as C's !.
    python = re.sub(r"!(?!=)", "~", text).replace("&&", " and ").replace("||", " or ").strip()
    try:
        return bool(_value(ast.parse(python, mode="eval").body))
    except (SyntaxError, KeyError, ValueError, RecursionError, MemoryError):
        return False


def _value(node: ast.expr) -> int:
    """What an expression stands for. Raises KeyError for what is none of a condition."""
    match node:
        case ast.Constant(value=int(value)):
            return value
        case ast.BoolOp(op=ast.And(), values=parts):
            return all(map(_value, parts))
        case ast.BoolOp(values=parts):
            return any(map(_value, parts))
        case ast.UnaryOp(op=op, operand=operand):
            return _UNARY[type(op)](_value(operand))
        case ast.BinOp(left=left, op=op, right=right) | ast.Compare(left=left, ops=[op], comparators=[right]):
            return _BINARY[type(op)](_value(left), _value(right))
    raise KeyError(type(node).__name__)
