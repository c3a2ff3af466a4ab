"""The documentation site builds without a warning, has no dead link, and needs no network to be read."""

from __future__ import annotations

import fcntl
import os
import re
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


def test_the_index_leads_to_every_page():
    """The site has the README in its place; on a code host it is what opens docs/."""
    text = (REPOSITORY / "docs/index.md").read_text(encoding="utf-8")
    linked = set(re.findall(r"\]\((\w+\.md)\)", text))
    assert linked == {path.name for path in (REPOSITORY / "docs").glob("*.md")} - {"index.md"}


def test_every_link_of_the_readme_leads_to_a_file():
    assert site.markdown_problems(REPOSITORY / "README.md") == []


def test_the_reference_has_every_name_of_the_front_door_and_every_room(built):
    page = (built / "python.html").read_text()
    assert [name for name in blinkgl.__all__ if f'id="blinkgl.{name}"' not in page] == []
    rooms = [path.parent.name for path in sorted((REPOSITORY / "blinkgl").glob("*/__init__.py"))]
    shown = (built / "rooms.html").read_text()
    assert [room for room in rooms if f"<code>blinkgl.{room}</code><a" not in shown] == [], "a section in docs/rooms.md"


def test_pictures_have_captions_and_are_there(built):
    page = (built / "scenes.html").read_text(encoding="utf-8")
    assert "<figcaption>People who dance</figcaption></figure>" in page
    for path in built.glob("*.html"):
        text = path.read_text(encoding="utf-8")
        assert not site.PICTURE.search(text), path.name
        assert 'alt=""' not in text, f"{path.name}: a picture without a description"


def test_the_site_offers_search_dark_mode_and_copying_of_code(built):
    for path in built.glob("*.html"):
        text = path.read_text(encoding="utf-8")
        if 'http-equiv="refresh"' not in text:
            assert 'data-md-component="search"' in text and "slate" in text and "content.code.copy" in text, path.name


def test_old_addresses_lead_to_where_the_pages_are_now(built):
    for page, places in site.moved_places((REPOSITORY / "docs" / site.MOVED).read_text(encoding="utf-8")).items():
        stub = (built / page).read_text(encoding="utf-8")
        assert f'content="0; url={places[""]}"' in stub
        for old, new in places.items():
            assert f'href="{new}"' in stub
            assert not old or f'id="{old[1:]}"' in stub


def test_a_stub_whose_target_is_gone_is_a_dead_link(tmp_path):
    (tmp_path / "index.html").write_text('<a href="new.html">new</a>')
    (tmp_path / "new.html").write_text('<h2 id="here">Here</h2>')
    site.write_stubs(tmp_path, site.moved_places("# old, new\nold.html new.html\nold.html#there new.html#here\n"))
    assert site.problems(tmp_path) == []
    site.write_stubs(tmp_path, {"older.html": {"": "gone.html", "#there": "new.html#gone"}})
    assert site.problems(tmp_path) == [
        "older.html: gone.html leads nowhere",
        "older.html: gone.html leads nowhere",
        "older.html: new.html#gone leads to no such place on the page",
    ]


@pytest.mark.parametrize("text", ["old.html", "old.html#part new.html", "a.html b.html c.html"])
def test_a_wrong_line_of_the_table_is_refused(text):
    with pytest.raises(site.BuildError, match="moved.txt"):
        site.moved_places(text)


def test_a_page_that_is_there_has_not_moved(tmp_path):
    (tmp_path / "old.html").write_text("")
    with pytest.raises(site.BuildError, match="has not moved"):
        site.write_stubs(tmp_path, {"old.html": {"": "new.html"}})


def test_every_page_that_code_names_is_there():
    """Messages, docstrings, configurations and tests point at ``docs/NAME.md``."""
    gone = [
        f"{path.relative_to(REPOSITORY)}: {name}"
        for folder in ("blinkgl", "eflow", "tools", "configs", "shaders", "tests", "examples")
        for path in sorted((REPOSITORY / folder).rglob("*"))
        if path.suffix in {".py", ".yaml", ".glsl", ".txt", ".ipynb", ".html"}
        for name in re.findall(r"docs/[a-z_]+\.md", path.read_text(encoding="utf-8"))
        if not (REPOSITORY / name).is_file()
    ]
    assert gone == []
