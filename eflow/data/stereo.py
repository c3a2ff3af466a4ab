"""Stereo: both eyes of one label as one sample.

    data = StereoDataset("out/stereo", VoxelGrid(bins=5))
    data[0]["left"]["new"], data[0]["right"]["new"], data[0]["disparity"]

Read from rigs with a `pair` (docs/rigs.md); a torch DataLoader batches the samples as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from blinkgl.errors import AssetError
from blinkgl.labels import LABELS
from blinkgl.sequence_files.index import made_folders
from blinkgl.sequence_files.rig_dir import read_rig
from blinkgl.sequence_files.sequence_dir import is_rig_folder
from eflow.data.dataset import FlowDataset
from eflow.data.representation import Representation
from eflow.data.sources import FolderSource, Sequence, blinkgl_sequence

_DISPARITY = LABELS["disparity"].forms[0]


@dataclass(frozen=True)
class Pair:
    """A stereo recording. baseline : world units.   focal : px.   folder : of the left eye."""

    left: Sequence
    right: Sequence
    folder: Path
    baseline: float
    focal: float


def find_pairs(root: str | Path) -> list[Pair]:
    """The rectified pairs of event cameras in the rigs at or below ``root`` that have forward flow, in the order of
    their folders. Raises AssetError where there is none."""
    root, found = Path(root), []
    for folder in made_folders(root):
        rig = read_rig(folder) if is_rig_folder(folder) else {}
        for name, one in rig.items():
            if one.get("baseline", 0.0) <= 0:
                continue
            eyes = [blinkgl_sequence(folder / eye, f"{folder.name}/{eye}") for eye in (name, one["pair"])]
            left, right = eyes
            if left is not None and right is not None:
                found.append(Pair(left, right, folder / name, one["baseline"], one["intrinsics"][0]))
    if not found:
        raise AssetError(
            "no stereo pair with events and forward flow",
            where=str(root),
            accepted="a data set of `rig: stereo`, or of `sensors` with a `pair` (docs/rigs.md)",
        )
    return found


class StereoDataset(Dataset):
    """Samples without augmentation, one per label of a pair: left, right (dicts of
    :class:`~eflow.data.dataset.FlowDataset`: old, new, flow, valid, mask, name, scene), baseline, focal, and, where
    `labels.disparity` was asked for, disparity (H, W) float32 px of the left eye.

    Raises AssetError: no pair, files missing; EventDataError: no event in a window of either eye."""

    def __init__(self, root: str | Path, representation: Representation):
        self.pairs = find_pairs(root)
        eyes = [FolderSource([getattr(pair, eye) for pair in self.pairs]) for eye in ("left", "right")]
        if len(eyes[0]) != len(eyes[1]):
            raise AssetError("the eyes have different numbers of labels", where=str(root))
        self._eyes = [FlowDataset([eye], representation) for eye in eyes]
        self._labels = [(pair, entry.index) for pair in self.pairs for entry in pair.left.entries]

    def __len__(self) -> int:
        return len(self._labels)

    def __getitem__(self, index: int) -> dict:
        pair, number = self._labels[index]
        left, right = (eye[index] for eye in self._eyes)
        out = {"left": left, "right": right, "baseline": pair.baseline, "focal": pair.focal}
        path = pair.folder / _DISPARITY.file(number)
        if path.is_file():
            out["disparity"] = torch.from_numpy(np.ascontiguousarray(_DISPARITY.read(path)))
        return out
