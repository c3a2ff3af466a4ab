"""File formats of labels."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Form:
    """A format ``FOLDER/000000.ENDING``, one file per label.

    encode : converts a value to the bytes of a file, or to (bytes, number of pixels that the format cannot hold).
    read : returns the value in a file; raises AssetError."""

    folder: str
    ending: str
    encode: Callable[[Any], bytes | tuple[bytes, int]] | None = None
    read: Callable[[str | os.PathLike], Any] | None = None

    def file(self, index: int) -> str:
        """Return the name of the ``index``-th label's file below the sequence."""
        return f"{self.folder}/{index:06d}.{self.ending}"

    def files(self, count: int) -> Iterator[str]:
        """Return the names of the files of ``count`` labels."""
        yield from (self.file(k) for k in range(count))

    def holds(self, name: str) -> bool:
        """Return whether ``name`` is one of its files."""
        return (
            name.startswith(self.folder + "/")
            and name.endswith("." + self.ending)
            and "/" not in name[len(self.folder) + 1 :]
        )


def npy(folder: str) -> Form:
    """Return the format of any array of numbers as .npy."""
    return Form(folder, "npy", later("images", "encode_npy"), later("images", "read_npy"))


def mask_png(folder: str) -> Form:
    """Return the format of (H, W) bool as 8-bit PNG, 255 and 0."""
    return Form(folder, "png", later("images", "encode_mask"), later("images", "read_mask"))


def ids_png(folder: str) -> Form:
    """Return the format of (H, W) numbers from 0 to 65535 as 16-bit PNG."""
    return Form(folder, "png", later("images", "encode_ids"), later("images", "read_ids"))


def image_png(folder: str) -> Form:
    """Return the format of (H, W[, C]) linear light or sRGB codes as sRGB PNG; read as codes."""
    return Form(folder, "png", later("images", "encode_image"), later("images", "read_image"))


def later(module: str, name: str) -> Callable[..., Any]:
    """Return a function of a module of :mod:`blinkgl.io` that is imported when first used, because configuration
    imports this module."""

    def call(*values: object) -> Any:
        return getattr(import_module(f"blinkgl.io.{module}"), name)(*values)

    return call
