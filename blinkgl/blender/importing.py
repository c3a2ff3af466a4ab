"""Import of Blender's scenes, and of the formats it reads, as a GLB.

    came = import_scene("shop.blend", "shop.glb")
    came.counts, came.left_out                      # what was imported, and what was not

Blender opens the file in a separate process (:mod:`blinkgl.blender.process`) and exports it with its own exporter of
glTF, modifiers applied. BlinkGL's own importer reads the GLB back before it gets its final name.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.blender.process import Blender, how_it_ended
from blinkgl.camera import PinHole
from blinkgl.errors import AssetError, BlinkGLError, ConfigError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.scene.importing import gltf
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.worlds.from_file import from_document

PROGRAM = Path(__file__).with_name("inside") / "convert.py"
ENDINGS = (".blend", ".fbx", ".usd", ".usda", ".usdc", ".usdz", ".dae", ".abc", ".obj")
_MOST_FACES = 1 << 31
_FRAME = 1_048_574  # Blender's own limit of frame numbers


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    blender : version.   counts : of the GLB's contents (meshes, triangles …).   left_out : what is missing, a line
    each.
    cameras : names; camera : the scene's active one, None without.
    size : (width, height) px of its render.   frames : (first, last) of the file.   fps : of the file.
    duration_s : of the animation.   omissions : parts of the GLB that BlinkGL does not draw, a line each.
    """

    path: Path
    blender: str
    counts: dict[str, int]
    left_out: tuple[str, ...]
    cameras: tuple[str, ...]
    camera: str | None
    size: tuple[int, int]
    frames: tuple[int, int]
    fps: float
    duration_s: float
    omissions: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as plain data, for JSON."""
        return {**asdict(self), "path": str(self.path)}


def import_scene(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scene: str | None = None,
    frames: Sequence[int] | None = None,
    fps: float | None = None,
    keys_per_frame: int = 1,
    clips: bool = False,
    time_limit_s: float = 900.0,
    overwrite: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Imported:
    """Write the GLB ``out``, complete or not at all.

    scene : name of the file's scene; None: the one it was saved in.   frames : (first, last); None: the scene's.
    fps : frames per second; None: the file's, 24 if its format does not contain it (USD, Collada, Alembic).
    keys_per_frame : key frames written per frame; between them glTF interpolates linearly.
    clips : an animation per action instead of one for the whole scene.
    time_limit_s : seconds that Blender may take in total.   progress : is called with what it does. Raises AssetError
    (the file), ConfigError (an option), OutputError, BlinkGLError (no Blender, or it crashed).
    """
    source, out = Path(source), Path(out)
    _check_options(source, out, frames, fps, keys_per_frame, time_limit_s)
    with atomic_file(out, overwrite=overwrite) as temporary:
        with output_errors(temporary):
            temporary.touch()  # now, not after minutes
        with tempfile.TemporaryDirectory(prefix="blinkgl-blender-") as name:
            folder = Path(name)
            job = {
                "source": str(source.absolute()),
                "shown": str(source),
                "scene": scene,
                "frames": None if frames is None else [int(f) for f in frames],
                "fps": fps,
                "keys_per_frame": keys_per_frame,
                "clips": clips,
            }
            (folder / "job.json").write_text(json.dumps(job))
            report = _run(folder, source, time_limit_s, progress or (lambda doing: None))
            with output_errors(temporary):
                shutil.copyfile(folder / "scene.glb", temporary)
        omissions = _read_back(temporary, out)
    return Imported(
        out,
        report["blender"],
        report["counts"],
        tuple(report["left_out"]),
        tuple(report["cameras"]),
        report["camera"],
        (report["size"][0], report["size"][1]),
        (report["first"], report["last"]),
        report["fps"],
        report["duration_s"],
        omissions,
    )


def _check_options(source: Path, out: Path, frames, fps, keys_per_frame, time_limit_s) -> None:
    if source.suffix.lower() not in ENDINGS:
        accepted = ", ".join(ENDINGS)
        if source.suffix.lower() in (".glb", ".gltf"):
            accepted += " (a glTF file is used as it is: scene: {kind: file, path: …})"
        raise AssetError("Blender cannot read this format", where=str(source), accepted=accepted)
    try:
        with open(source, "rb") as file:
            empty = not file.read(1)
    except OSError as error:
        raise AssetError(f"cannot read the scene: {error.strerror}", where=str(source)) from None
    if empty:
        raise AssetError("the file is empty", where=str(source))
    if out.suffix.lower() != ".glb":
        raise ConfigError("not a GLB", where="--out", value=str(out), accepted="a file name that ends in .glb")
    if frames is not None and (len(frames) != 2 or not -_FRAME <= frames[0] <= frames[1] <= _FRAME):
        raise ConfigError("not a range of frames", where="--frames", value=tuple(frames), accepted="FIRST LAST")
    for option, value, low, high in (
        ("--fps", 24.0 if fps is None else fps, 1, 10_000),
        ("--keys-per-frame", keys_per_frame, 1, 64),
        ("--time-limit", time_limit_s, 1, 1e6),
    ):
        if not low <= value <= high:
            raise ConfigError("out of range", where=option, value=value, accepted=f"{low} to {high:g}")


def _run(folder: Path, source: Path, limit_s: float, progress: Callable[[str], None]) -> dict[str, Any]:
    """Return the report of Blender's side, which has written ``folder``/scene.glb."""
    report = None
    with Blender(PROGRAM, folder, limit_s) as blender:
        for words in blender.answers():
            if "doing" in words:
                progress(words["doing"])
            report = words.get("report", report)
        status = blender.status()
        if status or report is None or not (folder / "scene.glb").is_file():
            raise BlinkGLError(
                f"Blender {how_it_ended(status)} while {blender.doing}: {blender.last_words()}", where=str(source)
            )
    return report


def _read_back(path: Path, out: Path) -> tuple[str, ...]:
    """Load the GLB as a scene and return lines of what is not drawn, with the name of ``out``. AssetError if it cannot
    be loaded."""
    still = StaticPath(np.eye(4), 0, 1)
    try:
        document = gltf.read(path, max_faces=_MOST_FACES, max_texture=16384)
        if all(node.mesh is None for node in document.nodes.values()):  # a clip for a figure of another file
            document.tracks(0)
            return ()
        scene = from_document(document, PinHole.centred(32, 32, 32.0), 0, 1, camera_path=still)
    except BlinkGLError as error:
        raise AssetError(f"what Blender wrote cannot be read ({error.problem})", where=str(out)) from error
    return tuple(line.replace(path.name, out.name) for line in scene.omissions)
