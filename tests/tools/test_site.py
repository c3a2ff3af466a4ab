"""The documentation site builds without a warning, has no dead link, and needs no network to be read."""

from __future__ import annotations

import fcntl
import os
import shutil
from pathlib import Path

import pytest
from webdriver import Browser, missing

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


def test_the_page_of_changes_has_what_is_not_released(built):
    page = (built / "changelog.html").read_text()
    fragments = list((REPOSITORY / "changes").glob("*.md"))
    assert ("Not released yet" in page) == bool(fragments)
    assert page.count("<li>") >= len(fragments) and "0.1.0" in page


def test_every_link_of_the_readme_leads_to_a_file():
    assert site.markdown_problems(REPOSITORY / "README.md") == []


def test_the_reference_has_every_name_of_the_front_door_and_every_room(built):
    page = (built / "python.html").read_text()
    assert [name for name in blinkgl.__all__ if f'id="blinkgl.{name}"' not in page] == []
    rooms = [path.parent.name for path in sorted((REPOSITORY / "blinkgl").glob("*/__init__.py"))]
    assert [room for room in rooms if not (built / f"room_{room}.html").is_file()] == [], (
        "a page docs/room_NAME.md, in mkdocs.yml and docs/rooms.md"
    )


def test_a_warning_is_an_error(tmp_path):
    pytest.importorskip("zensical", reason="the extra [docs] is not installed")
    for name in site.SOURCES:
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_text("") if "." in name else (tmp_path / name).mkdir()
    shutil.copy(REPOSITORY / "towncrier.toml", tmp_path)
    (tmp_path / "mkdocs.yml").write_text("site_name: a\nsite_dir: out/site\nplugins: []\n")
    (tmp_path / "docs/index.md").write_text("# A\n\n[b](b.md)\n")
    with pytest.raises(site.BuildError, match=r"index\.md"):
        site.build(tmp_path, tmp_path / "made")
    assert not (tmp_path / "made").exists()
    (tmp_path / "docs/index.md").write_text("# A\n\n[a](#a)\n")
    site.build(tmp_path, tmp_path / "made")
    assert (tmp_path / "made/index.html").is_file()


def test_each_kind_of_problem_is_found(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "index.html").write_text(
        '<h1 id="top">x</h1><a href="sub/b.html#there">1</a><a href="sub/b.html#gone">2</a>'
        '<a href="c.html">3</a><a href="../out.html">4</a>'
        '<a href="https://a.org/">5</a><a href="#top">6</a><a href="#bottom">7</a>'
        '<img src="d.png"><img src="data:,"><a href="mailto:a@b.org">8</a>'
        '<script src="https://cdn.org/a.js"></script><link rel="canonical" href="https://a.org/">'
        '<link rel="stylesheet" href="//cdn.org/a.css">'
    )
    (tmp_path / "sub/b.html").write_text('<p id="there"></p><a href="../index.html">1</a>')
    (tmp_path / "alone.html").write_text("")
    (tmp_path / "404.html").write_text('<a href="/nothing.html"></a>')
    (tmp_path / "a.css").write_text("@font-face {src: url('https://fonts.org/a.woff')} a {background: url(data:,)}")
    assert site.problems(tmp_path) == [
        "index.html: sub/b.html#gone leads to no such place on the page",
        "index.html: c.html leads nowhere",
        "index.html: ../out.html leads out of the site",
        "index.html: #bottom leads to no such place on the page",
        "index.html: d.png leads nowhere",
        "index.html: loads https://cdn.org/a.js",
        "index.html: loads //cdn.org/a.css",
        "a.css: loads https://fonts.org/a.woff",
        "alone.html: no link leads here",
    ]
    (tmp_path / "a.md").write_text("[1](a.md) [2](b.md) ![3](c.png#x) [4](https://a.org) [5](#a)")
    assert site.markdown_problems(tmp_path / "a.md") == ["a.md: b.md leads nowhere", "a.md: c.png#x leads nowhere"]


@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_pages_and_search_work_from_the_disk(built, tmp_path):
    with Browser(tmp_path) as browser:
        browser.open((built / "index.html").as_uri())
        browser.wait(
            "const button = document.querySelector('button.md-search__button'); button?.click(); return button"
        )
        found = browser.wait(  # what is shown of the search lies in a shadow tree
            "const roots = [...document.querySelectorAll('*')].map(e => e.shadowRoot);"
            "const box = roots.find(r => r?.querySelector('input')), field = box?.querySelector('input');"
            "if (field && !field.value) {"
            "  field.value = 'refractory'; field.dispatchEvent(new Event('input', {bubbles: true}))}"
            "return box && [...box.querySelectorAll('a')].map(a => a.href)[0]"
        )
        assert found.startswith(built.as_uri())
        loaded = browser.run("return performance.getEntriesByType('resource').map(e => e.name)")
        assert [url for url in loaded if not url.startswith(("file:", "data:", "blob:"))] == []
        assert browser.errors() == []
