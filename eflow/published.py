"""Conversion of the published checkpoints of E-RAFT (``dsec.tar``, ``mvsec_20.tar``, …) to safetensors files of
:class:`~eflow.models.eraft.Eraft`.

Those files are pickles. torch's restricted reader takes only tensors and plain containers from them and executes no
code. Names differ here, the gates of the GRU are one convolution, and the taps of a look-up have another order; the
numbers are the same. So is the flow, with E-RAFT's own padding and border, which the new file stores.
"""

from __future__ import annotations

import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from blinkgl.errors import AssetError
from blinkgl.io.atomic import atomic_file
from eflow.checkpoint import load_weights, metadata_of, write_tensors
from eflow.models import FlowModel, build_model, model_config

COLOURS = 3
_IGNORED = ("norm3.", "num_batches_tracked")
"""Parts of published names to skip: the norm of a shortcut is stored twice, and counters of batches are not used."""


def import_published(path: str | os.PathLike, out: str | os.PathLike) -> FlowModel:
    """Write the weights in ``path`` to the new safetensors file ``out`` and return the network.

    Raises AssetError: not a checkpoint of this layout, truncated, or with anything but tensors.
    OutputError: ``out`` exists or cannot be written."""
    path = Path(path)
    model = from_published(read_published(path), str(path))
    with atomic_file(out, overwrite=False) as temporary:
        write_tensors(temporary, model.state_dict(), metadata_of(model))
    return model


_SCALAR = cast(Callable, np.float64(0).__reduce__()[0])
_NUMBERS: list[Callable | tuple[Callable, str]] = [
    np.dtype,
    *(type(np.dtype(code)) for code in "?bBhHiIlLqQefd"),
    *((_SCALAR, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")),
]
"""What NumPy's numbers beside the tensors (an epoch, a score) are made of; under either name of its module."""


def read_published(path: Path) -> dict[str, Tensor]:
    """Return the named tensors of a torch checkpoint, or of its entry ``model`` or ``state_dict``. Raises
    AssetError."""
    try:
        with torch.serialization.safe_globals(_NUMBERS):
            tree = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise AssetError("no such file", where=str(path)) from None
    except pickle.UnpicklingError as error:
        if "GLOBAL" in str(error):  # the file names a class or function to call
            raise AssetError(
                "holds more than tensors, which could run any code when loaded; refused",
                where=str(path),
                accepted="a checkpoint of tensors",
            ) from error
        raise AssetError("truncated or not a checkpoint of PyTorch", where=str(path)) from error
    except OSError as error:
        reason = os.strerror(error.errno).lower() if error.errno else str(error)
        raise AssetError(f"cannot be read: {reason}", where=str(path)) from error
    except Exception as error:  # damaged bytes raise errors of many types, AssertionError too
        raise AssetError("truncated or not a checkpoint of PyTorch", where=str(path)) from error
    for key in ("model", "state_dict"):
        if isinstance(tree, dict) and isinstance(tree.get(key), dict):
            tree = tree[key]
    if not isinstance(tree, dict) or not tree or not all(isinstance(k, str) for k in tree):
        raise AssetError("holds no tensors by name", where=str(path), accepted="E-RAFT's checkpoint")
    tensors = {k.removeprefix("module."): v for k, v in tree.items()}
    for name, value in tensors.items():
        if not isinstance(value, Tensor):
            raise AssetError(f"'{name}' is not a tensor", where=str(path), value=type(value).__name__)
    return tensors


def from_published(tensors: dict[str, Tensor], where: str) -> FlowModel:
    """Return the network with published tensors. Raises AssetError, as :func:`import_published`."""
    first = _tensor(tensors, "fnet.conv1.weight", where)
    channels = first.shape[1] if first.ndim == 4 else 0
    if channels == COLOURS:
        raise AssetError("weights of RAFT are for images, not events", where=where, accepted="E-RAFT's checkpoint")
    if not 2 <= channels <= 64:
        raise AssetError("tensor 'fnet.conv1.weight' has another shape", where=where, value=tuple(first.shape))
    events = {"bins": channels, "normalise": "nonzero", "bounds": "events"}
    config = {"name": "eraft", "input": events, "border": "zero", "padding": "start"}
    model = build_model(model_config(config))
    ours = model.state_dict()
    taken = {}
    for name, wanted in ours.items():
        if name.endswith("num_batches_tracked"):
            taken[name] = wanted
            continue
        sources = published_names(name)
        parts = [_tensor(tensors, source, where) for source in sources]
        # Two published gates are stacked along their output channels; a scalar has no axis to stack along.
        value = torch.cat(parts) if all(p.ndim for p in parts) else parts[0]
        if value.shape != wanted.shape or not value.is_floating_point():
            raise AssetError(
                f"tensor '{' and '.join(sources)}' has another shape or type",
                where=where,
                value=(tuple(value.shape), str(value.dtype).removeprefix("torch.")),
                accepted=f"{tuple(wanted.shape)}, floating point",
            )
        taken[name] = (_reordered(value) if name == "update.motion.corr1.weight" else value).float()
    used = {source for name in ours for source in published_names(name)}
    left = [k for k in sorted(set(tensors) - used) if not any(part in k for part in _IGNORED)]
    if left:
        raise AssetError(
            f"holds a tensor '{left[0]}' that E-RAFT does not have", where=where, accepted="E-RAFT's checkpoint"
        )
    load_weights(model, taken, where)
    return model.eval()


_RENAMED = {
    "^features": "fnet",
    "^context": "cnet",
    "^update": "update_block",
    r"net\.0\.": "net.conv1.",
    r"net\.1\.": "net.norm1.",
    # Layers 3 to 8 are three stages of two residual blocks each.
    r"net\.3\.": "net.layer1.0.",
    r"net\.4\.": "net.layer1.1.",
    r"net\.5\.": "net.layer2.0.",
    r"net\.6\.": "net.layer2.1.",
    r"net\.7\.": "net.layer3.0.",
    r"net\.8\.": "net.layer3.1.",
    r"net\.9\.": "net.conv2.",
    "shortcut": "downsample",
    "mask_head": "mask",
    "motion.corr": "encoder.convc",
    "motion.flow": "encoder.convf",
    "motion.join": "encoder.conv",
    # Update and reset gate are one convolution here and two there.
    r"gates\.0": "conv{gate}1",
    r"gates\.1": "conv{gate}2",
    r"candidates\.0": "convq1",
    r"candidates\.1": "convq2",
    r"flow_head\.0": "flow_head.conv1",
    r"flow_head\.2": "flow_head.conv2",
}
"""Parts of our names, in this order -> what they are called in published files."""


def published_names(name: str) -> tuple[str, ...]:
    """Return the published names of the parameter ``name``: that of ``features.3.conv1.weight`` is
    ``fnet.layer1.0.conv1.weight``; there are two of a convolution that is both gates."""
    for part, published in _RENAMED.items():
        name = re.sub(part, published, name)
    return tuple(dict.fromkeys(name.format(gate=gate) for gate in "zr"))


def _reordered(weight: Tensor) -> Tensor:
    """Return a weight (C, taps, 1, 1) with its taps in row-major order; published ones are in column-major order."""
    levels, side = 4, 9
    grid = weight.view(weight.shape[0], levels, side, side, 1, 1)
    return grid.transpose(2, 3).reshape(weight.shape)


def _tensor(tensors: dict[str, Tensor], name: str, where: str) -> Tensor:
    if name not in tensors:
        raise AssetError(f"lacks the tensor '{name}'", where=where, accepted="E-RAFT's checkpoint")
    return tensors[name]
