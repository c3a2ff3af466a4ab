"""An optical marker: four LEDs blink, each at its own frequency, by which the events tell them apart."""

from pathlib import Path

import numpy as np

from blinkgl import Camera, Keyframes, Light, Material, Pose, Primitive, Scene, record

FREQUENCIES = (400, 500, 700, 900)  # Hz
PLACES = ((-0.5, 0.4), (0.5, 0.4), (-0.5, -0.4), (0.5, -0.4))  # y (to the left) and z, m


def marker() -> Scene:
    """Return four LEDs before a camera that moves sideways."""
    way = Keyframes({0.0: Pose((-3, -0.1, 0)), 0.3: Pose((-3, 0.1, 0))}, interpolation="linear")
    scene = Scene(Camera(160, 120, fov=50, pose=way), light=Light(0, 0.2), background=0.05, duration=0.2)
    for frequency, (y, z) in zip(FREQUENCIES, PLACES):
        blinking = {"kind": "pwm", "frequency": frequency, "duty": 0.5}
        led = Material(color=(0.1, 0.1, 0.1), emission=(2, 2, 2), emission_over_time=blinking)
        scene += Primitive("icosphere", subdivisions=3, scale=0.08, pose=Pose((0, y, z)), material=led)
    return scene


def main(out: Path) -> None:
    recording = record(marker(), emulator={"emulator": "esim", "contrast_threshold": 0.2}, labels=[])
    events = recording.events
    out.mkdir(parents=True, exist_ok=True)
    np.savez(out / "marker.npz", x=events.x, y=events.y, t=events.t, p=events.p)
    rising = events.p == 1
    for part, (left, up) in {"upper left": (1, 1), "upper right": (0, 1), "lower left": (1, 0)}.items():
        inside = rising & ((events.x < 80) == left) & ((events.y < 60) == up)
        # Many pixels fire in the microsecond of an edge, few in that of a motion.
        times, pixels = np.unique(events.t[inside], return_counts=True)
        edges = times[pixels > 0.5 * pixels.max()]
        print(f"{part}: {1e6 / np.median(np.diff(edges)):.0f} Hz")


def test_final(out: Path) -> None:
    with np.load(out / "marker.npz") as saved:
        # The LED at the lower right has 700 Hz: half periods of 714.3 µs.
        inside = (saved["x"] >= 80) & (saved["y"] >= 60)
        times, pixels = np.unique(saved["t"][inside], return_counts=True)
        edges = times[pixels > 0.5 * pixels.max()]
        assert abs(np.median(np.diff(edges)) - 1e6 / 1400) < 1


if __name__ == "__main__":
    main(Path("out/examples/optical_marker"))
