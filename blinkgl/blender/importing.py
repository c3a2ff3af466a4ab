"""Import of Blender's scenes, and of the formats it reads, as a GLB.

    came = import_scene("shop.blend", "shop.glb")
    came.counts, came.left_out                      # what was imported, and what was not

Blender opens the file in a separate process (:mod:`blinkgl.blender.process`) and exports it with its own exporter of
glTF, modifiers applied. BlinkGL plays the GLB and compares it with what Blender itself evaluates
(:mod:`blinkgl.blender.comparing`); what differs Blender bakes, and exports again.
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

from blinkgl.blender.comparing import Difference, compare
from blinkgl.blender.process import Blender, how_it_ended
from blinkgl.errors import AssetError, BlinkGLError, ConfigError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.types.trees import Tree

PROGRAM = Path(__file__).with_name("inside") / "convert.py"
ENDINGS = (".blend", ".fbx", ".usd", ".usda", ".usdc", ".usdz", ".dae", ".abc", ".obj")
_FRAME = 1_048_574  # Blender's own limit of frame numbers


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    blender : version.   counts : of the GLB's contents (meshes, triangles …).   left_out : what is missing, a line
    each.
    cameras : names; camera : the scene's active one, None without.
    size : (width, height) px of its render.
    frames : (first, last) of the file.   fps : of the file.   keys_per_frame : that were needed.
    duration_s : of the animation.   baked : names of what glTF could not express; baked_mb : what it takes, about.
    wrong : what differs from Blender all the same, a line each.
    omissions : parts of the GLB that BlinkGL does not draw, a line each.
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
    keys_per_frame: int
    duration_s: float
    baked: tuple[str, ...]
    baked_mb: float
    wrong: tuple[str, ...]
    omissions: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
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
    bake_mb: float = 256.0,
    time_limit_s: float = 900.0,
    overwrite: bool = False,
    progress: Callable[[str], None] | None = None,
) -> Imported:
    """Write the GLB ``out``, complete or not at all.

    scene : name of the file's scene; None: the one it was saved in.   frames : (first, last); None: the scene's.
    fps : frames per second; None: the file's; 24 where it has none that can be read (binary USD, Collada), which a
    line says of USD.
    keys_per_frame : least key frames written per frame; between them glTF interpolates linearly.
    clips : an animation per action instead of one for the whole scene; nothing is compared or baked.
    bake_mb : largest size of all baked shapes, MB.
    time_limit_s : seconds that Blender may take in total.   progress : is called with what it does. Raises AssetError
    (the file), ConfigError (an option), OutputError, BlinkGLError (no Blender, or it crashed).
    """
    source, out = Path(source), Path(out)
    _check_options(source, out, frames, fps, keys_per_frame, bake_mb, time_limit_s)
    with atomic_file(out, overwrite=overwrite) as temporary:
        with output_errors(temporary):
            temporary.touch()  # now, not after minutes
        with tempfile.TemporaryDirectory(prefix="blinkgl-blender-") as name:
            # Blender writes only here; the result is copied once it is known to be whole.
            folder = Path(name)
            job = {
                "source": str(source.absolute()),
                "shown": str(source),
                "scene": scene,
                "frames": None if frames is None else [int(f) for f in frames],
                "fps": fps,
                "keys_per_frame": keys_per_frame,
                "clips": clips,
                "bake_mb": bake_mb,
            }
            (folder / "job.json").write_text(json.dumps(job))
            report, differs, omissions = _run(folder, source, out, time_limit_s, progress or (lambda doing: None))
            with output_errors(temporary):
                shutil.copyfile(folder / "scene.glb", temporary)
    reasons, duration = report.pop("unbaked"), report["duration_s"]
    plain: Tree = {key: tuple(value) if isinstance(value, list) else value for key, value in report.items()}
    return Imported(
        path=out,
        wrong=tuple(_as_line(name, *differs[name], duration, reasons.get(name, "")) for name in differs),
        omissions=tuple(line.replace("scene.glb", out.name) for line in omissions),
        **plain,
    )


def _as_line(name: str, distance: float, share: float, duration_s: float, reason: str) -> str:
    """Return what is wrong with a thing, for how long, and why."""
    shown = "is missing, or shown too much" if distance >= 1 else f"is off by up to {100 * distance:.2g} % of its size"
    shown = f"as glTF exports it {shown}" if reason else shown
    return f"'{name}' {shown}, for {share * duration_s:.2g} of {duration_s:.2g} s" + (f" ({reason})" if reason else "")


def _check_options(source: Path, out: Path, frames, fps, keys_per_frame, bake_mb, time_limit_s) -> None:
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
        ("--bake-mb", bake_mb, 1, 100_000),
        ("--time-limit", time_limit_s, 1, 1e6),
    ):
        if not low <= value <= high:
            raise ConfigError("out of range", where=option, value=value, accepted=f"{low} to {high:g}")


def _run(
    folder: Path, source: Path, out: Path, limit_s: float, progress: Callable[[str], None]
) -> tuple[Tree, dict[str, Difference], tuple[str, ...]]:
    """Return (the report of Blender's side, which has written ``folder``/scene.glb; how that differs from what Blender
    sees; what of it is not drawn). The program asks for the comparison, as often as it has exported."""
    report, compared, glb = None, None, folder / "scene.glb"

    def differences(*against: Any) -> tuple[dict[str, Difference], int, tuple[str, ...]]:
        try:
            return compare(glb, *against)
        except BlinkGLError as error:
            raise AssetError(f"what Blender wrote cannot be read ({error.problem})", where=str(out)) from error

    with Blender(PROGRAM, folder, limit_s) as blender:
        for words in blender.answers():
            if "doing" in words:
                progress(words["doing"])
            # Blender waits for this answer before it bakes or ends.
            if "compare" in words:
                compared = differences(folder / "seen.npz", words["compare"], words["finest"])
                blender.tell({"differs": list(compared[0]), "denser": compared[1]})
            report = words.get("report", report)
        status = blender.status()
        if status or report is None or not glb.is_file():
            raise BlinkGLError(
                f"Blender {how_it_ended(status)} while {blender.doing}: {blender.last_words()}", where=str(source)
            )
    differs, _, omissions = compared or differences(None)
    return report, differs, omissions
