"""docs/limits.md: tables of claims and the commands that show them. The tests among them are part of the suite."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/limits.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"`((?:pytest|make) [^`]+)`", PAGE)))


def test_the_page_names_commands():
    claims = re.findall(r"^\|claim\|test\|\n\|[-|]+\n((?:\|.*\n)+)", PAGE, re.M)
    assert len(claims) >= 2
    for line in "".join(claims).splitlines():
        assert re.search(r"\|`(pytest|make) [^`]+`\|$", line), line


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_exists(command):
    program, *arguments = shlex.split(command)
    if program == "make":
        assert re.search(rf"^{arguments[0]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
        return
    paths = [a for a in arguments if a.startswith("tests")]
    assert paths and all((ROOT / path).exists() for path in paths)
    if "-k" in arguments:
        words = arguments[arguments.index("-k") + 1]
        assert re.search(rf"def test_\w*{words}", (ROOT / paths[0]).read_text(encoding="utf-8"))
