"""The values of ``render.antialiasing`` as numbers of samples."""

from __future__ import annotations

from typing import NamedTuple

from blinkgl.errors import GLError


class Samples(NamedTuple):
    """How one pixel is sampled.

    grid  : the image is drawn grid x grid times finer and averaged (super-sampling:
    everything is evaluated grid² times).
    taps  : 1, or 4: texture lookups of a drawn pixel, spread over the pixel, each one mip level finer. The texture is
            super-sampled, the light and the silhouettes are not. Event frames only: colour
            is not worth a shader variant.
    edges : whether silhouettes and creases, and no other pixels, are given the means over the areas of their surfaces
            (:class:`~blinkgl.render.passes.edged.Edged`), of a finer grid before it is averaged. The taps, where there
            are four, then lie along the way in which a surface is foreshortened."""

    grid: int = 1
    taps: int = 1
    edges: bool = False

    @property
    def stored(self) -> int:
        """Samples kept in memory per pixel of the image."""
        return self.grid**2

    @property
    def shared(self) -> bool:
        """Whether a pixel at a silhouette shows both surfaces by their shares, and not only that of its centre."""
        return self.stored > 1 or self.edges


ANTIALIASING = {
    "none": Samples(),
    "taps4": Samples(taps=4),
    "edges": Samples(taps=4, edges=True),
    "edges2": Samples(grid=2, taps=4, edges=True),
    "ssaa2": Samples(grid=2),
    "ssaa4": Samples(grid=4),
}


def samples_of(name: str, where: str = "render.antialiasing") -> Samples:
    """GLError for a name that is none of :data:`ANTIALIASING`'s."""
    if name not in ANTIALIASING:
        raise GLError("unknown anti-aliasing", where=where, value=name, accepted="one of " + ", ".join(ANTIALIASING))
    return ANTIALIASING[name]
