"""Trained networks that come with the package. Each is a folder of ``eflow/weights``:

    real_small/model.safetensors    weights and buffers; the metadata holds the model configuration
               card.yaml            purpose, training data, scores, limits, and commands that make it again

``eflow models`` lists them, and their names can be used in place of a checkpoint; ``eflow pack`` makes such a folder
from a checkpoint. Only packing imports torch.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from blinkgl import __version__
from blinkgl.config.base import Config
from blinkgl.config.problems import validate
from blinkgl.config.reader import read_table, to_yaml
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.atomic import atomic_folder, output_errors
from blinkgl.sequence_files.sequence_dir import refuse_existing
from eflow.methods.table import METHODS

FOLDER = Path(__file__).parent / "weights"
"""Folder of the networks; if it is empty or missing, none is shipped."""
WEIGHTS, CARD = "model.safetensors", "card.yaml"
LARGEST = 5_000_000
"""Maximum size of the weights, bytes: every clone of the repository contains them."""
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")


class CardText(Config):
    """The part of a card that a person writes."""

    about: str = Field(min_length=1, max_length=200, description="purpose, in one line")
    data: str = Field(min_length=1, description="training data")
    training: str = Field(min_length=1, description="duration, machine and seeds of the training")
    scores: dict[str, float | str] = Field(min_length=1, description="name of a measurement: its value")
    limits: tuple[str, ...] = Field(min_length=1, description="where it fails, and what was not tried")
    commands: tuple[str, ...] = Field(min_length=1, description="commands that make it again, in order")


class Card(CardText):
    """The whole card: the text, and facts about the file of weights."""

    name: str = Field(description="name of the network")
    network: str = Field(description="model.name")
    size: str = Field(description="model.size")
    parameters: int = Field(ge=1, description="number of trainable parameters")
    stored: Literal["fp32", "fp16"] = Field(description="precision of the file; computations are in fp32")
    rounding_px: float = Field(ge=0, description="largest change of flow by this precision, on random events")
    bytes: int = Field(ge=1, description="size of the weights")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="checksum of the weights")
    version: str = Field(description="version of the package that packed it")


def names() -> list[str]:
    """Return the names of the shipped networks, sorted."""
    return sorted(p.name for p in FOLDER.iterdir() if (p / CARD).is_file()) if FOLDER.is_dir() else []


def is_shipped(name: str | os.PathLike) -> bool:
    """Whether ``name`` is a shipped network; files and folders of that name have priority."""
    return str(name) in names() and not Path(name).exists()


def known() -> str:
    """Return the list of shipped networks for an error message; "" if there are none."""
    return f"; or a network that comes with the package: {', '.join(names())}" if names() else ""


def suggestion(name: str) -> str:
    """Return a hint to the shipped network that was probably meant, for an error message; or ""."""
    near = difflib.get_close_matches(name, names(), 1, 0.75)
    return f" (did you mean {near[0]}?)" if near else ""


def weights_of(folder: Path) -> Path:
    """Return the file of weights in the folder of a shipped network.

    Raises AssetError: it is missing, or its checksum is not that of the card (an incomplete clone, an edited file)."""
    card, path = read_card(folder), folder / WEIGHTS
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise AssetError(f"cannot be read: {(error.strerror or str(error)).lower()}", where=str(path)) from error
    if digest != card.sha256:
        raise AssetError(
            "checksum of the weights differs from that of the card",
            where=str(path),
            value=digest,
            accepted=f"sha256 {card.sha256}",
        )
    return path


def read_card(folder: Path) -> Card:
    """Return the card in the folder of a shipped network. Raises ConfigError."""
    return validate(Card, read_table(folder / CARD), where=str(folder / CARD))


def card_of(name: str) -> Card:
    """Return the card of a shipped network. Raises ConfigError: unknown name, or a damaged card."""
    if name not in names():
        raise ConfigError(
            f"no such network{suggestion(name)}",
            value=name,
            accepted=", ".join(names()) or "none: no network comes with this version",
        )
    return read_card(FOLDER / name)


def lines(card: Card, whole: bool = True) -> Iterator[str]:
    """Yield the lines of a card as text; if not ``whole``, only those for a list."""
    yield card.name
    yield f"  {card.about}"
    yield (
        f"  network   {card.network} {card.size}, {card.parameters / 1e6:.2f} M parameters, "
        f"{card.bytes / 1e6:.1f} MB ({card.stored})"
    )
    yield f"  data      {card.data}"
    scores = [f"{what}: {value if isinstance(value, str) else f'{value:g}'}" for what, value in card.scores.items()]
    if whole:
        yield f"  training  {card.training}"
    tables = {"scores": scores, "limits": card.limits if whole else (), "again": card.commands}
    for title, entries in tables.items():
        for k, entry in enumerate(entries):
            yield f"  {'' if k else title:10}{entry}"
    if whole:
        yield f"  file      sha256 {card.sha256}; packed by version {card.version}"


def pack(
    checkpoint: str | os.PathLike,
    name: str,
    card: str | os.PathLike,
    out: str | os.PathLike,
    *,
    averaged: bool = True,
) -> tuple[Path, Card]:
    """Write the new folder ``out/name`` with the weights of a checkpoint and a card (a YAML file of
    :class:`CardText`); return the folder and its card. It appears after its weights were read back, or not at all.
    Weights above 5 MB are rounded to float16; the card says what that changes.

    averaged : use the averaged weights if there are any.
    Raises ConfigError: bad name or card. AssetError: bad checkpoint, or above 5 MB in float16, too. OutputError."""
    from eflow.checkpoint import load_model, metadata_of, write_tensors
    from eflow.infer import largest_change
    from eflow.models import NETWORKS, parameters_of

    if not _NAME.fullmatch(name) or name in METHODS or name in NETWORKS:
        raise ConfigError(
            "not a valid name of a network",
            where="--name",
            value=name,
            accepted="small letters, digits, _ and -; not the name of a method or an architecture",
        )
    text = validate(CardText, read_table(card), where=str(card))
    final = Path(out) / name
    refuse_existing(final)
    model = load_model(checkpoint, averaged=averaged)
    tensors, stored = _stored(model.state_dict(), checkpoint)
    with atomic_folder(final) as folder:
        write_tensors(folder / WEIGHTS, tensors, metadata_of(model))
        (folder / WEIGHTS).chmod(0o644)  # other users of an installation must be able to read it
        packed = load_model(folder / WEIGHTS, expected=model.config)  # raises if it cannot be read
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


def _stored(tensors: dict[str, Any], checkpoint: str | os.PathLike) -> tuple[dict[str, Any], Literal["fp32", "fp16"]]:
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
