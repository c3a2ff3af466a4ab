"""The hidden folder ``.run`` of a data set: which recipe it is made of, what was logged, what it cost.

    .run/run.json       groups' hashes, versions, OpenGL, where the recipe's relative paths start
    .run/recipe.yaml    the recipe with all overrides      .run/assets.json   content hashes of the pools' files
    .run/costs.jsonl    one line per sequence made: wall seconds by stage, CPU seconds, bytes, memory, attempts
    .run/failed.json    sequences that were set aside, and why
    .run/dropped.json   sequences that were taken out on purpose (blinkgl drop), and why
    .run/checksums.json SHA-256 of the files above, as the run left them
    .run/logs/          one log per sequence, one per worker
    .run/damaged/       what was found under a sequence's name and was not whole

Times and paths of machines live here and nowhere else in a data set.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from blinkgl.dataset.messages import RUN_FOLDER, Message, SequenceLog
from blinkgl.dataset.plan import Plan, Task
from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import (
    fsync,
    is_still,
    locked_folder,
    make_folders,
    output_errors,
    remove_stale,
    write_whole,
)
from blinkgl.io.records import entries_below, inside, parse, read_text, shown
from blinkgl.machine.posix import fcntl
from blinkgl.sequence_files.index import INDEX
from blinkgl.sequence_files.sequence_dir import MANIFEST, digest_of, verify_sequence
from blinkgl.types.trees import Tree

FORMAT = "blinkgl-run"
CHECKSUMS = "checksums.json"
_BEGUN = ("run.json", "recipe.yaml", "assets.json")
_ENDED = ("costs.jsonl", "failed.json", "dropped.json")
"""Records that are complete when a run begins, and when it ends."""


class _Run(BaseModel):
    """``run.json``."""

    model_config = ConfigDict(strict=True, extra="allow")
    format: Literal["blinkgl-run"]
    format_version: Literal[1, 2, 3]
    """1: without checksums.json; below 3 num is the most sequences of each group, since then of the run"""
    groups: dict[str, str]
    environment: dict[str, str]
    mixed: list[dict[str, dict[str, str]]] = []
    base: str = Field(max_length=4096, pattern=r"^[^\x00]*$")
    num: int | None = Field(None, ge=1, le=10_000_000)


_Amount = Annotated[float, Field(ge=0, le=1e18, allow_inf_nan=False)]


class _Cost(BaseModel):
    """A line of ``costs.jsonl``."""

    model_config = ConfigDict(extra="allow")
    name: str
    seconds: dict[str, _Amount]
    total_s: _Amount
    simulated_s: _Amount
    frames: _Amount
    bytes: _Amount
    cpu_s: _Amount
    peak_rss_kib: _Amount
    attempts: _Amount


_TABLE = TypeAdapter(dict[str, str])
_RECORDS = {"run.json": TypeAdapter(_Run), "assets.json": _TABLE, "failed.json": _TABLE, "dropped.json": _TABLE}
_RECORDS[CHECKSUMS] = _TABLE
_COST = TypeAdapter(_Cost)


def whole_set(folder: Path) -> Path:
    """Return the data set of which ``folder`` is a split or a sequence, by its record or its index; the folder itself
    where there is none. The path is absolute."""
    here = folder.resolve()
    # A sequence lies in a split, and a camera of a rig in a sequence.
    above = here.parents[: 3 if (here / MANIFEST).is_file() else 1]
    for record in (f"{RUN_FOLDER}/run.json", INDEX):
        for place in (here, *above):
            if (place / record).is_file():
                return place
    return here


class RunFolder:
    """The folder ``.run`` below ``out``. Reading needs no lock; writing needs :meth:`locked`, then :meth:`begin`."""

    def __init__(self, out: Path):
        self.out, self.path = out, out / RUN_FOLDER
        self.begun = False
        self.environment: dict[str, str] = {}

    # ---- may this run go on here? ---------------------------------------------------------------------------------

    def check(self, plan: Plan, assets: dict[str, str], mixed: bool) -> None:
        """Raise OutputError when the folder contains a run of another recipe or of other assets, unless ``mixed``."""
        known = self.read("run.json")
        if known is None or mixed:
            return
        if known.get("groups") != plan.identity:
            ours, theirs = plan.identity, known.get("groups") or {}
            names = sorted(
                n or "the configuration" for n in ours.keys() | theirs.keys() if ours.get(n) != theirs.get(n)
            )
            raise OutputError(
                f"contains a run of another recipe (different: {', '.join(names)})",
                where=str(self.out),
                accepted="another --out, or --mixed to add to it anyway",
            )
        before = self.read("assets.json")
        if before is not None and before != assets:
            changed = sorted(n for n in before.keys() | assets.keys() if before.get(n) != assets.get(n))
            how = ["changed" if n in before and n in assets else "gone" if n in before else "new" for n in changed]
            words = ", ".join(f"{n} ({h})" for n, h in list(zip(changed, how))[:3]) + (" …" if len(changed) > 3 else "")
            raise OutputError(
                f"the pools have changed since the run began: {words}",
                where=str(self.out),
                accepted="the same files, or --mixed to continue with these",
            )

    def check_environment(self, environment: dict[str, str], mixed: bool) -> None:
        """Raise OutputError when the run began with other versions or another OpenGL, unless ``mixed``."""
        known = (self.read("run.json") or {}).get("environment") or {}
        if not mixed and (
            different := [f"{k} {known[k]}, now {v}" for k, v in environment.items() if k in known and known[k] != v]
        ):
            raise OutputError(
                "the run began with another installation: " + "; ".join(different),
                where=str(self.out),
                accepted="the same, or --mixed to continue with this one (bytes may differ)",
            )

    @contextlib.contextmanager
    def locked(self, splits: Sequence[str] = ()) -> Iterator[None]:
        """Lock the folder for one run; the lock ends with the process. The folder is made, and removed if it is empty
        in the end: a refused run leaves nothing.   splits : the folders that it writes. Raises OutputError: in use, not
        writable, or a symbolic link where the run writes."""
        with output_errors(self.out):
            made = make_folders(self.out)
        try:
            # Before the lock, which is a file below .run.
            self._refuse_links(splits)
            self._fresh = not self.path.exists()
            with self._handle(), locked_folder(self.out):
                self._went_on = (self.path / "run.json").exists()
                self._logs = set(self._worker_logs())
                yield
        finally:
            with contextlib.suppress(OSError):  # non-empty folders stay
                for folder in made:
                    folder.rmdir()

    def _refuse_links(self, splits: Sequence[str]) -> None:
        """Raise OutputError for a symbolic link where this run writes, which could lead out of ``out``."""
        links = [path for path in (self.path, *(self.out / split for split in splits)) if path.is_symlink()]
        for name, kind, _ in entries_below(self.path) if self.path.is_dir() and not links else ():
            # What was found in a sequence's place is moved there as it is.
            if kind == "symbolic link" and not re.match("damaged/[^/]+/", name):
                links.append(self.path / name)
        if links:
            raise OutputError(
                "is a symbolic link", where=str(links[0]), accepted="a folder (--out itself may be a link)"
            )

    def record(self, name: str) -> Path:
        """Return the path of a record. Raises AssetError for a symbolic link."""
        return inside(self.out, f"{RUN_FOLDER}/{name}")

    @contextlib.contextmanager
    def _handle(self) -> Iterator[None]:
        """Keep the folder open, by which it is known again."""
        self._opened = None if fcntl is None else os.open(self.out, os.O_RDONLY | os.O_DIRECTORY)
        try:
            yield
        finally:
            if self._opened is not None:
                os.close(self._opened)

    def check_in_place(self) -> None:
        """Raise OutputError when the locked folder is no longer the one at ``out``: deleted, moved or replaced during
        the run."""
        if not self.in_place:
            raise OutputError(
                "was deleted, moved or replaced during the run",
                where=str(self.out),
                accepted="a folder that is not moved",
            )

    @property
    def in_place(self) -> bool:
        return self.out.is_dir() if self._opened is None else is_still(self.out.resolve(), self._opened)

    def _worker_logs(self) -> Iterator[Path]:
        return (self.path / "logs").glob("worker-*.log")

    def take_back_logs(self) -> None:
        """Remove what starting workers left of a run that did not begin."""
        if self._fresh:
            shutil.rmtree(self.path, ignore_errors=True)
            return
        for path in set(self._worker_logs()) - self._logs:
            path.unlink(missing_ok=True)

    # ---- sequences ------------------------------------------------------------------------------------------------

    def state(self, name: str) -> str | None:
        """Return None: not there; "": complete, as far as file sizes tell; else the problem."""
        path = self.out / name
        if not path.exists() and not path.is_symlink():
            return None
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            return None
        if path.is_symlink() or not path.is_dir():
            return "not a folder"
        return "; ".join(verify_sequence(path, checksums=False)[:1])

    def put_away(self, name: str) -> None:
        """Move an incomplete entry at a sequence's name to ``damaged/``; it is not deleted."""
        target = self.path / "damaged" / name
        with output_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            number = 0
            while (final := target.with_name(f"{target.name}-{number}")).exists() or final.is_symlink():
                number += 1
            os.rename(self.out / name, final)

    def occupied(self, name: str) -> bool:
        """Return whether something other than an empty folder is at a sequence's name."""
        try:
            with os.scandir(self.out / name) as entries:
                return any(True for _ in entries)
        except FileNotFoundError:
            return False
        except OSError:
            return True

    def sweep(self, plan: Plan) -> None:
        """Remove leftovers of dead writers of this machine. Those of another machine, or of before this one's restart,
        cannot be tested: they stay, and `verify` names them."""
        for folder in [*(self.out / split for split in plan.tasks.splits), self.out, self.path]:
            with contextlib.suppress(OSError):
                remove_stale(folder)

    # ---- records --------------------------------------------------------------------------------------------------

    def begin(self, plan: Plan, assets: dict[str, str], environment: dict[str, str], num: int | None) -> None:
        """Write what identifies the run. Its first record is kept: ``mixed`` does not hide what a data set was begun
        with."""
        self.environment = environment
        known = self.read("run.json") or {"environment": environment, "groups": plan.identity}
        later = known.get("mixed", [])
        if (known["environment"], known["groups"]) != (environment, plan.identity):
            later = [*later, {"environment": environment, "groups": plan.identity}]
        self._write(
            "run.json",
            {
                "format": FORMAT,
                "format_version": 3,
                "groups": known["groups"],
                "environment": known["environment"],
                "mixed": later,
                "base": str(plan.template.base.resolve()),
                "num": num,
            },
        )
        self._write("assets.json", assets)
        write_whole(self.path / "recipe.yaml", plan.recipe_text())
        # Costs and failures are written during the run: they have no checksum until it ends.
        self.seal(_BEGUN)
        self.begun = True

    def seal(self, names: Sequence[str]) -> None:
        """Write the checksums of the existing records. Raises OutputError."""
        with output_errors(self.path):
            there = [name for name in names if (self.path / name).is_file()]
            for name in there:  # costs.jsonl grows by appending
                fsync(self.path / name)
            self._write(CHECKSUMS, {name: digest_of(self.path / name)["sha256"] for name in there})

    def altered(self) -> list[str]:
        """Return records that differ from what the run wrote, one line each. Runs of format_version 1 need no
        checksums, but existing ones count."""
        try:
            text = read_text(self.record(CHECKSUMS))
        except FileNotFoundError:
            record = self.read("run.json")
            old = record is None or record["format_version"] == 1
            return [] if old else [f"{RUN_FOLDER}/{CHECKSUMS}: missing"]
        known = self.read(CHECKSUMS) or {}
        if text != _text(known):
            return [f"{RUN_FOLDER}/{CHECKSUMS}: not as it was written"]
        lines = [f"{name}: has no checksum" for name in _BEGUN if name not in known and (self.path / name).exists()]
        for name, digest in known.items():
            if name not in (*_BEGUN, *_ENDED):
                lines.append(f"{CHECKSUMS}: names {shown(name)}, which is no record")
            elif not self.record(name).is_file():
                lines.append(f"{name}: missing")
            elif digest_of(self.record(name))["sha256"] != digest:
                lines.append(f"{name}: checksum differs")
        return [f"{RUN_FOLDER}/{line}" for line in lines]

    def forget(self, plan: Plan, keep_logs: bool) -> None:
        """Undo :meth:`begin` for a run without results, unless it went on with an earlier one. Entries moved to
        ``damaged/`` stay there."""
        if self._went_on:
            return
        for name in (*_BEGUN, *_ENDED, CHECKSUMS):
            (self.path / name).unlink(missing_ok=True)
        (self.out / INDEX).unlink(missing_ok=True)
        if not keep_logs:
            shutil.rmtree(self.path / "logs", ignore_errors=True)
        for folder in (self.path, *(self.out / split for split in plan.tasks.splits)):
            with contextlib.suppress(OSError):  # non-empty folders stay
                folder.rmdir()

    def add_cost(self, task: Task, message: Message, attempt: int) -> None:
        line = {
            "name": task.name,
            "group": task.group,
            **{k: v for k, v in message["report"].items() if k not in ("path", "index")},
            "bytes": message["bytes"],
            "cpu_s": message["cpu_s"],
            "peak_rss_kib": message["peak_rss_kib"],
            "attempts": attempt,
            "when": time.time(),
        }
        with contextlib.suppress(OSError), open(self.path / "costs.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def log(self, name: str, text: str) -> None:
        SequenceLog(self.out, name).write(text)

    def write_failures(self, set_aside: dict[str, str]) -> None:
        """Write the failures of this run, and of earlier runs whose sequences are still incomplete."""
        before = self.read("failed.json") or {}
        still = {name: reason for name, reason in {**before, **set_aside}.items() if self.state(name) != ""}
        with contextlib.suppress(OutputError):
            if still or before:
                self._write("failed.json", still)
            self.seal((*_BEGUN, *_ENDED))

    @property
    def dropped(self) -> dict[str, str]:
        """Return the sequences that were taken out on purpose, and why."""
        return self.read("dropped.json") or {}

    def write_dropped(self, dropped: dict[str, str]) -> None:
        """Write them, where a run is recorded; they are no failures any more. Raises OutputError."""
        if self.read("run.json") is not None:
            failed = self.read("failed.json") or {}
            self._write("failed.json", {name: why for name, why in failed.items() if name not in dropped})
            self._write("dropped.json", dropped)
            self.seal((*_BEGUN, *_ENDED))

    def costs(self) -> list[Tree]:
        """Return the last line of each sequence; a line cut by a crash is left out."""
        costs: dict[str, dict[str, object]] = {}
        with contextlib.suppress(FileNotFoundError, AssetError):
            for line in read_text(self.record("costs.jsonl")).splitlines():
                with contextlib.suppress(ValueError):
                    entry = parse(line, _COST)
                    costs[entry["name"]] = entry
        return list(costs.values())

    def read(self, name: str) -> Tree | None:
        """Return a JSON file of the folder, checked; None when there is none. Raises OutputError when it is damaged."""
        path = self.path / name
        try:
            return parse(read_text(self.record(name)), _RECORDS[name])
        except FileNotFoundError:
            return None
        except (AssetError, ValueError) as error:
            problem = error.problem if isinstance(error, AssetError) else error
            raise OutputError(
                f"the run's record is damaged: {problem}",
                where=str(path),
                accepted="a readable file; without it the run's recipe is unknown",
            ) from error

    def _write(self, name: str, data: Tree) -> None:
        write_whole(self.path / name, _text(data))


def _text(data: Mapping[str, object]) -> str:
    return json.dumps(data, indent=1, sort_keys=True) + "\n"
