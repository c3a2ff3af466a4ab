"""The definition of a stream, in plain data, for worker processes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from blinkgl.config.reader import parse_yaml
from blinkgl.config.run import Group, RunTemplate, derived_seed
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.work import Job
from blinkgl.errors import ConfigError

MIX = 8
"""Slots of a block, whose samples are mixed, so that a batch has samples of different sequences."""


@dataclass(frozen=True)
class StreamJob(Job):
    """What a stream renders.

    recipe : YAML text, its seed already the stream's (:func:`stream_seed`).   base : folder that its paths start from.
    kind : kind of sample, a key of :data:`blinkgl.online.cuts.CUTS`.   samples : per slot.
    window_us : shortest and longest window, µs, drawn log-uniformly for each sample; None: the recipe's label interval.
    steps : windows of a sample of kind "streams".   min_events : fewest events in each window.
    max_flow : longest median of the flow in a sample, px.   min_density : fewest events per pixel of a window and px of
    its mean flow.   split : which groups.   seed : of windows and their order.   out : the spool folder.
    rank, world : this process has every ``world``-th block of the stream, from block ``rank`` on."""

    kind: str = "windows"
    samples: int = 8
    window_us: tuple[int, int] | None = None
    steps: int = 8
    min_events: int = 1
    max_flow: float = 400.0
    min_density: float = 0.0
    split: str = "train"
    seed: int = 0
    rank: int = 0
    world: int = 1
    maker: ClassVar[str] = "blinkgl.online.maker:SlotMaker"

    def plan(self) -> Plan:
        """Return the plan. Raises ConfigError: a bad recipe, or one without groups of the split."""
        return _plan(self.recipe, self.base, self.split)

    def block_of_all(self, block: int) -> int:
        """Return the number in the whole stream of a block of this process."""
        return block * self.world + self.rank

    def slot_of_all(self, slot: int) -> int:
        """Return the number in the whole stream of a slot of this process."""
        # Blocks of MIX slots are dealt to the processes in turn: slot k of block b is number k of block b *
        # world + rank.
        block, place = divmod(slot, MIX)
        return self.block_of_all(block) * MIX + place


@lru_cache(maxsize=8)
def _plan(recipe: str, base: str, split: str) -> Plan:
    tree = parse_yaml(recipe, "recipe")
    of_split = [g for g in RunTemplate(tree, Path(base)).groups if g.enabled and _split_of(g) == split]
    if not of_split:
        raise ConfigError(f"the recipe has no sequences of split '{split}'", where="output.split")
    # Groups of other splits stay in the recipe, disabled: numbers and seeds of sequences count them.
    if "groups" in tree:
        names = {group.name for group in of_split}
        for name, group in tree["groups"].items():
            group["enabled"] = name in names
    plan = Plan.of(RunTemplate(tree, Path(base)))
    for group in plan.used:
        if group.template.check().frames is not None:
            raise ConfigError("recorded frames are not rendered", where="frames", accepted="blinkgl generate, and path")
        if "forward" not in (flow := flow_labels(group)):
            raise ConfigError("no flow labels to learn from", where="labels.flow", value=flow)
    return plan


def flow_labels(group: Group) -> list[str]:
    """Return ``labels.flow`` of a group."""
    return list(group.template.check().labels.model_dump()["flow"])


def _split_of(group: Group) -> str:
    return group.template.check().output.split


def stream_seed(recipe_seed: int, seed: int) -> int:
    """Return the recipe's seed in a stream of seed ``seed``: other sequences than those of ``blinkgl generate``, unless
    it gets this ``--seed``."""
    return derived_seed(recipe_seed, f"online/{seed}")
