"""Every program in every variant that the renderer compiles for some configuration and scene.

The table mirrors :class:`blinkgl.render.renderer.Renderer`; a test records what the renderer asks for and compares."""

from __future__ import annotations

from itertools import combinations, product

LABEL_OUTPUTS = ("DEPTH", "ID", "NORMAL", "VELOCITY", "FLOW_FORWARD", "FLOW_BACKWARD")
MATERIALS = ("TEXTURED", "LIT", "TWO_SIDED")
FACTORS = (2, 4)
EVERY = 4  # stands for every number of the brightness timeline's `sample_every` above 1


def materials() -> list[dict[str, int]]:
    """Defines of every kind of material."""
    return [{name: 1 for name, on in zip(MATERIALS, switches) if on} for switches in product((False, True), repeat=len(MATERIALS))]


def label_outputs() -> list[dict[str, int]]:
    """Defines of every combination of label buffers; colour is drawn alone because it is super-sampled."""
    out = [{"OUT_COLOUR": 0}]
    for count in range(1, len(LABEL_OUTPUTS) + 1):
        out += [{f"OUT_{name}": i for i, name in enumerate(names)} for names in combinations(LABEL_OUTPUTS, count)]
    return out


def debug_outputs() -> dict[str, int]:
    """Defines of the debugger's own pass."""
    from blinkgl.tools.shader_debugger.session import DebugRenderer

    return {f"OUT_{name}": i for i, (name, _) in enumerate(DebugRenderer.OUTPUTS)}


def lookups(program: str) -> list[dict[str, int]]:
    """Defines of the variants in which the debugger has a production program show what it looks up."""
    show = {"luminance.glsl": {"SHOW_LOOKUP": 1}, "label.glsl": {"OUT_COLOUR": 0, "SHOW_LOOKUP": 1}}.get(program)
    return [] if show is None else [show | material for material in materials()]


def variants(program: str) -> list[dict[str, int]] | None:
    """Defines of every variant of a program file, without :func:`lookups`; None for a file the renderer does not know."""
    if program == "luminance.glsl":
        taps = [material | {"TAPS4": 1} for material in materials() if "TEXTURED" in material]
        every = [material | {"RATE": 1, "EVERY": EVERY} for material in materials()]
        return [material | rate for rate in ({}, {"RATE": 1}) for material in materials() + taps] + every
    if program == "label.glsl":
        return [outputs | material for outputs in label_outputs() for material in materials()]
    if program == "downsample.glsl":
        return [{"FACTOR": factor} for factor in FACTORS]
    if program == "debug.glsl":
        return [debug_outputs() | material for material in materials()]
    return None
