"""Builds the documentation site and looks at every page: no dead link, nothing fetched, no page that none leads to.

    python -m blinkgl.tools.site [--out out/site]

Runs in the repository (`make docs`); a test builds a copy. Zensical's own `--strict` stops at what it can see in the
Markdown; what is checked here is what a reader gets.
"""

from __future__ import annotations

import argparse
import importlib.util
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


class BuildError(RuntimeError):
    """The generator found something; the text is its output."""


class _Page(HTMLParser):
    """What one page offers (anchors) and asks for (links, loads)."""

    def __init__(self, text: str):
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
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
        (copy / "docs/changelog.md").write_text(changelog(copy), encoding="utf-8")
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


def problems(site: Path) -> list[str]:
    """What is wrong with a built site, one line each: ``page: what``. ``site``: its folder."""
    pages = {
        path.relative_to(site).as_posix(): _Page(path.read_text(encoding="utf-8"))
        for path in sorted(site.rglob("*.html"))
    }
    pages.pop(ERROR_PAGE, None)
    found, led_to = [], {name: set() for name in pages}
    files = {path.relative_to(site).as_posix() for path in site.rglob("*") if path.is_file()}
    for name, page in pages.items():
        for link in [*page.links, *page.loads]:
            parts = urlsplit(link)
            if parts.scheme in ("data", "mailto"):
                continue
            if parts.scheme or parts.netloc:
                if link in page.loads:
                    found.append(f"{name}: loads {link}")
                continue
            inside = posixpath.normpath(posixpath.join(posixpath.dirname(name), unquote(parts.path)))
            if not parts.path:
                inside = name
            if inside.startswith(("..", "/")):
                found.append(f"{name}: {link} leads out of the site")
            elif inside not in files:
                found.append(f"{name}: {link} leads nowhere")
            elif inside in pages:
                led_to[name].add(inside)
                if parts.fragment and unquote(parts.fragment) not in pages[inside].anchors:
                    found.append(f"{name}: {link} leads to no such place on the page")
    for style in sorted(site.rglob("*.css")):
        found += [
            f"{style.relative_to(site).as_posix()}: loads {url}"
            for url in re.findall(r"url\([\"']?((?:https?:)?//[^)\"']+)", style.read_text(encoding="utf-8"))
        ]
    seen, ahead = set(), ["index.html"]
    while ahead:
        name = ahead.pop()
        if name in led_to and name not in seen:
            seen.add(name)
            ahead += led_to[name]
    return found + [f"{name}: no link leads here" for name in pages if name not in seen]


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
    found = [*problems(out), *markdown_problems(Path("README.md"))]
    print("\n".join(found) or f"{sum(1 for _ in out.rglob('*.html'))} pages, no dead link: {out / 'index.html'}")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
