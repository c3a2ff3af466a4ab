"""ROS 1 bags on the topics, messages and clock of ESIM's ``ros_publisher`` (rpg_esim, Rebecq et al., CoRL 2018).

    <split>/<sequence>.bag
      /cam0/events        dvs_msgs/EventArray, 10 ms each, stamped by their last event
      /cam0/image_raw     sensor_msgs/Image, mono8          /cam0/camera_info  sensor_msgs/CameraInfo
      /cam0/depthmap      sensor_msgs/Image, 32FC1          /cam0/optic_flow   esim_msgs/OpticFlow, px/s, NaN: none
      /imu                sensor_msgs/Imu                   /pose              geometry_msgs/PoseStamped, world to cam0

``/cam1/…`` likewise, of a stereo rig. ROS time is the sequence's own clock. Written by the package rosbags.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.io.atomic import output_errors
from blinkgl.io.imu import read_imu
from blinkgl.io.ros import FLOW, event_array, typestore
from blinkgl.layouts.layout import Layout, sensor_pixels
from blinkgl.layouts.source import Source

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_PACKET_US = 10_000
Message = tuple[int, str, str, Any]
"""Time, ns; topic; type; content: a message, or its bytes."""


class RosBag(Layout):
    """Events and all labels that ESIM's users know, as one bag a sequence."""

    name = "rosbag"
    about = "ROS 1 (rosbag, rqt_bag, rpg_dvs_ros), rosbags, evlib and what reads ESIM's bags"
    needs = (sensor_pixels,)

    def folder(self, source: Source) -> str:
        return source.split

    def write(self, source: Source, folder: Path) -> list[str]:
        store = typestore(ros2=False)
        from rosbags.rosbag1 import Writer

        eyes = [source, *([] if source.right is None else [source.right])]
        streams = itertools.chain.from_iterable(_camera(eye, f"/cam{k}", store) for k, eye in enumerate(eyes))
        # Each stream is in order of time, so that merging holds one message of each.
        whole = heapq.merge(*streams, _poses(source, store), _imu(source, store), key=lambda message: message[0])
        path = folder / f"{source.name}.bag"
        with output_errors(path), Writer(path) as bag:
            topics: dict[str, Any] = {}
            for t_ns, topic, kind, content in whole:
                if topic not in topics:
                    topics[topic] = bag.add_connection(topic, kind, typestore=store)
                data = content if isinstance(content, bytes) else store.serialize_ros1(content, kind)
                bag.write(topics[topic], t_ns, data)
        speeds = source.count("velocity") or not source.flow_times("forward")
        return (
            []
            if speeds
            else [f"{source.name}: optic_flow is the mean over a label interval (labels: {{velocity: true}})"]
        )


def _camera(source: Source, topic: str, store: Typestore) -> Iterator[Iterator[Message]]:
    """Yield the streams of one camera, each in order of time."""
    yield _events(source, f"{topic}/events")
    flows = source.flow_times("forward")
    times = _label_times(source)
    yield (
        (t * 1000, f"{topic}/camera_info", *_camera_info(source, t, store)) for t in times if source.camera is not None
    )
    make = lambda t, encoding, image: _image(store, t, encoding, image)
    shown = enumerate(source.image_times)
    yield ((t * 1000, f"{topic}/image_raw", _IMAGE, make(t, "mono8", source.grey(k))) for k, t in shown)
    deep = enumerate(times[: source.count("depth")])
    yield ((t * 1000, f"{topic}/depthmap", _IMAGE, make(t, "32FC1", source.value("depth", k))) for k, t in deep)
    moving = enumerate(times[: source.count("velocity") or len(flows)])
    yield ((t * 1000, f"{topic}/optic_flow", FLOW, _flow(source, k, t, store)) for k, t in moving)


def _label_times(source: Source) -> list[int]:
    """Return the times of the labels, µs, from whatever says them."""
    stamped = [source.image_times, *([a for a, _ in source.flow_times(towards)] for towards in ("forward", "backward"))]
    posed = [int(t) // 1000 for t in source.poses.get("t_ns", ())[1:]]  # the first is of the sequence's start
    return next((times for times in (*stamped, source.interval_times, posed) if times), [])


def _events(source: Source, topic: str) -> Iterator[Message]:
    for events in source.events():
        # A packet ends at whole multiples of its length, and at the end of a chunk.
        bounds = (
            np.arange(events.t[0] // _PACKET_US + 1, events.t[-1] // _PACKET_US + 1) * _PACKET_US if len(events) else []
        )
        for begin, end in itertools.pairwise([0, *np.searchsorted(events.t, bounds), len(events)]):
            part = events.part(slice(begin, end))
            if len(part):
                yield int(part.t[-1]) * 1000, topic, *event_array(part, source.height, source.width)


_IMAGE = "sensor_msgs/msg/Image"


def _header(store: Typestore, t_us: int, frame: str = "cam0") -> object:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=t_us // 10**6, nanosec=t_us % 10**6 * 1000)
    return store.types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id=frame)


def _image(store: Typestore, t_us: int, encoding: str, image: np.ndarray) -> object:
    """Return an image, or a map of float32, as a message."""
    rows = np.ascontiguousarray(image, np.uint8 if encoding == "mono8" else "<f4")
    size = {"height": image.shape[0], "width": image.shape[1], "step": rows.strides[0]}
    data = rows.view(np.uint8).ravel()
    return store.types[_IMAGE](header=_header(store, t_us), encoding=encoding, is_bigendian=0, data=data, **size)


def _flow(source: Source, k: int, t_us: int, store: Typestore) -> Any:
    """Return the flow in px/s as a message: the velocity at the time, else the mean over the label's interval."""
    if source.count("velocity"):
        speed = source.value("velocity", k)
    else:
        (begin, end), (flow, valid) = source.flow_times("forward")[k], source.flow("forward", k)
        speed = np.where(valid[..., None], flow * np.float32(1e6 / (end - begin)), np.float32(np.nan))
    u, v = (speed[..., axis].astype(np.float32).ravel() for axis in (0, 1))
    size = {"height": source.height, "width": source.width}
    return store.types[FLOW](header=_header(store, t_us), flow_x=u, flow_y=v, **size)


def _camera_info(source: Source, t_us: int, store: Typestore) -> tuple[str, object]:
    kind, camera = "sensor_msgs/msg/CameraInfo", source.camera
    assert camera is not None
    flat = isinstance(camera, PinHole)
    distortion = [0.0] * 5 if flat else [getattr(camera, name) for name in camera.coefficients]
    fx, fy, cx, cy = camera.intrinsics
    # R and P are those of a camera by itself: nothing is rectified, and P is K beside a column of zeros.
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return kind, store.types[kind](
        header=_header(store, t_us),
        height=source.height,
        width=source.width,
        distortion_model="plumb_bob" if flat or camera.kind == "radtan" else camera.kind,
        D=np.array(distortion, np.float64),
        K=np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1], np.float64),
        R=np.eye(3).ravel(),
        P=np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0], np.float64),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def _vector(store: Typestore, kind: str, values: np.ndarray) -> object:
    return store.types[f"geometry_msgs/msg/{kind}"](**dict(zip("xyzw", values.tolist())))


def _poses(source: Source, store: Typestore) -> Iterator[Message]:
    for t_ns, pose in zip(source.poses.get("t_ns", []), source.poses.get("T_world_cam", [])):
        place, turn = _vector(store, "Point", pose[:3, 3]), Rotation.from_matrix(pose[:3, :3]).as_quat()
        body = store.types["geometry_msgs/msg/Pose"](position=place, orientation=_vector(store, "Quaternion", turn))
        kind = "geometry_msgs/msg/PoseStamped"
        yield int(t_ns), "/pose", kind, store.types[kind](header=_header(store, int(t_ns) // 1000, "map"), pose=body)


def _imu(source: Source, store: Typestore) -> Iterator[Message]:
    if source.unit is None:
        return
    arrays, kind, unknown = read_imu(source.unit), "sensor_msgs/msg/Imu", np.zeros(9)
    for t_ns, rate, pull in zip(arrays["t_ns"].tolist(), arrays["rate"], arrays["acceleration"]):
        yield (
            t_ns,
            "/imu",
            kind,
            store.types[kind](
                header=_header(store, t_ns // 1000, "imu"),
                orientation=_vector(store, "Quaternion", np.array([0.0, 0.0, 0.0, 1.0])),
                orientation_covariance=np.array([-1.0, *unknown[1:]]),  # no orientation, by ROS' convention
                angular_velocity=_vector(store, "Vector3", rate),
                angular_velocity_covariance=unknown,
                linear_acceleration=_vector(store, "Vector3", pull),
                linear_acceleration_covariance=unknown,
            ),
        )
