"""Is a data set whole and right? Files against manifests, contents against the formats, and a sample against itself made anew.

A sequence's problems are lines of text; none means none found.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.sequence import RunTemplate, load_run
from blinkgl.dataset.generate import generate_sequence
from blinkgl.io.index import INDEX, entry, read_index, sequence_folders
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.work import RUN_FOLDER
from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.gl import GLContext, create_context
from blinkgl.io.flow_png import read_flow_png
from blinkgl.io.hdf5 import open_hdf5
from blinkgl.io.images import read_image
from blinkgl.io.sequence_dir import MANIFEST, read_manifest, verify_sequence

_BLOCK = 1 << 20
_REQUIRED = {"format": str, "format_version": int, "height": int, "width": int, "events": int, "t_offset_us": int, "duration_us": int,
             "seed": int, "sequence": int, "split": str, "labels": int, "files": dict}
_AT_TOP = {INDEX, "report.html"}


@dataclass
class Verification:
    """``problems``: sequence (or "." for the data set) -> lines. ``deep``: sequences that were made again, bit by bit the same or not."""

    sequences: int = 0
    problems: dict[str, list[str]] = field(default_factory=dict)
    deep: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        return not self.problems

    def add(self, name: str, problems: list[str]) -> None:
        if problems:
            self.problems.setdefault(name, []).extend(problems)


def verify_dataset(root: str | Path, *, deep: int = 0, seed: int = 0, base: str | Path | None = None,
                   progress: Callable[[int, str], None] | None = None) -> Verification:
    """Every sequence below ``root``, and what lies between them.

    deep : so many sequences, drawn with ``seed``, are generated again and compared bit by bit.
    base : folder that the recipe's relative paths start from; default: as the run's record says.
    Raises AssetError when ``root`` holds no sequence at all."""
    root = Path(root)
    if not root.is_dir():
        raise AssetError("no such data set", where=str(root), accepted="a folder of sequences")
    result = Verification()
    folders = list(sequence_folders(root))
    if not folders and not (root / RUN_FOLDER).is_dir():
        raise AssetError("no sequence found", where=str(root), accepted="a folder that 'blinkgl generate' wrote")
    for number, folder in enumerate(folders):
        name = folder.relative_to(root).as_posix()
        if progress:
            progress(number, name)
        result.add(name, check_sequence(folder))
    result.sequences = len(folders)
    if not (root / MANIFEST).is_file():
        result.add(".", _between(root, folders))
        _against_run(root, folders, result)
    sound = [f for f in folders if f.relative_to(root).as_posix() not in result.problems]
    if deep and sound:
        chosen = np.random.default_rng(seed).permutation(len(sound))[:deep]
        for number in sorted(chosen):
            if progress:
                progress(len(folders), "again: " + sound[number].name)
        _deep(root, [sound[i] for i in sorted(chosen)], result, base)
        if not result.deep and result.notes:
            result.add(".", ["nothing could be compared on this machine"])
    return result


def check_sequence(folder: Path) -> list[str]:
    """Checksums first; contents only where those hold."""
    problems = verify_sequence(folder)
    if problems:
        return problems
    manifest = read_manifest(folder)
    problems = [f"{MANIFEST}: '{key}' is missing or no {kind.__name__}" for key, kind in _REQUIRED.items() if not isinstance(manifest.get(key), kind)]
    if problems:
        return problems
    if "events.h5" in manifest["files"]:
        try:
            problems += check_events(folder / "events.h5", manifest)
        except (BlinkGLError, OSError, KeyError, TypeError, ValueError) as error:
            problems.append(f"events.h5: cannot be read: {' '.join(str(error).split())[:120]}")
    try:
        problems += _check_labels(folder, manifest)
    except (BlinkGLError, OSError, ValueError) as error:
        problems.append(" ".join(str(error).split()))
    return problems


def check_events(path: Path, manifest: dict[str, Any]) -> list[str]:
    """Sorted, inside the sensor and the sequence's time, counted as the manifest says, and ``ms_to_idx`` right at every millisecond."""
    problems = []
    with open_hdf5(path) as file:
        columns = {k: file[f"events/{k}"] for k in "xytp"}
        ms_to_idx, offset = file["ms_to_idx"][()].astype(np.int64), int(file["t_offset"][()])
        counts = {k: len(c) for k, c in columns.items()}
        if set(counts.values()) != {manifest["events"]}:
            return [f"events.h5: columns of {sorted(set(counts.values()))} events, manifest says {manifest['events']}"]
        if offset != manifest["t_offset_us"]:
            problems.append(f"events.h5: t_offset is {offset}, manifest says {manifest['t_offset_us']}")
        last, end = 0, manifest["duration_us"]
        expected = np.zeros(len(ms_to_idx), np.int64)
        marks = np.arange(len(ms_to_idx), dtype=np.int64) * 1000
        for begin in range(0, manifest["events"], _BLOCK):
            x, y, t, p = (columns[k][begin:begin + _BLOCK].astype(np.int64) for k in "xytp")
            if (np.diff(t) < 0).any() or t[0] < last:
                problems.append(f"events.h5: times decrease after event {begin + int(np.argmax(np.diff(t, prepend=last) < 0))}")
                break
            last = int(t[-1])
            if x.max() >= manifest["width"] or y.max() >= manifest["height"]:
                problems.append(f"events.h5: an event outside {manifest['width']}x{manifest['height']} px")
                break
            if p.max() > 1:
                problems.append("events.h5: a polarity other than 0 and 1")
                break
            expected += np.searchsorted(t, marks)
        else:
            if manifest["events"] and last > end:
                problems.append(f"events.h5: last event at {last} µs, the sequence ends at {end} µs")
            if not len(ms_to_idx) or len(ms_to_idx) < -(-end // 1000) + 1:
                problems.append(f"events.h5: ms_to_idx has {len(ms_to_idx)} entries, {-(-end // 1000) + 1} are needed")
            elif (wrong := np.flatnonzero(ms_to_idx != expected)).size:
                problems.append(f"events.h5: ms_to_idx[{wrong[0]}] is {ms_to_idx[wrong[0]]}, expected {expected[wrong[0]]}")
    return problems


def _check_labels(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """As many files as time stamps as labels; sizes as the manifest says; times inside the sequence and in order."""
    problems = []
    size = (manifest["height"], manifest["width"])
    begin, end = manifest["t_offset_us"], manifest["t_offset_us"] + manifest["duration_us"]
    names = manifest["files"]
    stamps = "images/timestamps.txt"
    if stamps in names:
        times = [int(line) for line in (folder / stamps).read_text().split()]
        pictures = sorted(n for n in names if n.startswith("images/") and n.endswith(".png"))
        if len(times) != len(pictures):
            problems.append(f"images: {len(pictures)} files, {len(times)} time stamps")
        if sorted(set(times)) != times or (times and not begin <= times[0] <= times[-1] <= end):
            problems.append(f"{stamps}: times are not in order inside {begin} … {end} µs")
        for name in pictures[:1] + pictures[-1:]:
            if read_image(folder / name).shape[:2] != size:
                problems.append(f"{name}: not {size[1]}x{size[0]} px")
    for direction in ("forward", "backward"):
        stamps = f"flow/{direction}_timestamps.txt"
        if stamps not in names:
            continue
        lines = [line for line in (folder / stamps).read_text().splitlines() if line and not line.startswith("#")]
        pairs = [tuple(int(v) for v in line.split(",")) for line in lines]
        flows = sorted(n for n in names if n.startswith(f"flow/{direction}/"))
        if not len(flows) == len(pairs) == manifest["labels"]:
            problems.append(f"flow/{direction}: {len(flows)} files, {len(pairs)} time stamps, manifest says {manifest['labels']} labels")
        if any(not begin <= t <= end for pair in pairs for t in pair) or any((b > a) != (direction == "forward") for a, b in pairs):
            problems.append(f"{stamps}: an interval leaves the sequence or runs the wrong way")
        for name in flows[:1] + flows[-1:]:
            if read_flow_png(folder / name)[0].shape[:2] != size:
                problems.append(f"{name}: not {size[1]}x{size[0]} px")
    for kind in ("depth", "velocity", "normals", "ids"):
        files = [n for n in names if n.startswith(f"{kind}/")]
        if files and len(files) != manifest["labels"]:
            problems.append(f"{kind}: {len(files)} files, manifest says {manifest['labels']} labels")
    return problems


def _between(root: Path, folders: list[Path]) -> list[str]:
    """What lies in the data set and belongs to no sequence."""
    problems = []
    known = set(folders)
    parents = {folder.parent for folder in folders} | {root}

    def look(folder: Path) -> Iterator[Path]:
        for path in sorted(folder.iterdir()):
            if path in known or (folder == root and path.name in (*_AT_TOP, RUN_FOLDER)):
                continue
            if path in parents and path.is_dir() and not path.is_symlink():
                yield from look(path)
            else:
                yield path

    for path in look(root):
        name = path.relative_to(root).as_posix()
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            continue
        left = ".blinkgl-tmp-" in path.name
        problems.append(f"{name}: {'left by a run that was cut off' if left else 'belongs to no sequence'}")
    return problems


def _against_run(root: Path, folders: list[Path], result: Verification) -> None:
    """Sequences that the recipe asks for and are not there; the index."""
    here = {folder.relative_to(root).as_posix() for folder in folders}
    try:
        plan = plan_of(root)
    except BlinkGLError as error:
        result.add(".", [str(error)])
        plan = None
    if plan is not None:
        failed = {}
        with suppress(BlinkGLError):
            failed = RunFolder(root).read("failed.json") or {}
        for task in plan.tasks:
            if task.name not in here:
                result.add(task.name, [f"set aside: {failed[task.name]}" if task.name in failed else "missing: the recipe asks for it"])
    if (root / INDEX).is_file():
        try:
            listed = {line["path"]: line for line in read_index(root)}
            actual = {}
            for folder in folders:
                with suppress(BlinkGLError):
                    line = entry(root, folder)
                    actual[line["path"]] = line
            wrong = sorted(p for p in listed.keys() | actual.keys() if listed.get(p) != actual.get(p))
            result.add(".", [f"{INDEX}: out of date for {p}" for p in wrong[:5]])
        except BlinkGLError as error:
            result.add(".", [str(error)])


def plan_of(root: Path) -> Plan | None:
    """The plan of the run that made ``root``; None without a record of one."""
    known = RunFolder(root).read("run.json")
    if known is None or not (root / RUN_FOLDER / "recipe.yaml").is_file():
        return None
    template = load_run(root / RUN_FOLDER / "recipe.yaml")
    return Plan.of(RunTemplate(template.tree, Path(known.get("base", "."))), known.get("num"))


def _deep(root: Path, folders: list[Path], result: Verification, base: str | Path | None) -> None:
    if base is None:
        base = (RunFolder(root).read("run.json") or {}).get("base", ".")
    gl: GLContext | None = None
    with tempfile.TemporaryDirectory(prefix="blinkgl-verify-") as scratch:
        try:
            for folder in folders:
                name = folder.relative_to(root).as_posix()
                try:
                    manifest = read_manifest(folder)
                    template = load_run(folder / "config.yaml")
                    config = template.sequence(manifest["sequence"])
                    if config.frames is None and gl is None:
                        gl = create_context(config.gl.backend, config.gl.device)
                    made_with = (manifest.get("opengl") or {}).get("renderer")
                    if gl is not None and made_with not in (None, gl.renderer):
                        result.notes.append(f"{name}: made with {made_with}, this machine has {gl.renderer}; not compared")
                        continue
                    again = generate_sequence(config, manifest["sequence"], scratch, gl, base=Path(base)).path
                except BlinkGLError as error:
                    result.add(name, [f"cannot be made again: {error}"])
                    continue
                result.deep.append(name)
                result.add(name, [f"made again, {line}" for line in differences(folder, again)])
                shutil.rmtree(again)
        finally:
            if gl is not None:
                gl.release()


def differences(a: Path, b: Path) -> list[str]:
    """Files in which two folders differ, one line each."""
    names = [{p.relative_to(f).as_posix() for p in f.rglob("*") if p.is_file()} for f in (a, b)]
    lines = [f"{name}: only in one of them" for name in sorted(names[0] ^ names[1])]
    return lines + [f"{name}: differs" for name in sorted(names[0] & names[1]) if (a / name).read_bytes() != (b / name).read_bytes()]
