"""Random paths from random free places, which a world chooses for itself."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.scene.motion import trajectories
from blinkgl.scene.motion.trajectories import look_rotation
from blinkgl.types.poses import pose_of


def free_place(rng, space, radius):
    points = rng.uniform(space.low, space.high, (1000, 3))
    return points[np.flatnonzero(space.depth(points, radius) <= 0.0)[0]]


def random_path(rng, t0, t1, config, space, radius, start=None, **keys):
    if start is None:
        start = pose_of(free_place(rng, space, radius), Rotation.random(rng=rng).as_matrix())
    return trajectories.random_path(rng, t0, t1, config, space, radius, start, **keys)


def random_camera_path(rng, t0, t1, config, space, radius, target, start=None):
    if start is None:
        place, roll = free_place(rng, space, radius), math.radians(rng.uniform(-0.5, 0.5) * config.roll)
        turn = Rotation.from_rotvec([0, 0, roll]).as_matrix()
        start = pose_of(place, look_rotation(np.asarray(target) - place) @ turn)
    return trajectories.random_camera_path(rng, t0, t1, config, space, radius, target, start)
