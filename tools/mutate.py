"""A small mutation run: are there tests that notice when a line is wrong?

    python -m blinkgl.tools.mutate --map                      # once per commit: which test runs which line (the suite under coverage)
    python -m blinkgl.tools.mutate --count 200 --seed 1       # draw mutants, run the tests that reach each, print the survivors
    python -m blinkgl.tools.mutate --show blinkgl/render/matrices.py    # the mutants of a module, without running any
    python -m blinkgl.tools.mutate --only blinkgl/render/matrices.py:41 # those of a line

A mutant is one small edit of one line: an operator, a comparison, a constant, a condition, a statement left out. It is made in a copy of
the tree, so nothing here is touched. The tests that reached its line run, shortest first, until one fails (killed), the time is up
(killed: "time"), or all passed (survived). Lines that no test reaches are survivors without a run. What coverage cannot see is
compiled: a numba kernel is given all tests of its module's callers, a shader those of ``tests/render``.

Exit status 1 when less than ``--at-least`` (0.9) of the mutants died. Mutants that change nothing a test could see (an estimate that only
saves time, say) are listed with the reason in ``tools/mutants_equivalent.txt``, printed, and not counted.
"""

from __future__ import annotations

import argparse
import ast
import concurrent.futures
import json
import os
import random
import re
import resource
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
ROOMS = ("render", "timeline", "events", "scene", "io", "dataset")
MAP = ROOT / ".scratch" / "mutate"
EQUIVALENT = ROOT / "tools" / "mutants_equivalent.txt"
SHARED_CODE = ("blinkgl", "eflow", "shaders", "configs", "tools", "tests", "setup.cfg", "README.md", "docs", "Makefile", "constraints.txt", "pyproject.toml",
               "examples")
MOST_TESTS, MOST_S = 120, 40.0
"""of the shortest that reach a line, for one mutant: how many, and how long they take together"""
MEMORY = 6 << 30
"""bytes of address space: a mutant that never stops collecting must not take the machine with it"""

ARITHMETIC = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*", ast.Pow: "*", ast.MatMult: None,
              ast.BitAnd: "|", ast.BitOr: "&", ast.BitXor: "|", ast.LShift: ">>", ast.RShift: "<<"}
COMPARISON = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.Is: "is not", ast.IsNot: "is",
              ast.In: "not in", ast.NotIn: "in"}
REVERSED = {ast.Lt: ">", ast.LtE: ">", ast.Gt: "<", ast.GtE: "<"}
NAMES = {"min": "max", "max": "min", "floor": "ceil", "ceil": "floor", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum",
         "sin": "cos", "cos": "sin", "argmin": "argmax", "argmax": "argmin", "zeros": "ones", "ones": "zeros"}


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
        self.starts = [0]
        for line in source.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))

    def offset(self, line: int, byte_column: int) -> int:
        text = self.source[self.starts[line - 1] : self.starts[line]]
        return self.starts[line - 1] + len(text.encode()[:byte_column].decode())

    def span(self, node) -> tuple[int, int]:
        return self.offset(node.lineno, node.col_offset), self.offset(node.end_lineno, node.end_col_offset)

    def add(self, start: int, end: int, after: str, operator: str) -> None:
        line = self.source.count("\n", 0, start) + 1
        mutant = Mutant(self.path, line, start - self.starts[line - 1] + 1, self.source[start:end], after, operator, self.compiled)
        try:
            ast.parse(mutant.apply(self.source))
        except SyntaxError:
            return
        if mutant.before != mutant.after:
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
        self.compiled = outer or any(re.search(r"\b(njit|jit|vectorize)\b", ast.unparse(d)) for d in node.decorator_list)
        for statement in node.body:
            self.visit(statement)
        self.compiled = outer

    def visit_AnnAssign(self, node) -> None:
        if node.value is not None and not (isinstance(node.value, ast.Call) and getattr(node.value.func, "id", "") in ("Field", "field")):
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
        literal = lambda n: isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, (str, bytes)))
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
        if node.arg not in ("description", "accepted", "where", "value"):  # what an error says is golden text, tested as such
            self.visit(node.value)


GLSL = (
    (re.compile(r"(?<=[\w)\]]) ([-+*/]) (?=[\w(-])"), {"+": "-", "-": "+", "*": "/", "/": "*"}, "arithmetic"),
    (re.compile(r"(?<=[\w)\]]) (<=|>=|<|>|==|!=|&&|\|\|) (?=[\w(-])"),
     {"<": ">", ">": "<", "<=": ">", ">=": "<", "==": "!=", "!=": "==", "&&": "||", "||": "&&"}, "comparison"),
    (re.compile(r"\b(min|max|dFdx|dFdy)(?=\()"), {"min": "max", "max": "min", "dFdx": "dFdy", "dFdy": "dFdx"}, "function"),
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
        everything = [m for path in modules(room) if path != "shaders/debug.glsl" for m in mutants_of(path, (ROOT / path).read_text())]
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


def make_map(jobs: str) -> None:
    """Runs the suite under coverage and keeps who ran what, and how long it took."""
    MAP.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "COVERAGE_FILE": str(MAP / "coverage.db")}
    status = subprocess.run([sys.executable, "-m", "pytest", "-q", "-n", jobs, "--dist", "worksteal", "--cov=blinkgl", "--cov-context=test",
                             "--cov-report=term:skip-covered", f"--junitxml={MAP / 'durations.xml'}"], cwd=ROOT, env=environment).returncode
    if status:
        raise SystemExit("the suite must pass before mutants are of any use")
    (MAP / "sources.json").write_text(json.dumps({p: (ROOT / p).read_text() for room in ROOMS for p in modules(room)}))


class Reach:
    """Test ids by line, from :func:`make_map`."""

    def __init__(self):
        if not (MAP / "coverage.db").exists():
            raise SystemExit("run with --map first: it finds out which test runs which line")
        import coverage

        self.data = coverage.CoverageData(str(MAP / "coverage.db"))
        self.data.read()
        self.sources = json.loads((MAP / "sources.json").read_text())
        self.seconds = {}
        for case in ElementTree.parse(MAP / "durations.xml").iter("testcase"):
            file = case.get("classname", "").replace(".", "/") + ".py"
            self.seconds[f"{file}::{case.get('name')}"] = float(case.get("time", 0))
        self._lines: dict[str, dict[int, list[str]]] = {}

    def lines(self, path: str) -> dict[int, list[str]]:
        if path not in self._lines:
            self._lines[path] = self.data.contexts_by_lineno(str(ROOT / path))
        return self._lines[path]

    def tests(self, mutant: Mutant) -> list[str]:
        """Shortest first. Empty: no test reaches the line."""
        if mutant.path in self.sources and self.sources[mutant.path] != (ROOT / mutant.path).read_text():
            raise SystemExit(f"{mutant.path} has changed since --map: run it again")
        if mutant.path.endswith(".glsl"):
            contexts = [t for t in self.seconds if t.startswith("tests/render/") and "pyrender" not in t and "cycles" not in t]
        else:
            room = f"tests/{Path(mutant.path).parent.name}/"
            reached = {c for contexts in self.lines(mutant.path).values() for c in contexts if c}
            if not reached:  # compiled as a whole, or run in a process of its own
                contexts = [t for t in self.seconds if t.startswith(room)]
            elif mutant.compiled:
                contexts = [c for c in reached if c.startswith(room)] or list(reached)
            else:
                contexts = self._around(mutant)
        ids = {c.split("|")[0] for c in contexts if c}
        chosen, together = [], 0.0
        for test in sorted(ids, key=lambda t: (self.seconds.get(t, 1.0), t)):
            together += self.seconds.get(test, 1.0)
            if len(chosen) == MOST_TESTS or (chosen and together > MOST_S):
                break
            chosen.append(test)
        return chosen

    def _around(self, mutant: Mutant) -> list[str]:
        """Coverage names the first line of a statement only. What runs when a module is imported (a default, a constant) concerns all
        that use the module, shortest first."""
        lines = self.lines(mutant.path)
        for line in range(mutant.line, 0, -1):
            if line in lines:
                reached = [c for c in lines[line] if c]
                return reached or ([c for contexts in lines.values() for c in contexts] if "" in lines[line] else [])
        return []


# ---- running -------------------------------------------------------------------------------------------------------


class Copy:
    """A copy of the tree that a mutant lives in; ``blinkgl.shaders`` and its like are links to the copy's own folders."""

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

    def run(self, tests: list[str], limit_s: float, kernels: Path | None) -> tuple[str, str]:
        """("passed" | "failed" | "time", end of the output)."""
        listing = self.folder / "tests.txt"
        listing.write_text("\n".join(tests) + "\n")
        environment = {**os.environ, "PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"}
        if kernels is not None:
            environment["NUMBA_CACHE_DIR"] = str(kernels)
        process = subprocess.Popen([sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "-p", "no:cacheprovider", "-p", "no:cov", f"@{listing}"],
                                   cwd=self.folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True)
        # Not by preexec_fn, which may hang: it runs between fork and exec, where another thread's lock is held for ever.
        resource.prlimit(process.pid, resource.RLIMIT_AS, (MEMORY, MEMORY))
        try:
            output, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return "time", ""
        return ("passed" if process.returncode == 0 else "failed"), output[-3000:]

    sound: ClassVar[set[str]] = set()
    unfit: ClassVar[set[str]] = set()
    """tests that pass, and that fail, in a copy without any mutant; known to all copies"""

    def passes(self, test: str) -> bool:
        """Whether a test passes here with the source as it is; asked about each test once."""
        if test not in self.sound | self.unfit:
            (self.sound if self.run([test], 300, None)[0] == "passed" else self.unfit).add(test)
        return test in self.sound

    def judge(self, mutant: Mutant, reach: Reach) -> dict:
        tests = [t for t in reach.tests(mutant) if t not in self.unfit]
        result = {**asdict(mutant), "name": mutant.name, "tests": len(tests), "by": ""}
        if not tests:
            return {**result, "outcome": "no test"}
        path = self.folder / mutant.path
        source = path.read_text()
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as kernels:
            path.write_text(mutant.apply(source))
            try:
                expected = sum(reach.seconds.get(t, 1.0) for t in tests)
                # A kernel's file has changed, so have the files that call it: numba's cache would not notice, hence an empty one.
                outcome, output = self.run(tests, 60 + 5 * expected, Path(kernels) if mutant.compiled and mutant.path.endswith(".py") else None)
            finally:
                path.write_text(source)
        failed = re.search(r"^(?:FAILED|ERROR) (\S+?)(?: - .*)?$", output, re.M)
        if outcome == "failed" and failed and not self.passes(failed.group(1)):
            return self.judge(mutant, reach)  # it fails in a copy whatever the source says: it has no say
        return {**result, "outcome": "survived" if outcome == "passed" else outcome, "by": failed.group(1) if failed else "",
                "seconds": round(time.monotonic() - started, 1)}


def equivalent() -> dict[str, str]:
    """Keys of mutants that change nothing, with the reason."""
    if not EQUIVALENT.exists():
        return {}
    entries = [line.rsplit("  # ", 1) for line in EQUIVALENT.read_text().splitlines() if line.strip() and not line.startswith("#")]
    return {entry[0].strip(): entry[1].strip() for entry in entries}


def key_of(mutant: Mutant, source: str) -> str:
    """A mutant's name by the text of its line instead of the line's number, which moves."""
    line = source.splitlines()[mutant.line - 1]
    return f"{mutant.path} | {line.strip()} | {mutant.column - (len(line) - len(line.lstrip()))}: {mutant.before} -> {mutant.after or '(nothing)'}"


def excuses(mutants: list[Mutant]) -> dict[str, str]:
    """Name -> reason of those that are listed as equivalent."""
    reasons = equivalent()
    found = {m.name: key_of(m, (ROOT / m.path).read_text()) for m in mutants}
    return {name: reasons[key] for name, key in found.items() if key in reasons}


def judged(mutants: list[Mutant], reach: Reach, jobs: int) -> Iterator[dict]:
    with tempfile.TemporaryDirectory(prefix="blinkgl-mutants-") as scratch, concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        idle = [Copy(_made(Path(scratch) / f"copy{k}")) for k in range(jobs)]

        def one(mutant: Mutant) -> dict:
            copy = idle.pop()
            try:
                return copy.judge(mutant, reach)
            finally:
                idle.append(copy)

        yield from (future.result() for future in concurrent.futures.as_completed([pool.submit(one, m) for m in mutants]))


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--map", action="store_true", help="run the suite under coverage (needs pytest-cov) and stop")
    parser.add_argument("--count", type=int, default=200, help=f"mutants drawn, over {', '.join(ROOMS)}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="mutants side by side")
    parser.add_argument("--show", metavar="FILE", help="list the mutants of a module")
    parser.add_argument("--only", metavar="FILE[:LINE]", help="all mutants of a module or a line")
    parser.add_argument("--at-least", type=float, default=0.9, help="share that must die")
    parser.add_argument("--out", type=Path, help="results as JSON; those that are there already are kept")
    options = parser.parse_args(arguments)
    if options.map:
        make_map(str(options.jobs))
        return 0
    if options.show:
        print(*(f"{m.name}  [{m.operator}]" for m in mutants_of(options.show, (ROOT / options.show).read_text())), sep="\n")
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
    for result in judged([m for m in mutants if m not in excused and m.name not in known], Reach(), options.jobs):
        results.append(result)
        print(f"[{len(results)}/{len(mutants) - len(excused)}] {result['outcome']:9} {result['name']}  {result['by']}", flush=True)
        if options.out:
            options.out.write_text(json.dumps(results, indent=1))
    survivors = [r for r in results if r["outcome"] in ("survived", "no test")]
    share = 1 - len(survivors) / max(len(results), 1)
    print(f"\n{len(results) - len(survivors)} of {len(results)} killed ({share:.1%}), {len(excused)} left out as equivalent")
    print(*(f"survived: {r['name']}  ({r['outcome']}, {r['tests']} tests)" for r in sorted(survivors, key=lambda r: r["name"])), sep="\n")
    print(*(f"equivalent: {m.name}  ({reasons[m.name]})" for m in excused), sep="\n")
    return 0 if share >= options.at_least else 1


if __name__ == "__main__":
    sys.exit(main())
