"""``index.jsonl``: one line per sequence of a data set, for loaders that do not want to search a file system.

    {"path": "train/flying_000000", "split": "train", "name": "flying_000000", "sequence": 0, "seed": …, "emulator": "v2e",
     "events": …, "labels": …, "frames": …, "height": …, "width": …, "t_offset_us": …, "duration_us": …, "bytes": …}

Made from the manifests alone and sorted by path: the same sequences give the same file.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, TypeAdapter

from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.io.records import InsidePath, parse, read_text, shown
from blinkgl.io.sequence_dir import MANIFEST, read_manifest

INDEX = "index.jsonl"
_KEYS = ("split", "sequence", "seed", "emulator", "events", "labels", "frames", "height", "width", "t_offset_us", "duration_us", "blinkgl")


def sequence_folders(root: str | Path) -> Iterator[Path]:
    """Folders <root>/<split>/<sequence> with a manifest, or ``root`` itself when it is a sequence; hidden ones are not looked at."""
    root = Path(root)
    if (root / MANIFEST).is_file():
        yield root
        return
    for pattern in ("*", "*/*"):
        for manifest in sorted(root.glob(f"{pattern}/{MANIFEST}")):
            if not any(part.startswith(".") for part in manifest.relative_to(root).parts):
                yield manifest.parent


def entry(root: Path, folder: Path) -> dict[str, Any]:
    """A sequence's line. Raises AssetError for a damaged manifest."""
    manifest = read_manifest(folder)
    return {"path": folder.relative_to(root).as_posix(), "name": folder.name, **{key: manifest.get(key) for key in _KEYS},
            "bytes": sum(file["bytes"] for file in manifest["files"].values())}


def write_index(root: str | Path) -> int:
    """Writes ``index.jsonl`` of the sequences below ``root`` (damaged ones are left out); returns how many. Raises OutputError."""
    root = Path(root)
    entries = []
    for folder in sequence_folders(root):
        try:
            entries.append(entry(root, folder))
        except BlinkGLError:
            continue
    with atomic_file(root / INDEX) as path, output_errors(path):
        path.write_text("".join(json.dumps(line, sort_keys=True) + "\n" for line in sorted(entries, key=lambda e: e["path"])), encoding="utf-8")
    return len(entries)


class _Line(BaseModel):
    """What a reader relies on; "." is the path of a folder that is a sequence itself."""

    model_config = ConfigDict(strict=True, extra="allow")
    path: Literal["."] | InsidePath


_MODEL = TypeAdapter(_Line)


def read_index(root: str | Path) -> list[dict[str, Any]]:
    """The lines of ``index.jsonl``. Raises AssetError: missing, damaged, a path that leaves the data set or is listed twice."""
    path = Path(root) / INDEX
    try:
        entries = [parse(line, _MODEL) for line in read_text(path).splitlines() if line]
    except FileNotFoundError:
        raise AssetError("no such file", where=str(path)) from None
    except ValueError as error:
        raise AssetError(f"damaged index: {error}", where=str(path), accepted="run 'blinkgl report' to make it anew") from None
    if twice := [name for name, count in Counter(line["path"] for line in entries).items() if count > 1]:
        raise AssetError(f"damaged index: {shown(twice[0])} is listed twice", where=str(path), accepted="run 'blinkgl report' to make it anew")
    return entries
