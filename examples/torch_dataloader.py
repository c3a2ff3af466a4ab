"""A data set in a torch DataLoader: voxel grids of the events before and after each label, and the flow."""

from pathlib import Path

import torch
from torch.utils.data import DataLoader

from blinkgl import Camera, Keyframes, Material, Primitive, Scene, generate, look_at
from eflow.data.dataset import FlowDataset, collate
from eflow.data.representation import VoxelGrid
from eflow.data.sources import open_source


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2, -0.5, 0.6), (0, 0, 0)), 0.5: look_at((-2, 0.5, 0.6), (0, 0, 0))})
    scene = Scene(Camera(64, 48, pose=flight), duration=0.4, label_rate=10) + Primitive(
        "cuboid", material=Material(procedural="fbm")
    )
    generate(scene, out / "data")

    dataset = FlowDataset([open_source(out / "data")], VoxelGrid(bins=5))
    for batch in DataLoader(dataset, batch_size=2, collate_fn=collate):
        print(f"{batch['name'][0]} …: events {tuple(batch['new'].shape)}, flow {tuple(batch['flow'].shape)}")
    torch.save({key: batch[key] for key in ("old", "new", "flow", "valid")}, out / "batch.pt")


def test_final(out: Path) -> None:
    batch = torch.load(out / "batch.pt", weights_only=True)
    assert batch["new"].shape == (2, 5, 48, 64) and batch["flow"].shape == (2, 2, 48, 64)
    assert batch["new"].abs().sum() > 0 and batch["valid"].any()
    assert batch["flow"][:, 0][batch["valid"]].abs().mean() > 0.5


if __name__ == "__main__":
    main(Path("out/examples/torch_dataloader"))
