"""Stars of several magnitudes, as points of light, before a camera that turns."""

from pathlib import Path

import numpy as np

from blinkgl import Camera, Keyframes, Light, Material, Pose, Primitive, Scene, record

WIDTH, HEIGHT, FOCAL, AWAY = 160, 120, 600.0, 50.0  # px; m


def sky(stars: int = 60, seed: int = 1) -> Scene:
    """Return stars before a dark sky. The flux of a star falls by 100 in five magnitudes."""
    random = np.random.default_rng(seed)
    turn = Keyframes({0.0: Pose(look_at=(1, 0, 0)), 0.5: Pose(look_at=(1, -0.02, 0.004))}, interpolation="linear")
    camera = Camera(WIDTH, HEIGHT, focal=FOCAL, pose=turn)
    scene = Scene(camera, light=Light(0, 0), background=0.001, duration=0.4)
    for _ in range(stars):
        x, y = random.uniform(0, WIDTH), random.uniform(0, HEIGHT)
        flux = 10 ** (-0.4 * random.uniform(0, 4))  # of one pixel of luminance 1
        scene += Primitive(
            "point",
            pose=Pose((AWAY, (WIDTH / 2 - x) / FOCAL * AWAY, (HEIGHT / 2 - y) / FOCAL * AWAY)),
            material=Material(color=(0, 0, 0), emission=(flux * (AWAY / FOCAL) ** 2,) * 3),
        )
    return scene


def main(out: Path) -> None:
    events = record(sky(), emulator={"emulator": "esim", "contrast_threshold": 0.2}, labels=[]).events
    out.mkdir(parents=True, exist_ok=True)
    np.savez(out / "stars.npz", x=events.x, y=events.y, t=events.t, p=events.p)
    pixels = len(np.unique(events.pixel(WIDTH)))
    print(f"{len(events):,} events of {pixels:,} pixels, {100 * (events.p == 1).mean():.0f} % ON")


def test_final(out: Path) -> None:
    with np.load(out / "stars.npz") as saved:
        # What gets bright where a star comes gets dark where it goes.
        assert len(saved["t"]) > 10_000 and 0.4 < saved["p"].mean() < 0.6


if __name__ == "__main__":
    main(Path("out/examples/star_field"))
