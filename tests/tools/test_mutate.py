"""The mutation run: what counts as a mutant, and that one is told from an untouched tree."""

import ast

import pytest

from blinkgl.tools.mutate import ROOT, equivalent, key_of, mutants_of

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
    for edit in ("10 -> 11", "< -> <=", "< -> >", "and -> or", "not -> (nothing)", "== -> !=", "log(x) -> None", "max -> min", "- -> +", "- -> (nothing)",
                 "+= -> -=", "0.5 -> 0.75", "x < low and not x == LIMIT -> True", 'raise ValueError(f"{x + 1} is small") -> pass'):
        assert edit in found, edit


def test_text_for_people_is_left_alone():
    assert not any(m.line in (2, 6) for m in mutants_of("m.py", SOURCE))
    assert not [m for m in mutants_of("m.py", SOURCE) if m.line == 8 and m.before == "+"]


def test_every_mutant_is_one_edit_that_parses():
    for mutant in mutants_of("m.py", SOURCE):
        changed = mutant.apply(SOURCE)
        ast.parse(changed)
        assert changed != SOURCE
        assert [a for a, b in zip(SOURCE.splitlines(), changed.splitlines()) if a != b][0] == SOURCE.splitlines()[mutant.line - 1]


def test_kernels_are_known_for_what_they_are():
    assert {m.before for m in mutants_of("m.py", SOURCE) if m.compiled} >= {"+=", "0.5"}
    assert not any(m.compiled for m in mutants_of("m.py", SOURCE) if m.line < 12)


def test_columns_count_characters():
    assert "1 -> 2" in edits('x = "µ", 1\n')


def test_shaders_have_mutants_too():
    found = [m.name for m in mutants_of("s.glsl", "#define A 1.0\nfloat x = a * b - 2.0; // c + d\nif (x < 0.0) x = min(x, -y);\n")]
    assert found == ["s.glsl:2:13: * -> /", "s.glsl:2:17: - -> +", "s.glsl:2:19: 2.0 -> 3.0", "s.glsl:3:7: < -> >", "s.glsl:3:18: min -> max",
                     "s.glsl:3:9: 0.0 -> 1.0", "s.glsl:3:25: - -> (nothing)"]


def test_an_edit_of_another_source_is_refused():
    mutant = mutants_of("m.py", SOURCE)[0]
    with pytest.raises(ValueError, match="not the source"):
        mutant.apply("x = 1\n" * 20)


def test_a_key_knows_the_line_and_the_place_in_it():
    first, second = [m for m in mutants_of("m.py", "if a < b and c < d:\n    pass\n") if m.after == "<="]
    assert key_of(first, "if a < b and c < d:") == "m.py | if a < b and c < d: | 6: < -> <=" != key_of(second, "if a < b and c < d:")


def test_what_is_called_equivalent_exists_and_says_why():
    for entry, reason in equivalent().items():
        path = entry.split(" | ")[0]
        source = (ROOT / path).read_text()
        assert entry in {key_of(m, source) for m in mutants_of(path, source)}, f"{entry} is no mutant any more"
        assert len(reason) > 10, entry
