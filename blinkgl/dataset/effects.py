"""What light and materials can do beside a white sun on matt surfaces, effect by effect: whether a scene asks for it,
what it costs, and what it changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from blinkgl.scene.lights import is_coloured, lamps_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from blinkgl.scene.types import Light, Material, Mesh, Scene


class Effect(NamedTuple):
    """asked : whether the scene asks for it.   key : by what it does.   times : an event frame's cost beside one of
    the plain scene's.   missed, extra, pictures, labels : %, of events, of luminance and of pixels' labels; measured
    once, in flying_objects."""

    name: str
    key: str
    asked: bool
    times: float
    missed: float
    extra: float
    pictures: float
    labels: float

    def cost(self, frame_s: float) -> float:
        """s of an event frame that this takes or would take, beside the others. frame_s : one as it is."""
        return frame_s * (1 - 1 / self.times if self.asked else self.times - 1)


def _of_surfaces(asks: Callable[[Material, Mesh], bool]) -> Callable[[Scene], bool]:
    return lambda scene: any(
        not part.material.unlit and asks(part.material, part.mesh) for thing in scene.objects for part in thing.parts
    )


def _further(scene: Scene) -> bool:
    """Whether there is more than one sun, which a panorama may have instead of the scene's."""
    kinds = [lamp.kind for lamp in lamps_of(scene.light)]
    return len(kinds) > 1 or any(kind != "sun" for kind in kinds)


_OF_A_PANORAMA = "light of a panorama"
PANORAMA = {(False, False): 1.04, (False, True): 1.10, (True, False): 1.10, (True, True): 1.21}
"""Times of a panorama's light: coloured, beside what coloured light costs by itself; by order 4, too."""


def _panorama(light: Light) -> float:
    """Of the panorama that there is; else of one as they mostly are, coloured and without order 4."""
    if light.around is None:
        return PANORAMA[True, False]
    return PANORAMA[is_coloured(light), light.finer is not None]


# Measured at 348eebef by its tools/bench_light.py (--changes, --materials), 2026-11-22.
_MEASURED: tuple[tuple[str, str, Callable[[Scene], bool], tuple[float, float, float, float, float]], ...] = (
    ("coloured light", "scene.light.*_color", lambda s: is_coloured(s.light), (1.23, 6.0, 6.6, 12.3, 0.0)),
    ("further lights", "scene.light.lights, scene.lights", _further, (1.21, 3.3, 3.1, 3.8, 0.0)),
    (_OF_A_PANORAMA, "sky.lights, light.environment", lambda s: s.light.around is not None,
     (PANORAMA[False, False], 16.3, 8.3, 4.9, 0.0)),
    ("hard shadows", "scene.light.shadows: hard", lambda s: s.light.shadows == "hard", (1.50, 2.2, 4.2, 3.1, 0.0)),
    ("soft shadows", "scene.light.shadows: soft", lambda s: s.light.shadows == "soft", (2.01, 2.2, 4.0, 3.1, 0.0)),
    ("metal and roughness", "materials", _of_surfaces(lambda m, _: m.gloss is not None),
     (2.10, 29.7, 16.7, 6.3, 0.0)),
    ("normal maps", "materials", _of_surfaces(lambda m, _: m.bumps is not None), (1.63, 39.3, 608.7, 55.0, 0.0)),
    ("light of their own", "materials", _of_surfaces(lambda m, _: any(m.emission)), (1.07, 48.2, 10.5, 28.8, 0.0)),
    ("holes", "materials", _of_surfaces(lambda m, _: m.mask is not None), (1.79, 19.8, 340.4, 14.5, 17.8)),
)  # fmt: skip


def effects_of(scene: Scene) -> list[Effect]:
    """All that there are, in a fixed order."""
    found = [Effect(name, key, asks(scene), *numbers) for name, key, asks, numbers in _MEASURED]
    return [one._replace(times=_panorama(scene.light)) if one.name == _OF_A_PANORAMA else one for one in found]
