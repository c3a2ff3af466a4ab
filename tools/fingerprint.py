"""What a dozen small configurations write, as SHA-256 sums: did a change change anything?

    python -m blinkgl.tools.fingerprint --out before.json        # at one commit
    python -m blinkgl.tools.fingerprint --against before.json    # at another, on the same machine

The second exits with status 1 where bytes differ.

All timelines, emulators, anti-aliasing settings, reconstructions, labels, sensors, level of detail, a still camera,
converted frames and ``simulate`` take part. Sums of two machines differ (processor, driver, versions are in the
manifests), so none are kept in the repository.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from blinkgl.config.reader import to_yaml
from blinkgl.config.sequence import LabelsConfig, load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.events.table import EMULATORS
from blinkgl.machine.bench import machine_line

BASE = {
    "seed": 5,
    "camera": {"width": 96, "height": 72},
    "time": {"duration": 0.1, "label_rate": 20},
    "scene": {
        "kind": "random",
        "objects": {"count": 4, "distance": [1.5, 5]},
        "pool": {"urdfs": False},
        "textures": {"variants": 12, "photographs": False, "max_size": 128},
    },
    "labels": {
        "flow": ["forward", "backward"],
        **{
            name: True
            for name, info in LabelsConfig.model_fields.items()
            if info.annotation is bool and name != "disparity"  # which needs another eye
        },
    },
}
STILL = "scene.camera_motion={speed: 0, rotation_rate: 0}"
CASES: dict[str, list[str]] = {
    "default": [],
    "no_quality": ["quality=null"],
    "uniform": ["timeline={kind: uniform, fps: 400}", "labels.float_flow=[npy, flo, h5]"],
    "peak": ["timeline={kind: displacement, max_px: 1, percentile: 90, max_px_peak: 3}"],
    "brightness": ["timeline={kind: brightness, max_fraction_of_threshold: 2}", "render.antialiasing=taps4"],
    "budget": ["timeline={kind: budget, max_time_error_us: 300}", "render.antialiasing=msaa4"],
    "pchip": ["timeline={kind: uniform, fps: 300, reconstruction: pchip}", "render.antialiasing=ssaa2"],
    "hermite": ["timeline={kind: displacement, max_px: 1.5, reconstruction: hermite}", "render.antialiasing=ssaa4"],
    "v2e": ["events={emulator: v2e, preset: noisy}", "render.mip_bias=-1"],
    "v2e_clean": ["events={emulator: v2e, preset: clean}", "render.anisotropy=4"],
    "voltmeter": ["events={emulator: voltmeter, preset: DVS346}"],
    "sensor": ["sensor=davis346", "camera.width=96", "camera.height=72", "readout.events_per_second=200000"],
    "fast": ["quality=fast"],
    "balanced": ["quality=balanced", "scene.ground=null"],
    "lod": ["render.lod={enabled: true}"],
    "still": [STILL, "render.antialiasing=ssaa2"],
    "still_hermite": [STILL, "timeline={kind: uniform, fps: 200, reconstruction: hermite}"],
    "esim_noisy": [
        "events={emulator: esim, contrast_threshold: {uniform: [0.1, 0.3]}, threshold_sigma: 0.05, refractory_us: 300}"
    ],
}


def sums(folder: Path) -> dict[str, str]:
    """Path below the folder -> SHA-256 of the file."""
    return {
        p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def sequence(overrides: list[str], scratch: Path) -> dict[str, str]:
    """One rendered sequence of BASE with overrides."""
    recipe = scratch / "recipe.yaml"
    recipe.write_text(to_yaml(BASE))
    for _ in generate_run(load_run(recipe, overrides), scratch / "out"):
        pass
    return sums(scratch / "out")


def frames(scratch: Path) -> dict[str, str]:
    """A folder of frames, converted by ``generate`` and by ``simulate`` with each emulator."""
    import cv2

    from blinkgl.recordings.simulation import file_to_events

    folder = scratch / "clip" / "image_left"
    folder.mkdir(parents=True)
    y, x = np.mgrid[:48, :64].astype(np.float64)
    for k in range(12):
        picture = 128 + 90 * np.sin((x + 1.3 * k) / 5) * np.cos((y - 0.4 * k) / 7)
        cv2.imwrite(str(folder / f"{k:06d}.png"), np.round(picture).astype(np.uint8))
    for emulator in EMULATORS:
        file_to_events(folder, scratch / "out" / f"{emulator}.npz", fps=100, emulator=emulator, seed=3)
    return sums(scratch / "out")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="where the sums go")
    parser.add_argument("--against", type=Path, help="sums of another commit")
    parser.add_argument("--only", default="", help="names of cases, with commas between")
    parser.add_argument("--keep", type=Path, help="a folder that keeps what was written")
    options = parser.parse_args(arguments)
    wanted = options.only.split(",") if options.only else [*CASES, "frames"]
    made: dict[str, dict[str, str]] = {}
    for name in wanted:
        with tempfile.TemporaryDirectory() as scratch:
            folder = options.keep / name if options.keep else Path(scratch)
            folder.mkdir(parents=True, exist_ok=True)
            made[name] = frames(folder) if name == "frames" else sequence(CASES[name], folder)
        print(f"{name}: {len(made[name])} files", flush=True)
    if options.out:
        options.out.write_text(json.dumps({"machine": machine_line(), "cases": made}, indent=1))
    if not options.against:
        return 0
    before = json.loads(options.against.read_text())["cases"]
    different = [
        f"{case}/{path}"
        for case in wanted
        for path in sorted(made[case].keys() | before.get(case, {}).keys())
        if made[case].get(path) != before.get(case, {}).get(path)
    ]
    print(f"{sum(map(len, made.values()))} files, {len(different)} differ", *different, sep="\n  ")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
