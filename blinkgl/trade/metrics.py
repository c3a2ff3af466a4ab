"""How wrong a stream of events is, judged by another one of the same scene, sensor and thresholds.

Everything looks at the same window [t0, t1) and the same pixels; what lies outside is not judged.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from blinkgl.events.grids import masked, voxel_grid
from blinkgl.trade.matching import match_events
from blinkgl.types.events import Events

BINS = 15
"""Of a clip's voxel grid."""


@dataclass(frozen=True)
class EventErrors:
    """Errors of a stream against the reference. Times are absolute differences of matched events.

    time_*_us : µs.
    shift_*_px : the same times the image speed at the event's pixel and time: how far the edge is from where it should
    have been.
    missed, extra : events without a partner, relative to the reference's count.
    count : events relative to the reference's count, minus 1.
    voxel : ||V - V_ref|| / ||V_ref|| of signed 15-bin voxel grids.
    NaN where there is nothing to judge by."""

    events: int
    reference_events: int
    time_median_us: float
    time_p95_us: float
    shift_median_px: float
    shift_p95_px: float
    missed: float
    extra: float
    voxel: float

    @property
    def count(self) -> float:
        return self.events / self.reference_events - 1 if self.reference_events else float("nan")

    @property
    def wrong(self) -> float:
        """Missed and extra events together."""
        return self.missed + self.extra

    def to_dict(self) -> dict[str, float]:
        return {**asdict(self), "count": self.count, "wrong": self.wrong}


@dataclass(frozen=True, eq=False)
class SpeedMaps:
    """Image speed, px/s, at some times. times_us : (K,) increasing.   speed : (K, H, W) float32."""

    times_us: np.ndarray
    speed: np.ndarray

    def at(self, x: np.ndarray, y: np.ndarray, t: np.ndarray) -> np.ndarray:
        """(N,) float32, from the map nearest in time."""
        middle = (self.times_us[:-1] + self.times_us[1:]) / 2
        return self.speed[np.searchsorted(middle, t), y, x]


def event_errors(
    reference: Events,
    judged: Events,
    speeds: SpeedMaps,
    t0_us: int,
    t1_us: int,
    *,
    limit_us: int,
    mask: np.ndarray | None = None,
) -> EventErrors:
    """Errors of ``judged`` in [t0_us, t1_us); mask : (H, W) bool, the pixels that count (default: all).

    limit_us : longest distance between partners; see :func:`blinkgl.trade.matching.match_events`."""
    height, width = speeds.speed.shape[1:]
    mine, theirs = (e.window(t0_us, t1_us) for e in (judged, reference))
    if mask is not None:
        mine, theirs = masked(mine, mask), masked(theirs, mask)
    matching = match_events(theirs, mine, height, width, limit_us)
    found = matching.matched
    late = np.abs(matching.dt_us[found])
    shift = late * 1e-6 * speeds.at(theirs.x[found], theirs.y[found], theirs.t[found])
    total = len(theirs)
    share = lambda n: n / total if total else float("nan")
    true = voxel_grid(theirs, t0_us, t1_us, height, width, BINS)
    norm = float(np.linalg.norm(true))
    difference = float(np.linalg.norm(voxel_grid(mine, t0_us, t1_us, height, width, BINS) - true))
    return EventErrors(
        len(mine),
        total,
        *_spread(late),
        *_spread(shift),
        share(total - int(found.sum())),
        share(matching.extra),
        difference / norm if norm else float("nan"),
    )


def _spread(values: np.ndarray) -> tuple[float, float]:
    """Median and 95th percentile; NaN of nothing."""
    return tuple(float(v) for v in np.percentile(values, (50, 95))) if len(values) else (float("nan"),) * 2
