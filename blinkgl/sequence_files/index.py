"""``index.jsonl``: one line per sequence of a data set, for loaders that should not search the file system.

    {"path": "train/flying_000000", "split": "train", "name": "flying_000000", "sequence":
    0, "seed": …, "emulator": "v2e",
     "events": …, "labels": …, "frames": …, "height": …, "width": …, "t_offset_us": …, "duration_us": …, "bytes": …}

It is made only from the manifests and sorted by path: the same sequences give the same file.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ConfigDict, TypeAdapter

from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.io.records import inside, named, parse, read_text, shown
from blinkgl.sequence_files.manifest import HereOrInside
from blinkgl.sequence_files.sequence_dir import MANIFEST, is_rig_folder, read_manifest
from blinkgl.types.trees import Tree

INDEX = "index.jsonl"
_KEYS = (
    "split",
    "sequence",
    "seed",
    "emulator",
    "events",
    "labels",
    "frames",
    "height",
    "width",
    "t_offset_us",
    "duration_us",
    "blinkgl",
)


def data_set(root: str | Path) -> Path:
    """Return the folder of a data set. Raises AssetError: there is none."""
    root = Path(root)
    if not root.is_dir():
        raise AssetError("no such data set", where=str(root), accepted="a folder of sequences")
    return root


def sequence_folders(root: str | Path) -> Iterator[Path]:
    """Yield folders <root>/<split>/<sequence> with a manifest, or ``root`` itself when it is a sequence; of a rig those
    of its cameras, <root>/<split>/<sequence>/<sensor>. Hidden folders are skipped."""
    for folder in made_folders(root):
        if is_rig_folder(folder):
            yield from (inside(folder, manifest.parent.name) for manifest in sorted(folder.glob(f"*/{MANIFEST}")))
        else:
            yield folder


def made_folders(root: str | Path) -> Iterator[Path]:
    """Yield the same, but for a rig its own folder: what a run makes, one per task. Symbolic links below ``root`` are
    not followed: they could lead out of it; 'blinkgl verify' names them."""
    root = Path(root)
    if (root / MANIFEST).is_file():
        yield root
        return
    # A set has its sequences in its own folder, or below one folder a split.
    for pattern in ("*", "*/*"):
        for manifest in sorted(root.glob(f"{pattern}/{MANIFEST}")):
            of_rig = pattern == "*/*" and is_rig_folder(manifest.parent.parent)
            hidden = any(part.startswith(".") for part in manifest.relative_to(root).parts)
            linked = manifest.parent.is_symlink() or (pattern == "*/*" and manifest.parent.parent.is_symlink())
            if not (of_rig or hidden or linked):
                yield manifest.parent


_SOMETIMES = ("events_by_cause", "sensor")
"""Keys that only some manifests have."""


def entry(root: Path, folder: Path) -> Tree:
    """Return a sequence's line. Raises AssetError for a damaged manifest."""
    manifest, own = read_manifest(folder), named(folder)
    return {
        "path": folder.relative_to(root).as_posix(),
        "name": own.name if "sensor" not in manifest else f"{named(own.parent).name}/{own.name}",
        **{key: manifest.get(key) for key in _KEYS},
        **{key: manifest[key] for key in _SOMETIMES if key in manifest},
        "bytes": sum(file["bytes"] for file in manifest["files"].values()),
    }


def task_of(line: Tree) -> str:
    """Return the folder that the task behind a line of the index wrote; for a camera of a rig, the rig's folder."""
    path = PurePosixPath(line["path"])
    return str(path.parent if "sensor" in line else path)


def write_index(root: str | Path) -> int:
    """Write ``index.jsonl`` of the sequences below ``root`` (without damaged ones); return their number. Raises
    OutputError."""
    root = Path(root)
    entries = []
    for folder in sequence_folders(root):
        with contextlib.suppress(BlinkGLError):
            entries.append(entry(root, folder))
    write_lines(root, entries)
    return len(entries)


def write_lines(root: Path, lines: list[dict[str, object]]) -> None:
    """Write ``index.jsonl`` of these lines. Raises OutputError."""
    with atomic_file(root / INDEX) as path, output_errors(path), open(path, "w", encoding="utf-8") as file:
        file.writelines(json.dumps(line, sort_keys=True) + "\n" for line in sorted(lines, key=itemgetter("path")))


class _Line(BaseModel):
    """The guaranteed keys of a line; "." is the path of a folder that is a sequence itself."""

    model_config = ConfigDict(strict=True, extra="allow")
    path: HereOrInside


_MODEL = TypeAdapter(_Line)


def read_index(root: str | Path) -> list[Tree]:
    """Return the lines of ``index.jsonl``. Raises AssetError: missing, damaged, a path that leaves the data set or is
    listed twice."""
    path = Path(root) / INDEX
    try:
        entries = [parse(line, _MODEL) for line in read_text(path).splitlines() if line]
    except FileNotFoundError:
        raise AssetError("no such file", where=str(path)) from None
    except ValueError as error:
        raise AssetError(
            f"damaged index: {error}", where=str(path), accepted="run 'blinkgl report' to rebuild it"
        ) from None
    if twice := [name for name, count in Counter(line["path"] for line in entries).items() if count > 1]:
        raise AssetError(
            f"damaged index: {shown(twice[0])} is listed twice",
            where=str(path),
            accepted="run 'blinkgl report' to rebuild it",
        )
    return entries
