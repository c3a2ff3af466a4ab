"""Rendered samples as files in a folder, so that several trainings can use the same windows without rendering them
again.

    eflow render configs/eflow/real_data.yaml --samples 20000 --window-ms 5-100 --out out/real_windows

The folder holds ``windows.json`` (their number and origin) and one ``%07d.npz`` per sample.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.atomic import atomic_folder, output_errors
from blinkgl.online.samples import read_sample
from eflow.data.window import RawSample, raw_sample

if TYPE_CHECKING:
    from eflow.data.online import OnlineSource

ABOUT = "windows.json"
_VERSION = 1


class PoolSource:
    """A folder written by :func:`render_pool`, as a :class:`~eflow.data.sources.Source`.

    Raises AssetError: not such a folder, missing files; for a damaged sample, when it is read."""

    def __init__(self, root: Path):
        self.root = root
        about = _about(root)
        self.count, self.has_backward = about["samples"], about["backward"]
        there = sum(1 for _ in root.glob("*.npz"))
        if there != self.count:
            raise AssetError(
                "some windows are missing", where=str(root), value=there, accepted=f"{self.count} .npz files"
            )

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> RawSample:
        path = self.root / f"{index:07d}.npz"
        try:
            return raw_sample(read_sample(path))
        except (OSError, ValueError, KeyError, TypeError, EOFError, EventDataError) as error:
            raise AssetError(f"not a window of eflow render: {error}", where=str(path)) from None
        except Exception as error:  # zipfile and zlib raise their own errors
            if type(error).__module__ not in ("zipfile", "zlib"):
                raise
            raise AssetError(f"a damaged window: {error}", where=str(path)) from None


def _about(root: Path) -> dict[str, Any]:
    path = root / ABOUT
    wanted = "samples and backward"
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise AssetError(f"cannot be read: {error}", where=str(path)) from None
    if not isinstance(about, dict) or about.get("version") != _VERSION:
        raise AssetError("unknown version", where=str(path), accepted=f"version {_VERSION}")
    samples, backward = about.get("samples"), about.get("backward")
    if not isinstance(samples, int) or isinstance(samples, bool) or samples < 1 or not isinstance(backward, bool):
        raise AssetError(
            "not the description of a folder of windows", where=str(path), value=(samples, backward), accepted=wanted
        )
    return about


def render_pool(
    source: OnlineSource,
    count: int,
    out: str | os.PathLike,
    *,
    about: dict[str, Any] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> int:
    """Write the first ``count`` samples of an online source to the new folder ``out``; return their number.

    The folder appears when it is complete. After an interruption it holds the samples finished by then.
    about : further entries of windows.json. Raises OutputError: the folder exists, no space. ConfigError: the recipe
    gives no samples."""
    done = 0
    with atomic_folder(out) as folder:
        try:
            for n in range(count):
                with output_errors(folder):
                    source.move(n, folder / f"{n:07d}.npz")
                done = n + 1
                progress(done)
        except KeyboardInterrupt:
            if done == 0:
                raise
            (folder / f"{done:07d}.npz").unlink(missing_ok=True)
        tree = {**(about or {}), "version": _VERSION, "samples": done, "backward": source.has_backward}
        with output_errors(folder):
            (folder / ABOUT).write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    return done
