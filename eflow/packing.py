"""``eflow pack``: a checkpoint as a network that can come with the package."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from torch import Tensor

from blinkgl.config.problems import validate
from blinkgl.config.reader import read_table, to_yaml
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.atomic import atomic_folder, output_errors
from blinkgl.sequence_files.sequence_dir import refuse_existing
from blinkgl.version import __version__
from eflow.checkpoint import load_model, metadata_of, write_tensors
from eflow.infer import largest_change
from eflow.methods.table import METHODS
from eflow.models import NETWORKS, parameters_of
from eflow.shipped import CARD, LARGEST, NAME, WEIGHTS, Card, CardText


def pack(
    checkpoint: str | os.PathLike,
    name: str,
    card: str | os.PathLike,
    out: str | os.PathLike,
) -> tuple[Path, Card]:
    """Write the new folder ``out/name`` with the weights of a checkpoint and a card (a YAML file of
    :class:`CardText`); return the folder and its card. It appears after its weights were read back, or not at all.
    Weights above 5 MB are rounded to float16; the card says what that changes.

    Raises ConfigError: bad name or card. AssetError: bad checkpoint, or above 5 MB in float16, too. OutputError."""
    if not NAME.fullmatch(name) or name in METHODS or name in NETWORKS:
        raise ConfigError(
            "not a valid name of a network",
            where="--name",
            value=name,
            accepted="small letters, digits, _ and -; not the name of a method or an architecture",
        )
    text = validate(CardText, read_table(os.fspath(card)), where=str(card))
    final = Path(out) / name
    refuse_existing(final)
    model = load_model(checkpoint)
    tensors, stored = _stored(model.state_dict(), checkpoint)
    with atomic_folder(final) as folder:
        write_tensors(folder / WEIGHTS, tensors, metadata_of(model))
        (folder / WEIGHTS).chmod(0o644)  # other users of an installation must be able to read it
        packed = load_model(folder / WEIGHTS)  # raises if it cannot be read
        read = (folder / WEIGHTS).read_bytes()
        full = Card(
            **text.model_dump(),
            name=name,
            network=model.config.name,
            size=model.config.size,
            parameters=parameters_of(model),
            stored=stored,
            rounding_px=largest_change(model, packed),
            bytes=len(read),
            sha256=hashlib.sha256(read).hexdigest(),
            version=__version__,
        )
        with output_errors(folder):
            (folder / CARD).write_text(to_yaml(full.model_dump(mode="json")), encoding="utf-8")
    return final, full


def _stored(
    tensors: Mapping[str, Tensor], checkpoint: str | os.PathLike
) -> tuple[Mapping[str, Tensor], Literal["fp32", "fp16"]]:
    """Return the tensors to store, and their precision: as they are, or in half precision where that is too large.

    Raises AssetError: above 5 MB in half precision, too."""
    size = lambda some: sum(v.numel() * v.element_size() for v in some.values())
    if size(tensors) <= LARGEST:
        return tensors, "fp32"
    halves = {k: v.half() if v.is_floating_point() else v for k, v in tensors.items()}
    if size(halves) > LARGEST:
        raise AssetError(
            "too large to come with the package",
            where=str(checkpoint),
            value=f"{size(halves) / 1e6:.1f} MB in float16",
            accepted=f"at most {LARGEST / 1e6:g} MB",
        )
    return halves, "fp16"
