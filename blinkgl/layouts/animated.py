"""A sequence as an animated glTF: its scene, built again from its own configuration, over its own time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blinkgl.config.run import load_run
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.layouts.source import Source, sources_of
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.exporting import glb
from blinkgl.sequence_files.sequence_dir import MANIFEST

RATE_HZ, SHAPES_HZ = 120, 30
"""Poses, and shapes that change, are sampled so often, and at the labels' times."""


def export_scene(sequence: str | Path, out: str | Path) -> list[str]:
    """Writes a sequence (or the only one of a data set) as ``out``, a .glb. Returns what of the scene is not in it.

    Raises AssetError: no sequence, several, or one of recorded frames; ConfigError, AssetError: its scene cannot be
    built again; OutputError."""
    out = Path(out)
    if out.suffix.lower() != ".glb":
        raise OutputError("not the name of a binary glTF", where=str(out), value=out.suffix, accepted=".glb")
    source = _only(Path(sequence))
    config = load_run(source.folder / "config.yaml").sequence(source.manifest["sequence"])
    if config.frames is not None:
        raise AssetError("a sequence of recorded frames has no scene", where=str(source.folder))
    scene = sequence_scene(config, source.manifest["sequence"], _base(source))
    data, said = glb(scene, _times(config, RATE_HZ), _times(config, SHAPES_HZ))
    with atomic_file(out) as path, output_errors(out):
        path.write_bytes(data)
    return said


def _only(folder: Path) -> Source:
    if not folder.is_dir():
        raise AssetError("no such sequence", where=str(folder), accepted="a folder of one")
    found = sources_of(folder)
    if len(found) != 1:
        raise AssetError(
            "a scene is of one sequence", where=str(folder), value=len(found), accepted=f"a folder with a {MANIFEST}"
        )
    return found[0]


def _base(source: Source) -> Path:
    """What relative paths of its configuration start from, as the run's record says."""
    for root in list(source.folder.resolve().parents)[:3]:
        if (record := RunFolder(root).read("run.json")) is not None:
            return Path(record.get("base", "."))
    return Path(".")


def _times(config: SequenceConfig, rate_hz: int) -> np.ndarray:
    t0, t1 = config.time.t0_ns, config.time.t1_ns
    even = t0 + np.arange(0, int((t1 - t0) * rate_hz / 1e9) + 1) * 1_000_000_000 // rate_hz
    return np.unique(np.concatenate([even, np.array(config.time.label_times_ns, np.int64), [t1]]))
