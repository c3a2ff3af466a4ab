"""Continuous flow of BlinkGL's data sets: from each label's time to several others (``labels.flow`` with intervals,
docs/over_time.md), beside the events up to the last of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.intervals import intervals_in
from blinkgl.io.records import read_text
from blinkgl.labels import LABELS, label_of
from blinkgl.sequence_files.index import sequence_folders
from eflow.data.dataset import FlowDataset
from eflow.data.representation import Representation
from eflow.data.sources import Entry, FolderSource, Sequence as Recording

_FLOWS, _HIDDEN = LABELS["flow_intervals"], LABELS["occlusion_intervals"]
_APART_NS = 1000
"""Intervals less far apart are the same: those that end with the sequence end there to the nanosecond."""


@dataclass(frozen=True)
class _Label:
    folder: Path
    index: int


class ContinuousDataset(Dataset):
    """Samples without augmentation, one per label whose flow leads over all ``intervals``: old, new (C, H, W) float32,
    the events of as long as the longest interval before and after the label's time; times (K,) float32 s, flow (K, 2,
    H, W) float32 px, valid (K, H, W) bool, and occluded (K, H, W) bool where the data set has it; name, scene.

    root : a data set, or a sequence.   intervals : s, increasing; None: all that the first sequence has.
    Raises ConfigError: no interval, or one that no label has; AssetError: no such labels, files missing;
    EventDataError: a window without events."""

    def __init__(self, root: str | Path, representation: Representation, intervals: Sequence[float] | None = None):
        root = Path(root)
        made = [(folder, times) for folder in sequence_folders(root) if (times := _times(folder))]
        if not made:
            raise AssetError(
                "no flow over intervals",
                where=str(root),
                accepted="a data set made with numbers in labels.flow, such as [0.01, 0.02, 0.05]",
            )
        leads = {folder: [intervals_in(folder / _FLOWS.forms[0].file(k)) for k in range(len(t))] for folder, t in made}
        there = sorted({ns for ends in leads[made[0][0]] for ns in ends.tolist()})
        self.intervals_ns = there if intervals is None else sorted(round(s * 1e9) for s in intervals)
        longest = max((abs(ns) for ns in self.intervals_ns), default=0) // 1000
        if not longest:
            raise ConfigError("no interval", where="intervals", value=intervals, accepted="seconds, not 0")
        self._labels: list[_Label] = []
        recordings = []
        for folder, times in made:
            entries = [
                Entry(k, t, t + longest)
                for k, (t, ends) in enumerate(zip(times, leads[folder], strict=True))
                if all(np.abs(ends - ns).min(initial=_APART_NS) < _APART_NS for ns in self.intervals_ns)
            ]
            self._labels += [_Label(folder, entry.index) for entry in entries]
            name = folder.name if folder == root else folder.relative_to(root).as_posix()
            recordings.append(Recording(name, name, folder / "events.h5", tuple(entries)))
        if not self._labels:
            raise ConfigError(
                "no label's flow leads over all of them",
                where="intervals",
                value=[ns * 1e-9 for ns in self.intervals_ns],
                accepted=", ".join(f"{ns * 1e-9:.6g}" for ns in there),
            )
        self._events = FlowDataset([FolderSource(recordings)], representation)

    def __len__(self) -> int:
        return len(self._labels)

    def __getitem__(self, index: int) -> dict:
        label, out = self._labels[index], self._events[index]
        flows = _read(_FLOWS.name, label)
        rows = [int(np.argmin(np.abs(flows.interval_ns - ns))) for ns in self.intervals_ns]
        out["times"] = torch.tensor([ns * 1e-9 for ns in self.intervals_ns], dtype=torch.float32)
        out["flow"] = torch.from_numpy(np.ascontiguousarray(flows.flow[rows].transpose(0, 3, 1, 2)))
        out["valid"] = torch.from_numpy(flows.valid[rows])
        if (label.folder / _HIDDEN.forms[0].file(label.index)).is_file():
            out["occluded"] = torch.from_numpy(_read(_HIDDEN.name, label).occluded[rows])
        return out


def _read(name: str, label: _Label):
    form = label_of(name).forms[0]
    assert form.read is not None
    return form.read(label.folder / form.file(label.index))


def _times(folder: Path) -> list[int]:
    """Of the labels that lead over intervals, µs; empty: there are none."""
    stamps = _FLOWS.stamps
    assert stamps is not None
    return [int(line) for line in read_text(folder / stamps).split()] if (folder / stamps).is_file() else []
