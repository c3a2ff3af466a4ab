"""The files that a mesh file refers to: which one a name means, and where it may lie."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from blinkgl.errors import AssetError
from blinkgl.scene.reading import Omissions


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
        plain, why = name.strip('"').replace("\\", "/"), "is on a network" if "://" in name else "is missing"
        # Letters of either case; what glob knows as a pattern stands for itself.
        either = "".join(f"[{c.lower()}{c.upper()}]" if c.isalpha() else f"[{c}]" if c in "*?[" else c for c in plain)
        for base in dict.fromkeys((inner or self.path.parent, self.path.parent)):
            with suppress(OSError, ValueError, RuntimeError):  # a name too long or with a NUL, or a link to itself
                within = "://" not in plain and self._within(base / plain)
                why = why if within or "://" in plain else "lies outside the folder of the pool or recipe"
                if within and (base / plain).is_file():
                    return base / plain
                alike = [file for file in base.glob(either) if file.is_file()] if within and plain[:1] != "/" else []
                if len(alike) == 1 and self._within(alike[0]):
                    self.log.append(f"{self.path.stem}: '{name}' is taken from {alike[0].name}")
                    return alike[0]
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

    @cached_property
    def _root(self) -> Path:
        return (self.border or self.path.parent).resolve()

    def _within(self, file: Path) -> bool:
        return file.resolve().is_relative_to(self._root)
