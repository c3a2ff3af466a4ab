"""Configurations drawn from the schema: a few keys of a small recipe get any values that their types and bounds allow.
Each is refused by one line, or is generated and verified, and what it wrote is looked at without our readers' help:
labels are finite, and the events of each window are those of its times.

    python -m blinkgl.tools.fuzz configurations [--mutants 1000] [--seed 0] [--only K] [--keep FILE]
"""

from __future__ import annotations

import copy
import types
import typing
import zlib
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401 - the events' filter
import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from blinkgl.config.base import is_model, members
from blinkgl.config.reader import to_yaml
from blinkgl.config.run import load_run
from blinkgl.config.scene import FileSceneConfig
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import BlinkGLError
from blinkgl.io.dsec import DsecEventReader
from blinkgl.labels import LABELS
from blinkgl.sequence_files.index import sequence_folders
from blinkgl.sequence_files.sequence_dir import read_manifest
from blinkgl.types.trees import Tree

SMALL: dict[str, object] = {
    "camera": {"width": 32, "height": 24},
    "time": {"duration": 0.1, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 100},
    "scene": {
        "kind": "random",
        "objects": {"count": 2},
        "pool": {"primitives": ["cuboid", "sphere"], "variants": 4},
        "textures": {"procedural": ["checks"], "variants": 4, "photographs": False, "max_size": 32},
    },
    "labels": {"flow": ["forward"], "depth": True},
    "preview": {"enabled": False},
}
_OTHERS: Tree = {
    "explicit": {
        "meshes": {"box": {"primitive": "cuboid"}, "ball": {"primitive": "sphere"}},
        "objects": [{"mesh": "box"}, {"mesh": "ball", "position": [1, 1, 0]}],
        "camera": {"position": [-3, 0, 0], "look_at": [0, 0, 0]},
    }
}
"""What a kind needs besides its name."""
_FIXED = (
    "output.sequences",
    "output.first_index",
    "gl",
    "frames",
    "rig",
    "sensor",
    "output.layout",
    "scene.path",
    "scene.camera.trajectory",
)
"""Keys that need files, more time, or another machine."""
_MOST: dict[str, float] = {
    "camera.width": 96, "camera.height": 96, "time.duration": 0.15, "time.label_rate": 200, "timeline.fps": 2000,
    "scene.objects.count": 8, "scene.pool.variants": 16, "scene.textures.max_size": 128, "images.rate": 200,
    "tracks.points": 200,
}  # fmt: skip
"""Values above these are drawn anew as these: they cost minutes, and no code that others do not run."""

Leaf = tuple[tuple[str, ...], dict[tuple[str, ...], str], FieldInfo]


def leaves(
    model: type[BaseModel], path: tuple[str, ...] = (), kinds: dict[tuple[str, ...], str] | None = None
) -> list[Leaf]:
    """Return the keys of a model that hold plain values: path, the kinds of the unions on the way, and the field."""
    rows: list[Leaf] = []
    for name, info in model.model_fields.items():
        at = (*path, name)
        if any(".".join(at).startswith(fixed) for fixed in _FIXED) or name in ("kind", "emulator"):
            continue
        inner = [one for one in members(info.annotation) if is_model(one)]
        for one in (one for one in inner if one is not FileSceneConfig):
            mark = next((k for k in ("kind", "emulator") if k in one.model_fields), None)
            kind = "" if mark is None else str(typing.get_args(one.model_fields[mark].annotation)[0])
            marks = {} if mark is None or len(inner) < 2 else {(*at, mark): kind}
            rows += leaves(one, at, {**(kinds or {}), **marks}) if len(at) < 4 else []
        if not inner:
            rows.append((at, kinds or {}, info))
    return rows


def value(rng: np.random.Generator, annotation: object, bounds: list[object]) -> object:
    """Return a value of a type: an end of its bounds, something between, or one of its choices."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return value(rng, arguments[0], [*bounds, *arguments[1:]])
    if origin is typing.Literal:
        return arguments[int(rng.integers(len(arguments)))]
    if origin in (typing.Union, types.UnionType):
        return value(rng, arguments[int(rng.integers(len(arguments)))], bounds)
    if origin in (tuple, list):
        fixed = arguments[:-1] * int(rng.integers(4)) if arguments[-1:] == (...,) else arguments
        return [value(rng, one, []) for one in fixed]
    if annotation is type(None):
        return None
    if annotation is bool:
        return bool(rng.integers(2))
    if annotation not in (int, float):
        return str(rng.choice(["a", "", "1", "true", "../x"]))
    least = [float(getattr(b, "ge", None) or getattr(b, "gt", 0)) for b in bounds if isinstance(b, (Ge, Gt))]
    most = [float(getattr(b, "le", None) or getattr(b, "lt", 0)) for b in bounds if isinstance(b, (Le, Lt))]
    low, high = max(least, default=-10.0), min(most, default=10.0)
    picks = [low, high, rng.uniform(low, high), rng.uniform(low, min(high, low + 10)), 0.0, 1.0]
    if low > 0:
        picks.append(float(np.exp(rng.uniform(np.log(low), np.log(max(high, low))))))
    number = picks[int(rng.integers(len(picks)))]
    return int(number) if annotation is int else float(number)


def drawn(seed: int, index: int) -> dict[str, object]:
    """Return configuration ``index``: the small recipe with one to four keys of other values."""
    rng = np.random.default_rng([seed, zlib.crc32(b"configurations"), index])
    tree: dict[str, object] = copy.deepcopy(SMALL)
    rows = leaves(SequenceConfig)
    for _ in range(int(rng.integers(1, 5))):
        path, kinds, info = rows[int(rng.integers(len(rows)))]
        picked = value(rng, info.annotation, list(info.metadata))
        most = _MOST.get(".".join(path))
        if most is not None and isinstance(picked, (int, float)) and picked > most:
            picked = type(picked)(most)
        for at, entry in [*kinds.items(), (path, picked)]:
            table: Tree = tree
            for step in at[:-1]:
                table = table.setdefault(step, {}) if isinstance(table.get(step, {}), dict) else {}
            if at[-1] in ("kind", "emulator") and table.get(at[-1]) not in (None, entry):
                table.clear()  # keys of another kind
                table.update(copy.deepcopy(_OTHERS.get(str(entry), {})))
            table[at[-1]] = entry
    return tree


def check(path: Path) -> None:
    """Generate the configuration in a file, verify it and look at what it wrote. Raises BlinkGLError: it is refused, or
    its sequence set aside; AssertionError: what was written is wrong."""
    out = path.with_name("out")
    outcome = run_dataset(load_run(path), out)
    for reason in outcome.set_aside.values():
        raise BlinkGLError(reason)
    problems = verify_dataset(out).problems
    assert not problems, problems
    for folder in sequence_folders(out):
        _look(folder)


def _look(folder: Path) -> None:
    manifest = read_manifest(folder)
    for label in LABELS.values():
        for name in filter(label.forms[0].holds, manifest["files"]):
            read = label.read(folder / name, label.forms[0], manifest["height"], manifest["width"])
            arrays = vars(read) if hasattr(read, "__dict__") else {"": read}
            for key, array in arrays.items():
                if isinstance(array, np.ndarray) and array.dtype.kind == "f":
                    # A depth is infinite where nothing is hit.
                    wrong = np.isnan(array) if label.kind == "depth" else ~np.isfinite(array)
                    assert not wrong.any(), f"{name}: {key} is not finite"
    if "events.h5" not in manifest["files"]:
        return
    with h5py.File(folder / "events.h5") as file:
        t = file["events/t"][()].astype(np.int64) + int(file["t_offset"][()])
        x = file["events/x"][()]
    stamps = folder / "flow/forward_timestamps.txt"
    rows = (
        np.loadtxt(stamps, delimiter=",", dtype=np.int64, ndmin=2) if stamps.is_file() else np.empty((0, 2), np.int64)
    )
    with DsecEventReader(folder / "events.h5", size=(manifest["height"], manifest["width"])) as reader:
        for begin, end in rows.tolist():
            inside = (t >= begin) & (t < end)
            assert np.array_equal(reader.slice(begin, end).x, x[inside]), f"events of [{begin}, {end}) are others"


def written(seed: int, index: int) -> bytes:
    """Return the YAML of configuration ``index``."""
    return to_yaml(drawn(seed, index)).encode()
