"""Short trainings, and what they leave."""

import json
from pathlib import Path

import yaml
from safetensors.torch import load_file

from eflow import checkpoint as ckpt

FAST = {"name": "ev_flownet", "input": "voxel", "bins": 5, "width": 8}


def config_file(folder: Path, data: Path, model=FAST, steps=6, crop=(64, 64), **changes) -> Path:
    tree = {
        "seed": 5,
        "model": model,
        "data": {"train": [{"path": str(data)}], "batch": 2, "crop": list(crop), "augment": {"time_reversal": 0.3}},
        "optim": {"steps": steps, "lr": 1e-3},
        "run": {"device": "cpu", "log_every": 1},
    }
    for dotted, value in changes.items():
        part, key = dotted.split("__")
        tree[part][key] = value
    path = folder / "train.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


def tensors(run_folder: Path) -> dict:
    folder = ckpt.newest(run_folder)
    return {f"{p.stem}/{k}": v for p in sorted(folder.glob("*.safetensors")) for k, v in load_file(p).items()}


def log(run_folder: Path) -> list[dict]:
    return [json.loads(line) for line in (run_folder / "log.jsonl").read_text().splitlines()]
