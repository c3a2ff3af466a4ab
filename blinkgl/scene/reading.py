"""What goes wrong while a file is read, and what it asks for that is not drawn, as lines that name the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from blinkgl.errors import AssetError, BlinkGLError

MAX_BYTES = 2_000_000_000


@contextmanager
def reading(what: str, where: str) -> Iterator[None]:
    """Everything that reading a ``what`` (mesh, image, scene) from the file ``where`` raises becomes an AssetError.

    The readers check what they know to check and say what is wrong. What is left is what nobody thought of, and what
    the parsers of other packages raise on broken files: ValueError, KeyError, IndexError, struct.error, OSError,
    SyntaxError, … The cause is kept for ``--debug``.
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
    """The bytes of a file. AssetError naming it (``where``): it cannot be read, or is longer than ``max_bytes``."""
    where = where or str(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise AssetError(
                f"the {what} file is too large",
                where=where,
                value=f"{size / 1e6:.0f} MB",
                accepted=f"at most {max_bytes / 1e6:.0f} MB",
            )
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise AssetError(f"cannot read the {what}: {getattr(error, 'strerror', None) or error}", where=where) from None


# ---------------------------------------------------------------------------------------------------------------------
# What a file asks for and BlinkGL does not draw: a loader collects it, a run says it, in one line per file.


@dataclass
class Omissions:
    """Of one file, in the order met.

    name : the file's name without its folder: the line goes into manifests, which know no machine.
    """

    name: str
    found: dict[str, None] = field(default_factory=dict)

    def add(self, what: str) -> None:
        """``what``: a few words from the file's own world, with what is done instead: "alpha BLEND (drawn opaque)"."""
        self.found[what] = None

    def lines(self) -> tuple[str, ...]:
        """The one line, or nothing."""
        return (f"{self.name} asks for what is not drawn: " + "; ".join(self.found),) if self.found else ()
