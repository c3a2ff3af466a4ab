"""A rig in Python: a stereo pair of event cameras, a fisheye frame camera and an inertial unit; disparity and gyroscope
are compared with depth and poses."""

from pathlib import Path

import numpy as np
from PIL import Image

from blinkgl import Camera, Keyframes, Material, Primitive, Rig, RigSensor, Scene, look_at, record

FOCAL, BASELINE = 180.0, 0.12


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    # The pose of the scene's camera is the rig's; each sensor has its place on the rig, x right, y down, z forward.
    target = (0, 0, 0.5)
    flight = Keyframes({t: look_at((-3, 2 * t - 0.3, 1 + t), target) for t in (0.0, 0.15, 0.3)})
    scene = Scene(Camera(240, 180, focal=FOCAL, pose=flight), duration=0.2, label_rate=10, background=0.4)
    scene += Primitive("grid", width=8, depth=8, material=Material(procedural="bricks", uv_scale=(8, 8)))
    scene += Primitive("icosphere", radius=0.5, pose=(0, 0.4, 0.5), material=Material(procedural="checks"))
    scene += Primitive("cuboid", pose=(0.3, -0.7, 0.5), material=Material(photograph="astronaut"))

    fisheye = Camera(240, 180, focal=135, lens="equidistant", distortion=(-0.02, 0.005, 0, 0))
    rig = Rig(
        RigSensor("left", pair="right", labels=["images", "depth", "disparity"]),
        RigSensor("right", pair="left", position=(BASELINE, 0, 0), labels=["images"]),
        RigSensor("fisheye", camera=fisheye, position=(0.06, -0.03, 0), images={"rate": 20, "exposure_us": 8000}),
        RigSensor("imu", imu={"preset": "ideal", "rate": 500}, position=(0.06, 0.02, 0), euler=(0, 0, 90)),
    )
    flown = record(scene, rig)  # generate(scene, "out/rig", rig=rig) writes the same as files

    left = flown["left"].labels[0]
    seen = left.disparity > 0
    depth = FOCAL * BASELINE / left.disparity[seen]
    views = [flown["left"].images[0], flown["right"].images[0], flown["fisheye"].camera[1].image]
    Image.fromarray(np.hstack(views)).save(out / "views.png")
    gyro = flown.units["imu"]
    # What the unit's own rates make of its first attitude, beside where the rig in fact ended.
    turned = rotation_of(gyro.rate, 1 / 500)
    to_rig = flown.T_rig_sensor["imu"][:3, :3]
    flew = flown.T_world_rig[0, :3, :3].T @ flown.T_world_rig[-1, :3, :3]
    apart = np.linalg.norm(to_rig @ turned @ to_rig.T - flew) / np.sqrt(2)  # rad, where it is small
    np.savez(out / "rig.npz", depth=depth, true=left.depth[seen], apart=apart)
    for name in ("left", "right"):
        print(f"{name:6} {len(flown[name].events)} events")
    print(f"fisheye {len(flown['fisheye'].camera)} images, imu {len(gyro.t_ns)} measurements")
    print(f"depth out of the disparity: {np.abs(depth / left.depth[seen] - 1).max():.0e} off")
    print(f"rates summed up over 0.3 s: {apart:.0e} rad off")


def rotation_of(rate: np.ndarray, step: float) -> np.ndarray:
    """(3, 3) that body rates (N, 3) rad/s lead to, each mean of two neighbours held for ``step`` s."""
    R = np.eye(3)
    for w in (rate[:-1] + rate[1:]) / 2 * step:
        angle, K = np.linalg.norm(w), np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        R = R @ (np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * K @ K)
    return R


def test_final(out: Path) -> None:
    made = np.load(out / "rig.npz")
    assert np.abs(made["depth"] / made["true"] - 1).max() < 1e-5
    assert made["apart"] < 1e-4 and np.asarray(Image.open(out / "views.png")).shape == (180, 720, 3)


if __name__ == "__main__":
    main(Path("out/examples/rig_in_python"))
