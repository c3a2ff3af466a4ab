"""Base of every config model and the translation of pydantic's errors into one line."""

from __future__ import annotations

import difflib
import types
import typing
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from blinkgl.errors import ConfigError


class Config(BaseModel):
    """Frozen; unknown keys, NaN and infinity are refused. Numbers written as strings ("1e-4") are converted,
    because YAML 1.1 reads ``1e-4`` as a string."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)


def validate(model: type[Config], data: Any, *, where: str = "") -> Config:
    """``model`` built from plain data; raises :class:`ConfigError` naming the first bad path, its value and
    what is accepted (for an unknown key: the nearest valid one)."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise _translate(model, error, where) from None


def _translate(model: type[BaseModel], error: ValidationError, where: str) -> ConfigError:
    # Unknown keys first: a misspelt key usually also causes a "missing" error, and the misspelling is the cause.
    problems = sorted(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
    first = problems[0]
    path, owner = _locate(model, first["loc"])
    dotted = ".".join(filter(None, [where, *path])) or "config"
    if first["type"] == "extra_forbidden":
        known = sorted(owner.model_fields) if owner is not None else []
        near = difflib.get_close_matches(str(path[-1]), known, n=1)
        hint = f"'{near[0]}' (nearest)" if near else "one of: " + ", ".join(known)
        return ConfigError("unknown key", where=dotted, accepted=hint)
    message = first["msg"].removeprefix("Value error, ").rstrip(".")
    if first["type"] == "missing":
        return ConfigError("is required", where=dotted)
    if first["type"] in ("union_tag_invalid", "union_tag_not_found"):
        context = first.get("ctx", {})
        key = context.get("discriminator", "kind").strip("'")
        return ConfigError("unknown or missing choice", where=f"{dotted}.{key}", value=context.get("tag", first["input"]),
                           accepted="one of " + context.get("expected_tags", "the documented kinds"))
    message = message[0].lower() + message[1:]
    return ConfigError(message, where=dotted, value=first["input"])


def _locate(model: type[BaseModel], loc: tuple) -> tuple[list[str], type[BaseModel] | None]:
    """Config path of a pydantic location without the union tags pydantic inserts, and the model that owns its
    last key (None when that is not a model)."""
    path: list[str] = []
    owner: Any = model
    candidates: list[Any] = [model]
    for step in loc:
        models = [c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)]
        if isinstance(step, int):
            path.append(str(step))
            candidates = [a for c in candidates for a in _arguments(c)] or candidates
            continue
        table = next((c for c in candidates if typing.get_origin(c) is dict), None)
        if table is not None:
            path.append(str(step))
            candidates = _flatten(typing.get_args(table)[1])
            owner = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), owner)
            continue
        holder = next((m for m in models if step in m.model_fields), None)
        if holder is not None:
            path.append(step)
            owner = holder
            candidates = _flatten(holder.model_fields[step].annotation)
            continue
        tagged = [m for m in models if _has_tag(m, step) or m.__name__ == step]
        if tagged and step != loc[-1]:
            candidates = tagged
            owner = tagged[0]
            continue
        if step == loc[-1] and not (tagged or str(step).startswith(("function-", "constrained-", "tuple[", "list["))):
            path.append(str(step))
            owner = models[0] if models else None
    return path, owner


def _has_tag(model: type[BaseModel], tag: str) -> bool:
    return any(tag in typing.get_args(f.annotation) for f in model.model_fields.values()
               if typing.get_origin(f.annotation) is typing.Literal)


def _arguments(annotation: Any) -> list[Any]:
    return [x for a in typing.get_args(annotation) if a is not type(None) for x in _flatten(a)]


def _flatten(annotation: Any) -> list[Any]:
    """Union members (through Annotated), other annotations as they are."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        return _flatten(typing.get_args(annotation)[0])
    if origin in (typing.Union, types.UnionType):
        return [x for a in typing.get_args(annotation) if a is not type(None) for x in _flatten(a)]
    return [annotation]
