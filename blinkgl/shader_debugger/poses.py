"""Where the surfaces that were drawn should be, and which other pose would have put them where they are.

The debug pass says which point of which object a pixel shows. The true poses say where that point belongs; nothing of
the ray caster is needed, and so a pose that is wrong is told apart from everything that is
looked up or shaded later."""

from __future__ import annotations

from typing import Any

import numpy as np

from blinkgl.render import reference

SAMPLES = 400  # pixels that a search looks at
TIMES = 161  # poses tried along the sequence before the best is refined
EXPLAINED = 0.05  # of the displacement: what a pose may leave unexplained
ROUNDING = 0.01  # px; float32 leaves less


def displaced(gpu: Any, ref: Any) -> np.ndarray:
    """(H, W, 2) px from each pixel's centre to where the point drawn there lies by the true poses; 0 where nothing was
    drawn, inf where that is out of the camera's sight."""
    part = gpu["part"]
    out = np.zeros((*part.shape, 2))
    for p, (thing, _) in enumerate(reference.scene_parts(ref.scene)):
        y, x = np.nonzero(part == p)
        pose = reference.relative_pose_at(ref.scene, thing, ref.when.t_ns)
        seen = _project(ref.scene.camera, pose, gpu["local"][y, x].astype(np.float64))
        out[y, x] = np.nan_to_num(seen - np.stack([x, y], axis=1), nan=np.inf)
    return out


def _project(camera, pose: np.ndarray, local: np.ndarray) -> np.ndarray:
    return camera.project(local @ pose[:3, :3].T + pose[:3, 3])


def pose_suspicions(comparison: Any, report: Any) -> list[str]:
    """One line per pose, of the camera or of an object, that explains the pixels that are misplaced."""
    gpu, ref = comparison.gpu, comparison.ref
    scene, now = ref.scene, ref.when.t_ns
    wrong = report.graded & (report.errors > report.limit)
    owner = comparison.owner("local")
    numbers = [int(k) for k in np.unique(owner[wrong])]

    def sample(mask):
        y, x = np.nonzero(mask)
        some = np.linspace(0, len(x) - 1, min(SAMPLES, len(x))).astype(int)
        return np.stack([x, y], axis=1)[some], gpu["local"][y, x][some].astype(np.float64)

    groups = [(scene.objects[k], *sample(wrong & (owner == k))) for k in numbers]

    def left(some, t_cam: int, t_obj: int) -> float:
        errors = [
            np.linalg.norm(_project(scene.camera, _pose(scene, thing, t_cam, t_obj), local) - xy, axis=1)
            for thing, xy, local in some
        ]
        # A point out of sight is as wrong as the picture is large: more would make any explanation look good beside it.
        return float(
            np.quantile(np.nan_to_num(np.concatenate(errors), nan=scene.camera.width + scene.camera.height), 0.9)
        )

    found = []
    before = left(groups, now, now)
    off = displaced(gpu, ref)[wrong]
    shift = np.median(off, axis=0)
    whole = {
        f"everything is shifted by ({-shift[0]:+.3g}, {-shift[1]:+.3g}) px (the principal point, or a "
        "pixel's centre)": float(np.nan_to_num(np.quantile(np.linalg.norm(off - shift, axis=1), 0.9), nan=np.inf))
    }
    if not scene.camera_path.is_static:
        t = _best(scene, now, lambda t: left(groups, t, now))
        whole[f"the camera is where it is at t = {_when(t, now)}: a stale pose"] = left(groups, t, now)
    if len(np.unique(owner[report.graded])) == len(numbers):  # every object that is seen
        text = min(whole, key=lambda text: whole[text])
        if whole[text] <= max(ROUNDING, EXPLAINED * before):
            return [text]
    for k, group in zip(numbers, groups):
        before = left([group], now, now)
        if group[0].path.is_static:
            continue
        t = _best(scene, now, lambda t, group=group: left([group], now, t))
        if left([group], now, t) <= max(ROUNDING, EXPLAINED * before):
            found.append(f"{comparison.objects[k]} is drawn where it is at t = {_when(t, now)}: a stale pose")
    return found


def _pose(scene, thing, t_cam: int, t_obj: int) -> np.ndarray:
    """(4, 4) T_cam_obj of the camera at one time and the object at another."""
    camera, body = scene.camera_path.pose(t_cam), thing.path.pose(t_obj)
    out = np.eye(4)
    out[:3, :3] = camera[:3, :3].T @ body[:3, :3]
    out[:3, 3] = camera[:3, :3].T @ (body[:3, 3] - camera[:3, 3])
    return out


def _best(scene, now: int, cost) -> int:
    """The time (ns) within the sequence at which ``cost`` is least."""
    low, high = scene.t0_ns, scene.t1_ns
    for _ in range(4):
        times = [round(t) for t in np.linspace(low, high, TIMES)]
        costs = [cost(t) for t in times]
        k = int(np.argmin(costs))
        low, high = times[max(0, k - 1)], times[min(TIMES - 1, k + 1)]
    return times[k]


def _when(t_ns: int, now: int) -> str:
    late = (t_ns - now) * 1e-9
    return f"{t_ns * 1e-9:.4g} s, {abs(late):.3g} s {'earlier' if late < 0 else 'later'}"
