"""The files that a mesh file refers to: which one a name means, and where it may lie."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from blinkgl.errors import AssetError
from blinkgl.scene.reading import Omissions

_OUTSIDE = "lies outside the folder of the pool or recipe"


@dataclass(eq=False)
class Neighbours:
    """The files that the one at ``path`` may refer to: those below ``border``, a pool's folder or a recipe's.

    border : None: the file's own folder.   omissions, log : get what is not drawn, and what was decided."""

    path: Path
    border: Path | None = None
    omissions: Omissions = field(default_factory=lambda: Omissions(""))
    log: list[str] = field(default_factory=list)

    def find(self, name: str, inner: Path | None = None) -> Path:
        """Return the file that ``name`` means, relative to the folder ``inner``, or to that of the mesh. Where no file
        has that name, the only one of other case has it. Raises AssetError: missing, or beyond the border."""
        folder, why = self.path.parent, "is missing"
        plain = name.strip('"').replace("\\", "/")
        if "://" in plain:
            why = "is on a network"
        for base in dict.fromkeys((inner or folder, folder) if plain and "://" not in plain else ()):
            try:
                file = base / plain
                if not self._within(file):
                    why = _OUTSIDE
                elif (file := _of_any_case(base, file)) and self._within(file):
                    if file.name != Path(plain).name:
                        self.log.append(f"{self.path.stem}: '{name}' is taken from {file.name}")
                    return file
            except (OSError, ValueError, RuntimeError):  # a name too long or with a NUL, or a link to itself
                continue
        raise AssetError(f"refers to a file that {why}", where=str(self.path), value=name)

    def optional(self, names: Iterable[str], inner: Path | None = None) -> Path | None:
        """Return the first file that is found of several readings of one name; None: none is, which is noted."""
        problem = ""
        for name in dict.fromkeys(names):
            try:
                return self.find(name, inner)
            except AssetError as error:
                problem = f"'{name}', which {error.problem.removeprefix('refers to a file that ')}"
        self.omissions.add(problem)
        return None

    def _within(self, file: Path) -> bool:
        return file.resolve().is_relative_to((self.border or self.path.parent).resolve())


def _of_any_case(base: Path, file: Path) -> Path | None:
    """Return the file itself, or the only one below ``base`` whose name differs by case; None: there is none."""
    if file.is_file():
        return file
    at = base
    for part in os.path.relpath(file, base).split(os.sep):
        step = at / part
        if part != ".." and not step.exists():
            alike = [name for name in os.listdir(at) if name.casefold() == part.casefold()]
            if len(alike) != 1:
                return None
            step = at / alike[0]
        at = step
    return at if at.is_file() else None
