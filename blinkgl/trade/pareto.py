"""Which settings are worth having: those that no other one beats in cost and error at once."""

from __future__ import annotations

import math
from collections.abc import Sequence


def pareto_front(rows: Sequence[dict], cost: str, error: str) -> list[dict]:
    """The non-dominated rows, cheapest first. A row is dominated when another is no worse in both and better in one; of
    rows that are equal in both the first stays. Rows whose error is not a number are left out."""
    result: list[dict] = []
    for row in sorted((r for r in rows if math.isfinite(r[error])), key=lambda r: (r[cost], r[error])):
        if not result or row[error] < result[-1][error]:
            result.append(row)
    return result


def excess(row: dict, rows: Sequence[dict], cost: str, error: str) -> float:
    """By how much the best of ``rows`` beats ``row`` in cost and in error, whichever it beats less in: 0.1 where one is
    a tenth better in both. At most 0: nothing beats it."""
    ratio = lambda mine, other: mine / other if other else (1.0 if not mine else math.inf)
    others = [r for r in rows if r is not row and math.isfinite(r[error])]
    return max((min(ratio(row[cost], r[cost]), ratio(row[error], r[error])) for r in others), default=1.0) - 1
