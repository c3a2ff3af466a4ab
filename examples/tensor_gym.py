"""A gymnasium-style environment whose observation is a voxel grid: the agent turns to keep a moving target in view."""

from pathlib import Path

import numpy as np
import torch

from blinkgl import TensorEsim
from blinkgl.tensors import voxel_grid

ENVS, SIZE, BINS, FRAMES, FRAME_NS = 4, 48, 5, 4, 2_000_000


class FollowTheTarget:
    """``reset`` and ``step`` as gymnasium's vector environments have them. observation : (ENVS, BINS, SIZE, SIZE)
    float32, signed events between two actions.   action : (ENVS,) px that the view turns until the next."""

    def __init__(self, seed: int):
        self.random = torch.Generator().manual_seed(seed)
        self.camera = TensorEsim(SIZE, SIZE, envs=ENVS, seed=seed)
        self.x, self.speed, self.t_ns = torch.zeros(ENVS), torch.zeros(ENVS), torch.zeros(ENVS, dtype=torch.int64)

    def reset(self, mask: torch.Tensor) -> torch.Tensor:
        place, speed = torch.rand(2, int(mask.sum()), generator=self.random)
        self.x[mask], self.speed[mask] = SIZE / 2 + 8 * place - 4, 6 * speed - 3
        self.t_ns[mask] = 0  # an environment that begins anew has times of its own
        self.camera.reset(mask)
        return self.step(torch.zeros(ENVS))[0]

    def draw(self) -> torch.Tensor:
        """(ENVS, SIZE, SIZE) linear luminance: a bright disc on grey."""
        y, x = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
        return 0.2 + 0.6 * torch.sigmoid(8.0 - torch.hypot(x - self.x[:, None, None], y - SIZE / 2))

    def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(observation, reward, terminated)"""
        grid, start = torch.zeros(ENVS, BINS, SIZE, SIZE), self.t_ns // 1000
        for _ in range(FRAMES):  # frames between two actions
            self.x += (self.speed - action) / FRAMES
            self.t_ns += FRAME_NS
            events = self.camera.step(self.draw(), self.t_ns)
            grid += voxel_grid(events, start, start + FRAMES * FRAME_NS // 1000, BINS)
        away = (self.x - SIZE / 2).abs()
        return grid, 1 - away / (SIZE / 2), away > SIZE / 2 - 8


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    score, losses = {}, {}
    for name in ("asleep", "awake"):
        env = FollowTheTarget(3)
        observation, rewards, lost = env.reset(torch.ones(ENVS, dtype=torch.bool)), [], 0
        columns, turn = torch.arange(SIZE) - SIZE / 2, torch.zeros(ENVS)
        for _ in range(30):
            weight = observation.abs().sum((1, 2))  # events in each column
            place = (weight * columns).sum(1) / weight.sum(1).clamp(min=1)
            turn = (turn + 0.3 * place).clamp(-6, 6) if name == "awake" else turn
            observation, reward, terminated = env.step(turn)
            rewards.append(float(reward.mean()))
            if terminated.any():
                lost, turn = lost + int(terminated.sum()), turn * ~terminated
                observation = env.reset(terminated)
        score[name], losses[name] = np.mean(rewards), lost
        print(f"{name}: mean reward {score[name]:.2f}, {lost} targets lost")
    np.savez(out / "scores.npz", **score, lost=[losses["asleep"], losses["awake"]])


def test_final(out: Path) -> None:
    made = np.load(out / "scores.npz")
    assert made["awake"] > made["asleep"] + 0.03 and made["lost"][1] < made["lost"][0]


if __name__ == "__main__":
    main(Path("out/examples/tensor_gym"))
