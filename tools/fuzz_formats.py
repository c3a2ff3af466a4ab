"""The table of what :mod:`blinkgl.tools.fuzz_files` damages: how a small whole file is made,
how BlinkGL reads it, what damage fits it.

``judge(folder)`` reads by the way the command line reads and looks at what came of it. It returns None, or in words
what a check could have known and did not: events outside the sensor, a flow that is NaN and valid, values that are not
those of the file. The judges use no reader of BlinkGL for what they compare with.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.tools import fuzz_mutators as m

HEIGHT, WIDTH = 24, 32
MARK = "untouched"
"""Name of a file that lies in the folder while nothing is damaged."""


@dataclass(frozen=True)
class Format:
    """make(folder) writes the seed and returns the files to damage, most wanted first (one of them per mutant)."""

    name: str
    make: Callable[[Path], list[str]]
    judge: Callable[[Path], str | None]
    mutators: tuple[m.Mutator, ...] = m.BLIND
    needs: str | None = None
    """a module without which the format is not read"""

    @property
    def available(self) -> bool:
        return self.needs is None or importlib.util.find_spec(self.needs) is not None


# ---- events ----------------------------------------------------------------------------------------------------------


def _events(n: int = 400):
    from blinkgl.types.events import Events

    rng = np.random.default_rng(5)
    t = np.sort(rng.integers(1000, 60_000, n))
    return Events(
        rng.integers(0, WIDTH, n).astype(np.uint16),
        rng.integers(0, HEIGHT, n).astype(np.uint16),
        t,
        rng.integers(0, 2, n).astype(np.uint8),
    )


def _write_events(name: str, **options) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        from blinkgl.io.formats import write_events

        write_events(folder / name, _events(), HEIGHT, WIDTH, **options)
        return [name]

    return make


def _make_mvsec(folder: Path) -> list[str]:
    import h5py

    e = _events()
    with h5py.File(folder / "e.hdf5", "w") as file:
        file["davis/left/events"] = np.stack([e.x, e.y, e.t * 1e-6, e.p * 2.0 - 1], axis=1)
    return ["e.hdf5"]


def _make_plain_dsec(folder: Path) -> list[str]:
    """Uncompressed and of 64-bit columns, so that damage reaches the values."""
    import h5py

    e = _events()
    with h5py.File(folder / "e.h5", "w") as file:
        for k in "xytp":
            file[f"events/{k}"] = getattr(e, k).astype(np.int64)
        file["ms_to_idx"] = np.searchsorted(e.t, np.arange(62) * 1000).astype(np.uint64)
        file["t_offset"] = np.int64(0)
        file.attrs["height"], file.attrs["width"] = HEIGHT, WIDTH
    return ["e.h5"]


def _as_stored(folder: Path, name: str) -> dict[str, np.ndarray] | None:
    """The columns as another library reads them; None where that does not say."""
    path = folder / name
    if path.suffix in (".h5", ".hdf5"):
        import h5py

        with h5py.File(path) as file:
            if "davis/left/events" in file:
                rows = file["davis/left/events"][()]
                return {"x": rows[:, 0], "y": rows[:, 1], "t": np.rint(rows[:, 2] * 1e6), "p": (rows[:, 3] > 0) * 1}
            offset = int(file["t_offset"][()]) if "t_offset" in file else 0
            return {k: file[f"events/{k}"][()].astype(object) + (offset if k == "t" else 0) for k in "xytp"}
    if path.suffix in (".npz", ".npy"):
        data = np.load(path, allow_pickle=False)
        t = np.asarray(data["t"])
        return {
            "x": data["x"],
            "y": data["y"],
            "t": np.rint(t.astype(float) * 1e6) if t.dtype.kind == "f" else t,
            "p": (data["p"] > 0) * 1,
        }
    if path.suffix in (".txt", ".csv"):
        lines = [line for line in path.read_bytes().split(b"\n") if line.strip() and line.strip()[:1] not in b"#%"]
        events = [
            f
            for line in lines
            if (len(f := line.replace(b",", b" ").split()) == 4 and f[0].lstrip(b"+-")[:1].isdigit())
            or f[0][:1] in b"."
        ]
        return {"x": np.array([float(f[1]) for f in events])}
    return None


def _judge_events(name: str) -> Callable[[Path], str | None]:
    def judge(folder: Path) -> str | None:
        from blinkgl.io.formats import open_events
        from blinkgl.types.events import Events

        with open_events(folder / name) as file:
            declared = file.height, file.width
            file = file.sized()
            e = Events.concatenate(list(file.chunks()))
        if len(e):
            if e.x.max() >= file.width or e.y.max() >= file.height:
                return f"an event outside {file.width}x{file.height} (declared {declared})"
            if (np.diff(e.t) < 0).any():
                return "time runs backwards"
            if e.p.max() > 1:
                return "a polarity other than 0 and 1"
        stored = _as_stored(folder, name)
        for k, column in (stored or {}).items():
            if len(column) != len(e):
                return f"{len(e)} events of {len(column)}"
            if any(int(a) != b for a, b in zip(getattr(e, k).tolist(), column.tolist())):
                return f"column {k} is not that of the file"
        return None

    return judge


def _make_aedat2(folder: Path) -> list[str]:
    """Events, two frames of a part of the sensor, and samples of the inertial unit."""
    e = _events()
    x, y = (a.ravel() for a in np.meshgrid(np.arange(30, 42), np.arange(20, 28), indexing="ij"))
    place = 1 << 31 | y << 22 | x << 12
    parts = [
        ((127 - e.y.astype(np.int64)) << 22 | (127 - e.x.astype(np.int64)) << 12 | e.p.astype(np.int64) << 11, e.t)
    ]
    for k in range(2):
        for read, value, begin in ((0, 900, 1000), (1, 300 + 100 * k, 9000)):
            parts.append((place | read << 10 | value, 20_000 * k + begin + np.arange(len(place))))
    for k in range(20):
        which = np.arange(7)
        parts.append((1 << 31 | which << 28 | (100 * which + k) << 12 | 3 << 10, np.full(7, 2000 * k)))
    address, t = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    order = np.argsort(t, kind="stable")
    lines = ("#!AER-DAT2.0", "# AEChip: eu.seebetter.ini.chips.davis.DAVIS128", "# End Of ASCII Header")
    head = "".join(f"{line}\r\n" for line in lines).encode()
    (folder / "e.aedat").write_bytes(head + np.stack([address, t], 1)[order].astype(">u4").tobytes())
    return ["e.aedat"]


def _judge_aedat2(folder: Path) -> str | None:
    from blinkgl.io.formats import open_events

    if problem := _judge_events("e.aedat")(folder):
        return problem
    with open_events(folder / "e.aedat") as file:
        frames, imu = list(file.frames()), file.imu()
    if any(f.image.shape != (file.height, file.width) or f.image.max() > 1023 or f.end_us < f.begin_us for f in frames):
        return "a frame of another size, of more than ten bits, or that ends before it begins"
    if (np.diff(imu.t) < 0).any() or not (np.isfinite(imu.acceleration).all() and np.isfinite(imu.rate).all()):
        return "samples of the inertial unit that run backwards, or are not finite"
    return None


# ---- flow, labels, frames --------------------------------------------------------------------------------------------


def _flow():
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    return np.dstack([x * 0.25 - 3, y * 0.5 - 6]), (x + y) % 7 > 0


def _make_flow_png(scale: float) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        from blinkgl.io.flow_png import write_flow_png

        write_flow_png(folder / "f.png", *_flow(), scale=scale)
        return ["f.png"]

    return make


def _sound_flow(flow: np.ndarray, valid: np.ndarray, limit: float = np.inf) -> str | None:
    if (
        flow.ndim != 3
        or flow.shape[2] != 2
        or valid.shape != flow.shape[:2]
        or valid.dtype != bool
        or flow.dtype != np.float32
    ):
        return f"flow {flow.dtype} {flow.shape}, valid {valid.dtype} {valid.shape}"
    if not np.isfinite(flow[valid]).all() or np.abs(flow[valid]).max(initial=0) > limit:
        return "a valid flow that is NaN, infinite or out of range"
    return "flow where it is not valid" if flow[~valid].any() else None


def _judge_flow_png(scale: float, limit: float) -> Callable[[Path], str | None]:
    def judge(folder: Path) -> str | None:
        from blinkgl.io.flow_png import read_flow_png

        return _sound_flow(*read_flow_png(folder / "f.png", scale=scale), limit)

    return judge


def _make_flo(folder: Path) -> list[str]:
    from blinkgl.io.flo import write_flo

    write_flo(folder / "f.flo", *_flow())
    return ["f.flo"]


def _judge_flo(folder: Path) -> str | None:
    from blinkgl.io.flo import read_flo

    return _sound_flow(*read_flo(folder / "f.flo"), 1e9)


def _make_flow_npy(folder: Path) -> list[str]:
    flow, valid = _flow()
    np.save(folder / "f.npy", np.dstack([flow, valid]).astype(np.float32))
    return ["f.npy"]


def _judge_flow_npy(folder: Path) -> str | None:
    from eflow.data.sources import read_flow
    from eflow.infer import read_truth

    flow, valid = read_flow(folder / "f.npy")
    try:
        read_truth(folder / "f.npy", *flow.shape[:2])
    except Exception as error:
        from blinkgl.errors import BlinkGLError

        if not isinstance(error, BlinkGLError):  # three channels are no truth
            raise
    return _sound_flow(flow, valid)


def _picture(dtype=np.uint8, channels: int = 3) -> np.ndarray:
    rng = np.random.default_rng(1)
    small = rng.integers(0, 256, (3, 4, channels))
    image = np.kron(small, np.ones((8, 8, 1), int))
    return (
        (image * 257).astype(np.uint16)
        if dtype == np.uint16
        else (image / 255).astype(np.float32)
        if dtype == np.float32
        else image.astype(np.uint8)
    )


def _make_frames(ending: str, dtype=np.uint8) -> Callable[[Path], list[str]]:
    """A folder of two frames and their times."""

    def make(folder: Path) -> list[str]:
        import cv2

        from blinkgl.io.pfm import write_pfm

        (folder / "frames").mkdir()
        names = []
        for k in range(2):
            name = f"frames/{k}{ending}"
            image = np.roll(_picture(dtype), 3 * k, axis=1)
            if ending == ".pfm":
                write_pfm(folder / name, image)
            elif ending == ".exr":
                _write_exr(folder / name, image)
            elif not cv2.imwrite(str(folder / name), image[..., ::-1]):
                raise RuntimeError(f"OpenCV cannot write {ending}")
            names.append(name)
        (folder / "frames/timestamps.txt").write_text("0\n10000\n")
        return names

    return make


def _write_exr(path: Path, image: np.ndarray) -> None:
    """Through ffmpeg, as it is read."""
    import subprocess

    import imageio_ffmpeg

    from blinkgl.io.pfm import encode_pfm

    subprocess.run(
        [
            imageio_ffmpeg.get_ffmpeg_exe(),
            "-loglevel",
            "error",
            "-y",
            "-f",
            "image2pipe",
            "-c:v",
            "pfm",
            "-i",
            "-",
            "-pix_fmt",
            "gbrpf32le",
            str(path),
        ],
        input=encode_pfm(image),
        check=True,
    )


def _judge_frames(name: str = "frames", fps: float | None = None) -> Callable[[Path], str | None]:
    def judge(folder: Path) -> str | None:
        from blinkgl.io.frames import open_frames
        from blinkgl.recordings.simulation import Decoder

        source = open_frames(folder / name, fps=fps)
        decode, last = Decoder(None), None
        for frame, t_ns, where in source:
            light = decode(frame, where)
            if light.shape != (source.height, source.width) or not (np.isfinite(light).all() and (light >= 0).all()):
                return f"frame {where}: {light.shape}, not finite or negative"
            if last is not None and t_ns <= last:
                return "times do not increase"
            last = t_ns
        return None

    return judge


def _make_timestamps(folder: Path) -> list[str]:
    _make_frames(".png")(folder)
    return ["frames/timestamps.txt"]


def _make_array_frames(ending: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        frames = np.stack([_picture(np.float32, 1)[..., 0], _picture(np.float32, 1)[::-1, :, 0]])
        if ending == ".npy":
            np.save(folder / "f.npy", frames)
        else:
            np.savez_compressed(folder / "f.npz", frames=frames, timestamps=np.array([0.0, 0.01]))
        return [f"f{ending}"]

    return make


def _make_video(folder: Path) -> list[str]:
    from blinkgl.io.video import VideoWriter

    with VideoWriter(folder / "v.mp4", HEIGHT, WIDTH, 25) as writer:
        for k in range(4):
            writer.write(np.roll(_picture(), k, axis=1))
    return ["v.mp4"]


def _make_labels(folder: Path) -> list[str]:
    from blinkgl.io import images

    (folder / "ids.png").write_bytes(images.encode_ids(np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 300))
    (folder / "mask.png").write_bytes(images.encode_mask(_flow()[1]))
    (folder / "depth.npy").write_bytes(images.encode_npy(_flow()[0][..., 0]))
    return ["ids.png", "mask.png", "depth.npy"]


def _judge_labels(folder: Path) -> str | None:
    from blinkgl.io import images

    found = (
        images.read_image(folder / "ids.png"),
        images.read_mask(folder / "mask.png"),
        images.read_npy(folder / "depth.npy"),
    )
    return "objects" if any(a.dtype.hasobject for a in found) else None


# ---- scenes ----------------------------------------------------------------------------------------------------------


def _make_mesh(ending: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        import trimesh
        from PIL import Image

        box = trimesh.creation.box()
        if ending in (".ply", ".stl"):
            box.export(folder / f"a{ending}")
        elif ending == ".ascii.ply":
            (folder / "a.ply").write_bytes(trimesh.exchange.ply.export_ply(box, encoding="ascii"))
            return ["a.ply"]
        else:
            uv = np.random.default_rng(0).random((len(box.vertices), 2))
            material = trimesh.visual.material.SimpleMaterial(image=Image.fromarray(_picture()))
            box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
            text, files = trimesh.exchange.obj.export_obj(box, return_texture=True)
            (folder / "a.obj").write_text(text)
            for name, content in files.items():
                (folder / name).write_bytes(content)
            others = sorted(files)
            return ["a.obj"] if ending == ".obj" else others
        return [f"a{ending}"]

    return make


def _judge_asset(name: str) -> Callable[[Path], str | None]:
    def judge(folder: Path) -> str | None:
        from blinkgl.scene.importing.mesh_files import load_asset

        asset = load_asset(folder / name, max_texture=256).normalised()
        return _sound_parts(asset.parts)

    return judge


def _sound_parts(parts) -> str | None:
    for part in parts:
        mesh = part.mesh
        arrays = {k: v for k, v in vars(mesh).items() if isinstance(v, np.ndarray)}
        for k, v in arrays.items():
            if v.dtype.kind == "f" and not np.isfinite(v).all():
                return f"mesh with NaN or infinity in {k}"
        if len(mesh.faces) and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
            return "a face of vertices that there are not"
        if not np.isfinite(part.material.base_color).all():
            return "a colour that is not finite"
        if part.material.texture is not None and (problem := _sound_texture(part.material.texture.image)):
            return problem
    return None


def _sound_texture(image: np.ndarray) -> str | None:
    fine = (
        image.ndim == 3
        and image.shape[2] == 3
        and image.size
        and (image.dtype == np.uint8 or (image.dtype == np.float32 and np.isfinite(image).all() and (image >= 0).all()))
    )
    return None if fine else f"texture {image.dtype} {image.shape}"


def _gltf() -> tuple[dict[str, Any], bytes]:
    """A textured triangle pair under a moving node, a camera, a light."""
    import cv2

    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4")
    pieces = [
        vertices.tobytes(),
        np.tile(np.array([0, 0, 1], "<f4"), (4, 1)).tobytes(),
        np.ascontiguousarray(vertices[:, :2]).tobytes(),
        np.array([0, 1, 2, 2, 1, 3], "<u2").tobytes(),
        np.array([0, 0.1, 0.2], "<f4").tobytes(),
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]], "<f4").tobytes(),
        np.array([[0, 0, 0, 1], [0, 0, 0.6, 0.8], [0, 0, 1, 0]], "<f4").tobytes(),
        cv2.imencode(".png", _picture())[1].tobytes(),
    ]
    data, views = b"", []
    for piece in pieces:
        data += b"\0" * (-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(piece)})
        data += piece
    kinds = [
        (5126, 4, "VEC3"),
        (5126, 4, "VEC3"),
        (5126, 4, "VEC2"),
        (5123, 6, "SCALAR"),
        (5126, 3, "SCALAR"),
        (5126, 3, "VEC3"),
        (5126, 3, "VEC4"),
    ]
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"name": "a", "translation": [0, 0, -3], "rotation": [0, 0, 0, 1], "scale": [1, 2, 1], "children": [1]},
            {"name": "b", "mesh": 0},
            {"name": "eye", "camera": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1]},
        ],
        "cameras": [
            {"type": "perspective", "name": "c", "perspective": {"yfov": 0.8, "znear": 0.1, "aspectRatio": 1.3}}
        ],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2},
                        "indices": 3,
                        "material": 0,
                        "mode": 4,
                    }
                ]
            }
        ],
        "materials": [
            {
                "name": "m",
                "doubleSided": True,
                "emissiveFactor": [0, 0, 0],
                "alphaMode": "OPAQUE",
                "pbrMetallicRoughness": {
                    "baseColorFactor": [1, 0.5, 0.2, 1],
                    "metallicFactor": 0,
                    "baseColorTexture": {
                        "index": 0,
                        "extensions": {"KHR_texture_transform": {"offset": [0.1, 0], "scale": [2, 2], "rotation": 0.1}},
                    },
                },
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 10497, "wrapT": 33071}],
        "images": [{"bufferView": 7, "mimeType": "image/png"}],
        "animations": [
            {
                "name": "go",
                "samplers": [
                    {"input": 4, "output": 5, "interpolation": "LINEAR"},
                    {"input": 4, "output": 6, "interpolation": "STEP"},
                ],
                "channels": [
                    {"sampler": 0, "target": {"node": 0, "path": "translation"}},
                    {"sampler": 1, "target": {"node": 0, "path": "rotation"}},
                ],
            }
        ],
        "accessors": [
            {"bufferView": i, "componentType": c, "count": n, "type": t} for i, (c, n, t) in enumerate(kinds)
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
        "extensionsUsed": ["KHR_texture_transform"],
    }
    return tree, data


def _make_gltf(folder: Path) -> list[str]:
    tree, data = _gltf()
    (folder / "a.bin").write_bytes(data)
    (folder / "a.gltf").write_text(json.dumps({**tree, "buffers": [{"byteLength": len(data), "uri": "a.bin"}]}))
    return ["a.gltf"]


def _make_gltf_buffer(folder: Path) -> list[str]:
    _make_gltf(folder)
    return ["a.bin"]


def _make_glb(folder: Path) -> list[str]:
    import struct

    tree, data = _gltf()
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    (folder / "a.glb").write_bytes(
        struct.pack("<IIIII", 0x46546C67, 2, 28 + len(text) + len(data), len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(data), 0x004E4942)
        + data
    )
    return ["a.glb"]


def _judge_scene(name: str) -> Callable[[Path], str | None]:
    """As an object of a pool, and as a whole scene with its camera and animation."""

    def judge(folder: Path) -> str | None:
        from blinkgl.camera import PinHole
        from blinkgl.errors import BlinkGLError
        from blinkgl.scene.worlds.from_file import from_gltf

        try:
            problem = _judge_asset(name)(folder)
        except BlinkGLError:
            problem = None
        scene = from_gltf(folder / name, PinHole.centred(32, 24, 28.0), 0, 200_000_000, intrinsics="file")
        for t in (0, 100_000_000, 200_000_000):
            for path in (scene.camera_path, *(o.path for o in scene.objects)):
                T = path.pose(t)
                if not np.isfinite(T).all() or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6):
                    return "a pose that is not rigid or not finite"
        camera = scene.camera
        if not (np.isfinite([camera.fx, camera.fy, camera.near]).all() and camera.fx > 0 and camera.near > 0):
            return f"camera fx {camera.fx}, near {camera.near}"
        return problem or next((p for o in scene.objects if (p := _sound_parts(o.parts))), None)

    return judge


def _make_texture(ending: str, dtype=np.uint8) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        import cv2

        if not cv2.imwrite(str(folder / f"t{ending}"), _picture(dtype)):
            raise RuntimeError(f"OpenCV cannot write {ending}")
        return [f"t{ending}"]

    return make


def _judge_texture(name: str) -> Callable[[Path], str | None]:
    def judge(folder: Path) -> str | None:
        from blinkgl.scene.surfaces.images import load_image

        return _sound_texture(load_image(folder / name, 256))

    return judge


# ---- data sets and configurations ------------------------------------------------------------------------------------

_RECIPE = {
    "seed": 11,
    "camera": {"width": WIDTH, "height": HEIGHT, "fov": 60},
    "time": {"duration": 0.1, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 300},
    "labels": {"flow": ["forward"], "images": False},
    "preview": {"enabled": False},
    "scene": {
        "kind": "random",
        "objects": {"count": 3, "size": {"uniform": [0.3, 0.6]}},
        "pool": {"primitives": ["cuboid"], "urdfs": False},
        "textures": {"procedural": ["checks"], "photographs": False},
    },
    "groups": {
        "a": {
            "output": {"name": "a", "sequences": 1, "split": "train"},
            "events": {"emulator": "esim", "contrast_threshold": {"uniform": [0.15, 0.25]}},
        },
        "b": {
            "enabled": False,
            "output": {"name": "b", "sequences": 1},
            "events": {"emulator": {"choice": ["v2e", "esim"]}},
        },
    },
}


def _make_data_set(folder: Path) -> None:
    """One sequence, its index and the run's record; nothing of it was rendered."""
    from blinkgl.config.reader import to_yaml
    from blinkgl.config.sequence import load_run
    from blinkgl.dataset.plan import Plan
    from blinkgl.dataset.run_folder import RunFolder
    from blinkgl.labels import Flow
    from blinkgl.sequence_files.index import write_index
    from blinkgl.sequence_files.sequence_dir import SequenceWriter

    (folder / "recipe.yaml").write_text(to_yaml(_RECIPE))
    out = folder / "out"
    plan = Plan.of(load_run(folder / "recipe.yaml"))
    flow, valid = _flow()
    with SequenceWriter(out / plan.tasks[0].name, HEIGHT, WIDTH, config_yaml=to_yaml(plan.template.tree)) as writer:
        writer.append_events(_events())
        for k in range(2):
            t = 20_000 * (k + 1)
            writer.label("flow_forward", k, Flow(flow, valid), t, t + 20_000)
            writer.label("depth", k, flow[..., 0] + 9, t)
        writer.poses(T_world_cam=np.tile(np.eye(4), (2, 1, 1)))
        writer.info.update(
            blinkgl="0",
            seed=11,
            sequence=0,
            split="train",
            labels=2,
            duration_us=60_000,
            emulator="esim",
            frames=30,
            group="a",
        )
        writer.t_end_us = 60_000
    write_index(out)
    run = RunFolder(out)
    with run.locked():
        run.begin(plan, {}, {"python": "3"}, None)


def _make_record(*names: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        _make_data_set(folder)
        found = [
            p.relative_to(folder).as_posix()
            for name in names
            for p in sorted((folder / "out").rglob(name))
            if p.is_file()
        ]
        if not found:
            raise RuntimeError(f"no {names} in the data set")
        return found

    return make


def _judge_data_set(must_notice: bool) -> Callable[[Path], str | None]:
    """``must_notice``: the files are checksummed, so every change has to be reported."""

    def judge(folder: Path) -> str | None:
        from blinkgl.dataset.verify import verify_dataset

        result = verify_dataset(folder / "out")
        lines = [line for found in result.problems.values() for line in found]
        if any("\n" in line for line in lines):
            return "a problem of several lines"
        if must_notice and not lines and not (folder / MARK).exists():
            return "a file was altered and verify reports nothing"
        return None

    return judge


def _judge_loader(folder: Path) -> str | None:
    """As ``eflow`` reads it."""
    from eflow.data.sources import open_source

    return _sound_samples(open_source(folder / "out"))


def _sound_samples(source) -> str | None:
    for k in range(min(len(source), 3)):
        s = source[k]
        for w in (s.old, s.new):
            if (
                len(w)
                and (w.x.max() >= s.width or w.y.max() >= s.height or w.x.min() < 0 or w.y.min() < 0)
                and w.x.dtype.kind == "u"
            ):
                return "an event outside the sensor"
            if len(w) and ((np.diff(w.t) < 0).any() or w.t[0] < w.t0 or w.t[-1] >= w.t1):
                return "events out of order or outside their window"
            if not np.isfinite(w.x).all() or (len(w) and w.p.max() > 1):
                return "events that are not finite, or polarity"
        if s.flow is not None and (problem := _sound_flow(s.flow, s.valid)):
            return problem
    return None


def _make_dsec_set(folder: Path) -> list[str]:
    from blinkgl.io.dsec import DsecEventWriter, identity_rectify_map, write_rectify_map
    from blinkgl.io.flow_png import write_flow_png

    left, flow = folder / "thun/events/left", folder / "thun/flow/forward"
    left.mkdir(parents=True)
    flow.mkdir(parents=True)
    with DsecEventWriter(left / "events.h5", HEIGHT, WIDTH) as writer:
        writer.append(_events())
    write_rectify_map(left / "rectify_map.h5", identity_rectify_map(HEIGHT, WIDTH))
    (flow.parent / "forward_timestamps.txt").write_text(
        "# from_timestamp_us, to_timestamp_us\n20000, 40000\n40000, 60000\n"
    )
    for k in range(2):
        write_flow_png(flow / f"{k:06d}.png", *_flow())
    return ["thun/events/left/rectify_map.h5", "thun/events/left/events.h5"]


def _judge_dsec_set(folder: Path) -> str | None:
    from eflow.data.sources import open_source

    return _sound_samples(open_source(folder, "dsec"))


def _make_times(folder: Path) -> list[str]:
    _make_dsec_set(folder)
    return ["thun/flow/forward_timestamps.txt"]


def _make_mvsec_set(folder: Path) -> list[str]:
    import h5py

    e = _events()
    t0 = 1.5e9
    stamps = t0 + np.arange(6) * 0.01
    table = np.stack([e.x, e.y, t0 + e.t * 1e-6, e.p * 2.0 - 1], axis=1)
    with h5py.File(folder / "a_data.hdf5", "w") as file:
        file["davis/left/events"] = table
        file["davis/left/image_raw_ts"] = stamps
        file["davis/left/image_raw_event_inds"] = np.searchsorted(table[:, 2], stamps)
    flow = np.ones((4, 260, 346), np.float32)
    flow[:, :20, :20] = 0
    np.savez_compressed(
        folder / "a_gt_flow_dist.npz", timestamps=t0 + np.arange(4) * 0.02, x_flow_dist=flow, y_flow_dist=-flow
    )
    return ["a_data.hdf5"]


def _make_mvsec_truth(folder: Path) -> list[str]:
    _make_mvsec_set(folder)
    return ["a_gt_flow_dist.npz"]


def _judge_mvsec_set(folder: Path) -> str | None:
    from eflow.data.sources import open_source

    return _sound_samples(open_source(folder, "mvsec"))


def _make_yaml(folder: Path) -> list[str]:
    from blinkgl.config.reader import to_yaml

    (folder / "r.yaml").write_text(to_yaml(_RECIPE))
    return ["r.yaml"]


def _judge_yaml(folder: Path) -> str | None:
    from blinkgl.config.sequence import load_run
    from blinkgl.dataset.plan import Plan

    plan = Plan.of(load_run(folder / "r.yaml"))
    for task in plan.tasks[:2]:
        next(g for g in plan.groups if g.name == task.group).template.sequence(task.index)
    return None


def _make_explicit(folder: Path) -> list[str]:
    from blinkgl.config.reader import to_yaml

    tree = {
        "camera": {"width": 32, "height": 24, "fov": 60},
        "time": {"duration": 0.1, "label_rate": 20},
        "scene": {
            "kind": "explicit",
            "meshes": {"a": {"primitive": "cuboid"}},
            "objects": [{"mesh": "a", "position": [0, 0, 0], "euler": [0, 10, 0]}],
            "camera": {
                "keyframes": [
                    {"time": 0.0, "position": [0, -3, 0], "look_at": [0, 0, 0]},
                    {"time": 0.1, "position": [0.1, -3, 0]},
                ]
            },
        },
    }
    (folder / "r.yaml").write_text(to_yaml(tree))
    return ["r.yaml"]


def _judge_explicit(folder: Path) -> str | None:
    """The scene is built, too: names, key frames and primitives are looked at there."""
    from blinkgl.config.sequence import load_run
    from blinkgl.scene.build import build_scene

    config = load_run(folder / "r.yaml").sequence(0)
    if config.scene.kind == "explicit":
        scene = build_scene(config.scene, config.camera, config.time.t0_ns, config.time.t1_ns, base=folder)
        return next((p for o in scene.objects if (p := _sound_parts(o.parts))), None)
    return None


def _make_emulator_yaml(folder: Path) -> list[str]:
    (folder / "e.yaml").write_text(
        "emulator: v2e\npreset: noisy\ncontrast_threshold: 0.25\nthreshold_sigma: 0.03\nrefractory_us: 100\n"
    )
    return ["e.yaml"]


def _judge_emulator_yaml(folder: Path) -> str | None:
    from blinkgl.recordings.simulation import emulator_config
    from blinkgl.show.simulate import emulator_options

    emulator_config(emulator_options("esim", str(folder / "e.yaml"), [])["emulator"])
    return None


def _make_checkpoint(folder: Path) -> list[str]:
    import torch

    from eflow.checkpoint import save_checkpoint
    from eflow.models import build_model, model_config

    torch.manual_seed(0)
    model = build_model(model_config({"name": "ev_flownet", "width": 4}))
    optimizer = torch.optim.AdamW(model.parameters())
    at = save_checkpoint(folder, 5, model, None, optimizer, {"epoch": 0}, 1)
    return [str((at / "weights.safetensors").relative_to(folder))]


def _make_checkpoint_state(folder: Path) -> list[str]:
    path = Path(_make_checkpoint(folder)[0])
    return [str(path.with_name("state.json"))]


def _judge_checkpoint(folder: Path) -> str | None:
    import torch

    from eflow.checkpoint import load_model

    model = load_model(folder)
    return (
        None
        if all(torch.isfinite(p).all() for p in model.state_dict().values() if p.is_floating_point())
        else "weights that are NaN or infinite"
    )


def _judge_checkpoint_state(folder: Path) -> str | None:
    from eflow.checkpoint import find_checkpoint, read_state

    state = read_state(find_checkpoint(folder).folder)
    return (
        None
        if isinstance(state["step"], int) and not isinstance(state["step"], bool) and state["step"] >= 0
        else f"step {state['step']!r}"
    )


def _make_train_yaml(folder: Path) -> list[str]:
    from blinkgl.config.reader import to_yaml

    (folder / "t.yaml").write_text(
        to_yaml(
            {
                "seed": 0,
                "model": {"name": "eraft", "iterations": 3},
                "data": {"crop": [64, 64], "train": [{"path": "x", "weight": 1.0}]},
                "optim": {"steps": 10},
            }
        )
    )
    return ["t.yaml"]


def _judge_train_yaml(folder: Path) -> str | None:
    from eflow.config import load_train_config

    load_train_config(folder / "t.yaml")
    return None


# ---- the table -------------------------------------------------------------------------------------------------------

_PNG = (*m.BLIND, m.png_chunks, m.png_chunks, m.png_chunks, m.png_chunks)
_NPZ = (*m.BLIND, m.fields(m.zip_layout), m.fields(m.zip_layout), *[m.arrays] * 8)
_NPY = (*m.BLIND, *[m.npy_header] * 5)
_H5 = (*m.BLIND, *[m.fields(m.hdf5_layout)] * 4, *[m.hdf5_objects] * 8)

FORMATS: tuple[Format, ...] = (
    Format("events text", _write_events("e.txt"), _judge_events("e.txt"), m.TEXT),
    Format("events csv", _write_events("e.csv", time_unit="us"), _judge_events("e.csv"), m.TEXT),
    Format("events dsec", _write_events("e.h5"), _judge_events("e.h5"), _H5),
    Format("events dsec plain", _make_plain_dsec, _judge_events("e.h5"), _H5),
    Format("events mvsec", _make_mvsec, _judge_events("e.hdf5"), _H5),
    Format("events npz", _write_events("e.npz"), _judge_events("e.npz"), _NPZ),
    Format("events npy", _write_events("e.npy"), _judge_events("e.npy"), _NPY),
    Format(
        "events evt2",
        _write_events("e.raw", format="evt2"),
        _judge_events("e.raw"),
        (*m.BLIND, m.token, *[m.fields(m.words_layout(4))] * 5),
    ),
    Format(
        "events evt3",
        _write_events("e.raw"),
        _judge_events("e.raw"),
        (*m.BLIND, m.token, *[m.fields(m.words_layout(2))] * 5),
    ),
    Format("events aedat4", _write_events("e.aedat4"), _judge_events("e.aedat4"), m.BLIND, "dv_processing"),
    Format(
        "events aedat2",
        _make_aedat2,
        _judge_aedat2,
        (*m.BLIND, m.token, *[m.fields(m.words_layout(4, b"Header\r\n"))] * 5),
    ),
    Format("flow png dsec", _make_flow_png(128.0), _judge_flow_png(128.0, 256), _PNG),
    Format("flow png kitti", _make_flow_png(64.0), _judge_flow_png(64.0, 512), _PNG),
    Format("flow flo", _make_flo, _judge_flo, (*m.BLIND, *[m.fixed((0, "<f"), (4, "<I"), (8, "<I"))] * 4)),
    Format("flow npy", _make_flow_npy, _judge_flow_npy, _NPY),
    Format("labels png npy", _make_labels, _judge_labels, m.BLIND),
    Format("frames png", _make_frames(".png"), _judge_frames(), _PNG),
    Format("frames png 16", _make_frames(".png", np.uint16), _judge_frames(), _PNG),
    Format("frames jpg", _make_frames(".jpg"), _judge_frames()),
    Format(
        "frames bmp",
        _make_frames(".bmp"),
        _judge_frames(),
        (*m.BLIND, *[m.fixed((10, "<I"), (14, "<I"), (18, "<I"), (22, "<I"), (28, "<H"), (30, "<I"), (46, "<I"))] * 4),
    ),
    Format("frames tiff", _make_frames(".tiff", np.uint16), _judge_frames()),
    Format("frames webp", _make_frames(".webp"), _judge_frames()),
    Format("frames ppm", _make_frames(".ppm"), _judge_frames(), (*m.BLIND, m.token)),
    Format("frames pfm", _make_frames(".pfm", np.float32), _judge_frames(), (*m.BLIND, m.token, m.token, m.token)),
    Format("frames hdr", _make_frames(".hdr", np.float32), _judge_frames(), (*m.BLIND, m.token)),
    Format("frames exr", _make_frames(".exr", np.float32), _judge_frames()),
    Format("frames npy", _make_array_frames(".npy"), _judge_frames("f.npy", 100.0), _NPY),
    Format("frames npz", _make_array_frames(".npz"), _judge_frames("f.npz"), _NPZ),
    Format("frames times", _make_timestamps, _judge_frames(), m.TEXT),
    Format("frames video", _make_video, _judge_frames("v.mp4"), (*m.BLIND, *[m.fields(m.box_layout)] * 5)),
    Format("mesh obj", _make_mesh(".obj"), _judge_asset("a.obj"), m.TEXT),
    Format("mesh obj mtl and image", _make_mesh(".mtl"), _judge_asset("a.obj"), (*m.TEXT, *m.BLIND)),
    Format("mesh ply", _make_mesh(".ply"), _judge_asset("a.ply"), (*m.BLIND, m.token, m.token, m.word)),
    Format("mesh ply ascii", _make_mesh(".ascii.ply"), _judge_asset("a.ply"), m.TEXT),
    Format("mesh stl", _make_mesh(".stl"), _judge_asset("a.stl"), (*m.BLIND, *[m.fixed((80, "<I"))] * 3)),
    Format("scene gltf", _make_gltf, _judge_scene("a.gltf"), (*m.TEXT, *[m.json_tree] * 12)),
    Format("scene gltf buffer", _make_gltf_buffer, _judge_scene("a.gltf")),
    Format(
        "scene glb",
        _make_glb,
        _judge_scene("a.glb"),
        (*m.BLIND, *[m.fixed((4, "<I"), (8, "<I"), (12, "<I"), (16, "<I"))] * 3, *[m.glb_tree] * 8),
    ),
    Format("texture png", _make_texture(".png"), _judge_texture("t.png"), _PNG),
    Format("texture jpg", _make_texture(".jpg"), _judge_texture("t.jpg")),
    Format("texture hdr", _make_texture(".hdr", np.float32), _judge_texture("t.hdr"), (*m.BLIND, m.token)),
    Format("texture tiff", _make_texture(".tiff"), _judge_texture("t.tiff")),
    Format(
        "dataset payload",
        _make_record("events.h5", "*.png", "*.npy", "poses.npz", "*_timestamps.txt", "config.yaml"),
        _judge_data_set(True),
    ),
    Format("dataset manifest", _make_record("manifest.json"), _judge_data_set(False), (*m.TEXT, *[m.json_tree] * 12)),
    Format("dataset index", _make_record("index.jsonl"), _judge_data_set(False), (*m.TEXT, *[m.json_lines] * 12)),
    Format("dataset run.json", _make_record("run.json"), _judge_data_set(False), (*m.TEXT, *[m.json_tree] * 12)),
    Format("dataset recipe", _make_record("recipe.yaml"), _judge_data_set(False), (*m.TEXT, *[m.yaml_tree] * 8)),
    Format(
        "loader blinkgl",
        _make_record("events.h5", "*.png", "*_timestamps.txt", "index.jsonl"),
        _judge_loader,
        (*m.BLIND, m.token),
    ),
    Format("loader dsec", _make_dsec_set, _judge_dsec_set, _H5, "torch"),
    Format("loader dsec times", _make_times, _judge_dsec_set, m.TEXT, "torch"),
    Format("loader mvsec", _make_mvsec_set, _judge_mvsec_set, _H5, "torch"),
    Format(
        "loader mvsec truth", _make_mvsec_truth, _judge_mvsec_set, (*m.BLIND, *[m.fields(m.zip_layout)] * 4), "torch"
    ),
    Format("yaml recipe", _make_yaml, _judge_yaml, (*m.TEXT, *[m.yaml_tree] * 12)),
    Format("yaml explicit scene", _make_explicit, _judge_explicit, (*m.TEXT, *[m.yaml_tree] * 12)),
    Format("yaml emulator", _make_emulator_yaml, _judge_emulator_yaml, (*m.TEXT, *[m.yaml_tree] * 6)),
    Format("yaml training", _make_train_yaml, _judge_train_yaml, (*m.TEXT, *[m.yaml_tree] * 12), "torch"),
    Format(
        "checkpoint weights",
        _make_checkpoint,
        _judge_checkpoint,
        (*m.BLIND, m.fixed((0, "<Q")), *[m.safetensors_tree] * 6, m.safetensors_values),
        "torch",
    ),
    Format("checkpoint state", _make_checkpoint_state, _judge_checkpoint_state, (*m.TEXT, *[m.json_tree] * 8), "torch"),
)
