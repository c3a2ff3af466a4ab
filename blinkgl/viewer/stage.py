"""The 3-D view: cameras, objects, points of the world, and events in x, y and time."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.errors import printable
from blinkgl.viewer.views import Body, CameraView, Cloud, Picture, SequenceView

if TYPE_CHECKING:
    import viser

LAYERS = {"points": "points (depth)", "boxes": "boxes", "tracks": "tracks"}
"""Parts of the world that can be switched off: key, and displayed name."""
_DEPTH = 1.3
"""Length of a window of events in 3-D, in widths of their picture."""
_EVENTS_AT = 2.1
"""Distance of the events from the world's middle, in radii."""
_EDGES = np.array(
    [[a, b] for a in np.ndindex(2, 2, 2) for b in np.ndindex(2, 2, 2) if a < b and sum(np.abs(np.subtract(a, b))) == 1]
)
"""(12, 2, 3): the edges of a box, by corners of 0 and 1."""
ON, OFF, _PALE = (40, 90, 235), (225, 50, 50), (170, 170, 180)
FOV = math.radians(45)
"""Field of view of the eye; viser's own 75 degrees make everything small."""
ASPECT = 1.6
"""Width over height of a saved page's view: half for the pictures, half for the world and the events below it."""
_HEIGHT = 4.4
"""Height of that view, in radii of the world."""


class Stage:
    """The nodes of a sequence: ``/world`` in its own axes (z up) and units, ``/events`` beside it. pictures : for a
    saved page, all in one view: ``/pictures`` on the left, the world and the events turned towards the eye."""

    def __init__(self, scene: viser.SceneApi, sequence: SequenceView, *, pictures: bool = False):
        self._scene, self._sequence = scene, sequence
        self._middle, self._radius = sequence.extent()
        self._turn = _facing(sequence)
        self._with_pictures = pictures
        self._shown: dict[str, Any] = {}
        self.world = scene.add_frame("/world", show_axes=False)
        self.space = scene.add_frame(
            "/events", show_axes=False, wxyz=_wxyz(self._turn), position=self._aside(_EVENTS_AT * self._radius)
        )
        self._cameras = [self._camera(s) for s in sequence.sensors if s.source.camera and s.source.poses]
        self._volumes = [s for s in sequence.sensors if s.event_count]
        for k, sensor in enumerate(self._volumes):
            self._volume(sensor, k)
        if pictures:
            self._arrange()
        if sequence.has_space:
            size = (2.4 if pictures else 4) * self._radius
            scene.add_grid("/world/grid", size, size, cell_size=size / 40, section_size=size / 8, cell_color=(225,) * 3,
                           section_color=(200,) * 3, position=(*self._middle[:2], 0.0))  # fmt: skip

    # ---- where one looks from ------------------------------------------------------------------------------------

    def _aside(self, distance: float) -> np.ndarray:
        return self._middle + distance * self._turn[:, 0]

    def views(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return, for each target, the position of the eye and the point that it looks at."""
        right, forward, up = self._turn.T
        radius, aside = self._radius, self._aside(_EVENTS_AT * self._radius)
        world = self._middle - 1.5 * radius * forward + 0.9 * radius * up - 1.3 * radius * right
        span = 1.2 * max(len(self._volumes), 1)
        at = aside + (span - 1.2) / 2 * radius * right - 0.5 * radius * _DEPTH * forward
        events = at - (1.4 + 0.9 * span) * radius * forward + 0.7 * radius * up + (0.7 + 0.6 * span) * radius * right
        distance = self._height() / (2 * math.tan(FOV / 2))
        return {
            "world": (world, self._middle),
            "events": (events, at),
            "all": (self._middle - distance * forward, self._middle),
        }

    def _height(self) -> float:
        """Return the height of the view in which everything stands; several volumes of events need more."""
        return self._radius * max(_HEIGHT, 1.9 * len(self._volumes))

    def _arrange(self) -> None:
        """Turn the world and the events as :meth:`views` sees them, and put them into the right half of the view."""
        views, height = self.views(), self._height()
        place = self._middle + 0.25 * ASPECT * height * self._turn[:, 0]
        halves = [name for name, there in (("world", self._sequence.has_space), ("events", self._volumes)) if there]
        for number, name in enumerate(halves):
            eye, at = views[name]
            forward = (at - eye) / np.linalg.norm(at - eye)
            right = np.cross(forward, self._turn[:, 2])
            right /= np.linalg.norm(right)
            # The rows are the axes of this view; the turn brings them onto the stage's own right, forward and up.
            turn = self._turn @ np.stack([right, forward, np.cross(right, forward)])
            up = 0.25 * height * (len(halves) - 1 - 2 * number) * self._turn[:, 2]
            node = {"world": self.world, "events": self.space}[name]
            rotation = turn @ (self._turn if name == "events" else np.eye(3))
            node.wxyz = _wxyz(rotation)
            node.position = place + up + turn @ (node.position - at)

    def has(self, layer: str) -> bool:
        """Return whether a layer of the world has anything."""
        sensors, start = self._sequence.sensors, self._sequence.start_us
        kinds = {
            "points": lambda s: s.depth_cloud(start),
            "boxes": lambda s: s.bodies(start) or None,
            "tracks": lambda s: s.track_cloud(start),
        }[layer]
        return any(kinds(s) is not None for s in sensors)

    # ---- what stays ----------------------------------------------------------------------------------------------

    def _camera(self, sensor: CameraView) -> tuple[CameraView, Any]:
        camera = sensor.source.camera
        assert camera is not None
        fx, fy, _, _ = camera.intrinsics
        frustum = self._scene.add_camera_frustum(
            f"/world/cameras/{sensor.name}",
            # The vertical angle of view, and width over height of the picture on the plane z = 1.
            2 * math.atan(camera.height / 2 / fy),
            camera.width * fy / (camera.height * fx),
            scale=0.08 * self._radius,
            thickness=2.0,
            thickness_units="screen",
            color=(30, 30, 40),
            cast_shadow=False,
        )
        path = sensor.camera_path
        if len(path) > 1:
            segments = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
            self._lines(f"/world/paths/{sensor.name}", segments, _PALE)
        return sensor, frustum

    def _volume(self, sensor: CameraView, k: int) -> None:
        """Add the frame of a window of events, and its text; its points come with the time."""
        tall, size = sensor.source.height / sensor.source.width, self._radius
        corners = (_EDGES - [0.5, 1.0, 0.5]) * [1, _DEPTH, tall] * size
        root = f"/events/{sensor.name}"
        self._scene.add_frame(root, show_axes=False, position=(1.2 * k * size, 0, 0))
        self._lines(f"{root}/frame", corners.astype(np.float32), _PALE)
        low = -0.53 * tall * size
        for name, text, at in (
            ("name", f"events, {sensor.name}", (0, -_DEPTH * size, -low)),
            ("x", "x", (0, -_DEPTH * size, low)),
            ("y", "y", (-0.53 * size, -_DEPTH * size, 0)),
        ):
            self._label(f"{root}/{name}", text, at)

    def _lines(self, name: str, segments: np.ndarray, colour: Any) -> Any:
        return self._scene.add_line_segments(name, segments, colour, thickness=1.5, thickness_units="screen")

    def _label(self, name: str, text: str, at: Sequence[float] | np.ndarray) -> object:
        return self._scene.add_label(
            name, text, position=np.array(at, float), font_screen_scale=0.85, anchor="center-center"
        )

    # ---- what is shown at a time ---------------------------------------------------------------------------------

    def show(
        self, t_us: int, window_us: int, pictures: dict[str, list[Picture]], layers: Collection[str] = tuple(LAYERS)
    ) -> None:
        """Show everything at a time. pictures : of each sensor, by its name, at that time."""
        for sensor, frustum in self._cameras:
            pose = sensor.camera_pose(t_us)
            assert pose is not None
            frustum.position, frustum.wxyz = pose[:3, 3], _wxyz(pose)
            image = _small(pictures[sensor.name][0].image) if pictures[sensor.name] else None
            if image is not None:
                frustum.image = image
        self._bodies(t_us, "boxes" in layers)
        # Of one camera: those of a rig see nearly the same.
        seen = next((c for s in self._sequence.sensors if (c := self._depth(s, t_us)) is not None), None)
        self._cloud("/world/points", [] if seen is None else [seen], 0.006 * self._radius, "points" in layers)
        followed = [c for s in self._sequence.sensors if (c := s.track_cloud(t_us)) is not None]
        self._cloud("/world/tracks", followed, 0.012 * self._radius, "tracks" in layers)
        for sensor in self._volumes:
            self._events(sensor, t_us, window_us, pictures[sensor.name])
        if self._with_pictures:
            self._wall(pictures)

    def _depth(self, sensor: CameraView, t_us: int) -> Cloud | None:
        """Return the cloud of the label's time, made once."""
        key, k = f"depth {sensor.name}", sensor.label(t_us)
        if self._shown.get(key, (None,))[0] != k:
            self._shown[key] = (k, sensor.depth_cloud(t_us))
        return self._shown[key][1]

    def _cloud(self, name: str, clouds: list[Cloud], size: float, visible: bool) -> None:
        if not clouds:
            return
        points = np.concatenate([c.points for c in clouds])
        if self._shown.get(name) is not None and np.array_equal(self._shown[name][1], points):
            self._shown[name][0].visible = visible
            return
        colours = np.concatenate([c.colours for c in clouds])
        near = points - self._middle  # as half floats: accurate to a thousandth of the scene's radius
        node = self._scene.add_point_cloud(
            name, near, colours, point_size=size, point_shape="circle", position=self._middle, visible=visible
        )
        self._shown[name] = (node, points)

    def _bodies(self, t_us: int, visible: bool) -> None:
        bodies: dict[str, Body] = {b.name: b for s in reversed(self._sequence.sensors) for b in s.bodies(t_us)}
        for body in bodies.values():
            segments = ((_EDGES - 0.5) * body.size).astype(np.float32)
            known = self._shown.get(f"box {body.name}")
            if known is None or not np.array_equal(known[1], segments):
                node = self._lines(f"/world/boxes/{printable(body.name).replace('/', ' ')}", segments, body.colour)
                known = self._shown[f"box {body.name}"] = (node, segments)
            known[0].position, known[0].wxyz = body.pose[:3, 3], _wxyz(body.pose)
            known[0].visible = visible

    def _events(self, sensor: CameraView, t_us: int, window_us: int, pictures: list[Picture]) -> None:
        (points, on), size, root = sensor.event_points(t_us, window_us), self._radius, f"/events/{sensor.name}"
        points = points[:, [0, 2, 1]] * [1, -_DEPTH, -1]
        for name, which, colour in (("ON", on, ON), ("OFF", ~on, OFF)):
            # Half floats of a picture's widths are accurate to a tenth of a pixel.
            self._scene.add_point_cloud(
                f"{root}/{name}", points[which], colour, point_size=0.004, scale=size, point_shape="circle"
            )
        tall = sensor.source.height / sensor.source.width
        for name, when, at in (("begins", t_us - window_us, 0.0), ("ends", t_us, -_DEPTH * size)):
            self._label(f"{root}/{name}", f"{when / 1000:.1f} ms", (0.62 * size, at, -0.5 * tall * size))
        frame = next((p.image for p in pictures if p.heading == "frame"), None)
        if frame is not None:
            self._image(f"{root}/picture", _small(frame), (0, 0.01 * size, 0), size)

    def _wall(self, pictures: dict[str, list[Picture]]) -> None:
        """Show all pictures, side by side."""
        several = len(pictures) > 1
        tracks = [
            (f"{name}: {one.heading}" if several else one.heading, one.image)
            for name, some in pictures.items()
            for one in some
        ]
        # In the left half of the view, as large as they can be, with a line of text above each.
        width, height = 0.48 * ASPECT * self._height(), 0.94 * self._height()
        tall = max((image.shape[0] / image.shape[1] for _, image in tracks), default=1.0)
        rows_of = lambda columns: math.ceil(len(tracks) / columns)
        size_of = lambda columns: min(width / columns, height / rows_of(columns) / (tall + 0.14))
        columns = max(range(1, max(len(tracks), 1) + 1), key=size_of)
        size, step = size_of(columns), (tall + 0.14) * size_of(columns)
        if "wall" not in self._shown:
            place = self._aside(-0.25 * ASPECT * self._height())
            self._shown["wall"] = self._scene.add_frame(
                "/pictures", show_axes=False, wxyz=_wxyz(self._turn), position=place
            )
        for number, (name, image) in enumerate(tracks):
            row, column = divmod(number, columns)
            at = np.array(
                [size * (column - (columns - 1) / 2), 0, step * ((rows_of(columns) - 1) / 2 - row) - 0.05 * size]
            )
            known, plain = self._shown.get(name), name.replace("/", " ")
            if known is None:  # beside the picture: nodes below another are removed when that is made again
                above = (0, 0, 0.5 * size * image.shape[0] / image.shape[1] + 0.03 * size)
                self._label(f"/pictures/names/{plain}", name, at + above)
            if known is None or not np.array_equal(known, image):
                self._image(f"/pictures/{plain}", _small(image), at, 0.96 * size)
            self._shown[name] = image

    def _image(self, name: str, image: np.ndarray, at: Sequence[float] | np.ndarray, width: float) -> None:
        """Add an upright picture: viser's lie in x and y, with y down."""
        self._scene.add_image(
            name,
            image,
            width,
            width * image.shape[0] / image.shape[1],
            wxyz=_wxyz(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])),
            position=np.array(at, float),
            cast_shadow=False,
            receive_shadow=False,
        )


def _facing(sequence: SequenceView) -> np.ndarray:
    """Return (3, 3) columns right, forward, up: level, in the first camera's initial direction."""
    for sensor in sequence.sensors:
        pose = sensor.camera_pose(sequence.start_us)
        if pose is not None and np.linalg.norm(pose[:2, 2]) > 1e-6:
            forward = np.array([*pose[:2, 2], 0.0]) / np.linalg.norm(pose[:2, 2])
            return np.stack([np.cross(forward, [0, 0, 1]), forward, [0, 0, 1]], axis=1)
    return np.eye(3)


def _wxyz(pose: np.ndarray) -> np.ndarray:
    """Return the quaternion of a (3, 3) rotation, or of that of a (4, 4) pose."""
    return np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)


def _small(image: np.ndarray) -> np.ndarray:
    """Return the image, at most 512 px wide."""
    if image.shape[1] <= 512:
        return image
    return cv2.resize(image, (512, round(image.shape[0] * 512 / image.shape[1])), interpolation=cv2.INTER_AREA)
