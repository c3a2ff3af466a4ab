"""Events over the frame they follow, as a picture: blue where it became brighter, red where it became darker."""

from pathlib import Path

import matplotlib
import numpy as np

from blinkgl import Camera, Keyframes, Material, Pose, Primitive, Scene, look_at, record

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2.4, -0.5, 1.0), (0, 0, 0.3)), 0.2: look_at((-2.4, 0.5, 1.0), (0, 0, 0.3))})
    scene = Scene(Camera(320, 240, fov=55, pose=flight), duration=0.1, label_rate=10)
    scene += Primitive("grid", width=6, depth=6, material=Material(procedural="fbm", seed=3), category="ground")
    scene += Primitive("cuboid", pose=Pose((0, 0, 0.5), euler=(0, 0, 30)), material=Material(photograph="coffee"))
    recording = record(scene, labels=["images"])

    events = recording.events.window(100_000, 110_000)  # the 10 ms after the image
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    for axis in axes:
        axis.imshow(recording.images[0])
        axis.axis("off")
    for polarity, colour in ((1, "deepskyblue"), (0, "red")):
        axes[1].scatter(events.x[events.p == polarity], events.y[events.p == polarity], s=0.3, c=colour, label=["OFF", "ON"][polarity])
    axes[0].set_title("frame at 100 ms")
    axes[1].set_title("events of the next 10 ms")
    axes[1].legend(loc="upper right", markerscale=6)
    figure.savefig(out / "events.png", dpi=80)
    plt.close(figure)
    np.save(out / "polarity.npy", events.p)
    print(f"{len(events)} events in 10 ms, {100 * events.p.mean():.0f} % of them ON")


def test_final(out: Path) -> None:
    assert len(np.load(out / "polarity.npy")) > 500
    assert plt.imread(out / "events.png").shape == (280, 720, 4)


if __name__ == "__main__":
    main(Path("out/examples/events_over_frame"))
