"""The order of numbered files, and what does not belong to their series."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path

from blinkgl.errors import EventDataError

# A sign counts at the beginning of the name, or after something that is neither a letter nor a digit: frame-1 is not
# minus one. An exponent has to end with the number.
_NUMBER = re.compile(r"(?:(?<![A-Za-z0-9])[-+])?\d+(?:\.\d+)?(?:[eE][-+]?\d{1,2}(?![A-Za-z0-9.]))?")
_DOTTED = re.compile(r"\d+")
_LOSSLESS = (".exr", ".pfm", ".hdr", ".tif", ".tiff", ".png", ".bmp", ".pgm", ".ppm", ".webp")
_MAJORITY = 0.8
"""Part of the files from which on the others count as strangers."""
_SHOWN, _MOST_PLACES = 3, 2**31


@dataclass
class Series:
    """Files in order.   numbers : the one number that differs from name to name, if there is one.   notes : what is
    left out and why, a line each."""

    files: list[Path]
    numbers: list[Decimal] | None = None
    notes: list[str] = field(default_factory=list)

    def places(self) -> list[Decimal] | None:
        """Return each file's place, in frames from the first, where numbers are evenly spaced but for gaps; None where
        they are not, or nothing is missing."""
        if self.numbers is None or len(self.numbers) < 3:
            return None
        steps = [b - a for a, b in zip(self.numbers, self.numbers[1:])]
        step, often = Counter(steps).most_common(1)[0]
        if step <= 0 or often < 0.5 * len(steps) or often == len(steps):
            return None
        places = [(number - self.numbers[0]) / step for number in self.numbers]
        return (
            places
            if places[-1] < _MOST_PLACES and all(place == place.to_integral_value() for place in places)
            else None
        )

    def missing(self) -> list[str]:
        """Return the lines that say which numbers are missing."""
        places = self.places()
        if places is None:
            return []
        gaps = [k for k in range(1, len(places)) if places[k] - places[k - 1] != 1]
        count = sum(int(places[k] - places[k - 1]) - 1 for k in gaps)
        beside = ", ".join(f"after {self.files[k - 1].name}" for k in gaps[:_SHOWN]) + (
            " …" if len(gaps) > _SHOWN else ""
        )
        return [f"{count} frames are missing ({beside}): times follow the numbers, not the files"]


def natural_order(paths: Iterable[Path]) -> list[Path]:
    """Return files in the order of the numbers in their names: 2 before 10, .05 before .1, 1e-3 before 2e-3, -1 before
    0; equal numbers by name."""
    paths = list(paths)
    pattern = _pattern(paths)
    return sorted(paths, key=lambda path: (_key(path.stem, pattern), path.name))


def series(folder: Path, suffixes: Iterable[str], wanted: Callable[[Path], bool] = lambda path: True) -> Series:
    """Return the files of ``folder`` with one of the suffixes that are ``wanted``, as one series.

    Hidden files, a second file of the same name stem, and few names unlike all others are left out, with a line each.
    Raises EventDataError: two series in one folder."""
    endings = {suffix.lower() for suffix in suffixes}
    named = [path for path in folder.iterdir() if path.suffix.lower() in endings and wanted(path)]
    files, notes = [path for path in named if path.is_file()], []
    if gone := [path for path in named if path.is_symlink() and not path.exists()]:
        notes.append(f"{_named(sorted(gone))}: left out, since the link leads to no file")
    hidden = [path for path in files if path.name.startswith(".")]
    if hidden:
        notes.append(f"{_named(hidden)}: hidden, so left out")
    below = [path for path in sorted(folder.iterdir()) if path.is_dir() and _holds(path, endings)]
    if files and below:
        notes.append(f"{_named(below)}: a folder, so its files are left out")
    files = natural_order(path for path in files if not path.name.startswith("."))
    files, twice = _one_each(files)
    if twice:
        kept = sorted({path.suffix for path in files if path.stem in {other.stem for other in twice}})
        notes.append(f"{_named(twice)}: left out, since there is a {', '.join(kept)} of the same name")
    files, odd = _alike(files, folder)
    if odd:
        notes.append(
            f"{_named(odd)}: left out, since the names of the {len(files)} others are of the form {_shape(files[0])}"
        )
    return Series(files, _numbers(files), notes)


def _holds(folder: Path, endings: Collection[str]) -> bool:
    """Return whether a folder has files of one of the endings; False for one that cannot be listed."""
    try:
        return any(path.suffix.lower() in endings for path in folder.iterdir())
    except OSError:
        return False


def _one_each(files: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return one file of each stem, and the others: the ending that most have, else the one that loses nothing."""
    endings = Counter(path.suffix.lower() for path in files)
    rank = lambda path: (
        -endings[path.suffix.lower()],
        _LOSSLESS.index(path.suffix.lower()) if path.suffix.lower() in _LOSSLESS else len(_LOSSLESS),
    )
    best: dict[str, Path] = {}
    for path in files:
        if path.stem not in best or rank(path) < rank(best[path.stem]):
            best[path.stem] = path
    chosen = set(best.values())
    return [path for path in files if path in chosen], [path for path in files if path not in chosen]


def _alike(files: list[Path], folder: Path) -> tuple[list[Path], list[Path]]:
    shapes = Counter(_shape(path) for path in files)
    if len(shapes) < 2:
        return files, []
    (first, often), (second, less) = shapes.most_common(2)
    # Names without a number are no series, so that none is a stranger to it.
    if "#" not in first:
        return files, []
    if often >= max(_MAJORITY * len(files), 3):
        return [p for p in files if _shape(p) == first], [p for p in files if _shape(p) != first]
    if "#" in second and less >= 3:
        raise EventDataError(
            "two series of pictures in one folder",
            where=str(folder),
            value=f"{often} named {first}, {less} named {second}",
            accepted="a folder of one series",
        )
    return files, []


def _shape(path: Path) -> str:
    return _NUMBER.sub("#", path.stem)


def _pattern(paths: Sequence[Path]) -> re.Pattern:
    """Return what counts as a number: 1.10 follows 1.9 where trailing zeros show that the point separates two
    counters; decimals are printed without them, and with zeros in front."""
    parts = [part for path in paths for part in re.findall(r"\d\.(\d+)(?!\.?\d)", path.stem)]
    widths = {len(part) for part in parts}
    counters = any(len(part) > 1 and part[-1] == "0" for part in parts) and not any(
        len(part) > 1 and part[0] == "0" for part in parts
    )
    several = any(re.search(r"\d\.\d+\.\d", path.stem) for path in paths)
    return _DOTTED if several or (len(widths) > 1 and counters) else _NUMBER


def _key(stem: str, pattern: re.Pattern) -> tuple:
    """Return a sort key: text and numbers in turn, texts before numbers of the same place."""
    key: list[tuple[int, str | Decimal]] = []
    at = 0
    for match in pattern.finditer(stem):
        if match.start() > at:
            key.append((0, stem[at : match.start()]))
        key.append((1, Decimal(match[0])))
        at = match.end()
    if at < len(stem):
        key.append((0, stem[at:]))
    return tuple(key)


def _numbers(files: Sequence[Path]) -> list[Decimal] | None:
    pattern = _pattern(files)
    rows = [[value for kind, value in _key(path.stem, pattern) if kind] for path in files]
    if not rows or len({len(row) for row in rows}) > 1:
        return None
    different = [column for column in zip(*rows) if len(set(column)) > 1]
    return list(different[0]) if len(different) == 1 else None


def _named(paths: Sequence[Path]) -> str:
    names = ", ".join(path.name for path in paths[:_SHOWN])
    return names if len(paths) <= _SHOWN else f"{names} and {len(paths) - _SHOWN} more"
