"""Events of a renderer in torch: a moving texture in eight environments, each at its own speed. TensorEsim makes the
events of all in one call, on the device of the frames."""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from blinkgl import Esim, TensorEsim
from blinkgl.tensors import event_counts

ENVS, HEIGHT, WIDTH, STEP_NS = 8, 120, 160, 1_000_000
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def texture() -> torch.Tensor:
    """(1, 1, 256, 256) luminance, smooth noise."""
    noise = torch.randn(1, 1, 64, 64, generator=torch.Generator().manual_seed(1))
    return torch.exp(0.7 * F.interpolate(noise, size=(256, 256), mode="bicubic") - 1.0).to(DEVICE)


def draw(picture: torch.Tensor, shift_px: torch.Tensor) -> torch.Tensor:
    """(ENVS, HEIGHT, WIDTH) float32 linear luminance, the texture moved by (ENVS,) px to the left."""
    y, x = torch.meshgrid(torch.arange(HEIGHT, device=DEVICE), torch.arange(WIDTH, device=DEVICE), indexing="ij")
    x = x + shift_px[:, None, None]
    grid = torch.stack((x, y.expand_as(x)), -1) / 128 - 1  # from pixels to the -1 to 1 of grid_sample
    return F.grid_sample(picture.expand(ENVS, -1, -1, -1), grid, padding_mode="reflection", align_corners=False)[:, 0]


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    picture, speeds = texture(), torch.linspace(0.1, 0.8, ENVS, device=DEVICE)  # px a step
    emulator = TensorEsim(HEIGHT, WIDTH, envs=ENVS, device=DEVICE, seed=5)
    twin = Esim(HEIGHT, WIDTH, seed=5 + 3)  # what environment 3 equals
    counts, same = torch.zeros(ENVS, dtype=torch.int64), True
    for step in range(12):
        frames = draw(picture, speeds * step)
        events = emulator.step(frames, step * STEP_NS)
        counts += event_counts(events).sum((1, 2, 3)).cpu()
        ours, alone = events.numpy()[3], twin.step(frames[3].cpu().numpy(), step * STEP_NS)
        same &= all(np.array_equal(getattr(ours, name), getattr(alone, name)) for name in "xytp")
    np.savez(out / "counts.npz", counts=counts.numpy(), same=same)
    for k in (0, 3, 7):
        print(f"environment {k}: {speeds[k]:.1f} px a step, {counts[k]} events")
    print("environment 3 has the events of blinkgl.Esim, bit for bit" if same else "other events")


def test_final(out: Path) -> None:
    made = np.load(out / "counts.npz")
    assert made["same"] and (np.diff(made["counts"]) > 0).all(), "the faster, the more events"


if __name__ == "__main__":
    main(Path("out/examples/tensor_environments"))
