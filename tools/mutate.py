"""A small mutation run: are there tests that notice when a line is wrong?

    python -m blinkgl.tools.mutate --map                 # once per commit: which test runs which line
    python -m blinkgl.tools.mutate --count 200 --seed 1  # draw mutants, run the tests that reach each, print survivors
    python -m blinkgl.tools.mutate --show blinkgl/render/matrices.py     # the mutants of a module, without running any
    python -m blinkgl.tools.mutate --only blinkgl/render/matrices.py:41  # those of a line

``--map`` runs the suite under coverage.
A mutant is one small edit of one line: an operator, a comparison, a constant, a condition, a statement left out. It is
made in a copy of the tree, so nothing here is touched. The tests that reached its line run, its module's own first,
until one fails (killed), the time is up (killed: "time"), or all passed (survived). Lines that no test reaches are
survivors without a run. What coverage cannot see is compiled: a numba kernel is given all tests of its module's
callers, a shader those of ``tests/render`` and ``tests/extremes``.

What takes time is starting, not testing. So the tests of a mutant run in a child of a process (``--serve``, one per
copy) that has imported what the tree stands on (numpy, numba, pytest, ...) and nothing of the tree itself. A kernel's
machine code is taken from the cache unless the edit can be in it: an edited kernel, a constant that kernels may hold,
and the kernels of every module that imports it are compiled again.

Exit status 1 when less than ``--at-least`` (0.9) of the mutants died. Mutants that change nothing a test could see (an
estimate that only saves time, say) are listed with the reason in
``tools/mutants_equivalent.txt``, printed, and not counted.
"""

from __future__ import annotations

import argparse
import ast
import collections
import concurrent.futures
import contextlib
import gc
import hashlib
import importlib
import json
import math
import os
import random
import re
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("render", "timeline", "events", "scene", "io", "dataset", "sequence", "camera", "labels", "recordings")
MAP = ROOT / ".scratch" / "mutate"
EQUIVALENT = ROOT / "tools" / "mutants_equivalent.txt"
SHARED_CODE = (
    "blinkgl",
    "eflow",
    "shaders",
    "configs",
    "tools",
    "tests",
    "setup.cfg",
    "README.md",
    "docs",
    "Makefile",
    "constraints.txt",
    "pyproject.toml",
    "examples",
)
FOR_CHECKERS_ALONE = ("TYPE_CHECKING", "False")
"""The one edit that is none by its kind."""
DEBUGGERS = "shaders/include/lookup.glsl"
"""the include that only the shader debugger asks for"""
LOOKERS = tuple(f"tests/test_rooms.py::test_{name}" for name in ("a_record", "records", "doors"))
"""tests that look at dataclasses and signatures of the whole package, whichever test it was that imported them first"""
MOST_TESTS, MOST_S = 300, 120.0
"""of the tests that reach a line, for one mutant: how many, and how long they take together"""
MEMORY = 6 << 30
"""bytes: a mutant that never stops collecting must not take the machine with it"""

PRELOADED = (
    "numpy",
    "numba",
    "scipy.interpolate",
    "scipy.ndimage",
    "scipy.spatial.transform",
    "scipy.optimize",
    "scipy.special",
    "cv2",
    "h5py",
    "hdf5plugin",
    "pydantic",
    "yaml",
    "typer",
    "rich.console",
    "rich.table",
    "rich.progress",
    "PIL.Image",
    "imageio.v3",
    "moderngl",
    "trimesh",
    "networkx",
    "fcl",
    "fast_simplification",
    "pytest",
    "_pytest.doctest",
    "hypothesis",
    "hypothesis.strategies",
    "hypothesis.extra.numpy",
    "concurrent.futures.process",
    "multiprocessing.pool",
    "http.server",
    "urllib.request",
    "sqlite3",
    "unittest.mock",
    "tarfile",
)
"""what the server imports before it forks; none of them starts a thread or opens a display when it is imported"""

COMPILED = re.compile(r"\b(njit|jit|vectorize|register_jitable|overload|intrinsic)\b")
"""in a decorator: the function is compiled, alone or into the kernels that call it"""

ARITHMETIC = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "*",
    ast.Pow: "*",
    ast.MatMult: None,
    ast.BitAnd: "|",
    ast.BitOr: "&",
    ast.BitXor: "|",
    ast.LShift: ">>",
    ast.RShift: "<<",
}
COMPARISON = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
}
REVERSED = {ast.Lt: ">", ast.LtE: ">", ast.Gt: "<", ast.GtE: "<"}
NAMES = {
    "min": "max",
    "max": "min",
    "floor": "ceil",
    "ceil": "floor",
    "any": "all",
    "all": "any",
    "minimum": "maximum",
    "maximum": "minimum",
    "sin": "cos",
    "cos": "sin",
    "argmin": "argmax",
    "argmax": "argmin",
    "zeros": "ones",
    "ones": "zeros",
}


@dataclass(frozen=True)
class Mutant:
    """``before`` at (line, column), both from 1, of a file becomes ``after``."""

    path: str
    line: int
    column: int
    before: str
    after: str
    operator: str
    compiled: bool = False
    """in a numba kernel or a shader, which coverage does not see"""

    @property
    def name(self) -> str:
        shorten = lambda text: " ".join(text.split())[:60]
        return f"{self.path}:{self.line}:{self.column}: {shorten(self.before)} -> {shorten(self.after) or '(nothing)'}"

    def apply(self, source: str) -> str:
        """``source`` with the edit. Raises ValueError where the text is another."""
        lines = source.splitlines(keepends=True)
        start = sum(map(len, lines[: self.line - 1])) + self.column - 1
        if source[start : start + len(self.before)] != self.before:
            raise ValueError(f"not the source this mutant was made for: {self.name}")
        return source[:start] + self.after + source[start + len(self.before) :]


class _Finder(ast.NodeVisitor):
    def __init__(self, path: str, source: str):
        self.path, self.source, self.found, self.compiled = path, source, [], False
        self.statement: ast.stmt | None = None
        self.starts = [0]
        for line in source.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))

    def visit(self, node):
        """Of a statement, it is the part of the source that has to parse with an edit inside it."""
        outer = self.statement
        if isinstance(node, ast.stmt):
            self.statement = node
        super().visit(node)
        self.statement = outer

    def parses(self, start: int, end: int, after: str) -> bool:
        """Whether the innermost statement round an edit still is one."""
        node = self.statement
        first = self.starts[min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", ()))]) - 1]
        text = self.source[first:start] + after + self.source[end : self.span(node)[1]]
        text = re.sub(r"\A(\s*)elif\b", r"\1if", text)  # a statement of its own in the tree
        try:
            ast.parse(f"if True:\n{text}" if text[0] in " \t" else text)
        except SyntaxError:
            return False
        return True

    def offset(self, line: int, byte_column: int) -> int:
        text = self.source[self.starts[line - 1] : self.starts[line]]
        return self.starts[line - 1] + len(text.encode()[:byte_column].decode())

    def span(self, node) -> tuple[int, int]:
        return self.offset(node.lineno, node.col_offset), self.offset(node.end_lineno, node.end_col_offset)

    def add(self, start: int, end: int, after: str, operator: str) -> None:
        line = self.source.count("\n", 0, start) + 1
        mutant = Mutant(
            self.path, line, start - self.starts[line - 1] + 1, self.source[start:end], after, operator, self.compiled
        )
        if mutant.before != mutant.after and self.parses(start, end, after):
            self.found.append(mutant)

    def between(self, left, right, symbol: str, operator: str) -> None:
        """The operator's symbol between two operands, brackets and comments left alone."""
        start, end = self.span(left)[1], self.span(right)[0]
        gap = re.search(r"(?:not\s+in|is\s+not|[-+*/%@&|^<>=!]+|\bin\b|\bis\b|\band\b|\bor\b)", self.source[start:end])
        if gap:
            self.add(start + gap.start(), start + gap.end(), symbol, operator)

    def visit_FunctionDef(self, node) -> None:
        if node.name in ("__repr__", "__str__"):
            return
        outer = self.compiled
        self.compiled = outer or any(COMPILED.search(ast.unparse(d)) for d in node.decorator_list)
        for statement in node.body:
            self.visit(statement)
        self.compiled = outer

    def visit_AnnAssign(self, node) -> None:
        if node.value is not None and not (
            isinstance(node.value, ast.Call) and getattr(node.value.func, "id", "") in ("Field", "field")
        ):
            self.visit(node.value)

    def visit_Expr(self, node) -> None:
        if isinstance(node.value, ast.Constant):
            return  # a docstring
        if isinstance(node.value, ast.Call):
            self.add(*self.span(node), "None" if not self.compiled else "pass", "statement left out")
        self.visit(node.value)

    def visit_Raise(self, node) -> None:
        self.add(*self.span(node), "pass", "raise left out")

    def visit_AugAssign(self, node) -> None:
        symbol = ARITHMETIC.get(type(node.op))
        if symbol:
            start, end = self.span(node.target)[1], self.span(node.value)[0]
            found = re.search(r"\S+=", self.source[start:end])
            self.add(start + found.start(), start + found.end(), symbol + "=", "arithmetic")
        self.visit(node.value)

    def visit_BinOp(self, node) -> None:
        symbol = ARITHMETIC.get(type(node.op))
        literal = lambda n: (
            isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, (str, bytes)))
        )
        if symbol and not literal(node.left) and not literal(node.right):
            self.between(node.left, node.right, symbol, "arithmetic")
        self.generic_visit(node)

    def visit_Compare(self, node) -> None:
        left = node.left
        for op, right in zip(node.ops, node.comparators):
            self.between(left, right, COMPARISON[type(op)], "comparison")
            if type(op) in REVERSED:
                self.between(left, right, REVERSED[type(op)], "comparison reversed")
            left = right
        self.generic_visit(node)

    def visit_BoolOp(self, node) -> None:
        for left, right in zip(node.values, node.values[1:]):
            self.between(left, right, "or" if isinstance(node.op, ast.And) else "and", "boolean")
        self.generic_visit(node)

    def visit_UnaryOp(self, node) -> None:
        start, _end = self.span(node)
        inner = self.span(node.operand)[0]
        if isinstance(node.op, (ast.Not, ast.USub)):
            self.add(start, inner, "", "negation left out")
        self.visit(node.operand)

    def visit_If(self, node) -> None:
        for value in ("True", "False"):
            self.add(*self.span(node.test), value, "condition")
        self.generic_visit(node)

    def visit_IfExp(self, node) -> None:
        for value in ("True", "False"):
            self.add(*self.span(node.test), value, "condition")
        self.generic_visit(node)

    def visit_Constant(self, node) -> None:
        value, (start, end) = node.value, self.span(node)
        if value is True or value is False:
            self.add(start, end, str(not value), "constant")
        elif isinstance(value, int):
            self.add(start, end, str(value + 1), "constant")
        elif isinstance(value, float):
            self.add(start, end, repr(value * 1.5 if value else 1.0), "constant")

    def visit_JoinedStr(self, node) -> None:
        """Text is for people."""

    def visit_Name(self, node) -> None:
        if node.id in NAMES and isinstance(node.ctx, ast.Load):
            self.add(*self.span(node), NAMES[node.id], "function")

    def visit_Attribute(self, node) -> None:
        if node.attr in NAMES:
            _start, end = self.span(node)
            self.add(end - len(node.attr), end, NAMES[node.attr], "function")
        self.visit(node.value)

    def visit_keyword(self, node) -> None:
        # What an error says is golden text, tested as such.
        if node.arg not in ("description", "accepted", "where", "value"):
            self.visit(node.value)


GLSL = (
    (re.compile(r"(?<=[\w)\]]) ([-+*/]) (?=[\w(-])"), {"+": "-", "-": "+", "*": "/", "/": "*"}, "arithmetic"),
    (
        re.compile(r"(?<=[\w)\]]) (<=|>=|<|>|==|!=|&&|\|\|) (?=[\w(-])"),
        {"<": ">", ">": "<", "<=": ">", ">=": "<", "==": "!=", "!=": "==", "&&": "||", "||": "&&"},
        "comparison",
    ),
    (
        re.compile(r"\b(min|max|dFdx|dFdy)(?=\()"),
        {"min": "max", "max": "min", "dFdx": "dFdy", "dFdy": "dFdx"},
        "function",
    ),
    (re.compile(r"(?<![\w.])(\d+\.\d+)(?![\w.])"), None, "constant"),
    (re.compile(r"(?<=[=(,] )(-)(?=[a-z(])"), {"-": ""}, "negation left out"),
)


def mutants_of(path: str, source: str) -> list[Mutant]:
    """All of a Python module or a shader, in the order of the lines. ``path`` is relative to the repository."""
    if not path.endswith(".glsl"):
        finder = _Finder(path, source)
        finder.visit(ast.parse(source))
        return sorted(set(finder.found), key=lambda m: (m.line, m.column, m.after))
    found = []
    for number, line in enumerate(source.splitlines(), 1):
        code = line.split("//")[0]
        if code.lstrip().startswith("#"):
            continue
        for pattern, table, operator in GLSL:
            for match in pattern.finditer(code):
                text = match.group(1)
                after = table[text] if table else (repr(float(text) * 1.5) if float(text) else "1.0")
                found.append(Mutant(path, number, match.start(1) + 1, text, after, operator, compiled=True))
    return found


def modules(room: str) -> list[str]:
    paths = [p for p in (ROOT / "blinkgl" / room).rglob("*.py") if p.name != "__init__.py"]
    if room == "render":
        paths += (ROOT / "shaders").rglob("*.glsl")
    return sorted(p.relative_to(ROOT).as_posix() for p in paths)


def drawn(count: int, seed: int) -> list[Mutant]:
    """``count`` mutants, the same number from every room, at most one of a line."""
    dice, chosen = random.Random(seed), []
    for k, room in enumerate(ROOMS):
        everything = [
            m
            for path in modules(room)
            if path != "shaders/debug.glsl"
            for m in mutants_of(path, (ROOT / path).read_text())
        ]
        dice.shuffle(everything)
        lines, few = set(), count // len(ROOMS) + (k < count % len(ROOMS))
        for mutant in everything:
            if (mutant.path, mutant.line) not in lines and few:
                lines.add((mutant.path, mutant.line))
                chosen.append((few, mutant))
                few -= 1
    # In turns over the rooms, so that a run that is stopped says something about all of them.
    return [mutant for _, mutant in sorted(chosen, key=lambda pair: -pair[0])]


# ---- which tests reach a line --------------------------------------------------------------------------------------


def make_map(jobs: str, tests: list[str]) -> None:
    """Runs the suite under coverage and keeps who ran what, and how long it took. With
    ``tests``, adds those to what is known."""
    MAP.mkdir(parents=True, exist_ok=True)
    sources = {p: (ROOT / p).read_text() for room in ROOMS for p in modules(room)}
    known = sorted(MAP.glob("durations*.xml"))
    if not tests:
        for old in known:
            old.unlink()
    elif json.loads((MAP / "sources.json").read_text()) != sources:
        raise SystemExit("the source has changed since --map: make the whole map again")
    environment = {**os.environ, "COVERAGE_FILE": str(MAP / "coverage.db")}
    status = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-n",
            jobs,
            "--dist",
            "worksteal",
            "--cov=blinkgl",
            "--cov-context=test",
            "--cov-report=term:skip-covered",
            f"--junitxml={MAP / f'durations{len(known) if tests else 0}.xml'}",
            *(["--cov-append"] if tests else []),
            *tests,
        ],
        cwd=ROOT,
        env=environment,
    ).returncode
    if status not in (0, 1):
        raise SystemExit("the suite cannot be run")
    if status:
        print("tests that failed have no say")
    (MAP / "sources.json").write_text(json.dumps(sources))


def _called_at_import(folder: Path) -> set[str]:
    """Names of functions that are called when a module of ``blinkgl`` is imported: what they
    return may be a constant of a kernel."""
    names = set()

    def visit(node) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Call):
                names.add(child.func.attr if isinstance(child.func, ast.Attribute) else getattr(child.func, "id", ""))
            if not isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
                visit(child)

    for path in sorted((folder / "blinkgl").rglob("*.py")):
        visit(ast.parse(path.read_text()))
    return names


class Kernels:
    """Which modules hold kernels, and which of them must be compiled again for a mutant."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.files = [p for p in (folder / "blinkgl").rglob("*.py") if "__pycache__" not in p.parts]
        self.holders = {
            p.relative_to(folder).as_posix()
            for p in self.files
            if re.search(rf"^\s*@.*{COMPILED.pattern}", p.read_text(), re.M)
        }
        self.imports = {p.relative_to(folder).as_posix(): self._imported(p) for p in self.files}
        self.early = _called_at_import(folder)

    def _imported(self, path: Path) -> set[str]:
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("blinkgl"):
                names = [node.module] + [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names if alias.name.startswith("blinkgl")]
            else:
                continue
            for name in names:
                found |= {
                    p
                    for p in (name.replace(".", "/") + ".py", name.replace(".", "/") + "/__init__.py")
                    if (self.folder / p).exists()
                }
        return found

    def users(self, path: str) -> set[str]:
        """Modules that import ``path``, themselves or by way of another; ``path`` among them."""
        known, new = set(), {path}
        while new:
            known |= new
            new = {p for p, imported in self.imports.items() if imported & new} - known
        return known

    def stale(self, mutant: Mutant) -> set[str]:
        """Modules whose kernels may contain what the mutant changed. An edit inside a function that is not compiled and
        not called on import reaches no kernel: those are compiled from other functions and
        from the constants of modules."""
        if not mutant.path.endswith(".py"):
            return set()
        tree = ast.parse((self.folder / mutant.path).read_text())
        around = [
            n
            for n in ast.walk(tree)
            if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))
            and n.body[0].lineno <= mutant.line <= n.end_lineno
        ]
        if around and not mutant.compiled and not self.early & {n.name for n in around}:
            return set()
        return self.users(mutant.path) & self.holders

    def cache(self, stale: set[str], into: Path) -> None:
        """Links what was compiled to ``into``, laid out as numba wants its NUMBA_CACHE_DIR, without what is stale."""
        for folder in {(self.folder / p).parent for p in self.holders}:
            inner = into / f"{folder.name}_{hashlib.sha1(str(folder).encode()).hexdigest()}"
            inner.mkdir()
            old = {Path(p).stem for p in stale if (self.folder / p).parent == folder}
            for file in (folder / "__pycache__").glob("*.nb[ic]"):
                if file.name.split(".")[0] not in old:
                    os.link(file, inner / file.name)


def _remembered(mutant: Mutant) -> bool:
    """Whether the line is in a function whose results are kept: then only the first test
    that asked in a process ran it."""
    tree = ast.parse((ROOT / mutant.path).read_text())
    return any(
        isinstance(node, ast.FunctionDef)
        and node.lineno <= mutant.line <= node.end_lineno
        and any("cache" in ast.unparse(d) for d in node.decorator_list)
        for node in ast.walk(tree)
        if not COMPILED.search(" ".join(ast.unparse(d) for d in getattr(node, "decorator_list", ())))
    )


def _on_import(mutant: Mutant) -> bool:
    """Whether the line runs when its module is imported: a decorator, a default, a constant."""
    return not any(
        isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and node.body[0].lineno <= mutant.line <= node.end_lineno
        for node in ast.walk(ast.parse((ROOT / mutant.path).read_text()))
    )


class Reach:
    """Test ids by line, from :func:`make_map`."""

    most_s = math.inf

    def __init__(self):
        if not (MAP / "coverage.db").exists():
            raise SystemExit("run with --map first: it finds out which test runs which line")
        import coverage

        self.data = coverage.CoverageData(str(MAP / "coverage.db"))
        self.data.read()
        self.sources = json.loads((MAP / "sources.json").read_text())
        self.seconds: dict[str, float] = {}
        self.idle: set[str] = set()  # skipped or failed
        for durations in sorted(MAP.glob("durations*.xml")):
            for case in ElementTree.parse(durations).iter("testcase"):
                test = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
                self.seconds[test] = float(case.get("time", 0))
                if (
                    case.find("failure") is not None
                    or case.find("error") is not None
                    or case.find("skipped") is not None
                ):
                    self.idle.add(test)
        self._lines: dict[str, dict[int, list[str]]] = {}
        self._anywhere: dict[str, set[str]] = {}
        self.kernels = Kernels(ROOT)

    def lines(self, path: str) -> dict[int, list[str]]:
        if path not in self._lines:
            tests = {}  # one object for each name
            by_line = self.data.contexts_by_lineno(str(ROOT / path)).items()
            self._lines[path] = {
                line: sorted({tests.setdefault(c, c) for c in (c.rsplit("|", 1)[0] for c in contexts)})
                for line, contexts in by_line
            }
            self._anywhere[path] = {c for contexts in self._lines[path].values() for c in contexts if c}
        return self._lines[path]

    def anywhere(self, path: str) -> set[str]:
        """Tests that run any line of a module."""
        self.lines(path)
        return self._anywhere[path]

    def tests(self, mutant: Mutant) -> list[str]:
        """In the order in which they run: the module's own file, its room, the others; quick files and tests first.
        Empty: none reaches the line."""
        if mutant.path in self.sources and self.sources[mutant.path] != (ROOT / mutant.path).read_text():
            raise SystemExit(f"{mutant.path} has changed since --map: run it again")
        if mutant.path.endswith(".glsl"):
            users = ("tests/tools/test_shader_",) if mutant.path == DEBUGGERS else ("tests/render/", "tests/extremes/")
            contexts = [t for t in self.seconds if t.startswith(users) and "pyrender" not in t and "cycles" not in t]
        else:
            room = f"tests/{Path(mutant.path).parts[1]}/"
            reached = self.anywhere(mutant.path)
            if not reached:  # compiled as a whole, or run in a process of its own
                contexts = [t for t in self.seconds if t.startswith(room)]
            elif mutant.compiled:
                callers = self.kernels.users(mutant.path) & self.kernels.holders
                contexts = set().union(*(self.anywhere(path) for path in callers))
            else:
                contexts = reached if _remembered(mutant) else self._around(mutant)
                if _on_import(mutant):
                    contexts = [*contexts, *(t for t in self.seconds if t.startswith(LOOKERS))]
        ids = (set(contexts) & self.seconds.keys()) - self.idle
        chosen, together = [], 0.0
        for test in sorted(ids, key=lambda t: (self._distance(mutant, t), self.seconds.get(t, 1.0), t)):
            together += self.seconds.get(test, 1.0)
            if len(chosen) == MOST_TESTS or (chosen and together > MOST_S):
                break
            chosen.append(test)
        files = collections.defaultdict(list)  # a file's tests stay together: they share a context
        for test in chosen:
            files[test.split("::")[0]].append(self.seconds.get(test, 1.0))
        pace = {file: sum(seconds) / len(seconds) for file, seconds in files.items()}
        return sorted(
            chosen,
            key=lambda t: (
                self._distance(mutant, t),
                pace[t.split("::")[0]],
                t.split("::")[0],
                self.seconds.get(t, 1.0),
                t,
            ),
        )

    @staticmethod
    def _distance(mutant: Mutant, test: str) -> int:
        """0: a test of the module, 1: of its room, 2: of another."""
        path, file = Path(mutant.path), Path(test.split("::")[0])
        if file.stem == f"test_{path.stem}" or test.startswith(LOOKERS):
            return 0
        return 1 if file.parts[1] == ("render" if path.suffix == ".glsl" else path.parts[1]) else 2

    def _around(self, mutant: Mutant) -> list[str]:
        """Coverage names the first line of a statement only. What runs when a module is imported (a default, a
        constant) concerns all that use the module, shortest first."""
        lines = self.lines(mutant.path)
        for line in range(mutant.line, 0, -1):
            if line in lines:
                reached = [c for c in lines[line] if c]
                return reached or (list(self.anywhere(mutant.path)) if "" in lines[line] else [])
        return []


class ByName:
    """Without a map: the test files of a mutant are its module's own and those that name it, those of its room, or that
    import from it, that name something it defines, the room's others, and the others that import from the room, in this
    order, the quick ones among them first. For a machine that is too busy for the whole suite under coverage. Who
    survives might die in tests that are not among them, so the share of those that die is a lower bound."""

    seconds: ClassVar[dict[str, float]] = {}
    most_s = MOST_S / 3
    PEERS = (
        "tests/tools/",
        "tests/eflow/",
        "tests/render/test_peer_",
        "tests/render/test_pyrender",
        "tests/test_packaging",
    )

    def __init__(self):
        slow = re.compile(
            r"\b(run_dataset|generate_run|run|two_nodes|create_context|gl|Renderer|subprocess|explain|trade)\b"
        )
        files = {path.relative_to(ROOT).as_posix(): path.read_text() for path in (ROOT / "tests").rglob("test_*.py")}
        order = sorted(files, key=lambda f: (len(slow.findall(files[f])), f))
        self.texts = {file: files[file] + self._tools(files[file]) for file in order}  # quick ones first

    @staticmethod
    def _tools(text: str) -> str:
        """The programs of ``tools/`` that a test file imports: what they name is tested by it."""
        names = re.findall(r"from blinkgl\.tools(?:\.(\w+))? import ([\w, ]+)", text)
        tools = {ROOT / "tools" / f"{a or b}.py" for a, named in names for b in re.split(r",\s*", named)}
        return "".join(path.read_text() for path in sorted(tools) if path.exists())

    def tests(self, mutant: Mutant) -> list[str]:
        path, text = Path(mutant.path), (ROOT / mutant.path).read_text()
        if path.suffix == ".glsl":
            debugger = mutant.path == DEBUGGERS
            start = ("tests/tools/test_shader_",) if debugger else ("tests/render/", "tests/extremes/")
            return [f for f in self.texts if f.startswith(start) and (debugger or not self._peer(f))]
        defined = [n.name for n in ast.parse(text).body if hasattr(n, "name") and not n.name.startswith("_")]
        package, stem = ".".join(path.parts[:-1]), path.stem
        named = re.compile(rf"{re.escape(package)}\.{stem}\b|from {re.escape(package)} import [^)]*?\b{stem}\b", re.S)
        mentions = re.compile(rf"\b({'|'.join(map(re.escape, defined))})\b") if defined else None

        def rank(file: str) -> int:
            if Path(file).stem == f"test_{stem}" or named.search(self.texts[file]):
                return 0
            inside = file.startswith(f"tests/{path.parts[1]}/")
            if not inside and not re.search(rf"from blinkgl\.{path.parts[1]}\b", self.texts[file]):
                return 9
            of_all = len(Path(file).parts) == 2  # golden numbers and the like
            return 1 if of_all or (mentions and mentions.search(self.texts[file])) else 2 if inside else 3

        ranks = {file: rank(file) for file in self.texts if not self._peer(file)}
        looking = [LOOKERS[0].split("::")[0]] if _on_import(mutant) else []
        return [*looking, *sorted((f for f in ranks if ranks[f] < 9 and f not in looking), key=ranks.get)]

    def _peer(self, file: str) -> bool:
        return file.startswith(self.PEERS)


# ---- running -------------------------------------------------------------------------------------------------------


class Server:
    """A process that has imported what the tree needs and runs tests in children of its own (:func:`serve`)."""

    def __init__(self, folder: Path):
        environment = {
            **os.environ,
            "PYTHONPATH": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
            "LP_NUM_THREADS": "0",
            "PYGLET_HEADLESS": "1",
        }
        self.process = subprocess.Popen(
            [sys.executable, str(ROOT / "tools" / "mutate.py"), "--serve"],
            cwd=folder,
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def ask(self, order: dict) -> str:
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise RuntimeError("the process that runs the tests is gone")
        return json.loads(answer)

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(60)
        self.process.stdout.close()


def serve() -> int:
    """Reads orders from standard input, one JSON object a line; runs each in a child;
    answers "passed", "failed" or "time"."""
    here = str(ROOT / "tools")
    sys.path[:] = [p for p in sys.path if p != here]
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    import numba

    # Fills numba's tables of types, which it does when it compiles or loads the first kernel.
    numba.njit("f8(f8)")(lambda x: x + 1.0)
    taken = sorted(m for m in sys.modules if m.split(".")[0] in ("blinkgl", "eflow", "tests"))
    assert not taken, f"of the tree, before it is edited: {taken}"
    gc.collect()
    gc.freeze()
    answers = os.fdopen(os.dup(1), "w")
    os.set_inheritable(answers.fileno(), False)
    for line in iter(sys.stdin.readline, ""):
        order = json.loads(line)
        child = os.fork()
        if child == 0:
            try:
                os._exit(_run_tests(order))
            finally:  # also where pytest itself fails
                os._exit(99)
        outcome = _awaited(child, order["limit_s"])
        print(json.dumps(outcome), file=answers, flush=True)
    return 0


def _awaited(child: int, limit_s: float) -> str:
    handle = os.pidfd_open(child)
    # No order comes while one is carried out: when stdin can be read, who gives them is gone.
    ready, _, _ = select.select([handle, sys.stdin], [], [], limit_s)
    in_time = handle in ready
    os.close(handle)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child, signal.SIGKILL)  # the child, if it still runs, and what it started
    _, status = os.waitpid(child, 0)
    if not in_time or (os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGPROF, signal.SIGALRM)):
        return "time"
    return "passed" if os.WIFEXITED(status) and os.WEXITSTATUS(status) == 0 else "failed"


def _run_tests(order: dict) -> int:
    """In a child: the tests of ``order`` by the source as it is now."""
    os.setsid()
    output = os.open(order["output"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for old, new in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(old, new)
    # Not of address space, of which Ray maps more than it uses.
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    from numba.core import caching, config

    os.environ["NUMBA_CACHE_DIR"] = config.CACHE_DIR = order["kernels"]
    locator = caching._SourceFileBackedLocatorMixin  # noqa: SLF001 - there is no other way to a kernel's stamp
    original, stamp = order["original"], locator.get_source_stamp
    # An edit that no kernel contains leaves those of its file as they are, though the file is another.
    locator.get_source_stamp = lambda self: (
        bytes.fromhex(original[self._py_file]) if self._py_file in original else stamp(self)
    )
    sys.argv = ["pytest"]
    import pytest

    witness = _Witness(
        Path(order["output"]).with_suffix(".failed"),
        order["seconds"],
        order["spare_s"],
        order["wait_s"],
        order.get("most_s", math.inf),
    )
    left_out = [f"--deselect={test}" for test in order.get("left_out", ())]
    status = pytest.main(
        ["-x", "-q", "--no-header", *(f"-pno:{name}" for name in ("cacheprovider", "cov", "xdist"))]
        + [*left_out, *order["tests"]],
        plugins=[witness],
    )
    sys.stdout.flush()
    sys.stderr.flush()
    return 0 if witness.enough else int(status)


class _Witness:
    """A plugin of pytest that writes down which test failed, or which file could not be collected, and ends the process
    when a test takes many times the processor time that it took once (``seconds``; ``spare_s`` more
    for kernels that have to be compiled), or waits (``wait_s`` and 20 times as long as it took). After ``most_s`` of
    processor time it is ``enough``: no further test begins."""

    def __init__(self, path: Path, seconds: dict[str, float], spare_s: float, wait_s: float, most_s: float):
        self.path, self.seconds, self.spare_s, self.wait_s = path, seconds, spare_s, wait_s
        self.end_s, self.enough = time.process_time() + most_s, False

    @staticmethod
    def pytest_sessionstart(session) -> None:
        _Witness.session = session

    def pytest_runtest_logfinish(self, nodeid, location) -> None:
        if time.process_time() > self.end_s and not self.path.exists():
            self.enough = True
            self.session.shouldstop = "enough"

    def pytest_runtest_logstart(self, nodeid, location) -> None:
        seconds = self.seconds.get(nodeid, 10.0)
        signal.setitimer(signal.ITIMER_PROF, self.spare_s + 3 * seconds)
        # Who waits for what never comes takes no processor time; a machine that is busy is no deadlock.
        signal.setitimer(signal.ITIMER_REAL, self.wait_s + 20 * seconds)

    def pytest_runtest_logreport(self, report) -> None:
        if report.failed:
            self.path.write_text(report.nodeid)

    pytest_collectreport = pytest_runtest_logreport


class Copy:
    """A copy of the tree that a mutant lives in; ``blinkgl.shaders`` and its like are links
    to the copy's own folders."""

    def __init__(self, folder: Path):
        self.folder = folder
        for name in SHARED_CODE:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, folder / name, copy_function=shutil.copy2)
            elif (ROOT / name).exists():
                shutil.copy2(ROOT / name, folder / name)
        for inner in ("shaders", "configs", "tools"):
            (folder / "blinkgl" / inner).symlink_to(folder / inner)
        if (ROOT.parent / "shared").is_dir():
            os.environ.setdefault("BLINKGL_SHARED", str(ROOT.parent / "shared"))
        self.kernels = Kernels(folder)
        self.server = Server(folder)

    def run(
        self,
        tests: dict[str, float],
        spare_s: float,
        stale: set[str] = frozenset(),
        original: dict[str, str] | None = None,
        most_s: float = math.inf,
    ) -> tuple[str, str]:
        """("passed" | "failed" | "time", the test that failed, "" where the process died). ``tests``: with the seconds
        that each took. ``original``: digests of the sources of files that were edited outside of kernels. ``most_s`` of
        processor time after which no further test begins; then how long it takes is not limited by the tests' times."""
        failed = self.folder / "output.failed"
        failed.unlink(missing_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            self.kernels.cache(stale, Path(scratch))
            outcome = self.server.ask(
                {
                    "tests": list(tests),
                    "seconds": tests,
                    "spare_s": spare_s,
                    "wait_s": 120.0,
                    "limit_s": 10 * spare_s + 4 * sum(tests.values()) if most_s == math.inf else 3600.0,
                    "most_s": most_s,
                    "left_out": sorted(self.unfit),
                    "kernels": scratch,
                    "original": original or {},
                    "output": str(self.folder / "output.txt"),
                }
            )
        return outcome, failed.read_text() if outcome == "failed" and failed.exists() else ""

    def leave_out_what_is_gone(self, reach: Reach) -> None:
        """Tests of the map that cannot be collected any more have no say."""
        listing = subprocess.run(
            [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"],
            cwd=self.folder,
            text=True,
            env={**os.environ, "PYTHONPATH": str(self.folder)},
            stdout=subprocess.PIPE,
        ).stdout
        self.unfit |= set(reach.seconds) - set(listing.splitlines())

    sound: ClassVar[set[str]] = set()
    unfit: ClassVar[set[str]] = set()
    """tests that pass, and that fail, in a copy without any mutant; known to all copies"""

    def passes(self, test: str) -> bool:
        """Whether a test passes here with the source as it is; asked about each test once."""
        if test not in self.sound | self.unfit:
            (self.sound if self.run({test: 60.0}, 60)[0] == "passed" else self.unfit).add(test)
        return test in self.sound

    def judge(self, mutant: Mutant, reach: Reach | ByName) -> dict:
        tests = {t: reach.seconds.get(t, 1.0) for t in reach.tests(mutant) if t not in self.unfit}
        result = {**asdict(mutant), "name": mutant.name, "tests": len(tests), "by": ""}
        if not tests:
            return {**result, "outcome": "no test"}
        path = self.folder / mutant.path
        source = path.read_bytes()
        stale = self.kernels.stale(mutant)
        original = {} if mutant.path in stale else {str(path): hashlib.sha256(source).hexdigest()}
        started = time.monotonic()
        path.write_text(mutant.apply(source.decode()))
        try:
            outcome, failed = self.run(tests, 60 if stale else 15, stale, original, reach.most_s)
        finally:
            path.write_bytes(source)
        if outcome == "failed" and "::" in failed and not self.passes(failed):
            return self.judge(mutant, reach)  # it fails in a copy whatever the source says: it has no say
        if outcome == "failed" and not failed and self.run(tests, 60, most_s=reach.most_s) == ("failed", ""):
            return {**result, "outcome": "broken"}  # the process died, and does so without the mutant
        return {
            **result,
            "outcome": "survived" if outcome == "passed" else outcome,
            "by": failed,
            "seconds": round(time.monotonic() - started, 1),
        }


def equivalent() -> dict[str, str]:
    """Keys of mutants that change nothing, with the reason."""
    if not EQUIVALENT.exists():
        return {}
    entries = [
        line.rsplit("  # ", 1)
        for line in EQUIVALENT.read_text().splitlines()
        if line.strip() and not line.startswith("#")
    ]
    return {entry[0].strip(): entry[1].strip() for entry in entries}


def key_of(mutant: Mutant, source: str) -> str:
    """A mutant's name by the text of its line instead of the line's number, which moves."""
    line = source.splitlines()[mutant.line - 1]
    return (
        f"{mutant.path} | {line.strip()} | {mutant.column - (len(line) - len(line.lstrip()))}: {mutant.before} -> "
        f"{mutant.after or '(nothing)'}"
    )


def excuses(mutants: list[Mutant]) -> dict[str, str]:
    """Name -> reason of those that are listed as equivalent, or are by their kind."""
    reasons = equivalent()
    found = {m.name: key_of(m, (ROOT / m.path).read_text()) for m in mutants}
    kind = {
        m.name: "False is what it is wherever a program runs"
        for m in mutants
        if (m.before, m.after) == FOR_CHECKERS_ALONE
    }
    return kind | {name: reasons[key] for name, key in found.items() if key in reasons}


def judged(mutants: list[Mutant], reach: Reach | ByName, jobs: int) -> Iterator[dict]:
    with (
        tempfile.TemporaryDirectory(prefix="blinkgl-mutants-") as scratch,
        concurrent.futures.ThreadPoolExecutor(jobs) as pool,
    ):
        idle = [Copy(_made(Path(scratch) / f"copy{k}")) for k in range(jobs)]
        if isinstance(reach, Reach):
            idle[0].leave_out_what_is_gone(reach)

        def one(mutant: Mutant) -> dict:
            copy = idle.pop()
            try:
                return copy.judge(mutant, reach)
            finally:
                idle.append(copy)

        try:
            yield from (
                future.result() for future in concurrent.futures.as_completed([pool.submit(one, m) for m in mutants])
            )
        finally:
            pool.shutdown(cancel_futures=True)
            for copy in idle:
                copy.server.close()


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--map",
        nargs="*",
        metavar="TEST",
        help="run the suite, or more tests of the same source, under coverage (needs pytest-cov) and stop",
    )
    parser.add_argument("--count", type=int, default=200, help=f"mutants drawn, over {', '.join(ROOMS)}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="mutants side by side")
    parser.add_argument(
        "--by-name", action="store_true", help="without a map: the tests that name the module, and its room's"
    )
    parser.add_argument("--show", metavar="FILE", help="list the mutants of a module")
    parser.add_argument("--only", metavar="FILE[:LINE]", help="all mutants of a module or a line")
    parser.add_argument("--at-least", type=float, default=0.9, help="share that must die")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help="results as JSON; those that are there already are kept")
    options = parser.parse_args(arguments)
    if options.serve:
        return serve()
    if options.map is not None:
        make_map(str(options.jobs), options.map)
        return 0
    if options.show:
        print(
            *(f"{m.name}  [{m.operator}]" for m in mutants_of(options.show, (ROOT / options.show).read_text())),
            sep="\n",
        )
        return 0
    if options.only:
        path, _, line = options.only.partition(":")
        mutants = [m for m in mutants_of(path, (ROOT / path).read_text()) if not line or m.line == int(line)]
    else:
        mutants = drawn(options.count, options.seed)
    reasons, results = excuses(mutants), []
    excused = [m for m in mutants if m.name in reasons]
    if options.out and options.out.exists():  # an earlier run's, as far as they are of these mutants
        names = {m.name for m in mutants if m not in excused}
        results = [r for r in json.loads(options.out.read_text()) if r["name"] in names]
    known = {r["name"] for r in results}
    reach = ByName() if options.by_name else Reach()
    for result in judged([m for m in mutants if m not in excused and m.name not in known], reach, options.jobs):
        results.append(result)
        print(
            f"[{len(results)}/{len(mutants) - len(excused)}] {result['outcome']:9} {result['name']}  {result['by']}",
            flush=True,
        )
        if options.out:
            options.out.write_text(json.dumps(results, indent=1))
    survivors = [r for r in results if r["outcome"] in ("survived", "no test")]
    results = [r for r in results if r["outcome"] != "broken"]
    share = 1 - len(survivors) / max(len(results), 1)
    print(
        f"\n{len(results) - len(survivors)} of {len(results)} killed ({share:.1%}), {len(excused)} left out as "
        "equivalent"
    )
    print(
        *(
            f"survived: {r['name']}  ({r['outcome']}, {r['tests']} tests)"
            for r in sorted(survivors, key=lambda r: r["name"])
        ),
        sep="\n",
    )
    print(*(f"equivalent: {m.name}  ({reasons[m.name]})" for m in excused), sep="\n")
    return 0 if share >= options.at_least else 1


if __name__ == "__main__":
    sys.exit(main())
