"""Base of every config model: its keys, its checks and its one-line errors.

A field checks one value. A :func:`rule` checks several values *together*; it receives the values of the keys that it
names and nothing else:

    class AdaptiveTimeline(Config):
        min_step_us: float = Field(200.0, ge=0.001)
        max_step_us: float = Field(20000.0, ge=0.001)

        @rule("min_step_us", "max_step_us")
        def _ordered(least, most):
            if least > most:
                raise Refused(f"min_step_us must not exceed max_step_us = {most}")

"""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import repeat
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    TypeAdapter,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import core_schema

from blinkgl.errors import ConfigError

Path = tuple[str, ...]


class Refused(ValueError):
    """The error that a rule raises: the problem, its place (a key of the rule's model), the value and what is
    accepted."""

    def __init__(self, problem: str, *, where: str = "", value: object = ..., accepted: str | None = None):
        super().__init__(problem)
        self.problem, self.where, self.value, self.accepted = problem, where, value, accepted


@contextmanager
def placed(
    where: str | Callable[[str], str],
    kind: type[Any] = ConfigError,
    *,
    of: tuple[type[Any], ...] = (Refused, ConfigError),
    before: str = "",
) -> Iterator[None]:
    """Raise the errors ``of`` the code inside as a ``kind`` of error at another place.

    where : the place, or what makes it of the place there.   before : what comes before the problem."""
    try:
        yield
    except of as error:
        place = where if isinstance(where, str) else where(error.where or "")
        raise kind(before + error.problem, where=place, value=error.value, accepted=error.accepted) from None


@dataclass(frozen=True)
class Rule:
    """A check of the values of ``keys``, which are paths below the rule's model. ``*`` in a key gives all entries of a
    list or table as a tuple. A leading ``?`` gives whether there is a value (not null). A leading ``#`` gives the names
    in a table, or the indices of a list, as a tuple. A key below null gives None."""

    keys: tuple[str, ...]
    check: Callable[..., None]
    paths: tuple[Path, ...] = field(init=False)

    def __post_init__(self) -> None:
        # Split once, because rules run for every sequence. A frozen dataclass allows no other way.
        object.__setattr__(self, "paths", tuple(tuple(key.lstrip("?#").split(".")) for key in self.keys))

    def __call__(self, model: Config) -> None:
        self.check(*map(_value, repeat(model), self.keys, self.paths))


def rule(*keys: str) -> Callable[[Callable[..., None]], Rule]:
    """Make a rule of the model in whose body it is defined; the function takes one value per key, in order."""
    return lambda function: Rule(keys, function)


def at_most_one(*keys: str) -> Rule:
    """Return the rule that at most one of the keys has a value."""

    def check(*values: object) -> None:
        used = [key for key, value in zip(keys, values) if value is not None]
        if len(used) > 1:
            raise Refused(f"only one of {', '.join(keys)} may be given, not {' and '.join(used)}")

    return Rule(keys, check)


class Former(NamedTuple):
    """A key of earlier versions. It is accepted where its value means the present behaviour, because the
    ``config.yaml`` files of those versions contain it, and refused otherwise.

    instead : what to write instead, the end of a sentence.   is_off : whether a value means the present behaviour."""

    instead: str
    is_off: Callable[[object], bool]


def always(constant: object) -> Former:
    """Return the former key whose value is ``constant`` now."""
    # YAML has lists where constants are tuples.
    accepted = (constant, list(constant)) if isinstance(constant, tuple) else (constant,)
    return Former(f"{constant}, which holds always", lambda value: value in accepted)


class Config(BaseModel):
    """A frozen model. It refuses unknown keys, NaN and infinity. Numbers written as strings ("1e-4") are converted,
    because YAML 1.1 reads ``1e-4`` as a string.

    presets : defaults of the other keys for each value of the key ``preset``.
    former : keys of earlier versions; see :class:`Former`.
    rules : the checks of several values together, see :func:`rule`, those of the base classes first.
    members : of a base model, which as a field's annotation accepts any of them: models by the value of their key
    ``tag``, in the order in which they were added; ``default_member`` where it is not given. Plug-ins may add some."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True, ignored_types=(Rule,)
    )
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    former: ClassVar[Mapping[str, Former]] = {}
    rules: ClassVar[tuple[Rule, ...]] = ()
    members: ClassVar[dict[str, type[Any]]]
    tag: ClassVar[str]
    default_member: ClassVar[str]

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> core_schema.CoreSchema:
        if "members" not in vars(cls):
            return handler(source)
        # A function instead of a schema, because pydantic would freeze the present members.
        union = lambda: _union(cls.tag, cls.default_member, *cls.members.values())
        return core_schema.no_info_plain_validator_function(lambda data: union().validate_python(data))

    @classmethod
    def __pydantic_init_subclass__(cls, **_: object) -> None:
        # From the base class down, so that a subclass may replace a rule of the same name.
        bodies = [vars(base) for base in reversed(cls.__mro__)]
        rules = {name: value for body in bodies for name, value in body.items() if isinstance(value, Rule)}
        cls.rules = tuple(rules.values())
        # Without this check, a rule of a renamed key would silently never run again. A private base class has rules of
        # keys that its subclasses define.
        for name, path in [(name, path) for name, check in rules.items() for path in check.paths]:
            if not cls.__name__.startswith("_") and not _fits(cls, path):
                raise TypeError(f"{cls.__name__}.{name}: there is no key {'.'.join(path)}")

    @model_validator(mode="before")
    @classmethod
    def _present_keys(cls, data: object) -> object:
        """Return the given keys over those of the preset, without those of earlier versions."""
        if not isinstance(data, dict):
            return data
        # Before the fields are checked, which would call them unknown keys.
        former = [key for key in data if key in cls.former]
        for key in former:
            if not cls.former[key].is_off(data[key]):
                accepted = cls.former[key].instead
                raise Refused("this key was removed", where=key, value=data[key], accepted=accepted)
        name = data.get("preset", cls.model_fields["preset"].default) if cls.presets else None
        preset = cls.presets.get(name, {}) if isinstance(name, str) else {}
        return {**preset, **{key: value for key, value in data.items() if key not in former}}

    @model_validator(mode="after")
    def check_rules(self) -> Config:
        """Return the model itself. Raises Refused where a rule is broken."""
        for one in self.rules:
            one(self)
        return self


def one_of(tag: str, *models: type[Config], default: str | None = None) -> Any:
    """Return the annotation of a field that is one of ``models``, chosen by the value of the key ``tag``. Without that
    key it is ``default``, so that a table may contain only what it changes."""
    union: Any = typing.Union[models]  # type: ignore[not-a-type]  # noqa: UP007 - of as many as there are
    if default is None:
        return Annotated[union, Discriminator(tag)]
    return Annotated[union, Discriminator(tag), BeforeValidator(partial(_with_tag, tag, default))]


@lru_cache
def _union(tag: str, default: str, *models: type[Config]) -> TypeAdapter:
    return TypeAdapter(one_of(tag, *models, default=default))


def _with_tag(tag: str, default: str, data: object) -> object:
    return {tag: default, **data} if isinstance(data, dict) and tag not in data else data


def tag_of(model: type[BaseModel]) -> tuple[str, str] | None:
    """Return the key and value that distinguish the model from the others of its union; None for a single model."""
    for key in ("kind", "emulator", "name"):
        if key in model.model_fields:
            annotation = model.model_fields[key].annotation
            if typing.get_origin(annotation) is typing.Literal and len(typing.get_args(annotation)) == 1:
                return key, typing.get_args(annotation)[0]
    return None


# --- what stands at a path --------------------------------------------------------------------------------------------


def members(annotation: Any) -> list[Any]:
    """Return the members of a union (through Annotated), or those of a base model, without null; another annotation
    alone."""
    if is_model(annotation) and "members" in vars(annotation):
        return list(annotation.members.values())
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        return members(typing.get_args(annotation)[0])
    if origin in (typing.Union, types.UnionType):
        return [x for a in typing.get_args(annotation) if a is not type(None) for x in members(a)]
    return [annotation]


def is_model(annotation: object) -> bool:
    """Return whether ``annotation`` is a pydantic model class."""
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def below(annotation: Any, step: str | int) -> list[Any]:
    """Return the annotations of the value at key or index ``step`` ("*": any) of a value of ``annotation``; [] where
    there can be none."""
    if is_model(annotation):
        info = annotation.model_fields.get(step)
        return [] if info is None else members(info.annotation)
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is dict:
        return members(arguments[1])
    if origin in (tuple, list) and (isinstance(step, int) or step == "*" or str(step).isdigit()):
        # A tuple of fixed length has one annotation per place, other lists have one for all entries.
        if origin is tuple and arguments and arguments[-1] is not Ellipsis:
            at = 0 if step == "*" else int(step)
            return members(arguments[at]) if at < len(arguments) else []
        return members(arguments[0])
    return []


def limits_below(annotation: object, step: str | int) -> FieldInfo | None:
    """Return the limits of an entry of a list, which its annotation holds."""
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) not in (tuple, list) or not str(step).isdigit() or not arguments:
        return None
    entry = arguments[min(int(step), len(arguments) - 1) if arguments[-1] is not Ellipsis else 0]
    return (
        next((a for a in typing.get_args(entry)[1:] if isinstance(a, FieldInfo)), None)
        if typing.get_origin(entry) is Annotated
        else None
    )


def _fits(annotation: object, path: Iterable[str]) -> bool:
    here = [annotation]
    for step in path:
        here = [x for a in here for x in below(a, step)]
    return bool(here)


def _value(model: object, key: str, path: Path) -> Any:
    value = _get(model, path)
    if key[0] == "?":
        return value is not None
    if key[0] == "#":
        return tuple(value) if isinstance(value, dict) else tuple(range(len(value or ())))
    return value


def _get(node: Any, path: Path) -> Any:
    for depth, step in enumerate(path):
        if node is None:
            return None
        if step == "*":
            rest = path[depth + 1 :]
            return tuple(_get(child, rest) for child in (node.values() if isinstance(node, dict) else node))
        node = getattr(node, step, None)
    return node


# --- errors -----------------------------------------------------------------------------------------------------------
