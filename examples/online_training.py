"""A network trained on samples that are rendered while it trains, in a torch DataLoader, without files."""

from pathlib import Path

import numpy as np
import torch
import yaml
from torch.utils.data import DataLoader

from blinkgl import OnlineSequences, WindowSample

RECIPE = {
    "camera": {"width": 32, "height": 32},
    "time": {"duration": 0.05, "label_rate": 20},
    "scene": {
        "objects": {"count": 3},
        "textures": {"photographs": False, "max_size": 64},
        "object_motion": {"kind": "static"},
        "camera_motion": {"speed": 1, "rotation_rate": {"uniform": [20, 90]}},
    },
    "events": {"contrast_threshold": {"uniform": [0.1, 0.3]}},
    "output": {"sequences": 100},
}


def collate(samples: list[WindowSample]) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of a batch: ON and OFF counts of the new windows, log (1 + n); the flow; where it holds."""
    counts = np.zeros((len(samples), 2, 32, 32), np.float32)
    for k, sample in enumerate(samples):
        np.add.at(counts[k], (sample.new.p, sample.new.y, sample.new.x), 1)
    flow = np.stack([sample.flow.transpose(2, 0, 1) for sample in samples])
    valid = np.stack([sample.valid for sample in samples])
    return torch.from_numpy(np.log1p(counts)), torch.from_numpy(flow), torch.from_numpy(valid)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / "recipe.yaml").write_text(yaml.safe_dump(RECIPE))
    network = torch.nn.Conv2d(2, 2, 5, padding=2)
    optimiser = torch.optim.Adam(network.parameters())
    with OnlineSequences(out / "recipe.yaml", window_ms=(5, 15), workers=1, seed=0) as sequences:
        for step, (counts, flow, valid) in enumerate(
            DataLoader(sequences.batches(4, collate, count=6), batch_size=None)
        ):
            error = torch.linalg.vector_norm(network(counts) - flow, dim=1)[valid].mean()
            optimiser.zero_grad()
            error.backward()
            optimiser.step()
            print(f"step {step}: {error.item():.2f} px off")
        made = sequences.stats
    np.savez(out / "stats.npz", samples=made.samples, failures=made.failures)


def test_final(out: Path) -> None:
    stats = np.load(out / "stats.npz")
    assert stats["samples"] >= 24 and stats["failures"] == 0
    assert sorted(path.name for path in out.iterdir()) == ["recipe.yaml", "stats.npz"]


if __name__ == "__main__":
    main(Path("out/examples/online_training"))
