"""Opens a file: .blend as Blender does but without its scripts and its windows, everything else into an empty scene."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import bpy
from said import Refused

_HEADER = re.compile(rb"BLENDER(?:[-_][vV](\d{3})|\d\d-\d\d[vV](\d{4}))")


def open_file(source: Path, fps: float | None) -> None:
    """The file as Blender's own data. Refused: not of its kind, damaged, or saved by a newer Blender."""
    ending = source.suffix.lower()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    # Whatever the defaults are: text blocks marked 'register' and drivers' expressions are never run.
    bpy.context.preferences.filepaths.use_scripts_auto_execute = False
    try:
        if ending == ".blend":
            check_version(blend_version(source))
            bpy.ops.wm.open_mainfile(filepath=str(source), load_ui=False, use_scripts=False)
            check_version(tuple(bpy.data.version[:2]))
        else:
            set_rate(24.0 if fps is None else fps)  # Alembic's seconds become frames while it is read
            done = _OPENERS[ending](str(source))
            if "FINISHED" not in done:
                raise Refused(f"Blender cannot read it as {ending[1:].upper()}", accepted="a whole file of that kind")
            if ending in (".fbx", ".dae"):
                fit_range()
    except RuntimeError as problem:  # what operators report as an error
        text = " ".join(str(problem).split()).removeprefix("Error: ")
        raise Refused(f"Blender cannot read it ({text[:200]})", accepted="a whole file") from problem
    if fps is not None:
        set_rate(fps)
    if bpy.context.preferences.filepaths.use_scripts_auto_execute:
        raise Refused("the file's scripts could not be switched off")


def set_rate(fps: float) -> None:
    """Frames per second of the scene, which Blender keeps as a whole number over a divisor."""
    render = bpy.context.scene.render
    render.fps = max(round(fps), 1)
    render.fps_base = render.fps / fps


def fbx(path: str) -> set[str]:
    """FBX of all versions, binary and text."""
    return bpy.ops.wm.fbx_import(filepath=path, use_anim=True, use_custom_props=False)


def usd(path: str) -> set[str]:
    """.usd, .usda, .usdc, .usdz, with their pictures inside."""
    return bpy.ops.wm.usd_import(filepath=path, import_textures_mode="IMPORT_PACK", set_frame_range=True)


def collada(path: str) -> set[str]:
    """.dae"""
    return bpy.ops.wm.collada_import(filepath=path)


def alembic(path: str) -> set[str]:
    """.abc"""
    return bpy.ops.wm.alembic_import(filepath=path, set_frame_range=True, as_background_job=False)


_OPENERS = {".fbx": fbx, ".dae": collada, ".abc": alembic, **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), usd)}


def fit_range() -> None:
    """The scene lasts as long as its actions, which importers of FBX and Collada do not say."""
    spans = [tuple(action.frame_range) for action in bpy.data.actions]
    if spans:
        scene = bpy.context.scene
        scene.frame_start = round(min(first for first, _ in spans))
        scene.frame_end = max(scene.frame_start, round(max(last for _, last in spans)))


def blend_version(source: Path) -> tuple[int, int] | None:
    """(4, 5) of a .blend file; None where it is packed in a way that cannot be looked into."""
    with open(source, "rb") as file:
        start = file.read(20)
    if start[:2] == b"\x1f\x8b":
        try:
            with gzip.open(source) as file:
                start = file.read(20)
        except (OSError, EOFError) as problem:
            raise Refused(f"the .blend file is damaged ({problem})") from problem
    elif start[:4] == b"\x28\xb5\x2f\xfd":
        try:
            import zstandard
        except ImportError:
            return None
        try:
            with open(source, "rb") as file:
                start = zstandard.ZstdDecompressor().stream_reader(file).read(20)
        except zstandard.ZstdError as problem:
            raise Refused(f"the .blend file is damaged ({problem})") from problem
    found = _HEADER.match(start)
    if not found:
        raise Refused("not a .blend file", accepted="a file saved by Blender")
    digits = int(found[1] or found[2])
    return digits // 100, digits % 100


def check_version(version: tuple[int, int] | None) -> None:
    """Refused: saved by a newer Blender than this one, which leaves out what it does not know without saying so."""
    here = tuple(bpy.app.version[:2])
    if version is not None and version > here:
        raise Refused(
            f"saved by Blender {version[0]}.{version[1]}, newer than the {here[0]}.{here[1]} that would open it",
            accepted=f"a file saved by Blender {here[0]}.{here[1]} or older (or export glTF from the newer one)",
        )
