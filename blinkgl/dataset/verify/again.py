"""A sequence against itself made anew."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.run import load_run
from blinkgl.dataset.generate import generate_sequence
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.verify.between import comparable, first_difference, made_with
from blinkgl.dataset.verify.found import Known, Verification, guarded
from blinkgl.errors import BlinkGLError
from blinkgl.gl import GLContext, create_context
from blinkgl.io.records import shown
from blinkgl.labels import LABELS
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
"""Of a manifest: what no renderer and no library has a say in."""


_ENGINES = ("mujoco",)
"""Among the versions of a manifest: what computed the poses of falling bodies."""


def made_again(
    root: Path,
    chosen: dict[str, Known],
    result: Verification,
    base: str | Path | None,
    progress: Callable[[int, str], None] | None,
) -> None:
    """``chosen`` generated again, in one OpenGL context. What differs goes to ``result``.   base : folder that relative
    paths start from; None: the run's.   progress : called with a count and a name, or None."""
    gl: GLContext | None = None
    if base is None:
        base = "."
        with suppress(BlinkGLError):  # a damaged record has been reported
            base = (RunFolder(root).read("run.json") or {}).get("base", ".")
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
    """The sequence against itself made again: bit by bit, or as far as two machines can agree."""
    lines = differences(one.folder, made)
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
    depend = []
    for file in sorted(set(one.manifest["files"]) & set(manifest["files"])):
        if one.manifest["files"][file]["sha256"] != manifest["files"][file]["sha256"]:
            inside = next((camera for camera in manifest.get("cameras", ()) if file.startswith(camera + "/")), None)
            below, name_ = ("", file) if inside is None else (inside, file.removeprefix(inside + "/"))
            if (_moved_otherwise(one.manifest, manifest) and _follows_poses(name_)) or _agrees(
                name_, one.folder / below, made / below
            ):
                depend.append(file)
            else:
                problems.append(f"made again, {file}: differs by more than a renderer can")
    result.notes.append(
        f"{shown(name)}: {apart}; of {len(depend)} files that may depend on it the bytes were not compared: "
        + ", ".join(depend[:4])
        + (" …" if len(depend) > 4 else "")
    )
    return problems


def _apart(one: dict[str, Any], other: dict[str, Any]) -> str:
    """What may make the bytes of two machines differ; "" where nothing does."""
    mine, here = ({"BlinkGL": manifest.get("blinkgl"), **made_with(manifest)} for manifest in (one, other))
    different = [k for k in mine.keys() | here.keys() if mine.get(k) != here.get(k)]
    return "; ".join(
        f"made with {k} {shown(mine.get(k))}, this machine has {shown(here.get(k))}" for k in sorted(different)
    )


def _moved_otherwise(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether another engine, or another version of it, computed the poses of one of the two."""
    return any(made_with(one).get(name) != made_with(other).get(name) for name in _ENGINES)


def _follows_poses(file: str) -> bool:
    """Whether what the file says hangs on where things are, not only on what was asked for."""
    return file != "config.yaml" and not file.endswith(".txt")


def _agrees(file: str, one: Path, other: Path) -> bool:
    """Whether two machines' files of one name say the same, as far as machines can agree. True for what a renderer, a
    codec or a library may change in every byte."""
    a, b = one / file, other / file
    if file == "config.yaml":
        mine, here = (load_run(path) for path in (a, b))
        said = [comparable(run.sequence(run.check().output.first_index)) for run in (mine, here)]
        return not first_difference(said[0], said[1])
    if any(form.holds(file) for label in LABELS.values() for form in label.forms[1:]):
        return True  # says again what the first form does
    if file.endswith(".txt"):
        return False
    if file == "poses.npz":
        with np.load(a, allow_pickle=False) as p, np.load(b, allow_pickle=False) as q:
            return set(p.files) == set(q.files) and all(
                p[k].shape == q[k].shape
                and (
                    np.allclose(p[k], q[k], rtol=1e-9, atol=1e-9)
                    if p[k].dtype.kind == "f"
                    else np.array_equal(p[k], q[k])
                )
                for k in p.files
            )
    for label in LABELS.values():
        form = label.forms[0]
        if form.holds(file) and form.read is not None:
            return label.agrees(form.read(a), form.read(b))
    return True


def differences(a: Path, b: Path) -> list[str]:
    """Files in which two folders differ, one line each."""
    names = [{p.relative_to(f).as_posix() for p in f.rglob("*") if p.is_file()} for f in (a, b)]
    lines = [f"{shown(name)}: only in one of them" for name in sorted(names[0] ^ names[1])]
    return lines + [
        f"{shown(name)}: differs"
        for name in sorted(names[0] & names[1])
        if (a / name).read_bytes() != (b / name).read_bytes()
    ]
