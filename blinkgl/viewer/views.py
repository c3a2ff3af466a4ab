"""The displayed data of a sequence at a time, as plain arrays: pictures, events, points and boxes in 3-D.

Times are µs on the sequence's clock. Labels and poses are known at label times: the last one is shown until the
next.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.camera.pinhole import rectified
from blinkgl.errors import AssetError
from blinkgl.io.colour import count_events, event_colour
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.images import read_image
from blinkgl.io.imu import H5 as IMU, read_imu
from blinkgl.io.pictures import TrackLines, id_colours, picture, with_boxes, with_tracks
from blinkgl.io.records import inside
from blinkgl.io.sequence_tables import EXPOSURES, TRACKS, picture_file, read_exposures, read_tracks
from blinkgl.labels import LABELS, Label
from blinkgl.layouts.source import Source
from blinkgl.sequence_files.index import made_folders
from blinkgl.sequence_files.rig_dir import read_sensors
from blinkgl.sequence_files.sequence_dir import MANIFEST, is_rig_folder, whole
from blinkgl.types.boxes import Boxes
from blinkgl.types.events import Events

EVERYWHERE = ("sky", "ground")
"""Objects around all others: they have no box, and their points would hide everything else."""
MAX_POINTS, MAX_EVENTS = 30_000, 15_000
"""Largest numbers in 3-D at a time, for browsers without a graphics card."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A displayed picture. heading : its unique title.   note : its time and scale, in words.   image : (H, W, 3)
    uint8."""

    heading: str
    note: str
    image: np.ndarray


@dataclass(frozen=True, eq=False)
class Cloud:
    """points (N, 3) float32; colours (N, 3) uint8."""

    points: np.ndarray
    colours: np.ndarray


@dataclass(frozen=True, eq=False)
class Body:
    """An object's box. colour (3,) uint8, of its id. size (3,) and pose (4, 4), from the box's axes and middle to the
    world's; world units."""

    name: str
    colour: np.ndarray
    size: np.ndarray
    pose: np.ndarray


class CameraView:
    """The displayed data of one camera of a sequence."""

    def __init__(self, source: Source, name: str):
        self.source, self.name = source, name
        poses_us = source.poses["t_ns"] // 1000 if source.poses else np.zeros(0, np.int64)
        self._poses_us = poses_us
        flows = [[a for a, _ in source.flow_times(way)] for way in ("forward", "backward")]
        # Label k is that of pose k + 1.
        self._label_us = np.array(poses_us[1:] if len(poses_us) else source.image_times or flows[0] or flows[1])
        size = (source.height, source.width)
        self._events = DsecEventReader(source.folder / "events.h5", size=size) if source.has("events.h5") else None
        self._exposures = read_exposures(source.folder) if source.has(EXPOSURES) else []
        self.tracks = read_tracks(source.folder) if source.has(TRACKS) else None
        self._known: dict[int, list[Picture]] = {}

    @property
    def event_count(self) -> int:
        return 0 if self._events is None else self._events.count

    def label(self, t_us: int) -> int:
        """Return the number of the last label at or before a time; the first one before that. The last image may have
        no labels of its own: it keeps those before it."""
        return min(self._image(t_us), self._last_label)

    def _image(self, t_us: int) -> int:
        return max(int(np.searchsorted(self._label_us, t_us, side="right")) - 1, 0)

    @cached_property
    def _last_label(self) -> int:
        last = len(self._label_us) - 1
        files = [label.forms[0].file for name, label in LABELS.items() if name != "images"]
        return next((k for k in (last, last - 1) if any(self.source.has(file(k)) for file in files)), last)

    # ---- pictures ------------------------------------------------------------------------------------------------

    def pictures(self, t_us: int, window_us: int) -> list[Picture]:
        """Return all pictures of a time: frame, images of a frame camera, events of [t - window, t), then labels, those
        of motion first. Missing kinds are left out."""
        pictures = [*self._frame(t_us), *self._of_frame_camera(t_us)]
        if self._events is not None:
            events = self.events(t_us, window_us)
            counts = np.zeros((2, self.source.height, self.source.width), np.uint16)
            count_events(events.x, events.y, events.p, counts)
            span = f"{(t_us - window_us) / 1000:.1f}–{t_us / 1000:.1f} ms"
            pictures.append(Picture("events", f"{span}, {len(events):,}, ON blue, OFF red", event_colour(counts)))
        k = self.label(t_us)
        if k not in self._known:
            self._known = {k: self._of_label(k)}  # playing reads each file once
        return pictures + self._known[k]

    def _frame(self, t_us: int) -> list[Picture]:
        """Return the image at the last label's time, with the objects' boxes and the tracks of points over it."""
        k = self._image(t_us)
        has_image, boxes = self.source.has(LABELS["images"].forms[0].file(k)), self._boxes(k)
        if not has_image and boxes is None and self.tracks is None:
            return []
        image = self.source.image(k) if has_image else np.full((self.source.height, self.source.width, 3), 24, np.uint8)
        when = f"{self._label_us[k] / 1000:.1f} ms" if len(self._label_us) else ""
        if boxes is not None:
            image, when = with_boxes(image, boxes), f"{when}, boxes"
        if self.tracks is not None:
            size = np.array([self.source.width, self.source.height])
            times, px, occluded, of = (self.tracks[n] for n in ("t_us", "target_points", "occluded", "instance"))
            image = with_tracks(image, TrackLines(times, px, occluded, of, size), t_us)
            when += f", tracks at {t_us / 1000:.1f} ms"
        return [Picture("frame", when, image)]

    def _of_frame_camera(self, t_us: int) -> list[Picture]:
        """Return the images with the last completed exposure; before that the first."""
        if not self._exposures:
            return []
        about = self.source.manifest["frame_camera"]
        ends = [one.end_us for one in self._exposures]
        k = max(int(np.searchsorted(ends, t_us, side="right")) - 1, 0)
        pictures = []
        for name in about["pictures"]:
            codes = read_image(self.source.folder / picture_file(name, k))
            # The upper eight of the codes' bits.
            shown = (codes.astype(np.uint32) >> (about["bits"] - 8)).astype(np.uint8)
            shown = np.repeat(shown[..., None], 3, axis=2) if shown.ndim == 2 else shown
            heading = "frame camera" if name == "images" else f"frame camera, {name}"
            note = f"{self._exposures[k].middle_us / 1000:.1f} ms, exposed {self._exposures[k].exposure_us / 1000:g} ms"
            pictures.append(Picture(heading, note, shown))
        return pictures

    def _of_label(self, k: int) -> list[Picture]:
        pictures = []
        for label in sorted(LABELS.values(), key=_rank):
            form = label.forms[0]
            if form.read is None or not self.source.has(form.file(k)):
                continue
            value = self.source.value(label.name, k)
            views = [view for view in label.views if not (view.kind == "mask" and len(label.views) > 1)]
            for view in views:
                image, legend = picture(view.kind, view.of(value))
                pictures.append(Picture(view.title, self._note(k, legend, view.unit), image))
        return pictures

    def _note(self, k: int, legend: Mapping[str, object], unit: str) -> str:
        when = f"{self._label_us[k] / 1000:.1f} ms"
        if legend["kind"] == "wheel":
            return f"{when}, full colour {legend['high']:.3g} {unit}"
        return f"{when}, {legend['low']:.3g}–{legend['high']:.3g} {unit}" if legend["kind"] == "bar" else when

    def _boxes(self, k: int) -> Boxes | None:
        file = LABELS["boxes"].forms[0].file(k)
        return self.source.value("boxes", k) if self.source.has(file) else None

    # ---- events --------------------------------------------------------------------------------------------------

    def events(self, t_us: int, window_us: int) -> Events:
        """Return the events of [t - window, t)."""
        assert self._events is not None, self.name
        return self._events.slice(t_us - window_us, t_us)

    def event_points(self, t_us: int, window_us: int) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, 3) float32 and (N,) bool: events of [t - window, t) as points, and which are ON. x and y go from
        -0.5 to 0.5 of the picture's width, right and down, z from 0, a window ago, to 1, now. Every n-th where there
        are more than :data:`MAX_EVENTS`."""
        events = self.events(t_us, window_us)
        some = slice(None, None, 1 + len(events) // MAX_EVENTS)
        width, height = self.source.width, self.source.height
        x = (events.x[some] - (width - 1) / 2) / width  # the centre of the picture is between its middle pixels
        y = (events.y[some] - (height - 1) / 2) / width
        z = (events.t[some] - (t_us - window_us)) / window_us
        return np.stack([x, y, z], axis=-1).astype(np.float32), events.p[some] > 0

    def usual_window_us(self) -> int:
        """Return a window with a readable picture: an event in about three pixels."""
        span = max(self.source.end_us - self.source.start_us, 1)
        wanted = self.source.height * self.source.width / 3
        steps = 1000 * np.array([1, 2, 5, 10, 20, 50, 100])
        # The nearest step on a logarithmic scale.
        return int(steps[np.argmin(abs(np.log(steps) - np.log(wanted * span / max(self.event_count, 1))))])

    # ---- space ---------------------------------------------------------------------------------------------------

    def _pose(self, t_us: int) -> int:
        return max(int(np.searchsorted(self._poses_us, t_us, side="right")) - 1, 0)

    def camera_pose(self, t_us: int) -> np.ndarray | None:
        """Return T_world_cam (4, 4), OpenCV's axes; None where a recording has none."""
        return self.source.poses["T_world_cam"][self._pose(t_us)] if self.source.poses else None

    @property
    def camera_path(self) -> np.ndarray:
        """Return the positions of the camera, (M, 3)."""
        return self.source.poses["T_world_cam"][:, :3, 3] if self.source.poses else np.zeros((0, 3))

    def label_camera(self) -> CameraModel | None:
        """Return the camera whose pixels labels use."""
        camera = self.source.camera
        return rectified(camera) if camera is not None and self._is_rectified(camera) else camera

    def _is_rectified(self, camera: CameraModel) -> bool:
        return not isinstance(camera, PinHole) and self.source.rectified

    def bodies(self, t_us: int) -> list[Body]:
        """Return boxes of the objects, without :data:`EVERYWHERE`, at the last label: those of ``boxes`` for visible
        objects, else those of the shapes at rest."""
        poses, m = self.source.poses, self._pose(t_us)
        seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        if len(self._label_us) and self._label_us[0] <= t_us and (boxes := self._boxes(self.label(t_us))) is not None:
            seen = {int(i): (s, T) for i, s, T in zip(boxes.instance, boxes.size, boxes.T_world_box)}
        at_rest = {one["id"]: one["box"] for one in self.source.manifest.get("objects", ()) if one.get("box")}
        bodies = []
        for row, number in enumerate(map(int, poses.get("object_ids", ()))):
            if number in self._everywhere() or number not in {*at_rest, *seen}:
                continue
            # The lower and the upper corner of the box at rest.
            low, high = np.array(at_rest.get(number, np.zeros((2, 3))), float)
            middle = np.eye(4)
            middle[:3, 3] = (low + high) / 2
            size, pose = seen.get(number, (high - low, poses["T_world_obj"][row, m] @ middle))
            colour = id_colours(np.array([number]))[0]
            bodies.append(Body(str(poses["object_names"][row]), colour, size, pose))
        return bodies

    def _everywhere(self) -> set[int]:
        poses = self.source.poses
        kinds = poses.get("object_categories", poses.get("object_names", ()))
        return {int(i) for i, kind in zip(poses.get("object_ids", ()), kinds) if kind in EVERYWHERE}

    def depth_cloud(self, t_us: int) -> Cloud | None:
        """Return the points of the last label's depth in the world, in the image's colours (else the ids', else grey),
        without sky and ground: by ids, or else points inside some object's box. None: no depth, or no poses."""
        k, camera = self.label(t_us), self.label_camera()
        form, pose = LABELS["depth"].forms[0], self.camera_pose(int(self._label_us[k]) if len(self._label_us) else 0)
        if not self.source.has(form.file(k)) or camera is None or pose is None:
            return None
        depth = self.source.value("depth", k)
        ids = self.source.value("ids", k) if self.source.has(LABELS["ids"].forms[0].file(k)) else None
        shown = np.isfinite(depth)
        if ids is not None:
            shown &= ~np.isin(ids, [0, *self._everywhere()])
        y, x = np.nonzero(shown)
        some = slice(None, None, 1 + len(x) // MAX_POINTS)
        y, x = y[some], x[some]
        rays = camera.rays(np.stack([x, y], axis=-1).astype(float))  # pixel centres are at whole numbers
        # Each ray is scaled to z = 1, as depth is along z; points are rows, so the rotation is transposed.
        points = rays / rays[:, 2:] * depth[y, x, None] @ pose[:3, :3].T + pose[:3, 3]
        if self.source.has(LABELS["images"].forms[0].file(k)):
            colours = self.source.image(k)[y, x]
        else:
            colours = np.full((len(x), 3), 160, np.uint8) if ids is None else id_colours(ids[y, x])
        if ids is None and (bodies := self.bodies(int(self._label_us[k]))):
            inside = np.any([_inside(points, body) for body in bodies], axis=0)
            points, colours = points[inside], colours[inside]
        return Cloud(points.astype(np.float32), colours)

    def track_cloud(self, t_us: int) -> Cloud | None:
        """Return tracked points in the world at their last time, in their objects' colours, hidden ones grey."""
        if self.tracks is None:
            return None
        m = max(int(np.searchsorted(self.tracks["t_us"], t_us, side="right")) - 1, 0)
        colours = id_colours(self.tracks["instance"])
        colours[self.tracks["occluded"][:, m]] = 130
        return Cloud(self.tracks["points_world"][:, m].astype(np.float32), colours)

    def close(self) -> None:
        if self._events is not None:
            self._events.close()


def _rank(label: Label) -> int:
    """Return a sort key: flow first, then other motion; the rest in the table's order."""
    return 2 if label.kind != "motion" else int(label.towards is None)


def _inside(points: np.ndarray, body: Body) -> np.ndarray:
    """Return (N,) bool: which of (N, 3) points lie in a body's box, or within a hundredth of its size of it."""
    # Points are rows, so the rotation without a transpose leads from the world to the body's axes.
    local = (points - body.pose[:3, 3]) @ body.pose[:3, :3]
    return np.all(abs(local) <= 0.51 * body.size + 1e-3, axis=1)


class SequenceView:
    """A sequence, or a rig's: its cameras and inertial units, on one clock."""

    def __init__(self, folder: Path):
        """Open a sequence. Raises AssetError: damaged, or it has nothing to show."""
        self.folder, self.name = folder, folder.name
        whole(folder)
        rig = is_rig_folder(folder)
        places = {name: inside(folder, name) for name in read_sensors(folder)} if rig else {"camera": folder}
        cameras = {name: place for name, place in places.items() if (place / MANIFEST).is_file()}
        self.sensors = [CameraView(Source.open(place), name) for name, place in cameras.items()]
        units = {name if rig else "imu": place for name, place in places.items() if (place / IMU).is_file()}
        self.units = {name: unit for name, place in units.items() if len((unit := read_imu(place))["t_ns"]) > 1}
        self.start_us = min((s.source.start_us for s in self.sensors), default=0)
        self.end_us = max((s.source.end_us for s in self.sensors), default=0)
        for unit in self.units.values():
            self.end_us = max(self.end_us, int(unit["t_ns"][-1] // 1000))
        if self.end_us <= self.start_us or not (self.units or any(s.pictures(self.end_us, 1) for s in self.sensors)):
            raise AssetError("the sequence is empty", where=str(folder))

    @property
    def has_space(self) -> bool:
        return any(s.source.poses for s in self.sensors)

    def extent(self) -> tuple[np.ndarray, float]:
        """Return the middle (3,) and radius of the cameras' paths and of the objects at the start."""
        bodies = [b.pose[:3, 3] for s in self.sensors for b in s.bodies(self.start_us)]
        places = np.concatenate([s.camera_path for s in self.sensors] + [np.reshape(bodies, (-1, 3))])
        if not len(places):
            return np.zeros(3), 1.0
        middle = np.median(places, axis=0)
        # Nine tenths of all places, so that one that is far away does not make the others small.
        return middle, max(float(np.quantile(np.linalg.norm(places - middle, axis=1), 0.9)), 1e-3)

    def close(self) -> None:
        for sensor in self.sensors:
            sensor.close()


def sequences_in(path: str | Path) -> list[Path]:
    """Return folders of the sequences at or below a path, in order; of a rig its own. Raises AssetError: there are
    none."""
    path = Path(path)
    if not path.is_dir():
        raise AssetError("no such folder", where=str(path), accepted="a sequence, or a folder of sequences")
    if not (folders := list(made_folders(path))):
        raise AssetError(
            "the folder has no sequence", where=str(path), accepted="a folder that 'blinkgl generate' wrote"
        )
    return folders
