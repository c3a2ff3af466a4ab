"""Rendered samples as files in a folder, so that several trainings can use the same windows without rendering them
again.

    eflow render configs/eflow/real_data.yaml --samples 20000 --window-ms 5-100 --out out/real_windows

The folder holds ``windows.json`` (their number and origin) and one ``%07d.npz`` per sample.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from blinkgl.errors import AssetError
from blinkgl.io.atomic import atomic_folder, output_errors
from blinkgl.io.columns import check_events
from blinkgl.io.images import numpy_errors
from blinkgl.io.records import inside, parse, read_text
from blinkgl.online.samples import WindowSample, read_sample
from eflow.data.window import RawSample, raw_sample

if TYPE_CHECKING:
    from blinkgl.online.stream import SampleStream

ABOUT = "windows.json"
_VERSION = 1


class _About(BaseModel):
    """``windows.json``."""

    model_config = ConfigDict(strict=True, extra="allow")
    version: Literal[1]
    samples: int = Field(ge=1, le=10_000_000)
    backward: bool


_MODEL = TypeAdapter(_About)


class PoolSource:
    """A folder written by :func:`render_pool`, as a :class:`~eflow.data.sources.Source`.

    Raises AssetError: not such a folder, missing files; for a damaged sample, when it is read."""

    def __init__(self, root: Path):
        self.root = root
        about = _about(root)
        self.count, self.has_backward = about.samples, about.backward
        there = sum(1 for _ in root.glob("[!.]*.npz"))
        if there != self.count:
            raise AssetError(
                "some windows are missing", where=str(root), value=there, accepted=f"{self.count} .npz files"
            )

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> RawSample:
        path = self.root / f"{index:07d}.npz"
        with numpy_errors(path):
            sample = read_sample(path)
            if not isinstance(sample, WindowSample):
                raise AssetError("not a window of eflow render, but a stream", where=str(path))
            for flow, valid in ((sample.flow, sample.valid), (sample.backward, sample.backward_valid)):
                if flow is not None or valid is not None:
                    size = sample.height, sample.width
                    if (
                        flow is None
                        or valid is None
                        or flow.shape != (*size, 2)
                        or valid.shape != size
                        or flow.dtype != np.float32
                        or valid.dtype != bool
                        or not np.isfinite(flow[valid]).all()
                    ):
                        raise AssetError("flow of another shape or type, or not finite", where=str(path))
            inside(self.root, sample.name.replace("/", "_"))  # it becomes the name of a picture
            for events in (sample.old, sample.new):
                check_events(events, str(path), height=sample.height, width=sample.width)
            return raw_sample(sample)


def _about(root: Path) -> _About:
    path = root / ABOUT
    try:
        return _About(**parse(read_text(path), _MODEL))
    except (FileNotFoundError, ValueError) as error:
        raise AssetError(
            f"not the description of a folder of windows: {error}",
            where=str(path),
            accepted=f"version {_VERSION}, samples and backward, as eflow render writes them",
        ) from None


def render_pool(
    stream: SampleStream,
    count: int,
    out: str | os.PathLike,
    *,
    about: Mapping[str, object] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> int:
    """Write the first ``count`` samples of a stream of windows to the new folder ``out``; return their number.

    The folder appears when it is complete. After an interruption it holds the samples finished by then.
    about : further entries of windows.json. Raises OutputError: the folder exists, no space. ConfigError: the recipe
    gives no samples."""
    done = 0
    with atomic_folder(out) as folder:
        try:
            for n in range(count):
                with output_errors(folder):
                    stream.move(n, folder / f"{n:07d}.npz")
                done = n + 1
                progress(done)
        except KeyboardInterrupt:
            if done == 0:
                raise
            # The file that was being moved may be incomplete.
            (folder / f"{done:07d}.npz").unlink(missing_ok=True)
        tree = {**(about or {}), "version": _VERSION, "samples": done, "backward": stream.has_backward}
        with output_errors(folder):
            (folder / ABOUT).write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    return done
