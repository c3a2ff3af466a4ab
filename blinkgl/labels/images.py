"""What the scene looks like."""

from __future__ import annotations

from blinkgl.labels import files
from blinkgl.labels.files import Form
from blinkgl.labels.label import Label, View


class Images(Label):
    """(H, W, 3) float32 linear radiance, anti-aliased as ``render.image_antialiasing`` says."""

    name, title, unit, kind = "images", "images", "linear radiance", "light"
    anti_aliased, at_last = True, True
    channels, dtype = None, None
    stamps, shard = "images/timestamps.txt", "image.png"

    @property
    def forms(self) -> tuple[Form, ...]:
        return (files.image_png("images"),)

    @property
    def views(self) -> tuple[View, ...]:
        return ()  # the debugger follows the colour pass step by step, beginning with what it looks up
