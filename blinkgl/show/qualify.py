"""``blinkgl qualify``: folders of frames, what was measured of their pairs, and why some cannot be interpolated."""

from __future__ import annotations

import glob
import json
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from blinkgl.config.frames import FramesConfig
from blinkgl.config.recipe import all_groups
from blinkgl.config.run import RunTemplate, apply_overrides, load_run
from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.machine.terminal import plain_console, say
from blinkgl.sequence.folders import folder_of
from blinkgl.sequence.qualify import Verdict, shown, verdict

UNFIT = 1
"""Exit status when a folder does not qualify."""


@dataclass(frozen=True)
class _Row:
    """name : of the sequence, or the folder.   verdict : None where it cannot be used, which ``reason`` says."""

    name: str
    verdict: Verdict | None
    reason: str | None

    def to_dict(self) -> dict[str, Any]:
        if self.verdict is None:
            return {"name": self.name, "qualifies": False, "reason": self.reason}
        pairs = [{"first": p.first, "second": p.second, **p.values} for p in self.verdict.pairs]
        return {
            "name": self.name,
            "folder": str(self.verdict.folder),
            "qualifies": self.reason is None,
            "reason": self.reason,
            **self.verdict.facts(),
            "absent": self.verdict.absent,
            "each": pairs,
        }


def run(sources: Sequence[str], *, overrides: Sequence[str] = (), pairs: bool = False, as_json: bool = False) -> int:
    """:func:`~blinkgl.sequence.qualify.verdict` of every folder; status :data:`UNFIT` when one does not qualify.

    sources : folders, or one YAML file. Raises ConfigError: a file without frames, no such folder, bad values."""
    console, rows = plain_console(), []
    with plain_console(stderr=True).status("looking") as status:
        for name, frames, folder in _folders(sources, overrides):
            told = lambda done, of, name=name: status.update(f"{name}: {done} of {of} pairs")
            try:
                found = verdict(frames, folder, progress=told)
                refused = found.refusal()
                rows.append(_Row(name, found, None if refused is None else str(refused)))
            except (AssetError, EventDataError) as error:
                rows.append(_Row(name, None, str(error)))
    if as_json:
        say(console, json.dumps([row.to_dict() for row in rows], indent=1))
    else:
        show(rows, console, pairs)
    return UNFIT if any(row.reason for row in rows) else 0


def _folders(sources: Sequence[str], overrides: Sequence[str]) -> Iterator[tuple[str, FramesConfig, Path]]:
    """(name, configuration, folder) of all that is asked for."""
    files = [source for source in sources if not Path(source).is_dir()]
    if files and len(sources) > 1:
        raise ConfigError("no such folder", where=files[0], accepted="folders of frames, or one YAML file alone")
    if files:
        yield from _of_run(load_run(files[0], overrides), files[0])
        return
    for source in sources:
        tree = apply_overrides({"frames": {"folders": [glob.escape(source)]}}, overrides)
        template = RunTemplate(tree, Path("."))
        frames = template.check().frames
        assert frames is not None, "they are what the tree holds"
        yield source, frames, folder_of(frames, 0, template.base)


def _of_run(template: RunTemplate, path: str) -> Iterator[tuple[str, FramesConfig, Path]]:
    some = False
    for group in all_groups(template):
        for index in range(group.first, group.first + group.count):
            config = group.template.sequence(index)
            if config.frames is None or not (group.enabled or config.frames.folders):
                break
            some = True
            yield f"{config.output.name}_{index:06d}", config.frames, folder_of(config.frames, index, template.base)
    if not some:
        raise ConfigError("no folders of frames in it", where=path, accepted="frames: {folders: [...]}")


def show(rows: Sequence[_Row], console: Console, pairs: bool) -> None:
    """One folder: a row per measure. Several: a row per folder. Then a line per folder that does not qualify, and what
    could not be measured."""
    if pairs:
        for row in rows:
            _show_pairs(row, console)
    if len(rows) == 1 and rows[0].verdict is not None:
        console.print(_measures(rows[0].verdict))
    else:
        console.print(_folders_in_rows(rows))
    for row in rows:
        if row.reason is not None:
            say(console, row.reason if row.name in row.reason else f"{row.name}: {row.reason}")
        elif len(rows) == 1:
            say(console, f"{row.name}: qualifies")
    measured = [row.verdict for row in rows if row.verdict is not None]
    for name, why in dict.fromkeys((name, why) for found in measured for name, why in found.absent.items()):
        say(console, f"not measured: {name} ({why})")


def _measures(found: Verdict) -> Table:
    table = Table(title=f"{found.folder}: {len(found.pairs)} pairs of frames", title_justify="left")
    table.add_column("")
    for heading in ("median", "largest", "limit", "beyond"):
        table.add_column(heading, justify="right")
    for name, largest in found.worst.items():
        values, limit = [pair.values[name] for pair in found.pairs if name in pair.values], getattr(found.limits, name)
        table.add_row(
            name,
            shown(name, statistics.median(values)),
            shown(name, largest),
            "–" if limit is None else shown(name, limit),
            "–" if limit is None else str(sum(value > limit for value in values)),
        )
    return table


def _folders_in_rows(rows: Sequence[_Row]) -> Table:
    table = Table(title="farthest beyond, or nearest to, its limit of all pairs and measures", title_justify="left")
    for heading in ("frames", "pairs", "beyond", "measure", "largest", "limit", "qualifies"):
        table.add_column(heading, overflow="fold")
    for row in rows:
        found, answer = row.verdict, "yes" if row.reason is None else "no"
        cells = ("–",) * 3
        if found is not None and found.nearest is not None:
            cells = (found.nearest, *_value_and_limit(found, found.nearest))
        counts = ("–", "–") if found is None else (str(len(found.pairs)), str(found.refused))
        table.add_row(row.name, *counts, *cells, answer)
    return table


def _value_and_limit(found: Verdict, name: str) -> tuple[str, str]:
    return shown(name, found.worst[name]), shown(name, getattr(found.limits, name))


def _show_pairs(row: _Row, console: Console) -> None:
    found = row.verdict
    if found is None:
        return
    for pair in found.pairs:
        limits = {name: getattr(found.limits, name) for name in pair.values}
        said = [
            f"{name} {shown(name, value)}" + (" (!)" if limits[name] is not None and value > limits[name] else "")
            for name, value in pair.values.items()
        ]
        say(console, f"{pair.first} to {pair.second}: {', '.join(said)}")
