"""``tracks:`` of the YAML: points on surfaces that are followed through the sequence (:mod:`blinkgl.render.tracks`)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from blinkgl.config.base import Config, Refused

MAX_POSITIONS = 50_000_000
"""Points times times: what is held in memory."""


class TracksConfig(Config):
    """Points on surfaces, followed: where each is in the image and in the world, and whether it is seen, in
    tracks.npz."""

    points: int = Field(256, ge=1, le=1_000_000, description="how many, at most")
    choose: Literal["grid", "surface"] = Field(
        "grid",
        description="grid: what the pixels of a regular grid see at the first time; surface: places drawn evenly on "
        "the bodies' surfaces, of which those are kept that are ever seen",
    )
    rate: float | None = Field(
        None,
        gt=0,
        le=1e5,
        description="positions per second, Hz, from the first label's time on; null: at the labels' times",
    )


def track_times(rate: float | None, first_ns: int, end_ns: int, interval_ns: int) -> range:
    """Times of positions, ns: from the first label's on, one ``rate`` apart (None: a label interval)."""
    return range(first_ns, end_ns + 1, interval_ns if rate is None else max(1, round(1e9 / rate)))


def check_tracks(points: int, rate: float, seconds: float) -> None:
    """Raises Refused, where ``tracks:`` stands, for more positions than are held."""
    count = seconds * rate + 1
    if points * count > MAX_POSITIONS:
        raise Refused(
            f"{points * count:.3g} positions",
            where="tracks.points",
            value=points,
            accepted=f"at most {max(1, int(MAX_POSITIONS / count))} at {count:.0f} times, or a lower rate",
        )
