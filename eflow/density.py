"""Is flow as long as it should be, where events are few and where they are many?

The density of a sample is events per pixel of its new window over its mean true flow: events that an image point leaves
per px that it moves, whatever the window's length. Recordings of signs on paper have 0.03, textured scenes 0.2 to 1.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

import numpy as np

EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, float("inf"))
"""Of the bins of density, events per px of flow."""
LEAST_PX = 0.5
"""Shorter true flow has no length to speak of: such pixels are left out."""


@dataclass
class LengthByDensity:
    """Collects samples; :meth:`rows` says what came of them."""

    found: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, flow: np.ndarray, truth: np.ndarray, valid: np.ndarray, events: int, hit: np.ndarray) -> None:
        """flow, truth : (H, W, 2) px.   valid : (H, W) bool.   events : of the new window.   hit : (H, W) bool, where
        there are events. A sample is left out where too little moves."""
        size = np.hypot(*np.moveaxis(np.asarray(truth, np.float64), -1, 0))
        moves = valid & (size >= LEAST_PX)
        if moves.sum() < 0.05 * valid.sum() or not moves.any():
            return
        length = np.hypot(*np.moveaxis(np.asarray(flow, np.float64), -1, 0))
        density = events / valid.size / size[valid].mean()
        ratio = lambda mask: length[mask].sum() / size[mask].sum() if mask.any() else float("nan")
        self.found.append((density, ratio(moves), ratio(moves & hit)))

    def rows(self) -> list[dict[str, Any]]:
        """One per bin of :data:`EDGES` that has samples: "from", "to", "samples", medians over them of predicted over
        true length "all" (all valid pixels) and "events" (those with events), and the quartiles of the latter."""
        found, rows = np.array(self.found, np.float64).reshape(-1, 3), []
        for low, high in itertools.pairwise(EDGES):
            inside = found[(found[:, 0] >= low) & (found[:, 0] < high)]
            at = inside[np.isfinite(inside[:, 2]), 2]
            if len(inside):
                quartiles = [float(q) for q in np.percentile(at, (25, 75))] if len(at) else [float("nan")] * 2
                rows.append(
                    {
                        "from": low,
                        "to": high if np.isfinite(high) else None,
                        "samples": len(inside),
                        "all": float(np.median(inside[:, 1])),
                        "events": float(np.median(at)) if len(at) else float("nan"),
                        "quartiles": quartiles,
                    }
                )
        return rows
