"""The values of ``render.antialiasing`` as numbers of samples."""

from __future__ import annotations

from typing import NamedTuple

from blinkgl.errors import GLError


class Samples(NamedTuple):
    """How one pixel is sampled.

    grid  : the image is drawn grid x grid times finer and averaged (super-sampling).
    taps  : 1, or 4: texture lookups of a drawn pixel, spread over the pixel, each one mip level finer. This
            super-samples the texture but not the light and the silhouettes. Only for event frames: colour is not worth
            a shader variant.
    edges : whether pixels at silhouettes and creases get the mean by area of their surfaces
            (:class:`~blinkgl.render.passes.edged.Edged`), on the finer grid before it is averaged. The four taps, if
            any, then lie along the direction in which a surface is foreshortened."""

    grid: int = 1
    taps: int = 1
    edges: bool = False

    @property
    def stored(self) -> int:
        """Return the samples in memory per pixel of the image."""
        return self.grid**2

    @property
    def shared(self) -> bool:
        """Return whether a pixel at a silhouette shows both surfaces by area, and not only that of its centre."""
        return self.stored > 1 or self.edges


ANTIALIASING = {
    "none": Samples(),
    "taps4": Samples(taps=4),
    "edges": Samples(taps=4, edges=True),
    "edges2": Samples(grid=2, taps=4, edges=True),
    "ssaa2": Samples(grid=2),
    "ssaa4": Samples(grid=4),
    "ssaa8": Samples(grid=8),
}


def samples_of(name: str, where: str = "render.antialiasing") -> Samples:
    """Return the samples of an anti-aliasing mode. Raises GLError for a name that is not in :data:`ANTIALIASING`."""
    if name not in ANTIALIASING:
        raise GLError("unknown anti-aliasing", where=where, value=name, accepted="one of " + ", ".join(ANTIALIASING))
    return ANTIALIASING[name]
