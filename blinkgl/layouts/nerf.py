"""Sets for radiance fields (NeRF, 3D Gaussian splatting, with and without events), as their loaders read them.

    <split>/<sequence>/
      images/%06d.png        frames, blurred ones of a frame camera; sharp/%06d.png  those without blur beside them
      transforms.json        instant-ngp, nerfstudio: all frames, camera to world, OpenGL axes (x right, y up, z back)
      transforms_{train,val,test}.json   of each eight frames six, the fifth and the first; val and test without blur
      sparse/0/*.txt         COLMAP: cameras, images (world to camera, OpenCV axes); no points
      poses_bounds.npy       LLFF: (n, 17) f8, a row 3x5 (axes down, right, back; place; H, W, focal), near and far
      events.npz, events.h5  x, y u2, t i8 µs, p u1; as in the sequence
      eventnerf/{train,validation}/   EventNeRF: events/events.npz, intrinsics/, pose/%06d.txt, rgb/%06d.png

In all of them the top-left pixel's centre is (0.5, 0.5), half a pixel from BlinkGL's.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import CameraModel
from blinkgl.camera.pinhole import rectified
from blinkgl.io.formats import write_events
from blinkgl.io.images import encode_npy, encoded
from blinkgl.io.sequence_tables import EXPOSURE_POSES, EXPOSURES, POSES, read_exposure_poses, read_exposures
from blinkgl.layouts.frames import Frames, frames_of, two_frames, write_frames
from blinkgl.layouts.layout import Layout, Missing, need, sensor_pixels, write_bytes, write_lines
from blinkgl.layouts.source import Planned, Source
from blinkgl.types.events import Events

_poses = need("poses of its camera", "scene: {kind: random}", lambda source: source.has(POSES))
_exposed = need(
    "poses of its frame camera (frame_camera/poses.npz)",
    "images: {}, generated again",
    lambda source: not source.has(EXPOSURES) or source.has(EXPOSURE_POSES),
)


def _bounded(source: Source) -> Missing | None:
    if _poses(source) or isinstance(source, Planned) or next(_depths(source), None) is not None:
        return None
    if source.count("depth"):
        return Missing("something in view, for near and far", "scene: {kind: random}")
    return Missing("depth, or boxes of bodies in view, for near and far", "labels: {depth: true}")


_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_HOLD = 8
"""Of so many frames the first is of the split test, as LLFF's loader holds out."""
_COLMAP = {"pinhole": "PINHOLE", "radtan": "FULL_OPENCV", "equidistant": "OPENCV_FISHEYE"}
_EVENTNERF_SIZE = 346, 260


class Nerf(Layout):
    """Frames, poses, intrinsics and events for radiance fields."""

    name = "nerf"
    about = "instant-ngp, nerfstudio, 3DGS (COLMAP text), LLFF's loaders and EventNeRF"
    needs = (two_frames, _poses, _exposed, _bounded)

    def write(self, source: Source, folder: Path) -> list[str]:
        frames, camera = frames_of(source), source.camera
        assert camera is not None, "its poses have the intrinsics"
        apart = not source.has(EXPOSURES) and sensor_pixels(source) is not None
        if apart:
            camera = rectified(camera)
        T_world_cam = _camera_poses(source, frames)
        write_frames(source, frames, folder)
        for name, content in _transforms(source, camera, frames, T_world_cam).items():
            write_bytes(folder / f"{name}.json", json.dumps(content, indent=1).encode())
        for name, lines in _colmap(camera, T_world_cam[:, 1]).items():
            write_lines(folder / f"sparse/0/{name}.txt", lines)
        write_bytes(folder / "poses_bounds.npy", encode_npy(_llff(source, camera, T_world_cam[:, 1])))
        for name in ("events.npz", "events.h5"):
            write_events(folder / name, source.events(), source.height, source.width, t_offset_us=source.start_us)
        for split in ("train", "validation"):
            _event_nerf(source, camera, frames, T_world_cam[:, 1], folder / "eventnerf" / split)
        return [f"{source.name}: {line}" for line in _notes(camera, frames, apart)]


def _camera_poses(source: Source, frames: Frames) -> np.ndarray:
    """Return T_world_cam at the start, middle and end of each exposure, (n, 3, 4, 4) float64."""
    if source.has(EXPOSURES):
        return read_exposure_poses(source.folder)["T_world_cam"]
    at = np.searchsorted(source.poses["t_ns"] // 1000, frames.t_us)
    return np.repeat(source.poses["T_world_cam"][at][:, None], 3, axis=1)


def _transforms(
    source: Source, camera: CameraModel, frames: Frames, T_world_cam: np.ndarray
) -> dict[str, dict[str, object]]:
    """Return the content of the JSON files by name."""
    about: dict[str, object] = {
        "camera_model": {"radtan": "OPENCV", "equidistant": "OPENCV_FISHEYE"}.get(camera.kind, "PINHOLE"),
        **dict(zip(("fl_x", "fl_y", "cx", "cy"), _intrinsics(camera))),
        **dict(zip(camera.coefficients, camera.distortion)),
        "w": camera.width,
        "h": camera.height,
        "camera_angle_x": 2 * math.atan(camera.width / (2 * camera.fx)),
        "is_fisheye": camera.kind == "equidistant",
    }
    blurred = source.has(EXPOSURES)
    if blurred:
        # instant-ngp: a pixel (u, v), 0 to 1, is exposed at a + b u + c v + d r of the exposure, r random from 0 to 1.
        line = read_exposures(source.folder)[0]
        share = line.exposure_us / (line.end_us - line.start_us)
        about["rolling_shutter"] = [0.0, 0.0, 1.0 - share, share]
    clock = (frames.t_us - frames.t_us[0]) / (frames.t_us[-1] - frames.t_us[0])
    matrices = (T_world_cam @ _TO_OPENGL).tolist()
    names = ("transform_matrix_start", "transform_matrix", "transform_matrix_end")

    def rows(numbers: Iterable[int], shown: str = "images") -> list[dict[str, object]]:
        return [
            {
                "file_path": f"{shown}/{k:06d}.png",
                "time": float(clock[k]),
                "t_us": int(frames.t_us[k]),
                **(dict(zip(names, matrices[k])) if blurred else {"transform_matrix": matrices[k][1]}),
            }
            for k in numbers
        ]

    every = range(len(matrices))
    val, test = every[_HOLD // 2 :: _HOLD], every[::_HOLD]
    splits = {"train": sorted({*every} - {*val, *test}), "val": val, "test": test}
    shown = {"train": "images", **dict.fromkeys(("val", "test"), "sharp" if frames.sharp else "images")}
    listed = {f"{split}_filenames": [row["file_path"] for row in rows(numbers)] for split, numbers in splits.items()}
    return {
        "transforms": {**about, **listed, "frames": rows(every)},
        **{f"transforms_{split}": {**about, "frames": rows(splits[split], shown[split])} for split in splits},
    }


def _intrinsics(camera: CameraModel) -> list[float]:
    """Return fx, fy, cx, cy with (0.5, 0.5) as the centre of the top-left pixel."""
    return [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _colmap(camera: CameraModel, T_world_cam: np.ndarray) -> dict[str, list[str]]:
    """Return the lines of COLMAP's text files by name. A second, empty line of an image says that it has no points."""
    # FULL_OPENCV: k1 k2 p1 p2 k3 k4 k5 k6, the last three of a denominator of 1.
    values = [*_intrinsics(camera), *camera.distortion, *([0.0] * 3 if camera.kind == "radtan" else [])]
    world = np.linalg.inv(T_world_cam)
    # SciPy's quaternions have w last, COLMAP's first.
    turns = Rotation.from_matrix(world[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    poses = [
        line
        for k, (turn, place) in enumerate(zip(turns, world[:, :3, 3]))
        for line in (f"{k + 1} {_text([*turn, *place])} 1 {k:06d}.png", "")
    ]
    return {
        "cameras": [f"1 {_COLMAP[camera.kind]} {camera.width} {camera.height} {_text(values)}"],
        "images": poses,
        "points3D": ["# no points: begin with random ones"],
    }


def _llff(source: Source, camera: CameraModel, T_world_cam: np.ndarray) -> np.ndarray:
    """Return the rows of ``poses_bounds.npy``, (n, 17) float64. Near and far are those of the whole sequence."""
    right, down, forward, place = (T_world_cam[:, :3, k] for k in range(4))
    size = np.broadcast_to([camera.height, camera.width, camera.fx], place.shape)
    matrices = np.stack([down, right, -forward, place, size], axis=2).reshape(len(place), 15)
    depths = np.concatenate([*_depths(source)])
    bounds = np.broadcast_to([depths.min(), depths.max()], (len(place), 2))
    return np.concatenate([matrices, bounds], axis=1)


def _depths(source: Source) -> Iterator[np.ndarray]:
    """Yield the least and the largest depth of each depth label that shows something, else those of boxes, of which
    there may be none either."""
    seen = False
    for k in range(source.count("depth")):
        depth = source.value("depth", k)
        if (hit := depth[np.isfinite(depth)]).size:
            seen = True
            yield np.array([hit.min(), hit.max()])
    if not seen and len(boxes := _depths_of_boxes(source)):
        yield boxes


def _depths_of_boxes(source: Source) -> np.ndarray:
    """Return the depths of the corners of all bodies' boxes at all labels, as far as they are not behind the near
    plane; (n,) float64, world units."""
    poses, boxes = source.poses, {row["id"]: row.get("box") for row in source.manifest.get("objects") or ()}
    depths = [np.empty(0)]
    for number, T_world_obj in zip(poses.get("object_ids", []), poses.get("T_world_obj", [])):
        if box := boxes.get(int(number)):
            # All eight corners, homogeneous: along each axis the low or the high end of the box.
            corners = np.array([*itertools.product(*zip(*box), (1.0,))])
            depths.append((np.linalg.inv(poses["T_world_cam"]) @ T_world_obj @ corners.T)[:, 2].ravel())
    every = np.concatenate(depths)
    return np.maximum(every, poses["near"]) if (every > poses.get("near", 0)).any() else np.empty(0)


def _event_nerf(source: Source, camera: CameraModel, frames: Frames, T_world_cam: np.ndarray, folder: Path) -> None:
    """Write one of EventNeRF's folders: events from the first frame, at 0 µs, to the last one; p is -1 or +1."""
    start, end = int(frames.t_us[0]), int(frames.t_us[-1])
    events = Events.concatenate([part.window(start, end + 1) for part in source.events()])
    columns = {"x": events.x, "y": events.y, "t": events.t - start, "p": 2 * events.p.astype(np.int8) - 1}
    write_bytes(folder / "events/events.npz", encoded(np.savez_compressed, **columns))
    fx, fy, cx, cy = _intrinsics(camera)
    lens = camera.distortion[:2] if camera.kind == "radtan" else (0.0, 0.0)
    # A 4x4 matrix of intrinsics, and k1 and k2 in a fifth row.
    rows = [[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1], [*lens, 0, 0]]
    for k, (file, pose) in enumerate(zip(frames.files, T_world_cam)):
        write_lines(folder / f"intrinsics/{k:06d}.txt", [_text(row) for row in rows])
        write_lines(folder / f"pose/{k:06d}.txt", [_text(row) for row in pose])
        write_bytes(folder / f"rgb/{k:06d}.png", file.read_bytes())


def _notes(camera: CameraModel, frames: Frames, apart: bool) -> list[str]:
    """Return what the formats cannot say of this sequence.   apart : whether its frames are rectified and its events
    are not."""
    middle = np.allclose(_intrinsics(camera)[2:], [camera.width / 2, camera.height / 2], atol=0.01)
    steps = np.diff(frames.t_us)
    # p1, p2 and k3 of radtan, and any lens of another kind.
    unknown = any(camera.distortion[2:]) or camera.kind not in ("pinhole", "radtan")
    checks = (
        (not middle or not np.isclose(camera.fx, camera.fy) or camera.coefficients,
         "poses_bounds.npy has one focal length, its principal point in the middle and no lens"),
        (steps.max() - steps.min() > 2, "EventNeRF's loader takes frames to be evenly spaced, and these are not"),
        (apart, "its frames are rectified, its events in the sensor's pixels (labels: {pixels: sensor})"),
        (unknown, "EventNeRF's loader knows k1 and k2 of radtan alone"),
        ((camera.width, camera.height) != _EVENTNERF_SIZE,
         f"EventNeRF's loader expects 346x260 px, and this is {camera.width}x{camera.height}"),
    )  # fmt: skip
    return [line for wrong, line in checks if wrong]
