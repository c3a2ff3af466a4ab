"""The clocks of USD and Alembic files, which Blender's importers do not read. Standard library only."""

from __future__ import annotations

import re
import struct
import zipfile
from pathlib import Path
from typing import BinaryIO


def rate_of(source: Path) -> float | None:
    """Return the time codes per second of a USD file of text, or the samples per second of an Alembic file; None: it is
    of another kind or does not say so."""
    with open(source, "rb") as file:
        head = file.read(1 << 16)
        if head[:5] == b"Ogawa":
            return alembic_rate(file)
    if source.suffix.lower() == ".usdz" and zipfile.is_zipfile(source):
        with zipfile.ZipFile(source) as archive, archive.open(archive.infolist()[0]) as file:
            head = file.read(1 << 16)
    if not head.startswith(b"#usda"):
        return None
    # The layer's own settings stand before its first prim; 24 is the standard's default.
    settings = re.split(rb"\n\s*(?:def|over|class)\s", head)[0]
    stated = dict(re.findall(rb"(?m)^\s*(\w+PerSecond)\s*=\s*([\d.eE+]+)", settings))
    return float(stated.get(b"timeCodesPerSecond", stated.get(b"framesPerSecond", b"24"))) or None


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
