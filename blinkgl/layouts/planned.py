"""A sequence that a configuration makes, as far as layouts' checks look at one: nothing is generated."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.verify import files_of_sequence, times_of
from blinkgl.labels import LABELS
from blinkgl.layouts.source import Source


@dataclass(frozen=True)
class Planned(Source):
    """See above.   config : of the camera that an export takes: of a rig its first with events."""

    config: SequenceConfig = field(default_factory=SequenceConfig)

    @classmethod
    def of(cls, config: SequenceConfig, where: Path) -> Planned:
        """Return the plan of a configuration; ``where`` is named in errors. Raises StopIteration: no events."""
        own = next(one.config for one in config.cameras() if one.gives_events)
        manifest = {
            "files": dict.fromkeys(files_of_sequence(own)),
            "height": own.camera.height,
            "width": own.camera.width,
            "split": own.output.split,
            **dict(times_of(own)),
        }
        return cls(where, manifest, own.output.name, config=own)

    @property
    def camera(self) -> CameraModel:
        return self.config.camera.model

    @property
    def track_times(self) -> list[int]:
        tracks, times = self.config.tracks, self._label_us
        if tracks is None or tracks.rate is None:
            return times
        return [round(t) for t in np.arange(times[0], times[-1] + 1, 1e6 / tracks.rate)]

    def interval_ns(self, k: int) -> np.ndarray:
        return np.array(LABELS["flow_intervals"].intervals(self.config.labels), np.int64)

    @property
    def _label_us(self) -> list[int]:
        return [t // 1000 for t in self.config.time.label_times_ns]

    def _times(self, label: str, columns: int = 1) -> list[tuple[int, ...]]:
        if not self.has(LABELS[label].stamps or ""):
            return []
        rows: list[tuple[int, ...]] = list(zip(*(self._label_us[k:] for k in range(columns))))
        return rows[: self.count(label)]

    def _configured(self, section: str, key: str) -> Any:
        return getattr(getattr(self.config, section), key)
