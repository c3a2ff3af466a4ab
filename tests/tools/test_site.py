"""The documentation site builds without a warning, has no dead link, and needs no network to be read."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

import blinkgl
from blinkgl.tools import site

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    pytest.importorskip("zensical", reason="the extra [docs] is not installed")
    here = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        here = here.parent  # of all workers: it takes half a minute, and they may share this file's tests
    with open(here / "site.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (here / "site.built").exists():
            site.build(REPOSITORY, here / "site")
            (here / "site.built").touch()
    return here / "site"


def test_every_link_of_every_page_leads_somewhere(built):
    assert site.problems(built) == []


def test_every_link_of_the_readme_leads_to_a_file():
    assert site.markdown_problems(REPOSITORY / "README.md") == []


def test_the_reference_has_every_name_of_the_front_door_and_every_room(built):
    page = (built / "python.html").read_text()
    assert [name for name in blinkgl.__all__ if f'id="blinkgl.{name}"' not in page] == []
    rooms = [path.parent.name for path in sorted((REPOSITORY / "blinkgl").glob("*/__init__.py"))]
    assert [room for room in rooms if not (built / f"room_{room}.html").is_file()] == [], (
        "a page docs/room_NAME.md, in mkdocs.yml and docs/rooms.md"
    )
