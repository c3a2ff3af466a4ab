"""The project's own Python files as syntax trees, for tests of who may say what."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def parsed(*folders: str, words: tuple[str, ...]) -> Iterator[tuple[str, list[ast.AST]]]:
    """(path relative to the repository, every node of its tree) of the Python files below ``folders`` in whose text one
    of ``words`` stands. Most of five hundred files have none of what a test looks for: to parse and walk them all takes
    seconds."""
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if any(word in text for word in words):
                yield path.relative_to(ROOT).as_posix(), list(ast.walk(ast.parse(text)))
