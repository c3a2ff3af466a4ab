"""Which plain configurations stand for all that a template can draw, so that a template is
accepted or refused when it is read.

A sequence draws every distribution of its template. That no draw is refused for its range follows from checking, for
everything that looks at values, all combinations of the *ends* of the distributions that it looks at together:

- a field looks at its own value (for a list, at all its entries); besides both ends a value between them is tried,
  since 2.5 is no number of objects though 2 and 3 are;
- a rule looks at the keys it names (:func:`blinkgl.config.base.rule`; it is given nothing else);
- what a key means hangs on the ``kind`` of its table, on a ``preset`` beside it, and on what fills it in when it is not
  said (:class:`Fill`: ``quality``, ``sensor``); and on every choice that it stands in.

Everything else stays at its first option. So forty distributions of forty independent keys cost a hundred
configurations, not 2^40. That the ends are enough holds for conditions that are monotone or
convex in each value alone, as all of ours are.
"""

from __future__ import annotations

import itertools
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from blinkgl.config.base import Config, Path, Rule, below, is_model, members
from blinkgl.config.draw import is_distribution, options
from blinkgl.errors import ConfigError

MOST = 4096


@dataclass(frozen=True)
class Fill:
    """Values laid under what a configuration says: ``values(*reads)`` returns a tree of them.

    reads, writes : dotted keys from the top. ``values`` is given what the tree says at ``reads`` (None: nothing) and
    nothing else, and may return keys at or below ``writes`` only. parts : (key written, keys inside what is read that
    it comes from, "*" for any), so that of a table that is read a key hangs on its own part alone."""

    reads: tuple[str, ...]
    writes: tuple[str, ...]
    values: Callable[..., dict[str, Any]]
    parts: tuple[tuple[str, str], ...] = ()

    def __call__(self, tree: dict[str, Any]) -> dict[str, Any]:
        """``tree`` over the fill's values. Raises TypeError where those are not the declared ones."""
        given = self.values(*(_said(tree, key.split(".")) for key in self.reads))
        for path in _leaves(given, ()):
            if not any(
                _related(path, tuple(key.split(".")), True) and len(path) >= len(key.split(".")) for key in self.writes
            ):
                raise TypeError(f"a fill of {self.writes} wrote {'.'.join(path)}")
        return _lay(given, tree)


def _said(tree: Any, path: list[str]) -> Any:
    for step in path:
        tree = tree.get(step) if isinstance(tree, dict) else None
    return tree


def _leaves(node: Any, path: Path) -> Iterator[Path]:
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from _leaves(value, (*path, key))
    elif path:
        yield path


def _lay(under: Any, over: Any) -> Any:
    """Tables key by key; anything else that is said wins."""
    if not (isinstance(under, dict) and isinstance(over, dict)):
        return over
    return {**under, **{key: _lay(under[key], value) if key in under else value for key, value in over.items()}}


def sites(tree: Any) -> list[Path]:
    """Paths of all distributions, those inside the choices of others included, outermost first. Raises ConfigError for
    a malformed one."""
    found: dict[Path, None] = {}

    def walk(node: Any, path: Path) -> None:
        if is_distribution(node):
            found[path] = None
            for option in options(path, node):
                walk(option, path)
        else:
            for step, child in _children(node):
                walk(child, (*path, step))

    walk(tree, ())
    return list(found)


def corners(model: type[Config], tree: Any, fills: tuple[Fill, ...] = ()) -> Iterator[Any]:
    """Plain trees that stand for all that ``tree`` can draw, as this module says; the first has every first option.

    Raises ConfigError: a malformed distribution, or more than ``MOST`` combinations that have
    to be looked at together."""
    every = sites(tree)
    if not every:
        yield tree
        return
    made: Made = {}
    for site in every:
        group = _together([(site, is_leaf(model, site))], model, every, fills)
        yield from combinations(tree, group, between=site, made=made)
    done: list[frozenset[Path]] = []
    for group in sorted(
        {_together(keys, model, every, fills) for keys in _looked_at(model, [*every, *_written(every, fills)])},
        key=len,
        reverse=True,
    ):
        if not any(group <= other for other in done):
            done.append(group)
            yield from combinations(tree, group, made=made)


def corners_of(keys: tuple[str, ...], model: type[Config], tree: Any, fills: tuple[Fill, ...] = ()) -> Iterator[Any]:
    """Plain trees with every combination of the ends of the distributions at or below
    ``keys``, and of what those hang on."""
    every = sites(tree)
    yield from combinations(tree, _together([(tuple(key.split(".")), True) for key in keys], model, every, fills))


Made = dict[int, tuple[Any, Any]]
"""Identity of a node -> the node, which keeps it taken, and what it is with every first option."""


def combinations(
    tree: Any, group: frozenset[Path], between: Path | None = None, made: Made | None = None
) -> Iterator[Any]:
    """``tree`` with every combination of options of the distributions at the paths in ``group``, the first option of
    all others. ``between``: the one of which a value inside the range is an option, too. made : to be shared by all
    calls for one tree."""
    expansion = _Expansion(group, between, {} if made is None else made)
    number = expansion.count(tree, ())
    if number > MOST:
        raise ConfigError(
            "too many distributions are looked at together",
            where=", ".join(sorted(".".join(p) for p in group))[:200],
            value=f"{number} combinations",
            accepted=f"at most {MOST}; draw fewer of them",
        )
    yield from expansion.of(tree, ())


class _Expansion:
    """What does not vary is made once, and the trees share it: thousands of them cost little, and what is the same
    object was looked at before (:func:`blinkgl.config.base.remembering`)."""

    def __init__(self, group: frozenset[Path], between: Path | None, made: Made):
        self.group, self.between, self.made = group, between, made
        self.towards = {site[:depth] for site in group for depth in range(len(site) + 1)}

    def count(self, node: Any, path: Path) -> int:
        """How many trees there will be."""
        if path not in self.towards:
            return 1
        if is_distribution(node):
            given = options(path, node)
            return sum(self.count(option, path) for option in (given if path in self.group else given[:1]))
        number = 1
        for step, child in _children(node):
            number *= self.count(child, (*path, step))
        return number

    def of(self, node: Any, path: Path) -> Iterator[Any]:
        if path not in self.towards:
            yield self.first(node, path)
            return
        if is_distribution(node):
            given = options(path, node, between=path == self.between)
            for option in given if path in self.group else given[:1]:
                yield from self.of(option, path)
            return
        if not isinstance(node, (dict, list)):  # one choice of several, of which another holds a distribution
            yield node
            return
        places = [tuple(self.of(child, (*path, step))) for step, child in _children(node)]
        for values in itertools.product(*places):
            yield dict(zip(node, values, strict=True)) if isinstance(node, dict) else list(values)

    def first(self, node: Any, path: Path) -> Any:
        """The node with every first option."""
        if not isinstance(node, (dict, list)):
            return node
        if id(node) not in self.made:
            if isinstance(node, dict) and is_distribution(node):
                value = self.first(options(path, node)[0], path)
            else:
                values = [self.first(child, (*path, step)) for step, child in _children(node)]
                value = dict(zip(node, values, strict=True)) if isinstance(node, dict) else values
            self.made[id(node)] = node, value
        return self.made[id(node)][1]


def _children(node: Any) -> list[tuple[str, Any]]:
    if isinstance(node, dict):
        return [(str(key), value) for key, value in node.items()]
    return [(str(i), value) for i, value in enumerate(node)] if isinstance(node, list) else []


# --- what is looked at together ---------------------------------------------------------------------------------------


def _related(site: Path, key: Path, deep: bool) -> bool:
    """Whether the distribution at ``site`` decides the value at ``key``: it holds it, or, ``deep``, is a part of it."""
    if not deep and len(site) > len(key):
        return False
    for s, k in zip(site, key):  # noqa: SIM110 - as all(...) it takes three times as long, millions of times
        if s != k and k != "*":
            return False
    return True


def _together(
    keys: list[tuple[Path, bool]], model: type[Config], every: list[Path], fills: tuple[Fill, ...]
) -> frozenset[Path]:
    """The distributions that decide the values of ``keys`` (path, whether with all below
    it), directly or by what those hang on."""
    wanted = dict.fromkeys(keys)
    queue = list(wanted)
    while queue:
        key, deep = queue.pop()
        more = [(hung, False) for hung in _hangs_on(model, key)]
        for fill in fills:
            writes = [tuple(w.split(".")) for w in fill.writes]
            if any(_related(key, w, True) and (deep or len(key) >= len(w)) for w in writes):
                more += [(tuple(r.split(".")), False) for r in fill.reads]
            for written, source in fill.parts:
                top = tuple(written.split("."))
                if key[: len(top)] == top:
                    more.append(((*source.split("."), *key[len(top) :]), deep))
        for one in more:
            if one not in wanted:
                wanted[one] = None
                queue.append(one)
    return frozenset(site for site in every if any(_related(site, key, deep) for key, deep in wanted))


def _hangs_on(model: type[Config], key: Path) -> Iterator[Path]:
    """Tags of the unions and presets of the models that the key stands in."""
    here: list[Any] = [model]
    for depth, step in enumerate((*key, None)):
        models = [a for a in here if is_model(a)]
        tags = (
            {name for name in ("kind", "emulator") for m in models if name in m.model_fields}
            if len(models) > 1
            else set()
        )
        for name in sorted(tags | ({"preset"} if any(m.presets for m in models) else set())):
            yield (*key[:depth], name)
        if step is not None:
            here = [x for a in here for x in below(a, step)]


def is_leaf(model: type[Config], path: Path) -> bool:
    """Whether ``path`` stands at or inside a field that holds no tables: then all of the field is one value."""
    here: list[Any] = [model]
    for step in path:
        here = [x for a in here for x in below(a, step)]
        if not any(_has_models(a) for a in here):
            return True
    return False


def _has_models(annotation: Any) -> bool:
    if is_model(annotation):
        return True
    return any(_has_models(x) for a in typing.get_args(annotation) if a is not type(None) for x in members(a))


def placed_rules(model: type[Config]) -> tuple[tuple[Path, Rule], ...]:
    """Every rule of ``model`` and of the models below it, with the path of the model that it
    belongs to ("*": any entry)."""
    found: list[tuple[Path, Rule]] = []

    def walk(annotation: Any, path: Path) -> None:
        if is_model(annotation):
            found.extend((path, one) for one in annotation.rules)
            for name, info in annotation.model_fields.items():
                for member in members(info.annotation):
                    walk(member, (*path, name))
            return
        for argument in typing.get_args(annotation):
            if argument not in (Ellipsis, type(None)) and not isinstance(argument, (str, int)):
                for member in members(argument):
                    if _has_models(member):
                        walk(member, (*path, "*"))

    walk(model, ())
    return tuple(dict.fromkeys(found))


def _written(every: list[Path], fills: tuple[Fill, ...]) -> Iterator[Path]:
    """Where fills put what is drawn inside the tables that they read."""
    for fill in fills:
        for written, source in fill.parts:
            top = tuple(source.split("."))
            for site in every:
                if len(site) > len(top) and _related(site[: len(top)], top, False):
                    yield (*written.split("."), *site[len(top) :])


def _looked_at(model: type[Config], every: list[Path]) -> Iterator[list[tuple[Path, bool]]]:
    """The keys of every rule that a distribution has to do with, its place bound to the entries where those are."""
    for place, one in placed_rules(model):
        for prefix in sorted({bound for site in every for bound in _bound(place, site)}):
            keys = [((*prefix, *path), deep) for path, deep in one.paths()]
            if any(_related(site, key, deep) for site in every for key, deep in keys):
                yield keys


def _bound(place: Path, site: Path) -> Iterator[Path]:
    """``place`` with its "*" replaced by where ``site`` is, if it is there; as it is where the site holds the place.
    Nothing for a site elsewhere: it would bind all entries of a list together."""
    if _related(site[: len(place)], place, False):
        yield site[: len(place)] if len(site) >= len(place) else place
