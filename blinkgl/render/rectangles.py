"""Rectangles of pixels."""

from __future__ import annotations

from typing import NamedTuple


class Rectangle(NamedTuple):
    """Pixels x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int

    def meets(self, other: Rectangle) -> bool:
        return self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1

    def union(self, other: Rectangle) -> Rectangle:
        return Rectangle(min(self.x0, other.x0), min(self.y0, other.y0), max(self.x1, other.x1), max(self.y1, other.y1))

    def grown(self, margin: int, width: int, height: int) -> Rectangle:
        """With ``margin`` px more on every side, as far as a picture of this size reaches."""
        return Rectangle(
            max(0, self.x0 - margin),
            max(0, self.y0 - margin),
            min(width, self.x1 + margin),
            min(height, self.y1 + margin),
        )

    def scaled(self, factor: int) -> Rectangle:
        return Rectangle(self.x0 * factor, self.y0 * factor, self.x1 * factor, self.y1 * factor)


def merged(rectangles: list[Rectangle]) -> list[Rectangle]:
    """Rectangles that do not meet and cover the given ones, in a fixed order."""
    result: list[Rectangle] = []
    for rectangle in rectangles:
        while (other := next((r for r in result if r.meets(rectangle)), None)) is not None:
            result.remove(other)
            rectangle = rectangle.union(other)
        result.append(rectangle)
    return sorted(result, key=lambda r: (r.y0, r.x0))
