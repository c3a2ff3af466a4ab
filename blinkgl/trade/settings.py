"""The settings that are measured: named points on five axes, each a few lines of YAML.

Not the full product: it would be thousands of settings, most of them silly. What is there and why:

1. displacement x anti-aliasing, in full: the two axes that matter most, and they interact,
   because each hides the other's error.
2. reconstruction x displacement at one anti-aliasing: a better curve between frames trades
   against more frames and nothing else ...
3. ... and both, pchip at the coarse steps, with sharper mip maps: where presets are looked for.
4. every other way to choose the times (uniform, brightness, budget) at one anti-aliasing,
   so that each is a curve to compare.
5. anisotropy, level of detail and texture size one at a time: they change what a frame is, not when it is drawn.
6. half the image size: another data set, with a reference of its own; it says what a pixel costs.
"""

from __future__ import annotations

from dataclasses import dataclass

SAMPLINGS = {
    **{f"uniform {fps}/s": (f"timeline={{kind: uniform, fps: {fps}}}",) for fps in (50, 100, 200, 400, 800, 1600)},
    **{
        f"displacement {px:g} px": (f"timeline={{kind: displacement, max_px: {px}, min_step_us: 20}}",)
        for px in (4, 2, 1.5, 1, 0.5, 0.25, 0.125)
    },
    **{
        f"brightness {c:g} C": (f"timeline={{kind: brightness, max_fraction_of_threshold: {c}, min_step_us: 20}}",)
        for c in (4, 2, 1)
    },
    **{
        f"budget {px:g} px": (f"timeline={{kind: budget, max_time_error_px: {px}, min_step_us: 20}}",)
        for px in (0.1, 0.05, 0.025)
    },
}
RECONSTRUCTIONS = {
    "linear": (),
    "pchip": ("timeline.reconstruction=pchip",),
    "hermite": ("timeline.reconstruction=hermite",),
}
ANTIALIASINGS = {
    name: (f"render.antialiasing={name}",) for name in ("none", "taps4", "edges", "edges2", "ssaa2", "ssaa4")
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
    reconstruction: str = "linear"
    antialiasing: str = "none"
    other: str = ""
    size: str = ""

    @property
    def name(self) -> str:
        return ", ".join(
            part for part in (self.sampling, self.reconstruction, self.antialiasing, self.other, self.size) if part
        )

    @property
    def overrides(self) -> tuple[str, ...]:
        """As ``--set`` options; the size is not among them."""
        return (
            *SAMPLINGS[self.sampling],
            *RECONSTRUCTIONS[self.reconstruction],
            *ANTIALIASINGS[self.antialiasing],
            *OTHERS[self.other],
        )


def design(quick: bool, random_scene: bool = True) -> tuple[Setting, ...]:
    """The settings of a sweep, without repetitions. random_scene : the scene has pools,
    whose textures can be made smaller."""
    displacement = lambda *px: [f"displacement {p:g} px" for p in px]
    uniform = lambda *fps: [f"uniform {f}/s" for f in fps]
    curves = [r for r in RECONSTRUCTIONS if r != "linear"]
    extra = [s for s in SAMPLINGS if not s.startswith(("uniform", "displacement"))]
    others = [o for o in OTHERS if o and (random_scene or not o.startswith("textures"))]
    sharper = ("mip bias -0.5", "mip bias -1")
    if quick:
        points = [Setting(s, antialiasing=a) for s in displacement(2, 1, 0.5) for a in ("none", "ssaa2")]
        points += [Setting(s, r, "ssaa2") for s in displacement(2, 1) for r in curves]
        points += [Setting(displacement(1)[0], antialiasing=a) for a in ("taps4", "edges", "edges2", "ssaa4")]
        points += [Setting(s, antialiasing="ssaa2") for s in uniform(100, 400)]
        points += [Setting(s, "pchip", "ssaa2") for s in extra[1::3]]
        points += [Setting(displacement(1)[0], antialiasing=a, other=sharper[0]) for a in ("none", "ssaa2")]
        points += [
            Setting(displacement(1)[0], antialiasing="none", other=o)
            for o in others
            if o not in sharper and not o.endswith(("4", "128 px", "0.25 px"))
        ]
    else:
        points = [
            Setting(s, antialiasing=a)
            for s in displacement(2, 1, 0.5, 0.25)
            for a in ANTIALIASINGS
            if (s, a) != (displacement(0.25)[0], "ssaa4")
        ]
        points += [Setting(s, r, "ssaa2") for s in displacement(4, 2, 1, 0.5) for r in curves]
        points += [Setting(s, r, "ssaa4") for s in displacement(4, 2, 1) for r in curves]
        points += [
            Setting(s, "pchip", a, o)
            for s in displacement(2, 1)
            for a in ("none", "taps4", "ssaa2", "ssaa4")
            for o in ("", *sharper)
        ]
        points += [
            Setting(s, "pchip", a, sharper[1])
            for s in displacement(0.5, 0.25)
            for a in ("ssaa2", "ssaa4")
            if (s, a) != (displacement(0.25)[0], "ssaa2")
        ]
        points += [
            Setting(s, antialiasing=a, other=o)
            for s in displacement(2, 1, 0.5)
            for a in ("none", "taps4", "edges", "edges2", "ssaa2", "ssaa4")
            for o in sharper
        ]
        points += [Setting(s, antialiasing="ssaa2") for s in uniform(100, 200, 400, 800)]
        points += [Setting(s, r, "ssaa2") for s in extra for r in ("linear", "pchip")]
        points += [
            Setting(displacement(1)[0], "pchip", a, o) for o in others if o not in sharper for a in ("none", "ssaa2")
        ]
        points += [
            Setting(s, "pchip", a, size="half size") for s, a in zip(displacement(2, 1, 1), ("none", "none", "ssaa2"))
        ]
    return tuple(dict.fromkeys(points))


def suite_design() -> tuple[Setting, ...]:
    """The settings that every scene of the suite is drawn with: all that a preset may be, what presets have to beat,
    and rows for two questions. Where do more frames help (displacement with and without filtering)? Do steps by
    contrast x speed (brightness) or by the measured error (budget) need fewer?"""
    displacement = lambda *px: [f"displacement {p:g} px" for p in px]
    sharp = "mip bias -1"
    points = [Setting(s, antialiasing=a) for s in displacement(2, 1, 0.5, 0.25) for a in ("none", "edges")]
    points += [Setting(s, antialiasing=a, other=sharp) for s in displacement(2, 1) for a in ("none", "taps4")]
    points += [Setting(s, antialiasing="edges", other=o) for s in displacement(2, 1) for o in ("mip bias -0.5", sharp)]
    points += [Setting(s, antialiasing="edges", other=sharp) for s in displacement(4, 1.5, 0.5)]
    points += [Setting(s, antialiasing="ssaa2", other=sharp) for s in displacement(2, 1, 0.5)]
    points += [Setting(s, "pchip", "edges", sharp) for s in displacement(4, 2, 1, 0.5)]
    points += [Setting(s, antialiasing="edges2", other=sharp) for s in displacement(2, 1, 0.5)]
    points += [Setting(s, "pchip", "edges2", sharp) for s in displacement(2, 1)]
    points += [Setting(s, "pchip", "ssaa4", sharp) for s in displacement(2, 1)]
    points += [Setting(displacement(0.5)[0], antialiasing="ssaa4", other=sharp)]
    points += [Setting(f"brightness {c} C", antialiasing="edges", other=sharp) for c in (4, 2, 1)]
    points += [Setting(f"budget {px} px", antialiasing="edges", other=sharp) for px in (0.1, 0.05)]
    return tuple(dict.fromkeys(points))
