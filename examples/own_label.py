"""A label of your own: where in the world each pixel's surface is; and a map drawn from it."""

from pathlib import Path

import matplotlib
import numpy as np

from blinkgl import Camera, Material, Pose, Primitive, Renderer, Scene, generate, look_at, verify
from blinkgl.labels import Label, register
from blinkgl.render.casting import scene_parts

matplotlib.use("Agg")
import matplotlib.pyplot as plt


class Position(Label):
    """World-space position of the surface, (H, W, 3) float32 m; 0 where nothing is hit."""

    name, about = "position", "world-space position, m, float32 .npy"
    unit, buffer, varyings, channels, tolerance = "m", "RGBA32F", ("local",), 3, 1e-4
    glsl = """uniform mat4x3 world_from_local;
    vec4 label_position() { return vec4(world_from_local * vec4(local, 1.0), 1.0); }"""

    def uniforms(self, shot):
        return {"world_from_local": shot.moment.T_world_obj[:, :3]}

    def reference(self, scene, frame):  # what `blinkgl shader diff` holds it against, float64
        out = np.zeros((*frame.hit.shape, 3))
        for number, (thing, _) in enumerate(scene_parts(scene)):
            on, pose = frame.part == number, thing.path.pose(frame.t_ns)
            out[on] = frame.local[on] @ pose[:3, :3].T + pose[:3, 3]
        return out


def main(out: Path) -> None:
    register(Position())
    scene = Scene(Camera(160, 120, fov=60, pose=look_at((-3, -2, 2), (0, 0, 0.4))), duration=0.2, label_rate=10)
    scene += Primitive(
        "grid", width=6, depth=6, material=Material(procedural="bricks", uv_scale=(8, 8)), category="ground"
    )
    scene += Primitive(
        "torus", pose=Pose((0, 0, 0.5), euler=(60, 0, 0)), scale=1.4, material=Material(photograph="astronaut")
    )
    with Renderer(scene) as renderer:
        image, frame = renderer.image(0.1), renderer.frame(0.1, ["position"])
    made = generate(scene, out / "data", labels=["position"])
    assert verify(out / "data", deep=1).clean

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    axes[0].imshow(image)
    axes[0].axis("off")
    hit = frame.position.any(axis=-1)
    seen = frame.position[hit]
    axes[1].scatter(seen[:, 0], seen[:, 1], c=image[hit] / 255, s=1)
    axes[1].set(title="the same pixels from above", xlabel="x, m", ylabel="y, m", aspect="equal")
    figure.savefig(out / "position.png", dpi=80)
    plt.close(figure)
    print(
        f"{made.made.count} sequence with {made.made.labels} labels; z from {seen[:, 2].min():.2f} m to "
        f"{seen[:, 2].max():.2f} m"
    )


def test_final(out: Path) -> None:
    (first, *_) = sorted((out / "data").rglob("position/*.npy"))
    z = np.load(first)[..., 2]
    assert -1e-3 < z.min() < 1e-3 and 0.8 < z.max() < 1.4 and (out / "position.png").stat().st_size > 10_000


if __name__ == "__main__":
    main(Path("out/examples/own_label"))
