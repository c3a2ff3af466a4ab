"""Which lines of an expanded shader the preprocessor leaves alive: #if, #ifdef, #elif, #else, #define of plain values.

Function-like macros are not expanded: lines are kept or dropped whole, which is all that listing declarations needs.
The driver's own preprocessor remains the one that compiles. Conditions are those of GLSL 4.60, section 3.3: the
operators of C on 32-bit integers, in a time that grows with the length of the text alone, whatever it says."""

from __future__ import annotations

import re
from functools import lru_cache

_DIRECTIVE = re.compile(r"^\s*#\s*(\w+)\s*(.*?)\s*$")
_TOKEN = re.compile(
    r"\s*(?:(?P<number>\d\w*)|(?P<name>[A-Za-z_]\w*)|(?P<operator><<|>>|<=|>=|==|!=|&&|\|\||[-+*/%<>&^|!~()]))"
)
_PRECEDENCE = {
    op: level
    for level, ops in enumerate(
        (
            ("||",),
            ("&&",),
            ("|",),
            ("^",),
            ("&",),
            ("==", "!="),
            ("<", ">", "<=", ">="),
            ("<<", ">>"),
            ("+", "-"),
            ("*", "/", "%"),
        )
    )
    for op in ops
}
MOST_TOKENS = 10_000  # of one condition with its macros written out
DEEPEST = 100  # parentheses and signs inside each other


class ConditionError(ValueError):
    """An #if expression that GLSL's preprocessor does not take."""


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
    try:
        return value(expression, macros) != 0
    except ConditionError:
        return False


def value(expression: str, macros: dict[str, str]) -> int:
    """The 32-bit integer that an #if expression stands for, names that are not ``macros`` being 0.

    A macro's own name is not expanded again inside its expansion (C++98 16.3.4, which GLSL
    follows). Raises ConditionError."""
    return _Reader(_expanded(expression, macros)).all()


def _tokens(text: str) -> list[str]:
    out, position, text = [], 0, text.rstrip()
    while position < len(text):
        match = _TOKEN.match(text, position)
        if not match:
            raise ConditionError(f"not of a condition: {text[position : position + 20].strip()!r}")
        out.append(match[match.lastgroup])
        position = match.end()
        if len(out) > MOST_TOKENS:
            raise ConditionError("too long")
    return out


def _expanded(expression: str, macros: dict[str, str]) -> list[str]:
    """Tokens with ``defined`` answered and macros written out."""
    out: list[str] = []
    # Each entry: a token, and the macros it came out of, as a linked list.
    todo: list[tuple[str, tuple | None]] = [(token, None) for token in reversed(_tokens(expression))]
    steps = 0
    while todo:
        token, inside = todo.pop()
        steps += 1
        if steps > MOST_TOKENS:
            raise ConditionError("too long when its macros are written out")
        if token == "defined":
            bracket = bool(todo) and todo[-1][0] == "("
            if bracket:
                todo.pop()
            name = todo.pop()[0] if todo else ""
            if not re.match(r"[A-Za-z_]", name) or (bracket and not (todo and todo.pop()[0] == ")")):
                raise ConditionError("defined wants a name")
            out.append("1" if name in macros else "0")
        elif token in macros and not _came_from(token, inside):
            body = _tokens(macros[token])
            if not body:
                raise ConditionError(f"{token} is defined as nothing")
            todo += [(t, (token, inside)) for t in reversed(body)]
        else:
            out.append(token)
    return out


def _came_from(token: str, inside: tuple | None) -> bool:
    while inside is not None:
        if inside[0] == token:
            return True
        inside = inside[1]
    return False


def _wrapped(number: int) -> int:
    """As a signed integer of 32 bits."""
    return (number + 2**31) % 2**32 - 2**31


class _Reader:
    """Precedence climbing over tokens. && and || do not judge what they need not (1 || 1 / 0)."""

    def __init__(self, tokens: list[str]):
        self.tokens, self.at, self.depth = tokens, 0, 0

    def all(self) -> int:
        result = self.binary(0, True)
        if self.at != len(self.tokens):
            raise ConditionError(f"unexpected {self.tokens[self.at]!r}")
        return result

    def next(self) -> str:
        if self.at >= len(self.tokens):
            raise ConditionError("ends too early")
        self.at += 1
        return self.tokens[self.at - 1]

    def binary(self, lowest: int, needed: bool) -> int:
        left = self.unary(needed)
        while self.at < len(self.tokens) and _PRECEDENCE.get(self.tokens[self.at], -1) >= lowest:
            operator = self.next()
            matters = needed and not ((operator == "&&" and left == 0) or (operator == "||" and left != 0))
            right = self.binary(_PRECEDENCE[operator] + 1, matters)
            left = _apply(operator, left, right, matters)
        return left

    def unary(self, needed: bool) -> int:
        self.depth += 1
        if self.depth > DEEPEST:
            raise ConditionError("nested too deeply")
        try:
            token = self.next()
            if token == "(":
                result = self.binary(0, needed)
                if self.next() != ")":
                    raise ConditionError("a bracket is not closed")
                return result
            if token in ("+", "-", "!", "~"):
                operand = self.unary(needed)
                return {"+": operand, "-": _wrapped(-operand), "!": int(operand == 0), "~": ~operand}[token]
            return _number(token)
        finally:
            self.depth -= 1


def _number(token: str) -> int:
    """Of 0x1F, 017, 42u; 0 of a name."""
    if not token[0].isdigit():
        if re.match(r"[A-Za-z_]", token):
            return 0
        raise ConditionError(f"unexpected {token!r}")
    digits = token[:-1] if token[-1] in "uU" else token
    for pattern, base in ((r"0[xX][0-9a-fA-F]+", 16), (r"0[0-7]*", 8), (r"[1-9][0-9]*", 10)):
        if re.fullmatch(pattern, digits):
            if len(digits) > 40:  # before int(), which takes time and refuses thousands of digits
                raise ConditionError("a number of more than 32 bits")
            number = int(digits, base)
            if number >= 2**32:
                raise ConditionError("a number of more than 32 bits")
            return _wrapped(number)
    raise ConditionError(f"not an integer: {token!r}")


def _apply(operator: str, a: int, b: int, matters: bool) -> int:
    if operator == "&&":
        return int(a != 0 and b != 0)
    if operator == "||":
        return int(a != 0 or b != 0)
    if operator in ("/", "%"):
        if b == 0:
            if matters:
                raise ConditionError("division by zero")
            return 0
        quotient = abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)  # C rounds towards zero
        return _wrapped(quotient if operator == "/" else a - quotient * b)
    if operator in ("<<", ">>"):
        b &= 31  # GLSL leaves shifts by more undefined; this is what processors do
    return _wrapped(
        {
            "|": lambda: a | b,
            "^": lambda: a ^ b,
            "&": lambda: a & b,
            "==": lambda: int(a == b),
            "!=": lambda: int(a != b),
            "<": lambda: int(a < b),
            ">": lambda: int(a > b),
            "<=": lambda: int(a <= b),
            ">=": lambda: int(a >= b),
            "<<": lambda: a << b,
            ">>": lambda: a >> b,
            "+": lambda: a + b,
            "-": lambda: a - b,
            "*": lambda: a * b,
        }[operator]()
    )
