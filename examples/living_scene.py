"""A scene that deforms: people who dance and walk, a fish, a flag and a tower that bends."""

from pathlib import Path

import numpy as np
from PIL import Image

from blinkgl import Camera, Deform, Keyframes, Material, Pose, Primitive, Scene, Way, look_at, record


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    target = (3.2, 0, 1.0)
    flight = Keyframes({0.0: look_at((-0.3, -0.3, 1.5), target), 0.3: look_at((-0.3, 0.3, 1.5), target)})
    scene = Scene(Camera(240, 180, fov=60, pose=flight), duration=0.2, label_rate=10, background=0.5)
    scene += Primitive(
        "grid", width=20, depth=20, material=Material(photograph="brick", uv_scale=(8, 8)), category="ground"
    )
    # A figure wears a coat of its own; `clip` is what it does, `variant` which of many dances.
    scene += Primitive("figure", clip="dance", variant=3, coat=2, pose=Pose((3, -0.8, 0), euler=(0, 0, 160)))
    # Along a way, as fast as its steps take it: feet on the ground stay there.
    scene += Primitive("figure", clip="walk", coat=5, pose=Way([(4, 0.9, 0), (4.2, -0.4, 0), (4, -3, 0)]))
    scene += Primitive(
        "fish", length=0.5, coat=1, pose=Way([(2, -0.1, 1.85), (2, 0.6, 1.95), (2.4, 1.5, 2.1)], level=False)
    )
    scene += Primitive("flag", wind=1.5, coat=4, pose=Pose((4.4, 2.4, 1.5), euler=(0, 0, -80)))
    # `deform` changes the shape of any mesh, of one from a file, too.
    tower = Material(procedural="bricks", uv_scale=(2, 3))
    bends = Deform("bend", angle=25, period=0.8)
    scene += Primitive("cuboid", extents=(0.4, 0.4, 1.4), material=tower, pose=(2.8, 0.95, 0.7), deform=bends)

    recording = record(scene, labels=("images", "forward", "ids"))
    Image.fromarray(recording.images[1]).save(out / "living.png")
    label = recording.labels[0]
    np.savez(out / "recording.npz", t=recording.events.t, flow=recording.flow[0], ids=label.ids)
    print(f"{len(recording.events)} events in {recording.frames} frames")
    for number, thing in enumerate(scene.objects, start=1):
        here = (label.ids == number) & recording.valid[0]
        if here.any():
            speed = np.linalg.norm(recording.flow[0][here], axis=1)
            print(f"{thing.tree['name']:8} {here.sum():6d} px, flow {speed.min():5.2f} to {speed.max():5.2f} px")


def test_final(out: Path) -> None:
    made = np.load(out / "recording.npz")
    speed, ids = np.linalg.norm(made["flow"], axis=-1), made["ids"]
    assert len(made["t"]) > 10_000 and set(range(1, 7)) <= set(np.unique(ids))
    assert speed[ids == 2].std() > 0.8  # px; who stands still has a third of it
    assert np.asarray(Image.open(out / "living.png")).std() > 20


if __name__ == "__main__":
    main(Path("out/examples/living_scene"))
