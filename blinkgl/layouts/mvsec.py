"""MVSEC's files (Zhu et al., RA-L 2018; flow: RSS 2018).

    <split>/<sequence>_data.hdf5         davis/left/events (N, 4) f8 = x, y, t [s], ±1; image_raw (n, H, W) u1,
                                         image_raw_ts (n,) f8 s, image_raw_event_inds (n,) i8; imu (m, 6), imu_ts
    <split>/<sequence>_gt.hdf5           davis/left/depth_image_raw, depth_image_rect (n, H, W) f4, NaN: nothing;
                                         depth_image_raw_ts …; pose (n, 4, 4), pose_ts; flow_dist (n, 2, H, W)
    <split>/<sequence>_gt_flow_dist.npz  timestamps (n,) s; x_flow_dist, y_flow_dist (n, H, W) px from one to the next

``davis/right`` likewise, of a stereo rig. Without distortion raw and rectified images are the same. MVSEC has no mask:
(0, 0) says that there is no flow, so a valid flow of exactly 0 is written as 1e-6 px.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from blinkgl.io.atomic import output_errors
from blinkgl.io.imu import read_imu
from blinkgl.layouts.layout import Layout, append, forward_flow, growing, images, keep, new_hdf5, sensor_pixels
from blinkgl.layouts.source import Source

_ALMOST_NOTHING = np.float32(1e-6)


class Mvsec(Layout):
    """Events, grey images, depth, poses and flow of DAVIS cameras."""

    name = "mvsec"
    about = "EV-FlowNet's and later loaders of MVSEC (hdf5 and *_gt_flow_dist.npz), eflow"
    size = (260, 346)
    needs = (forward_flow, images, sensor_pixels)

    def folder(self, source: Source) -> str:
        return source.split

    def write(self, source: Source, folder: Path) -> list[str]:
        eyes = {"left": source, **({} if source.right is None else {"right": source.right})}
        for ending, write in (("data", _data), ("gt", _truth)):
            path = folder / f"{source.name}_{ending}.hdf5"
            with new_hdf5(path) as file:
                for eye, one in eyes.items():
                    write(one, file, f"davis/{eye}")
        times, flow = np.array([a * 1e-6 for a, _ in source.flow_times("forward")]), _flow(source)
        path = folder / f"{source.name}_gt_flow_dist.npz"
        with output_errors(path), open(path, "wb") as npz:
            np.savez(npz, timestamps=times, x_flow_dist=flow[:, 0], y_flow_dist=flow[:, 1])
        return [] if source.right else [f"{source.name}: no davis/right, which some loaders open (rig: stereo)"]


def _data(source: Source, file: h5py.File, group: str) -> None:
    rows = growing(file, f"{group}/events", np.float64, (4,))
    taken = np.array(source.image_times, np.int64)
    first = np.zeros(len(taken), np.int64)  # number of the first event that is not before the image
    for events in source.events():
        append(rows, np.stack([events.x, events.y, events.t * 1e-6, events.p * 2.0 - 1], axis=1))
        first += np.searchsorted(events.t, taken, side="left")
    pictures = growing(file, f"{group}/image_raw", np.uint8, (source.height, source.width), rows=1)
    for k in range(len(taken)):
        append(pictures, source.grey(k)[None])
    keep(file, f"{group}/image_raw_ts", taken * 1e-6)
    # Images after the last event get its number, and 0 where there is none.
    keep(file, f"{group}/image_raw_event_inds", np.minimum(first, max(len(rows) - 1, 0)))
    if source.unit is not None:
        imu = read_imu(source.unit)
        keep(file, f"{group}/imu", np.hstack([imu["acceleration"], imu["rate"]]))
        keep(file, f"{group}/imu_ts", imu["t_ns"] * 1e-9)


def _truth(source: Source, file: h5py.File, group: str) -> None:
    times = source.flow_times("forward")
    if 0 < len(times) <= source.count("depth"):
        for name in ("depth_image_raw", "depth_image_rect"):
            maps = growing(file, f"{group}/{name}", np.float32, (source.height, source.width), rows=1)
            for k in range(len(times)):
                depth = source.value("depth", k)
                append(maps, np.where(np.isfinite(depth), depth, np.float32(np.nan))[None])
            keep(file, f"{group}/{name}_ts", np.array([a * 1e-6 for a, _ in times]))
    keep(file, f"{group}/flow_dist", _flow(source))
    keep(file, f"{group}/flow_dist_ts", np.array([a * 1e-6 for a, _ in times]))
    if "T_world_cam" in source.poses:
        poses = source.poses["T_world_cam"]
        keep(file, f"{group}/pose", np.linalg.inv(poses[0]) @ poses)  # of the camera, in its first one's axes
        keep(file, f"{group}/pose_ts", source.poses["t_ns"] * 1e-9)


def _flow(source: Source) -> np.ndarray:
    """Return (n, 2, H, W) float32 px; where a flow is valid and 0, x is almost nothing."""
    flows = np.zeros((len(source.flow_times("forward")), 2, source.height, source.width), np.float32)
    for k in range(len(flows)):
        flow, valid = source.flow("forward", k)
        still = valid & (flow == 0).all(-1)
        flows[k, 0] = np.where(still, _ALMOST_NOTHING, np.where(valid, flow[..., 0], 0))
        flows[k, 1] = np.where(valid, flow[..., 1], 0)
    return flows
