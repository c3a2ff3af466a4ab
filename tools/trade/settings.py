"""The settings to measure: named points on five axes, each a few lines of YAML.

The full product would have thousands of settings, most of them useless. The design is:

1. displacement x anti-aliasing, in full: the two most important axes, which interact because each hides the other's
   error; and both with sharper mip maps, where presets are looked for.
2. every other way to choose the times (uniform, brightness) at one anti-aliasing, so that each is a curve to compare.
3. anisotropy and texture size one at a time: they change the frame, not its time.
4. half the image size: another data set, with its own reference; it shows the cost per pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

SAMPLINGS = {
    **{f"uniform {fps}/s": (f"timeline={{kind: uniform, fps: {fps}}}",) for fps in (50, 100, 200, 400, 800, 1600)},
    **{
        f"displacement {px:g} px": (f"timeline={{kind: displacement, max_px: {px}, min_step_us: 20}}",)
        for px in (4, 3, 2, 1.5, 1, 0.5, 0.25, 0.125)
    },
    **{
        f"brightness {c:g} C": (f"timeline={{kind: brightness, max_fraction_of_threshold: {c}, min_step_us: 20}}",)
        for c in (4, 2, 1)
    },
}
ANTIALIASINGS = {
    name: (f"render.antialiasing={name}",) for name in ("none", "taps4", "edges", "edges2", "ssaa2", "ssaa4", "ssaa8")
}
OTHERS = {
    "": (),
    "mip bias -0.5": ("render.mip_bias=-0.5",),
    "mip bias -1": ("render.mip_bias=-1",),
    "anisotropy 4": ("render.anisotropy=4",),
    "textures 256 px": ("scene.textures.max_size=256",),
    "textures 128 px": ("scene.textures.max_size=128",),
}
SIZES = {"": 1.0, "half size": 0.5}
"""Factor on the image's sides; every size has its own reference."""


@dataclass(frozen=True)
class Setting:
    """A point on the axes; the attributes are names in the tables above."""

    sampling: str
    antialiasing: str = "none"
    other: str = ""
    size: str = ""

    @property
    def name(self) -> str:
        return ", ".join(part for part in (self.sampling, self.antialiasing, self.other, self.size) if part)

    @property
    def overrides(self) -> tuple[str, ...]:
        """Return the setting as ``--set`` options, without the size."""
        return (
            *SAMPLINGS[self.sampling],
            *ANTIALIASINGS[self.antialiasing],
            *OTHERS[self.other],
        )


def _displacement(*px: float) -> list[str]:
    return [f"displacement {p:g} px" for p in px]


def _uniform(*fps: int) -> list[str]:
    return [f"uniform {f}/s" for f in fps]


_SHARPER = ("mip bias -0.5", "mip bias -1")


def design(quick: bool, random_scene: bool = True) -> tuple[Setting, ...]:
    """Return the settings of a sweep, without repetitions. random_scene : the scene has pools, whose textures can be
    reduced."""
    one = _displacement(1)[0]
    contrasts = [s for s in SAMPLINGS if s.startswith("brightness")]
    others = [o for o in OTHERS if o and o not in _SHARPER and (random_scene or not o.startswith("textures"))]
    if quick:
        points = [Setting(s, a) for s in _displacement(2, 1, 0.5) for a in ("none", "edges")]
        points += [Setting(one, a) for a in ("edges2", "ssaa2")]
        points += [Setting(s, "edges") for s in (*_uniform(100, 400), contrasts[1])]
        points += [Setting(one, a, _SHARPER[1]) for a in ("none", "edges")]
        points += [Setting(one, "none", o) for o in others if o == "textures 256 px"]
    else:
        points = [Setting(s, a) for s in _displacement(2, 1, 0.5, 0.25) for a in ANTIALIASINGS]
        points += [Setting(s, a, o) for s in _displacement(2, 1, 0.5) for a in ANTIALIASINGS for o in _SHARPER]
        points += [Setting(s, "edges") for s in (*_displacement(4), *_uniform(100, 200, 400, 800), *contrasts)]
        points += [Setting(one, a, o) for o in others for a in ("none", "edges")]
        points += [Setting(s, a, size="half size") for s, a in zip(_displacement(2, 1, 1), ("none", "none", "edges"))]
    return tuple(dict.fromkeys(points))


def suite_design() -> tuple[Setting, ...]:
    """Return the settings of the suite for every scene: all candidates for presets, their competitors, and rows for two
    questions. Where do more frames help (displacement with and without filtering)? Do steps by contrast x speed
    (brightness) need fewer?"""
    sharp = _SHARPER[1]
    points = [Setting(s, a) for s in _displacement(2, 1, 0.5, 0.25) for a in ("none", "edges")]
    points += [Setting(s, a, sharp) for s in _displacement(2, 1) for a in ("none", "taps4")]
    points += [Setting(s, "edges", o) for s in _displacement(2, 1) for o in _SHARPER]
    points += [Setting(s, "edges", sharp) for s in _displacement(4, 3, 1.5, 0.5)]
    points += [Setting(s, a, sharp) for s in _displacement(2, 1, 0.5) for a in ("ssaa2", "edges2")]
    points += [Setting(s, "edges2", sharp) for s in _displacement(3, 1.5)]
    points += [Setting(s, "ssaa4", sharp) for s in _displacement(3, 1.5, 1, 0.5)]
    points += [Setting(f"brightness {c} C", "edges", sharp) for c in (4, 2, 1)]
    return tuple(dict.fromkeys(points))


# ---------------------------------------------------------------------------------------------------------------------
# The best settings: those that no other one beats in cost and error at once.


def pareto_front(rows: Sequence[dict], cost: str, error: str) -> list[dict]:
    """Return the non-dominated rows, cheapest first. A row is dominated when another is no worse in both and better in
    one; of equal rows the first stays. Rows whose error is not a number are left out."""
    result: list[dict] = []
    for row in sorted((r for r in rows if math.isfinite(r[error])), key=lambda r: (r[cost], r[error])):
        # Rows come by rising cost: one is on the front where its error is below that of every cheaper one.
        if not result or row[error] < result[-1][error]:
            result.append(row)
    return result


def excess(row: dict, rows: Sequence[dict], cost: str, error: str) -> float:
    """Return by how much the best of ``rows`` beats ``row`` in cost and error, the smaller of the two: 0.1 where one is
    a tenth better in both. At most 0: nothing beats it."""
    ratio = lambda mine, other: mine / other if other else (1.0 if not mine else math.inf)
    others = [r for r in rows if r is not row and math.isfinite(r[error])]
    return max((min(ratio(row[cost], r[cost]), ratio(row[error], r[error])) for r in others), default=1.0) - 1
