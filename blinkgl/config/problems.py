"""Validation errors as one line: the config path, the problem in plain words, the value, and what is accepted."""

from __future__ import annotations

import difflib
import re
import typing
from typing import Annotated, Any

import annotated_types
from pydantic import (
    BaseModel,
    TypeAdapter,
    ValidationError,
)
from pydantic.fields import FieldInfo

from blinkgl.config.base import Config, Path, Refused, below, is_model, limits_below, members, tag_of
from blinkgl.errors import ConfigError


def _dotted(*names: str) -> str:
    return ".".join(name for name in names if name)


def validate(model: type[Config], data: object, *, where: str = "") -> Any:
    """Return ``model`` built from plain data. Raises :class:`ConfigError` naming the first bad path, its value and what
    is accepted (for an unknown key: the nearest valid one)."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _translate(model, error, where) from None


def validate_field(model: type[Config], name: str, value: object) -> Any:
    """Return ``value`` validated as the model's field ``name``. Raises ConfigError as :func:`validate`."""
    info = model.model_fields[name]
    try:
        parts = (info.annotation, *info.metadata)
        kind: Any = Annotated[parts] if info.metadata else info.annotation  # type: ignore[not-a-type]
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        raise _translate(model, error, "", (name,)) from None


PROBLEMS = {
    "model_type": "not a table of keys",
    "model_attributes_type": "not a table of keys",
    "dict_type": "not a table of keys",
    "invalid_key": "a key is not text",
    "tuple_type": "not a list",
    "too_long": "too many entries",
    "too_short": "too few entries",
    "int_type": "not a whole number",
    "int_parsing": "not a whole number",
    "int_from_float": "not a whole number",
    "int_parsing_size": "too many digits",
    "float_type": "not a number",
    "float_parsing": "not a number",
    "finite_number": "not a finite number",
    "bool_type": "not true or false",
    "bool_parsing": "not true or false",
    "string_type": "not text",
    "string_unicode": "not text",
    "string_too_short": "too short",
    "string_too_long": "too long",
    "string_pattern_mismatch": "not accepted characters, or too many",
    "literal_error": "unknown choice",
    "none_required": "not null",
    "greater_than": "too small",
    "greater_than_equal": "too small",
    "less_than": "too large",
    "less_than_equal": "too large",
    "multiple_of": "not a multiple",
}
"""Plain words for pydantic's error types. `missing`, `extra_forbidden`, `value_error` and the tags of unions are
handled where they are translated."""


def _translate(model: type[BaseModel], error: ValidationError, where: str, start: Path = ()) -> ConfigError:
    # Unknown keys come first: a misspelt key usually also causes a "missing" error. Then the errors of rules: for a
    # union ("text or a table") they say what is wrong with the given table.
    order = {"extra_forbidden": 0, "value_error": 1}
    problems = sorted(error.errors(include_url=False), key=lambda e: order.get(e["type"], 2))
    first = problems[0]
    kind, context = first["type"], first.get("ctx", {})
    path, owners, annotations, info = _locate(model, (*start, *first["loc"]), kind)
    dotted = _dotted(where, *path) or "config"
    if kind == "extra_forbidden":
        return ConfigError("unknown key", where=dotted, accepted=_nearest(model, path, owners))
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        tags = [tag_of(a) for a in annotations if is_model(a)]
        key = context.get("discriminator", "kind").strip("'")
        got = first["input"].get(key, ...) if isinstance(first["input"], dict) else first["input"]
        return ConfigError(
            "missing choice" if got is ... else "unknown choice",
            where=f"{dotted}.{key}",
            value=got,
            accepted="one of " + ", ".join(f"'{tag[1]}'" for tag in tags if tag),
        )
    if kind == "missing":
        # A list's missing entry is reported by its number, as if that were a key.
        short = path and path[-1].isdigit() and not owners
        problem, value = ("too few entries", first["input"]) if short else ("is required", ...)
        return ConfigError(
            problem,
            where=_dotted(where, *path[:-1]) if short else dotted,
            value=value,
            accepted=None if short else describe(annotations, info),
        )
    refused = context.get("error")
    if isinstance(refused, Refused):
        there = _dotted(where, *path, refused.where) or "config"
        return ConfigError(refused.problem, where=there, value=refused.value, accepted=refused.accepted)
    if refused is not None:
        return ConfigError(str(refused), where=dotted, value=first["input"])
    if kind == "invalid_key":
        return ConfigError(PROBLEMS[kind], where=dotted, value=first["input"], accepted="text")
    several = len(annotations) > 1 and not any(is_model(a) for a in annotations)
    problem = "not accepted" if several else PROBLEMS.get(kind, "not accepted")
    return ConfigError(problem, where=dotted, value=first["input"], accepted=describe(annotations, info))


def _nearest(model: type[BaseModel], path: list[str], owners: list[type[BaseModel]]) -> str:
    """Return what an unknown key may mean: the nearest known key, or the sibling kind that has the key."""
    known = sorted({name for owner in owners for name in owner.model_fields})
    if (near := nearest(path[-1], known)).endswith("(nearest)"):
        return near
    here: list[Any] = members(model)
    for step in path[:-1]:
        here = [x for a in here for x in below(a, step)]
    others = [tag_of(m) for m in here if is_model(m) and m not in owners and path[-1] in m.model_fields]
    also = "".join(f"; it is a key of {key}: {value}" for key, value in filter(None, others))
    return near + also


def nearest(name: str, known: list[str]) -> str:
    """Return the known name nearest to ``name``, as text; all names where none is near."""
    # "threshold" means "contrast_threshold" and not "threshold_sigma", although that shares more letters.
    near = [one for one in known if one.endswith(f"_{name}")]
    in_units = [one for one in known if one in [f"{name}_{unit}" for unit in ("us", "ms", "s", "hz", "px")]]
    near = in_units or near or difflib.get_close_matches(name, known, n=1)
    return f"'{near[0]}' (nearest)" if near else "one of: " + ", ".join(known)


def _locate(
    model: type[BaseModel], loc: tuple, kind: str
) -> tuple[list[str], list[type[BaseModel]], list[Any], FieldInfo | None]:
    """Return the config path of a pydantic location without pydantic's labels for members of unions, the models that
    may own its last key, the annotations that are accepted there, and their field."""
    path: list[str] = []
    here: list[Any] = members(model)
    owners: list[type[BaseModel]] = []
    info: FieldInfo | None = None
    for number, step in enumerate(loc):
        models = [a for a in here if is_model(a)]
        inner = [x for a in here for x in below(a, step)]
        if inner:
            path.append(str(step))
            owners = [m for m in models if step in m.model_fields]
            info = (
                owners[0].model_fields[step]
                if owners
                else next(filter(None, (limits_below(a, step) for a in here)), None)
            )
            here = inner
            continue
        tagged = [m for m in models if step in (tag_of(m) or ())[1:]]
        if tagged:
            here = tagged
        elif number == len(loc) - 1 and kind in ("extra_forbidden", "missing"):
            path.append(str(step))
            owners = models
        # anything else is a pydantic label: a member of a union, a function, "[key]"
    return path, owners, here, info


def describe(annotations: list[object], info: FieldInfo | None = None) -> str:
    """Return what a field accepts, in words."""
    words = list(dict.fromkeys(_word(a, info) for a in annotations))
    if info is not None and type(None) in typing.get_args(info.annotation):
        words.append("null")
    return _or(words)


def _or(words: list[str]) -> str:
    if len(words) == 1:
        return words[0]
    comma = "," if any(" " in word for word in words[:-1]) else ""
    return ", ".join(words[:-1]) + f"{comma} or {words[-1]}"


def _word(annotation: Any, info: FieldInfo | None) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        return _word(arguments[0], info)
    if origin is typing.Literal:
        return _or([str(a).lower() if isinstance(a, bool) else repr(a) for a in arguments])
    if origin in (tuple, list):
        if origin is tuple and arguments[-1] is not Ellipsis:
            return "a list of " + _NUMBER_WORDS.get(len(arguments), str(len(arguments))) + " numbers"
        inner = members(arguments[0])
        plural = "tables" if any(is_model(a) for a in inner) else "texts" if inner == [str] else describe(inner)
        example = f", such as [{typing.get_args(inner[0])[0]}]" if typing.get_origin(inner[0]) is typing.Literal else ""
        return f"a list of {plural}{example}"
    if origin is dict or is_model(annotation):
        return "a table of keys"
    if annotation in (int, float):
        return ("a whole number" if annotation is int else "a number") + _limits(info)
    return {str: "text", bool: "true or false"}.get(annotation, "another value")


_NUMBER_WORDS = {2: "two", 3: "three", 4: "four"}


def _limits(info: FieldInfo | None) -> str:
    limits = []
    for kind, attribute, words in (
        (annotated_types.Gt, "gt", "greater than"),
        (annotated_types.Ge, "ge", "at least"),
        (annotated_types.Lt, "lt", "less than"),
        (annotated_types.Le, "le", "at most"),
        (annotated_types.MultipleOf, "multiple_of", "a multiple of"),
    ):
        limits += [
            f"{words} {_plain(getattr(m, attribute))}"
            for m in (info.metadata if info is not None else ())
            if isinstance(m, kind)
        ]
    text = " and ".join(limits)
    return re.sub(r"^ at least (\S+) and at most (\S+)$", r" from \1 to \2", f" {text}") if limits else ""


def _plain(number: object) -> str:
    return str(number) if isinstance(number, int) and abs(number) < 1e6 else f"{number:.7g}"
