"""Every sentence that a user can be refused with, collected from the sources, so that none is missing: every
BlinkGLError that is made, and what the configuration's validators say. ``{…}`` stands where a value goes. Errors made
by a helper that is given its sentence are listed where the helper is called.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("blinkgl", "eflow", "tools")


def error_classes(nodes: dict[str, list[ast.AST]]) -> set[str]:
    """Names of BlinkGLError and everything that inherits from it, however far. ``nodes``: of every file's tree."""
    parents = {
        node.name: {base.id for base in node.bases if isinstance(base, ast.Name)}
        for tree in nodes.values()
        for node in tree
        if isinstance(node, ast.ClassDef)
    }
    found = {"BlinkGLError"}
    while more := {name for name, bases in parents.items() if bases & found} - found:
        found |= more
    return found


def template(node: ast.expr | None) -> str:
    """What an expression says, with {name} for what is filled in."""
    if node is None:
        return ""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(
            str(v.value) if isinstance(v, ast.Constant) else "{" + _short(v.value) + "}" for v in node.values
        )
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return template(node.left) + template(node.right)
    if isinstance(node, ast.IfExp):
        return f"{template(node.body)} | {template(node.orelse)}"
    return "{" + _short(node) + "}"


def _short(node: ast.expr) -> str:
    text = " ".join(ast.unparse(node).split())
    return text if len(text) <= 40 else text[:39] + "…"


def _called(node: ast.Call) -> str:
    return (
        node.func.id
        if isinstance(node.func, ast.Name)
        else node.func.attr
        if isinstance(node.func, ast.Attribute)
        else ""
    )


def _sentence(call: ast.Call, problem: ast.expr | None) -> str:
    """As errors.py puts it together."""
    said = {k.arg: k.value for k in call.keywords if k.arg}
    line = template(problem if problem is not None else said.get("problem"))
    if "value" in said:
        line += " (got …)"
    if "accepted" in said:
        accepted = template(said["accepted"])
        line += f"; {accepted}" if accepted.startswith(("run ", "try ", "use ", "see ")) else f"; expected {accepted}"
    if "where" in said:
        line = f"{template(said['where'])}: {line}"
    return " ".join(line.split())


def _functions(nodes: list[ast.AST]) -> Iterator[tuple[ast.FunctionDef | ast.AsyncFunctionDef, list[str]]]:
    for node in nodes:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node, [a.arg for a in (*node.args.posonlyargs, *node.args.args)]


def _passed_on(node: ast.AST, classes: set[str]) -> str | None:
    """The name of what an error is given for its sentence, where it is a name alone."""
    if isinstance(node, ast.Call) and _called(node) in classes and node.args and isinstance(node.args[0], ast.Name):
        return node.args[0].id
    return None


@cache
def sentences() -> dict[str, list[str]]:
    """Module -> its sentences, each once, in the order of the source."""
    nodes = {
        p.relative_to(ROOT).as_posix(): list(ast.walk(ast.parse(p.read_text())))
        for package in PACKAGES
        for p in sorted((ROOT / package).rglob("*.py"))
    }
    classes = error_classes(nodes)
    # Helpers that are given their sentence: name -> which argument it is.
    helpers: dict[str, tuple[int, str]] = {}
    for tree in nodes.values():
        given = {name for node in tree if (name := _passed_on(node, classes))}
        for function, parameters in _functions(tree):
            if given.isdisjoint(parameters):
                continue
            for node in ast.walk(function):
                name = _passed_on(node, classes)
                if name in parameters:
                    skip = 1 if parameters[0] in ("self", "cls") else 0
                    helpers[function.name] = (parameters.index(name) - skip, name)
    found: dict[str, list[str]] = {}
    for path, tree in nodes.items():
        lines: list[tuple[int, str]] = []
        for node in tree:
            if isinstance(node, ast.Call):
                name = _called(node)
                if (
                    name in classes
                    and node.args
                    and not (isinstance(node.args[0], ast.Name) and path != "blinkgl/errors.py")
                ):
                    lines.append((node.lineno, _sentence(node, node.args[0])))
                elif name in helpers:
                    index, keyword = helpers[name]
                    problem = (
                        node.args[index]
                        if 0 <= index < len(node.args)
                        else next((k.value for k in node.keywords if k.arg == keyword), None)
                    )
                    if problem is not None and not isinstance(problem, ast.Name):
                        lines.append((node.lineno, _sentence(node, problem)))
            elif (
                isinstance(node, ast.Raise)
                and path.split("/")[1] in ("config", "config.py")
                and isinstance(node.exc, ast.Call)
            ):
                # pydantic turns these into a ConfigError.
                if _called(node.exc) in ("ValueError", "PydanticCustomError") and node.exc.args:
                    lines.append((node.lineno, template(node.exc.args[-1])))
        if lines:
            found[path] = list(dict.fromkeys(line for _, line in sorted(lines)))
    return found
