"""Where the parts of a data set lie below a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from fnmatch import filter as matching
from pathlib import Path


def below(root: Path, pattern: str) -> Iterator[Path]:
    """Files and folders below ``root`` whose name matches ``pattern`` (`*` and `?`), those of a folder in order.

    Links to folders are followed, for subsets are often made of links; each folder is visited once, so that links in
    a circle end."""
    visited = set()
    for folder, folders, files in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders.sort()
        for name in sorted(matching([*folders, *files], pattern)):
            yield Path(folder, name)
