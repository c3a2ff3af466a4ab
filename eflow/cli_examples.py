"""Two examples of each command of ``eflow``, for its help and docs/commands.md. A test parses each."""

from __future__ import annotations

EFLOW: dict[str, tuple[str, ...]] = {
    "train": (
        "configs/eflow/smoke.yaml --out out/smoke --resume",
        "--model ev_flownet-tiny --data out/mine/train --minutes 9 -o out/n",
    ),
    "evaluate": ("out/net out/mine/test --out out/scores", "real_small /data/mvsec --dt 4 --dense"),
    "submit": ("out/net /data/dsec/test --out flow.zip", "eraft_dsec.safetensors /data/dsec/test --out flow.zip"),
    "models": ("", "real_small"),
    "import": ("dsec.tar --out eraft_dsec.safetensors", "mvsec_45.tar --out eraft_mvsec.safetensors"),
    "predict": (
        "recording.raw --window-ms auto --video flow.mp4",
        "real_bodies recording.h5 --window-ms 40 --at .5,1 --out out/flow",
    ),
    "render": (
        "configs/eflow/real_data.yaml --samples 2000 -o out/windows",
        "configs/eflow/real_data.yaml --window-ms 5-100 -o out/windows",
    ),
    "export": ("real_small --onnx flow.onnx --size 640x480", "out/net --torchscript flow.pt --size 346x260"),
    "pack": (
        "out/net --name mine --card card.yaml --out eflow/weights",
        "out/net/best.safetensors --name mine --card card.yaml --out weights",
    ),
}
"""Command -> what follows its name."""
