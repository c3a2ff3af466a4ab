"""tests/claims.txt: what the pages promise, and the commands that show it."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINES = [
    tuple(part.strip() for part in line.split(" | "))
    for line in (ROOT / "tests/claims.txt").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]


def plain(text: str) -> str:
    return " ".join(text.split())


def test_every_claim_stands_on_its_page():
    pages = {page: plain((ROOT / page).read_text(encoding="utf-8")) for page, *_ in LINES}
    assert not [(page, words) for page, words, _ in LINES if plain(words) not in pages[page]]


def test_every_guide_has_claims():
    made = {"commands", "configuration", "eflow_configuration", "benchmarks", "peers", "python", "rooms", "changelog"}
    # Programs, opinions, and tables that name their commands.
    without = {"examples", "alternatives", "learning", "results_eflow"}
    guides = {p.stem for p in (ROOT / "docs").glob("*.md") if not p.stem.startswith("room_")} - made - without
    assert guides == {Path(page).stem for page, *_ in LINES if page != "README.md"}


@pytest.mark.parametrize("command", sorted({command for *_, command in LINES}))
def test_every_command_exists(command):
    program, *arguments = shlex.split(command)
    if program == "pytest":
        paths = [a for a in arguments if a.startswith("tests")]
        assert paths and all((ROOT / path).exists() for path in paths)
        if "-k" in arguments:
            words = arguments[arguments.index("-k") + 1]
            assert re.search(rf"def test_\w*{words}", (ROOT / paths[0]).read_text(encoding="utf-8"))
    elif program == "make":
        assert re.search(rf"^{arguments[0]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    elif program == "python":
        assert (ROOT / "tools" / f"{arguments[1].rpartition('.')[2]}.py").is_file()
    else:
        assert program == "blinkgl" and arguments[0] == "shader"
