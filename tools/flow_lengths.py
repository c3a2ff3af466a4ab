"""How long is a network's flow beside the true one, where flow is short and where it is long?

    eflow render configs/eflow/real_data.yaml --out out/lengths -n 500 --split test --seed 99 --per-sequence 4 \\
        --window-ms 1.5-100 --max-flow 24 --min-density 0.008
    python -m blinkgl.tools.flow_lengths real_small out/lengths
    python -m blinkgl.tools.flow_lengths real_small out/lengths --changed   # the error of mirrored, thinned … windows

Two tables of medians, each of the network's flow as it is and as `eflow predict` refines it:
over the windows of a rendered pool, by their true length; and over pans across photographs (one velocity everywhere,
three speeds, three emulators), by the length of a window. At pixels with events. ``--changed`` prints three tables of
errors over all pixels, as shares of zero flow's: of each view; of thinned windows beside others with so few events; of
tripled ones by the length of their flow.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from blinkgl.machine.terminal import plain_console, say
from blinkgl.tools.real_recordings import PANS, of_pans, table
from eflow.checkpoint import load_model
from eflow.data.sources import open_source
from eflow.data.window import RawSample, StreamWindow, hit_pixels
from eflow.infer import Predictor, default_views
from eflow.models import FlowModel

BINS = (0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 24.0)
"""Edges of the bins of true length, px."""
LEAST_EVENTS = 50
Judged = tuple[float, float, float, float, float]
"""True length; predicted over true length and error over true length, of the flow as it is and refined."""


def of_pool(path: str) -> Iterator[tuple[RawSample, np.ndarray]]:
    """Pairs of windows and their true flow, (H, W, 2) px, NaN where there is none."""
    source = open_source(path)
    for i in range(len(source)):
        sample = source[i]
        assert sample.flow is not None and sample.valid is not None
        yield sample, np.where(sample.valid[..., None], sample.flow, np.nan)


def enlarged(sample: RawSample, factor: int) -> RawSample:
    """The same events on a sensor of ``factor`` times the rows and columns, and the flow that they have there."""
    apart = lambda w: replace(w, x=w.x * factor, y=w.y * factor)
    larger = lambda a: a.repeat(factor, 0).repeat(factor, 1)
    return replace(
        sample,
        old=apart(sample.old),
        new=apart(sample.new),
        height=sample.height * factor,
        width=sample.width * factor,
        flow=larger(sample.flow) * factor,
        valid=larger(sample.valid),
    )


THINNED, TRIPLED = "5 % of the events", "coordinates tripled"
DENSITIES = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0)
"""Edges of the bins of events per pixel."""
CHANGED: dict[str, Callable[[RawSample], RawSample]] = {
    "as it is": lambda s: s,
    "mirrored": lambda s: s.flip("x"),
    "upside down": lambda s: s.flip("y"),
    "transposed": lambda s: s.transpose(),
    "time reversed": lambda s: s.reverse(),
    "polarity swapped": lambda s: s.invert(),
    THINNED: lambda s: s.drop(0.95, np.random.default_rng(0)),
    "noise of 3 /s/px": lambda s: s.noise(3.0, np.random.default_rng(0)),
    "coordinates doubled": lambda s: enlarged(s, 2),
    TRIPLED: lambda s: enlarged(s, 3),
}


def of_changed(model: FlowModel, path: str, limit: int) -> list[list[list[object]]]:
    """Rows of three tables of the windows of a pool. Errors are over all pixels with truth, as shares of zero flow's.

    Each view: error and zero flow's, px, their ratio, and that beside the ratio of the windows as they are. Windows as
    they are and thinned, by events per pixel: whether thinned ones are worse than others with so few events. Windows
    tripled, by the length of the flow before it: whether they are worse than others with such flow."""
    source = open_source(path)
    samples = [source[int(i)] for i in np.linspace(0, len(source) - 1, min(limit, len(source))).round().astype(int)]
    samples = [s for s in samples if s.valid is not None and s.valid.any()]
    errors = {name: np.array([_error(model, view(s)) for s in samples]) for name, view in CHANGED.items()}
    plain, thin, tripled = (errors[name] for name in ("as it is", THINNED, TRIPLED))
    share = lambda of: float(of[:, 0].mean() / of[:, 1].mean()) if len(of) else float("nan")
    views = [[n, *e.mean(0)[:2].tolist(), share(e), share(e) / share(plain)] for n, e in errors.items()]
    density, length = [], []
    for low, high in itertools.pairwise(DENSITIES):
        some = [of[(of[:, 2] >= low) & (of[:, 2] < high)] for of in (plain, thin)]
        density.append([f"{low:g} to {high:g}", *(value for of in some for value in (len(of), share(of)))])
    for low, high in itertools.pairwise((0.0, *BINS[2:])):
        inside = (plain[:, 1] >= low) & (plain[:, 1] < high)
        length.append([f"{low:g} to {high:g} px", int(inside.sum()), share(plain[inside]), share(tripled[inside])])
    return [views, density, length]


def _error(model: FlowModel, s: RawSample) -> tuple[float, float, float]:
    """Error of a sample, and zero flow's, px; events per pixel of the new window."""
    predictor = Predictor(model, s.height, s.width)
    assert s.flow is not None and s.valid is not None
    flow, true = predictor(s)[0][s.valid], s.flow[s.valid]
    return np.hypot(*(flow - true).T).mean(), np.hypot(*true.T).mean(), len(s.new) / (s.height * s.width)


def judged(
    model: FlowModel, pairs: Iterable[tuple[StreamWindow | RawSample, np.ndarray]], views: int
) -> Iterator[Judged]:
    """Of every pair whose new window has events enough. views : of the refined flow."""
    for pair, truth in pairs:
        height, width = truth.shape[:2]
        hit = hit_pixels([pair.new], height, width) & np.isfinite(truth).all(-1)
        if len(pair.new) < LEAST_EVENTS or not hit.any():
            continue
        true, row = truth[hit], []
        size = np.hypot(*true.T)
        if not size.any():  # nothing moves: no length to compare
            continue
        for refine in (False, True):
            predictor = Predictor(model, height, width, refine=refine, views=views if refine else 1)
            flow = predictor(pair)[0][hit]
            row += [np.hypot(*flow.T).sum() / size.sum(), np.hypot(*(flow - true).T).sum() / size.sum()]
        share, error, sharp_share, sharp_error = map(float, row)
        yield float(np.median(size)), share, error, sharp_share, sharp_error


def rows_of(found: list[Judged], edges: Iterable[tuple[float, float]]) -> list[list[object]]:
    """A row of medians for each pair of edges."""
    table_of, values = [], np.array(found)
    for low, high in edges:
        inside = values[(values[:, 0] >= low) & (values[:, 0] < high)]
        if len(inside):
            table_of.append(
                [f"{low:g} to {high:g} px", len(inside), *np.median(inside[:, 1:], axis=0)[[0, 2, 1, 3]].tolist()]
            )
    return table_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", help="checkpoint, or a packaged network")
    parser.add_argument("pool", help="folder of `eflow render`")
    parser.add_argument("--changed", action="store_true", help="errors of changed windows in place of lengths")
    parser.add_argument("--limit", type=int, default=200, help="windows of the pool that --changed takes")
    options = parser.parse_args()
    model = load_model(options.network)
    if options.changed:
        heads = (
            ("view", ["error, px", "zero flow", "ratio", "to as it is"]),
            ("events per pixel", ["windows", "ratio", "windows, thinned", "ratio, thinned"]),
            ("mean flow", ["windows", "ratio", "ratio, tripled"]),
        )
        for (title, columns), rows in zip(heads, of_changed(model, options.pool, options.limit), strict=True):
            say(plain_console(), table(title, columns, rows) + "\n")
        return
    heads = ["windows", "length", "length, sharp", "error", "error, sharp"]
    views = default_views(options.network)
    pool = list(judged(model, of_pool(options.pool), views))
    say(plain_console(), table("true length", heads, rows_of(pool, itertools.pairwise(BINS))))
    pans = list(judged(model, of_pans(), views))
    near = [(0.9 * length, 1.1 * length) for length in PANS[2]]
    say(plain_console(), "\n" + table("pans", heads, rows_of(pans, near)))


if __name__ == "__main__":
    main()
