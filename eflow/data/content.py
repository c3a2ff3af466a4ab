"""Digests of what a training reads: a run that goes on may find its data at another place, but not other data."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from pathlib import Path

from blinkgl.config.run import load_run
from blinkgl.errors import AssetError
from blinkgl.io.flow import READ_ENDINGS
from eflow.checkpoint import find_weights
from eflow.config import SourceConfig, TrainConfig
from eflow.data.dataset import evenly
from eflow.data.folders import below

_ENDINGS = {".h5", ".hdf5", ".npz", ".txt", ".csv", ".json", ".yaml", *READ_ENDINGS}
_OPENED, _END = 256, 1 << 16
"""Files of which both ends are read, and the bytes of each: those of a small set whole, of a large one a sample."""


def content_of(config: TrainConfig) -> dict[str, str]:
    """Return key -> digest of every set, and of the initial weights where they are still there."""
    kept = {
        f"data.{name}.{k}." + ("path" if s.recipe is None else "recipe"): _of_set(s)
        for name in ("train", "validate_on")
        for k, s in enumerate(getattr(config.data, name))
        if s.share is None
    }
    with suppress(AssetError):
        if config.init_from:
            kept["init_from"] = hashlib.sha256(find_weights(config.init_from).read_bytes()).hexdigest()
    return kept


def _of_set(s: SourceConfig) -> str:
    if s.recipe is None:
        return _of_files(Path(s.path or ""))
    # The renderer is imported for recipes alone.
    from blinkgl.dataset.assets import check_assets
    from blinkgl.dataset.plan import Plan

    plan = Plan.of(load_run(s.recipe, s.set))
    about = [plan.identity, sorted(check_assets(plan).values())]
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def _of_files(root: Path) -> str:
    """Return a digest of the names below ``root`` and sizes of all data files, and of both ends of evenly spaced ones.
    Of a recording of MVSEC ``root`` is one of its files."""
    beside = sorted(root.parent.glob(root.name.removesuffix("data.hdf5") + "*"))
    files = [p for p in (below(root, "*") if root.is_dir() else beside) if p.suffix.lower() in _ENDINGS and p.is_file()]
    base, digest, opened = root if root.is_dir() else root.parent, hashlib.sha256(), set(evenly(len(files), _OPENED))
    for k, path in enumerate(files):
        name, size = path.relative_to(base).as_posix(), path.stat().st_size
        if name.startswith("."):  # .run: what is known of the run that made a set
            continue
        digest.update(f"{name} {size}\n".encode())
        if k in opened:
            with open(path, "rb") as file:
                digest.update(file.read(_END))
                file.seek(max(size - _END, 0))
                digest.update(file.read(_END))
    return digest.hexdigest()
