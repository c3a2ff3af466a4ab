"""Checks across sequences: foreign entries, the index, duplicates, and the recipe."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Set
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from blinkgl.config.run import RunTemplate, load_run, without_places
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.messages import RUN_FOLDER
from blinkgl.dataset.plan import Plan, Task
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.errors import BlinkGLError
from blinkgl.io.records import inside, open_regular, shown
from blinkgl.sequence_files.index import INDEX, entry, read_index, task_of
from blinkgl.sequence_files.sequence_dir import MANIFEST, read_manifest
from blinkgl.types.trees import Tree

# ---------------------------------------------------------------------------------------------------------------------
# Results of a verification.


@dataclass
class Verification:
    """Results. ``problems``: sequence (or "." for the data set) -> lines. ``notes``: what was not checked, and why.

    ``deep``: sequences that were generated again, equal or not. ``in_part``: those of them that differ from this
    machine's result and were made on another; for these only machine-independent parts were compared."""

    sequences: int = 0
    problems: dict[str, list[str]] = field(default_factory=dict)
    deep: list[str] = field(default_factory=list)
    in_part: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    dropped: int = 0
    """Number of sequences that were taken out on purpose."""

    @property
    def clean(self) -> bool:
        return not self.problems

    def add(self, name: str, problems: list[str]) -> None:
        if problems:
            self.problems.setdefault(name, []).extend(problems)


@dataclass(frozen=True)
class Known:
    """A sequence without problems of its own."""

    folder: Path
    manifest: Tree
    config: SequenceConfig


def guarded(check: Callable[[], list[str]]) -> list[str]:
    """Return ``check()``, or its exception as the only line: libraries raise exceptions of every kind for damaged
    files."""
    try:
        return check()
    except BlinkGLError as error:
        return [str(error)]
    except Exception as error:  # noqa: BLE001
        return [f"cannot be checked: {type(error).__name__}: {shown(' '.join(str(error).split()))}"]


_AT_TOP = {INDEX, "report.html"}


_MOST_MISSING = 1000
"""Number of missing sequences with a line each; the others are counted."""
_SHOWN = 5


def strangers(root: Path, folders: list[Path]) -> list[str]:
    """Return entries of the data set that belong to no sequence."""
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
        why = "left by a run that was cut off" if ".blinkgl-tmp-" in path.name else "belongs to no sequence"
        problems.append(f"{shown(name)}: {'a symbolic link, which is not followed' if path.is_symlink() else why}")
    return problems


def index(root: Path, folders: list[Path]) -> list[str]:
    """Return where the index differs from the manifests."""
    try:
        (root / INDEX).lstat()
    except FileNotFoundError:
        return []
    listed = {line["path"]: line for line in read_index(root)}
    actual = {}
    for folder in folders:
        with suppress(BlinkGLError):
            line = entry(root, folder)
            actual[line["path"]] = line
    wrong = sorted(p for p in listed.keys() | actual.keys() if listed.get(p) != actual.get(p))
    return [f"{INDEX}: out of date for {shown(p)}" for p in wrong[:5]]


def twins(known: dict[str, Known], result: Verification) -> dict[str, list[str]]:
    """Return sequences of random worlds with the events or the poses of another draw. Duplicates of an explicit scene
    or of recorded frames may be intended: they give a note."""
    seen: dict[tuple[str, str], str] = {}
    problems: dict[str, list[str]] = {}
    for name, one in known.items():
        (files, events), config = _of_first(one), one.config
        random_scene = config.frames is None and config.scene.kind == "random"
        looked = [f for f, tells in (("events.h5", events > 0), ("poses.npz", random_scene)) if tells and f in files]
        for file in looked:
            other = seen.setdefault((file, files[file]["sha256"]), name)
            if other == name:
                continue
            # Of one seed and one number the draws are the same, and so may be the bytes.
            numbers = [(known[n].config.seed, known[n].manifest["sequence"]) for n in (name, other)]
            if numbers[0] != numbers[1] and random_scene:
                problems.setdefault(name, []).append(
                    f"{file}: the same as in {shown(other)}, a sequence of another draw"
                )
            elif file == "events.h5":
                result.notes.append(
                    f"{shown(name)}: the same events as {shown(other)}, as their configurations have it"
                )
    return problems


def _of_first(one: Known) -> tuple[Tree, int]:
    """Return files of a sequence and the number of its events, for a rig of its first camera only."""
    files = one.manifest["files"]
    if not one.manifest.get("cameras"):
        return files, one.manifest["events"]
    first = one.manifest["cameras"][0]
    own = {name.removeprefix(f"{first}/"): file for name, file in files.items() if name.startswith(f"{first}/")}
    return own, read_manifest(inside(one.folder, first))["events"]


def against_run(root: Path, folders: list[Path], known: dict[str, Known], result: Verification) -> list[str]:
    """Return sequences of the recipe that are missing, extra ones, and differences from the run's OpenGL."""
    plan, record = plan_of(root), RunFolder(root).read("run.json") or {}
    if plan is None:
        result.notes.append("no record of the run here: sequences were not compared with a recipe")
        return []
    # Every record may be damaged: a reader's error becomes a line, and the other checks go on.
    failed: dict[str, str] = {}
    problems = guarded(lambda: failed.update(RunFolder(root).read("failed.json") or {}) or [])
    here = {folder.relative_to(root).as_posix() for folder in folders}
    dropped = RunFolder(root).dropped
    for name in here & dropped.keys():
        result.add(name, ["was dropped, and is here: run 'blinkgl drop' with it again, or with --undo"])
    result.dropped = len(dropped)
    # Sequences that the recipe asks for and that are neither here nor dropped on purpose.
    missing, more = _missing(plan, here | dropped.keys(), _MOST_MISSING)
    for task in missing:
        why = f"set aside: {shown(failed[task.name])}" if task.name in failed else "missing: the recipe asks for it"
        result.add(task.name, [why])
    if more:
        problems.append(f"and {more} more sequences that the recipe asks for are missing")
    if record.get("mixed"):
        result.notes.append("the run went on with --mixed: configurations and OpenGL were not compared with its record")
        return problems
    groups = {
        f"{g.template.tree.get('output', {}).get('split', 'train')}/{_called(g.template)}": g for g in plan.groups
    }
    environment = record.get("environment", {})
    for name, one in known.items():
        # SPLIT/NAME_000000 without the number is the group's folder.
        group = groups.get(re.sub(r"_\d{6,}$", "", name))
        if group is None:
            result.add(name, ["no group of the recipe makes it"])
            continue
        # The draws are repeated from the seed and compared with what the sequence says of itself.
        drawn = group.template.sequence(one.manifest["sequence"])
        if where := first_difference(comparable(one.config), comparable(drawn)):
            result.add(name, [f"config.yaml: the recipe draws another value for {where}"])
        result.add(
            name,
            [
                f"{MANIFEST}: made with {key} {shown(value)}, the run's record says {shown(environment[key])}"
                for key, value in made_with(one.manifest).items()
                if environment.get(key, value) != value
            ],
        )
    return problems


def _missing(plan: Plan, here: Set[str], most: int) -> tuple[list[Task], int]:
    """Return up to ``most`` tasks that are not among the names ``here``, and the number of further ones."""
    # A record may ask for millions: the work grows with what is here.
    count = len(plan.tasks) - sum(plan.tasks.number(name) is not None for name in here)
    missing = list(islice((task for task in plan.tasks if task.name not in here), min(count, most)))
    return missing, count - len(missing)


def lost(root: Path, folders: list[Path]) -> list[str]:
    """Return a line for sequences that the recipe, or without one the index, names and that are neither here nor
    dropped: for programs that read a set without verifying it."""
    here = {folder.relative_to(root).as_posix() for folder in folders}
    if (plan := plan_of(root)) is not None:
        tasks, more = _missing(plan, here | RunFolder(root).dropped.keys(), _SHOWN)
        names = [task.name for task in tasks]
    elif (root / INDEX).is_file():
        names = sorted({task_of(line) for line in read_index(root)} - here - {"."})
        names, more = names[:_SHOWN], max(len(names) - _SHOWN, 0)
    else:
        return []
    lines = [f"{shown(name)}: missing, and was not dropped ('blinkgl drop' does that)" for name in names]
    return lines + ([f"and {more} more are missing"] if more else [])


def made_with(manifest: Tree) -> dict[str, str]:
    """Return versions and OpenGL, under the names of the run's record."""
    gl = manifest.get("opengl") or {}
    return {
        **(manifest.get("versions") or {}),
        **({"opengl": f"{gl.get('renderer')}, {gl.get('version')}"} if gl else {}),
    }


def _called(template: RunTemplate) -> str:
    return template.check().output.name


def comparable(config: SequenceConfig) -> Tree:
    """Return plain data without what a sequence's own configuration changes: its number, and which of the folders."""
    tree = without_places(json.loads(config.model_dump_json()))
    for key in ("sequences", "first_index"):
        tree["output"].pop(key)
    if tree["frames"] is not None:
        tree["frames"].pop("folders")
    return tree


def first_difference(a: object, b: object, path: str = "") -> str:
    """Return the dotted path of the first difference, "" when they are equal. Numbers that a text form rounds are
    equal."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in sorted(a.keys() | b.keys()):
            if where := first_difference(a.get(key), b.get(key), f"{path}.{key}" if path else key):
                return where
        return ""
    return "" if a == b else path


def plan_of(root: Path) -> Plan | None:
    """Return the plan of the run that made ``root``; None without a record of one. Raises BlinkGLError: a damaged
    record."""
    known = RunFolder(root).read("run.json")
    if known is None:
        return None
    recipe = RunFolder(root).record("recipe.yaml")
    with suppress(FileNotFoundError):
        open(open_regular(recipe), "rb").close()
        template = load_run(recipe)
        template = RunTemplate(template.tree, Path(known.get("base", ".")))
        return Plan.of(template, known.get("num"), of_each=known["format_version"] < 3)
    return None
