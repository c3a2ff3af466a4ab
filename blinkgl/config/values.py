"""Value types of many keys: ranges, vectors, colours."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from blinkgl.config.materials import Radiance


def as_pair(value: object) -> object:
    """Return a range; a number is both of its ends."""
    # Text too: YAML 1.1 reads 1e-1 as text, and pydantic converts it later.
    return (value, value) if isinstance(value, (int, float, str)) and not isinstance(value, bool) else value


def ordered(pair: tuple[float, float]) -> tuple[float, float]:
    """Return the range. Raises ValueError if its lower end is above its upper one."""
    if pair[0] > pair[1]:
        raise ValueError("the range must be [smallest, largest]")
    return pair


def _as_list(value: object) -> object:
    return (value,) if isinstance(value, str) else value


def word_or_list(words: tuple, kinds: tuple[str, ...] = ()) -> BeforeValidator:
    """Return a validator that refuses what is neither one of ``words`` nor a list of ``kinds``; pydantic's message
    would name only the union's first member."""

    def check(value: object) -> Any:
        listed = isinstance(value, (list, tuple)) and kinds
        if not (
            any(value is w or (isinstance(w, str) and value == w) for w in words)
            or (listed and all(v in kinds for v in value))
        ):
            accepted = ", ".join(str(w).lower() for w in words)
            raise ValueError(f"must be {accepted}" + (" or a list of " + ", ".join(kinds) if kinds else ""))
        return value

    return BeforeValidator(check)


def number_or_three(value: object) -> object:
    """Return a number, or a list of three. Raises ValueError."""
    items = value if isinstance(value, (list, tuple)) else [value]
    try:
        ok = (
            len(items) in ((3,) if items is value else (1,))
            and not any(isinstance(v, bool) for v in items)
            and [float(v) for v in items]
        )
    except (TypeError, ValueError):
        ok = False
    if not ok:
        raise ValueError("must be a number or a list of three")
    return value


def parameter_value(value: object) -> object:
    """Return a word unchanged, for the primitive to check, and a number as a number (YAML 1.1 reads 1e-1 as text)."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return number_or_three(value)


def greater_than_zero(value: Any) -> object:
    """Return a number or a tuple of them, each in (0, 1e9]. Raises ValueError."""
    values = value if isinstance(value, tuple) else (value,)
    if min(values) <= 0 or max(values) > 1e9:
        raise ValueError("must be greater than 0 and at most 1e9")
    return value


Positive = Annotated[float, Field(gt=0, le=1e9)]


Fraction = Annotated[float, Field(ge=0, le=1)]


PositiveRange = Annotated[tuple[Positive, Positive], BeforeValidator(as_pair), AfterValidator(ordered)]


Paths = Annotated[tuple[str, ...], BeforeValidator(_as_list)]


Vector3 = tuple[float, float, float]


# At 1e9 units float64 still resolves 1e-7 units; a larger value has the wrong unit, and would
# overflow float32 matrices.
Coordinate = Annotated[float, Field(ge=-1e9, le=1e9)]


Position = tuple[Coordinate, Coordinate, Coordinate]


Color = tuple[Radiance, Radiance, Radiance]
