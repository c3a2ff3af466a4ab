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
