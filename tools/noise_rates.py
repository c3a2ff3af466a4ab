"""Rates of noise events of a comparator behind a low-pass: the table of :mod:`blinkgl.events.noise`.

    python -m blinkgl.tools.noise_rates          # prints the tables, about five minutes of one core
    python -m blinkgl.tools.noise_rates --judge  # events of V2E over those asked for, by IN_SECONDS; as long

Gaussian noise of standard deviation s (in thresholds) with the correlation e^-k from frame to frame; levels one
threshold apart, the one at which the last event came is the reference, an event for each other level that is passed.
References stay on a ladder of levels, so that rungs and the place of the noise are a Markov chain; its stationary state
is solved for on a grid whose cells end at the rungs, and no die is thrown.

Where the ladder stands differs from pixel to pixel, and the rate with it: a ladder with a rung at the noise's mean is
quiet. Unlike thresholds for ON and OFF, as every real pixel has them, move the ladder by their difference with every
pair of events, so that pixels spend the more time with a ladder the quieter it is; the rate in the end is the harmonic
mean over all places of the ladder. The second table is how much quieter: ln of the rates' ratio from a rung at half a
threshold to one at the mean.

A dead time puts the reference wherever the noise is at its end, off the ladder: how many times as many events come then
is counted, in trajectories of one pixel (third table, by dead time in frames, k and size).
"""

from __future__ import annotations

import argparse
from itertools import product

import numba
import numpy as np
from scipy.special import ndtr

from blinkgl.config.events import V2eConfig
from blinkgl.events import V2e, noise
from blinkgl.events.noise import DEAD_FRAMES, DEAD_K, DEAD_SIZES, RATE_K, RATE_SIZES, noise_rate


def rate_per_step(size: float, k: float, place: float, cells: int) -> float:
    """Events per frame of a ladder with a rung at ``place``; ``cells`` of the grid between two rungs."""
    # An Ornstein-Uhlenbeck process from frame to frame: the share of the noise that stays, and the deviation of what is
    # new.
    a, fresh = np.exp(-k), size * np.sqrt(-np.expm1(-2 * k))
    rungs = int(np.ceil(5.5 * size)) + 1
    below = np.repeat(np.arange(-rungs, rungs), cells)  # of each cell: the rung under it
    n = place + (np.arange(2 * rungs * cells) + 0.5) / cells - rungs
    edges = np.append(n - 0.5 / cells, n[-1] + 0.5 / cells)
    edges[0], edges[-1] = -np.inf, np.inf
    # From anywhere in a cell: the mean over the two points of Gauss's rule.
    move = 0.5 * sum(
        np.diff(ndtr((edges[None, :] - a * (n + d / cells)[:, None]) / fresh), axis=1)
        for d in (-0.5 / 3**0.5, 0.5 / 3**0.5)
    )
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
    # The stationary law solves after.T state = state; the last equation gives way to the sum of all chances, 1.
    system[-1] = 1.0
    state = np.linalg.solve(system, np.eye(1, 2 * n.size, 2 * n.size - 1)[0])
    return float(state @ counts)


def rate_per_time_constant(size: float, k: float) -> tuple[float, float]:
    """(harmonic mean of the rates over where the ladder stands, ln of the largest over the smallest)."""
    fresh = size * np.sqrt(-np.expm1(-2 * k))
    cells = int(min(max(np.ceil(4.0 / fresh), 24), 200))
    # Mirror images have the same rate: half of the places are enough.
    rates = np.array([rate_per_step(size, k, (j + 0.5) / 16, cells) for j in range(8)])
    ends = [rate_per_step(size, k, place, cells) for place in (1e-3, 0.499)]
    return float(1 / np.mean(1 / rates)) / k, float(np.log(ends[1] / ends[0]))


@numba.njit(cache=True)
def count_events(size: float, k: float, dead: float, steps: int, seed: int) -> int:
    """Events of one pixel: noise at the frames, straight lines between them, a dead time of ``dead`` frames after each
    event, at whose end the reference is the noise."""
    np.random.seed(seed)  # noqa: NPY002 - numba's own
    a, fresh = np.exp(-k), size * np.sqrt(-np.expm1(-2 * k))
    noise = reference = size * np.random.normal()  # noqa: NPY002
    wait, events = -1.0, 0  # frames until the comparator wakes, from this frame on; negative: it is awake
    for _ in range(steps):
        now = a * noise + fresh * np.random.normal()  # noqa: NPY002
        look = 0.0
        if wait >= 1:
            wait -= 1
        else:
            if wait >= 0:
                look, wait = wait, -1.0
                reference = noise + (now - noise) * look
            while abs(now - reference) >= 1:
                events += 1
                level = reference + (1.0 if now > reference else -1.0)
                # The part of the frame at which the line reaches the level; the dead time begins there.
                end = max((level - noise) / (now - noise), look) + dead
                if end >= 1:
                    wait = end - 1
                    break
                look, reference = end, noise + (now - noise) * end
        noise = now
    return events


def dead_time_factor(size: float, k: float, dead: float, wanted: int = 6000, most: int = 40_000_000) -> float:
    """ln of the rate with a dead time of so many frames over that without one."""
    steps = int(min(wanted / (noise_rate(size, k) * k), most))
    events = count_events(size, k, dead, steps, 1)
    return float(np.log(max(events, 1) / (steps * k) / noise_rate(size, k)))


def of_asked(rate_hz: float, seed: int, **keys) -> list[float]:
    """Events of 1,024 pixels of V2E over those asked for, in clips of 0.5, 2 and 8 s. keys : of V2eConfig, and fps, 0
    for steps from 0.2 to 20 ms."""
    fps, side = keys.pop("fps"), 32
    config = V2eConfig(preset="clean", photoreceptor_noise=True, shot_noise_rate_hz=rate_hz, **keys)
    emulator, frame = V2e(side, side, config, seed=seed), np.full((side, side), 0.4, np.float32)
    steps_s = np.exp(np.random.default_rng(23).uniform(np.log(2e-4), np.log(2e-2), 9600))
    times = np.arange(8 * fps + 1) / fps if fps else np.concatenate([[0.0], np.cumsum(np.floor(steps_s * 1e9)) * 1e-9])
    parts = [emulator.step(frame, round(t * 1e9)).t for t in times[times <= 8]]
    events = np.concatenate(parts) * 1e-6
    return [float((events < s).sum() / (s * side**2 * rate_hz)) for s in (0.5, 2, 8)]


def judge() -> None:
    """IN_SECONDS on seeds, clips and dead times by which it was not chosen."""
    print("| asked, Hz | thresholds | IN_SECONDS | 0.5 s | 2 s | 8 s |\n|---|---|---|---|---|---|")
    shipped = noise.IN_SECONDS
    for (rate, seed, spacings), sigma, part in product(
        ((1.0, 12, (50, 500)), (5.0, 11, (50, 500, 0)), (20.0, 13, (50, 500))), (0.0, 0.03), (0.0, 0.25, 0.5, 1.0)
    ):
        noise.IN_SECONDS = part
        ratios = np.array([
            of_asked(rate, seed, fps=fps, refractory_us=dead, cutoff_hz=cutoff, threshold_sigma=sigma)
            for dead, cutoff, fps in product((200.0, 3000.0), (30.0, 300.0), spacings)
        ])  # fmt: skip
        off = np.exp(np.abs(np.log(ratios)).mean(0))
        cells = (f"{o:.2f} ({r.min():.2f}-{r.max():.2f})" for o, r in zip(off, ratios.T))
        print(f"| {rate:g} | {'spread' if sigma else 'equal'} | {part:g} | " + " | ".join(cells) + " |", flush=True)
    noise.IN_SECONDS = shipped


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--judge", action="store_true", help="how near V2E's rate comes to the one asked for")
    if parser.parse_args().judge:
        judge()
        return
    print("_DEAD = [  # [dead time][k][size]")
    for dead in DEAD_FRAMES:
        rows = [[f"{dead_time_factor(size, k, dead):.2f}" for size in DEAD_SIZES] for k in DEAD_K]
        print("    [" + ", ".join("[" + ", ".join(row) + "]" for row in rows) + f"],  # {dead:g}", flush=True)
    print("]")
    spans = []
    for k in RATE_K:
        row = [rate_per_time_constant(size, k) for size in RATE_SIZES]
        spans.append([span for _, span in row])
        print("        [" + ", ".join(f"{np.log(rate):.4f}" for rate, _ in row) + f"],  # k = {k:g}", flush=True)
    print("[" + ", ".join(f"{span:.3f}" for span in spans[0]) + f"]  # span at k = {RATE_K[0]:g}")


if __name__ == "__main__":
    main()
