"""Files below the folder of a data set."""

from __future__ import annotations

import os
from collections.abc import Iterator
from fnmatch import filter as matching
from pathlib import Path

from blinkgl.io.atomic import is_temporary


def below(root: Path, pattern: str) -> Iterator[Path]:
    """Yield the files and folders below ``root`` whose name matches ``pattern`` (`*` and `?`), sorted in each folder.

    Links to folders are followed, since subsets are often made of links. Each folder is visited once, so circles of
    links end. What is still being written, such as the next sequence of a run that goes on, is left out."""
    visited = set()
    for folder, folders, files in os.walk(root, followlinks=True):
        real = os.path.realpath(folder)
        if real in visited:
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not is_temporary(name))
        for name in sorted(matching([*folders, *files], pattern)):
            if not is_temporary(name):
                yield Path(folder, name)
