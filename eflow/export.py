"""``eflow export``: a network as an ONNX or TorchScript file, for programs without this package.

The file's inputs are the event tensors of the network's windows (:mod:`eflow.data.representation`), "old" and "new" or
"new" alone, (1, C, H, W) float32 of the size that it was exported for; its output "flow" is (1, 2, H, W) float32 px,
t -> t + Δ. It appears after it gave torch's flow for other inputs than those of the export.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.atomic import atomic_file
from blinkgl.machine.extras import EXTRAS, install
from eflow.infer import pad_batch
from eflow.models import FlowModel

OPSET, CHECKS = 18, 3
TOLERANCE = 1e-4
"""Largest difference from torch's flow, as a share of the longest flow, or px where that is shorter than 1 px."""


class _Flow(nn.Module):
    """A network of any size with tensors as arguments and result."""

    def __init__(self, model: FlowModel):
        super().__init__()
        self.model = model

    def forward(self, *windows: Tensor) -> Tensor:
        padded, left, top = pad_batch(dict(zip(self.model.reads, windows, strict=True)), self.model)
        height, width = windows[0].shape[-2:]
        return self.model(padded).flow[..., top : top + height, left : left + width]


def export(model: FlowModel, out: str | os.PathLike, kind: str, height: int, width: int) -> float:
    """Write ``model`` as the new file ``out`` for sensors of (height, width) px; return the largest difference of its
    flow from torch's on three random inputs, px.

    kind : a key of :data:`KINDS`.   Raises ConfigError: a package is missing, or the size is too small.   AssetError:
    the format lacks an operator, or its flow is another one.   OutputError: ``out`` exists or cannot be written."""
    write, load, packages = KINDS[kind]
    if missing := [name for name in packages if importlib.util.find_spec(name) is None]:
        raise ConfigError(f"{missing[0]} is not installed", where=f"--{kind}", accepted=f"run {install(*packages)}")
    if min(height, width) < model.least:
        size = f"{width}x{height}"
        raise ConfigError("too small", where="--size", value=size, accepted=f"at least {model.least} px a side")
    flow, largest = _Flow(model.cpu().eval()), 0.0
    shape = (1, model.representation.channels, height, width)
    draw = torch.Generator().manual_seed(0)
    # As sparse as tensors of events.
    make = lambda: torch.randn(shape, generator=draw) * (torch.rand(shape, generator=draw) < 0.2)
    inputs = [tuple(make() for _ in model.reads) for _ in range(1 + CHECKS)]
    with atomic_file(out, overwrite=False) as temporary, torch.no_grad(), _quiet():
        write(flow, inputs[0], Path(temporary), str(out))
        exported = load(Path(temporary))
        for windows in inputs[1:]:
            wanted = flow(*windows)
            difference = float((exported(*windows) - wanted).abs().max())
            if not difference <= TOLERANCE * max(1.0, float(wanted.abs().max())):
                raise AssetError(
                    "the exported network gives another flow", where=str(out), value=f"{difference:.3g} px"
                )
            largest = max(largest, difference)
    return largest


def _write_onnx(flow: _Flow, windows: tuple[Tensor, ...], path: Path, where: str) -> None:
    names = flow.model.reads
    try:
        program = torch.onnx.export(
            flow, windows, dynamo=True, opset_version=OPSET, input_names=names, output_names=["flow"], verbose=False
        )
    except torch.onnx.errors.OnnxExporterError as error:
        cause: BaseException = error
        # The first cause names the operator; the exceptions around it name stages of the exporter.
        while cause.__cause__ is not None:
            cause = cause.__cause__
        raise AssetError(
            f"ONNX lacks an operator of this network: {next(iter(str(cause).splitlines()), '')}",
            where=where,
            accepted="--torchscript",
        ) from error
    assert program is not None
    program.save(str(path))


def _load_onnx(path: Path) -> Callable[..., Tensor]:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [entry.name for entry in session.get_inputs()]
    return lambda *windows: torch.from_numpy(
        session.run(None, {name: w.numpy() for name, w in zip(names, windows, strict=True)})[0]
    )


def _write_torchscript(flow: _Flow, windows: tuple[Tensor, ...], path: Path, where: str) -> None:
    torch.jit.save(torch.jit.trace(flow, windows, check_trace=False), str(path))


KINDS = {
    "onnx": (_write_onnx, _load_onnx, EXTRAS["onnx"][0]),
    "torchscript": (_write_torchscript, lambda path: torch.jit.load(str(path)), ()),
}
"""The formats: how one is written and read back, and the packages that this takes."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep remarks of the tracer about sizes, which are constants here, and of the exporter about other packages."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        log.setLevel(level)
