"""Trajectories of other programs, as poses of a body in the world, T_world_body, with OpenCV's axes.

    tum, orbslam    t x y z qx qy qz qw                  s; a camera in the world
    euroc           t, x, y, z, qw, qx, qy, qz[, …]      ns; the inertial unit in the world
    kitti           12 numbers: the rows of T_world_cam  times of times.txt, or a rate
    tartanair       x y z qx qy qz qw                    a rate; axes: x forwards, y right, z down
    colmap          images.txt: id qw qx qy qz x y z …   the world in the camera; a rate
    nerf            transforms.json: T_world_cam         OpenGL's axes; "time" of each frame, or a rate

A heading is believed before all of these. What neither it nor the user says is asked for, except in layouts that are
known by name, which the notes say: TUM's, the Event Camera Dataset's and ORB-SLAM's rows (seconds with a point, of
which some have six places), TUM's, EuRoC's and ESIM's headings.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.io.atomic import write_whole
from blinkgl.io.names import natural_order
from blinkgl.io.records import decoding, shown_names
from blinkgl.io.times import (
    PLACES,
    checked_unit,
    named_unit,
    nanoseconds,
    overruled,
    places_of,
    read_rows,
    read_timestamps,
    titles_of,
)
from blinkgl.types.numbers import exact, is_number

FORMS = ("tum", "euroc", "orbslam", "kitti", "tartanair", "colmap", "nerf")
AXES = ("opencv", "opengl", "ned")
MAPS_FROM = ("camera", "world")
_GAP = 20
"""A step this many times the usual one is a gap."""
_COLUMNS = {
    "tum": "t x y z qx qy qz qw", "orbslam": "t x y z qx qy qz qw", "euroc": "t x y z qw qx qy qz",
    "tartanair": "x y z qx qy qz qw", "colmap": "- qw qx qy qz x y z",
}  # fmt: skip
_UNITS = {"tum": "s", "orbslam": "s", "euroc": "ns"}
_FROM = {"colmap": "world"}
_OWN_AXES = {"nerf": "opengl", "tartanair": "ned"}
_TO_OPENCV = {
    # Columns: OpenCV's x (right), y (down), z (forwards) in the body's own axes.
    "opengl": np.diag([1.0, -1.0, -1.0]),
    "ned": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}
_HEADINGS = {
    "timestamp tx ty tz qx qy qz qw": ("TUM's", "s"), "timestamp,x,y,z,qx,qy,qz,qw": ("ESIM's", "ns"),
    "timestamp,p_rs_r_x[m],p_rs_r_y[m],p_rs_r_z[m],q_rs_w[],q_rs_x[],q_rs_y[],q_rs_z[]": ("EuRoC's", "ns"),
}  # fmt: skip
"""Beginnings of headings that state no unit -> whose they are, and their unit. Of "s" every time has a point, of "ns"
none."""
_METRES = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0}
_METRES |= {
    f"{prefix}{metre}{plural}": metres
    for prefix, metres in {"": 1.0, "centi": 0.01, "milli": 0.001, "kilo": 1000.0}.items()
    for metre in ("metre", "meter")
    for plural in ("", "s")
}
"""Units of positions in a heading, ``x [mm]`` or ``x (meters)``, in metres."""
_CHANGED = ("applied_transform", "applied_scale", "scale", "offset")
"""Keys of transforms.json by which programs have changed poses, or change them as they read."""
_FASTEST = 60.0
"""units/s of a camera from which on a note asks for the unit."""


@dataclass(frozen=True)
class PoseFile:
    """What a user declares of a trajectory; None: what the file says.

    form : one of ``FORMS``.   columns : names of the columns, "t x y z qw qx qy qz"; "-" is left out.   time_unit :
    "s", "ms", "us", "ns".   maps_from : "camera" where poses map from the camera to the world, "world" where they map
    from the world to the camera.   axes : of the camera, "opencv", "opengl", or "ned" (x forwards, y right, z down).
    rate : poses per second of a file without times.   times : file of their times.

    Raises ConfigError: values that are none of these."""

    form: str | None = None
    columns: str | None = None
    time_unit: str | None = None
    maps_from: str | None = None
    axes: str | None = None
    rate: float | None = None
    times: str | os.PathLike | None = None

    def __post_init__(self) -> None:
        for key, known in (("form", FORMS), ("axes", AXES), ("maps_from", MAPS_FROM)):
            if (value := getattr(self, key)) not in (None, *known):
                raise ConfigError(f"unknown {key}", where=key, value=value, accepted=", ".join(known))
        checked_unit(self.time_unit, "time_unit")
        if self.columns is not None:
            roles = self.columns.replace(",", " ").split()
            wanted = ["qw", "qx", "qy", "qz", "x", "y", "z"]
            if sorted(set(roles) - {"t", "-"}) != wanted or len([r for r in roles if r != "-"]) - ("t" in roles) != 7:
                raise ConfigError(
                    "not names of columns", where="columns", value=self.columns, accepted="such as t x y z qx qy qz qw"
                )


ANY = PoseFile()
TIMES = "times.txt"
"""The list, beside poses without times, that has them (KITTI)."""


@dataclass
class _Table:
    """Poses as read: times (texts, or None), (N, 3) positions, rotations, and the number of each pose's line."""

    times: list[str] | None
    positions: np.ndarray
    rotations: Rotation
    lines: list[int]
    unit: str | None = None
    notes: list[str] = field(default_factory=list)


def read_trajectory(
    path: str | os.PathLike, declared: PoseFile = ANY, notes: list[str] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) int64 ns and poses (N, 4, 4) float64 T_world_body, N >= 2, with OpenCV's axes.

    notes : gets what was recognised by a layout's name, a line each.

    Raises AssetError, naming the line: a wrong count of numbers, not finite, times that do not increase, a quaternion
    of length other than 1, a gap of 20 usual steps, no times, an order or a unit that has to be declared; ConfigError
    as :class:`PoseFile`."""
    path = Path(path)
    with decoding(path, "cannot be read"):
        text = path.read_text(encoding="utf-8-sig")
    form = declared.form or _form(path, text)
    readers = {"kitti": _kitti, "colmap": _colmap, "nerf": _nerf}
    table = readers.get(form or "", _columns)(path, text, replace(declared, form=form))
    if len(table.positions) < 2:
        raise AssetError(
            "no trajectory", where=str(path), value=f"{len(table.positions)} poses", accepted="two or more"
        )
    lines = [] if notes is None else notes
    lines += table.notes
    if declared.columns is not None and form in readers:
        lines.append(f"{path.name}: columns is not used, because of form {form}")
    t_ns = _times(table, declared, path, lines)
    T = np.tile(np.eye(4), (len(t_ns), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = table.rotations.as_matrix(), table.positions
    if (declared.maps_from or _FROM.get(form or "", "camera")) == "world":
        T = np.linalg.inv(T)
    axes = declared.axes or _OWN_AXES.get(form or "", "opencv")
    if axes != "opencv":
        # The world's axes stay; only the body's change, so the matrix stands on the right.
        T[:, :3, :3] = T[:, :3, :3] @ _TO_OPENCV[axes]
        if declared.axes is None:
            lines.append(f"{path.name}: {form}'s axes ({axes}) turned to OpenCV's (axes: opencv if they are already)")
    speed = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) / (np.diff(t_ns) * 1e-9)
    if (fast := float(np.median(speed))) > _FASTEST:
        lines.append(f"{path.name}: the body moves at {fast:.4g} units/s: another unit of time or length? (time_unit)")
    return t_ns, T


def _form(path: Path, text: str) -> str | None:
    """Return the form that a file's name or its first lines show; None: a table of named or of unknown columns."""
    start = text.lstrip()[:1]
    if path.suffix.lower() == ".json" or start == "{":
        return "nerf"
    if re.search(r"^# *IMAGE_ID, QW", text[:2000], re.M):
        return "colmap"
    # A heading that names a pose is believed first, also that of twelve columns.
    if _roles(titles_of(read_rows(text, 100)[0])):
        return None
    row = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    count = len(re.split(r"[\s,;]+", row.strip()))
    # A place and a quaternion are seven numbers, three rows of a 4x4 matrix twelve.
    if count == 7 and "," not in row:
        return "tartanair"
    return "kitti" if count == 12 and "," not in row else None


def _columns(path: Path, text: str, declared: PoseFile) -> _Table:
    """Read a table of positions and quaternions."""
    heading, rows = read_rows(text)
    titles = titles_of(heading)
    given, own, usual = (
        (declared.columns or "").replace(",", " ").split(),
        _roles(titles),
        _COLUMNS.get(declared.form or "", "").split(),
    )
    roles = given or own or usual
    if not rows:
        return _Table(None, np.empty((0, 3)), Rotation.identity(), [])
    notes: list[str] = []
    if own and given and _places(own) != _places(given):
        notes.append(f"{path.name}: the heading names the columns otherwise; columns: {' '.join(given)} is used")
    elif own and usual and not given and _places(own) != _places(usual):
        notes.append(f"{path.name}: the heading names the columns otherwise than form: {declared.form}, and is used")
    if not roles:
        roles = _COLUMNS["tum"].split()
        if len(rows[0][1]) >= 8 and places_of([fields[0] for _, fields in rows]) < PLACES:
            raise AssetError(
                "no heading names the columns of poses",
                where=str(path),
                accepted=f"try form: tum or euroc, or columns: {_COLUMNS['tum']} and time_unit: s, ms, us or ns",
            )
    at = _places(roles)
    if titles and declared.columns is None:
        named = zip(titles[: len(rows[0][1])], [*roles, *"-" * len(titles)])
        left = [title for title, role in named if role == "-" and title]
        notes += [f"{path.name}: left out: columns that are no pose: {shown_names(left)}"] if left else []
    wanted = ("x", "y", "z", "qx", "qy", "qz", "qw")
    most = max((at[role] for role in wanted), default=0)
    for number, fields in rows:
        # More columns than names are speeds and biases; fewer, or one too many of a bare table, is no pose.
        if len(fields) <= most or (len(roles) == 8 and not titles and len(fields) not in (8, *range(14, 40))):
            raise _no_pose(path, number, fields, " ".join(roles))
    numbers = _numbers(path, rows, [at[role] for role in wanted], " ".join(roles))
    lines = [number for number, _ in rows]
    times = [fields[at["t"]] for _, fields in rows] if "t" in at else None
    stated = named_unit(titles[at["t"]]) if "t" in at and at["t"] < len(titles) and len(titles) >= len(roles) else None
    unit = stated or _UNITS.get(declared.form or "")
    if times is not None and not (unit or declared.time_unit) and (known := _known_layout(heading, times)):
        notes.append(f"{path.name}: read as {known[0]} poses: {' '.join(roles)}, {known[1]}")
        unit = known[1]
    metres = _metres(path, titles, [at[axis] for axis in "xyz"]) if len(titles) >= len(roles) else 1.0
    return _Table(times, numbers[:, :3] * metres, _rotations(numbers[:, 3:], lines, path), lines, unit, notes)


def _places(roles: Sequence[str]) -> dict[str, int]:
    return {role: k for k, role in enumerate(roles) if role != "-"}


def _metres(path: Path, titles: Sequence[str], columns: Sequence[int]) -> float:
    """Return the metres of a unit of position, as the titles of x, y, z state it; 1: they state none."""
    stated = [re.search(r"[\[(]([^\])]*)", titles[k]) for k in columns]
    units = {"" if unit is None else unit[1].strip().lower() for unit in stated}
    if len(units) > 1 or not units <= _METRES.keys():
        raise AssetError(
            "no such unit of positions",
            where=str(path),
            value=", ".join(sorted(units)),
            accepted="m, cm, mm or km of all three, or none",
        )
    return _METRES[units.pop()]


def _known_layout(heading: str, times: Sequence[str]) -> tuple[str, str] | None:
    """Return whose layout a heading or the times show, and its unit; None: none that is known."""
    bare, places = re.sub(r"\s*([,\[\]])\s*", r"\1", heading.strip("# \t").lower()), places_of(times)
    for begin, known in _HEADINGS.items():
        if bare.startswith(begin) and (places > 0 if known[1] == "s" else all(map(str.isdigit, times))):
            return known
    return ("TUM's or the Event Camera Dataset's", "s") if places >= PLACES else None


def _roles(titles: Sequence[str]) -> list[str]:
    """Return the role of each column by its title, "-" for those that have none; empty: the titles name no pose."""
    names = [re.sub(r"\s*[\[(].*", "", title).strip("#").lower() for title in titles]
    turns = [bool(re.match(r"(.*[_.])?(q|quat|orientation|rot|r)[_.]?([a-z]*[_.])*[wxyz]$", name)) and not
             re.match(r"(p|t|pos)", name) for name in names]  # fmt: skip
    roles: list[str] = []
    for name, turn in zip(names, turns):
        axis = name[-1:] if name[-1:] in "wxyz" else ""
        rest = re.sub(r"[^a-z]", "", name[:-1])
        if re.match(r"(time|ts?(_[a-zµ]+)?$|stamp|sec)", name):
            role = "t"
        elif not axis or rest.startswith(("v", "b", "w", "a")):
            role = "-"  # a speed, a bias
        elif turn or axis == "w" or (axis in roles and not any(turns)):
            role = f"q{axis}"
        else:
            role = axis
        roles.append("-" if role in roles else role)
    if "qw" in roles and "qx" not in roles:
        # w x y z after x y z, without a q: the ones next to w are the quaternion's.
        w = roles.index("qw")
        beside = range(w + 1, w + 4) if w + 3 < len(names) and names[w + 1][-1:] == "x" else range(w - 3, w)
        for k, axis in zip(beside, "xyz"):
            roles[k] = f"q{axis}"
    return roles if {"x", "y", "z", "qx", "qy", "qz", "qw"} <= set(roles) else []


def _numbers(path: Path, rows: Sequence[tuple[int, list[str]]], columns: list[int], accepted: str) -> np.ndarray:
    out = np.empty((len(rows), len(columns)))
    for i, (number, fields) in enumerate(rows):
        if max(columns) >= len(fields) or not all(is_number(fields[k]) for k in columns):
            raise _no_pose(path, number, fields, accepted)
        out[i] = [float(fields[k]) for k in columns]
    return out


def _no_pose(path: Path, number: int, fields: Sequence[str], accepted: str) -> AssetError:
    return AssetError(f"line {number} is no pose", where=str(path), value=" ".join(fields)[:80], accepted=accepted)


def _rotations(quaternions: np.ndarray, lines: Sequence[int], path: Path) -> Rotation:
    length = np.linalg.norm(quaternions, axis=1)
    if (wrong := np.abs(length - 1) > 0.01).any():
        i = int(np.argmax(wrong))
        raise AssetError(
            f"line {lines[i]} has no rotation",
            where=str(path),
            value=f"a quaternion of length {length[i]:.4g}",
            accepted="length 1, or columns: in the file's order",
        )
    return Rotation.from_quat(quaternions)


def _matrices(path: Path, given: np.ndarray, lines: list[int]) -> tuple[np.ndarray, Rotation]:
    """Return the positions and rotations of (N, 3 or 4, 4) matrices. Raises AssetError: not rigid."""
    R = given[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    # Rows of length 1 at right angles may also be a reflection, whose determinant is -1.
    wrong = (off > 0.01) | (np.linalg.det(R) < 0) if len(R) else np.zeros(0, bool)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise AssetError(
            f"line {lines[i]} is no pose",
            where=str(path),
            value=" ".join(f"{v:.4g}" for v in given[i].ravel()[:12]),
            accepted="rows of a rotation",
        )
    return given[:, :3, 3], Rotation.from_matrix(R)


def _kitti(path: Path, text: str, declared: PoseFile) -> _Table:
    _, rows = read_rows(text)
    numbers = _numbers(path, rows, list(range(12)), "12 numbers, the rows of T_world_cam").reshape(-1, 3, 4)
    lines = [number for number, _ in rows]
    return _Table(None, *_matrices(path, numbers, lines), lines)


def _colmap(path: Path, text: str, declared: PoseFile) -> _Table:
    """images.txt: two lines per image, the second lists its points; sorted by the images' names."""
    body = [(k, line) for k, line in enumerate(text.splitlines(), 1) if not line.startswith("#")]
    rows = [(k, line.split()) for k, line in body[::2] if line.strip()]
    accepted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of points"
    numbers = _numbers(path, rows, list(range(1, 8)), accepted)
    names = [fields[9] if len(fields) > 9 else str(number) for number, fields in rows]
    order = _order_of(names)
    cameras = {fields[8] for _, fields in rows if len(fields) > 8}
    notes = [f"{path.name}: poses of {len(cameras)} cameras, read as one path"] if len(cameras) > 1 else []
    lines = [rows[k][0] for k in order]
    # SciPy's quaternions have w last.
    rotations = _rotations(numbers[order][:, [1, 2, 3, 0]], lines, path)
    return _Table(None, numbers[order][:, 4:], rotations, lines, notes=notes)


def _order_of(names: Sequence[str]) -> list[int]:
    """Return the places of names in the order of the numbers in them; equal names as they come."""
    places: dict[Path, list[int]] = {}
    for k, name in enumerate(names):
        places.setdefault(Path(name), []).append(k)
    return [k for path in natural_order(places) for k in places[path]]


def _nerf(path: Path, text: str, declared: PoseFile) -> _Table:
    try:
        # Numbers stay text, from which times are converted exactly; NumPy makes floats of the matrices.
        tree = json.loads(text, parse_int=str, parse_float=str)
        frames = tree["frames"]
        matrices = np.array([frame["transform_matrix"] for frame in frames], np.float64)
        if (
            matrices.ndim != 3
            or matrices.shape[1] not in (3, 4)
            or matrices.shape[2] != 4
            or not (np.abs(matrices) < 1e100).all()
        ):
            raise ValueError("transform_matrix")
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        reason = " ".join(str(error).split())[:80]
        raise AssetError(
            f"no transforms.json: {reason}",
            where=str(path),
            accepted="frames: [{transform_matrix: 4 rows of 4, time: s}, …]",
        ) from None
    lines = list(range(1, len(frames) + 1))
    times = [str(frame["time"]) for frame in frames] if all("time" in frame for frame in frames) else None
    changed = [key for key in _CHANGED if key in tree]
    notes = [f"{path.name}: {', '.join(changed)}: not applied, poses are as in the file"] if changed else []
    if times is None and all(isinstance(frame.get("file_path"), str) for frame in frames):
        names = [frame["file_path"] for frame in frames]
        order = _order_of(names)
        if order != sorted(order):
            notes.append(f"{path.name}: frames in the order of their names")
            matrices, lines = matrices[order], [lines[k] for k in order]
    return _Table(times, *_matrices(path, matrices, lines), lines, "s", notes)


def _times(table: _Table, declared: PoseFile, path: Path, notes: list[str]) -> np.ndarray:
    """Return the times of poses, ns. Raises AssetError."""
    count = len(table.positions)
    beside = Path(declared.times) if declared.times is not None else path.with_name(TIMES)
    if table.times is not None:
        unused = [key for key in ("rate", "times") if getattr(declared, key) is not None]
        notes += [f"{path.name}: the poses have times; {key} is not used" for key in unused]
    elif declared.rate is not None:
        unused = [key for key in ("time_unit", "times") if getattr(declared, key) is not None]
        notes += [f"{path.name}: {key} is not used, because of rate" for key in unused]
        return np.round(np.arange(count) * (1e9 / declared.rate)).astype(np.int64)
    elif declared.times is not None and not beside.is_file():
        raise AssetError("no such file", where=str(beside), accepted="a file of times, or rate: in Hz")
    if table.times is None and beside.is_file():
        try:
            stamps = read_timestamps(beside, declared.time_unit)
        except EventDataError as error:
            raise AssetError(error.problem, where=error.where, value=error.value, accepted=error.accepted) from None
        if len(stamps.times_ns) != count:
            value = f"{len(stamps.times_ns)} times, {count} poses"
            raise AssetError("one time per pose", where=str(beside), value=value, accepted="as many, or rate:")
        notes += [stamps.note] if stamps.note else []
        values = stamps.times_ns
    elif table.times is None:
        raise AssetError("poses without times", where=str(path), accepted="rate: in Hz, or times: a file of them")
    else:
        texts = table.times
        for number, text in zip(table.lines, texts):
            if not is_number(text):
                raise _no_pose(path, number, [text], "a time first, a finite number")
        times = list(map(exact, texts))
        unit = declared.time_unit or table.unit
        own = None if declared.form else table.unit  # of a form that is declared, the unit may be another
        notes += [f"{path.name}: {line}" for line in overruled(own, declared.time_unit, "time_unit:")]
        if unit is None:
            proposed = "s" if any("." in text for text in texts) else "ns" if max(map(abs, times)) > 1e17 else "us"
            accepted = f"try time_unit: {proposed} if that is right"
            raise AssetError("no unit of the times is stated", where=str(path), value=texts[0], accepted=accepted)
        values = nanoseconds(times, unit)
    # The difference of any two times below 2^62 fits into an int64.
    if (most := max(map(abs, values))) >= 2**62:
        accepted = "time_unit: s, ms, us or ns"
        raise AssetError("times are too large: another unit?", where=str(path), value=f"{most} ns", accepted=accepted)
    t_ns = np.array(values, np.int64)
    _check_times(t_ns, table.lines, path)
    return t_ns


def _check_times(t_ns: np.ndarray, line: list[int], path: Path) -> None:
    steps = np.diff(t_ns)
    if (steps <= 0).any():
        i = int(np.argmax(steps <= 0)) + 1
        what = "is at the time of the one before" if steps[i - 1] == 0 else "is before the one before"
        raise AssetError(f"line {line[i]} {what}", where=str(path), value=f"{t_ns[i] * 1e-9:.9f} s")
    usual = float(np.median(steps))
    if usual > 100e9:
        raise AssetError(
            "poses are minutes apart: another unit of time?",
            where=str(path),
            value=f"{usual * 1e-9:.6g} s from pose to pose",
            accepted="time_unit: s, ms, us or ns",
        )
    if (steps > _GAP * usual).any():
        i = int(np.argmax(steps > _GAP * usual)) + 1
        raise AssetError(
            f"a gap before line {line[i]}",
            where=str(path),
            value=f"{steps[i - 1] * 1e-9:.6g} s",
            accepted=f"at most {_GAP} times the usual {usual * 1e-9:.6g} s",
        )


def write_trajectory(path: str | os.PathLike, t_ns: np.ndarray, poses: np.ndarray) -> None:
    """Write (N,) int64 ns and (N, 4, 4) poses as TUM's text, completely or not at all. Raises OutputError."""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    lines = ["# timestamp[s] tx ty tz qx qy qz qw"]
    for t, p, q in zip(np.asarray(t_ns).tolist(), poses[:, :3, 3].tolist(), quaternions.tolist()):
        # Floor division of a negative time would round its seconds down.
        sign, t = ("-", -t) if t < 0 else ("", t)
        lines.append(f"{sign}{t // 1_000_000_000}.{t % 1_000_000_000:09d} " + " ".join(f"{v:.12g}" for v in (*p, *q)))
    write_whole(path, "\n".join(lines) + "\n")
