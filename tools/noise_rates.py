"""Rates of noise events of a comparator behind a low-pass: the table of :mod:`blinkgl.events.noise`.

    python -m blinkgl.tools.noise_rates        # prints the table, about three minutes of one core

Gaussian noise of standard deviation s (in thresholds) with the correlation e^-k from frame to frame; levels one
threshold apart, the one at which the last event came is the reference, an event for each other level that is passed.
References stay on a ladder of levels, so that rungs and the place of the noise are a Markov chain; its stationary state
is solved for on a grid whose cells end at the rungs, and no die is thrown. Where the ladder stands differs from pixel
to pixel (uniformly: leak moves it); the rate is the mean over it.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from blinkgl.events.noise import RATE_K, RATE_SIZES


def rate_per_step(size: float, k: float, place: float, cells: int) -> float:
    """Events per frame of a ladder with a rung at ``place``; ``cells`` of the grid between two rungs."""
    a, fresh = np.exp(-k), size * np.sqrt(-np.expm1(-2 * k))
    rungs = int(np.ceil(5.5 * size)) + 1
    below = np.repeat(np.arange(-rungs, rungs), cells)  # of each cell: the rung under it
    n = place + (np.arange(2 * rungs * cells) + 0.5) / cells - rungs
    edges = np.append(n - 0.5 / cells, n[-1] + 0.5 / cells)
    edges[0], edges[-1] = -np.inf, np.inf
    # Within a cell the noise has nearly the density of its ends; the mean over two points in it is good to fourth order.
    move = 0.5 * sum(
        np.diff(ndtr((edges[None, :] - a * (n + d / cells)[:, None]) / fresh), axis=1)
        for d in (-0.5 / 3**0.5, 0.5 / 3**0.5)
    )
    cell = np.arange(n.size)
    after, counts = np.zeros((2 * n.size, 2 * n.size)), np.zeros(2 * n.size)
    for bit in (0, 1):  # the reference is the rung below, or the one above
        reference = (below + bit)[:, None]
        up, down = below[None, :] - reference, reference - 1 - below[None, :]
        passed = np.maximum(np.maximum(up, down), 0)
        new_bit = np.where(up > 0, 0, np.where(down > 0, 1, reference - below[None, :]))
        rows = slice(bit * n.size, (bit + 1) * n.size)
        after[rows, : n.size] = move * (new_bit == 0)
        after[rows, n.size :] = move * (new_bit == 1)
        counts[rows] = (move * passed).sum(1)
    system = after.T - np.eye(2 * n.size)
    system[-1] = 1.0
    state = np.linalg.solve(system, np.eye(1, 2 * n.size, 2 * n.size - 1)[0])
    return float(state @ counts)


def rate_per_time_constant(size: float, k: float, ladders: int = 8) -> float:
    """The mean over where the ladder stands."""
    fresh = size * np.sqrt(-np.expm1(-2 * k))
    cells = int(min(max(np.ceil(2.0 / fresh), 12), 160))
    # Mirror images have the same rate: half of the places are enough.
    return float(np.mean([rate_per_step(size, k, (j + 0.5) / ladders / 2, cells) for j in range(ladders)])) / k


def main() -> None:
    for k in RATE_K:
        row = [np.log(rate_per_time_constant(size, k)) for size in RATE_SIZES]
        print("        [" + ", ".join(f"{value:.4f}" for value in row) + f"],  # k = {k:g}", flush=True)


if __name__ == "__main__":
    main()
