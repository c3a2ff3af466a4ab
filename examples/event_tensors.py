"""Events as images for a network: a time surface and a voxel grid of five bins."""

from pathlib import Path

import matplotlib
import numpy as np

from blinkgl import Camera, Keyframes, Material, Primitive, Scene, look_at, record
from eflow.ops.voxel import voxel_grid

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2, -0.5, 0.6), (0, 0, 0)), 0.3: look_at((-2, 0.5, 0.6), (0, 0, 0))})
    scene = Scene(Camera(160, 120, pose=flight), duration=0.1) + Primitive(
        "cuboid", material=Material(procedural="bricks")
    )
    recording = record(scene, labels=["forward"])
    events, t0, t1 = recording.window(0), int(recording.t_us[0]), int(recording.image_t_us[1])

    last = np.full((120, 160), -np.inf)
    last[events.y, events.x] = events.t  # in order of time, so that the last one stays
    surface = np.exp((last - t1) / 30_000)  # decays within 30 ms
    grid = voxel_grid(events.x, events.y, events.t, events.p, t0, t1, 5, 120, 160, normalise="none")
    np.savez(out / "tensors.npz", surface=surface, grid=grid, count=len(events), on=events.p.sum())

    figure, axes = plt.subplots(1, 6, figsize=(14, 2.2), layout="constrained")
    axes[0].imshow(surface, cmap="inferno")
    axes[0].set_title("time surface")
    for k in range(5):
        axes[k + 1].imshow(grid[k], cmap="RdBu", vmin=-3, vmax=3)
        axes[k + 1].set_title(f"voxel grid, bin {k}")
    for axis in axes:
        axis.axis("off")
    figure.savefig(out / "tensors.png", dpi=70)
    plt.close(figure)
    print(f"{len(events)} events to a surface {surface.shape} and a grid {grid.shape}")


def test_final(out: Path) -> None:
    made = np.load(out / "tensors.npz")
    assert made["surface"].min() == 0 and 0.9 < made["surface"].max() <= 1
    assert abs(made["grid"].sum() - (2 * int(made["on"]) - int(made["count"]))) < 1, (
        "every event is in the grid once, by its sign"
    )


if __name__ == "__main__":
    main(Path("out/examples/event_tensors"))
