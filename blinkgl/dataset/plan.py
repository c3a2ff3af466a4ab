"""The plan of a run: the list of sequences, and the identity of the run, so that it can be continued later."""

from __future__ import annotations

import os
import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import overload

from blinkgl.config.problems import validate
from blinkgl.config.reader import to_yaml
from blinkgl.config.run import Group, RunTemplate
from blinkgl.config.sequence import OutputConfig, SequenceConfig
from blinkgl.errors import ConfigError, OutputError


@dataclass(frozen=True)
class Task:
    """One sequence: ``index`` of ``group``; ``name`` is its folder below the data set, "train/flying_000017"."""

    group: str
    index: int
    name: str


def sequence_name(output: OutputConfig, index: int) -> str:
    """<split>/<name>_<index>"""
    return f"{output.split}/{output.name}_{index:06d}"


SPLITS = ("train", "test")
_NUMBERED = re.compile(r"(.+)_([0-9]{6,})")


class Tasks(Sequence[Task]):
    """The sequences of a run by number, made when requested: a run of millions takes no more memory than one of ten.

    parts : (group, output, first, count) of each group that has sequences, in order.
    """

    def __init__(self, parts: Sequence[tuple[str, OutputConfig, int, int]]):
        self._parts = tuple(parts)
        # _starts[k] is the number of the first task of part k; the last entry is the number of all tasks.
        self._starts = [0]
        for *_, count in self._parts:
            self._starts.append(self._starts[-1] + count)
        self._by_prefix = {f"{output.split}/{output.name}": part for part, (_, output, _, _) in enumerate(self._parts)}

    @property
    def splits(self) -> list[str]:
        """Return the folders below the data set that sequences go to."""
        return sorted({output.split for _, output, _, _ in self._parts})

    def __len__(self) -> int:
        return self._starts[-1]

    @overload
    def __getitem__(self, number: int) -> Task: ...

    @overload
    def __getitem__(self, number: slice) -> tuple[Task, ...]: ...

    def __getitem__(self, number: int | slice) -> Task | tuple[Task, ...]:
        if isinstance(number, slice):
            return tuple(self[n] for n in range(*number.indices(len(self))))
        if not -len(self) <= number < len(self):
            raise IndexError(number)
        number %= len(self)
        part = bisect_right(self._starts, number) - 1
        group, output, first, _ = self._parts[part]
        index = first + number - self._starts[part]
        return Task(group, index, sequence_name(output, index))

    def number(self, name: str) -> int | None:
        """Return the number of the task with this name; None when the run has no such sequence."""
        matched = _NUMBERED.fullmatch(name)
        part = self._by_prefix.get(matched.group(1)) if matched else None
        if matched is None or part is None:
            return None
        _, output, first, count = self._parts[part]
        index = int(matched.group(2))
        inside = first <= index < first + count and name == sequence_name(output, index)
        return self._starts[part] + index - first if inside else None

    def present(self, out: Path) -> Iterator[tuple[int, Task]]:
        """Yield the existing tasks below ``out``, in any order. It lists the folder, not all possible tasks."""
        for split in self.splits:
            try:
                entries = os.scandir(out / split)
            except OSError:
                continue
            with entries:
                for entry in entries:
                    if (number := self.number(f"{split}/{entry.name}")) is not None:
                        yield number, self[number]


@dataclass(frozen=True)
class Plan:
    """The sequences of a run, in order. ``groups`` includes disabled ones: they identify the recipe."""

    template: RunTemplate
    groups: tuple[Group, ...]
    tasks: Tasks
    counts: dict[str, int]
    """Number of sequences of each group that has any."""

    @classmethod
    def of(cls, template: RunTemplate, num: int | None = None, *, of_each: bool = False) -> Plan:
        """Return the plan. ``num``: sequences of the whole run, dealt over the groups by their own numbers, so that a
        larger ``num`` only adds.   of_each : ``num`` is the most of each group, as in records before format_version 3.

        Raises ConfigError: any bad value of the recipe, or all groups disabled."""
        groups = template.groups
        enabled = [group for group in groups if group.enabled]
        if not enabled:
            raise ConfigError("all groups are disabled", where="groups", accepted="enabled: true in at least one")
        counts = [group.count for group in enabled]
        if of_each and num is not None and enabled[0].name:
            counts = [min(num, count) for count in counts]
        elif num is not None:
            counts = _dealt(num, counts)
        parts = [
            (
                group.name,
                validate(OutputConfig, group.template.tree.get("output") or {}, where="output"),
                group.first,
                n,
            )
            for group, n in zip(enabled, counts, strict=True)
            if n
        ]
        return cls(template, groups, Tasks(parts), {name: n for name, _, _, n in parts})

    @cached_property
    def by_name(self) -> dict[str, Group]:
        return {group.name: group for group in self.groups}

    def config(self, task: Task) -> SequenceConfig:
        """Return the sequence's configuration, every value drawn. Raises ConfigError."""
        return self.by_name[task.group].template.sequence(task.index)

    @cached_property
    def used(self) -> tuple[Group, ...]:
        """Return the groups that have tasks."""
        return tuple(group for group in self.groups if group.name in self.counts)

    @property
    def identity(self) -> dict[str, str]:
        """Return group -> hash of its recipe, without the numbers of sequences, so that a run may be extended."""
        return {group.name: group.identity for group in self.groups}

    def recipe_text(self) -> str:
        """Return the recipe with all overrides, as YAML that ``load_run`` reads."""
        return to_yaml(self.template.tree)


def _dealt(num: int, counts: list[int]) -> list[int]:
    """Return ``num`` dealt in proportion to ``counts`` by the method of Sainte-Laguë, in which no share falls when
    ``num`` grows."""
    # No share is further than (n + 1) / 2 from its exact part, of n groups: the dealing may begin n below it, and takes
    # no longer for millions.
    shares = [max(num * count // sum(counts) - len(counts), 0) for count in counts]
    while sum(shares) < num:
        shares[min(range(len(counts)), key=lambda k: (2 * shares[k] + 1) / counts[k])] += 1
    return shares


def check_output(out: str | Path) -> None:
    """Raise OutputError when ``out`` cannot become a folder of sequences.

    ``out`` itself may be a symbolic link; what BlinkGL makes below it may not be one already: sequences would be
    written, and incomplete ones moved, to an unexpected place."""
    out = Path(out)
    if out.exists() and not out.is_dir():
        raise OutputError("is a file", where=str(out), accepted="a folder")
    for name in SPLITS:
        if (out / name).is_symlink():
            raise OutputError(
                "is a symbolic link", where=str(out / name), accepted="a folder (--out itself may be a link)"
            )
