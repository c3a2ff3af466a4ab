"""``index.jsonl``: one line per sequence of a data set, for loaders that do not want to search a file system.

    {"path": "train/flying_000000", "split": "train", "name": "flying_000000", "sequence": 0, "seed": …, "emulator": "v2e",
     "events": …, "labels": …, "frames": …, "height": …, "width": …, "t_offset_us": …, "duration_us": …, "bytes": …}

Made from the manifests alone and sorted by path: the same sequences give the same file.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.atomic import atomic_file, output_errors
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


def read_index(root: str | Path) -> list[dict[str, Any]]:
    """The lines of ``index.jsonl``. Raises AssetError: missing, damaged, or a path that leaves the data set."""
    path = Path(root) / INDEX
    try:
        entries = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
        for one in entries:
            if Path(one["path"]).is_absolute() or ".." in Path(one["path"]).parts:
                raise ValueError
        return entries
    except OSError as error:
        raise AssetError(f"cannot read: {error.strerror}", where=str(path)) from error
    except (ValueError, KeyError, TypeError) as error:
        raise AssetError("damaged index", where=str(path), accepted="run 'blinkgl report' to make it anew") from error
