"""The mutation run: what counts as a mutant, and that one is told from an untouched tree."""

import ast
import math
from pathlib import Path

import pytest

from blinkgl.tools.mutate import (
    ROOT,
    ByName,
    Kernels,
    Mutant,
    Reach,
    Server,
    _on_import,
    equivalent,
    excuses,
    key_of,
    mutants_of,
)

SOURCE = '''
"""Not this: 1 + 1."""
LIMIT = 10

def clamp(x: int, low=0) -> int:
    """Nor this."""
    if x < low and not x == LIMIT:
        raise ValueError(f"{x + 1} is small")
    log(x)
    return max(x - 1, -low)

@njit(cache=True)
def kernel(a):
    a[0] += 0.5
'''


def edits(source: str = SOURCE) -> list[str]:
    return [m.name.split(": ", 1)[1] for m in mutants_of("m.py", source)]


def test_every_kind_of_edit_is_there():
    found = edits()
    for edit in (
        "10 -> 11",
        "< -> <=",
        "< -> >",
        "and -> or",
        "not -> (nothing)",
        "== -> !=",
        "log(x) -> None",
        "max -> min",
        "- -> +",
        "- -> (nothing)",
        "+= -> -=",
        "0.5 -> 0.75",
        "x < low and not x == LIMIT -> True",
        'raise ValueError(f"{x + 1} is small") -> pass',
    ):
        assert edit in found, edit


def test_text_for_people_is_left_alone():
    assert not any(m.line in (2, 6) for m in mutants_of("m.py", SOURCE))
    assert not [m for m in mutants_of("m.py", SOURCE) if m.line == 8 and m.before == "+"]


def test_every_mutant_is_one_edit_that_parses():
    for mutant in mutants_of("m.py", SOURCE):
        changed = mutant.apply(SOURCE)
        ast.parse(changed)
        assert changed != SOURCE
        assert [a for a, b in zip(SOURCE.splitlines(), changed.splitlines()) if a != b][0] == SOURCE.splitlines()[
            mutant.line - 1
        ]


def test_kernels_are_known_for_what_they_are():
    assert {m.before for m in mutants_of("m.py", SOURCE) if m.compiled} >= {"+=", "0.5"}
    assert not any(m.compiled for m in mutants_of("m.py", SOURCE) if m.line < 12)


def test_columns_count_characters():
    assert "1 -> 2" in edits('x = "µ", 1\n')


def test_shaders_have_mutants_too():
    found = [
        m.name
        for m in mutants_of("s.glsl", "#define A 1.0\nfloat x = a * b - 2.0; // c + d\nif (x < 0.0) x = min(x, -y);\n")
    ]
    assert found == [
        "s.glsl:2:13: * -> /",
        "s.glsl:2:17: - -> +",
        "s.glsl:2:19: 2.0 -> 3.0",
        "s.glsl:3:7: < -> >",
        "s.glsl:3:18: min -> max",
        "s.glsl:3:9: 0.0 -> 1.0",
        "s.glsl:3:25: - -> (nothing)",
    ]


def test_an_edit_of_another_source_is_refused():
    mutant = mutants_of("m.py", SOURCE)[0]
    with pytest.raises(ValueError, match="not the source"):
        mutant.apply("x = 1\n" * 20)


def test_a_key_knows_the_line_and_the_place_in_it():
    first, second = [m for m in mutants_of("m.py", "if a < b and c < d:\n    pass\n") if m.after == "<="]
    assert (
        key_of(first, "if a < b and c < d:")
        == "m.py | if a < b and c < d: | 6: < -> <="
        != key_of(second, "if a < b and c < d:")
    )


def test_what_is_called_equivalent_exists_and_says_why():
    listed: dict[str, dict[str, str]] = {}
    for entry, reason in equivalent().items():
        listed.setdefault(entry.split(" | ")[0], {})[entry] = reason
    for path, entries in listed.items():
        source = (ROOT / path).read_text()
        known = {key_of(m, source) for m in mutants_of(path, source)}
        for entry, reason in entries.items():
            assert entry in known, f"{entry} is no mutant any more"
            assert len(reason) > 10, entry


def test_what_only_type_checkers_read_is_excused_and_nothing_else_by_its_kind():
    mutants = mutants_of("blinkgl/labels/depth.py", (ROOT / "blinkgl/labels/depth.py").read_text())
    kinds = {(m.before, m.after) for m in mutants if m.name in excuses(mutants)}
    assert kinds == {("TYPE_CHECKING", "False")}


def test_what_is_compiled_into_a_kernel_is_compiled_itself():
    source = "@register_jitable\ndef f(a):\n    return a + 1\n\ndef g(a):\n    return a - 1\n"
    assert {m.before: m.compiled for m in mutants_of("m.py", source) if m.operator == "arithmetic"} == {
        "+": True,
        "-": False,
    }


def test_an_edit_is_in_the_kernels_of_whoever_imports_it(tmp_path):
    """A kernel's callee, a constant of a module, a function that is called on import; not what
    stands in a method beside them."""
    files = {
        "blinkgl/a.py": "from numba.extending import register_jitable\nLIMIT = 3\ndef table():\n    return 1 + "
        "1\nTABLE = table()\n@register_jitable\ndef callee(x):\n    return x * 2\nclass Thing:\n    "
        "def method(self):\n        return 4 - 5\n",
        "blinkgl/b.py": "import numba\nfrom blinkgl.a import callee\n@numba.njit(cache=True)\ndef kernel(x):\n    "
        "return callee(x) / 6\n",
        "blinkgl/c.py": "import numba\nfrom blinkgl import b\n@numba.njit(cache=True)\ndef other(x):\n    return x\n",
        "blinkgl/d.py": "import blinkgl.c\nVALUE = 7\n",
        "blinkgl/__init__.py": "",
    }
    (tmp_path / "blinkgl").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    kernels = Kernels(tmp_path)
    stale = {
        m.before + m.after: {Path(p).stem for p in kernels.stale(m)}
        for name, text in files.items()
        for m in mutants_of(name, text)
    }
    assert kernels.holders == {"blinkgl/a.py", "blinkgl/b.py", "blinkgl/c.py"}
    assert (
        stale["34"] == stale["+-"] == stale["*/"] == {"a", "b", "c"}
        and stale["/*"] == {"b", "c"}
        and stale["-+"] == stale["78"] == set()
    )
    (tmp_path / "blinkgl/__pycache__").mkdir()
    for name in ("a.callee-7.py311.nbi", "b.kernel-4.py311.1.nbc", "c.other-4.py311.nbi"):
        (tmp_path / "blinkgl/__pycache__" / name).write_text("")
    (tmp_path / "into").mkdir()
    kernels.cache({"blinkgl/b.py", "blinkgl/c.py"}, tmp_path / "into")
    assert [p.name for p in (tmp_path / "into").rglob("*.nb?")] == ["a.callee-7.py311.nbi"]


def test_own_tests_are_asked_first():
    mutant = Mutant("blinkgl/events/curve.py", 1, 1, "a", "b", "x")
    assert [
        Reach._distance(mutant, t)
        for t in ("tests/events/test_curve.py::a", "tests/events/test_esim.py::a", "tests/cross/test_cross.py::a")
    ] == [0, 1, 2]
    assert Reach._distance(Mutant("shaders/colour.glsl", 1, 1, "a", "b", "x"), "tests/render/test_renderer.py::a") == 1
    assert (
        Reach._distance(
            Mutant("blinkgl/scene/motion/paths.py", 1, 1, "a", "b", "x"), "tests/scene/geometry/test_lod.py::a"
        )
        == 1
    )


def of(path: str, text: str) -> Mutant:
    """A mutant of the first line of a module that holds ``text``."""
    lines = (ROOT / path).read_text().splitlines()
    return Mutant(path, 1 + next(k for k, line in enumerate(lines) if text in line), 1, "a", "b", "x")


def test_without_a_map_tests_are_found_by_name():
    """Its own, those that name the module, its room's, those that import from the room; no peers, no networks."""
    names = ByName()
    found = names.tests(of("blinkgl/timeline/budget.py", "return 0.0"))
    assert found[0] == "tests/timeline/test_budget.py" and "tests/timeline/test_strategy.py" in found
    found = names.tests(of("blinkgl/labels/table.py", "return keys"))
    assert "tests/labels/test_label_rows.py" in found and "tests/test_seams.py" in found
    assert not any(file.startswith(ByName.PEERS) for file in found) and len(set(found)) == len(found)
    shader = names.tests(Mutant("shaders/luminance.glsl", 1, 1, "a", "b", "x"))
    assert {Path(file).parts[1] for file in shader} == {"render", "extremes"}
    debugger = names.tests(Mutant("shaders/include/lookup.glsl", 1, 1, "a", "b", "x"))
    assert debugger and all(file.startswith("tests/tools/test_shader_") for file in debugger)


def test_what_runs_on_import_is_seen_by_those_who_look_at_the_package():
    frozen, inside = of("blinkgl/render/raycast.py", "@dataclass"), of("blinkgl/render/raycast.py", "return Tree(")
    default = of("blinkgl/recordings/simulation.py", "factor: int = 4")
    assert _on_import(frozen) and _on_import(default) and not _on_import(inside)
    assert ByName().tests(frozen)[0] == "tests/test_rooms.py" != ByName().tests(inside)[0]


@pytest.mark.slow
def test_verdicts(tmp_path):
    """A test that passes, one that fails, one that never ends, one that waits for ever, a process that
    dies: each in a child that sees the source as it is by then."""
    (tmp_path / "thing.py").write_text("VALUE = 1\n")
    (tmp_path / "test_thing.py").write_text(
        "import os, thing\ndef test_right(): assert thing.VALUE == 1\ndef test_spins():\n    while True: pass\n"
        "def test_spends(): sum(range(10**6))\n"
        "def test_dies(): os._exit(3)\ndef test_waits():\n    import threading; threading.Event().wait()\n"
    )
    server, seen = Server(tmp_path), []
    try:
        for tests, value in (
            (["right"], 1),
            (["right"], 2),
            (["spins"], 1),
            (["waits"], 1),
            (["right", "dies"], 1),
            (["right"], 1),
            (["spends", "right"], 2),
        ):
            (tmp_path / "thing.py").write_text(f"VALUE = {value}\n")
            (tmp_path / "output.failed").unlink(missing_ok=True)
            names = [f"test_thing.py::test_{name}" for name in tests]
            outcome = server.ask(
                {
                    "tests": names,
                    "seconds": dict.fromkeys(names, 0.0),
                    "spare_s": 1,
                    "wait_s": 2,
                    "limit_s": 60,
                    "most_s": 0.0 if "spends" in tests else math.inf,
                    "kernels": str(tmp_path / "kernels"),
                    "original": {},
                    "output": str(tmp_path / "output.txt"),
                }
            )
            seen.append(
                (outcome, (tmp_path / "output.failed").read_text() if (tmp_path / "output.failed").exists() else "")
            )
    finally:
        server.close()
    assert seen == [
        ("passed", ""),
        ("failed", "test_thing.py::test_right"),
        ("time", ""),
        ("time", ""),
        ("failed", ""),
        ("passed", ""),
        ("passed", ""),
    ], "the last: after a moment it is enough, and what would fail is not begun"
