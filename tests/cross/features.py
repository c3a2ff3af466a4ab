"""The table of features: each top-level feature with its kinds, as changes of one tiny
configuration, and what may not be combined.

A *row* is one kind of every feature: a whole configuration. :func:`covering_rows` finds few rows in which any two kinds
of any two features meet. Whoever adds a feature adds its kinds to ``FEATURES``;
``test_cross.py`` says so when that was forgotten.
"""

from __future__ import annotations

import collections
import copy
import importlib.util
import itertools
import random
import typing
from typing import Any

from pydantic import BaseModel

from blinkgl.config.base import is_model, members
from blinkgl.config.quality import QUALITIES
from blinkgl.config.sequence import LabelsConfig, SequenceConfig

WIDTH, HEIGHT, FPS = 32, 24, 100
FILTERS = ("none", "edges", "edges2", "ssaa2", "ssaa4", "ssaa8")
OF_PAIRS = ("disparity",)
"""Labels of stereo pairs: tests/dataset/test_rig_runs.py."""
_POOLS = {
    "pool": {"primitives": ["cuboid", "sphere"], "variants": 8, "test_fraction": 0.3},
    "textures": {
        "procedural": ["checks", "fbm"],
        "variants": 8,
        "photographs": False,
        "max_size": 32,
        "test_fraction": 0.3,
    },
}
_FAST = {"speed": [2, 5], "rotation_rate": [60, 200]}
_RANDOM = {
    "kind": "random",
    **_POOLS,
    "objects": {"count": 3, "distance": [2, 5]},
    "camera_motion": _FAST,
    "object_motion": _FAST,
}
# To and fro about y = 0, once a second, so that things are in view at the late start, too.
_TO_AND_FRO = [(k / 4, (0, 1, 0, -1)[k % 4]) for k in range(17)]
_KEYED = {
    "keyframes": [{"time": t, "position": [0, 5 * y, 0.1]} for t, y in _TO_AND_FRO],
    "interpolation": "linear",
}
_CAMERA = {"keyframes": [{"time": t, "position": [-3, 2.2 * y, 0], "look_at": [0, 2.2 * y, 0]} for t, y in _TO_AND_FRO]}
_EXPLICIT = {
    "kind": "explicit",
    "meshes": {"box": {"primitive": "cuboid"}, "ball": {"primitive": "sphere"}},
    "materials": {"checks": {"procedural": "checks", "max_size": 32}},
    "objects": [{"mesh": "box", "material": "checks", **_KEYED}, {"mesh": "ball", "position": [1, 0, 0]}],
    "camera": _CAMERA,
}
_FILE = {"kind": "file", "path": "scene.glb", "pose": _CAMERA}
_FALLS = importlib.util.find_spec("mujoco") is not None
_LIVING = {  # figures, flags and fish among what deforms, falls and stands
    **_RANDOM,
    "pool": {
        **_POOLS["pool"],
        "primitives": ["cuboid", "sphere", "figure", "flag", "fish"],
        "variants": 3,
        "keep_materials": True,
    },
    "objects": {"count": 6, "distance": [1, 4], "deform": {"share": 0.7, "period": [0.05, 0.2]}},
    **({"physics": {"share": 0.5}} if _FALLS else {}),
}
_STEPS = {"clip": "run", "height": 0.8, "tempo": 2, "coat": 3}
_ALIVE = {  # one of everything that moves by itself, beside each other
    "kind": "explicit",
    "meshes": {
        "arm": {"file": "arm.glb"},
        "sheet": {"primitive": "cuboid", "parameters": {"extents": [0.1, 0.8, 0.8]}},
        "runner": {"primitive": "figure", "parameters": _STEPS},
        "ball": {"primitive": "icosphere"},
        "floor": {"primitive": "grid", "parameters": {"width": 9, "depth": 9}},
    },
    "materials": {"checks": {"procedural": "checks", "max_size": 32}},
    "objects": [
        {"mesh": "floor", "category": "ground", "position": [0, 0, -0.7], "material": "checks"},
        {"mesh": "arm", "animation": {"clip": "wave", "speed": 3}, "scale": 0.4, "position": [0, -0.9, 0]},
        {"mesh": "sheet", "material": "checks", "position": [0.3, 0.7, 0.2], "deform": {"kind": "wave", "period": 0.1}},
        {"mesh": "runner", "way": {"points": [[-0.5, 0.6, -0.7], [-0.5, -2, -0.7], [-0.7, -9, -0.7]]}},
        {
            "mesh": "ball",
            "material": "checks",
            "scale": 0.4,
            "position": [-0.6, 0, -0.4],
            **({"physics": {"velocity": [0, 2, -8]}} if _FALLS else {}),
        },
    ],
    **({"physics": {}} if _FALLS else {}),
    "camera": {"position": [-3, 0, 0], "look_at": [0, 0, 0]},
}

BASE = {
    "camera": {"width": WIDTH, "height": HEIGHT},
    "time": {"duration": 0.03, "label_rate": FPS},
    "scene": _RANDOM,
    "preview": {"enabled": False},
}


def _frames(**more: Any) -> dict[str, Any]:
    return {"frames": {"folders": ["P*"], "fps": FPS, **more}}


NOTHING: dict[str, Any] = {}
_SENSOR = {
    "name": "of one's own",
    "width": 20,
    "height": 16,
    "emulators": {"esim": {"contrast_threshold": 0.25}, "v2e": {"cutoff_hz": 100}, "voltmeter": {"k1": 4}},
    "frame_gamma": "linear",
    "readout": {"clock_us": 5},
}
FEATURES: dict[str, dict[str, dict[str, Any]]] = {
    "source": {
        "random": NOTHING,
        "still camera": {"scene": {"camera_motion": {"kind": "static"}}},
        "explicit": {"scene": _EXPLICIT},
        "file": {"scene": _FILE},
        "living": {"scene": _LIVING},
        "explicit, alive": {"scene": _ALIVE},
        "frames, motion": _frames(interpolate="motion", max_px=0.5),
        "frames, linear": _frames(
            interpolate="linear", flow="flow_flo", gamma="linear", range="limited", check_flow=False
        ),
        "frames, part": _frames(
            interpolate="linear", gamma="hlg", range="full", flow=None, first=1, count=4, keep_noise=True
        ),
    },
    "emulator": {
        "esim": {"events": {"emulator": "esim"}},
        "esim, noisy": {
            "events": {"emulator": "esim", "threshold_jitter": 0.05, "refractory_us": 50, "contrast_threshold_off": 0.3}
        },
        "v2e": {"events": {"emulator": "v2e"}},
        "v2e, clean": {"events": {"emulator": "v2e", "preset": "clean", "start": "zero"}},
        "v2e, noisy": {
            "events": {
                "emulator": "v2e",
                "preset": "noisy",
                "photoreceptor_noise": True,
                "cutoff_hz": 200,
                "hot_pixel_fraction": 0.01,
                "causes": True,
                "start": "balanced",
            }
        },
        "voltmeter": {"events": {"emulator": "voltmeter"}},
        "voltmeter, 240": {"events": {"emulator": "voltmeter", "preset": "DVS240", "causes": True, "k4": 1e-4}},
    },
    "timeline": {
        "uniform": {"timeline": {"kind": "uniform", "fps": 400}},
        "displacement": {"timeline": {"kind": "displacement", "max_px": 1}},
        "brightness": {"timeline": {"kind": "brightness"}},
        "unsaid": NOTHING,
    },
    "quality": {"unsaid": NOTHING, **{name: {"quality": name} for name in QUALITIES}},
    "sensor": {
        "unsaid": NOTHING,
        **{name: {"sensor": name} for name in ("davis346", "dvxplorer")},
        "a table": {"sensor": _SENSOR},
        "its frames are sRGB": {"sensor": {**_SENSOR, "frame_gamma": "srgb"}},
    },
    "readout": {
        "unsaid": NOTHING,
        "ample": {"readout": {"events_per_second": 1e9}},
        "slow": {"readout": {"events_per_second": 1e3, "row_ns": 50, "queue_events": 4}},
        "clock": {"readout": {"clock_us": 10}},
        "controlled": {"readout": {"roi": [1, 0, 4000, 4000], "max_rate": 1e6}},
        "resets": {"readout": {"frame_resets": {"interval_ms": 8, "kick": 1.2, "first_ms": 3}}},
        "pixels": {
            "readout": {
                "pixels": {"dead_fraction": 0.1, "hot_fraction": 0.02, "hot_rate_hz": 500, "rate_hz": 5},
            }
        },
    },
    "optics": {
        "none": NOTHING,
        "spread": {"optics": {"psf": {"kind": "gaussian", "sigma": 0.4}}},
        "filters": {"optics": {"bayer": "rggb", "lens": {"aperture": 0.05, "focus": 4.0}, "lens_points": 4}},
    },
    "anti-aliasing": {name: {"render": {"antialiasing": name}} for name in ("taps4", *FILTERS)},
    "images": {
        **{name: {"render": {"image_antialiasing": name}} for name in FILTERS},
        "no images": {"labels": {"images": False}},
    },
    "frame camera": {
        "none": NOTHING,
        "raw": {
            "images": {
                "preset": "raw",
                "rate": 50,
                "response": "linear",
                "photon_noise": True,
                "bayer": "bggr",
                "bits": 16,
                "max_instants": 2,
            }
        },
        "rolling, low light": {
            "images": {
                "preset": "low_light",
                "times": [0.006, 0.018],
                "exposure_us": 4000,
                "row_us": 100,
                "response": "gamma",
                "max_instants": 3,
                "also": ["sharp", "clean"],
            }
        },
        "automatic": {
            "images": {
                "preset": "deblurring",
                "rate": 120,
                "exposure_us": 2000,
                "max_instants": 2,
                "vignetting": 0.5,
                "bayer": "grbg",
                "lens": {"aperture": 0.05, "focus": 4.0},
                "auto_exposure": {"longest_us": 4000},
            }
        },
    },
    "textures": {
        "plain": NOTHING,
        "sharp": {"render": {"anisotropy": 4, "mip_bias": -1}},
        "drawn": {"render": {"mip_bias": {"uniform": [-1, 0]}}},
    },
    "light": {
        "lit": NOTHING,
        "unlit": {"scene": {"light": {"unlit": True}}},
        "shadows": {"scene": {"light": {"shadows": "soft", "shadow_size": 64}}},
        "flicker": {
            "scene": {
                "light": {
                    "over_time": {"kind": "sine", "frequency": 100, "depth": 0.2},
                    "lights": [
                        {
                            "kind": "point",
                            "motion": {"position": [0.5, 0.5, 2.0]},
                            "over_time": {"kind": "pwm", "frequency": 150},
                        }
                    ],
                }
            }
        },
        "lamps": {
            "scene": {
                "fog": {"density": 0.02},
                "light": {
                    "sky_color": [0.6, 0.8, 1.0],
                    "lights": [
                        {"kind": "point", "position": [0.5, 0.5, 2.0], "strength": 4, "color": [1.0, 0.7, 0.4]},
                        {"kind": "spot", "position": [0, 0, 4], "look_at": [1, 0, 0], "strength": 9},
                    ],
                },
            }
        },
    },
    "flow": {
        "forward": NOTHING,
        "all ways": {"labels": {"flow": ["forward", "backward", 0.004, -0.01]}},
        "backward": {"labels": {"flow": ["backward"]}},
        "none": {"labels": {"flow": []}},
    },
    "float flow": {"none": NOTHING, **{name: {"labels": {"float_flow": [name]}} for name in ("npy", "flo")}},
    "labels": {
        "default": NOTHING,
        "all": {
            "labels": {
                name: True
                for name, info in LabelsConfig.model_fields.items()
                if info.annotation is bool and name not in OF_PAIRS
            }
            | {"semantics": {"cuboid*": 7, "*": 1}}
        },
        "fewest": {"labels": {"occlusion": False, "semantics": True}},
    },
    "over time": {
        "nothing": NOTHING,
        "grid, noisy": {"tracks": {"points": 30, "choose": "grid"}, "imu": {"preset": "adis16448", "rate": 1000}},
        "surfaces, ideal": {"tracks": {"points": 20, "choose": "surface", "rate": 300}, "imu": {"rate": 90}},
        "drawn": {"tracks": {"points": {"integer": [5, 9]}}},
    },
    "preview": {"off": NOTHING, "on": {"preview": {"enabled": True, "rate": 100}}},
    "time": {
        "from 0": NOTHING,
        "late": {"time": {"start": 3.0}},
        "between microseconds": {"time": {"start": 7e-7, "label_rate": 90, "duration": 0.034}},
        "drawn": {"time": {"duration": {"uniform": [0.02, 0.03]}}},
    },
    "camera": {
        "default": NOTHING,
        "odd": {"camera": {"width": WIDTH - 1, "height": HEIGHT - 1, "focal": 30, "cx": 12.3}},
        "wide": {"camera": {"fov": 110, "near": 0.2}},
        "radtan, rectified": {
            "camera": {"fx": 30, "fy": 31, "cx": 15.0, "lens": "radtan", "distortion": [-0.2, 0.05, 0.001, 0]},
            "labels": {"pixels": "rectified"},
        },
        "fisheye": {"camera": {"lens": "equidistant", "distortion": [0.01, 0, 0, 0], "fov": 70}},
    },
    "output": {
        "train": NOTHING,
        "test": {"output": {"split": "test", "name": "probe", "first_index": 1, "compression": "lz4"}},
        "for h5py alone": {"output": {"compression": "gzip"}},
    },
    "seed": {"the group's": NOTHING, "its own": {"seed": 2**62 + 1}},
}
_RIGS = "every row may be a rig's sensor: tests/dataset/test_rig_runs.py, tests/config/test_rig_keys.py"
RUN_LEVEL = {
    "gl": "one OpenGL for all groups of a run; tests/gl tries the backends",
    "rig": _RIGS,
    "sensors": _RIGS,
}
"""Top-level keys that are no feature of a sequence."""

Kind = tuple[str, str]
REFUSED: dict[tuple[Kind, Kind], str] = {
    **{
        (("source", source), ("frame camera", camera)): "images: recorded frames are already images"
        for source in FEATURES["source"]
        if source.startswith("frames")
        for camera in FEATURES["frame camera"]
        if camera != "none"
    },
    **{
        (("source", source), ("optics", what)): "optics: recorded frames have come through their own lens"
        for source in FEATURES["source"]
        if source.startswith("frames")
        for what in FEATURES["optics"]
        if what != "none"
    },
    **{
        (("source", source), ("over time", what)): ("tracks" if what == "drawn" else "imu") + ": recorded frames do not"
        for source in FEATURES["source"]
        if source.startswith("frames")
        for what in FEATURES["over time"]
        if what != "nothing"
    },
    (("frame camera", "rolling, low light"), ("time", "late")): "images.times: an exposure outside the sequence",
}
"""Pairs that make no sense, and the line that says so. Recorded frames have neither a timeline nor a time: there those
are no contradiction."""

TOO_SLOW: set[tuple[Kind, Kind]] = {(("source", one), ("textures", "sharp")) for one in ("random", "still camera")}
"""Pairs that are accepted and left out of the rows: llvmpipe takes seconds for a picture of 32 x 24 px with anisotropy
where a ground ends at the horizon (the footprint of a pixel there is endless, and it adds up every texel of it)."""

OTHER_WAY: set[tuple[Kind, Kind]] = {
    (("source", one), ("flow", "backward")) for one in ("frames, motion", "frames, linear")
}
"""Pairs that set a sequence aside: the flow of a file leads forward (tests/sequence/test_flow_of_others.py)."""

ELSEWHERE = {
    "scene": "tests/scene: what a scene is made of; here only where it comes from, whether it is lit, whether the "
    "camera moves, and what moves by itself",
    "images": "tests/config/test_images.py, tests/imaging: every preset, every choice; here what is written and read",
    "optics": "tests/imaging/test_optics.py: every point spread and pattern; here what is written and read",
    "frames.flow_direction": "tests/sequence/test_flow_of_others.py: it has to go with `labels.flow`",
    "events.device": "tests/tensors/test_device_emulator.py: either device writes the same files",
    "events.threshold_map": "tests/dataset/test_threshold_maps.py: the file has the camera's size",
    "imu": "tests/sequence/test_inertial.py, tests/dataset/test_over_time.py; here what is written and read",
    **RUN_LEVEL,
}
_SCENE_HERE = {"scene.kind", "scene.light.unlit", "scene.camera_motion.kind"}


def merged(table: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    """``change`` laid over ``table``, key by key; a table of another kind replaces the one below."""
    made = copy.deepcopy(table)
    for key, value in change.items():
        below = made.get(key)
        if (
            isinstance(value, dict)
            and isinstance(below, dict)
            and value.get("kind", below.get("kind")) == below.get("kind")
        ):
            made[key] = merged(below, value)
        else:
            made[key] = copy.deepcopy(value)
    return made


def configuration(row: dict[str, str]) -> dict[str, Any]:
    """The tree of a row; features that it does not name are as in ``BASE``."""
    tree = BASE
    for feature in FEATURES:
        if feature in row:
            tree = merged(tree, FEATURES[feature][row[feature]])
    return tree


def refusal(row: dict[str, str]) -> str | None:
    """What is said when this row is given; None: it is accepted."""
    recorded = row.get("source", "").startswith("frames")
    return next(
        (
            line
            for (a, b), line in REFUSED.items()
            if row.get(a[0]) == a[1] and row.get(b[0]) == b[1] and (not recorded or a[0] == "source")
        ),
        None,
    )


def fits(row: dict[str, str]) -> bool:
    """Whether a row may be made here."""
    return refusal(row) is None and not any(
        row.get(a[0]) == a[1] and row.get(b[0]) == b[1] for a, b in (*TOO_SLOW, *OTHER_WAY)
    )


def pairs(row: dict[str, str]) -> set[tuple[Kind, Kind]]:
    return set(itertools.combinations(((f, row[f]) for f in FEATURES if f in row), 2))


def all_pairs() -> set[tuple[Kind, Kind]]:
    """Every pair of kinds of two features that is accepted by itself and not left out."""
    kinds = [(feature, kind) for feature, those in FEATURES.items() for kind in those]
    return {(a, b) for a, b in itertools.combinations(kinds, 2) if a[0] != b[0] and fits(dict((a, b)))}


def covering_rows(seed: int = 1, tries: int = 12) -> list[dict[str, str]]:
    """Rows, accepted each, in which every accepted pair meets. Greedy: each row begins with a pair that is missing and
    takes of every further feature the kind that brings most of those; the best of ``tries``
    orders. The same seed gives the same rows."""
    rng, missing, rows = random.Random(seed), sorted(all_pairs()), []
    contested = {kind for pair in (*REFUSED, *TOO_SLOW, *OTHER_WAY) for kind in pair}
    while missing:
        wanted = collections.defaultdict(set)
        for a, b in missing:
            wanted[a].add(b)
            wanted[b].add(a)
        best: tuple[int, dict[str, str]] = (-1, {})
        for _ in range(tries):
            row = dict(missing[rng.randrange(len(missing))])
            rest = [f for f in FEATURES if f not in row]
            rng.shuffle(rest)
            for feature in rest:
                taken = row.items()
                gain = {
                    kind: len(taken & wanted[feature, kind])
                    for kind in FEATURES[feature]
                    if (feature, kind) not in contested or fits({**row, feature: kind})
                }
                row[feature] = rng.choice([kind for kind, more in gain.items() if more == max(gain.values())])
            best = max(best, (len(pairs(row).intersection(missing)), row), key=lambda pair: pair[0])
        rows.append({f: best[1][f] for f in FEATURES})
        missing = sorted(set(missing) - pairs(rows[-1]))
    return rows


# ---- is the table whole? ---------------------------------------------------------------------------------------------


def options_of_the_schema() -> set[tuple[str, Any]]:
    """(dotted key, option) of every switch and every choice of the configuration, what is tested elsewhere left out."""
    found: set[tuple[str, Any]] = set()

    def literals(annotation: Any, path: str) -> None:
        if annotation is bool:
            found.update({(path, True), (path, False)})
        elif typing.get_origin(annotation) is typing.Literal:
            found.update((path, option) for option in typing.get_args(annotation))
        elif is_model(annotation):
            for one in members(annotation):  # a family has several
                model(one, path)
        else:
            for inner in typing.get_args(annotation):
                literals(inner, path)

    def model(kind: type[BaseModel], path: str) -> None:
        for name, field in kind.model_fields.items():
            literals(field.annotation, f"{path}.{name}" if path else name)

    model(SequenceConfig, "")
    return {
        (path, option)
        for path, option in found
        if not {path, path.split(".")[0]} & ELSEWHERE.keys() or path in _SCENE_HERE
    }


def options_of_the_table() -> set[tuple[str, Any]]:
    """(dotted key, value) of everything the table says, and of the schema's defaults."""
    found: set[tuple[str, Any]] = set()

    def walk(node: Any, path: str) -> None:
        if isinstance(node, dict):
            for key, value in node.items():
                walk(value, f"{path}.{key}" if path else key)
        elif isinstance(node, (list, tuple)):
            for value in node:
                walk(value, path)
        else:
            found.add((path, node))

    walk(SequenceConfig().model_dump(), "")
    walk(BASE, "")
    for change in (change for kinds in FEATURES.values() for change in kinds.values()):
        walk(change, "")
        for table in {"timeline", "events", "frames"} & change.keys():
            if table == "frames" or {"kind", "emulator"} & change[table].keys():
                walk(getattr(SequenceConfig.model_validate({table: change[table]}), table).model_dump(), table)
    return found
