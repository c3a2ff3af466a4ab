"""What is said of an import: refusals, and the rows of its table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field


class Refused(Exception):
    """A line for the user: what is wrong, where (None: the file), what would be accepted."""

    def __init__(self, problem: str, *, where: str | None = None, accepted: str | None = None):
        super().__init__(problem)
        self.problem, self.where, self.accepted = problem, where, accepted


@dataclass
class Row:
    """kind : of things in the file.   found : how many there are.   came : how many are in the GLB, in whatever form.
    notes : how they came, and which did not and why."""

    kind: str
    found: int = 0
    came: int = 0
    notes: list[str] = field(default_factory=list)


class Table:
    """Rows by kind, in the order in which they were first asked for."""

    def __init__(self) -> None:
        self.rows: dict[str, Row] = {}

    def __getitem__(self, kind: str) -> Row:
        return self.rows.setdefault(kind, Row(kind))

    def listed(self) -> list[dict]:
        """As plain data, what is not in the file left out."""
        return [asdict(row) for row in self.rows.values() if row.found or row.notes]


def names(things: Iterable[object], limit: int = 3) -> str:
    """'a', 'b', 'c' and 4 more."""
    listed = [f"'{getattr(thing, 'name', thing)}'" for thing in things]
    more = len(listed) - limit
    return ", ".join(listed[:limit]) + (f" and {more} more" if more > 0 else "")
