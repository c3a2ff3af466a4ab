"""A trajectory of your own: the camera circles a column on key frames from a formula."""

from pathlib import Path

import numpy as np

from blinkgl import Camera, Keyframes, Material, Primitive, Scene, Timeline, look_at, record

RADIUS, TURNS_PER_S, DURATION = 3.0, 0.1, 0.4


def position(t: float) -> np.ndarray:
    """m, at t s."""
    angle = 2 * np.pi * TURNS_PER_S * t
    return np.array([-RADIUS * np.cos(angle), -RADIUS * np.sin(angle), 0.0])


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    times = np.linspace(0, DURATION, 9)
    flight = Keyframes({t: look_at(position(t), (0, 0, 0)) for t in times}, interpolation="spline")
    scene = Scene(Camera(160, 120, fov=50, pose=flight), duration=0.3, label_rate=10, background=0.1)
    scene += Primitive("cylinder", radius=0.5, height=3, material=Material(procedural="glyphs", uv_scale=(4, 4)))
    recording = record(scene, timeline=Timeline("uniform", fps=400), labels=["forward"])

    middle = recording.flow[0][50:70, 76:84]
    np.save(out / "middle.npy", middle)
    print(
        f"{len(times)} key frames, {len(recording.events)} events; the column's middle moves "
        f"{np.median(middle[..., 0]):+.2f} px in 0.1 s"
    )


def test_final(out: Path) -> None:
    # The axis stays in the image's centre. A point in front of it, `radius` nearer, turns about it: u = f sin(a) r / (R
    # - r cos a).
    angle, focal = 2 * np.pi * TURNS_PER_S * 0.1, 80 / np.tan(np.radians(25))
    expected = focal * 0.5 * np.sin(angle) / (RADIUS - 0.5 * np.cos(angle))
    assert abs(abs(np.median(np.load(out / "middle.npy")[..., 0])) - expected) < 0.02 * expected


if __name__ == "__main__":
    main(Path("out/examples/own_trajectory"))
