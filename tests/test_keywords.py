"""Order is no contract: records of many values are made by keyword, since two neighbours of one type swap silently."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST = 6


def records(trees):
    """Names of the project's dataclasses and named tuples."""
    for tree in trees:
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                words = [*map(ast.unparse, node.bases), *map(ast.unparse, node.decorator_list)]
                if any(word == "NamedTuple" or "dataclass" in word for word in words):
                    yield node.name


def test_records_of_many_values_are_made_by_keyword():
    trees = {p: ast.parse(p.read_text()) for room in ("blinkgl", "eflow") for p in (ROOT / room).rglob("*.py")}
    known, long = set(records(trees.values())), []
    for path, tree in trees.items():
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            name = getattr(call.func, "id", getattr(call.func, "attr", ""))
            if name in known and sum(not isinstance(one, ast.Starred) for one in call.args) > MOST:
                long.append(f"{path.relative_to(ROOT)}:{call.lineno}: {name}, {len(call.args)} values by position")
    assert long == []
