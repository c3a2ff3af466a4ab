"""The source of every random number.

One run has one integer seed (0 is valid). Each sequence and each role in it gets an independent child stream. So an
additional draw in one role changes no other role, and sequence 17 is the same whether or not sequences 0-16 were made
in this run, by this worker, or at all.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Role(IntEnum):
    """Streams of one sequence. Append only: the numbers are part of every published data set."""

    PARAMETERS = 0
    SCENE = 1
    TRAJECTORY = 2
    TEXTURE = 3
    EVENTS = 4
    PHYSICS = 5
    SHAPE = 6
    LIGHT = 7
    IMAGES = 8
    IMU = 9
    TRACKS = 10


def seed_sequence(seed: int, sequence: int, role: Role, sensor: int = 0) -> np.random.SeedSequence:
    """Return the child of ``seed`` for (sequence, role), and for the number of a rig's sensor after the first, which
    has the stream of a single camera. It does not depend on children drawn before."""
    return np.random.SeedSequence(seed, spawn_key=(int(sequence), int(role), *((int(sensor),) if sensor else ())))


def generator(seed: int, sequence: int, role: Role, sensor: int = 0) -> np.random.Generator:
    """Return a PCG64 generator on :func:`seed_sequence`."""
    return np.random.default_rng(seed_sequence(seed, sequence, role, sensor))


def kernel_seed(seed: int, sequence: int, role: Role, sensor: int = 0) -> int:
    """Return a 64-bit key for the counter-based generators inside numba kernels."""
    return int(seed_sequence(seed, sequence, role, sensor).generate_state(1, np.uint64)[0])
