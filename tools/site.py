"""Builds the documentation site and checks every page: no dead link, nothing fetched, every page linked.

    python -m blinkgl.tools.site [--out out/site]

Runs in the repository (`make docs`); a test builds a copy. Zensical's own `--strict` stops at what it can see in the
Markdown; what is checked here is what a reader gets.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

SOURCES = (
    "mkdocs.yml",
    "docs",
    "examples",
    "blinkgl",
    "eflow",
    "tools/docstrings.py",
    "README.md",
    "CHANGELOG.md",
    "changes",
    "towncrier.toml",
)
"""What the site is made of."""
FETCHED = {
    ("script", "src"),
    ("link", "href"),
    ("img", "src"),
    ("source", "src"),
    ("video", "src"),
    ("iframe", "src"),
    ("object", "data"),
}
"""What a browser loads when it shows a page, unlike what a reader may click."""
NOT_LOADED = {"canonical", "prev", "next", "alternate", "author"}
"""Of `<link rel=…>`: says something, loads nothing."""
ERROR_PAGE = "404.html"
"""Is shown at any address by a server, so its links start at the root."""
MOVED = "moved.txt"
"""In docs/: old and new places of pages and sections that moved, one pair a line; ``#`` begins a comment."""
PICTURE = re.compile(r'<p>(<img alt="([^"]+)" src="[^"]+" ?/?>)</p>')
"""A picture in a paragraph of its own."""
STUB = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>Moved</title>
<meta name="robots" content="noindex">
<script>location.replace(({places})[location.hash] || {target});</script>
<noscript><meta http-equiv="refresh" content="0; url={address}"></noscript>
</head>
<body>
<p>This page has moved: <a href="{address}">{address}</a></p>
{links}
</body>
</html>
"""


class BuildError(RuntimeError):
    """The generator found something; the text is its output."""


class _Page(HTMLParser):
    """What one page offers (anchors) and asks for (links, loads)."""

    def __init__(self, text: str):
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.moved = False  # a page that only leads on
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors |= {name for name in (values.get("id"), values.get("name") if tag == "a" else None) if name}
        for key, value in values.items():
            if value is None:
                continue
            if (tag, key) in FETCHED and not NOT_LOADED & set((values.get("rel") or "").split()):
                self.loads.append(value)
            elif tag == "a" and key == "href":
                self.links.append(value)
        if tag == "meta" and (values.get("http-equiv") or "").lower() == "refresh":
            self.moved = True
            self.links.append((values.get("content") or "").partition("url=")[2])


def build(root: Path, out: Path) -> None:
    """The site of the repository at ``root``, in ``out``, which is replaced. Raises BuildError for any warning."""
    if importlib.util.find_spec("zensical") is None:
        raise BuildError(
            "error: Zensical is not installed; run pip install -c constraints.txt -e '.[docs]' (Python 3.11 or newer)"
        )
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in SOURCES:
            source, target = root / name, copy / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_dir():
                shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, target)
        # Where the documentation of a module is looked for: the package lies in two places.
        shutil.copytree(root / "tools", copy / "blinkgl/tools", ignore=shutil.ignore_patterns("__pycache__"))
        (copy / "docs/changelog.md").write_text(changelog(copy), encoding="utf-8")
        (copy / "docs/index.md").write_text(first_page(copy), encoding="utf-8")
        moved = moved_places((copy / "docs" / MOVED).read_text(encoding="utf-8"))
        (copy / "docs" / MOVED).unlink()
        done = subprocess.run(
            [sys.executable, "-m", "zensical", "build", "--clean", "--strict"],
            cwd=copy,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise BuildError(re.sub(r"\x1b\[[0-9;]*m", "", done.stdout + done.stderr).partition("Traceback")[0].strip())
        if out.exists():
            shutil.rmtree(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(copy / "out/site", out)
        write_captions(out)
        write_stubs(out, moved)


def write_captions(site: Path) -> None:
    """Show the description of every picture that is a paragraph of its own below the picture."""
    for path in site.glob("*.html"):
        text = path.read_text(encoding="utf-8")
        shown = PICTURE.sub(r"<figure>\1<figcaption>\2</figcaption></figure>", text)
        if shown != text:
            path.write_text(shown, encoding="utf-8")


def moved_places(text: str) -> dict[str, dict[str, str]]:
    """Old page -> its old anchor, with ``#`` ("" for the page itself) -> new place. Raises BuildError.

    text : lines ``OLD.html[#ANCHOR] NEW.html[#ANCHOR]``."""
    pages: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        places = line.split()
        if len(places) != 2:
            raise BuildError(f"docs/{MOVED}: expected an old and a new place, got {line!r}")
        page, mark, anchor = places[0].partition("#")
        pages.setdefault(page, {})[mark + anchor] = places[1]
    for page, places in pages.items():
        if "" not in places:
            raise BuildError(f"docs/{MOVED}: {page} needs a line without an anchor")
    return pages


def write_stubs(site: Path, pages: dict[str, dict[str, str]]) -> None:
    """Write a page at each old place that leads to the new one. Raises BuildError where a page is still there."""
    for page, places in pages.items():
        if (site / page).exists():
            raise BuildError(f"docs/{MOVED}: {page} has not moved")
        links = [f'<p><a id="{old[1:]}" href="{new}">{new}</a></p>' for old, new in places.items() if old]
        text = STUB.format(
            places=json.dumps({old: new for old, new in places.items() if old}),
            target=json.dumps(places[""]),
            address=places[""],
            links="\n".join(links),
        )
        (site / page).write_text(text, encoding="utf-8")


def changelog(root: Path) -> str:
    """CHANGELOG.md with what has not been released, from the fragments in ``changes/``. Raises BuildError."""
    done = subprocess.run(
        [sys.executable, "-m", "towncrier", "build", "--draft", "--version", "next"],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise BuildError(done.stdout + done.stderr)
    coming = re.sub(r"\A.*?^## next.*?$", "## Not released yet", done.stdout, count=1, flags=re.S | re.M)
    return (root / "CHANGELOG.md").read_text(encoding="utf-8").replace("<!-- releases -->", coming.strip())


def first_page(root: Path) -> str:
    """README.md with the links of a page in docs/; files that are no page of the site are only named."""
    text = (root / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    text = text.replace("](CHANGELOG.md)", "](changelog.md)")
    return re.sub(r"\[([^]]+)\]\((?:LICENSE|CITATION\.cff|CONTRIBUTING\.md)\)", r"\1", text)


def problems(site: Path) -> list[str]:
    """What is wrong with a built site, one line each: ``page: what``. ``site``: its folder."""
    pages = {
        path.relative_to(site).as_posix(): _Page(path.read_text(encoding="utf-8"))
        for path in sorted(site.rglob("*.html"))
    }
    pages.pop(ERROR_PAGE, None)
    dead, led_to = [], {name: set() for name in pages}
    files = {path.relative_to(site).as_posix() for path in site.rglob("*") if path.is_file()}
    for name, page in pages.items():
        for link in [*page.links, *page.loads]:
            parts = urlsplit(link)
            if parts.scheme in ("data", "mailto"):
                continue
            if parts.scheme or parts.netloc:
                if link in page.loads:
                    dead.append(f"{name}: loads {link}")
                continue
            inside = posixpath.normpath(posixpath.join(posixpath.dirname(name), unquote(parts.path)))
            if not parts.path:
                inside = name
            if inside.startswith(("..", "/")):
                dead.append(f"{name}: {link} leads out of the site")
            elif inside not in files:
                dead.append(f"{name}: {link} leads nowhere")
            elif inside in pages:
                led_to[name].add(inside)
                if parts.fragment and unquote(parts.fragment) not in pages[inside].anchors:
                    dead.append(f"{name}: {link} leads to no such place on the page")
    for style in sorted(site.rglob("*.css")):
        dead += [
            f"{style.relative_to(site).as_posix()}: loads {url}"
            for url in re.findall(r"url\([\"']?((?:https?:)?//[^)\"']+)", style.read_text(encoding="utf-8"))
        ]
    seen, ahead = set(), ["index.html"]
    while ahead:
        name = ahead.pop()
        if name in led_to and name not in seen:
            seen.add(name)
            ahead += led_to[name]
    return dead + [f"{name}: no link leads here" for name, page in pages.items() if name not in seen and not page.moved]


def markdown_problems(path: Path) -> list[str]:
    """Links of a Markdown file to files that are not there, as a code host shows it: ``file: link``."""
    links = re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8"))
    return [
        f"{path.name}: {link} leads nowhere"
        for link in links
        if not urlsplit(link).scheme and not (path.parent / urlsplit(link).path).exists()
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/site"))
    out = parser.parse_args().out
    try:
        build(Path(), out)
    except BuildError as error:
        print(error, file=sys.stderr)
        return 1
    dead = [*problems(out), *markdown_problems(Path("README.md"))]
    print("\n".join(dead) or f"{sum(1 for _ in out.rglob('*.html'))} pages, no dead link: {out / 'index.html'}")
    return bool(dead)


if __name__ == "__main__":
    sys.exit(main())
