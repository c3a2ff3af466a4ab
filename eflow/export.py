"""A network as an ONNX file, for programs without torch.

    import onnxruntime, numpy as np
    session = onnxruntime.InferenceSession("model.onnx")
    flow = session.run(None, {"new": grid[None]})[0]       # (1, 2, H, W) float32 px

Inputs are the event tensors of :mod:`eflow.data.representation` ("old" and "new", or "new" alone where the network sees
one window), float32 (N, C, H, W); the output "flow" is (N, 2, H, W) px, t -> t + Δ. What the tensors are, and which
sizes are taken, is in the file's metadata.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import warnings
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.atomic import atomic_file
from eflow.models import FlowModel

OPSET = 18
TOLERANCE = 1e-4
"""Largest difference between onnxruntime's and torch's flow, px, or share of the longest flow."""
FREE_BATCH = ("ev_flownet", "spike_flownet")
"""Whose batch the exporter leaves open; that of the others is 1."""
ONE_SIZE = ("eflowformer",)
"""Whose sizes it does not: attention is padded to windows."""
REFUSED = {
    "ste_flownet": "its three sweeps over five slices unroll into a graph that the exporter does not finish in ten "
    "minutes",
}


class _Flow(nn.Module):
    """Tensors in, tensor out."""

    def __init__(self, model: FlowModel):
        super().__init__()
        self.model = model

    def forward(self, *tensors: Tensor) -> Tensor:
        return self.model(dict(zip(self.model.reads, tensors, strict=True))).flow


def export_onnx(
    model: FlowModel, out: str | os.PathLike, *, size: tuple[int, int] | None = None, check: bool = True
) -> dict[str, str]:
    """Writes ``model`` (evaluation mode, fp32) to the new file ``out``; returns the metadata in it.

    size : (height, width) that alone are taken; None: any multiples of the network's stride.
    check : compare with onnxruntime on random input, at two sizes where any is taken.
    Raises ConfigError: a network or a size that cannot be exported. AssetError: the exported network says something
    else. OutputError: ``out``."""
    name = model.config.name
    if name in REFUSED:
        raise ConfigError(f"{name} is not exported: {REFUSED[name]}")
    if model.pad_start:
        raise ConfigError(f"{name} with E-RAFT's own padding is not exported", accepted="padding: end")
    if size is None and name in ONE_SIZE:
        raise ConfigError(f"{name} is exported for one size only", where="--size", accepted="WIDTHxHEIGHT")
    if size is not None and (min(size) < model.least or any(s % model.divisor for s in size)):
        raise ConfigError(
            "a size the network does not take",
            where="--size",
            value=f"{size[1]}x{size[0]}",
            accepted=f"multiples of {model.divisor}, at least {model.least}",
        )
    model = model.eval().cpu().float()
    if hasattr(model.config, "correlation"):  # which of two ways is a question of memory, asked of a size
        model.config = model.config.model_copy(update={"correlation": "dense"})
    wrapped, names = _Flow(model), model.reads
    multiples = _multiple(model.divisor, model.least)
    example = size or (multiples(160), multiples(192))
    told = {
        "model": model.config.model_dump_json(),
        "representation": json.dumps({"name": type(model.representation).__name__, **asdict(model.representation)}),
        "windows": "old: events of [t - d, t), new: of [t, t + d); flow: px, t -> t + d, +x right, +y down",
        "sizes": f"{size[1]}x{size[0]}" if size else f"multiples of {model.divisor}, at least {model.least}",
    }
    with atomic_file(out, overwrite=False) as temporary:
        with _quiet():
            program = torch.onnx.export(
                wrapped,
                _random(model, 2 if name in FREE_BATCH and size is None else 1, example, len(names)),
                dynamo=True,
                opset_version=OPSET,
                input_names=list(names),
                output_names=["flow"],
                dynamic_shapes=None if size else {"tensors": tuple(_free(model) for _ in names)},
                verbose=False,
            )
        program.model.metadata_props.update(told)
        program.save(str(temporary))
        if check:
            sizes = [size] if size else [(multiples(128), multiples(160)), (multiples(200), multiples(128))]
            for height, width in sizes:
                compare(wrapped, temporary, _random(model, 1, (height, width), len(names)), str(out))
    return told


def compare(wrapped: nn.Module, path: Path, tensors: tuple[Tensor, ...], where: str) -> float:
    """Largest difference of the file's flow from torch's, px. Raises AssetError beyond :data:`TOLERANCE`."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    given = {i.name: t.numpy() for i, t in zip(session.get_inputs(), tensors, strict=True)}
    with torch.no_grad():
        wanted = wrapped(*tensors).numpy()
    difference = float(np.abs(session.run(None, given)[0] - wanted).max())
    if not difference <= TOLERANCE * max(1.0, float(np.abs(wanted).max())):
        raise AssetError("onnxruntime gives another flow", where=where, value=difference, accepted=f"<= {TOLERANCE} px")
    return difference


def _multiple(divisor: int, least: int):
    return lambda side: max(-(-side // divisor) * divisor, -(-least // divisor) * divisor)


def _random(model: FlowModel, batch: int, size: tuple[int, int], count: int) -> tuple[Tensor, ...]:
    """Tensors as sparse as those of events."""
    draw = torch.Generator().manual_seed(0)
    shape = (batch, model.representation.channels, *size)
    make = lambda: torch.randn(shape, generator=draw) * (torch.rand(shape, generator=draw) < 0.2)
    return tuple(make() for _ in range(count))


def _free(model: FlowModel) -> dict[int, object]:
    """Axes that the exported network leaves open."""
    least = -(-model.least // model.divisor)
    height, width = (torch.export.Dim(k, min=least, max=4096) * model.divisor for k in ("height", "width"))
    batch = {0: torch.export.Dim("batch", max=1024)} if model.config.name in FREE_BATCH else {}
    return {**batch, 2: height, 3: width}


@contextlib.contextmanager
def _quiet():
    """Without the exporter's remarks about packages that are not needed, and about itself."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)
