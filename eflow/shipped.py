"""Trained networks that come with the package. Each is a folder of ``eflow/weights``:

    real_small/model.safetensors    weights and buffers; the metadata holds the model configuration
               card.yaml            purpose, training data, scores, limits, and commands that make it again

``eflow models`` lists them, and their names can be used in place of a checkpoint; ``eflow pack`` (packing.py) makes
such a folder from a checkpoint. torch is not imported here.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from pydantic import Field

from blinkgl.config.base import Config
from blinkgl.config.problems import validate
from blinkgl.config.reader import read_table
from blinkgl.errors import AssetError, ConfigError

FOLDER = Path(__file__).parent / "weights"
"""Folder of the networks; if it is empty or missing, none is shipped."""
WEIGHTS, CARD = "model.safetensors", "card.yaml"
LARGEST = 5_000_000
"""Maximum size of the weights, bytes: every clone of the repository contains them."""
NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")


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
