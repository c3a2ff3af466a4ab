"""Parameters that differ from sequence to sequence.

Anywhere a plain value may stand, the YAML may hold a distribution instead; it is drawn once per sequence and
the drawn value is what the sequence's own ``config.yaml`` records:

    contrast_threshold: {uniform: [0.18, 0.25]}     # float in [a, b)
    log_eps: {log_uniform: [1.0e-4, 1.0e-2]}        # float, uniform in log
    contrast_threshold: {normal: [0.18, 0.03, 0.1, 0.3]}  # float: mean, standard deviation, cut at both ends
    count: {integer: [8, 16]}                       # integer, both ends included
    emulator: {choice: [esim, v2e]}                 # one of the list, equal chances
    emulator: {weighted: {esim: 3, v2e: 1}}         # one of the keys, chances in proportion
    events: {shares: [{share: 0.8, value: {emulator: v2e}}, {share: 0.2, value: {emulator: voltmeter}}]}

``shares`` deals its values out instead of rolling dice: among any n sequences that follow one another, each value comes
up as often as its share says, give or take a few (an additive recurrence from a seeded start). Its shares have to sum
to 1. The step of ``events`` is the golden ratio, or of the first path where that has none; the others' steps are square
roots of primes, so that what one deals is independent of the others.

Each path draws from its own stream (seed, sequence, path), so adding one distribution changes no other draw but those
of ``shares`` of later paths than another ``shares``.
"""

from __future__ import annotations

import hashlib
import math
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from blinkgl.config.base import Path
from blinkgl.errors import ConfigError
from blinkgl.rng import Role
from blinkgl.types.trees import Tree

_KINDS = ("uniform", "log_uniform", "normal", "integer", "choice", "weighted", "shares")
_GOLDEN = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: its multiples modulo 2^64 are spread as evenly as possible
# Multiples of 1 and of roots of different primes are linearly independent, so that the pairs are spread evenly, too
# (Weyl); 2^64 times their fractions.
_STEPS = (_GOLDEN, *(math.isqrt(prime << 128) % 2**64 for prime in (2, 3, 7, 13, 11, 19, 23, 31, 29, 37, 41, 43, 47)))
_INNER = "#"
"""Step of the path of a distribution that another one gives."""


def is_distribution(node: object) -> bool:
    """Return whether plain data is a distribution: a table of one key that names a kind."""
    return isinstance(node, dict) and len(node) == 1 and next(iter(node)) in _KINDS


def draw(tree: object, seed: int, sequence: int) -> Any:
    """Return ``tree`` (plain YAML data) with every distribution replaced by the value drawn for ``sequence``.

    Raises ConfigError (with the path) for a malformed distribution."""
    dealt = sorted({*_shares(tree, ())}, key=lambda path: (path != ("events",), path))
    steps = {path: _STEPS[k % len(_STEPS)] for k, path in enumerate(dealt)}
    return _walk(tree, (), lambda path, kind, spec: _draw_one(path, kind, spec, seed, sequence, steps.get(path, 0)))


def _shares(node: Any, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield the paths at which ``shares`` may be drawn."""
    if is_distribution(node):
        kind, spec = next(iter(node.items()))
        yield from (path,) if kind == "shares" else ()
        for part in spec if kind in ("shares", "choice") and isinstance(spec, list) else ():
            value = part.get("value") if kind == "shares" and isinstance(part, dict) else part
            yield from _shares(value, _within(path, value))
    else:
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in items:
            yield from _shares(value, (*path, str(key)))


def _within(path: tuple[str, ...], value: object) -> tuple[str, ...]:
    """Return the path of what a distribution gives: with numbers of its own where that is a distribution, too."""
    return (*path, _INNER) if is_distribution(value) else path


def options(path: tuple[str, ...], node: Tree, between: bool = False) -> list[Any]:
    """Return values that represent all that the distribution ``node`` can draw: both ends of a range, every choice.
    ``between``: also a value inside the range. Raises ConfigError (with the path) for a malformed one."""
    kind, spec = next(iter(node.items()))
    _check(path, kind, spec)
    if kind == "shares":
        return [part["value"] for part in spec]
    if kind in ("choice", "weighted"):
        return list(spec)
    low, high = (_number(x) for x in (spec[2:] if kind == "normal" else spec))
    if kind == "integer":
        return list(dict.fromkeys((int(low), int(high))))
    # The golden section: between whole ends hardly ever a whole number, so that a key of whole numbers refuses it.
    return list(dict.fromkeys((low, high, low + 0.381966 * (high - low)) if between else (low, high)))


def middle(tree: object) -> Any:
    """Return ``tree`` with every distribution replaced by its middle: half-way between the ends of a range (of their
    logarithms for ``log_uniform``; the lower of two integers), and of choices the value at which half of the chances
    are reached. Raises ConfigError (with the path) for a malformed one."""
    return _walk(tree, (), _middle)


def _middle(path: tuple[str, ...], kind: str, spec: Any) -> object:
    _check(path, kind, spec)
    if kind == "choice":
        # The lower one of two middle values.
        return spec[(len(spec) - 1) // 2]
    if kind in ("weighted", "shares"):
        parts = spec.items() if kind == "weighted" else [(part["value"], part["share"]) for part in spec]
        half, dealt = math.fsum(_number(chance) for _, chance in parts) / 2, 0.0
        for value, chance in parts:
            dealt += _number(chance)
            if dealt >= half and _number(chance) > 0:
                return value
    if kind == "normal":
        return _number(spec[0])
    low, high = (_number(x) for x in spec)
    if kind == "integer":
        return (int(low) + int(high)) // 2
    # Half-way between logarithms is the geometric mean.
    return math.exp(0.5 * (math.log(low) + math.log(high))) if kind == "log_uniform" else low + 0.5 * (high - low)


def _walk(node: Any, path: tuple[str, ...], replace) -> object:
    if is_distribution(node):
        kind, spec = next(iter(node.items()))
        value = replace(path, kind, spec)
        return _walk(value, _within(path, value), replace)  # a choice may hold further distributions
    if isinstance(node, dict):
        return {key: _walk(value, (*path, str(key)), replace) for key, value in node.items()}
    if isinstance(node, list):
        return [_walk(value, (*path, str(i)), replace) for i, value in enumerate(node)]
    return node


def _number(x: object) -> float:
    if isinstance(x, bool) or not isinstance(x, (int, float, str)):
        raise ValueError
    try:
        value = float(x)
    except OverflowError:
        raise ValueError from None
    if not math.isfinite(value):
        raise ValueError
    return value


def _is_weighted(spec: Any) -> bool:
    # Weights need not sum to 1, but something must be left to draw.
    weights = [_number(weight) for weight in spec.values()]
    return min(weights) >= 0 and sum(weights) > 0


def _is_shares(spec: Any) -> bool:
    shares = [_number(part["share"]) for part in spec]
    alike = all(set(part) == {"share", "value"} for part in spec)
    return alike and min(shares) >= 0 and abs(math.fsum(shares) - 1) <= 1e-9


def _is_normal(spec: Any) -> bool:
    mean, deviation, low, high = (_number(x) for x in spec)
    return low <= mean <= high and deviation > 0 and math.isfinite(high - low)


def _is_range(spec: Any) -> bool:
    low, high = (_number(x) for x in spec)
    return low <= high and math.isfinite(high - low)


_RULES: dict[str, tuple[Callable[[Any], bool], str, str]] = {
    "choice": (lambda spec: isinstance(spec, list) and bool(spec), "a list of choices", "a non-empty list"),
    "weighted": (_is_weighted, "a table of weights", "{value: weight, …} with weights >= 0 and a positive sum"),
    "shares": (_is_shares, "a list of shares", "[{share: 0.8, value: …}, …] with shares that sum to 1"),
    "normal": (
        _is_normal,
        "a normal distribution",
        "[mean, standard deviation > 0, lowest, highest], the mean between the last two",
    ),
    "uniform": (_is_range, "a range", "[low, high], two finite numbers, low <= high"),
    "log_uniform": (
        lambda spec: _is_range(spec) and _number(spec[0]) > 0,
        "a logarithmic range",
        "[low, high], 0 < low <= high",
    ),
    "integer": (
        lambda spec: _is_range(spec) and all(_number(x).is_integer() and abs(_number(x)) < 2**63 for x in spec),
        "a range of whole numbers",
        "[low, high], two integers, low <= high",
    ),
}
"""Kind -> whether its parameters are valid, what they are, and what is accepted."""


def _check(path: tuple[str, ...], kind: str, spec: object) -> None:
    right, what, accepted = _RULES[kind]
    try:
        ok = right(spec)
    except (TypeError, ValueError, KeyError, AttributeError, IndexError):
        ok = False
    if not ok:
        where = ".".join((*(step for step in path if step != _INNER), kind))
        raise ConfigError(f"not {what}", where=where, value=spec, accepted=accepted)


def _draw_one(path: tuple[str, ...], kind: str, spec: Any, seed: int, sequence: int, step: int) -> object:
    """step : of ``shares``, 2^64 times the fraction by which it goes on."""
    _check(path, kind, spec)
    key = int.from_bytes(hashlib.sha256("/".join(path).encode()).digest()[:8], "little")
    if kind == "shares":
        # Without the sequence in its key: all sequences continue one series, so that their shares come out.
        start = int(np.random.SeedSequence(seed, spawn_key=(int(Role.PARAMETERS), key)).generate_state(1, np.uint64)[0])
        return _share_at((start + sequence * step) % 2**64 / 2**64, spec)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(sequence), int(Role.PARAMETERS), key)))
    if kind == "choice":
        return spec[int(rng.integers(len(spec)))]
    if kind == "weighted":
        weights = np.array([_number(w) for w in spec.values()])
        return list(spec)[int(rng.choice(len(weights), p=weights / weights.sum()))]
    if kind == "normal":
        mean, deviation, low, high = (_number(x) for x in spec)
        for _ in range(1000):  # values outside the limits are drawn again
            value = float(rng.normal(mean, deviation))
            if low <= value <= high:
                return value
        from scipy.special import ndtr, ndtri

        # Limits so narrow that hardly a value lies in them: the same law, from its distribution function.
        part = rng.uniform(*ndtr([(low - mean) / deviation, (high - mean) / deviation]))
        return min(max(float(mean + deviation * ndtri(part)), low), high)
    low, high = (_number(x) for x in spec)
    if kind == "integer":
        return int(rng.integers(int(low), int(high), endpoint=True))
    if kind == "log_uniform":
        # exp(log(b)) may exceed b
        return min(max(float(math.exp(rng.uniform(math.log(low), math.log(high)))), low), high)
    return float(rng.uniform(low, high))


def _share_at(u: float, spec: list[Mapping[str, object]]) -> object:
    """Return the value whose part of [0, 1) contains u."""
    parts = [part for part in spec if _number(part["share"]) > 0]
    upper = 0.0
    for part in parts:
        upper += _number(part["share"])
        if u < upper:
            return part["value"]
    return parts[-1]["value"]


# ---------------------------------------------------------------------------------------------------------------------
# Plain configurations that represent all that a template can draw, so that a template is accepted or refused when it is
# read.
#
# A sequence draws every distribution of its template. Here every distribution gives an end of its range or one of its
# choices (a value between the ends is tried, too: 2.5 is not a number of objects although 2 and 3 are). There are
# enough trees for each option to occur several times, in all combinations of two or three distributions, so a conflict
# between those is refused here. A rare combination of many may be missed; the sequence that draws it is then refused.

LEAST, MOST = 64, 160
"""Fewest and most trees of a template."""
_EACH = 4
"""Trees per option of a distribution."""


@dataclass(frozen=True)
class Fill:
    """Values laid under a configuration: ``values(*reads)`` returns a tree of them.

    reads : the keys whose values it receives, as they are written; None where a key is not given."""

    reads: tuple[str, ...]
    values: Callable[..., Tree]

    def __call__(self, tree: Mapping[str, object]) -> Tree:
        """Return ``tree`` laid over the fill's values."""
        return _lay(self.values(*(_said(tree, key.split(".")) for key in self.reads)), tree)


def _said(tree: object, path: list[str]) -> Any:
    for step in path:
        tree = tree.get(step) if isinstance(tree, dict) else None
    return tree


def _lay(under: object, over: object) -> Any:
    """Lay ``over`` on ``under``: tables key by key; any other value of ``over`` replaces the one below."""
    if not (isinstance(under, dict) and isinstance(over, dict)):
        return over
    return {**under, **{key: _lay(under[key], value) if key in under else value for key, value in over.items()}}


def sites(tree: object) -> dict[Path, int]:
    """Return the paths of all distributions and their numbers of options, outermost first, including those inside the
    choices of others. Raises ConfigError for a bad one."""
    counts: dict[Path, int] = {}

    def walk(node: Any, path: Path) -> None:
        if is_distribution(node):
            drawn = options(path, node)
            counts[path] = counts.get(path, 0) + len(drawn)
            for option in drawn:
                walk(option, path)
        else:
            for step, child in _children(node):
                walk(child, (*path, step))

    walk(tree, ())
    return counts


def corners(tree: object) -> Iterator[Any]:
    """Yield plain trees that represent all that ``tree`` can draw (see the comment above); the first has every first
    option. They share the parts that do not vary. Raises ConfigError for a bad distribution."""
    if not (every := sites(tree)):
        yield tree
        return
    varying = {path[:depth] for path in every for depth in range(len(path) + 1)}

    def chosen(node: Any, path: Path, pick: Callable[[Path, Tree], Any]) -> Any:
        if path not in varying:
            return node
        if is_distribution(node):
            return chosen(pick(path, node), path, pick)
        values = [chosen(child, (*path, step), pick) for step, child in _children(node)]
        if isinstance(node, dict):
            return dict(zip(node, values))
        return values if isinstance(node, list) else node

    yield chosen(tree, (), lambda path, node: options(path, node)[0])
    dealer = _Dealer()
    for _ in range(min(max(LEAST, _EACH * sum(every.values())), MOST)):
        yield chosen(tree, (), dealer.deal)


class _Dealer:
    """Gives every distribution its options in rounds; each round has its own order."""

    def __init__(self):
        self._random = random.Random(0)
        self._decks: dict[tuple[Path, int], list[Any]] = {}

    def deal(self, path: Path, node: dict[str, object]) -> object:
        """Return the next option of the distribution."""
        deck = self._decks.get((path, id(node)))
        if not deck:
            deck = options(path, node, between=deck is None)
            self._random.shuffle(deck)
            self._decks[path, id(node)] = deck
        return deck.pop()


def _children(node: object) -> list[tuple[str, object]]:
    if isinstance(node, dict):
        return [(str(key), value) for key, value in node.items()]
    return [(str(i), value) for i, value in enumerate(node)] if isinstance(node, list) else []
