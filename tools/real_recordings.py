"""How well does a network, or a method, tell the motion in recordings of cameras?

    python -m blinkgl.tools.real_recordings real_small contrast-affine --recordings ../shared/data/events
    python -m blinkgl.tools.real_recordings real_small contrast-affine --recordings ../shared/data/events --bursts \\
        --sets out/independent/test

The first line is for choosing: of every recording but the two bursts with ground truth, up to ``--windows`` pairs of
windows, evenly spaced, of a length over which contrast maximisation's translation says about five px (the same windows
for all that are judged; of large sensors their middle). Beside each other, medians over windows:

| column | what it is |
|---|---|
| FWL | how much sharper the flow makes the events (Stoffregen et al., ECCV 2020); 1 is zero flow's |
| cosine, length | beside the affine field that makes the events sharpest (where its FWL > 1.1), at pixels with events |
| ms | processor time of a window, grids included |

``all`` is the median of the recordings that move (the affine field's FWL above 1.1). A slider's camera moves along the
image's x axis: ``x`` is the share of its flow along it.

The second line is for judging, and to be used seldom: the bursts' flow is known. AEE and cosine of the whole burst as
one window and (``halves``) of its second half, behind its first, beside zero flow's and the best constant and affine
flow (which know the truth); at pixels with events, and over all. ``NAME+refined`` is what `eflow predict` gives: the
mean over four views of the events, as long as makes the events sharpest. ``--changed`` adds their share of zero flow's
error when only a part of the events is left (means of ten draws), and when the burst lies in the middle of a larger
sensor.
``--sets`` adds the same table for data sets with labels (configs/eflow/independent_data.yaml is one): means over up to
``--windows`` samples of each, evenly spaced; ``--pans`` that of four photographs that pass by, of 0.5 to 6 px a window;
``--office`` that of a camera that pans over an office, beside the flow of its pictures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.io.frames import read_any_image
from blinkgl.io.images import read_npy
from blinkgl.machine.terminal import plain_console, say
from blinkgl.recordings.simulation import emulator_config, frames_to_events
from blinkgl.scene.surfaces.images import photographs
from blinkgl.types.events import Events
from eflow.checkpoint import load_model
from eflow.data.sources import open_source
from eflow.data.window import RawSample, StreamWindow, hit_pixels
from eflow.evaluate import best_motions
from eflow.infer import LIKELY_PX, Predictor, default_views
from eflow.methods.iwe import flow_warp_loss
from eflow.methods.table import METHODS, make_method

TEST = "ecd_rotation"
"""Folder of the bursts whose flow is known: the networks are judged by them and not tuned on them."""
REFINED = "+refined"
"""Behind a network's name: the mean over views, as long as makes the events sharpest, as `eflow predict` has it."""
MOVES = 1.1
"""FWL of the affine field from which on a window is said to move."""
LONGEST_MS = 120.0
MIDDLE = (260, 346)
"""Height and width, px, that are looked at of a large sensor."""
PANNED = "pans across photographs"
Answer = Callable[[StreamWindow | RawSample], np.ndarray]


def read(path: Path) -> tuple[Events, int, int]:
    """Events, height and width of a recording; evbench's .mat too (y and polarity turned over). Raises BlinkGLError."""
    if path.suffix != ".mat":
        with open_events(path) as file:
            sized = file.sized()
            assert sized.height is not None and sized.width is not None
            return sized.read(), sized.height, sized.width
    from scipy.io import loadmat

    with open(path, "rb") as file:
        table = {k: v.ravel() for k, v in loadmat(file).items() if k in ("ts", "x", "y", "pol")}
    t = table["ts"].astype(np.int64)
    columns = table["x"].astype(np.uint16), (179 - table["y"].astype(np.int64)).astype(np.uint16), t
    return Events(*columns, (1 - (table["pol"] > 0)).astype(np.uint8)), 180, 190


def recordings(root: Path) -> list[Path]:
    """Every file below ``root`` that is one, by folder."""
    endings = (".aedat4", ".aedat", ".raw", ".mat")
    text = ("events.txt", "events_chunk.txt")
    return sorted(p for p in root.rglob("*") if p.suffix in endings or p.name in text)


def looked_at(path: Path) -> tuple[Events, int, int]:
    """Events, height and width of a recording; of a large sensor its middle (:data:`MIDDLE`), where contrast
    maximisation takes seconds a window and not minutes. Raises BlinkGLError."""
    events, height, width = read(path)
    high, wide = min(height, MIDDLE[0]), min(width, MIDDLE[1])
    top, left = (height - high) // 2, (width - wide) // 2
    inside = (events.x >= left) & (events.x < left + wide) & (events.y >= top) & (events.y < top + high)
    part = events.part(inside)
    return Events(part.x - np.uint16(left), part.y - np.uint16(top), part.t, part.p), high, wide


def cut(events: Events, t: int, span: int) -> StreamWindow:
    """The pair of windows of ``span`` µs that meet at t."""
    return StreamWindow.of(events, t - span, t, t + span)


def answer_of(name: str, height: int, width: int, focal: float | None = None) -> Answer:
    """A network's or method's flow (H, W, 2) of a pair of windows, zero where there is nothing to go by."""
    if name == "zero":
        return lambda window: np.zeros((height, width, 2), np.float32)
    plain = name.removesuffix(REFINED)
    model = make_method(name, focal) if name in METHODS else load_model(plain)
    refine = plain != name
    predictor = Predictor(model, height, width, refine=refine, views=default_views(plain) if refine else 1)
    return lambda window: predictor(window)[0]


def reads_two(name: str) -> bool:
    """Whether it is a network that reads two windows, of a burst its halves."""
    return name not in METHODS and "old" in load_model(name.removesuffix(REFINED)).reads


def likely_span(events: Events, height: int, width: int) -> int:
    """Length, µs, over which the middle of the recording moves by about :data:`LIKELY_PX`, by contrast maximisation."""
    translation = answer_of("contrast-translation", height, width)
    t0, t1 = int(events.t[0]), int(events.t[-1]) + 1
    longest = int(min((t1 - t0) // 3, 1000 * LONGEST_MS))
    span = min(20_000, longest)
    for _ in range(3):
        speeds = []
        for place in (0.3, 0.5, 0.7):
            t = int(np.clip(t0 + place * (t1 - t0), t0 + span, t1 - span))
            speeds.append(float(np.hypot(*translation(cut(events, t, span))[0, 0])))
        span = int(np.clip(span * np.clip(LIKELY_PX / max(np.median(speeds), 1e-3), 0.4, 2.5), 1000, longest))
    return span


def judged(path: Path, names: list[str], most: int) -> dict[str, object]:
    """What a recording says of each: {"span_ms", "windows", "moves", "rows": {name: {...}}}."""
    events, height, width = looked_at(path)
    span = likely_span(events, height, width)
    t0, t1 = int(events.t[0]), int(events.t[-1]) + 1
    count = int(np.clip((t1 - t0 - span) // span, 1, most))
    pairs = [cut(events, int(t), span) for t in np.linspace(t0 + span, max(t1 - span, t0 + span), count)]
    pairs = [pair for pair in pairs if min(len(pair.old), len(pair.new)) >= 100]
    if not pairs:
        raise BlinkGLError("no windows with 100 events", where=str(path))
    affine = answer_of("contrast-affine", height, width)
    best = [affine(pair) for pair in pairs]
    sharp = [flow_warp_loss(pair.new, flow) for pair, flow in zip(pairs, best, strict=True)]
    rows = {}
    for name in names:
        answer = answer_of(name, height, width)
        answer(pairs[0])  # compiles
        began = time.process_time()
        flows = [answer(pair) for pair in pairs]
        spent = (time.process_time() - began) / len(pairs)
        cosines, lengths, along = [], [], []
        for pair, flow, other, fwl in zip(pairs, flows, best, sharp, strict=True):
            hit = hit_pixels([pair.new], height, width)
            mine, its = flow[hit].astype(np.float64), other[hit].astype(np.float64)
            sizes = np.hypot(*mine.T), np.hypot(*its.T)
            along.append(float(np.abs(mine[:, 0]).sum() / max(sizes[0].sum(), 1e-9)))
            if fwl > MOVES:
                cosines.append(float(np.median((mine * its).sum(1) / np.maximum(sizes[0] * sizes[1], 1e-9))))
                lengths.append(float(sizes[0].sum() / max(sizes[1].sum(), 1e-9)))
        middle = lambda values: float(np.median(values)) if values else float("nan")
        rows[name] = {
            "fwl": middle([flow_warp_loss(pair.new, flow) for pair, flow in zip(pairs, flows, strict=True)]),
            "cosine": middle(cosines),
            "length": middle(lengths),
            "x": middle(along),
            "ms": 1000 * spent,
        }
    size = f"{width}x{height}"
    return {"size": size, "span_ms": span / 1000, "windows": len(pairs), "moves": float(np.median(sharp)), "rows": rows}


class Burst(NamedTuple):
    """A burst with its flow, (H, W, 2) px, NaN where it is unknown, and the focal length of its camera, px."""

    events: Events
    truth: np.ndarray
    focal: float

    @classmethod
    def read(cls, folder: Path) -> Burst:
        """Return the burst of a folder. Raises BlinkGLError."""
        events, height, width = read(folder / "events.txt")
        focal = float((folder / "calib.txt").read_text().split()[0])
        return cls(events, np.moveaxis(read_npy(folder / "flow.npy").reshape(2, height, width), 0, -1), focal)

    @property
    def times(self) -> tuple[int, int, int]:
        """First time, middle and end, µs."""
        t0, t1 = int(self.events.t[0]), int(self.events.t[-1]) + 1
        return t0, (t0 + t1) // 2, t1


def burst(folder: Path, names: list[str]) -> dict[str, dict[str, float]]:
    """A burst with its flow, as one window, for each: AEE, its share of zero flow's, cosine (mean over pixels), all
    pixels and those with events; and what the best constant and affine flow would have."""
    events, truth, focal = known = Burst.read(folder)
    (height, width), (t0, middle, t1) = truth.shape[:2], known.times
    # A method's flow is over its new window, which must lie behind an old one.
    whole, halves = cut(events, t0, t1 - t0), cut(events, middle, t1 - middle)
    valid, hit = np.all(np.isfinite(truth), axis=-1), hit_pixels([whole.new], height, width)
    flows = best_of(truth, valid)
    for name in names:
        if name in METHODS:
            try:
                flows[name] = make_method(name, focal)(whole.old, whole.new, height, width)
            except BlinkGLError as error:
                print(f"{name}: {error}")
            continue
        answer = answer_of(name, height, width)
        if not reads_two(name):
            flows[name] = answer(whole)
        # The flow over the second half stands for the whole burst, as if its motion were even.
        flows[f"{name}, halves"] = answer(halves) * ((t1 - t0) / (t1 - middle))
    return {name: row_of([(np.asarray(flow, np.float64), truth, valid, hit)]) for name, flow in flows.items()}


SHARES = (1.0, 0.2, 0.1, 0.05)
SENSORS = ((294, 220), (394, 296), (537, 402), (640, 480), (1280, 720))
"""Width and height, px, of sensors in whose middle a burst is put: 1.5, 2.7, 5, 7 and 21 times its area."""
DRAWS = 10


def changed(folder: Path, names: list[str]) -> dict[str, dict[str, float]]:
    """AEE of a burst as a share of zero flow's, at its pixels with events, for each name: of a share of its events
    (:data:`SHARES`), and in the middle of larger sensors (:data:`SENSORS`). A network of two windows has the burst's
    halves."""
    events, truth, focal = known = Burst.read(folder)
    (height, width), (t0, middle, t1), rows = truth.shape[:2], known.times, {}

    def error(name: str, part: Events, wide: int, high: int) -> float:
        left, top = (wide - width) // 2, (high - height) // 2
        moved = Events(part.x + np.uint16(left), part.y + np.uint16(top), part.t, part.p)
        meet = middle if reads_two(name) else t0
        pair, factor = cut(moved, meet, t1 - meet), (t1 - t0) / (t1 - meet)
        flow = answer_of(name, high, wide, focal)(pair)[top : top + height, left : left + width] * factor
        hit = (
            np.isfinite(truth).all(-1)
            & hit_pixels((pair.old, pair.new), high, wide)[top : top + height, left : left + width]
        )
        return float(np.hypot(*(flow[hit] - truth[hit]).T).mean() / np.hypot(*truth[hit].T).mean())

    for name in names:
        rows[name] = {}
        for share in SHARES:
            draws = [np.random.default_rng(k).random(len(events)) < share for k in range(DRAWS if share < 1 else 1)]
            rows[name][f"{100 * share:g} %"] = float(
                np.mean([error(name, events.part(d), width, height) for d in draws])
            )
        for size in SENSORS:
            rows[name][f"{size[0]}x{size[1]}"] = error(name, events, *size)
    return rows


def best_of(truth: np.ndarray, valid: np.ndarray) -> dict[str, np.ndarray]:
    """Zero flow, and the best constant and affine flow, which know the truth (H, W, 2)."""
    median, affine = best_motions(truth, valid)
    return {
        "zero": np.zeros_like(truth),
        "best constant": np.broadcast_to(median, truth.shape),
        "best affine": affine,
    }


def row_of(judged: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]) -> dict[str, float]:
    """AEE, its share of zero flow's, cosine and length of (flow, truth, valid, pixels with events) of samples: means
    over samples, at pixels with events and over all."""
    row: dict[str, float] = {}
    for where in ("events", "all"):
        sums = []
        for flow, truth, valid, hit in judged:
            mask = valid & hit if where == "events" else valid
            if not mask.any():
                continue
            mine, its = flow[mask], truth[mask]
            size, length = np.hypot(*its.T), np.hypot(*mine.T)
            cosine = ((mine * its).sum(1) / np.maximum(length * size, 1e-9)).mean()
            sums.append((np.hypot(*(mine - its).T).mean(), size.mean(), cosine, length.mean()))
        error, size, cosine, length = np.mean(sums, axis=0) if sums else [np.nan] * 4
        row |= {f"aee_{where}": error, f"of_zero_{where}": error / size}
        row |= {f"cosine_{where}": cosine, f"length_{where}": length / size}
    return {key: float(value) for key, value in row.items()}


def of_set(path: Path, names: list[str], most: int) -> dict[str, dict[str, float]]:
    """The same of a data set with labels: its samples as pairs of windows, at most ``most``, evenly spaced."""
    source = open_source(path)
    samples = (source[int(i)] for i in np.unique(np.linspace(0, len(source) - 1, most).round().astype(int)))
    pairs = (
        (s, np.where(s.valid[..., None], s.flow, np.nan))
        for s in samples
        if s.flow is not None and s.valid is not None and s.valid.any()
    )
    return of_pairs(pairs, names, str(path))


def of_pairs(
    pairs: Iterable[tuple[StreamWindow | RawSample, np.ndarray]], names: list[str], where: str
) -> dict[str, dict[str, float]]:
    """The same of pairs of windows with their true flow, (H, W, 2) px, NaN where there is none."""
    answers: dict[str, Answer] = {}
    judged: dict[str, list] = {}
    for pair, flow in pairs:
        size = flow.shape[:2]
        valid = np.all(np.isfinite(flow), axis=-1)
        for name in names:
            answers.setdefault(name, answer_of(name, *size))
        hit, truth = hit_pixels((pair.old, pair.new), *size), np.where(valid[..., None], flow, 0.0).astype(np.float64)
        for name, flow_of in (best_of(truth, valid) | {name: answer(pair) for name, answer in answers.items()}).items():
            judged.setdefault(name, []).append((np.asarray(flow_of, np.float64), truth, valid, hit))
    if not judged:
        raise BlinkGLError("no labelled sample", where=where)
    return {name: row_of(rows) for name, rows in judged.items()}


PANS = ("astronaut", "gravel", "brick", "grass"), (40.0, 150.0, 600.0), (0.5, 1.0, 2.0, 4.0, 6.0)
"""Photographs; speeds, px/s; lengths of windows, px."""
EMULATORS = (
    {"emulator": "esim", "contrast_threshold": 0.2},
    {"emulator": "esim", "contrast_threshold": 0.5},
    {"emulator": "v2e"},
)
HEIGHT, WIDTH = 180, 240
DIRECTION = np.array([-0.825, -0.565])


def of_pans() -> Iterator[tuple[StreamWindow, np.ndarray]]:
    """Pairs of windows and their true flow, (H, W, 2) px, of photographs that move as one, at most half a pixel a
    frame."""
    files = photographs()
    for name, speed, emulator in itertools.product(*PANS[:2], EMULATORS):
        image = read_any_image(files[name])
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        soft = cv2.GaussianBlur(cv2.resize(grey, (512, 512)).astype(np.float32) / 255, (0, 0), 0.6)
        fps = max(100.0, 2 * speed)
        frames = []
        for k in range(int(13 / speed * fps) + 1):
            x, y = DIRECTION * speed * k / fps - 40
            moved = cv2.warpAffine(
                soft, np.array([[1, 0, x], [0, 1, y]], np.float32), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
            )
            frames.append(0.9 * moved**2.2 + 0.02)
        events = Events.concatenate([*frames_to_events(frames, fps=fps, emulator=emulator_config(emulator))])
        for length in PANS[2]:
            span = round(1e6 * length / speed)
            flow = np.broadcast_to(DIRECTION * speed * span * 1e-6, (HEIGHT, WIDTH, 2))
            yield cut(events, int(events.t[-1]) - 1000 - span, span), flow


OFFICE, FIRST_US, APART_US = "evbench_davis240", 44_000, 51_500
"""A camera that pans over an office; when its first picture was taken, after the first event, and the others."""
AGREE_PX = 0.3


def of_office(folder: Path, apart: int) -> Iterator[tuple[StreamWindow, np.ndarray]]:
    """Pairs of windows and their flow, (H, W, 2) px: OpenCV's DIS between the pictures at a window's ends, of which one
    is the ``apart``-th after the other; NaN where it is not the flow back."""
    events, height, width = read(folder / "seq_0001_e.mat")
    place = events.pixel(width)
    counts = np.bincount(place)
    events = events.part(counts[place] <= np.quantile(counts, 0.9998))  # without the stuck pixels
    pictures = [read_any_image(path) for path in sorted((folder / "frames").glob("*.png"))]
    # With finer patches the flow follows the pictures' noise: the best affine field leaves 0.28 of it instead of 0.13.
    dis, grid = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST), np.mgrid[:height, :width].astype(np.float32)
    flow_of = lambda one, other: dis.calc(one, other, np.empty(0))[:, :width]  # events are of fewer columns
    for k in range(apart, len(pictures) - apart, apart):
        there, back = (flow_of(*pair) for pair in itertools.permutations((pictures[k], pictures[k + apart])))
        moved = cv2.remap(back, grid[1] + there[..., 0], grid[0] + there[..., 1], cv2.INTER_LINEAR)
        agrees = np.hypot(*np.moveaxis(there + moved, -1, 0)) < AGREE_PX
        t = int(events.t[0]) + FIRST_US + APART_US * k
        yield cut(events, t, apart * APART_US), np.where(agrees[..., None], there, np.nan)


def table(title: str, heads: list[str], rows: list[list[object]]) -> str:
    """Markdown."""
    cell = lambda v: f"{v:.3g}" if isinstance(v, float) and np.isfinite(v) else "–" if isinstance(v, float) else str(v)
    lines = ["| " + " | ".join([title, *heads]) + " |", "|" + "---|" * (len(heads) + 1)]
    return "\n".join(lines + ["| " + " | ".join(map(cell, row)) + " |" for row in rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("answers", nargs="+", help=f"checkpoints, packaged networks, or {', '.join(METHODS)}")
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--windows", type=int, default=12, help="of a recording or a set, at most")
    parser.add_argument("--bursts", action="store_true", help=f"the recordings of {TEST}, whose flow is known")
    parser.add_argument("--changed", action="store_true", help="with --bursts: fewer events, larger sensors")
    parser.add_argument("--sets", type=Path, nargs="*", default=[], help="data sets with labels, with --bursts")
    parser.add_argument("--pans", action="store_true", help=f"with --bursts: {PANNED}")
    parser.add_argument("--office", action="store_true", help=f"with --bursts: {OFFICE}, windows of 1.5 and 4.5 px")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    if a.sets and not a.bursts:
        parser.error("--sets: needs --bursts")
    if a.bursts and not (a.recordings / TEST).is_dir():
        parser.error(f"--recordings: {a.recordings} has no folder {TEST}")
    console, results = plain_console(), {}
    if a.bursts:
        known = {folder.name: burst(folder, a.answers) for folder in sorted((a.recordings / TEST).iterdir())}
        try:
            known |= {path.as_posix(): of_set(path, a.answers, a.windows) for path in a.sets}
            known |= {PANNED: of_pairs(of_pans(), a.answers, PANNED)} if a.pans else {}
            for apart in (1, 3) if a.office else ():
                title = f"office, {apart * APART_US / 1000:g} ms"
                known[title] = of_pairs(of_office(a.recordings / OFFICE, apart), a.answers, title)
        except (BlinkGLError, OSError) as error:
            parser.error(str(error))
        for title, rows in known.items():
            results[title] = rows
            keys = [f"{what}_{where}" for where in ("events", "all") for what in ("aee", "of_zero", "cosine", "length")]
            heads = [key.replace("_", " ") for key in keys]
            say(console, table(title, heads, [[n, *(row[k] for k in keys)] for n, row in rows.items()]) + "\n")
        for folder in sorted((a.recordings / TEST).iterdir()) if a.changed else ():
            rows = results[f"{folder.name}, changed"] = changed(folder, a.answers)
            title = f"{folder.name}: AEE of zero flow's"
            say(console, table(title, list(rows[a.answers[0]]), [[n, *row.values()] for n, row in rows.items()]) + "\n")
    else:
        for path in recordings(a.recordings):
            name = path.relative_to(a.recordings).as_posix()
            if name.startswith(TEST):
                continue
            try:
                results[name] = judged(path, a.answers, a.windows)
            except BlinkGLError as error:
                say(console, f"left out: {error}")
                continue
            it = results[name]
            title = f"{name}, {it['size']}, {it['windows']} of {it['span_ms']:.1f} ms, affine {it['moves']:.2f}"
            keys = ["fwl", "cosine", "length", "x", "ms"]
            say(console, table(title, keys, [[n, *(row[k] for k in keys)] for n, row in it["rows"].items()]) + "\n")
        moving = [it for it in results.values() if it["moves"] > MOVES]
        if not moving:
            raise SystemExit(f"nothing moves below {a.recordings}")
        over = lambda name, key: float(np.nanmedian([it["rows"][name][key] for it in moving]))
        rows = [[n, *(over(n, k) for k in ("fwl", "cosine", "length"))] for n in a.answers]
        say(console, table(f"all that move ({len(moving)})", ["fwl", "cosine", "length"], rows))
    if a.json:
        a.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
