"""Frames converted to a sensor of another size: the largest part of the sensor's shape, scaled."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class Fitting:
    """A conversion of frame sizes. given, wanted : (height, width), px."""

    given: tuple[int, int]
    wanted: tuple[int, int]

    @property
    def part(self) -> tuple[int, int]:
        """Return (height, width) of the part of a frame that is kept: its middle, cut to the wanted shape."""
        (height, width), (wanted_height, wanted_width) = self.given, self.wanted
        scale = min(height / wanted_height, width / wanted_width)
        return max(1, round(wanted_height * scale)), max(1, round(wanted_width * scale))

    def __call__(self, luminance: np.ndarray) -> np.ndarray:
        """Return (H, W) float32 linear light at the wanted size: means over areas where that is smaller."""
        height, width = self.part
        y, x = (self.given[0] - height) // 2, (self.given[1] - width) // 2
        cut = luminance[y : y + height, x : x + width]
        way = cv2.INTER_AREA if self.wanted[0] <= height else cv2.INTER_LINEAR
        return cv2.resize(cut, self.wanted[::-1], interpolation=way)

    @property
    def loses_much(self) -> bool:
        """Return whether less than half of the picture remains, as of a portrait video on a landscape sensor."""
        return self.part[0] * self.part[1] < 0.5 * self.given[0] * self.given[1]

    def __str__(self) -> str:
        named = lambda size: f"{size[1]}x{size[0]}"
        share = 100 * self.part[0] * self.part[1] / (self.given[0] * self.given[1])
        y, x = (self.given[0] - self.part[0]) // 2, (self.given[1] - self.part[1]) // 2
        kept = f"cropped to {named(self.part)}, {share:.0f} % of the picture, from x {x}, y {y} on, and "
        cropped = "" if self.part == self.given else kept
        return f"frames of {named(self.given)} are {cropped}scaled to {named(self.wanted)}"
