"""Random configurations, made from the models themselves: what is accepted can be drawn,
generated and verified; all else is one line.

    python -m blinkgl.tools.fuzz_configs [--seed 0] [--count 10000] [--runs 300] [--out out/fuzz_configs] [--json FILE]
    python -m blinkgl.tools.fuzz_configs --seed 0 --only read:317  # one again: its YAML, and its traceback

``read``: a configuration with any keys at any legal value, ends of ranges first, distributions anywhere, presets,
groups and --set overrides; half of them with one or two defects (a value out of range or of another type, a misspelt or
foreign key, a malformed distribution). It is read as ``blinkgl generate`` reads it, and if that accepts it, a dozen of
its sequences are drawn. ``run``: the same without defects, with sizes and durations forced so small that a sequence
takes a fraction of a second; what is accepted is generated and verified.

Everything but these is a defect, and exit status 1: an error that is no BlinkGLError, or has several lines; a refusal
of something that was accepted before (but for bodies that touch at the start, or find no free space: that is known when
the scene is built); a sequence that does not verify; a process that dies, needs more than --memory or more than --cpu
processor seconds. Each failure is printed with the command that repeats it, and its YAML is kept in OUT. The same seed
and version make the same configurations.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import math
import os
import random
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import typing
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import annotated_types
from rich.console import Console
from rich.table import Table

from blinkgl.config.base import is_model, members, tag_of
from blinkgl.config.draw import is_distribution
from blinkgl.config.quality import QUALITIES
from blinkgl.config.reader import to_yaml
from blinkgl.config.sensor import sensor_names
from blinkgl.config.sequence import SequenceConfig, load_run
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.machine.bench import machine_line
from blinkgl.machine.terminal import plain_console

DRAWS = 12
"""Sequences drawn of every accepted configuration."""
GOOD = ("made", "accepted", "refused")

_TEXTS = {
    "name": ["a", "flying_1", "x.y-z"],
    "path": ["scene.glb"],
    "file": ["m.obj"],
    "mesh": ["m", "n"],
    "material": ["m", None],
    "photograph": ["astronaut"],
    "texture": ["t.png"],
    "images": ["image_left", "."],
    "sensor": [*sensor_names(), "DAVIS-346"],
    "folders": ["frames"],
    "panoramas": [],
}
_WRONG = [
    None,
    True,
    -1,
    0,
    2.5,
    1e30,
    -1e30,
    float("nan"),
    float("inf"),
    10**30,
    "",
    "word",
    "1e-4",
    [],
    [1],
    {},
    {"x": 1},
    [[]],
    {"kind": "other"},
    "9" * 50,
]
_BAD_DISTRIBUTIONS = [
    {"uniform": [2, 1]},
    {"uniform": [1]},
    {"uniform": "ab"},
    {"log_uniform": [0, 1]},
    {"integer": [1, 2.5]},
    {"choice": []},
    {"weighted": {}},
    {"shares": [{"share": 0.5, "value": 1}]},
    {"uniform": [-1e308, 1e308]},
    {"integer": [0, 1e300]},
    {"choice": {"a": 1}},
]

# What keeps a run so small that a few hundred of them take minutes: (path, value or function of a random generator).
SMALL = {
    "output": {"sequences": 1},
    "gl": {},
    "preview.rate": 5.0,
    "preview.slowdown": 2.0,
    "camera.width": lambda r: r.choice([1, 2, 17, 24, 32]),
    "camera.height": lambda r: r.choice([1, 3, 16, 24]),
    "time": lambda r: {
        "duration": r.choice([0.02, {"uniform": [0.02, 0.03]}]),
        "label_rate": r.choice([50.0, {"integer": [50, 70]}]),
        "start": r.choice([0, 0.1, 1e6, {"uniform": [0, 5]}]),
    },
    "events.max_events_per_step": 100_000,
    "readout.queue_events": lambda r: r.choice([1, 16, 4096]),
    "images.times": None,
    "images.rate": lambda r: r.choice([50, {"uniform": [50, 100]}]),
    "images.exposure_us": lambda r: r.choice([500, {"uniform": [20, 2000]}]),
    "images.row_us": lambda r: r.choice([0, 10]),
    "images.max_instants": lambda r: r.choice([1, 2, {"integer": [1, 3]}]),
    "images.gain_db": lambda r: r.choice([0, {"uniform": [0, 20]}]),
    "images.gamma": 2.2,
    "images.also": lambda r: r.choice([[], ["clean"], {"choice": [["sharp"], ["clean", "sharp"]]}]),
    "images.auto_exposure": lambda r: r.choice([None, {"longest_us": 5000, "lag": {"uniform": [0, 1]}}]),
}
_TOGETHER = ("lens", "distortion", "fx", "fy", "calibration", "calibration_name")
"""Keys of a camera that make sense beside each other only."""
_RIG = ("rig", "sensors")
"""Keys beside which most others belong elsewhere."""
SMALL_TIMELINE = {
    "uniform": {"fps": lambda r: r.choice([20, 200, {"uniform": [50, 400]}])},
    None: {
        "min_step_us": lambda r: r.choice([1000, {"uniform": [800, 2000]}]),
        "max_step_us": lambda r: r.choice([4000, 20000]),
    },
}
SMALL_SCENE = {
    "objects.count": lambda r: r.choice([0, 1, 3, {"integer": [0, 3]}]),
    "pool": {"primitives": ["cuboid", "icosphere"], "variants": 2, "test_fraction": 0.5},
    "textures": {
        "procedural": ["perlin", "checks"],
        "variants": 2,
        "photographs": False,
        "max_size": 32,
        "test_fraction": 0.5,
    },
    "sky.panoramas": [],
    "sky.subdivisions": 2,
    "ground.subdivisions": 2,
    "object_motion.waypoints": 3,
    "camera_motion.waypoints": 3,
}


# --- configurations ---------------------------------------------------------------------------------------------------


@dataclass
class Case:
    """One configuration: a tree, and overrides as ``--set`` takes them."""

    tree: dict[str, Any]
    overrides: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        return to_yaml(self.tree)


class Maker:
    """Random trees of the models. eager : chance of a key to be said; ends : chance of an extreme value."""

    def __init__(self, rng: random.Random, eager: float, ends: float, draws: float):
        self.rng, self.eager, self.ends, self.draws = rng, eager, ends, draws

    def table(self, model: Any) -> dict[str, Any]:
        tree: dict[str, Any] = {}
        tag = tag_of(model)
        for name, info in model.model_fields.items():
            if tag is not None and name == tag[0]:
                if info.is_required() or self.rng.random() < 0.8:
                    tree[name] = tag[1]
            elif info.is_required() or self.rng.random() < self.eager:
                tree[name] = self.value(name, info.annotation, info.metadata)
        return self._consistent(tree)

    def _consistent(self, tree: dict[str, Any]) -> dict[str, Any]:
        """Of keys that exclude one another mostly one, and of ranges mostly what is in order."""
        for group in (
            ("fov", "focal"),
            ("quaternion", "euler", "look_at"),
            ("texture", "procedural", "photograph"),
            ("primitive", "file"),
            ("max_time_error_us", "max_time_error_px"),
        ):
            said = [key for key in group if tree.get(key) is not None]
            if len(said) > 1 and self.rng.random() < 0.9:
                for key in said[1:]:
                    del tree[key]
        if self.rng.random() < 0.97:
            for key in _TOGETHER:
                tree.pop(key, None)
        for low, high in (("min_step_us", "max_step_us"),):
            if all(isinstance(tree.get(k), (int, float)) for k in (low, high)) and self.rng.random() < 0.9:
                tree[low], tree[high] = sorted((tree[low], tree[high]))
        if isinstance(tree.get("keyframes"), list):
            for k, frame in enumerate(tree["keyframes"]):
                frame["time"] = k * 0.01
            for key in ("position", "quaternion", "euler", "look_at"):
                tree.pop(key, None)
        return tree

    def value(self, name: str, annotation: Any, metadata: Any = ()) -> Any:
        nullable = type(None) in typing.get_args(annotation)
        if nullable and self.rng.random() < 0.15:
            return None
        made = self._plain(name, self.rng.choice(members(annotation)), [*metadata, *_metadata(annotation)])
        if self.rng.random() < self.draws:
            return self._drawn(name, annotation, metadata, made)
        return made

    def _drawn(self, name: str, annotation: Any, metadata: Any, made: Any) -> Any:
        again = lambda: self._plain(name, self.rng.choice(members(annotation)), [*metadata, *_metadata(annotation)])
        other = again()
        if isinstance(made, int) and isinstance(other, int) and not isinstance(made, bool):
            return {"integer": sorted((made, other))}
        numbers = all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in (made, other))
        if numbers and self.rng.random() < 0.8:
            low, high = sorted((made, other))
            return {self.rng.choice(["uniform", "log_uniform"]) if low > 0 else "uniform": [low, high]}
        kind = self.rng.choice(["choice", "weighted", "shares"])
        if kind == "weighted" and isinstance(made, str):
            return {"weighted": {made: 3, **({other: 1} if isinstance(other, str) else {})}}
        if kind == "shares":
            return {"shares": [{"share": 0.25, "value": made}, {"share": 0.75, "value": other}]}
        return {"choice": [made, other, *([self.value(name, annotation, metadata)] if self.rng.random() < 0.3 else [])]}

    def _plain(self, name: str, annotation: Any, metadata: list[Any]) -> Any:
        rng = self.rng
        if is_model(annotation):
            return self.table(annotation)
        origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
        if origin is typing.Literal:
            return rng.choice(arguments)
        if origin is dict:
            return {
                key: self._plain(key, rng.choice(members(arguments[1])), [])
                for key in ("m", "n")
                if name != "parameters"
            }
        if origin in (tuple, list):
            if arguments[-1] is Ellipsis:
                least = next((m.min_length for m in metadata if isinstance(m, annotated_types.MinLen)), 0)
                return [
                    self.value(name, arguments[0], [])
                    for _ in range(rng.choice([least, 1, 2]) if name != "keyframes" else rng.choice([0, 2, 3]))
                ]
            made = [self._plain(name, rng.choice(members(a)), _metadata(a)) for a in arguments]
            return sorted(made) if len(made) == 2 and rng.random() < 0.9 else made
        if annotation is bool:
            return rng.random() < 0.5
        if annotation in (int, float):
            return self._number(annotation, metadata)
        return rng.choice(_TEXTS.get(name) or ["word"])

    def _number(self, kind: Any, metadata: list[Any]) -> Any:
        low, high = -1e3, 1e3
        for m in metadata:
            low = float(getattr(m, "ge", getattr(m, "gt", low)))
            high = float(getattr(m, "le", getattr(m, "lt", high)))
        if any(hasattr(m, "ge") or hasattr(m, "gt") for m in metadata) and not any(
            hasattr(m, "le") or hasattr(m, "lt") for m in metadata
        ):
            high = max(1e6, low * 10)
        rng = self.rng
        if rng.random() < self.ends:
            made = rng.choice([low, high])
            if any(hasattr(m, "gt") for m in metadata) and made == low:
                made = low + min(1e-3, 1e-3 * (high - low))
            if any(hasattr(m, "lt") for m in metadata) and made == high:
                made = high - 1e-3 * (high - low)
        elif low >= 0 and high / max(low, 1e-3) > 100:
            made = math.exp(rng.uniform(math.log(max(low, 1e-3)), math.log(max(min(high, 1e3), low * 10, 2e-3))))
        else:
            made = rng.uniform(low, high)
        made = min(max(made, low), high)
        return int(made) if kind is int else float(f"{made:.6g}") if low < float(f"{made:.6g}") < high else made


def _metadata(annotation: Any) -> list[Any]:
    if typing.get_origin(annotation) is typing.Annotated:
        base, *rest = typing.get_args(annotation)
        inner = [m for r in rest for m in getattr(r, "metadata", [r])]
        return [*inner, *_metadata(base)]
    return []


def make(seed: int, what: str, number: int) -> Case:
    """Configuration ``number`` of kind ``what`` ("read" or "run"); a function of its arguments."""
    rng = random.Random(f"{seed}/{what}/{number}")
    maker = Maker(rng, rng.choice([0.05, 0.15, 0.3, 0.6]), rng.choice([0.0, 0.1, 0.5]), rng.choice([0.0, 0.1, 0.3]))
    tree: dict[str, Any] = {}
    for name, info in SequenceConfig.model_fields.items():
        if rng.random() < (
            0.02
            if name in _RIG
            else 0.15
            if name in ("frames", "quality", "sensor", "readout", "gl", "output", "images", "imu", "tracks")
            else 0.5
        ):
            models = [m for m in members(info.annotation) if is_model(m)]
            if name == "scene" and rng.random() < 0.7:
                models = models[:1]
            tree[name] = (
                maker.table(rng.choice(models))
                if models and rng.random() < 0.85
                else maker.value(name, info.annotation, info.metadata)
            )
    for name in ("seed", "gl", "output"):
        if _has_distribution(tree.get(name)):
            del tree[name]
    if rng.random() < 0.2:
        tree["quality"] = rng.choice([*QUALITIES, {"choice": ["fast", "accurate"]}])
    case = Case(tree)
    if what == "run":
        _shrink(rng, tree)
        return case
    for _ in range(rng.choice([0, 0, 1, 2])):
        _damage(rng, tree)
    if rng.random() < 0.1:
        case.tree = {
            **tree,
            "groups": {
                "a": {},
                "b": {k: tree.pop(k) for k in list(tree)[:2]},
                **({"c": copy.deepcopy(rng.choice(_WRONG))} if rng.random() < 0.2 else {}),
            },
        }
    if rng.random() < 0.15:
        paths = [p for p in _paths(SequenceConfig) if p]
        for _ in range(rng.choice([1, 2])):
            text = (
                to_yaml(rng.choice([*_WRONG[:-1], 1, 0.5, {"uniform": [1, 2]}])).strip().removesuffix("\n...").strip()
            )
            case.overrides.append(".".join(rng.choice(paths)) + "=" + text)
    return case


def _has_distribution(node: Any) -> bool:
    from blinkgl.config.corners import sites

    return bool(sites(node))


def _paths(model: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    yield path
    for name, info in model.model_fields.items():
        for member in members(info.annotation):
            if is_model(member):
                yield from _paths(member, (*path, name))
            else:
                yield (*path, name)


def _places(node: Any, path: tuple = ()) -> Iterator[tuple]:
    if path:
        yield path
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield from _places(value, (*path, key))


def _damage(rng: random.Random, tree: dict[str, Any]) -> None:
    """One defect at a random place of ``tree``."""
    places = list(_places(tree))
    if not places:
        tree[rng.choice(["seed", "camera", "scene", "wrong", "uniform"])] = copy.deepcopy(rng.choice(_WRONG))
        return
    path = rng.choice(places)
    node: Any = tree
    for step in path[:-1]:
        node = node[step]
    what = rng.choice(["wrong", "wrong", "misspelt", "distribution", "gone", "scaled"])
    if what == "misspelt" and isinstance(node, dict):
        node[str(path[-1])[:-1] + rng.choice("xyz_")] = node.pop(path[-1])
    elif what == "gone" and isinstance(node, dict):
        del node[path[-1]]
    elif what == "distribution":
        node[path[-1]] = copy.deepcopy(rng.choice(_BAD_DISTRIBUTIONS))
    elif what == "scaled" and isinstance(node[path[-1]], (int, float)):
        node[path[-1]] = node[path[-1]] * rng.choice([-1, 1e3, 1e-3, 1e9])
    else:
        node[path[-1]] = copy.deepcopy(rng.choice(_WRONG))


def _shrink(rng: random.Random, tree: dict[str, Any]) -> None:
    """Forces what decides the cost of a run; the rest stays as it is."""
    for node in (tree, tree.get("scene")):
        for key in (
            [k for k, v in node.items() if is_distribution(v)]
            if isinstance(node, dict) and not is_distribution(node)
            else []
        ):
            if key in (
                "camera",
                "timeline",
                "scene",
                "objects",
                "sky",
                "ground",
                "camera_motion",
                "object_motion",
                "meshes",
            ):
                del node[key]
    if isinstance(tree.get("camera"), dict):
        for key in ("near", "fov", "focal", "cx", "cy"):
            if rng.random() < 0.7:
                tree["camera"].pop(key, None)
    for path, value in SMALL.items():
        top = path.split(".")[0]
        if "." not in path or top == "camera" or (isinstance(tree.get(top), dict) and not _has_distribution(tree[top])):
            _put(tree, path, value(rng) if callable(value) else value)
        elif top in tree:
            del tree[top]
    timeline = tree.get("timeline")
    if (
        not isinstance(timeline, dict)
        or _has_distribution({"x": timeline.get("kind")})
        or (len(timeline) == 1 and _has_distribution(timeline))
    ):
        timeline = tree["timeline"] = {"kind": rng.choice(["uniform", "displacement", "brightness"])}
    quality = tree.get("quality") is not None
    for key, value in SMALL_TIMELINE["uniform" if timeline.get("kind", "displacement") == "uniform" else None].items():
        timeline[key] = value(rng)
    if quality and timeline.get("kind") == "uniform":
        tree.pop("quality")
    scene = tree.get("scene")
    if (
        isinstance(scene, dict)
        and scene.get("kind") == "explicit"
        and not _has_distribution({"x": scene.get("meshes")})
    ):
        scene["meshes"] = {
            "m": {"primitive": rng.choice(["cuboid", "cone", "torus"])},
            "n": {"primitive": "icosphere", "parameters": {"subdivisions": 1}},
        }
        scene["materials"] = {"m": {"procedural": rng.choice(["perlin", "dots"]), "max_size": 32}}
    else:
        scene = tree["scene"] = (
            scene if isinstance(scene, dict) and scene.get("kind", "random") == "random" and len(scene) > 1 else {}
        )
        for path, value in SMALL_SCENE.items():
            top, _, rest = path.partition(".")
            if not rest or isinstance(scene.setdefault(top, {}), dict):
                _put(scene, path, value(rng) if callable(value) else value)
    if tree.get("frames") is not None:
        tree["frames"] = {
            **(tree["frames"] if isinstance(tree["frames"], dict) and not _has_distribution(tree["frames"]) else {}),
            "folders": ["frames"],
            "images": "images",
            "flow": None,
            "first": 0,
            "count": rng.choice([None, 3, 5]),
            "fps": rng.choice([10, {"uniform": [10, 100]}]),
            "max_px": 1.0,
        }


def _put(tree: dict[str, Any], path: str, value: Any) -> None:
    *outer, last = path.split(".")
    for key in outer:
        if not isinstance(tree.get(key), dict):
            tree[key] = {}
        tree = tree[key]
    tree[last] = value


# --- trying one -------------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """kind : made, accepted, refused (all is well); else late, unclean, bug, lines, died, slow (a defect)."""

    what: str
    number: int
    kind: str
    message: str = ""
    cpu_s: float = 0.0
    detail: str = ""

    @property
    def good(self) -> bool:
        return self.kind in GOOD


def attempt(what: str, number: int, case: Case, folder: Path, gl: Any = None) -> Outcome:
    """Reads (and for "run" generates and verifies) ``case`` below ``folder``. gl : an open context, for "run"."""
    path = folder / "config.yaml"
    path.write_text(case.text, encoding="utf-8")
    started, accepted = time.process_time(), False
    try:
        kind, message = "accepted", ""
        template = load_run(path, case.overrides)
        accepted = True
        _draw(template)
        if what == "run":
            kind = "made"
            accepted = False
            tasks = _planned(template)
            accepted = True
            message = _generate(template, tasks, folder, gl)
            kind = "made" if not message else "unclean"
    except BlinkGLError as error:
        geometry = isinstance(error, ConfigError) and error.where in ("scene", "scene.collisions")
        kind, message, detail = ("late" if accepted and not geometry else "refused"), str(error), traceback.format_exc()
        kind = "lines" if "\n" in message or len(message) > 1000 else kind
        return Outcome(what, number, kind, message, time.process_time() - started, "" if kind == "refused" else detail)
    except MemoryError as error:
        return Outcome(
            what, number, "died", f"MemoryError {error}", time.process_time() - started, traceback.format_exc()
        )
    except Exception as error:  # noqa: BLE001 - what a fuzz is for
        return Outcome(
            what,
            number,
            "bug",
            f"{type(error).__name__}: {error}"[:300],
            time.process_time() - started,
            traceback.format_exc(),
        )
    return Outcome(what, number, kind, message, time.process_time() - started)


def _draw(template: Any) -> None:
    from blinkgl.config.recipe import all_groups

    for group in all_groups(template):
        for index in range(DRAWS):
            group.template.sequence(index)


def _planned(template: Any) -> Any:
    from blinkgl.dataset.plan import Plan

    plan = Plan.of(template)
    plan.check_assets()
    return plan


def _generate(template: Any, plan: Any, folder: Path, gl: Any) -> str:
    from blinkgl.dataset.generate import generate_sequence
    from blinkgl.dataset.verify import verify_dataset

    out = folder / "out"
    shutil.rmtree(out, ignore_errors=True)
    task = plan.tasks[0]
    generate_sequence(plan.config(task), task.index, out, gl, base=template.base)
    return "; ".join(
        f"{name}: {line}" for name, lines in verify_dataset(out).problems.items() for line in lines if name != "."
    )[:300]


def work(seed: int, memory_mb: int) -> None:
    """A worker: "what number" lines in, outcomes as JSON lines out."""
    os.environ.setdefault("LP_NUM_THREADS", "0")
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # nothing but answers goes to the parent
    gl = None
    with tempfile.TemporaryDirectory(prefix="fuzz_configs_") as name:
        folder = Path(name)
        for line in sys.stdin:
            what, number = line.split()
            if what == "run" and gl is None:
                from blinkgl.gl import create_context

                _frames(folder / "frames/images")
                gl = create_context().__enter__()
            _, hard = resource.getrlimit(resource.RLIMIT_AS)
            resource.setrlimit(resource.RLIMIT_AS, (_used() + memory_mb * 2**20, hard))
            outcome = attempt(what, int(number), make(seed, what, int(number)), folder, gl)
            resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
            answers.write(json.dumps(asdict(outcome)) + "\n")
            answers.flush()


def _used() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _frames(folder: Path) -> None:
    import cv2
    import numpy as np

    folder.mkdir(parents=True, exist_ok=True)
    picture = np.random.default_rng(0).integers(0, 255, (20, 24), dtype=np.uint8)
    for k in range(6):
        cv2.imwrite(str(folder / f"{k}.png"), np.roll(picture, k, axis=1))


class Worker:
    """A process that may die. ``try_one`` restarts it as often as it has to."""

    def __init__(self, seed: int, memory_mb: int, cpu_s: float):
        self.arguments = [
            sys.executable,
            "-m",
            "blinkgl.tools.fuzz_configs",
            "--worker",
            "--seed",
            str(seed),
            "--memory",
            str(memory_mb),
        ]
        self.cpu_s, self.process = cpu_s, None
        self.said = tempfile.TemporaryFile("w+")  # noqa: SIM115 - lives as long as the worker

    def try_one(self, what: str, number: int) -> Outcome:
        if self.process is None:
            self.process = subprocess.Popen(
                self.arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.said, text=True, bufsize=1
            )
        process = self.process
        with contextlib.suppress(BrokenPipeError):  # it is dead; what it said comes below
            process.stdin.write(f"{what} {number}\n")
            process.stdin.flush()
        first, started = None, time.monotonic()
        while not select.select([process.stdout], [], [], 1.0)[0]:
            spent = _cpu_seconds(process.pid)
            first = spent if first is None else first
            # A process that waits for ever uses no processor at all: clock time ends that, far beyond any load.
            if spent - first > self.cpu_s or time.monotonic() - started > 30 * self.cpu_s:
                self.close()
                return Outcome(what, number, "slow", f"more than {self.cpu_s:g} processor seconds")
        line = process.stdout.readline()
        if not line:
            status = process.wait()
            self.said.seek(0)
            said = self.said.read().strip()[-2000:]
            self.close()
            return Outcome(what, number, "died", f"exit status {status}", detail=said)
        return Outcome(**json.loads(line))

    def close(self) -> None:
        if self.process is not None:
            self.process.send_signal(signal.SIGKILL)
            self.process.wait()
            with contextlib.suppress(BrokenPipeError):
                self.process.stdin.close()
            self.process.stdout.close()
            self.process = None


def _cpu_seconds(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError):
        return 0.0


def fuzz(
    seed: int,
    count: int,
    runs: int,
    out: Path | None = None,
    *,
    memory_mb: int = 2000,
    cpu_s: float = 20.0,
    console: Console | None = None,
) -> dict[str, Any]:
    """Tries ``count`` configurations to read and ``runs`` to generate; returns the report.
    The failures' YAML goes to ``out``."""
    console = console or plain_console(quiet=True)
    worker = Worker(seed, memory_mb, cpu_s)
    outcomes: list[Outcome] = []
    try:
        for what, number in [*(("read", k) for k in range(count)), *(("run", k) for k in range(runs))]:
            outcome = worker.try_one(what, number)
            outcomes.append(outcome)
            if not outcome.good:
                command = f"python -m blinkgl.tools.fuzz_configs --seed {seed} --only {what}:{number}"
                console.print(f"{outcome.kind}: {outcome.message}\n    {command}", highlight=False, soft_wrap=True)
                if out is not None:
                    out.mkdir(parents=True, exist_ok=True)
                    case = make(seed, what, number)
                    (out / f"{what}_{number}.yaml").write_text(
                        f"# {command}\n# --set {case.overrides}\n# {outcome.kind}: {outcome.message}\n{case.text}"
                    )
    finally:
        worker.close()
    return {
        "seed": seed,
        "machine": machine_line(),
        "outcomes": {what: dict(Counter(o.kind for o in outcomes if o.what == what)) for what in ("read", "run")},
        "slowest_cpu_s": {
            what: max((o.cpu_s for o in outcomes if o.what == what), default=0.0) for what in ("read", "run")
        },
        "failures": [asdict(o) for o in outcomes if not o.good],
    }


def show(report: dict[str, Any], console: Console) -> None:
    table = Table(title=f"configurations, seed {report['seed']}", title_justify="left")
    for column in (
        "",
        "made and verified",
        "accepted and drawn",
        "refused in one line",
        "defects",
        "slowest, processor s",
    ):
        table.add_column(column, justify="left" if not column else "right")
    for what, kinds in report["outcomes"].items():
        bad = sum(n for kind, n in kinds.items() if kind not in GOOD)
        table.add_row(
            what, *(f"{kinds.get(kind, 0):,}" for kind in GOOD), str(bad), f"{report['slowest_cpu_s'][what]:.2f}"
        )
    console.print(table)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=10_000, help="configurations to read")
    parser.add_argument("--runs", type=int, default=300, help="configurations to generate and verify")
    parser.add_argument("--out", type=Path, help="folder for the YAML of failures")
    parser.add_argument("--json", type=Path, help="file for the report")
    parser.add_argument("--memory", type=int, default=2000, help="MB that one may need")
    parser.add_argument("--cpu", type=float, default=20.0, help="processor seconds that one may take")
    parser.add_argument("--only", help="read:N or run:N, this one alone, in this process")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.worker:
        work(options.seed, options.memory)
        return 0
    console = plain_console()
    if options.only:
        return _only(options.seed, *options.only.split(":"))
    report = fuzz(
        options.seed,
        options.count,
        options.runs,
        options.out,
        memory_mb=options.memory,
        cpu_s=options.cpu,
        console=console,
    )
    show(report, console)
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    return 1 if report["failures"] else 0


def _only(seed: int, what: str, number: str) -> int:
    case = make(seed, what, int(number))
    print(case.text + "".join(f"# --set {override}\n" for override in case.overrides))
    gl = None
    with tempfile.TemporaryDirectory(prefix="fuzz_configs_") as folder:
        if what == "run":
            from blinkgl.gl import create_context

            _frames(Path(folder) / "frames/images")
            gl = create_context().__enter__()
        outcome = attempt(what, int(number), case, Path(folder), gl)
    print(outcome.detail, f"{outcome.kind}: {outcome.message}", sep="\n")
    return 0 if outcome.good else 1


if __name__ == "__main__":
    sys.exit(main())
