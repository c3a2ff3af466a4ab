"""What is lost by at most one event per pixel and frame, stamped with the frame's time.

    python -m blinkgl.tools.one_event_per_frame

Some simulators on cards make events by that rule. It is re-stated here in NumPy, in two forms: the reference moves by
one threshold (what is left comes out at later frames), or to the frame's value (what is left is gone). A random texture
with the spectrum of natural images moves at a constant velocity; truth is ESIM at 64 frames per pixel of motion, all
crossings at their times. Shares are of its events. The error of a time stamp is its distance from the nearest true
event of the same pixel and polarity, at 1,000 px/s in µs, and in intervals between frames.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from blinkgl.config.events import EsimConfig
from blinkgl.events import Esim, Events

SIZE, PATH_PX, SPEED_PX_S, THRESHOLD = 160, 12.0, 1000.0, 0.2
FINE = 64
CONFIG = EsimConfig(contrast_threshold=THRESHOLD, threshold_sigma=0.0)
STEPS = (0.1, 0.3, 1.0, 3.0)


def texture(blur: float, seed: int = 1) -> np.ndarray:
    """(n, n) log intensity, periodic, spectrum 1/f, standard deviation 0.6; ``blur`` in px."""
    n = 4 * SIZE
    rng = np.random.default_rng(seed)
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    f[0, 0] = 1.0
    picture = np.fft.ifft2(np.fft.fft2(rng.normal(size=(n, n))) / f).real
    picture = ndimage.gaussian_filter(picture, blur, mode="wrap")
    return 0.6 * (picture - picture.mean()) / picture.std()


def clip(picture: np.ndarray, step_px: float) -> tuple[np.ndarray, np.ndarray]:
    """(N, SIZE, SIZE) float32 luminance and (N,) int64 ns, one frame per ``step_px`` of motion (0.8, 0.6)."""
    distance = np.arange(0.0, PATH_PX + 1e-9, step_px)
    y, x = np.mgrid[:SIZE, :SIZE]
    coefficients = ndimage.spline_filter(picture, mode="grid-wrap")
    frames = [
        np.exp(
            ndimage.map_coordinates(coefficients, [y + 0.6 * d, x + 0.8 * d], prefilter=False, mode="grid-wrap") - 1.5
        )
        for d in distance
    ]
    return np.array(frames, np.float32), np.round(distance / SPEED_PX_S * 1e9).astype(np.int64)


def all_crossings(frames: np.ndarray, times: np.ndarray) -> Events:
    """ESIM: every crossing, at its own time."""
    emulator = Esim(SIZE, SIZE, CONFIG)
    return Events.concatenate([emulator.step(frame, int(t)) for frame, t in zip(frames, times)])


def one_per_frame(frames: np.ndarray, times: np.ndarray, to_the_frame: bool) -> Events:
    """At most one event per pixel and frame, at the frame's time. to_the_frame: where the reference goes then."""
    log = np.log(frames.astype(np.float64) + CONFIG.log_eps)
    reference, parts = log[0].copy(), []
    for now, t_ns in zip(log[1:], times[1:]):
        difference = now - reference
        fires = np.abs(difference) >= THRESHOLD
        y, x = np.nonzero(fires)
        on = difference[fires] > 0
        reference[fires] = now[fires] if to_the_frame else reference[fires] + np.where(on, THRESHOLD, -THRESHOLD)
        t = np.full(len(x), t_ns // 1000, np.int64)
        parts.append(Events(x.astype(np.uint16), y.astype(np.uint16), t, on.astype(np.uint8)))
    return Events.concatenate(parts)


def errors_us(events: Events, truth: Events) -> np.ndarray:
    """(N,) µs, signed, to the nearest true event of the same pixel and polarity; NaN where there is none."""
    far = np.int64(2**32)
    place = lambda e: ((e.y.astype(np.int64) * SIZE + e.x) * 2 + e.p) * far
    keys = np.sort(place(truth) + truth.t)
    mine = place(events) + events.t
    after = np.searchsorted(keys, mine)
    distances = [mine - keys[np.clip(k, 0, len(keys) - 1)] for k in (after - 1, after)]
    nearest = np.where(np.abs(distances[0]) <= np.abs(distances[1]), *distances).astype(np.float64)
    nearest[np.abs(nearest) >= far // 2] = np.nan  # of another pixel
    return nearest


def row(name: str, events: Events, truth: Events, interval_us: float) -> str:
    """One line of the table."""
    error = np.abs(errors_us(events, truth))
    median, high = np.nanquantile(error, (0.5, 0.9))
    return (
        f"| {name} | {100 * len(events) / len(truth):.1f} % | {median:.0f} | {high:.0f} | {median / interval_us:.2f} |"
    )


def main() -> None:
    """Prints the table."""
    for kind, blur in (("smooth, blurred by 1.5 px", 1.5), ("sharp, blurred by 0.5 px", 0.5)):
        picture = texture(blur)
        truth = all_crossings(*clip(picture, 1.0 / FINE))
        print(
            f"\n{kind}: {len(truth):,} events in truth, {len(truth) / SIZE**2 / PATH_PX:.2f} per pixel and px of motion"
        )
        print("| px per frame, rule | events, of truth's | error median, µs | 90 %, µs | median, in intervals |")
        print("|---|---|---|---|---|")
        for step in STEPS:
            frames, times = clip(picture, step)
            interval_us = step / SPEED_PX_S * 1e6
            print(row(f"{step}: all crossings", all_crossings(frames, times), truth, interval_us))
            for to_the_frame in (False, True):
                rule = "one a frame, to the frame" if to_the_frame else "one a frame, by a threshold"
                print(row(f"{step}: {rule}", one_per_frame(frames, times, to_the_frame), truth, interval_us))


if __name__ == "__main__":
    main()
