"""Tests of words that a library chooses run with the versions of constraints.txt, and skip with others."""

import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

CONSTRAINTS = (Path(__file__).parents[1] / "constraints.txt").read_text(encoding="utf-8")


def only_with_pinned(*names: str) -> None:
    """Skip the test where one of these libraries has another version than the pinned one."""
    for name in names:
        pinned = re.search(rf"^{name}==(\S+)$", CONSTRAINTS, re.M)[1]
        try:
            found = version(name)
        except PackageNotFoundError:  # typer may carry click inside
            continue
        if found != pinned:
            pytest.skip(f"compares words of {name} {pinned}; {found} is installed")
