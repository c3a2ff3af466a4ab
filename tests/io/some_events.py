"""Events anywhere on a sensor, and whether two are the same."""

import numpy as np

from blinkgl.types.events import Events


def some_events(n: int, t0: int, t1: int, height: int, width: int, seed: int = 0) -> Events:
    """``n`` of them in [t0, t1) µs."""
    rng = np.random.default_rng(seed)
    return Events(
        rng.integers(0, width, n).astype(np.uint16),
        rng.integers(0, height, n).astype(np.uint16),
        np.sort(rng.integers(t0, t1, n)),
        rng.integers(0, 2, n).astype(np.uint8),
    )


def same(a: Events, b: Events) -> bool:
    return all(np.array_equal(getattr(a, k), getattr(b, k)) for k in "xytp")
