"""What seeds draw, in numbers: the same configuration and seed give the same world in every version.

    python -m blinkgl.tools.draws            # writes tests/golden/draws.json
    python -m blinkgl.tools.draws --check    # exit status 1 when that file is not what the code draws

Published data sets are made again from their recipes, so textures, bodies, motions, worlds and the emulators' noise
must not change by accident; when one is changed on purpose this file is written anew and its difference is reviewed. An
array is told by its shape and four numbers (mean, standard deviation, two projections) to six digits, so that the last
bits of another processor's libm do not matter; events, which are integers made by portable
arithmetic, are told exactly.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from blinkgl.config.camera import CameraConfig
from blinkgl.config.events import EmulatorConfig, EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.config.primitives import kinds
from blinkgl.config.problems import validate
from blinkgl.config.readout import ReadoutConfig
from blinkgl.config.scene import TEXTURE_KINDS, RandomSceneConfig
from blinkgl.events import Events, make_emulator
from blinkgl.events.camera import Readout
from blinkgl.scene.build import build_scene
from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.geometry.meshes import make_mesh
from blinkgl.scene.geometry.random_primitives import random_primitive
from blinkgl.scene.surfaces.coats import bunting, clothes, scales
from blinkgl.scene.surfaces.textures import procedural_texture
from blinkgl.scene.types import Scene

ROOT = Path(__file__).resolve().parent.parent
GOLDEN = ROOT / "tests" / "golden" / "draws.json"
END_NS = 400_000_000
TIMES_NS = np.array([0, 61_234_567, 200_000_000, 333_333_333, END_NS])
CLOSE, CLOSE_PIXELS = 2e-6, 1e-3
"""Relative to the larger of 1e-3 and the number; of pictures in [0, 1], whose pixels are rounded, absolute."""

WORLDS: dict[str, dict[str, object]] = {
    "default": {},
    "no sky": {"sky": None},
    "no ground, all flying": {"ground": None, "objects": {"count": 5, "flying": 1.0, "tint": 0.0}},
    "crowd": {
        "objects": {"count": 14, "size": [0.4, 1.0], "distance": [1.5, 6], "in_view": 0.5, "flying": 0.3},
        "region": {"width": 12, "height": 3},
    },
    "one sky": {
        "sky": {"per_face": False, "size": 60, "brightness": [0.5, 0.9], "repeat": [2, 5]},
    },
    "shaken": {
        "camera_motion": {"shake": 2.0, "rotation_rate": 90, "view_cone": 10, "roll": 3, "speed": [1, 2]},
        "object_motion": {"static_share": 0.5},
    },
    "winding": {
        "object_motion": {"waypoints": 3, "smoothness": 0.0, "speed": [2, 4], "rotation_rate": [400, 700]},
        "camera_motion": {"smoothness": 1.0, "waypoints": 9},
    },
    "still": {
        "camera_motion": {"kind": "static"},
        "object_motion": {"speed": 0, "rotation_rate": [30, 60]},
        "light": {"sun": 1.3, "sky": 0.2},
    },
    "unlit": {"light": {"unlit": True}, "object_motion": {"kind": "static"}, "camera_motion": {"rotation_rate": 0}},
}
EMULATORS: dict[str, EmulatorConfig] = {
    "esim": EsimConfig(),
    "esim spread, jitter": EsimConfig(
        contrast_threshold=0.15,
        contrast_threshold_off=0.25,
        threshold_sigma=0.05,
        threshold_jitter=0.1,
        refractory_us=900,
    ),
    "v2e": V2eConfig(),
    "v2e clean": V2eConfig(preset="clean"),
    "v2e noisy": V2eConfig(preset="noisy", hot_pixel_fraction=0.02),
    "v2e photoreceptor noise": V2eConfig(
        preset="noisy", shot_noise_rate_hz=40.0, photoreceptor_noise=True, cutoff_hz=40.0
    ),
    "voltmeter": VoltmeterConfig(),
    "voltmeter DVS240": VoltmeterConfig(preset="DVS240"),
}


def numbers_of(values: object) -> list[float]:
    """Shape, mean, standard deviation and two projections of an array."""
    a = np.asarray(values, np.float64)
    if not a.size:
        return [float(n) for n in a.shape]
    dice = np.random.default_rng(1)
    numbers = [a.mean(), a.std(), *(float(dice.uniform(-1, 1, a.size) @ a.ravel()) / np.sqrt(a.size) for _ in range(2))]
    return [*(float(n) for n in a.shape), *(float(f"{n:.8g}") for n in numbers)]


def mesh_numbers(mesh) -> list[float]:
    return [
        float(mesh.closed),
        *(n for part in (mesh.vertices, mesh.faces, mesh.normals, mesh.uvs) for n in numbers_of(part)),
    ]


def event_numbers(events: Events) -> list[int]:
    place = np.arange(len(events)) % 101
    return [
        len(events),
        *(int((column.astype(np.int64) * place).sum()) for column in (events.x, events.y, events.t, events.p)),
    ]


def scene_numbers(scene: Scene) -> Mapping[str, object]:
    camera = scene.camera
    table: dict[str, object] = {
        "log": list(scene.log),
        "light": numbers_of([*scene.light.sun_direction, scene.light.sun, scene.light.sky]),
        "camera": [
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            *numbers_of(scene.camera_path.poses(TIMES_NS)),
            *numbers_of(np.stack([scene.camera_path.derivative(int(t)) for t in TIMES_NS])),
        ],
    }
    for body in scene.objects:
        table[f"{body.instance_id} {body.category} {body.name}"] = [
            *numbers_of(body.path.poses(TIMES_NS)),
            *numbers_of(np.stack([body.path.derivative(int(t)) for t in TIMES_NS])),
            *(
                n
                for part in body.parts
                for n in (
                    *mesh_numbers(part.mesh),
                    *part.material.base_color,
                    *part.material.uv_scale,
                    float(part.material.unlit),
                    float(not part.culled),
                )
            ),
            *(part.material.texture.name for part in body.parts if part.material.texture),
        ]
    return table


def textures() -> Mapping[str, object]:
    return {
        f"{kind} {index}": numbers_of(procedural_texture(kind, index, 48).image / 255)
        for kind in TEXTURE_KINDS
        for index in range(6)
    }


def coats() -> Mapping[str, object]:
    """What people, flags and fish wear, averaged over patches of 32 px."""
    return {
        f"{coat.__name__} {seed}": numbers_of(coat(seed).reshape(16, 32, 16, 32, 3).mean(axis=(1, 3)) / 255)
        for coat in (clothes, bunting, scales)
        for seed in range(8)
    }


def bodies() -> Mapping[str, object]:
    return {
        f"{kind} {index}": mesh_numbers(random_primitive(kind, index)) for kind in kinds("pool") for index in range(3)
    }


def living() -> Mapping[str, object]:
    """People, flags and fish as they are bound, and where they are at other times."""
    keys = {
        "figure": [
            {},
            {"height": 1.1, "head": 1.4, "build": 1.3, "clip": "run"},
            {"clip": "wave"},
            *({"legs": 1.2, "clip": "dance", "variant": variant} for variant in range(8)),
        ],
        "flag": [{}],
        "fish": [{}, {"deep": 0.7}],
    }
    table = {}
    for kind, several in keys.items():
        for number, these in enumerate(several):
            mesh = BUILDERS[kind](**these)
            assert mesh.deformer is not None
            at = np.stack([mesh.deformer.positions(mesh, int(t)) for t in TIMES_NS])
            table[f"{kind} {number}"] = [*mesh_numbers(mesh), *numbers_of(at)]
    return table


def shapes() -> Mapping[str, object]:
    """Primitives of other parameters than the usual ones; meshes whose normals and texture
    coordinates are made here."""
    other = {
        "cuboid": dict(extents=(1.0, 2.0, 0.5), subdivisions=3),
        "cylinder": dict(radius=0.3, height=2.0, segments=7, rings=4),
        "sphere": dict(radius=2.0, segments=9, rings=5),
        "icosphere": dict(radius=1.5, subdivisions=2),
        "cone": dict(radius=0.7, height=0.4, segments=6, rings=3),
        "torus": dict(radius=2.0, tube=0.3, segments=8, tube_segments=5),
        "capsule": dict(radius=0.4, height=1.5, segments=7, rings=6),
        "prism": dict(sides=5, radius=1.2, height=0.6),
        "pyramid": dict(sides=3, radius=0.8, height=1.7),
        "grid": dict(width=2.0, depth=3.0, subdivisions=3),
    }
    table = {kind: mesh_numbers(BUILDERS[kind](**keys)) for kind, keys in other.items()}
    for kind in ("cuboid", "sphere", "prism", "torus"):
        mesh = BUILDERS[kind](**other[kind])
        for name, make in {"creased": make_mesh, "tiled": partial(make_mesh, uv_size=0.37)}.items():
            table[f"{kind} {name}"] = mesh_numbers(make(mesh.vertices, mesh.faces))
    return table


def worlds() -> Mapping[str, object]:
    camera = CameraConfig(width=96, height=72)
    return {
        name: scene_numbers(build_scene(world(keys), camera, 0, END_NS, seed=3, sequence=k))
        for k, (name, keys) in enumerate(WORLDS.items())
    }


def world(keys: dict[str, object]) -> RandomSceneConfig:
    return validate(
        RandomSceneConfig,
        {
            "kind": "random",
            "objects": {"count": 6},
            **keys,
            "textures": {"max_size": 32, "variants": 10, "photographs": False},
        },
    )


def clip(frames: int = 6, height: int = 37, width: int = 45) -> tuple[np.ndarray, np.ndarray]:
    """(frames, times ns) of a random walk of 8-bit codes, looked up in a table that
    is exact on every machine."""
    dice = np.random.default_rng(4)
    codes = np.clip(
        np.cumsum(
            dice.integers(-40, 41, (frames, height, width)) * (dice.random((frames, height, width)) < 0.5), axis=0
        )
        + 120,
        1,
        255,
    )
    return (
        (codes.astype(np.float32) / np.float32(256)) ** 2,
        7_123 + np.cumsum(dice.integers(10**6, 4 * 10**7, frames)),
    )


def events() -> Mapping[str, object]:
    frames, times = clip()
    table = {}
    for name, config in EMULATORS.items():
        emulator = make_emulator(config, frames.shape[1], frames.shape[2], 9)
        chunks = [emulator.step(f, int(t)) for f, t in zip(frames, times)]
        table[name] = event_numbers(Events.concatenate(chunks))
        bus = Readout(ReadoutConfig(events_per_second=100_000, queue_events=50, row_ns=300))
        sent = Events.concatenate([bus.step(chunk) for chunk in chunks])
        table[f"{name} read out"] = [*event_numbers(sent), bus.dropped]
    return table


PARTS = (textures, coats, bodies, living, shapes, worlds, events)


def drawn(parts=PARTS) -> Mapping[str, object]:
    """ "PART/NAME" -> what was drawn, as the golden file has it."""
    return {f"{part.__name__}/{name}": value for part in parts for name, value in part().items()}


def differences(golden: object, now: object, where: str = "") -> list[str]:
    """Where two tables say different things, one line each."""
    if isinstance(golden, dict) and isinstance(now, dict):
        lines = (
            [f"{where}: {', '.join(map(repr, sorted(golden.keys() ^ now.keys())))} only in one of them"]
            if golden.keys() != now.keys()
            else []
        )
        return lines + [
            line for key in golden.keys() & now.keys() for line in differences(golden[key], now[key], f"{where}/{key}")
        ]
    same = golden == now
    if isinstance(golden, list) and isinstance(now, list) and len(golden) == len(now):
        near = lambda a: CLOSE_PIXELS if where.startswith("/textures/") else CLOSE * max(abs(a), 1e-3)
        same = all(
            abs(a - b) <= near(a) if isinstance(a, float) and isinstance(b, float) else a == b
            for a, b in zip(golden, now)
        )
    return [] if same else [f"{where}: {golden!r} became {now!r}"]


def written(table: Mapping[str, object]) -> str:
    """As JSON, one line for each thing drawn."""
    lines = (
        f"{json.dumps(key, ensure_ascii=False)}: {json.dumps(value, ensure_ascii=False)}"
        for key, value in table.items()
    )
    return "{\n" + ",\n".join(lines) + "\n}\n"


def known() -> Mapping[str, object]:
    return json.loads(GOLDEN.read_text(encoding="utf-8"))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with the file instead of writing it")
    options = parser.parse_args(arguments)
    table = drawn()
    if options.check:
        lines = differences(known(), table)
        print(*lines, sep="\n")
        return 1 if lines else 0
    GOLDEN.write_text(written(table), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
