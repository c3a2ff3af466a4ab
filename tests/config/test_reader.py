"""Files that are no configuration, or more of one than anybody wrote: refused before anything is built from them."""

import time
from importlib import resources

import pytest
import yaml

from blinkgl.config.reader import MAX_DEPTH, MAX_VALUES, parse_yaml, read_yaml, to_yaml
from blinkgl.errors import ConfigError
from tests.refusals import refusal

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi")
)
MERGE_BOMB = "a: &a {x: 1}\n" + "".join(
    f"{b}: &{b} {{<<: [{', '.join(['*' + a] * 9)}]}}\n" for a, b in zip("abcdefgh", "bcdefghi")
)


@pytest.mark.parametrize(
    "text, problem",
    [
        (BOMB, f"more than {MAX_VALUES} values, aliases expanded"),
        (MERGE_BOMB, f"more than {MAX_VALUES} values, aliases expanded"),
        ("[" * 100_000, f"more than {MAX_DEPTH} tables and lists inside one another"),
        ("{a: " * 100_000, f"more than {MAX_DEPTH} tables and lists inside one another"),
        ("a: &a [*a]", "alias 'a' is inside what it stands for"),
        ("a: &a {b: {c: *a}}", "alias 'a' is inside what it stands for"),
        ("seed: 0x" + "f" * 6000, "a number of 6002 digits"),
        ("seed: 1." + "1" * 6000, "a number of 6002 digits"),
        ("a: 1\nb: {c: 1, c: 2}", "key 'c' is given twice"),
        ("a: {<<: {b: 1}, <<: {b: 2}}", "key '<<' is given twice"),
        ("? [a]\n: 1", "a key is not plain text"),
        ("null: 1", "a key is not plain text"),
        ("a: !!set {b}", "could not determine a constructor"),
        ("a: !!binary aGk=", "could not determine a constructor"),
        ("a: !!python/name:os.system", "could not determine a constructor"),
        ("a: !!int abc", "not a YAML int"),
        ("a: !!bool abc", "not a YAML bool"),
        ("a: !!map [1]", "not a table"),
        ("a: !!seq {b: 1}", "not a list"),
        ("a: \ud800", "surrogates not allowed"),
        ("a: \x07", "control characters are not allowed"),
        ("a: 1\n---\nb: 2", "another document"),
    ],
)
def test_refused_at_once(text, problem):
    started = time.process_time()
    line = refusal(ConfigError, parse_yaml, text, "c.yaml")
    assert problem in line and line.startswith("c.yaml") and len(line) < 200
    assert time.process_time() - started < 600, "the bomb would take hours"


def test_aliases_and_merge_keys_as_people_use_them():
    text = (
        "base: &base {width: 3, height: 4}\nwide: {<<: *base, width: 9}\nboth: [*base, *base]\nmore: {<<: [{x: 1}, "
        "*base]}"
    )
    assert parse_yaml(text, "") == {
        "base": {"width": 3, "height": 4},
        "wide": {"width": 9, "height": 4},
        "both": [{"width": 3, "height": 4}] * 2,
        "more": {"x": 1, "width": 3, "height": 4},
    }
    assert parse_yaml("a: 2026-01-01", "") == {"a": "2026-01-01"}, "text: nothing here is a date"


def test_the_shipped_files_read_as_any_safe_loader_reads_them():
    folder = resources.files("blinkgl.configs")
    files = [
        f
        for part in ("", "eflow", "quality", "scenes", "sensors")
        for f in (folder / part if part else folder).iterdir()
        if f.name.endswith(".yaml")
    ]
    assert len(files) > 15
    for file in files:
        tree = read_yaml(str(file))
        assert tree == yaml.safe_load(file.read_text()) == parse_yaml(to_yaml(tree), "")
