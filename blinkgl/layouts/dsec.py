"""DSEC's folders (Gehrig et al., RA-L 2021, and the format page of the data set), and those that E-RAFT's loader opens.

    <split>/<sequence>/
      events/left/events.h5, rectify_map.h5        events/right/ likewise, of a stereo rig
      flow/forward/%06d.png, forward_timestamps.txt    backward likewise
      images/timestamps.txt                        two lines a label interval, as DSEC's images are
      images/left/ev_inf/%06d.png                  what the event camera's own lens sees, at the flow's times
      disparity/event/%06d.png, timestamps.txt     of a stereo rig with depth; 000000 is empty: loaders skip it
      calibration/cam_to_cam.yaml
      imu/imu.csv, imu.h5, imu.yaml …              of an inertial unit, as a sequence has them (EuRoC's, Kalibr's)

A file's number is its line in ``images/timestamps.txt``, which begins an interval before the first label, so flow k is
file 2k + 2, as in the published sequences: loaders count on the step of two, and on a number before each flow's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.camera.pinhole import rectify_map
from blinkgl.config.camchain import Calibrated, cam_to_cam_yaml
from blinkgl.io.dsec import DsecEventWriter, identity_rectify_map, write_rectify_map
from blinkgl.io.images import encode_png
from blinkgl.io.imu import made_again
from blinkgl.layouts.layout import Layout, Missing, events_before, forward_flow, need, write_bytes, write_lines
from blinkgl.layouts.source import Source

DISPARITY_SCALE = 256.0
_PARALLEL = 1e-6
"""Largest difference of two cameras' axes and rows for which a disparity is f b / Z."""
_INTERVAL_US = 100_000
"""Windows of E-RAFT, fixed in its loader."""


# DSEC's labels are in the rectified image; its loaders rectify only the events.
_rectified = need(
    "labels in rectified pixels",
    "labels: {pixels: rectified}",
    lambda source: source.camera is None or source.rectified,
)
_two_labels = need(
    "a second label",
    "time: {duration: 0.3, label_rate: 10}",
    lambda source: len(source.flow_times("forward")) != 1,
)


def _over_100_ms(source: Source) -> Missing | None:
    times = source.flow_times("forward")
    if all(b - a == _INTERVAL_US for a, b in times):
        return None
    rate = 1e6 / (times[0][1] - times[0][0])
    return Missing(f"flow over 100 ms (labels come at {rate:g} Hz)", "time: {label_rate: 10}")


class Dsec(Layout):
    """Training sequences with flow, and for a stereo rig with disparity."""

    name = "dsec"
    about = "DSEC's event slicer, bflow's loader of DSEC, eflow"
    size = (480, 640)
    needs = (forward_flow, _rectified)
    splits = ("train", "test")
    filled = ("train",)

    def opened_by(self, out: Path) -> str:
        """Return the loaders: DSEC's own provider requires a folder of disparities and both cameras' events in every
        sequence."""
        folders = [*out.glob("train/*")]
        if folders and all((f / "disparity/event").is_dir() and (f / "events/right").is_dir() for f in folders):
            return f"DSEC's provider, {self.about}"
        return f"{self.about} (not DSEC's provider, which asks for 'rig: stereo' and 'labels: {{disparity: true}}')"

    def write(self, source: Source, folder: Path) -> list[str]:
        lines = []
        if len(source.flow_times("forward")) == 1:
            lines.append(f"{source.name}: one label, and bflow's loader opens two or more")
        write_events(source, folder / "events/left")
        for towards in ("forward", "backward"):
            write_flow(source, towards, folder / "flow")
        times = image_times(source)
        write_lines(folder / "images/timestamps.txt", times)
        # Loaders pair images and times by number, so other frames are left out.
        for k, t in enumerate(source.image_times):
            if t in times:
                write_bytes(folder / f"images/left/ev_inf/{times.index(t):06d}.png", source.copied("images", k))
        if source.right is not None:
            write_events(source.right, folder / "events/right")
            lines += _write_disparity(source, source.right, folder / "disparity")
        if source.unit is not None:
            for name, content in made_again(source.unit).items():
                write_bytes(folder / name, content)
        if source.camera is not None:
            write_bytes(folder / "calibration/cam_to_cam.yaml", cam_to_cam(source, source.camera).encode())
        return lines


class ERaft(Layout):
    """E-RAFT's layout. Its loader reads only the folder ``test``, uses every second line of ``image_timestamps.txt``
    except the first and the last, and 100 ms of events on both sides of each."""

    name = "eraft"
    about = "E-RAFT's DSEC loader (test sequences, standard and warm start)"
    size = (480, 640)
    needs = (forward_flow, _rectified, _over_100_ms, _two_labels, events_before)
    filled = ("test",)

    def write(self, source: Source, folder: Path) -> list[str]:
        write_events(source, folder / "events_left")
        write_lines(folder / "image_timestamps.txt", image_times(source))
        rows = [f"{a}, {b}, {2 * k + 2}" for k, (a, b) in enumerate(source.flow_times("forward"))]
        header = "# from_timestamp_us, to_timestamp_us, file_index"
        write_lines(folder / "test_forward_flow_timestamps.csv", [header, *rows])
        write_flow(source, "forward", folder / "flow")
        return []


def image_times(source: Source) -> list[int]:
    """Return times of DSEC's images, µs: an interval before the flow labels, those of the labels, the end of the last,
    and the middle between any two."""
    times = source.flow_times("forward")
    begin, end = times[0]
    return [t for a, b in [(2 * begin - end, begin), *times] for t in (a, (a + b) // 2)] + [times[-1][1]]


def write_events(source: Source, folder: Path) -> None:
    """Write ``events.h5``, anew, since nothing but its events may be handed on, and ``rectify_map.h5``."""
    folder.mkdir(parents=True, exist_ok=True)
    with DsecEventWriter(
        folder / "events.h5", source.height, source.width, source.start_us, codec=source.codec
    ) as writer:
        writer.t_end_us = source.end_us
        for events in source.events():
            writer.append(events)
    camera = source.camera
    flat = camera is None or isinstance(camera, PinHole)
    table = identity_rectify_map(source.height, source.width) if flat else rectify_map(camera)
    # Beside events that h5py alone reads, the map must not need a plugin either.
    write_rectify_map(folder / "rectify_map.h5", table, codec=source.codec)


def write_flow(source: Source, towards: str, folder: Path) -> None:
    """Write ``forward`` or ``backward``: PNGs by number, and their times."""
    times = source.flow_times(towards)
    if not times:
        return
    for k in range(len(times)):
        write_bytes(folder / f"{towards}/{2 * k + 2:06d}.png", source.copied(f"flow_{towards}", k))
    write_lines(
        folder / f"{towards}_timestamps.txt",
        ["# from_timestamp_us, to_timestamp_us", *(f"{a}, {b}" for a, b in times)],
    )


def encode_disparity(disparity: np.ndarray) -> bytes:
    """Return a 16-bit PNG of round(256 d) of (H, W) px; not finite or <= 0: none. Values that round to 0, or of 256 px
    and more, have no code and become 0, "none"."""
    with np.errstate(invalid="ignore", over="ignore"):
        code = np.rint(np.asarray(disparity, np.float64) * DISPARITY_SCALE)
        holds = np.isfinite(code) & (code >= 1) & (code <= 65535)
    return encode_png(np.where(holds, code, 0).astype(np.uint16))


def _write_disparity(left: Source, right: Source, folder: Path) -> list[str]:
    baseline, camera = _baseline(left, right), left.camera
    if baseline is None or camera is None:
        return [f"{left.name}: no disparity: its cameras are not parallel, side by side and alike"]
    times = left.flow_times("forward")
    labelled = left.count("disparity") >= len(times)
    if not labelled and left.count("depth") < len(times):
        return [f"{left.name}: no disparity without 'labels: {{disparity: true}}'"]
    for k in range(len(times)):
        disparity = left.value("disparity", k) if labelled else camera.disparity(left.value("depth", k), baseline)
        write_bytes(folder / f"event/{2 * k + 2:06d}.png", encode_disparity(disparity))
    # DSEC's provider drops the first disparity, of a time without events before it.
    write_bytes(folder / "event/000000.png", encode_disparity(np.zeros((left.height, left.width))))
    # Every second time but the last: that of the empty disparity, then those of the labels.
    write_lines(folder / "timestamps.txt", image_times(left)[:-1:2])
    return []


def _baseline(left: Source, right: Source) -> float | None:
    """Return the baseline, world units; None where a disparity is not f b / Z."""
    eyes = left.camera, right.camera
    if eyes[0] is None or eyes[1] is None or not np.allclose(eyes[0].K, eyes[1].K, rtol=0, atol=1e-9):
        return None
    T_left_right = np.linalg.inv(left.poses["T_world_cam"]) @ right.poses["T_world_cam"]
    t = T_left_right[:, :3, 3]
    turned = np.abs(T_left_right[:, :3, :3] - np.eye(3)).max()
    # At all times the right camera must be at the same place on the left one's x axis.
    aside = np.abs(t - [t[0, 0], 0, 0]).max()
    parallel = t[0, 0] > 0 and max(turned, aside) < _PARALLEL * max(1.0, t[0, 0])
    return float(t[0, 0]) if parallel else None


def cam_to_cam(source: Source, camera: CameraModel) -> str:
    """Return DSEC's calibration: cam0 and, for a stereo rig, cam3 are event cameras; ``camRectX`` is the one without
    distortion; ``T_XY`` transforms points from Y to X."""
    right = source.right
    if right is None or right.camera is None:
        return cam_to_cam_yaml([Calibrated(camera)])
    T_right_left = np.linalg.inv(right.poses["T_world_cam"][0]) @ source.poses["T_world_cam"][0]
    tables = None
    if (baseline := _baseline(source, right)) is not None:
        # Q (x, y, disparity, 1) is the homogeneous point (X, Y, Z, W), with Z / W = f b / disparity.
        focal, _, cx, cy = camera.intrinsics
        Q = [[1.0, 0.0, 0.0, -cx], [0.0, 1.0, 0.0, -cy], [0.0, 0.0, 0.0, focal]]
        tables = {"cams_03": [[float(v) for v in row] for row in (*Q, [0.0, 0.0, 1 / baseline, 0.0])]}
    return cam_to_cam_yaml([Calibrated(camera), Calibrated(right.camera, T_right_left)], (0, 3), tables)
