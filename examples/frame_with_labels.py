"""One frame with its ground truth: image, depth, instance ids and optical flow side by side."""

from pathlib import Path

import matplotlib
import numpy as np

from blinkgl import Camera, Keyframes, Material, Pose, Primitive, Renderer, Scene, look_at

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-3, -0.2, 1.2), (0, 0, 0.4)), 0.2: look_at((-2.8, 0.2, 1.2), (0, 0, 0.4))})
    spin = Keyframes({0: Pose((0, 0.7, 0.5)), 0.2: Pose((0, 0.7, 0.5), euler=(0, 0, 40))})
    scene = Scene(Camera(240, 180, fov=50, pose=flight))
    scene += Primitive(
        "grid", width=10, depth=10, material=Material(procedural="bricks", uv_scale=(8, 8)), category="ground"
    )
    scene += Primitive("cuboid", pose=spin, scale=0.9, material=Material(photograph="astronaut"))
    scene += Primitive("capsule", pose=(-0.4, -0.6, 0.5), material=Material(procedural="dots"))

    with Renderer(scene) as renderer:
        image = renderer.image(0.1)
        frame = renderer.frame(0.1, ["depth", "ids", "forward", "occlusion"], to=0.15)  # flow from 0.10 s to 0.15 s
    np.savez(out / "labels.npz", depth=frame.depth, ids=frame.ids, flow=frame.forward.flow, valid=frame.forward.valid)

    speed = np.linalg.norm(frame.forward.flow, axis=-1)
    panels = {
        "image": (image, None),
        "depth, m": (np.where(np.isinf(frame.depth), np.nan, frame.depth), "viridis"),
        "instance id": (frame.ids, "tab10"),
        "flow, px": (speed, "magma"),
    }
    figure, axes = plt.subplots(1, 4, figsize=(13, 2.9), layout="constrained")
    for axis, (title, (values, colours)) in zip(axes, panels.items()):
        picture = axis.imshow(values, cmap=colours)
        axis.set_title(title)
        axis.axis("off")
        if title in ("depth, m", "flow, px"):
            figure.colorbar(picture, ax=axis, shrink=0.8)
    step = np.s_[8::16, 8::16]
    y, x = np.mgrid[:180, :240]
    flow = frame.forward.flow[step]
    axes[3].quiver(
        x[step], y[step], flow[..., 0], flow[..., 1], color="white", angles="xy", scale_units="xy", scale=0.8
    )
    figure.savefig(out / "labels.png", dpi=80)
    plt.close(figure)
    print(
        f"depth {frame.depth.min():.2f} m to {frame.depth[np.isfinite(frame.depth)].max():.2f} m, ids "
        f"{np.unique(frame.ids).tolist()}"
    )
    print(
        f"largest flow {speed.max():.1f} px, {100 * frame.forward.occluded.mean():.1f} % of the pixels occluded at "
        "its end"
    )


def test_final(out: Path) -> None:
    made = np.load(out / "labels.npz")
    assert {1, 2, 3} <= set(np.unique(made["ids"])) and (made["depth"][made["ids"] > 0] < 20).all()
    box = np.linalg.norm(made["flow"][made["ids"] == 2], axis=-1)
    ground = np.linalg.norm(made["flow"][made["ids"] == 1], axis=-1)
    assert box.std() > 0 and ground.max() > 0
    assert (out / "labels.png").stat().st_size > 10_000


if __name__ == "__main__":
    main(Path("out/examples/frame_with_labels"))
