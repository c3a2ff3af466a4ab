"""Errors of an event stream relative to a reference of the same scene, sensor and thresholds.

All measures use the same window [t0, t1) and the same pixels; the rest is ignored.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from blinkgl.events.grids import masked, voxel_grid
from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene
from blinkgl.tools.trade.matching import match_events
from blinkgl.types.events import Events

BINS = 15
"""Bins of a clip's voxel grid."""


@dataclass(frozen=True)
class EventErrors:
    """Errors of a stream against the reference. Times are absolute differences of matched events.

    time_*_us : µs.
    shift_*_px : the same times the image speed at the event's pixel and time: the distance of the edge from its correct
    position.
    missed, extra : events without a partner, relative to the reference's count.
    count : events relative to the reference's count, minus 1.
    voxel : ||V - V_ref|| / ||V_ref|| of signed 15-bin voxel grids.
    NaN where there is nothing to compare."""

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
        """Return missed plus extra events."""
        return self.missed + self.extra

    def to_dict(self) -> dict[str, float]:
        return {**asdict(self), "count": self.count, "wrong": self.wrong}


@dataclass(frozen=True, eq=False)
class SpeedMaps:
    """Image speed, px/s, at some times. times_us : (K,) increasing.   speed : (K, H, W) float32."""

    times_us: np.ndarray
    speed: np.ndarray

    def at(self, x: np.ndarray, y: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return (N,) float32 speeds from the map nearest in time."""
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
    """Return the errors of ``judged`` in [t0_us, t1_us); mask : (H, W) bool, the pixels that count (default: all).

    limit_us : longest distance between partners; see :func:`blinkgl.tools.trade.matching.match_events`."""
    height, width = speeds.speed.shape[1:]
    mine, theirs = (e.window(t0_us, t1_us) for e in (judged, reference))
    if mask is not None:
        mine, theirs = masked(mine, mask), masked(theirs, mask)
    matching = match_events(theirs, mine, height, width, limit_us)
    paired = matching.matched
    late = np.abs(matching.dt_us[paired])
    shift = late * 1e-6 * speeds.at(theirs.x[paired], theirs.y[paired], theirs.t[paired])
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
        share(total - int(paired.sum())),
        share(matching.extra),
        difference / norm if norm else float("nan"),
    )


def _spread(values: np.ndarray) -> tuple[float, float]:
    """Return the median and the 95th percentile; NaN for no values."""
    middle, high = np.percentile(values, (50, 95)) if len(values) else (np.nan, np.nan)
    return float(middle), float(high)


# ---------------------------------------------------------------------------------------------------------------------
# Errors of a setting's flow labels, by casting float64 rays into the exact scene at a sample of pixels.

PIXELS = 300
_AROUND = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)], float)


def flow_errors(scene: Scene, renderer: Renderer, t_ns: int, t_next_ns: int) -> dict[str, float]:
    """Return the error of the forward flow in px, median and maximum, over ``PIXELS`` random pixels off silhouettes;
    NaN where there are none.

    scene : the scene with all its triangles, also where the renderer draws simplified ones. A pixel counts where it and
    its four neighbours see one instance, the renderer sees the same one, and the flow is valid on both sides."""
    height, width = renderer.height, renderer.width
    rng = np.random.default_rng(0)
    xy = np.stack([rng.integers(0, width, PIXELS), rng.integers(0, height, PIXELS)], axis=1)
    hits = casting.cast(scene, t_ns, (xy[:, None] + _AROUND).reshape(-1, 2))
    # Column 0 is the pixel itself, the others are its four neighbours.
    ids = hits.instance.reshape(PIXELS, len(_AROUND))
    exact = casting.flow_to(scene, hits, t_next_ns)
    flow, valid = exact.flow.reshape(PIXELS, len(_AROUND), 2)[:, 0], exact.valid.reshape(PIXELS, -1)[:, 0]
    ours = renderer.labels(t_ns, LabelRequest("ids", "flow_forward"), t_next_ns)
    assert ours.forward is not None
    x, y = xy.T
    counts = (
        (ids == ids[:, :1]).all(axis=1)
        & (ids[:, 0] > 0)
        & (ours.ids[y, x] == ids[:, 0])
        & valid
        & ours.forward.valid[y, x]
    )
    error = np.hypot(*(ours.forward.flow[y, x] - flow)[counts].T)
    return {
        "flow_median_px": float(np.median(error)) if len(error) else float("nan"),
        "flow_max_px": float(error.max(initial=0)) if len(error) else float("nan"),
    }
