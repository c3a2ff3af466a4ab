"""Digests of what a training reads: a run that goes on may find its data at another place, but not other data."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from blinkgl.config.run import load_run
from blinkgl.errors import AssetError
from eflow.checkpoint import find_weights
from eflow.config import TrainConfig
from eflow.data.dataset import evenly
from eflow.data.sources import Source

_READ = 256
_END = 1 << 16
"""Files of which both ends are read, and the bytes of each: those of a small set whole, of a large one a sample."""


def content_of(config: TrainConfig, train: list[Source], validation: list[Source]) -> dict[str, str]:
    """Return key -> digest of every set, and of the initial weights where they are still there."""
    found = {}
    for name, sources in (("train", train), ("validate_on", validation)):
        for k, (source, s) in enumerate(zip(sources, getattr(config.data, name), strict=True)):
            where = f"data.{name}.{k}."
            if s.recipe is not None:
                found[where + "recipe"] = _of_recipe(s.recipe, s.set)
            else:
                found[where + "path"] = digest_of_files(source.files())
    if config.init_from:
        with suppress(AssetError):
            found["init_from"] = hashlib.sha256(find_weights(config.init_from).read_bytes()).hexdigest()
    return found


def _of_recipe(recipe: str, overrides: tuple[str, ...]) -> str:
    from blinkgl.dataset.assets import check_assets
    from blinkgl.dataset.plan import Plan

    plan = Plan.of(load_run(recipe, overrides))
    about = [plan.identity, sorted(check_assets(plan).values())]
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()


def digest_of_files(files: Iterable[tuple[str, Path]]) -> str:
    """Return a digest of names and sizes of all (name, file), and of both ends of evenly spaced ones. Names are those
    of the samples, not of folders."""
    found, listed = hashlib.sha256(), list(files)
    looked = set(evenly(len(listed), _READ))
    for k, (name, path) in enumerate(listed):
        size = path.stat().st_size
        found.update(f"{name} {size}\n".encode())
        if k in looked:
            with open(path, "rb") as file:
                found.update(file.read(_END))
                file.seek(max(size - _END, 0))
                found.update(file.read(_END))
    return found.hexdigest()
