"""What the page may ask, and how each parameter is read: the one place that looks at a query's text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl

from blinkgl.errors import ConfigError
from blinkgl.io.pictures import MAPS
from blinkgl.shader_debugger.moments import check_pass

LONGEST = 2000  # characters of a query
LARGEST = 1e30  # ends of a colour scale: far above every buffer, and their difference is still a number
SOURCES = ("gpu", "reference")
COMPONENTS = ("auto", "length", "x", "y", "z", "w")

Reader = Callable[[str, str], Any]  # (parameter's name, its text; "" when not given) -> value


def _choice(what: str, known: tuple[str, ...], default: str | None) -> Reader:
    def read(key: str, text: str):
        if text and text not in known:
            raise ConfigError(what, where=key, value=text, accepted="one of " + ", ".join(known))
        return text or default

    return read


def _pass(key: str, text: str) -> str:
    return check_pass(text, where=key)


def _pass_and_source(key: str, text: str) -> tuple[str, str]:
    name, _, source = text.partition(":")
    if source not in SOURCES:
        raise ConfigError("unknown source", where=key, value=text, accepted="PASS:gpu or PASS:reference")
    return check_pass(name, where=key), source


def _seconds(key: str, text: str) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        raise ConfigError("not a time", where=key, value=text, accepted="seconds") from None


def _number(key: str, text: str) -> float | None:
    try:
        value = float(text) if text else None
    except ValueError:
        value = math.nan
    # NaN is not below anything.
    if value is not None and not abs(value) <= LARGEST:
        raise ConfigError(
            "not a number", where=key, value=text, accepted=f"a number between -{LARGEST:g} and {LARGEST:g}, or nothing"
        )
    return value


def _count(key: str, text: str) -> int:
    """-1 when not given."""
    if text and not re.fullmatch(r"[0-9]{1,18}", text):
        raise ConfigError("not a version", where=key, value=text, accepted="a whole number")
    return int(text) if text else -1


def _text(key: str, text: str) -> str:
    return text  # session.check_pixel reads the two together


_VIEW: dict[str, Reader] = {
    "t": _seconds,
    "component": _choice("no such component", COMPONENTS, "auto"),
    "map": _choice("unknown colour map", MAPS, None),
    "low": _number,
    "high": _number,
}

ROUTES: dict[str, dict[str, Reader]] = {
    "/state": {},
    "/image": {"pass": _pass, "source": _choice("unknown source", SOURCES, "gpu"), **_VIEW},
    "/difference": {"a": _pass_and_source, "b": _pass_and_source, **_VIEW},
    "/probe": {"x": _text, "y": _text, "t": _seconds},
    "/verdict": {"t": _seconds},
    "/wait": {"version": _count},
}
"""Parameters of each route; all may be left out, where a default makes sense."""


def read_query(route: str, text: str) -> dict[str, Any]:
    """Values of every parameter of a route in :data:`ROUTES`, from the text behind the
    question mark. Raises ConfigError."""
    readers = ROUTES[route]
    if len(text) > LONGEST:
        raise ConfigError(
            "the question is too long", where=route, value=len(text), accepted=f"at most {LONGEST} characters"
        )
    given: dict[str, str] = {}
    # A parameter that is given twice is read differently everywhere.
    for key, value in parse_qsl(text, keep_blank_values=True):
        if key not in readers or key in given:
            raise ConfigError(
                "asked twice" if key in given else "unknown parameter",
                where=route,
                value=key,
                accepted="one of " + ", ".join(readers) if readers else "none",
            )
        given[key] = value
    return {key: read(key, given.get(key, "")) for key, read in readers.items()}
