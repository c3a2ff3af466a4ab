"""Transparent pixels of given pictures: composited over one colour, and said."""

from __future__ import annotations

import re

import numpy as np

from blinkgl.errors import ConfigError

_NAMED = {"black": (0, 0, 0), "grey": (128, 128, 128), "gray": (128, 128, 128), "white": (255, 255, 255)}


def background_of(text: str | None) -> tuple[int, int, int] | None:
    """Return (r, g, b), 0 to 255, of ``black``, ``grey``, ``white`` or ``#rrggbb``. Raises ConfigError."""
    if text is None or text in _NAMED:
        return None if text is None else _NAMED[text]
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
    raise ConfigError("unknown colour", where="--background", value=text, accepted="black, grey, white or #rrggbb")


def over(
    image: np.ndarray, background: tuple[int, int, int] | None, *, associated: bool | None = None
) -> tuple[np.ndarray, str | None]:
    """Return (H, W, 2) or (H, W, 4) without its alpha, (H, W) or (H, W, 3), composited over ``background`` (0 to 255 of
    full scale; None: black), and the line that says so; None where every pixel is opaque.

    Codes are mixed as viewers and browsers do, alpha being straight, and floats (OpenEXR) are premultiplied light,
    unless the file states whether alpha is ``associated``, multiplied already."""
    colour, alpha = image[..., :-1], image[..., -1:]
    top = 1.0 if image.dtype.kind == "f" else float(np.iinfo(image.dtype).max)
    grey = colour.shape[-1] == 1
    if (alpha >= 0.998 * top).all():  # FFmpeg widens 10 bits to 1023 * 64
        return (colour[..., 0] if grey else colour), None
    below = np.asarray(background or (0, 0, 0), np.float64) / 255 * top
    below = below @ [0.2126, 0.7152, 0.0722] if grey else below
    share = alpha / top
    multiplied = image.dtype.kind == "f" if associated is None else associated
    mixed = (colour if multiplied else colour * share) + below * (1 - share)
    mixed = mixed.astype(np.float32) if image.dtype.kind == "f" else np.rint(np.minimum(mixed, top)).astype(image.dtype)
    name = "black" if background is None else "#{:02x}{:02x}{:02x}".format(*background)
    return (mixed[..., 0] if grey else mixed), f"transparent pixels are shown over {name} (--background for another)"
