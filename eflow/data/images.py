"""Images of a frame camera with the events of their exposures, for whoever restores, interpolates or brightens them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from blinkgl.errors import AssetError
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.frame_camera import EXPOSURES, ExposureLine, picture_file, read_codes, read_exposures
from blinkgl.sequence_files.index import sequence_folders
from blinkgl.sequence_files.sequence_dir import read_manifest
from eflow.data.representation import Representation
from eflow.data.window import Window


class ImageDataset(Dataset):
    """A sample per image of every sequence at or below ``root`` that was made with ``images:``.

    A dict: images, and sharp and clean where the data set has them, (3, H, W) or (1, H, W) float32, code / largest
    code; events (C, H, W) float32 of the time from the first row's start to the last row's end; start_us, end_us,
    exposure_us, row_us, gain_db; name. All samples of one camera have the same keys, so that torch's own collation
    takes them.

    representation : of the events; None: their :class:`~eflow.data.window.Window` itself, as "window".
    margin_us : of time before and after the exposure whose events are given, too (interpolation looks at neighbours).
    Raises AssetError: no such images, a damaged sequence."""

    def __init__(self, root: str | os.PathLike, representation: Representation | None = None, *, margin_us: int = 0):
        self.representation, self.margin_us = representation, int(margin_us)
        self._samples: list[tuple[Path, int, ExposureLine]] = []
        self._about: dict[Path, dict[str, Any]] = {}
        for folder in sequence_folders(Path(root)):
            manifest = read_manifest(folder)
            if EXPOSURES in manifest["files"]:
                self._about[folder] = manifest["frame_camera"]
                self._samples += [(folder, k, line) for k, line in enumerate(read_exposures(folder))]
        if not self._samples:
            raise AssetError(
                "no images of a frame camera", where=str(root), accepted="a data set generated with images:"
            )

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> dict[str, Any]:
        folder, k, line = self._samples[index]
        about = self._about[folder]
        sample: dict[str, Any] = {
            name: self._picture(folder / picture_file(name, k), about["bits"]) for name in about["pictures"]
        }
        height, width = sample["images"].shape[1:]
        t0, t1 = int(line.start_us) - self.margin_us, int(-(-line.end_us // 1)) + self.margin_us
        with DsecEventReader(folder / "events.h5") as reader:
            events = reader.slice(t0, t1)
        window = Window(events.x, events.y, events.t, events.p, t0, t1)
        if self.representation is None:
            sample["window"] = window
        else:
            sample["events"] = torch.from_numpy(self.representation(window, height, width))
        times = {name: getattr(line, name) for name in ("start_us", "end_us", "exposure_us", "row_us", "gain_db")}
        return {**sample, **times, "name": f"{folder.name}_{k:06d}"}

    @staticmethod
    def _picture(path: Path, bits: int) -> torch.Tensor:
        codes = read_codes(path)
        light = codes.astype(np.float32) / np.float32((1 << bits) - 1)
        return torch.from_numpy(np.ascontiguousarray(np.atleast_3d(light).transpose(2, 0, 1)))
