"""A star tracker's view: stars of a CSV catalogue behind a lens's point spread, at a known attitude.

The mean position of a star's events is its position on the sensor, which a tracker measures.
"""

import csv
from pathlib import Path

import numpy as np

from blinkgl import Camera, Keyframes, Light, Material, Pose, Primitive, Recording, Scene, record

WIDTH, HEIGHT, FOCAL, AWAY = 160, 120, 600.0, 50.0  # px; m
BORESIGHT = np.radians((83.8, -5.4))  # where the camera looks at the start: right ascension, declination
SPREAD = {"psf": {"kind": "gaussian", "sigma": 0.8}}


def direction(right_ascension: float, declination: float) -> np.ndarray:
    """Return the unit vector of angles in rad, z towards the celestial north pole."""
    c = np.cos(declination)
    return np.array([c * np.cos(right_ascension), c * np.sin(right_ascension), np.sin(declination)])


def write_catalogue(path: Path, stars: int = 24, seed: int = 3) -> None:
    """Write a catalogue of random stars around the boresight, and some on the other side of the sky."""
    random = np.random.default_rng(seed)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["name", "ra_deg", "dec_deg", "magnitude"])
        for k in range(stars):
            away = random.uniform(-6, 6, 2) + (180 if k % 10 == 9 else 0, 0)
            place = np.degrees(BORESIGHT) + away
            table.writerow([f"star {k}", *place.round(5), round(random.uniform(0, 4), 2)])


def sky(catalogue: Path) -> Scene:
    """Return the stars of a catalogue before a camera that turns slowly. The flux falls by 100 in five magnitudes."""
    begin, end = direction(*BORESIGHT), direction(*(BORESIGHT + (0.01, 0.004)))
    turn = Keyframes({0.0: Pose(look_at=begin), 0.5: Pose(look_at=end)}, interpolation="linear")
    scene = Scene(Camera(WIDTH, HEIGHT, focal=FOCAL, pose=turn), light=Light(0, 0), background=0.001, duration=0.4)
    with catalogue.open(newline="", encoding="utf-8") as file:
        for star in csv.DictReader(file):
            flux = 10 ** (-0.4 * float(star["magnitude"]))  # of one pixel of luminance 1
            towards = direction(*np.radians((float(star["ra_deg"]), float(star["dec_deg"]))))
            material = Material(color=(0, 0, 0), emission=(flux * (AWAY / FOCAL) ** 2,) * 3)
            scene += Primitive("point", pose=Pose(AWAY * towards), material=material, name=star["name"])
    return scene


def centroids(recording: Recording, catalogue: Path) -> np.ndarray:
    """Return (n, 2), px: where the events of stars well in view lie on average, less where the stars are on average."""
    T = recording.T_world_rig[:, :3, :3]
    with catalogue.open(newline="", encoding="utf-8") as file:
        angles = [np.radians((float(star["ra_deg"]), float(star["dec_deg"]))) for star in csv.DictReader(file)]
    events, errors = recording.events, []
    ways = []
    for one in angles:
        seen = np.einsum("mji,j->mi", T, direction(*one))  # in the camera's axes at each time
        ways.append(seen[:, :2] / seen[:, 2:] * FOCAL + ((WIDTH - 1) / 2, (HEIGHT - 1) / 2))
        ways[-1][seen[:, 2] <= 0] = 1e6  # behind the camera
    for way in ways:
        middle = way.mean(axis=0)
        alone = sum(np.abs(other - middle).max() < 18 for other in ways) == 1
        inside = np.all(np.abs(way - ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)) < (WIDTH / 2 - 8, HEIGHT / 2 - 8))
        near = np.hypot(events.x - middle[0], events.y - middle[1]) < 12
        if alone and inside and near.sum() > 200:
            errors.append((events.x[near].mean() - middle[0], events.y[near].mean() - middle[1]))
    return np.array(errors)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    catalogue = out / "catalogue.csv"
    write_catalogue(catalogue)
    emulator = {"emulator": "esim", "contrast_threshold": 0.2}
    recording = record(sky(catalogue), emulator=emulator, labels=[], optics=SPREAD)
    errors = centroids(recording, catalogue)
    np.save(out / "errors.npy", errors)
    print(f"{len(recording.events):,} events; {len(errors)} stars alone: {np.hypot(*errors.T).mean():.2f} px off")


def test_final(out: Path) -> None:
    errors = np.load(out / "errors.npy")
    assert len(errors) >= 3 and np.hypot(*errors.T).mean() < 0.3


if __name__ == "__main__":
    main(Path("out/examples/star_tracker"))
