"""The only module that parses and writes YAML. Plain data are tables with text keys, lists, text, numbers, true/false
and null.

The file may come from an untrusted user, so its cost is limited before it is built: its size, its depth, the length of
its numbers, and the number of values *after* aliases and merge keys are expanded (a few hundred bytes of nested aliases
can make billions of values). Only plain tags are accepted. A key that is given twice in one table is an error; a table
may override the keys of its merge key (``<<: *base``). Dates are read as text. ``1e-4`` is text in YAML 1.1; the models
convert it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import Composer, ComposerError
from yaml.constructor import ConstructorError, SafeConstructor
from yaml.nodes import MappingNode, Node, ScalarNode
from yaml.resolver import Resolver

from blinkgl.config.draw import is_distribution
from blinkgl.config.names import shipped_names
from blinkgl.errors import ConfigError
from blinkgl.types.trees import Tree

MAX_BYTES = 4 << 20
MAX_VALUES = 100_000
MAX_DEPTH = 50
_TOO_DEEP = f"more than {MAX_DEPTH} tables and lists inside one another"
MAX_DIGITS = 100

# libyaml's parser emits events without recursion; the composer, which counts values, is Python code in both cases.
_Events: Any = getattr(yaml, "cyaml", None) and yaml.cyaml.CParser
if not _Events:

    class _Events(yaml.reader.Reader, yaml.scanner.Scanner, yaml.parser.Parser):  # type: ignore[no-redef]
        def __init__(self, stream: str):
            yaml.reader.Reader.__init__(self, stream)
            yaml.scanner.Scanner.__init__(self)
            yaml.parser.Parser.__init__(self)


class _Loader(Composer, _Events, SafeConstructor, Resolver):
    """A composer that counts the values that the document expands to and refuses anything but plain data."""

    yaml_constructors: dict = {}  # noqa: RUF012 - as PyYAML declares it
    yaml_implicit_resolvers: dict = {  # noqa: RUF012
        first: [(tag, regexp) for tag, regexp in known if not tag.endswith(":timestamp")]
        for first, known in Resolver.yaml_implicit_resolvers.items()
    }

    def __init__(self, text: str):
        _Events.__init__(self, text)
        Composer.__init__(self)
        SafeConstructor.__init__(self)
        Resolver.__init__(self)
        self._values, self._depth = 0, 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Compose a node as Composer does; an alias counts as all values that it refers to."""
        before = self._values
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            # An alias counts as much as what it stands for: a few lines of aliases could be a billion values.
            known = self.anchors.get(event.anchor)
            if known is not None:
                if id(known) not in self._sizes:
                    raise ComposerError(
                        None, None, f"alias '{event.anchor}' is inside what it stands for", event.start_mark
                    )
                self._count(self._sizes[id(known)], event)
            return super().compose_node(parent, index)
        event = self.peek_event()
        self._count(1, event)
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise ComposerError(None, None, _TOO_DEEP, event.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        # With everything inside it, so that an alias of aliases counts in full.
        self._sizes[id(node)] = self._values - before
        return node

    def _count(self, more: int, event: Any) -> None:
        self._values += more
        if self._values > MAX_VALUES:
            raise ComposerError(None, None, f"more than {MAX_VALUES} values, aliases expanded", event.start_mark)

    def plain_map(self, node: MappingNode) -> Tree:
        """Return the table of a mapping. Its keys are constructed before merge keys are flattened, so that only
        duplicates among the table's own keys are errors."""
        if not isinstance(node, MappingNode):
            raise ConstructorError(None, None, "not a table", node.start_mark)
        # Flattening lets a table's own keys replace merged ones, and would hide keys given twice.
        self._refuse_twice(node)
        self.flatten_mapping(node)
        return {self._key(key): self.construct_object(value, deep=True) for key, value in node.value}

    def _refuse_twice(self, node: MappingNode) -> None:
        seen: set = set()
        for key_node, _ in node.value:
            key = "<<" if key_node.tag.endswith(":merge") else self._key(key_node)
            if key in seen:
                raise ConstructorError(None, None, f"key '{key}' is given twice", key_node.start_mark)
            seen.add(key)

    def flatten_mapping(self, node: MappingNode) -> None:
        """Flatten merge keys as SafeConstructor does, but only once per table: aliases visit a table again."""
        if any(key.tag.endswith(":merge") for key, _ in node.value):
            super().flatten_mapping(node)

    def _key(self, node: Node) -> Any:
        key = self.construct_object(node, deep=True) if isinstance(node, ScalarNode) else None
        if not isinstance(key, (str, int, float)):
            raise ConstructorError(None, None, "a key is not plain text", node.start_mark)
        return key

    def plain_scalar(self, node: ScalarNode) -> object:
        """Return text, a number, true/false or null, by the node's tag. Very long numbers are refused: nobody needs a
        hundred digits, and Python refuses to print five thousand."""
        kind = node.tag.rpartition(":")[2]
        if kind in ("int", "float") and len(node.value) > MAX_DIGITS:
            raise ConstructorError(None, None, f"a number of {len(node.value)} digits", node.start_mark)
        try:
            return getattr(self, f"construct_yaml_{kind}")(node)
        except (ValueError, LookupError):  # only for an explicit tag such as !!int abc
            raise ConstructorError(None, None, f"not a YAML {kind}", node.start_mark) from None

    def plain_seq(self, node: Node) -> list:
        if not isinstance(node, yaml.SequenceNode):
            raise ConstructorError(None, None, "not a list", node.start_mark)
        return [self.construct_object(value, deep=True) for value in node.value]


for _tag in ("null", "bool", "int", "float", "str"):
    _Loader.yaml_constructors[f"tag:yaml.org,2002:{_tag}"] = _Loader.plain_scalar
_Loader.yaml_constructors["tag:yaml.org,2002:map"] = _Loader.plain_map
_Loader.yaml_constructors["tag:yaml.org,2002:seq"] = _Loader.plain_seq
_Loader.yaml_constructors[None] = SafeConstructor.construct_undefined


def parse_yaml(text: str, where: str) -> Any:
    """Return plain data from YAML text (None for an empty text). Raises ConfigError with line and column for invalid or
    too large YAML.

    where : file or option, for the message."""
    if len(text) > MAX_BYTES:
        raise ConfigError("too large for a configuration", where=where, accepted=f"at most {MAX_BYTES} bytes")
    loader = None
    try:
        loader = _Loader(text)
        return loader.get_single_data()
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{where}:{mark.line + 1}:{mark.column + 1}" if mark else where
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        if "nesting depth" in problem:  # PyYAML has a limit of its own from 6.0.4 on, which may be met first
            problem = _TOO_DEEP
        raise ConfigError(f"not valid YAML: {problem}", where=place) from None
    finally:
        if loader is not None:
            loader.dispose()


def read_yaml(path: str | Path) -> Any:
    """Return the plain data of a YAML file. Raises ConfigError as :func:`read_text`, and for what is not YAML."""
    return parse_yaml(read_text(path), str(path))


def read_text(path: str | Path) -> str:
    """Return the text of a YAML file, without a byte order mark. Raises ConfigError for a file that is missing,
    unreadable, not regular, too large or not UTF-8."""
    path = Path(path)
    where = str(path)
    try:
        if path.exists() and not path.is_file():
            problem = "is a folder" if path.is_dir() else "cannot be read: not a regular file"
            raise ConfigError(problem, where=where, accepted="a YAML file")
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(
                "file is too large for a configuration", where=where, accepted=f"at most {MAX_BYTES} bytes"
            )
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError("no such file", where=where, accepted="a YAML file") from None
    except OSError as error:
        raise ConfigError(
            f"cannot be read: {(error.strerror or str(error)).lower()}", where=where, accepted="a YAML file"
        ) from None
    except ValueError:  # bytes that are not UTF-8, or a NUL in the name
        raise ConfigError(
            "cannot be read: not text in UTF-8", where=where, accepted="a YAML text file in UTF-8"
        ) from None


def read_table(path: str | Path, accepted: str = "key: value lines") -> Tree:
    """Return :func:`read_yaml` of a file that must hold a table; an empty file is an empty table."""
    tree = read_yaml(path)
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError("not a table of keys", where=str(path), value=tree, accepted=accepted)
    return tree


def to_yaml(tree: object) -> str:
    """Return YAML text that :func:`parse_yaml` reads as ``tree``; keys keep their order, without aliases."""
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def to_short_yaml(tree: object) -> str:
    """Return YAML text with each innermost table or list on one line, easy to copy."""
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True


# ---------------------------------------------------------------------------------------------------------------------
# Plain trees of configurations as read from YAML, and operations on them: merging, and changes in several places.

_TAGS = {"kind": ("random", "displacement", "spline"), "emulator": ("esim",)}
"""Keys that say of which kind a table is, and the kinds of tables without them: of scene, timeline, motions; events."""
_WHOLE = ("sensor",)
"""Keys whose tables are replaced as a whole: a sensor is not mixed from two."""


def merge(common: object, own: object) -> Any:
    """Return ``own`` laid over ``common``: tables key by key. Any other value, a distribution, or a table of another
    kind (``kind: explicit`` over ``kind: random``) replaces the common value."""
    both = (
        isinstance(common, dict) and isinstance(own, dict) and not is_distribution(common) and not is_distribution(own)
    )
    # Keys of one kind mean nothing to another.
    if not both or any(_kinds_differ(common, own, tag) for tag in _TAGS):
        return copy.deepcopy(own)
    laid = {key: copy.deepcopy(value) if key in _WHOLE else merge(common.get(key), value) for key, value in own.items()}
    return {**copy.deepcopy(common), **laid}


def _kinds_differ(common: Tree, own: Tree, tag: str) -> bool:
    usual = tag not in common and own.get(tag) in _TAGS[tag]
    return tag in own and own[tag] != common.get(tag) and not usual


def each_option(node: Any, change: Callable[[object], object]) -> object:
    """Return ``node`` changed by ``change``, or with each option of its distribution changed."""
    if not is_distribution(node):
        return change(node)
    kind, spec = next(iter(node.items()))
    if kind == "choice" and isinstance(spec, list):
        return {kind: [each_option(option, change) for option in spec]}
    if kind == "shares" and isinstance(spec, list) and all(isinstance(p, dict) and "value" in p for p in spec):
        return {kind: [{**part, "value": each_option(part["value"], change)} for part in spec]}
    return node


def with_groups(tree: Tree, change: Callable[[Tree], Tree]) -> Tree:
    """Return ``tree`` and each of its groups changed by ``change``; invalid groups are left to validation."""
    changed, groups = change(tree), tree.get("groups")
    if isinstance(groups, dict):
        changed["groups"] = {
            name: change(group) if isinstance(group, dict) and "groups" not in group else group
            for name, group in groups.items()
        }
    return changed


def with_sections(tree: Tree, change: Callable[[Tree], Tree]) -> Tree:
    """Return ``tree`` with the table of each sensor in ``sensors:`` changed."""
    sensors = tree.get("sensors")
    if not isinstance(sensors, list):
        return tree
    return {**tree, "sensors": [change(one) if isinstance(one, dict) else one for one in sensors]}


def apply_overrides(tree: Tree, overrides: Sequence[str]) -> Tree:
    """Return a copy of ``tree`` with ``--set`` options applied; missing tables on the path are created."""
    tree = copy.deepcopy(tree)
    for option in overrides:
        # The value is YAML, so that lists, tables and null can be given.
        dotted, equals, text = option.partition("=")
        keys = dotted.strip().split(".")
        if not equals or not all(keys):
            raise ConfigError("not an override", where="--set", value=option, accepted="path.to.key=value")
        value = parse_yaml(text, f"--set {dotted}")
        node: Any = tree
        for depth, key in enumerate(keys):
            last = depth == len(keys) - 1
            if isinstance(node, list):
                if not key.isdecimal() or int(key) >= len(node):
                    raise ConfigError(
                        "no such list entry",
                        where="--set " + ".".join(keys[: depth + 1]),
                        value=key,
                        accepted=f"0 … {len(node) - 1}",
                    )
                key = int(key)
            elif not isinstance(node, dict):
                raise ConfigError(
                    "is a plain value and has no keys", where="--set " + ".".join(keys[:depth]), value=node
                )
            if last:
                node[key] = value
            elif isinstance(node, dict):
                # A table that is not there, or null, begins empty.
                if node.get(key) is None:
                    node[key] = {}
                node = node[key]
            else:
                node = node[key]
    return tree


# ---------------------------------------------------------------------------------------------------------------------
# Files that ship with the program, by name: runs, and tables of sensors, rigs, quality presets and recipes.


def shipped(kind: str, name: object, what: str = "table", where: str = "") -> Tree:
    """Return a copy of the table of this name. Raises ConfigError listing the known ones (:func:`shipped_names`).

    what, where : for the message."""
    known = shipped_names(kind)
    if not isinstance(name, str) or name not in known:
        raise ConfigError(f"unknown {what}", where=where, value=name, accepted=f"one of {', '.join(known)}")
    return copy.deepcopy(_read(kind, name))


@lru_cache
def _read(kind: str, name: str) -> Tree:
    text = (resources.files("blinkgl.configs") / kind / f"{name}.yaml").read_text(encoding="utf-8")
    return parse_yaml(text, f"{kind}/{name}.yaml")


_RUNS = ("*.yaml", "scenes/*.yaml", "eflow/*_data.yaml")


@lru_cache
def shipped_runs() -> dict[str, Path]:
    """Return the files of shipped runs by name: "demo", "flags" …"""
    folder = Path(str(resources.files("blinkgl.configs")))
    return {path.stem: path for pattern in _RUNS for path in sorted(folder.glob(pattern))}


def run_file(name: str | Path) -> Path:
    """Return the file ``name`` or, where there is none, the shipped run of that name: "demo", "demo.yaml" and
    "configs/demo.yaml" are the same. (A folder does not count: ``generate demo --out demo`` creates one.) Raises
    ConfigError."""
    path = Path(name)
    shipped_one = shipped_runs().get(path.stem)
    if (path.exists() or path.is_symlink()) and not (path.is_dir() and str(path) == path.stem and shipped_one):
        return path
    named = shipped_one is not None and shipped_one.as_posix().endswith(f"/{path.with_suffix('.yaml').as_posix()}")
    if shipped_one is not None and (named or path.parent == Path()):
        return shipped_one
    raise ConfigError("no such file", where=str(name), accepted="a YAML file, or a name that 'blinkgl configs' lists")
