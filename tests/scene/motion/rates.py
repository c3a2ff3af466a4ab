"""How fast a path moves and turns, measured: what tests compare with what was asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blinkgl.scene.motion.pose_path import PosePath


def body_rate(T: np.ndarray, dT: np.ndarray) -> np.ndarray:
    """(3,) body-frame angular rate in rad/s of a pose and its derivative: dR/dt = R [w]x."""
    W = T[:3, :3].T @ dT[:3, :3]
    return 0.5 * np.array([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]])


@dataclass(frozen=True)
class PathStatistics:
    """mean_speed, peak_speed in units/s; mean_rate, peak_rate in rad/s. The peaks are upper bounds (tight to ~1 %)."""

    mean_speed: float
    peak_speed: float
    mean_rate: float
    peak_rate: float


def statistics(path: PosePath, t0_ns: int, t1_ns: int, samples: int = 512) -> PathStatistics:
    """What a path really does over [t0, t1]: midpoint rule and interval bounds on ``samples`` intervals."""
    edges = np.linspace(0, t1_ns - t0_ns, samples + 1).astype(np.int64) + t0_ns
    speed, rate = 0.0, 0.0
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist()):
        mid = (a + b) // 2
        D = path.derivative(mid)
        speed += (b - a) * float(np.linalg.norm(D[:3, 3]))
        rate += (b - a) * float(np.linalg.norm(body_rate(path.pose(mid), D)))
    bounds = np.array([path.speed_bound(a, b) for a, b in zip(edges[:-1].tolist(), edges[1:].tolist())])
    length = max(t1_ns - t0_ns, 1)
    return PathStatistics(speed / length, float(bounds[:, 0].max()), rate / length, float(bounds[:, 1].max()))
