"""Checks of the arguments of public functions: an error message begins with the argument's name."""

from __future__ import annotations

import functools
import inspect
import math
import numbers
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.types.trees import Tree

Given = ParamSpec("Given")
Made = TypeVar("Made")


def public(keywords: type | None = None) -> Callable[[Callable[Given, Made]], Callable[Given, Made]]:
    """Decorate a public function: an argument that is unknown, missing or one too many raises ConfigError.

    keywords : the TypedDict of its ``**keywords``; None: there are none, or it checks those itself."""
    return lambda function: _checked(function, keywords)


def _checked(function: Callable[Given, Made], keywords: type | None) -> Callable[Given, Made]:
    signature = inspect.signature(function)
    name = function.__qualname__.removesuffix(".__init__")
    prefix = f"{name}." if function.__name__ == "__init__" else ""
    known = [key for key, one in signature.parameters.items() if key != "self" and one.kind is not one.VAR_KEYWORD]
    any_more = keywords is None and any(one.kind is one.VAR_KEYWORD for one in signature.parameters.values())
    known += [] if keywords is None else keywords.__annotations__

    @functools.wraps(function)
    def called(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        for key in () if any_more else kwargs:
            if key not in known:
                raise unknown_argument(key, known, prefix)
        try:
            signature.bind(*args, **kwargs)
        except TypeError as error:
            raise ConfigError(str(error), where=name, accepted=f"{name}({', '.join(known)})") from None
        return function(*args, **kwargs)

    return called


def unknown_argument(name: str, known: Iterable[str], prefix: str = "") -> ConfigError:
    """Return the error of an unknown argument: it suggests the nearest of the ``known``, or where an emulator's key
    belongs."""
    from blinkgl.config.events import EmulatorConfig
    from blinkgl.config.problems import nearest

    for kind, model in EmulatorConfig.members.items():
        if name in model.model_fields and "emulator" in known:
            accepted = f"emulator={{'emulator': '{kind}', '{name}': …}}"
            break
    else:
        accepted = nearest(name, list(known))
    return ConfigError("unknown argument", where=prefix + name, accepted=accepted)


def plain(value: object) -> Any:
    """Return the value as plain lists and numbers instead of arrays, tuples and NumPy scalars, as a YAML file gives
    it."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, Mapping):
        return {plain(k): plain(v) for k, v in value.items()}
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def given(**arguments: object) -> Tree:
    """Return the arguments that are not None, as plain data."""
    return {name: plain(value) for name, value in arguments.items() if value is not None}


def path(value: object, where: str) -> Path:
    """Return a path. Raises ConfigError: not a path."""
    if not isinstance(value, (str, os.PathLike)) or not str(value):
        raise ConfigError("not a path", where=where, value=value, accepted="text or a pathlib.Path")
    return Path(value)


def existing(value: Any, where: str) -> str:
    """Return the path of an existing file, as text. Raises ConfigError."""
    if not path(value, where).expanduser().is_file():
        raise ConfigError("no such file", where=where, value=os.fspath(value), accepted="an existing file")
    return os.fspath(value)


def number(
    value: object, where: str, *, least: float = -math.inf, most: float = math.inf, above: float = -math.inf
) -> float:
    """Return a finite number in [least, most] and greater than ``above``. Raises ConfigError."""
    bounds = (
        [f"greater than {above:g}"] * (above > -math.inf)
        + [f"at least {least:g}"] * (least > -math.inf)
        + [f"at most {most:g}"] * (most < math.inf)
    )
    real = isinstance(value, (numbers.Real, np.number)) and not isinstance(value, bool) and _is_finite(value)
    if not real or not least <= float(value) <= most or not float(value) > above:
        raise ConfigError(
            "out of range" if real else "not a finite number",
            where=where,
            value=value,
            accepted=" ".join(["a number", " and ".join(bounds)]).strip(),
        )
    return float(value)


def _is_finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False


def whole(value: object, where: str, least: int, most: int) -> int:
    """Return a whole number in [least, most]. Raises ConfigError."""
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or not least <= int(value) <= most:
        raise ConfigError("not a whole number in range", where=where, value=value, accepted=f"{least} to {most}")
    return int(value)


def seed(value: object, where: str = "seed") -> int:
    """Return a whole number that is valid as a seed. Raises ConfigError."""
    return whole(value, where, 0, 2**63 - 1)


def one_of(value: object, where: str, kinds: type | tuple[type, ...], accepted: str) -> Any:
    """Return ``value`` if it is an instance of one of the classes. Raises ConfigError."""
    if not isinstance(value, kinds):
        kind = type(value).__name__
        raise ConfigError(f"not accepted: {kind}", where=where, value=value, accepted=accepted)
    return value


def array(value: object, where: str, shape: tuple[int | None, ...], accepted: str) -> np.ndarray:
    """Return a numeric array of the shape (None: any length). Raises ConfigError."""
    try:
        made = np.asarray(value)
    except ValueError:  # rows of different lengths
        made = np.empty(0, object)
    fits = made.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, made.shape))
    if not fits or made.dtype.kind not in "fiub":
        got = f"{made.dtype} {made.shape}" if isinstance(value, np.ndarray) else value
        raise ConfigError("array of another type or shape", where=where, value=got, accepted=accepted)
    return made
