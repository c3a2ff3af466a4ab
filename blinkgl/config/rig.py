"""The ``rig:`` and ``sensors:`` sections: several sensors on one moving body.

    rig: stereo                                   # a preset: its sensors; keys given beside it override it
    sensors:
      - {name: right, place: {position: [0.2, 0, 0]}}       # laid over the preset's sensor of this name
      - {name: imu, imu: {rate: 400}}                       # a further sensor

A sensor's table has the sections of a single camera's configuration (:data:`SECTIONS`). Sections of :data:`INHERITED`
that it does not give come from the top level. This module works on plain trees, after distributions have been drawn and
before validation, so that its result is complete.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from blinkgl.camera import PinHole
from blinkgl.config.base import Config, Refused, at_most_one, rule
from blinkgl.config.camera import CameraConfig
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.images import ImagesConfig
from blinkgl.config.labels import LabelsConfig
from blinkgl.config.over_time import ImuConfig, TracksConfig
from blinkgl.config.poses import Matrix, check_rigid, rigid_matrix, some_rotation
from blinkgl.config.reader import merge, shipped
from blinkgl.config.readout import ReadoutConfig
from blinkgl.config.sensor import Sensor
from blinkgl.config.values import Position, Vector3
from blinkgl.errors import ConfigError
from blinkgl.types.poses import pose_of
from blinkgl.types.trees import Tree

SECTIONS = ("camera", "sensor", "events", "readout", "labels", "images", "imu", "tracks")
"""Sections of a single camera's configuration that each sensor has."""
INHERITED = ("camera", "sensor", "events", "readout", "labels")
"""Sections that a sensor inherits from the top level. The others apply only to a sensor that gives them."""
_SHARED = ("time", "timeline")


class PlaceConfig(Config):
    """T_rig_sensor, from the sensor's axes to the rig's (docs/rigs.md)."""

    position: Position = Field((0.0, 0.0, 0.0), description="m, in the rig's axes: x right, y down, z forward")
    euler: Vector3 | None = Field(None, description="degrees about the rig's x, y, z axes, applied in this order")
    quaternion: tuple[float, float, float, float] | None = Field(
        None, description="[w, x, y, z], normalised automatically"
    )
    matrix: Matrix | None = Field(
        None,
        description="T_rig_sensor, instead of the others; rounded rotations are made exact",
    )

    _one_orientation = at_most_one("euler", "quaternion", "matrix")
    _some_rotation = some_rotation

    @rule("matrix", "position")
    def _whole_place(matrix, position):
        if matrix is not None:
            if any(position):
                raise Refused("the matrix contains the position", where="position", value=list(position))
            check_rigid(matrix, "matrix")

    @property
    def T(self) -> np.ndarray:
        """Return T_rig_sensor, (4, 4) float64."""
        from scipy.spatial.transform import Rotation

        if self.matrix is not None:
            return rigid_matrix(self.matrix)
        turn = Rotation.identity()
        if self.euler is not None:
            turn = Rotation.from_euler("xyz", self.euler, degrees=True)
        elif self.quaternion is not None:
            w, x, y, z = self.quaternion
            turn = Rotation.from_quat([x, y, z, w])
        return pose_of(self.position, turn.as_matrix())


def _sensor_name(name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
        raise Refused(
            "not a name for folders",
            value=name,
            accepted="a letter or digit, then letters, digits, '_' and '-', at most 64",
        )
    return name


class RigSensorConfig(Config):
    """One device on a rig: an event camera, a frame camera, an inertial unit, or several in one housing that share one
    lens. `events` is as at the top level, but absent for a sensor with `images`, or with `imu` and no `camera`, that
    does not give it."""

    name: Annotated[str, AfterValidator(_sensor_name)] = Field(
        description="name of its folder in the sequence's folder"
    )
    place: PlaceConfig = Field(PlaceConfig(), description="pose on the rig; {}: where a single camera would be")
    pair: str | None = Field(
        None, description="name of the other camera of a rectified stereo pair, for `labels.disparity`"
    )
    camera: CameraConfig = Field(CameraConfig(), description="as at the top level, whose keys it inherits")
    sensor: Sensor | None = Field(None, description="as at the top level")
    events: EmulatorConfig | None = Field(None, description="as at the top level, whose keys it inherits")
    readout: ReadoutConfig | None = Field(None, description="as at the top level")
    labels: LabelsConfig = Field(
        default_factory=LabelsConfig,
        description="as at the top level; a camera without events has only those given here",
    )
    images: ImagesConfig | None = Field(None, description="a frame camera (docs/cameras.md)")
    imu: ImuConfig | None = Field(None, description="an inertial unit, with position and rotation in the sensor's axes")
    tracks: TracksConfig | None = Field(None, description="points on surfaces, followed through this camera")

    @property
    def sees(self) -> bool:
        """Return whether it is a camera: of events, of images, or of labels alone."""
        labelled = self.tracks is not None or self.labels != LabelsConfig(images=False, flow=())
        return self.events is not None or self.images is not None or labelled


def is_rig(tree: object) -> bool:
    """Return whether a configuration has several sensors."""
    return isinstance(tree, dict) and (tree.get("rig") is not None or tree.get("sensors") is not None)


def check_one_lens(tree: Mapping[str, object]) -> None:
    """Raise ConfigError where the top level has a calibration and a sensor has a camera of its own: keys of both would
    be one lens."""
    camera = tree.get("camera")
    if isinstance(camera, dict) and camera.get("calibration") is not None and is_rig(tree):
        for one in with_preset(tree)["sensors"]:
            own = one.get("camera")
            if isinstance(own, dict) and own.get("calibration") is None and set(own) - {"near"}:
                raise ConfigError(
                    f"sensor '{one.get('name')}' has a camera of its own",
                    where="camera.calibration",
                    value=camera["calibration"],
                    accepted="one for each: sensors: [{name: …, camera: {calibration: …, calibration_name: …}}]",
                )


def spelled_out(tree: dict[str, object], fills: Iterable[Callable[[dict[str, object]], dict[str, object]]]) -> Tree:
    """Return ``tree`` with every sensor of its rig, if it is one, complete: the sensor's own keys over the preset's,
    both over the top level's sections, then completed by ``fills`` as a single camera's sections. Repeating it changes
    nothing.

    Raises ConfigError for an unknown rig, no list of sensors or an empty one, two sensors of one name, or sections that
    a sensor cannot have."""
    if not is_rig(tree):
        return tree
    for key in ("images", "imu", "tracks"):
        if tree.get(key) is not None:
            raise ConfigError(
                "belongs to a sensor, not to the rig",
                where=key,
                accepted=f"{key} in one of `sensors`",
            )
    tables = with_preset(tree)["sensors"]
    if not tables:
        raise ConfigError("the rig has no sensor", where="sensors", value=tables, accepted="one or more")
    return {**tree, "sensors": [_complete(one, k, tree, fills) for k, one in enumerate(tables)]}


def with_preset(tree: Mapping[str, object]) -> Tree:
    """Return ``tree`` with its own sensors laid over those of its preset. Repeating it changes nothing. Raises
    ConfigError for an unknown rig, no list of sensors, or two of one name."""
    sensors = tree.get("sensors")
    own = [] if sensors is None else sensors
    if not isinstance(own, list):
        raise ConfigError("not a list", where="sensors", value=own, accepted="- {name: left, …}")
    for k, one in enumerate(own):
        if not isinstance(one, dict):
            raise ConfigError("not a table of keys", where=f"sensors.{k}", value=one, accepted="{name: left, …}")
    base = [] if tree.get("rig") is None else shipped("rigs", tree["rig"], "rig", "rig")["sensors"]
    return {**tree, "sensors": _laid(own, base)}


def _laid(own: list[dict[str, object]], base: list[dict[str, object]]) -> list[dict[str, object]]:
    """Return a preset's sensors, in its order, with those of the same names laid over them, then the others."""
    by_name: dict[object, dict[str, object]] = {}
    for k, one in enumerate(own):
        name = one.get("name")
        # Names are folders, and some file systems do not tell upper from lower case. No text is refused later.
        low = name.lower() if isinstance(name, str) else k
        if low in by_name:
            raise ConfigError(
                "two sensors have the same name",
                where=f"sensors.{k}.name",
                value=name,
                accepted="different names, ignoring case",
            )
        by_name[low] = one
    under = {one["name"]: one for one in base}
    return [
        *(_over_preset(one, by_name[name]) if name in by_name else one for name, one in under.items()),
        *(copy.deepcopy(one) for name, one in by_name.items() if name not in under),
    ]


def _over_preset(preset: dict[str, object], own: dict[str, object]) -> Tree:
    """Return a preset's sensor with its own keys laid over it: another way to give the focal length or the place, as a
    calibration does, takes the place of the preset's."""
    preset, place = copy.deepcopy(preset), own.get("place")
    _drop_other_focal(preset.get("camera"), own.get("camera"))
    if isinstance(place, dict) and place.get("matrix") is not None:
        preset.pop("place", None)
    return merge(preset, own)


_UNSAID = CameraConfig().model_dump(mode="json")
"""The camera that a sequence's own configuration has for a sensor without one."""


def _complete(
    own: dict[str, object],
    number: int,
    tree: dict[str, object],
    fills: Iterable[Callable[[dict[str, object]], dict[str, object]]],
) -> Tree:
    for key in _SHARED:
        if key in own:
            raise ConfigError(
                "the sensors of a rig share the clock and the timeline",
                where=f"sensors.{number}.{key}",
                accepted=f"{key} at the top level",
            )
    # Without a word about events, a sensor with images or an inertial unit alone has none.
    lens = any(own.get(key) is not None for key in ("camera", "sensor"))
    other = own.get("images") is not None or (own.get("imu") is not None and not lens)
    events = own["events"] is not None if "events" in own else not other
    camera = events or any(own.get(key) for key in ("labels", "tracks")) or own.get("images") is not None
    for key in ("readout",) if camera else ("camera", "sensor", "readout"):
        if not events and own.get(key) is not None and not (key == "camera" and own[key] == _UNSAID):
            raise ConfigError(
                "is not used: the sensor has no " + ("events" if camera else "camera"),
                where=f"sensors.{number}.{key}",
                accepted="events: {} beside it, or without this key",
            )
    # The run's own sections lie below the sensor's; those that it cannot have are left out.
    keys = [key for key in INHERITED if key in tree and (events or key in ("camera", "sensor"))]
    sections = {key: own[key] for key in SECTIONS if key in own and (events or key not in ("events", "readout"))}
    above = {key: copy.deepcopy(tree[key]) for key in keys if camera}
    _drop_other_focal(above.get("camera"), sections.get("camera"))
    sections = merge(above, sections)
    if not events and "labels" not in own:
        sections["labels"] = {"images": False, "flow": []}
    if events:
        sections.setdefault("events", {})
    for fill in fills:
        sections = fill(sections)
    if not events:
        sections |= {"events": None, "readout": None}
    rest = {key: value for key, value in own.items() if key not in SECTIONS}
    return {**rest, **{key: sections[key] for key in SECTIONS if key in sections}}


_FOCAL = (("fov",), ("focal",), ("fx", "fy"))
"""Alternative ways to give the focal length; a camera has one."""


def _drop_other_focal(above: object, own: object) -> None:
    """Drop the top level's focal length where a sensor gives its own in another way."""
    if isinstance(above, dict) and isinstance(own, dict):
        used = {key for keys in _FOCAL if any(own.get(key) is not None for key in keys) for key in keys}
        for key in {key for keys in _FOCAL for key in keys} - used if used else ():
            above.pop(key, None)


def check_pairs(sensors: Sequence[RigSensorConfig]) -> None:
    """Raise ConfigError where a sensor's `pair` is not a camera of the rig or the two are not a rectified pair: they
    need the same camera model and poses that differ only along their common x axis."""
    for k, one in enumerate(sensors):
        where = f"sensors.{k}.pair"
        if one.pair is None:
            if one.sees and getattr(one.labels, "disparity", False):
                raise ConfigError(
                    "this sensor has no pair",
                    where=f"sensors.{k}.labels.disparity",
                    accepted=f"false, or a `pair` for '{one.name}'",
                )
            continue
        others = {other.name: other for other in sensors if other is not one and other.sees}
        if one.pair not in others or not one.sees:
            raise ConfigError("no such camera on the rig", where=where, value=one.pair, accepted=", ".join(others))
        if baseline_of(one, others[one.pair]) is None:
            raise ConfigError(
                "the two are not a rectified pair",
                where=where,
                value=one.pair,
                accepted="equal `camera` keys without distortion, equal rotations, and positions that differ "
                "only along the cameras' x axis",
            )


def baseline_of(one: RigSensorConfig, other: RigSensorConfig | None) -> float | None:
    """Return the distance along the x axis of ``one`` to ``other``, m; None where the two are not a rectified pair."""
    if other is None:
        return None
    a, b = one.camera.model, other.camera.model
    if a != replace(b, near=a.near) or not isinstance(a, PinHole):
        return None
    away = np.linalg.inv(one.place.T) @ other.place.T
    apart = float(away[0, 3])
    straight = np.abs(away[:3, :3] - np.eye(3)).max() < 1e-9 and np.abs(away[1:3, 3]).max() <= 1e-9 * abs(apart)
    return apart if straight and apart else None
