"""The clocks of USD and Alembic files, which Blender's importers do not read. Standard library, and what Blender
brings along."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import BinaryIO


def rate_of(source: Path, libraries: Path) -> float | None:
    """Return the time codes per second of a USD file, or the samples per second of an Alembic file; None: it is of
    another kind or does not say so.   libraries : the folder of Blender's own Python packages."""
    with open(source, "rb") as file:
        if file.read(5) == b"Ogawa":
            return alembic_rate(file)
    return usd_rate(source, libraries) if source.suffix.lower().startswith(".usd") else None


def usd_rate(source: Path, libraries: Path) -> float | None:
    """Return ``timeCodesPerSecond`` by USD's own library, with its fallbacks (``framesPerSecond``, 24); None: the
    library or the file cannot be read."""
    # The one of Blender, not of the environment: two in one process do not get on.
    sys.path.insert(0, str(libraries))
    try:
        from pxr import Sdf

        layer = Sdf.Layer.FindOrOpen(str(source))
    except (ImportError, RuntimeError):
        return None
    finally:
        sys.path.remove(str(libraries))
    return float(layer.timeCodesPerSecond) or None if layer else None


def alembic_rate(file: BinaryIO) -> float | None:
    """Return the samples per second of the sampling that an Ogawa file of Alembic uses most; None: there is none.

    A group is the number of its children and the place of each (the top bit set for data); the root's fifth child
    lists the samplings: greatest count, seconds per cycle, number of times, and these times."""

    def number(place: int) -> int:
        file.seek(place)
        return int(struct.unpack("<Q", file.read(8))[0])

    place = number(number(8) + 8 + 4 * 8) & ~(1 << 63)
    table, best, at = file.read(number(place)), (1, 0.0), 0
    while at + 16 <= len(table):
        count, cycle, times = struct.unpack_from("<IdI", table, at)
        best, at = max(best, (count, cycle / times if times else 0.0)), at + 16 + 8 * times
    return 1 / best[1] if 1e-4 < best[1] < 1 else None
