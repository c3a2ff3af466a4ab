"""What bench.py can time, and the process that times it: a line in, a round of all rows out, as a line of JSON.

    python tools/bench_rows.py WHAT [--config FILE] [--set a.b=c …]

bench.py runs this file in every checkout, so the functions of theirs that are used here must agree.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING
from unittest.mock import patch

import numpy as np

if TYPE_CHECKING:
    from blinkgl.config.sequence import SequenceConfig
    from blinkgl.scene.types import Scene

SECOND = 1_000_000_000
HEIGHT, WIDTH, FPS = 480, 640, 1000
Row = Callable[[], "float | dict[str, float] | None"]
"""Does some work and returns how many units it was (frames, samples; None: one), or a dict of "units" and seconds of
parts."""
Rows = dict[str, Row]


def config_of(options: argparse.Namespace) -> Path:
    """The configuration to use: ``--config``, or the demo."""
    return Path(options.config or str(resources.files("blinkgl.configs") / "demo.yaml"))


# --- what can be timed ------------------------------------------------------------------------------------------------


def clip(kind: str, frames: int) -> np.ndarray:
    """(N, H, W) uint8: a photograph that rolls, moves and grows, 0.63 px a frame; ``mid`` is blurred (0.07 events per
    pixel and frame for ESIM at C = 0.2), ``dense`` is not (0.3)."""
    import cv2
    from skimage import data

    photo = data.grass() if kind == "dense" else cv2.GaussianBlur(data.grass(), (0, 0), 1.5)
    out = np.empty((frames, HEIGHT, WIDTH), np.uint8)
    for k in range(frames):
        s = 0.65 * k / FPS
        angle, zoom = 0.6 * np.sin(2 * np.pi * s), 1.06 + 0.2 * np.sin(3 * np.pi * s)
        c, d = zoom * np.cos(angle), zoom * np.sin(angle)
        x, y = WIDTH / 2 + 420 * s, HEIGHT / 2 + 300 * s
        move = np.array([[c, -d, x - c * 256 + d * 256], [d, c, y - d * 256 - c * 256]])
        out[k] = cv2.warpAffine(photo, move, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return out


def events(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Emulators alone: a frame of 640x480 at 1000 frames/s, 8-bit codes in, sorted events out. "mid" has 0.07 events
    per pixel and frame (ESIM), "dense" 0.3."""
    from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
    from blinkgl.events import make_emulator

    emulators = {
        "ESIM": EsimConfig(),
        "V2E": V2eConfig(),
        "V2E noisy": V2eConfig(preset="noisy"),
        "Voltmeter": VoltmeterConfig(),
    }

    def row(config: EsimConfig | V2eConfig | VoltmeterConfig, frames: np.ndarray) -> int:
        emulator = make_emulator(config, HEIGHT, WIDTH, 0)
        for k, frame in enumerate(frames):
            emulator.step(frame, k * SECOND // FPS)
        return len(frames)

    clips = {kind: clip(kind, 60) for kind in ("mid", "dense")}
    return {
        f"{name}, {kind}": lambda config=config, frames=frames: row(config, frames)
        for name, config in emulators.items()
        for kind, frames in clips.items()
    }


def generate(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Whole sequences: a simulated second of the configuration, and wall time of each stage."""
    from blinkgl import load
    from blinkgl.dataset.generate import generate_run

    def row() -> dict[str, float]:
        with tempfile.TemporaryDirectory() as folder:
            (report,) = generate_run(load(config_of(options), options.overrides), f"{folder}/out", 1)
        return {"units": report.simulated_s, **report.seconds}

    return {config_of(options).stem: row}


def scene_of(options: argparse.Namespace) -> tuple[SequenceConfig, Scene]:
    """The first sequence of the configuration, and its scene."""
    from blinkgl import load
    from blinkgl.scene.build import sequence_scene

    path = config_of(options)
    config = load(path, options.overrides).sequence(0)
    return config, sequence_scene(config, 0, path.parent)


def build(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Reading the configuration and building its scene."""
    return {config_of(options).stem: lambda: scene_of(options) and None}


def passes(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """A luminance frame of the configuration, drawn and read, by antialiasing."""
    from blinkgl.gl import create_context
    from blinkgl.render.renderer import Renderer

    config, scene = scene_of(options)
    gl = stack.enter_context(create_context())
    times = itertools.cycle(np.linspace(scene.t0_ns, scene.t1_ns, 40).astype(np.int64).tolist())

    def renderer(antialiasing: str) -> Renderer:
        render = config.render.model_copy(update={"antialiasing": antialiasing})
        return stack.enter_context(Renderer(gl, scene, render))

    def frames(kind: str) -> Callable[[], float]:
        drawn = renderer(kind)
        return lambda: len([drawn.luminance(next(times)).read() for _ in range(4)])

    return {kind: frames(kind) for kind in ("none", "edges", "ssaa2")}


def labels(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Each label at a label time of the configuration, drawn, read and finished."""
    from blinkgl.gl import create_context
    from blinkgl.labels import LABELS, LabelRequest
    from blinkgl.render.renderer import Renderer

    config, scene = scene_of(options)
    gl = stack.enter_context(create_context())
    renderer = stack.enter_context(Renderer(gl, scene, config.render))
    span = config.time.interval_ns
    times = itertools.cycle(config.time.label_times_ns[1:-1])
    sets = [(name,) for name, label in LABELS.items() if label.buffer or (label.needs and label.towards is None)]
    sets += [("flow_forward", "occlusion_forward")]

    def row(request: LabelRequest) -> None:
        t = next(times)
        renderer.labels(t, request, t + span, t - span)

    return {", ".join(names): partial(row, LabelRequest(*names)) for names in sets}


def formats(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """A million events written and read in each format."""
    from blinkgl.events import Events
    from blinkgl.io.formats import open_events, write_events

    rng, count = np.random.default_rng(0), 1_000_000
    t = np.sort(rng.integers(0, SECOND // 1000, count))
    x, y, p = (rng.integers(0, n, count).astype(kind) for n, kind in ((WIDTH, "u2"), (HEIGHT, "u2"), (2, "u1")))
    recording, folder = Events(x, y, t, p), Path(stack.enter_context(tempfile.TemporaryDirectory()))

    def read(path: Path) -> None:
        with open_events(path) as file:
            file.sized().read()

    rows: Rows = {}
    for ending in ("h5", "raw", "npz", "npy", "txt"):
        path = folder / f"e.{ending}"
        rows[f"write {ending}"] = lambda path=path: write_events(path, recording, HEIGHT, WIDTH) and None
        rows[f"read {ending}"] = lambda path=path: read(path)
    return rows


def start(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Processes that import, with compiled kernels where there are some."""
    programs = {
        "import blinkgl": "import blinkgl",
        "read_events": "from blinkgl import read_events",
        "record": "from blinkgl import record",
        "blinkgl --help": "import blinkgl.cli, sys; sys.argv[1:] = ['--help']; blinkgl.cli.main()",
        "eflow --help": "import eflow.cli, sys; sys.argv[1:] = ['--help']; eflow.cli.main()",
    }
    here = f"import sys; sys.path.insert(0, {sys.path[0]!r}); "

    def run(text: str) -> None:
        subprocess.run([sys.executable, "-c", here + text], capture_output=True, check=False)

    return {name: partial(run, text) for name, text in programs.items()}


def online(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Samples without files, rendered by this process (configs/eflow/real_data.yaml unless --config is given)."""
    from blinkgl import OnlineSequences

    recipe = options.config or str(resources.files("blinkgl.configs") / "eflow" / "real_data.yaml")
    sequences = stack.enter_context(OnlineSequences(recipe, workers=0, window_ms=(5, 100)))
    stream = iter(sequences)
    return {"samples": lambda: sum(next(stream) is not None for _ in range(16))}


def voxels(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Voxel grids of a million events, 15 bins, 640x480."""
    from eflow.ops.voxel import voxel_grid

    rng, count = np.random.default_rng(0), 1_000_000
    t, p = np.sort(rng.integers(0, 100_000, count)), rng.integers(0, 2, count).astype(np.uint8)
    x, y = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)

    def row(kind: type) -> None:
        voxel_grid(x.astype(kind), y.astype(kind), t, p, 0, 100_000, 15, HEIGHT, WIDTH)

    return {"integer pixels": lambda: row(np.uint16), "rectified": lambda: row(np.float32)}


def networks(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Forward passes of the five networks as published, 640x480, on the processor or a card."""
    import torch

    from eflow.infer import predict
    from eflow.models import NETWORKS, build_model, model_config

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")

    def row(name: str) -> Row:
        model = build_model(model_config({"name": name})).to(device).eval()
        grids = {key: torch.randn(1, model.representation.channels, HEIGHT, WIDTH) for key in ("old", "new")}
        return lambda: predict(model, grids).flow.cpu() is None or None

    return {name: row(name) for name in NETWORKS}


def main_thread(options: argparse.Namespace, stack: contextlib.ExitStack) -> Rows:
    """Event frames with their times: of flying_objects (or --config) at 640x480, of a crowd, and of 1,000 boxes at
    320x240; and the main thread's part. GALLIUM_NOOP=1 with --set render.antialiasing=none draws nothing, as an
    endlessly fast card would (the crowd is left out, whose vertices Mesa then does not take)."""
    from blinkgl import load
    from blinkgl.gl import create_context
    from blinkgl.gl.framebuffer import Target
    from blinkgl.render.renderer import Renderer
    from blinkgl.scene.build import sequence_scene
    from blinkgl.sequence import SequenceRequest, simulate_sequence

    nothing = "GALLIUM_NOOP" in os.environ
    if nothing:
        # Mesa reads nothing either: what the memory held need not be a picture.
        read = Target.read
        stack.enter_context(patch.object(Target, "read", lambda *args, **named: zeroed(read(*args, **named))))
    gl, folder = stack.enter_context(create_context()), resources.files("blinkgl.configs")
    sizes = {"640x480": ["camera.width=640", "camera.height=480"], "320x240": ["camera.width=320", "camera.height=240"]}

    def made(config: SequenceConfig, scene: Scene) -> Row:
        renderer = stack.enter_context(Renderer(gl, scene, config.render))
        request = SequenceRequest(config, 0, labels=False, scene=scene, renderer=renderer)
        sequences = (simulate_sequence(request, gl).alone for _ in itertools.count())
        chunks = itertools.chain.from_iterable(sequence.chunks() for sequence in sequences)

        def row() -> dict[str, float]:
            began = time.thread_time()
            frames = sum(1 for _ in itertools.islice(chunks, 12))
            return {"units": frames, "main thread": time.thread_time() - began}

        return row

    first = Path(options.config or str(folder / "flying_objects.yaml"))
    rows: Rows = {}
    crowd = () if nothing else (("320x240", Path(str(folder / "scenes" / "crossing.yaml"))),)
    for size, file in (("640x480", first), *crowd):
        config = load(file, [*sizes[size], *options.overrides]).sequence(0)
        rows[f"{file.stem}, {size}"] = made(config, sequence_scene(config, 0, file.parent))
    rows["1,000 boxes, 320x240"] = made(config, boxes(1000))
    return rows


def zeroed(picture: np.ndarray) -> np.ndarray:
    picture.fill(0)
    return picture


WHATS = {
    f.__name__: f
    for f in (events, generate, build, passes, main_thread, labels, formats, start, online, voxels, networks)
}


def probe_scene(kind: str, width: int, height: int) -> Scene:
    """Sky box, ground and ten textured balls that move: "full" (111k triangles) or "tri/16" (7k)."""
    from scipy.spatial.transform import Rotation

    from blinkgl.camera import PinHole, focal_length
    from blinkgl.scene.geometry import primitives
    from blinkgl.scene.motion.paths import KeyframePath, StaticPath
    from blinkgl.scene.rig import Rig
    from blinkgl.scene.surfaces.textures import procedural_texture
    from blinkgl.scene.types import Material, Mesh, Part, Scene, SceneObject

    rng = np.random.default_rng(1)
    times, objects = np.linspace(0, 2 * SECOND, 6).astype(np.int64), []
    segments, rings = (100, 56) if kind == "full" else (25, 14)
    for i in range(10):
        ball = primitives.sphere(radius=0.9, segments=segments, rings=rings)
        centre = np.array([(i % 4) * 1.9 - 2.9, 5.0 + (i % 3), (i // 4) * 1.7 - 0.6])
        path = KeyframePath(times, centre + rng.normal(0, 0.2, (6, 3)), Rotation.random(6, random_state=i))
        material = Material(procedural_texture("fbm", i, 1024), unlit=True)
        objects.append(SceneObject(f"ball {i}", i + 1, (Part(ball, material),), path))
    ground, lowered = primitives.grid(width=100.0, depth=100.0, subdivisions=8), np.eye(4)
    lowered[2, 3] = -1.5
    bricks = Material(procedural_texture("bricks", 1, 1024), uv_scale=(25.0, 25.0), unlit=True)
    objects.append(SceneObject("ground", 100, (Part(ground, bricks),), StaticPath(lowered), "ground"))
    box = primitives.cuboid(extents=(100.0, 100.0, 100.0), subdivisions=4)
    inside = Mesh(box.vertices, np.ascontiguousarray(box.faces[:, ::-1]), -box.normals, box.uvs)
    clouds = Material(procedural_texture("fbm", 77, 1024), unlit=True)
    objects.append(SceneObject("sky", 101, (Part(inside, clouds),), StaticPath(), "sky"))
    level = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    keys = np.linspace(0, 2 * SECOND, 4).astype(np.int64)
    turns = Rotation.concatenate([level * Rotation.from_rotvec(rng.normal(0, 0.05, 3)) for _ in keys])
    camera = PinHole.centred(width, height, focal_length(width, math.radians(60)))
    rig = Rig.alone(camera, KeyframePath(keys, rng.normal(0, 0.2, (4, 3)), turns))
    return Scene(tuple(objects), rig, 0, 2 * SECOND)


def boxes(count: int) -> Scene:
    """Textured boxes that move before a moving camera of 320x240."""
    from scipy.spatial.transform import Rotation

    from blinkgl.camera import PinHole
    from blinkgl.scene.geometry import primitives
    from blinkgl.scene.motion.paths import KeyframePath
    from blinkgl.scene.rig import Rig
    from blinkgl.scene.surfaces.textures import procedural_texture
    from blinkgl.scene.types import Material, Part, Scene, SceneObject

    rng, times = np.random.default_rng(1), np.linspace(0, SECOND, 4).astype(np.int64)
    materials = [Material(procedural_texture("fbm", k, 128)) for k in range(8)]
    shapes = [primitives.cuboid(extents=(0.2, 0.2, 0.2)), primitives.icosphere(radius=0.12, subdivisions=1)]
    objects = []
    for k in range(count):
        centre = rng.uniform((-3, 4, -2.2), (3, 9, 2.2))
        path = KeyframePath(times, centre + rng.normal(0, 0.1, (4, 3)), Rotation.random(4, random_state=k))
        objects.append(SceneObject(f"box {k}", k + 1, (Part(shapes[k % 2], materials[k % 8]),), path))
    level = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    moves = KeyframePath(times, rng.normal(0, 0.1, (4, 3)), Rotation.concatenate([level] * 4))
    return Scene(tuple(objects), Rig.alone(PinHole.centred(320, 240, 280.0), moves), 0, SECOND)


def processor_s() -> float:
    """Processor seconds of this process and of children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + used.ru_utime + used.ru_stime


def timed(row: Row) -> dict[str, list[float]]:
    """[wall, processor] milliseconds per unit, by part: "" is the whole."""
    wall, processor = time.perf_counter(), processor_s()
    done = row() or 1
    wall, processor = time.perf_counter() - wall, processor_s() - processor
    parts = dict(done) if isinstance(done, dict) else {"units": done}
    units = parts.pop("units")
    of_parts = {f": {name}": [1e3 * seconds / units, math.nan] for name, seconds in parts.items()}
    return {"": [1e3 * wall / units, 1e3 * processor / units], **of_parts}


def answer(rounds: Callable[[], dict[str, list[float]]]) -> None:
    """Write what ``rounds`` returns, name -> numbers, as a line of JSON for every line of standard input."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what is measured may print
    for _ in sys.stdin:
        answers.write(json.dumps(rounds()) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=WHATS)
    parser.add_argument("--config")
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        rows = WHATS[options.what](options, stack)
        answer(lambda: {name + part: pair for name, row in rows.items() for part, pair in timed(row).items()})


if __name__ == "__main__":
    main()
