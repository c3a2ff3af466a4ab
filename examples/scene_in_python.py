"""A scene in Python: bodies, materials, a light and a moving camera; events and flow as arrays."""

from pathlib import Path

import numpy as np
from PIL import Image

from blinkgl import Camera, Keyframes, Light, Material, Pose, Primitive, Scene, look_at, record


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    target = (0, 0, 0.4)
    flight = Keyframes({0.0: look_at((-2.6, -0.6, 1.3), target), 0.3: look_at((-2.6, 0.6, 1.3), target)})
    odd = (np.indices((64, 64)) // 8).sum(axis=0) % 2
    squares = np.where(odd[..., None], (230, 200, 60), (40, 60, 110)).astype(np.uint8)  # an image of your own, sRGB

    scene = Scene(Camera(240, 180, fov=55, pose=flight), light=Light(elevation=50), duration=0.2, label_rate=10)
    scene += Primitive(
        "grid", width=8, depth=8, material=Material(procedural="bricks", uv_scale=(6, 6)), category="ground"
    )
    scene += Primitive(
        "cuboid",
        extents=(0.8, 0.8, 0.8),
        pose=Pose((0, -0.6, 0.4), euler=(0, 0, 30)),
        material=Material(photograph="coffee"),
    )
    scene += Primitive("sphere", radius=0.4, pose=(0, 0.7, 0.4), material=Material(squares, uv_scale=(2, 1)))
    scene += Primitive("torus", pose=Pose((-0.6, 0.1, 0.2), euler=(60, 0, 0)), material=Material(color=(0.7, 0.1, 0.1)))

    recording = record(scene)
    Image.fromarray(recording.images[0]).save(out / "scene.png")
    np.savez(out / "recording.npz", t=recording.events.t, flow=recording.flow, valid=recording.valid)
    print(f"{len(scene.objects)} bodies, {len(recording.events)} events in {recording.frames} frames")
    print(f"flow {recording.flow.shape}, at most {np.abs(recording.flow).max():.1f} px from one label to the next")


def test_final(out: Path) -> None:
    made = np.load(out / "recording.npz")
    assert made["flow"].shape == (2, 180, 240, 2) and made["valid"].mean() > 0.5
    assert len(made["t"]) > 10_000 and (np.diff(made["t"]) >= 0).all()
    assert np.asarray(Image.open(out / "scene.png")).std() > 20


if __name__ == "__main__":
    main(Path("out/examples/scene_in_python"))
