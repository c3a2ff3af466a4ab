"""This process among those of a distributed training: what `torchrun` and Ray Train say of it."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

from blinkgl.errors import ConfigError


class Share(NamedTuple):
    """rank, world : number of this process, and how many there are.   local : its number on this machine; None: nobody
    says."""

    rank: int = 0
    world: int = 1
    local: int | None = None


def share_of_process(environment: Mapping[str, str] = os.environ) -> Share:
    """From Ray Train's context, where that has been imported and this is one of its workers, else from ``RANK``,
    ``WORLD_SIZE`` and ``LOCAL_RANK``, else alone. Nothing is imported.

    Raises ConfigError: variables that are no numbers, or do not fit together."""
    return _of_ray() or _of_environment(environment)


def _of_ray() -> Share | None:
    train = sys.modules.get("ray.train")
    try:
        context = cast(Any, train).get_context()
        said = context.get_world_rank(), context.get_world_size(), context.get_local_rank()
    except (AttributeError, RuntimeError):  # not imported; not one of its workers, as some versions say it
        return None
    return None if said[0] is None or said[1] is None else Share(*said)


def _of_environment(environment: Mapping[str, str]) -> Share:
    if "RANK" not in environment or "WORLD_SIZE" not in environment:
        return Share()
    rank, world = (_number(environment, name) for name in ("RANK", "WORLD_SIZE"))
    local = _number(environment, "LOCAL_RANK") if "LOCAL_RANK" in environment else None
    if rank >= world:
        raise ConfigError("not the number of a process", where="RANK", value=rank, accepted=f"0 to {world - 1}")
    return Share(rank, world, local)


def _number(environment: Mapping[str, str], name: str) -> int:
    text = environment[name]
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise ConfigError("not a number of processes", where=name, value=text, accepted="a whole number")
    return int(text)
