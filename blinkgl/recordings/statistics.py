"""Statistics by which a calibration compares two event streams of one scene: sums over the pixels, and from them a
vector of numbers, each with its expected error.

Sums are kept per group of pixels, so that leaving each group out in turn (the jackknife, Quenouille 1956; Tukey 1958)
tells how much every number, and anything computed from them, would vary in another recording of the same kind.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.recordings.bursts import inside_any
from blinkgl.recordings.clip import TILE_PX, Clip
from blinkgl.recordings.comparison import BLUR_PX, histogram_distance
from blinkgl.recordings.patches import LEAST_IN_PATCH, LEAST_PATCHES, NAMES, SIDE_PX, patches
from blinkgl.types.events import Events

GROUPS = 16
"""Number of groups of tiles, for the jackknife."""
ISI_PER_DECADE = 40
ISI_BINS = 7 * ISI_PER_DECADE
"""Bins of the interval between two events of a pixel, from 1 µs."""
COUNTS = np.array([0, 1, 2, 3, 4, 6, 9, 14, 21, 31, 101, 1001])
"""Lower ends of the bins of a pixel's number of events."""
LIGHTS = 8
PROBES = np.array([0.005, 0.01, 0.02, 0.05, *np.arange(0.1, 0.95, 0.1), 0.95, 0.98])
"""Quantiles of the recording's intervals at which the two distributions are compared."""
LEAST_STILL = 400
"""px; fewer do not determine noise."""


@dataclass(frozen=True, eq=False)
class GroupSums:
    """Of the intervals [first, stop) of a clip; the first axis is the group. What lies in a burst that the camera's
    frames set off is left out on both sides.

    rates : (G, K, 2) events by interval and polarity (OFF, ON), of pixels that saw a change.
    lights : (G, 8, 2) the same by brightness.
    isi : (G, 2, bins) intervals between a pixel's events without a burst between them, by whether the second event is
    of the other polarity.
    counts : (G, C) pixels and intervals by number of events.
    still, still_counts : (G, 2), (G, C) of pixels that saw no change, over all intervals.
    products : (G, 3) sums of a*b, a*a, b*b of polarity sums a with the recording's b.
    pixels : (G, 2) number of pixels that saw a change, and that did not.
    polarity : (K, H*W) float32, polarity sums, blurred by a pixel.   both : (H*W,) a pixel's events.
    alike : (G, 6) pixels and sums of a, b, a*b, a*a, b*b of ``both`` with the recording's.
    looks : (G, 2 F + 1) of the recording's patches with enough events: their number, and sums and sums of squares of
    their F features (:mod:`~blinkgl.recordings.patches`).   full : (T, Y, X) bool, these patches."""

    rates: np.ndarray
    lights: np.ndarray
    isi: np.ndarray
    counts: np.ndarray
    still: np.ndarray
    still_counts: np.ndarray
    products: np.ndarray
    pixels: np.ndarray
    polarity: np.ndarray
    both: np.ndarray
    alike: np.ndarray
    looks: np.ndarray
    full: np.ndarray
    seconds: np.ndarray

    def without(self, group: int | None) -> list[np.ndarray]:
        """Return the totals over the groups, without one."""
        keep = np.arange(GROUPS) != (-1 if group is None else group)
        parts = (self.rates, self.lights, self.isi, self.counts, self.still, self.still_counts, self.products,
                 self.pixels, self.alike, self.looks)  # fmt: skip
        return [part[keep].sum(axis=0) for part in parts]


def sums(events: Events, clip: Clip, first: int, stop: int, against: GroupSums | None = None) -> GroupSums:
    """Return the sums of a stream of events of the clip's scene in its intervals [first, stop).

    against : the recording's; None: it is the recording itself."""
    height, width = clip.size
    count = stop - first
    group = groups(clip.size)
    total = np.zeros((count, height * width, 2), np.int32)  # a hot pixel has more than 2^15 in minutes
    isi = np.zeros((GROUPS, 2, ISI_BINS), np.int64)
    span_us = int(clip.edges_us[first]), int(clip.edges_us[stop])
    part = events.window(*span_us)
    part = part.part(~inside_any(part.t, clip.bursts))
    where = part.pixel(width)
    _collect(where, part.t, part.p, clip.edges_us[first : stop + 1], clip.bursts, group, total, isi)
    used, still = clip.used.ravel(), clip.still.ravel()
    moving = used & ~still
    on_group = np.where(moving, group, GROUPS)
    # Group GROUPS is the bin of the pixels that do not count; _by drops it.
    per_pixel = total.sum(axis=2)
    rates = np.stack([_by(on_group, total[k, :, p]) for k in range(count) for p in (0, 1)], 1).reshape(GROUPS, count, 2)
    both = total.sum(axis=0, dtype=np.int64)
    light, of_both = clip.light.ravel(), lambda groups: np.stack([_by(groups, both[:, p]) for p in (0, 1)], 1)
    lights = np.stack([of_both(np.where(light == part, on_group, GROUPS)) for part in range(LIGHTS)], 1)
    counts = _histogram(per_pixel[:, moving], np.broadcast_to(group[moving], (count, int(moving.sum()))))
    still_counts = _histogram(both.sum(axis=1)[still], group[still])
    quiet = of_both(np.where(still, group, GROUPS))
    raw = (total[..., 1] - total[..., 0]).reshape(count, height, width).astype(np.float32)
    # Quantisation and sub-pixel shifts are not compared, as in `compare`.
    polarity = np.stack([cv2.GaussianBlur(one, (0, 0), BLUR_PX).ravel() for one in raw])
    other = polarity if against is None else against.polarity
    # GroupSums of products, not correlations, since only sums can be added over groups, and without one of them.
    pairs = ((polarity, other), (polarity, polarity), (other, other))
    products = np.stack([_by(on_group, np.einsum("kn,kn->n", x, y)) for x, y in pairs], 1)
    pixels = np.stack([_by(on_group, np.ones(len(group))), _by(np.where(still, group, GROUPS), np.ones(len(group)))], 1)
    seconds = np.diff(clip.edges_us[first : stop + 1]) * 1e-6
    mine = both.sum(axis=1)
    theirs = mine if against is None else against.both
    moments = (used, mine, theirs, mine * theirs, mine * mine, theirs * theirs)
    alike = np.stack([_by(np.where(used, group, GROUPS), each.astype(np.float64)) for each in moments], 1)
    looks, full = _looks(part, clip.size, span_us, None if against is None else against.full)
    return GroupSums(
        rates=rates,
        lights=lights,
        isi=isi,
        counts=counts,
        still=quiet,
        still_counts=still_counts,
        products=products,
        pixels=pixels,
        polarity=polarity,
        both=mine,
        alike=alike,
        looks=looks,
        full=full,
        seconds=seconds,
    )


def _looks(
    events: Events, size: tuple[int, int], span_us: tuple[int, int], full: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``GroupSums.looks`` and (T, Y, X) bool, the patches that count (full: where that is known)."""
    count, numbers = patches(events, size, span_us)
    full = count >= LEAST_IN_PATCH if full is None else full
    side = TILE_PX // 2
    # The group of the tile in which each patch lies, as in ``groups``.
    rows, columns = (np.arange(n) * SIDE_PX // side for n in full.shape[1:])
    group = np.broadcast_to((rows[:, None] * 7 + columns * 3) % GROUPS, full.shape)[full]
    values = numbers[full].astype(np.float64)
    parts = np.concatenate([np.ones((len(values), 1)), values, values * values], axis=1)
    return np.stack([_by(group, column) for column in parts.T], 1), full


def groups(size: tuple[int, int]) -> np.ndarray:
    """Return the group of every pixel, (H*W,) int64: tiles scattered over the image, neither rows nor columns."""
    y, x = np.divmod(np.arange(size[0] * size[1]), size[1])
    side = TILE_PX // 2
    # 7 and 3 have no factor in common with 16, so a row or a column of tiles passes through all groups.
    return ((y // side) * 7 + (x // side) * 3) % GROUPS


def _by(group: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.bincount(group, values, minlength=GROUPS + 1)[:GROUPS]


def _histogram(counts: np.ndarray, group: np.ndarray) -> np.ndarray:
    bins = np.searchsorted(COUNTS, counts, side="right") - 1
    # A histogram over groups and bins in one: the number of a cell is group * bins + bin.
    flat = np.bincount((group * len(COUNTS) + bins).ravel(), minlength=GROUPS * len(COUNTS))
    return flat.reshape(GROUPS, len(COUNTS)).astype(np.float64)


@kernel
def _collect(where, t, p, edges, bursts, group, total, isi):
    """Counts by interval, pixel and polarity, and the histogram of the intervals between a pixel's events, of those
    without a burst between them, in which there may have been another."""
    pixels = total.shape[1]
    last = np.full(pixels, -1, np.int64)
    before = np.zeros(pixels, np.uint8)
    k, burst, quiet_since = 0, 0, edges[0]
    for i in range(len(t)):
        while t[i] >= edges[k + 1]:
            k += 1
        j = where[i]
        total[k, j, p[i]] += 1
        # Events within bursts were removed, so an interval across one may lack events; only pairs since the last
        # burst count.
        while burst < len(bursts) and t[i] >= bursts[burst, 1]:
            quiet_since = bursts[burst, 1]
            burst += 1
        now = t[i] - edges[0]
        if last[j] >= 0 and last[j] + edges[0] >= quiet_since:
            # 1e-9, because the logarithm of a power of ten may be rounded down.
            b = min(int(ISI_PER_DECADE * np.log10(max(now - last[j], 1)) + 1e-9), ISI_BINS - 1)
            isi[group[j], int(before[j] != p[i]), b] += 1
        last[j], before[j] = now, p[i]


@dataclass(frozen=True, eq=False)
class Target:
    """A recording's numbers, for comparison with a simulation's.

    values : (N,).   chance : (N,), standard deviation of each, of the recording and of a simulation.
    floor : (N,), further error of a model.   weight : (N,), of a number's block.
    jackknife : (G, N), differences without each group.   block : (N,) of names.
    spread : (F,), of the features of the recording's patches.
    together : rates of ON and OFF events of moving pixels in one number."""

    sums: GroupSums
    probes: np.ndarray
    values: np.ndarray
    chance: np.ndarray
    floor: np.ndarray
    weight: np.ndarray
    jackknife: np.ndarray
    block: np.ndarray
    spread: np.ndarray
    together: bool = False

    @property
    def error(self) -> np.ndarray:
        return np.hypot(self.chance, self.floor)

    def residual(self, simulated: GroupSums) -> np.ndarray:
        """Return the residuals, (N,), in errors, times the weights."""
        return self.weight * (self._numbers(simulated) - self.values) / self.error

    def _numbers(self, of: GroupSums, without: int | None = None) -> np.ndarray:
        return numbers(of, self.probes, self.spread, without, self.together)[0]

    def beside(self, simulated: GroupSums, *, floor: str) -> Target:
        """Return the target with errors from a simulation near the recording. Chance: the jackknife of the differences,
        in which the common scene cancels.

        floor : "expected": ``FLOOR``.   "lowest": a tenth of it, as for an exact model.   "seen": the simulation's
        error beyond chance, block by block, between the two."""
        value = lambda without: self._numbers(simulated, without) - self._numbers(self.sums, without)
        jackknife = np.stack([value(group) for group in range(GROUPS)])
        # The jackknife's variance: its values differ by a (G - 1)-th of what independent groups would.
        chance = np.sqrt((GROUPS - 1) / GROUPS * ((jackknife - jackknife.mean(axis=0)) ** 2).sum(axis=0))
        most = np.array([FLOOR[b] for b in self.block])
        floors = most * (LOWEST if floor == "lowest" else 1.0)
        # What chance does not explain of a difference is the model's own error.
        off = value(None) ** 2 - chance**2
        for name in set(self.block.tolist()) if floor == "seen" else ():
            here = self.block == name
            beyond = np.sqrt(max(float(np.mean(off[here])), 0.0))
            floors[here] = np.clip(beyond, most[here] * LOWEST, most[here])
        return replace(self, chance=chance, floor=floors, jackknife=jackknife)


class Targets:
    """Several recordings by one camera: their numbers one after another."""

    def __init__(self, each: list[Target]):
        self._each = each

    def beside(self, simulated: list[GroupSums], *, floor: str) -> None:
        """Use errors as in :meth:`Target.beside` from now on."""
        self._each = [one.beside(of, floor=floor) for one, of in zip(self._each, simulated)]

    def residual(self, simulated: list[GroupSums]) -> np.ndarray:
        return np.concatenate([one.residual(of) for one, of in zip(self._each, simulated)])

    @property
    def sums(self) -> list[GroupSums]:
        return [one.sums for one in self._each]

    def _joined(self, name: str) -> np.ndarray:
        return np.concatenate([getattr(one, name) for one in self._each], axis=-1)

    values = property(lambda self: self._joined("values"))
    chance = property(lambda self: self._joined("chance"))
    weight = property(lambda self: self._joined("weight"))
    error = property(lambda self: self._joined("error"))
    jackknife = property(lambda self: self._joined("jackknife"))


WEIGHTS = {"rate": 3.0, "light": 3.0, "interval": 5.0, "turn": 1.0, "count": 2.0, "still": 2.0, "still count": 2.0,
           "polarity": 2.0, "alike": 4.0, "look": 2.0, "total": 3.0}  # fmt: skip
"""Weights of the blocks: rates and intervals matter most in the use of a simulation."""
FLOOR = {"rate": 0.02, "light": 0.05, "interval": 0.01, "turn": 0.02, "count": 0.01, "still": 0.05, "still count": 0.01,
         "polarity": 0.02, "alike": 0.02, "look": 0.1, "total": 0.02}  # fmt: skip
"""Smallest error expected of a model: logarithms of rates, fractions of events or of pixels."""
LOWEST = 0.1
"""Factor on a floor, where the model turns out to be better."""


def target(recorded: GroupSums, together: bool = False) -> Target:
    """Return the target of the recording's sums, with floors as errors until a simulation is compared. together: see
    Target."""
    probes = _probes(recorded.isi.sum(axis=(0, 1)))
    spread = _spread(recorded.looks.sum(axis=0))
    values, block = numbers(recorded, probes, spread, together=together)
    floor = np.array([FLOOR[b] for b in block])
    sizes = {b: max(np.count_nonzero(block == b), 1) for b in FLOOR}
    # A block weighs the same in the sum of squares, however many numbers it has.
    weight = np.array([WEIGHTS[b] / np.sqrt(sizes[b]) for b in block])
    chance, jackknife = np.zeros(len(values)), np.zeros((GROUPS, len(values)))
    return Target(
        sums=recorded,
        probes=probes,
        values=values,
        chance=chance,
        floor=floor,
        weight=weight,
        jackknife=jackknife,
        block=block,
        spread=spread,
        together=together,
    )


def _spread(looks: np.ndarray) -> np.ndarray:
    """Return standard deviations of the patches' features, from ``GroupSums.looks``."""
    count, features = max(looks[0], 1), len(NAMES)
    mean, square = looks[1 : 1 + features] / count, looks[1 + features :] / count
    return np.sqrt(np.maximum(square - mean**2, 1e-6))


def correlation(alike: np.ndarray) -> float:
    """Return Pearson's correlation of the events of single pixels, from ``GroupSums.alike``; 0 where one of them is
    constant."""
    n, a, b, product, square_a, square_b = alike
    norm = np.sqrt(max(n * square_a - a * a, 0.0) * max(n * square_b - b * b, 0.0))
    return float((n * product - a * b) / norm) if norm > 0 else 0.0


def _probes(isi: np.ndarray) -> np.ndarray:
    """Return the bins at which the recording's distribution of intervals passes the PROBES, and the one before its
    first."""
    if not isi.sum():
        return np.empty(0, np.int64)
    cdf = np.cumsum(isi) / isi.sum()
    places = np.searchsorted(cdf, PROBES)
    # The one before the first tells whether a simulation has shorter intervals than the camera ever has.
    return np.unique(np.concatenate([places, [max(places[0] - 2, 0)]]))


def numbers(
    s: GroupSums, probes: np.ndarray, spread: np.ndarray, without: int | None = None, together: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) numbers of a stream, and the block name of each. spread, together: see Target."""
    rates, lights, isi, counts, still, still_counts, products, pixels, alike, looks = s.without(without)
    values, block = [], []

    def add(name: str, more: np.ndarray | float) -> None:
        values.append(np.ravel(more))
        block.extend([name] * np.size(more))

    if together:
        rates, lights = (part.sum(axis=-1, keepdims=True) for part in (rates, lights))
    if pixels[0] >= LEAST_STILL:
        seconds = s.seconds[:, None] * pixels[0]
        # One event must not decide about an empty interval: 1, 2 or 4 are added before each logarithm.
        add("rate", np.log((rates + 1) / seconds))
        add("rate", np.log((rates.sum(axis=0) + 1) / seconds.sum()))
        add("total", np.log((rates.sum() + 1) / seconds.sum()))
        add("light", np.log((lights + 4) / (s.seconds.sum() * pixels[0])))
        # The last entry of a cumulative distribution is always 1.
        add("count", (np.cumsum(counts) / max(counts.sum(), 1))[:-1])
        norm = np.sqrt(products[1] * products[2])
        add("polarity", products[0] / norm if norm > 0 else 0.0)
        add("alike", correlation(alike))
        if s.looks[:, 0].sum() >= LEAST_PATCHES:
            add("look", looks[1 : 1 + len(NAMES)] / max(looks[0], 1) / spread)
    if len(probes):
        total = isi.sum()
        add("interval", (np.cumsum(isi.sum(axis=0)) / max(total, 1))[probes])
        add("turn", isi[1].sum() / max(total, 1))
    if pixels[1] >= LEAST_STILL:
        add("still", np.log((still + 2) / (s.seconds.sum() * pixels[1])))
        # Of the pixels that fired: most never do, and would hide the others' distribution.
        add("still count", (np.cumsum(still_counts[1:]) / max(still_counts[1:].sum(), 1))[:-1])
        add("still count", np.log((still_counts[1:].sum() + 2) / pixels[1]) / 5)
    return np.concatenate(values) if values else np.empty(0), np.array(block)


def interval_distance(a: GroupSums, b: GroupSums) -> float:
    """Return the Kolmogorov-Smirnov distance of the intervals between events of a pixel."""
    return histogram_distance(*(s.isi.sum(axis=(0, 1)) for s in (a, b)))
