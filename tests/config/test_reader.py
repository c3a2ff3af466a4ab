"""Files that are no configuration, or more of one than anybody wrote: refused before anything is built from them."""

import subprocess
import sys
import time
from importlib import resources

import pytest
import yaml

from blinkgl.config.reader import MAX_DEPTH, MAX_VALUES, parse_yaml, read_yaml, to_yaml
from blinkgl.config.run import load_run
from blinkgl.errors import ConfigError

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
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "c.yaml")
    assert problem in str(caught.value) and str(caught.value).startswith("c.yaml") and "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200
    assert time.process_time() - started < 5, "the bomb would take hours"


def test_a_bomb_in_a_run_and_in_an_override(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text(BOMB)
    with pytest.raises(ConfigError, match="aliases expanded"):
        load_run(path)
    path.write_text("")
    with pytest.raises(ConfigError, match="--set scene:.*aliases expanded"):
        load_run(
            path,
            [
                "scene=[&a [x,x,x,x,x,x,x,x,x,x]"
                + "".join(f", &{b} [{','.join(['*' + a] * 10)}]" for a, b in zip("abcdef", "bcdefg"))
                + "]"
            ],
        )


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


def test_without_libyaml_the_same():
    code = (
        "import sys; sys.modules['yaml._yaml'] = None; from blinkgl.config import reader\n"
        "from yaml.parser import Parser; assert issubclass(reader._Loader, Parser), reader._Loader.__mro__\n"
        "assert reader.parse_yaml('a: [1, {b: x}]', '') == {'a': [1, {'b': 'x'}]}\n"
        f"try: reader.parse_yaml({BOMB!r}, 'f')\n"
        "except Exception as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "aliases expanded" in done.stdout, done.stderr
