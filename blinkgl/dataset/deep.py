"""Sequences compared with themselves, generated again (``verify --deep``)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from blinkgl.dataset.cross_checks import Known, Verification, guarded, made_with
from blinkgl.dataset.generate import generate_sequence
from blinkgl.dataset.run_folder import RunFolder, whole_set
from blinkgl.errors import BlinkGLError
from blinkgl.gl import GLContext, create_context
from blinkgl.io.records import shown
from blinkgl.sequence_files.sequence_dir import MANIFEST, read_manifest

_SAME_ANYWHERE = (
    "split",
    "seed",
    "sequence",
    "emulator",
    "labels",
    "duration_us",
    "t_offset_us",
    "height",
    "width",
    "objects",
    "source",
)
"""Entries of a manifest that do not depend on the renderer and libraries."""


def made_again(
    root: Path,
    chosen: dict[str, Known],
    result: Verification,
    base: str | Path | None,
    progress: Callable[[int, str], None] | None,
) -> None:
    """Generate ``chosen`` again, in one OpenGL context; differences go to ``result``.   base : folder that relative
    paths start from; None: the run's.   progress : called with a count and a name, or None."""
    gl: GLContext | None = None
    if base is None:
        base = "."
        with suppress(BlinkGLError):  # a damaged record has been reported
            base = (RunFolder(whole_set(root)).read("run.json") or {}).get("base", ".")
    with tempfile.TemporaryDirectory(prefix="blinkgl-verify-") as scratch:
        try:
            for name, one in chosen.items():
                if progress:
                    progress(result.sequences, "again: " + shown(name))

                def again(name: str = name, one: Known = one) -> list[str]:
                    nonlocal gl
                    if one.config.frames is None and gl is None:
                        gl = create_context(one.config.gl.backend, one.config.gl.device)
                    made = generate_sequence(one.config, one.manifest["sequence"], scratch, gl, base=Path(base)).path
                    try:
                        result.deep.append(name)
                        return _compared(name, one, made, result)
                    finally:
                        shutil.rmtree(made)

                lines = guarded(again)
                result.add(name, lines if name in result.deep else [f"cannot be made again: {line}" for line in lines])
        finally:
            if gl is not None:
                gl.release()


def _compared(name: str, one: Known, made: Path, result: Verification) -> list[str]:
    """Return the differences of the sequence from itself generated again: bit by bit, or as far as two machines can
    agree."""
    lines = differences(one.folder, made)
    if one.manifest["format_version"] == 1:  # those have no hash of themselves
        lines = [line for line in lines if not line.endswith(f"{MANIFEST}: differs")]
    if not lines:
        return []
    manifest = read_manifest(made)
    if not (apart := _apart(one.manifest, manifest)):
        return [f"made again, {line}" for line in lines]
    result.in_part.append(name)
    problems = [
        f"made again, {MANIFEST}: {key} differs" for key in _SAME_ANYWHERE if one.manifest.get(key) != manifest.get(key)
    ]
    problems += [f"made again, {line}" for line in lines if line.endswith("only in one of them")]
    result.notes.append(f"{shown(name)}: {apart}; the bytes of its files were not compared")
    return problems


def _apart(one: dict[str, object], other: dict[str, object]) -> str:
    """Return what may make the bytes of two machines differ; "" where nothing does."""
    mine, here = ({"BlinkGL": manifest.get("blinkgl"), **made_with(manifest)} for manifest in (one, other))
    different = [k for k in mine.keys() | here.keys() if mine.get(k) != here.get(k)]
    return "; ".join(
        f"made with {k} {shown(mine.get(k))}, this machine has {shown(here.get(k))}" for k in sorted(different)
    )


def differences(a: Path, b: Path) -> list[str]:
    """Return files in which two folders differ, one line each."""
    names = [{p.relative_to(f).as_posix() for p in f.rglob("*") if p.is_file()} for f in (a, b)]
    lines = [f"{shown(name)}: only in one of them" for name in sorted(names[0] ^ names[1])]
    return lines + [
        f"{shown(name)}: differs"
        for name in sorted(names[0] & names[1])
        if (a / name).read_bytes() != (b / name).read_bytes()
    ]
