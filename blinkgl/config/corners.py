"""Which plain configurations stand for all that a template can draw, so that a template is accepted or refused when it
is read.

A sequence draws every distribution of its template. Here every distribution gives an end of its range or one of its
choices (besides both ends a value between them is tried: 2.5 is no number of objects though 2 and 3 are), in as many
trees as are needed for each of them to come several times, dealt so that they meet in all mixtures: what two or three
distributions decide together is refused here. A combination of many that only few draws have may be missed; the
sequence that draws it is refused alone.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from blinkgl.config.base import Path
from blinkgl.config.draw import is_distribution, options

LEAST, MOST = 64, 160
"""Trees of a template."""
_EACH = 4
"""Trees for each option of a distribution."""


@dataclass(frozen=True)
class Fill:
    """Values laid under what a configuration says: ``values(*reads)`` returns a tree of them.

    reads : keys whose values it is given, as they are said; None: not said."""

    reads: tuple[str, ...]
    values: Callable[..., dict[str, Any]]

    def __call__(self, tree: dict[str, Any]) -> dict[str, Any]:
        """``tree`` over the fill's values."""
        return _lay(self.values(*(_said(tree, key.split(".")) for key in self.reads)), tree)


def _said(tree: Any, path: list[str]) -> Any:
    for step in path:
        tree = tree.get(step) if isinstance(tree, dict) else None
    return tree


def _lay(under: Any, over: Any) -> Any:
    """Tables key by key; anything else that is said wins."""
    if not (isinstance(under, dict) and isinstance(over, dict)):
        return over
    return {**under, **{key: _lay(under[key], value) if key in under else value for key, value in over.items()}}


def sites(tree: Any) -> dict[Path, int]:
    """Paths of all distributions, those inside the choices of others included, outermost first, and how many options
    they have. Raises ConfigError for a bad one."""
    found: dict[Path, int] = {}

    def walk(node: Any, path: Path) -> None:
        if is_distribution(node):
            given = options(path, node)
            found[path] = found.get(path, 0) + len(given)
            for option in given:
                walk(option, path)
        else:
            for step, child in _children(node):
                walk(child, (*path, step))

    walk(tree, ())
    return found


def corners(tree: Any) -> Iterator[Any]:
    """Plain trees that stand for all that ``tree`` can draw, as this module says; the first has every first option.
    What does not vary is shared by all of them. Raises ConfigError for a bad distribution."""
    if not (every := sites(tree)):
        yield tree
        return
    yield _chosen(tree, (), lambda path, node: options(path, node)[0])
    dealer = _Dealer()
    for _ in range(min(max(LEAST, _EACH * sum(every.values())), MOST)):
        yield _chosen(tree, (), dealer.deal)


class _Dealer:
    """Gives every distribution its options in rounds, each round in an order of its own."""

    def __init__(self):
        self._random = random.Random(0)
        self._decks: dict[tuple[Path, int], list[Any]] = {}

    def deal(self, path: Path, node: dict[str, Any]) -> Any:
        """Return the next option of the distribution."""
        deck = self._decks.get((path, id(node)))
        if not deck:
            deck = options(path, node, between=deck is None)
            self._random.shuffle(deck)
            self._decks[path, id(node)] = deck
        return deck.pop()


def _chosen(node: Any, path: Path, pick: Callable[[Path, dict[str, Any]], Any]) -> Any:
    """The node with ``pick``'s option of every distribution; the same object where it has none."""
    if is_distribution(node):
        return _chosen(pick(path, node), path, pick)
    children = _children(node)
    values = [_chosen(child, (*path, step), pick) for step, child in children]
    if all(value is child for value, (_, child) in zip(values, children)):
        return node
    return dict(zip(node, values)) if isinstance(node, dict) else values


def _children(node: Any) -> list[tuple[str, Any]]:
    if isinstance(node, dict):
        return [(str(key), value) for key, value in node.items()]
    return [(str(i), value) for i, value in enumerate(node)] if isinstance(node, list) else []
