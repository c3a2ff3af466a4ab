"""Compare what BlinkGL writes with the sums that the repository keeps: did a change change anything?

    python -m blinkgl.tools.fingerprint            # against the kept sums; status 1 where bytes differ
    python -m blinkgl.tools.fingerprint --keep                # write the sums of this platform anew
    python -m blinkgl.tools.fingerprint --only wave,v2e       # some cases

``tests/fingerprint/cases.yaml`` has the cases: small pictures of every feature that a user was promised. The sums lie
beside it, one file for each rasteriser and NumPy version (:func:`platform_name`). So that they hold on every x86
processor, the program runs in a process whose NumPy and OpenBLAS use no AVX-512 (``PINNED``), which rounds the last
bit of a pose differently. Colour pictures have a sum for each processor vendor: llvmpipe makes the mip levels of sRGB
textures with the processor's approximate reciprocal square root, whose last bits are Intel's or AMD's own.

A sum covers the names and bytes of the files in one folder. ``manifest.json`` and ``config.yaml`` are left
out: they name versions and every key of the configuration, so that a removed key would change every case.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path

import cv2
import numpy as np

from blinkgl.config.reader import merge, read_table, to_yaml
from blinkgl.config.run import load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.events.table import EMULATORS
from blinkgl.gl import create_context
from blinkgl.io.formats import convert
from blinkgl.io.reading import Declared
from blinkgl.layouts.export import LAYOUTS, export_layout
from blinkgl.machine.cpu import cpu_field
from blinkgl.recordings.simulation import file_to_events
from blinkgl.types.trees import Tree

HERE = Path(__file__).resolve().parents[1] / "tests" / "fingerprint"
PINNED = {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR"}
COLOUR = re.compile(r"(^|/)(images|clean|sharp|ev_inf|rgb|frame_camera|mvsec/train|intervals/train)$")
"""Folders of colour pictures, whose sums are kept for each processor vendor."""
GroupSums = dict[str, str | dict[str, str]]
NOT_DATA = re.compile(r"(^|/)(manifest\.json|config\.yaml|rig\.yaml|README\.md|\.run/.*)$")


def platform_name() -> str:
    """Return the name of what decides the bytes beside this program: the rasteriser and NumPy's version."""
    with create_context() as gl:
        drawn_by = f"{gl.renderer} {gl.version}"
    return re.sub(r"[^A-Za-z0-9.]+", "-", f"{drawn_by} numpy-{np.__version__}").strip("-")


def sums(folder: Path) -> dict[str, str]:
    """Return a SHA-256 sum (its first 16 digits) for each folder below ``folder`` that directly holds data files."""
    digests: dict[str, hashlib._Hash] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not NOT_DATA.search(name):
            whole = digests.setdefault(path.relative_to(folder).parent.as_posix(), hashlib.sha256())
            # A zero ends the name, and a hash of fixed length follows: no other files give the same input.
            whole.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return {name: whole.hexdigest()[:16] for name, whole in digests.items()}


@functools.cache
def table() -> Tree:
    """Return what cases.yaml says."""
    return read_table(HERE / "cases.yaml")


def assets(folder: Path) -> None:
    """Write the files that cases name: a clip, pictures, a panorama, a trajectory, a skinned mesh that morphs."""
    clip = folder / "clip" / "image_left"
    clip.mkdir(parents=True)
    y, x = np.mgrid[:36, :48].astype(np.float64)
    for k in range(12):
        picture = 128 + 90 * np.sin((x + 1.3 * k) / 5) * np.cos((y - 0.4 * k) / 7)
        cv2.imwrite(str(clip / f"{k:06d}.png"), np.round(picture).astype(np.uint8))
    waves = np.stack([128 + 60 * np.sin(x / 3), 128 + 60 * np.cos(y / 4), np.full_like(x, 230)], axis=-1)
    cv2.imwrite(str(folder / "bumps.png"), np.round(waves[..., ::-1]).astype(np.uint8))
    cv2.imwrite(str(folder / "mask.png"), np.where((x // 8 + y // 8) % 3 == 0, 0, 255).astype(np.uint8))
    sky = np.repeat((1 + np.sin(x / 3) * np.cos(y / 3))[:24, :, None], 3, axis=2)
    cv2.imwrite(str(folder / "sky.hdr"), sky.astype(np.float32))
    poses = [f"{t / 10:.6f} {-3 + t / 40} {t / 20} 1 -0.5 0.5 -0.5 0.5" for t in range(-2, 5)]
    (folder / "path.txt").write_text("\n".join(poses) + "\n", encoding="utf-8")
    shutil.copy(HERE / "arm.glb", folder)
    (folder / "configs").mkdir()
    shutil.copytree(str(resources.files("blinkgl.configs") / "scenes"), folder / "configs" / "scenes")


def recipe_of(name: str, scratch: Path) -> Path:
    """Write the recipe of the case ``name`` beside its assets and return its path."""
    recipe = scratch / "recipe.yaml"
    case, base = table()["cases"][name], table()["base"]
    if "from" in case.get("scene", {}):  # a whole scene: nothing of the base's is laid over it
        base = {key: value for key, value in base.items() if key != "scene"}
    recipe.write_text(to_yaml(merge(base, case)), encoding="utf-8")
    return recipe


def generated(name: str, scratch: Path, overrides: Sequence[str] = ()) -> Path:
    """Generate the case ``name`` and return the folder of the data set."""
    for _ in generate_run(load_run(recipe_of(name, scratch), overrides), scratch / "out"):
        pass
    return scratch / "out"


def simulated(scratch: Path) -> Path:
    """Turn a folder of frames into events with each emulator, and the events into other formats."""
    out = scratch / "out"
    for emulator in EMULATORS:
        clip = scratch / "clip" / "image_left"
        file_to_events(clip, out / f"{emulator}.npz", declared=Declared(fps=100), emulator=emulator, seed=3)
    for name in ("a.h5", "b.txt", "c.raw", "d.npy"):
        convert(out / "esim.npz", out / "formats" / name)
    return out


def exported(scratch: Path) -> Path:
    """Export a rig and a single camera in the layouts that take them."""
    for case in ("labels", "stereo"):
        inner = scratch / case
        inner.mkdir()
        assets(inner)
        data = generated(case, inner)
        for layout in (name for name in LAYOUTS if name != "rosbag"):  # needs an extra
            try:
                export_layout(data, scratch / "out" / case / layout, layout)
            except Exception as error:  # noqa: BLE001 - what a layout refuses is part of the fingerprint
                refused = scratch / "out" / case / f"{layout}.refused"
                refused.parent.mkdir(parents=True, exist_ok=True)
                refused.write_text(type(error).__name__, encoding="utf-8")
    return scratch / "out"


OTHERS: dict[str, Callable[[Path], Path]] = {"simulate": simulated, "export": exported}


def names() -> list[str]:
    """Return the names of all cases."""
    return [*table()["cases"], *OTHERS]


def fingerprint(name: str) -> dict[str, str]:
    """Return the sums of one case, by folder of its output."""
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        assets(scratch)
        return sums(OTHERS[name](scratch) if name in OTHERS else generated(name, scratch))


def kept(platform: str) -> dict[str, GroupSums]:
    """Return the sums that the repository keeps of a platform, by case; empty where it keeps none."""
    try:
        return json.loads((HERE / "sums" / f"{platform}.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}


def differences(before: GroupSums, after: dict[str, str], vendor: str) -> list[str]:
    """Return the folders of one case whose sums differ; colour pictures count where this vendor's sum is kept."""

    def known(path: str) -> str | None:
        entry = before.get(path)
        return entry.get(vendor, after.get(path)) if isinstance(entry, dict) else entry

    return [path for path in sorted(before.keys() | after) if known(path) != after.get(path)]


def renewed(before: GroupSums, after: dict[str, str], vendor: str) -> GroupSums:
    """Return the sums of one case as they are kept: another vendor's stay only beside an unchanged one of this."""

    def entry(path: str, made: str) -> str | dict[str, str]:
        known = before.get(path)
        others = known if isinstance(known, dict) and known.get(vendor, made) == made else {}
        return {**others, vendor: made} if COLOUR.search(path) else made

    return {path: entry(path, made) for path, made in after.items()}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", action="store_true", help="write the sums of this platform instead of comparing")
    parser.add_argument("--only", default="", help="names of cases, with commas between")
    options = parser.parse_args(arguments)
    if any(os.environ.get(name) != value for name, value in PINNED.items()):  # they count when NumPy is loaded
        command = [
            sys.executable,
            "-m",
            "blinkgl.tools.fingerprint",
            *(sys.argv[1:] if arguments is None else arguments),
        ]
        return subprocess.run(command, env={**os.environ, **PINNED}, check=False).returncode
    wanted = options.only.split(",") if options.only else names()
    platform, vendor = platform_name(), cpu_field("vendor_id")
    before = kept(platform)
    made, changed = {}, {}
    for name in wanted:
        made[name] = fingerprint(name)
        changed[name] = differences(before[name], made[name], vendor) if name in before else []
        print(f"{name}: {len(made[name])} folders", *changed[name], sep=f"\n  differs: {name}/", flush=True)
    if options.keep:
        file = HERE / "sums" / f"{platform}.json"
        file.parent.mkdir(exist_ok=True)
        new = {name: renewed(before.get(name, {}), sums, vendor) for name, sums in made.items()}
        known = before if options.only else {}
        file.write_text(json.dumps({**known, **new}, indent=1) + "\n", encoding="utf-8")
        return 0
    if unknown := [name for name in wanted if name not in before]:
        print(f"no sums are kept for {platform} of {', '.join(unknown)}; --keep writes them")
    return int(bool(unknown) or any(changed.values()))


if __name__ == "__main__":
    sys.exit(main())
