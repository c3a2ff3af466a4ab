"""Errors while a file is read, and features of a file that are not drawn, as lines that name the file."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from blinkgl.errors import AssetError, BlinkGLError, ConfigError

MAX_BYTES = 2_000_000_000


def resolve(path: str, base: Path) -> Path:
    """Return a path of the YAML: ``~`` expanded, relative to the YAML file's folder."""
    return base / Path(path).expanduser()  # an absolute path stays


def existing(path: str, base: Path, where: str, accepted: str) -> Path:
    """Return :func:`resolve` of a file that exists. Raises ConfigError, which names the key ``where``."""
    file = resolve(path, base)
    if not file.is_file():
        raise ConfigError("no such file", where=where, value=path, accepted=accepted)
    return file


def limit_faces(count: int, most: int, where: str) -> None:
    """Raise AssetError when a mesh has more than ``most`` faces."""
    if count > most:
        raise AssetError("the mesh has too many faces", where=where, value=count, accepted=f"at most {most}")


@contextmanager
def reading(what: str, where: str) -> Iterator[None]:
    """Convert every exception raised while reading a ``what`` (mesh, image, scene) from the file ``where`` to an
    AssetError.

    The readers report the errors that they check for. The rest are unforeseen errors, and what the parsers of other
    packages raise on broken files: ValueError, KeyError, IndexError, struct.error, OSError, SyntaxError, … The cause is
    kept for ``--debug``.
    """
    try:
        yield
    except BlinkGLError:
        raise
    except MemoryError as error:
        raise AssetError(f"the {what} does not fit into memory", where=where) from error
    except RecursionError as error:
        raise AssetError(f"the {what} is corrupt (nested too deeply)", where=where) from error
    except Exception as error:
        detail = f"{type(error).__name__}: {' '.join(str(error).split())[:80]}"
        raise AssetError(f"the {what} is corrupt or of an unknown format ({detail})", where=where) from error


def contents(path: Path, what: str, where: str | None = None, max_bytes: int = MAX_BYTES) -> bytes:
    """Return the bytes of a file. Raises AssetError naming it (``where``): it cannot be read, or is longer than
    ``max_bytes``."""
    where = where or str(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            # Before reading: a sparse file of terabytes costs no more than its directory entry.
            raise AssetError(
                f"the {what} file is too large",
                where=where,
                value=f"{size / 1e6:.0f} MB",
                accepted=f"at most {max_bytes / 1e6:.0f} MB",
            )
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise AssetError(f"cannot read the {what}: {getattr(error, 'strerror', None) or error}", where=where) from None


class Cache:
    """What was loaded last, ``limit`` bytes in all: a process that makes sequences of many groups for days uses no more
    memory than one that makes a few."""

    def __init__(self, limit: int):
        self.limit, self.held = limit, 0
        self._kept: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable, load: Callable[[], Any], size_of: Callable[[Any], int]) -> Any:
        """Return the stored content of this key, or ``load()``, which is not changed afterwards.
        size_of : its bytes."""
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][0]
        loaded = load()
        size = size_of(loaded)
        self._kept[key] = loaded, size
        self.held += size
        # The last one stays whatever its size, since the caller uses it next.
        while self.held > self.limit and len(self._kept) > 1:
            self.held -= self._kept.popitem(last=False)[1][1]
        return loaded


RECENT = Cache(256_000_000)
"""The process's meshes and textures that were used last."""

# ---------------------------------------------------------------------------------------------------------------------
# Features that a file uses and BlinkGL does not draw: collected by a loader, reported by a run in one line per file.


@dataclass
class Omissions:
    """The undrawn features of one file, in the order met.

    name : the file's name without its folder: the line is written to manifests, which must not depend on the
    machine.
    """

    name: str
    found: dict[str, None] = field(default_factory=dict)

    def add(self, what: str) -> None:
        """Add a feature. ``what``: a few words in the file's terms, with what is done instead: "alpha BLEND (drawn
        opaque)"."""
        self.found[what] = None

    def unknown(self, what: str, names: Iterable[str]) -> None:
        """Add the first five ``names`` that a format's closed list does not have, as those of a ``what``; nothing for
        none."""
        if ordered := sorted(names):
            self.add(f"unknown {what} ({', '.join(ordered[:5])}{', …' if len(ordered) > 5 else ''})")

    def lines(self) -> tuple[str, ...]:
        """Return the one line, or nothing."""
        return (f"{self.name} asks for what is not drawn: " + "; ".join(self.found),) if self.found else ()
