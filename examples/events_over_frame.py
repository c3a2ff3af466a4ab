"""Events drawn over the frame before them: blue where it became brighter, red where it became darker."""

from pathlib import Path

import matplotlib
import numpy as np

from blinkgl import Camera, Keyframes, Material, Pose, Primitive, Scene, look_at, record

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2.4, -0.5, 1.0), (0, 0, 0.3)), 0.2: look_at((-2.4, 0.5, 1.0), (0, 0, 0.3))})
    scene = Scene(Camera(320, 240, fov=55, pose=flight), duration=0.1, label_rate=10)
    scene += Primitive(
        "grid", width=6, depth=6, material=Material(procedural="bricks", uv_scale=(4, 4)), category="ground"
    )
    scene += Primitive("cuboid", pose=Pose((0, 0, 0.5), euler=(0, 0, 30)), material=Material(photograph="coffee"))
    recording = record(scene, labels=["images"])

    events = recording.events.window(100_000, 104_000)  # the 4 ms after the image
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    axes[0].imshow(recording.images[0])
    # Pale, for the events to stand out.
    axes[1].imshow(recording.images[0].mean(axis=-1) / 2 + 127, cmap="gray", vmin=0, vmax=255)
    for polarity, colour in ((1, "blue"), (0, "red")):
        axes[1].scatter(
            events.x[events.p == polarity],
            events.y[events.p == polarity],
            s=0.3,
            c=colour,
            label=["OFF", "ON"][polarity],
        )
    for axis in axes:
        axis.axis("off")
    axes[0].set_title("frame at 100 ms")
    axes[1].set_title("events of the next 4 ms")
    axes[1].legend(loc="upper right", markerscale=6)
    figure.savefig(out / "events.png", dpi=80)
    plt.close(figure)
    np.save(out / "polarity.npy", events.p)
    print(f"{len(events)} events in 4 ms, {100 * events.p.mean():.0f} % of them ON")


def test_final(out: Path) -> None:
    assert len(np.load(out / "polarity.npy")) > 500
    assert plt.imread(out / "events.png").shape == (280, 720, 4)


if __name__ == "__main__":
    main(Path("out/examples/events_over_frame"))
