"""Trajectories of other programs: TUM's text and EuRoC's CSV.

    TUM     t x y z qx qy qz qw          s, m; separated by spaces, `#` begins a comment
    EuRoC   t, x, y, z, qw, qx, qy, qz[, …]   ns, m; `#` begins a comment; further columns are left alone

Poses are those of a body in the world, T_world_body. A camera's axes are OpenCV's in both.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.errors import AssetError
from blinkgl.io.atomic import atomic_file, output_errors

FORMATS = ("tum", "euroc")
_MOST_LINES = 5_000_000
_GAP = 20
"""A step this many times the usual one is a gap."""


def read_trajectory(path: str | os.PathLike, form: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return times (N,) int64 ns and poses (N, 4, 4) float64 T_world_body, N >= 2, of a file of ``form`` "tum" or
    "euroc"; None: EuRoC where the lines have commas.

    Raises AssetError, naming the line: a wrong count of numbers, not finite, times that do not increase, a quaternion
    of length other than 1, a gap of 20 usual steps; a heading with w first in a TUM file."""
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeError) as error:
        raise AssetError(f"cannot be read: {' '.join(str(error).split())[:120]}", where=str(path)) from None
    rows = [(k, line) for k, line in enumerate(lines[:_MOST_LINES], 1) if line.strip() and not line.startswith("#")]
    if len(rows) < 2:
        raise AssetError("no trajectory", where=str(path), value=f"{len(rows)} poses", accepted="two or more")
    form = form or ("euroc" if "," in rows[0][1] else "tum")
    heading = " ".join(line.lower() for line in lines[:20] if line.startswith("#"))
    if form == "tum" and "qw" in heading and heading.index("qw") < (heading + "qx").index("qx"):
        raise AssetError(
            "the heading says that quaternions begin with w",
            where=str(path),
            value=heading[:80],
            accepted="t x y z qx qy qz qw, as TUM's files have it",
        )
    times, numbers = [], np.empty((len(rows), 7))
    for i, (k, line) in enumerate(rows):
        words = line.replace(",", " ").split()
        try:
            if len(words) != 8 and not (form == "euroc" and len(words) > 8):
                raise ValueError
            times.append(_nanoseconds(words[0], form))
            numbers[i] = [float(word) for word in words[1:8]]
            if not np.isfinite(numbers[i]).all():
                raise ValueError
        except (ValueError, OverflowError):
            accepted = "t x y z qx qy qz qw" if form == "tum" else "t, x, y, z, qw, qx, qy, qz"
            raise AssetError(f"line {k} is no pose", where=str(path), value=line[:80], accepted=accepted) from None
    if max(map(abs, times)) >= 2**62:
        raise AssetError(
            "times are too large: another unit?",
            where=str(path),
            value=rows[-1][1][:40],
            accepted="seconds in TUM's files, nanoseconds in EuRoC's",
        )
    t_ns = np.array(times, np.int64)
    _check_times(t_ns, [k for k, _ in rows], path)
    quaternions = numbers[:, 3:] if form == "tum" else numbers[:, [4, 5, 6, 3]]
    length = np.linalg.norm(quaternions, axis=1)
    if (np.abs(length - 1) > 0.01).any():
        i = int(np.argmax(np.abs(length - 1) > 0.01))
        raise AssetError(
            f"line {rows[i][0]} has no rotation",
            where=str(path),
            value=f"a quaternion of length {length[i]:.4g}",
            accepted="length 1",
        )
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(quaternions).as_matrix(), numbers[:, :3]
    return t_ns, T


def _nanoseconds(word: str, form: str) -> int:
    """Return ns of a number of s or ns, with all its digits."""
    if form == "euroc":
        return int(float(word)) if "." in word or "e" in word.lower() else int(word)
    whole, _, part = word.partition(".")
    if "e" in word.lower() or not part.isdigit() or not whole.lstrip("-").isdigit():
        return round(float(word) * 1e9)
    sign = -1 if whole.startswith("-") else 1
    return int(whole) * 1_000_000_000 + sign * int(part[:9].ljust(9, "0"))


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
            accepted="seconds in TUM's files, nanoseconds in EuRoC's",
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
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for t, p, q in zip(np.asarray(t_ns).tolist(), poses[:, :3, 3].tolist(), quaternions.tolist()):
        sign, t = ("-", -t) if t < 0 else ("", t)
        lines.append(f"{sign}{t // 1_000_000_000}.{t % 1_000_000_000:09d} " + " ".join(f"{v:.12g}" for v in (*p, *q)))
    with atomic_file(path) as temporary, output_errors(path):
        Path(temporary).write_text("\n".join(lines) + "\n", encoding="utf-8")
