"""Curation: sequences are taken out of a data set on purpose, so that run, verify, export and report agree without
them."""

from __future__ import annotations

import operator
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from blinkgl.dataset.cross_checks import plan_of
from blinkgl.dataset.run_folder import RunFolder, whole_set
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.atomic import output_errors, temporary_beside
from blinkgl.sequence_files.index import INDEX, entry, made_folders, read_index, sequence_folders, task_of, write_lines
from blinkgl.sequence_files.sequence_dir import MANIFEST

_TESTS: dict[str, Callable[[Any, Any], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "=": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
# A value begins with neither a quotation mark nor a sign of comparison: "=>" and "<>" are none.
_CONDITION = re.compile(rf"\s*(\w+)\s*({'|'.join(_TESTS)})\s*([^\s<>=!'\"].*?)\s*")


def drop(root: str | Path, names: Sequence[str] = (), where: Sequence[str] = (), *, undo: bool = False) -> list[str]:
    """Remove sequences of the data set ``root`` and record it; return their names.

    names : "train/NAME_000000", or paths of their folders; also of sequences that were set aside.
    where : conditions on the keys of index.jsonl, "events < 1000"; those that meet all of them are removed, too.
    undo : only take ``names`` from the record; ``generate --resume`` makes the sequences again.
    Raises AssetError: no data set, no such sequence; ConfigError: a bad condition; OutputError: in use, not
    writable."""
    root, folder = Path(root), RunFolder(Path(root))
    if not names and not where:
        raise ConfigError("nothing to drop", accepted="names of sequences, or --where 'events < 1000'")
    if not root.is_dir() or (root / MANIFEST).is_file():
        raise AssetError("no data set", where=str(root), accepted="the folder that 'blinkgl generate' wrote")
    if undo and where:
        raise ConfigError("not with --undo: the index has no dropped sequences", where="--where", accepted="names")
    if (whole := whole_set(root)) != root.resolve():
        raise AssetError("a split of a data set, which keeps the record", where=str(root), accepted=str(whole))
    with folder.locked():
        plan, dropped = plan_of(root), folder.dropped
        here = {made.relative_to(root).as_posix(): made for made in made_folders(root)}
        chosen = {}
        for text in names:
            name = text.rstrip("/")
            with suppress(ValueError):
                name = Path(name).resolve().relative_to(root.resolve()).as_posix() if name not in here else name
            planned = plan is not None and plan.tasks.number(name) is not None
            if name not in dropped if undo else not planned and name not in here:
                problem = "was not dropped" if undo else "no such sequence"
                raise AssetError(problem, where=str(root), value=text, accepted="SPLIT/NAME_000000 of this data set")
            chosen[name] = "by name"
        # Of tens of thousands of sequences the index is read in a second, their manifests in minutes.
        lines = read_index(root) if (root / INDEX).is_file() else []
        if not here.keys() <= {task_of(line) for line in lines}:  # of a run that was cut off
            lines = [entry(root, made) for made in sequence_folders(root)]
        for name in _meeting(lines, where) if where else ():
            chosen.setdefault(name, " and ".join(where))
        # The record comes first: cut off here, the same command goes on.
        if undo:
            folder.write_dropped({name: why for name, why in dropped.items() if name not in chosen})
            return sorted(chosen)
        folder.write_dropped(dropped | chosen)
        for name in chosen.keys() & here.keys():
            with output_errors(here[name]):
                here[name].rename(gone := temporary_beside(here[name]))
                shutil.rmtree(gone)
        write_lines(root, [line for line in lines if task_of(line) not in chosen])
    return sorted(chosen)


def _meeting(lines: list[dict[str, object]], where: Sequence[str]) -> Iterator[str]:
    """Yield the names of the sequences that meet all conditions; of a rig one camera has to."""
    conditions = [_CONDITION.fullmatch(text) for text in where]
    if None in conditions:
        text = where[conditions.index(None)]
        raise ConfigError("not a condition", where="--where", value=text, accepted="KEY < VALUE, also <= > >= = !=")
    # Some lines alone have "sensor".
    known = sorted({key for line in lines for key, value in line.items() if not isinstance(value, (dict, list))})
    for condition in conditions if lines else ():
        if condition and condition[1] not in known:
            raise ConfigError("unknown key", where="--where", value=condition[1], accepted=f"one of {', '.join(known)}")
    for line in lines:
        if all(_met(line, *condition.groups()) for condition in conditions if condition):
            yield task_of(line)


def _met(line: Mapping[str, object], key: str, test: str, text: str) -> bool:
    value, compare = line.get(key), _TESTS[test]
    if isinstance(value, str):
        if test not in ("=", "==", "!="):
            raise ConfigError("is a text", where="--where", value=f"{key} {test}", accepted="= or !=")
        return compare(value, text)
    try:
        return isinstance(value, (int, float)) and compare(value, float(text))
    except ValueError:
        raise ConfigError("not a number", where="--where", value=text, accepted=f"such as {value}") from None
