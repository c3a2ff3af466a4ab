"""Training data without files: windows of events and the flow over each, one at a time."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl import (
    Camera,
    EventChunk,
    Events,
    GroundTruth,
    Keyframes,
    Material,
    Primitive,
    Scene,
    look_at,
    simulate_sequence,
)

BINS = 5


def samples(scene: Scene) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of every label: signed counts of the events until the next one (BINS, H, W), the flow until
    then (2, H, W), px, and its mask (H, W)."""
    truth, window = None, []
    for item in simulate_sequence(scene, labels=["forward"]):
        if isinstance(item, EventChunk):
            window.append(item.events)
        elif isinstance(item, GroundTruth):  # every event before its time has come, and no other
            if truth is not None:
                flow = truth.frame.forward
                grid = counts(Events.concatenate(window), truth.t_ns // 1000, item.t_ns // 1000, flow.valid.shape)
                yield grid, flow.flow.transpose(2, 0, 1), flow.valid
            truth, window = item, []


def counts(events: Events, t0_us: int, t1_us: int, shape: tuple[int, int]) -> np.ndarray:
    grid = np.zeros((BINS, *shape), np.float32)
    bins = (events.t - t0_us) * BINS // (t1_us - t0_us)
    np.add.at(grid, (bins, events.y, events.x), 2.0 * events.p - 1.0)
    return grid


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2, -0.5, 0.6), (0, 0, 0)), 0.5: look_at((-2, 0.5, 0.6), (0, 0, 0))})
    scene = Scene(Camera(64, 48, pose=flight), duration=0.3, label_rate=10) + Primitive(
        "cuboid", material=Material(procedural="fbm")
    )
    for k, (grid, flow, valid) in enumerate(samples(scene)):
        np.savez(out / f"{k}.npz", grid=grid, flow=flow, valid=valid)
        print(
            f"window {k}: {np.abs(grid).sum():.0f} events after those that cancel, flow of "
            f"{np.abs(flow[:, valid]).mean():.2f} px on average"
        )


def test_final(out: Path) -> None:
    assert len(list(out.iterdir())) == 3
    made = np.load(out / "0.npz")
    assert np.abs(made["grid"]).sum(axis=(1, 2)).min() > 0, "events in every bin of the window"
    assert made["flow"].shape == (2, 48, 64) and np.abs(made["flow"][0][made["valid"]]).mean() > 0.5


if __name__ == "__main__":
    main(Path("out/examples/online_windows"))
