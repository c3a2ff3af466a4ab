"""Gives a quick E-FlowFormer's dead units new weights, as the start of a further training.

    python -m blinkgl.tools.revive real_bodies --out out/revived.safetensors
    eflow train … --set init_from=out/revived.safetensors

Units whose rectifier is never above zero get no gradient and stay dead. In the first ``real_bodies`` those were the
U-Net's coarsest scale, which carries motion over the image, and the head of the refinement (``--look POOL`` counts
them). They begin anew here, as in ReDo (Sokar et al., "The dormant neuron phenomenon", ICML 2023): fresh weights into
them, zeros out of them, so that the network answers as before until it has learnt what they are good for.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from eflow import load_model
from eflow.checkpoint import metadata_of, write_tensors
from eflow.data.sources import open_source
from eflow.models import FlowModel
from eflow.models.eflowformer import EFlowFormer

FRESH = ("context.deep", "update.motion.flow2", "update.flow_head")
"""Parts that begin anew."""
DEAD = 1e-3
"""Share of cells above zero under which a unit counts as dead."""


def revived(model: FlowModel, seed: int) -> FlowModel:
    """Return the network with :data:`FRESH` parts of a new one, and with zeros where the others read them."""
    if not isinstance(model, EFlowFormer) or not model.config.quick:
        raise SystemExit("only a quick E-FlowFormer is known here")
    torch.manual_seed(seed)
    new = EFlowFormer(model.config)
    state = model.state_dict()
    state |= {name: value for name, value in new.state_dict().items() if name.startswith(FRESH)}
    deep, narrow = (len(state[f"{name}.weight"]) for name in ("context.deep.0.conv1", "update.motion.flow2"))
    state["context.up.weight"] = state["context.up.weight"].clone()
    state["context.up.weight"][:, :deep] = 0
    state["update.motion.join.weight"] = state["update.motion.join.weight"].clone()
    state["update.motion.join.weight"][:, -narrow:] = 0
    new.load_state_dict(state)
    return new


def dead_units(model: FlowModel, pool: Path, samples: int) -> dict[str, tuple[int, int]]:
    """Return (units, dead ones) of each convolution and block over samples of a pool."""
    shares: dict[str, Tensor] = {}

    def hook(name: str):
        def count(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
            shares[name] = shares.get(name, torch.zeros(output.shape[1])) + (output > 0).float().mean((0, 2, 3))

        return count

    watched = [n for n, m in model.named_modules() if isinstance(m, nn.Conv2d)] + [
        f"context.deep.{k}" for k in range(3)
    ]
    handles = [model.get_submodule(name).register_forward_hook(hook(name)) for name in watched]
    source = open_source(pool)
    for i in np.linspace(0, len(source) - 1, samples).astype(int):
        sample = source[int(i)]
        assert sample.flow is not None
        size = sample.flow.shape[:2]
        with torch.no_grad():
            grids = {k: torch.from_numpy(model.representation(getattr(sample, k), *size))[None] for k in model.reads}
            model.eval()(grids)
    for handle in handles:
        handle.remove()
    return {name: (len(share), int((share / samples < DEAD).sum())) for name, share in shares.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", help="a checkpoint or a packaged network")
    parser.add_argument("--out", type=Path, help="weights to start from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--look", type=Path, metavar="POOL", help="count the dead units over 96 samples of it")
    a = parser.parse_args()
    model = load_model(a.network)
    if a.look:
        for name, (units, dead) in dead_units(model, a.look, 96).items():
            print(f"{name:26} {units:4} units, {dead:4} dead")
    if a.out:
        new = revived(model, a.seed)
        write_tensors(a.out, new.state_dict(), metadata_of(new))


if __name__ == "__main__":
    main()
