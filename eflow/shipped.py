"""Trained networks that come with the package, each a folder of ``eflow/weights``:

    real_small/model.safetensors    weights and buffers; the metadata holds the model configuration
               card.yaml            what it is, what it was trained on, its scores and limits, how it is made again

``eflow models`` lists them, and their names stand where a checkpoint may stand; ``eflow pack`` makes such a folder of a
training. Nothing here imports torch but packing.
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

from blinkgl import __version__
from blinkgl.config.base import Config
from blinkgl.config.problems import validate
from blinkgl.config.reader import read_table, to_yaml
from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.atomic import atomic_folder, output_errors
from blinkgl.sequence_files.sequence_dir import refuse_existing
from eflow.methods.table import METHODS

FOLDER = Path(__file__).parent / "weights"
"""Where the networks lie; empty or missing: none is shipped."""
WEIGHTS, CARD = "model.safetensors", "card.yaml"
LARGEST = 5_000_000
"""Bytes of weights: everybody who clones the repository gets them."""
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")


class CardText(Config):
    """What a person says of a network."""

    about: str = Field(min_length=1, max_length=200, description="what it is for, in one line")
    data: str = Field(min_length=1, description="what it was trained on")
    training: str = Field(min_length=1, description="how long, on which machine, from which seeds")
    scores: dict[str, float | str] = Field(min_length=1, description="what was measured: its value")
    limits: tuple[str, ...] = Field(min_length=1, description="what it is not good at, and was not tried on")
    commands: tuple[str, ...] = Field(min_length=1, description="what makes it again, in order")


class Card(CardText):
    """That, and what is known of the file."""

    name: str = Field(description="as it is called by")
    network: str = Field(description="model.name")
    size: str = Field(description="model.size")
    parameters: int = Field(ge=1, description="trainable ones")
    stored: Literal["fp32", "fp16"] = Field(description="numbers in the file; it computes in fp32")
    rounding_px: float = Field(ge=0, description="largest change of a flow by storing it so, on random events")
    bytes: int = Field(ge=1, description="of the weights")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="of the weights")
    version: str = Field(description="of the package that packed it")


def names() -> list[str]:
    """The shipped networks, sorted."""
    return sorted(p.name for p in FOLDER.iterdir() if (p / CARD).is_file()) if FOLDER.is_dir() else []


def is_shipped(name: str | os.PathLike) -> bool:
    """Whether a network is called so, and no file or folder: what lies in the working folder goes first."""
    return str(name) in names() and not Path(name).exists()


def known() -> str:
    """The shipped networks as an error message says them; "" without any."""
    return f"; or a network that comes with the package: {', '.join(names())}" if names() else ""


def suggestion(name: str) -> str:
    """The shipped network that was probably meant, as an error message says it; or ""."""
    near = difflib.get_close_matches(name, names(), 1, 0.75)
    return f" (did you mean {near[0]}?)" if near else ""


def weights_of(folder: Path) -> Path:
    """The weights in the folder of a shipped network. Raises AssetError: missing, or not those of the card (a clone
    that was cut off, a file that an editor touched)."""
    card, path = read_card(folder), folder / WEIGHTS
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise AssetError(f"cannot be read: {(error.strerror or str(error)).lower()}", where=str(path)) from error
    if digest != card.sha256:
        raise AssetError(
            "not the weights that the card is of", where=str(path), value=digest, accepted=f"sha256 {card.sha256}"
        )
    return path


def read_card(folder: Path) -> Card:
    """The card in the folder of a shipped network. Raises ConfigError."""
    return validate(Card, read_table(folder / CARD), where=str(folder / CARD))


def card_of(name: str) -> Card:
    """The card of a shipped network. Raises ConfigError: there is none of that name; damaged."""
    if name not in names():
        raise ConfigError(
            f"no such network{suggestion(name)}",
            value=name,
            accepted=", ".join(names()) or "nothing yet: none comes with this version",
        )
    return read_card(FOLDER / name)


def lines(card: Card, whole: bool = True) -> Iterator[str]:
    """A card for people, line by line; not ``whole``: what a list needs of it."""
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
    """Writes the new folder ``out/name`` of a checkpoint's weights and a person's card (a YAML file of
    :class:`CardText`); returns it with its card. The folder appears whole or not at all, after its weights have been
    read back.

    averaged : the averaged weights, where there are any.
    Raises ConfigError: name, card. AssetError: checkpoint; weights that are too large. OutputError."""
    from eflow.checkpoint import load_model, metadata_of, write_tensors
    from eflow.models import NETWORKS, parameters_of

    if not _NAME.fullmatch(name) or name in METHODS or name in NETWORKS:
        raise ConfigError(
            "not a name for a network",
            where="--name",
            value=name,
            accepted="small letters, digits, _ and -; not that of a method or of an architecture",
        )
    text = validate(CardText, read_table(card), where=str(card))
    final = Path(out) / name
    refuse_existing(final)
    model = load_model(checkpoint, averaged=averaged)
    tensors = model.state_dict()
    size = sum(v.numel() * v.element_size() for v in tensors.values())
    if size > LARGEST:
        raise AssetError(
            "too large to come with the package",
            where=str(checkpoint),
            value=f"{size / 1e6:.1f} MB",
            accepted=f"at most {LARGEST / 1e6:g} MB",
        )
    with atomic_folder(final) as folder:
        write_tensors(folder / WEIGHTS, tensors, metadata_of(model))
        (folder / WEIGHTS).chmod(0o644)  # of an installation that others use
        load_model(folder / WEIGHTS, expected=model.config)  # it can be read
        read = (folder / WEIGHTS).read_bytes()
        full = Card(
            **text.model_dump(),
            name=name,
            network=model.config.name,
            size=model.config.size,
            parameters=parameters_of(model),
            stored="fp32",
            rounding_px=0.0,
            bytes=len(read),
            sha256=hashlib.sha256(read).hexdigest(),
            version=__version__,
        )
        with output_errors(folder):
            (folder / CARD).write_text(to_yaml(full.model_dump(mode="json")), encoding="utf-8")
    return final, full
