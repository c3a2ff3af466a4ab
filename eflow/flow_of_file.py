"""Flow of an event file, window by window: one line each, and optionally pictures, arrays and a video."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.io.formats import EventFile
from eflow import infer
from eflow.data.window import hit_pixels
from eflow.infer import StreamWindow
from eflow.methods.contrast import LEAST_EVENTS, ContrastMaximisation
from eflow.methods.iwe import flow_warp_loss
from eflow.metrics import frame_metrics
from eflow.pictures import events_of, flow_video, near_events


@dataclass(frozen=True)
class WindowsAsked:
    """The windows of a file to process.

    milliseconds : length of each; None: motion of about 5 px in a window.
    start_ms, end_ms : limits, as times after the first event; None: no limit.
    whole : the whole file is one window, or its halves are a pair."""

    milliseconds: float | None = 100.0
    start_ms: float | None = None
    end_ms: float | None = None
    whole: bool = False


@dataclass(frozen=True, eq=False)
class Outputs:
    """What to write: a new folder of flow and pictures, a video; None: not written.

    npy : also write float32 arrays to the folder.   truth : (H, W, 2) px, ground truth to score each flow with.
    at_events : flow of pixels without events nearby is not valid."""

    folder: str | None = None
    video: str | None = None
    npy: bool = False
    truth: np.ndarray | None = None
    at_events: bool = False


def milliseconds(text: str) -> float | None:
    """Return the value of --window-ms; None for "auto". Raises ConfigError."""
    if text == "auto":
        return None
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.001 <= value < 1e9:
        raise ConfigError("not a window length", where="--window-ms", value=text, accepted="milliseconds, or auto")
    return value


def show_flows(
    file: EventFile,
    predictor: infer.Predictor | infer.MethodPredictor,
    reads: Sequence[str],
    asked: WindowsAsked,
    outputs: Outputs,
    say: Callable[[str], None],
) -> None:
    """Process every window: say a line about it and write ``outputs``.

    reads : the windows of a pair that the predictor uses.
    Raises BlinkGLError: the file has no events, or is shorter than its windows."""
    stream, span, factor = _windows(file, predictor, reads, asked, say)
    kept = getattr(predictor, "unsharpened", {})
    kept.clear()  # of the windows that were looked at to choose their length
    count = began = 0
    with contextlib.ExitStack() as opened:
        writer = shown = None
        if outputs.folder:
            writer = opened.enter_context(infer.flow_folder(outputs.folder, npy=outputs.npy))
        if outputs.video:
            fps = min(20.0, 1e6 / span)  # windows per second of video: real time, but at most 20
            shown = opened.enter_context(flow_video(outputs.video, *infer.sensor_of(file), fps))
        for window in stream:
            flow, tensor = predictor(window)
            sharper = flow_warp_loss(window.new, flow)
            flow = flow * np.float32(factor)
            count += 1
            line = (
                f"t {window.t_us} us  {len(window.old) + len(window.new)} events  mean speed "
                f"{np.hypot(*np.moveaxis(flow, -1, 0)).mean():.3f} px  FWL {sharper:.3f}"
            )
            if outputs.truth is not None:
                line += _beside_truth(flow, outputs.truth, window)
            say(line)
            if writer:
                writer.add(window, flow, tensor, outputs.truth, at_events=outputs.at_events)
            if shown:
                began = window.new.t0 if count == 1 else began
                # Times may be Unix times; captions count from the first window.
                caption = f"{(window.new.t1 - window.new.t0) / 1000:g} ms at {(window.t_us - began) / 1e6:.3f} s"
                shown.add(caption, events_of(tensor), flow, near_events(tensor))
        if not count:
            raise BlinkGLError(
                f"shorter than {'two windows' if 'old' in reads else 'a window'} of {span / 1000:g} ms",
                where=str(file.path),
                accepted="a smaller --window-ms, or --whole",
            )
    for why, windows in kept.items():
        say(f"  {windows} of {count} flows have the network's own length: {why} (--no-sharpen for all)")
    for path in filter(None, (outputs.folder, outputs.video)):
        say(f"written: {path}")


def _windows(file, predictor, reads, asked, say):
    """Return (windows, their length in µs, factor to multiply the flow with)."""
    if asked.whole:
        window, factor = infer.whole_file(file, reads)
        return [window], window.new.t1 - window.old.t0, factor
    first = next((int(c.t[0]) for c in file.chunks()), None)
    if first is None:
        raise BlinkGLError("holds no events", where=str(file.path))
    if asked.milliseconds is None:
        span, longest = infer.likely_span(file, predictor, reads)
        say(f"windows of {span / 1000:g} ms")
        if span == longest:
            say(f"  the longest window of this recording: motion in it is below {infer.LIKELY_PX:g} px")
        _second_opinion(file, predictor, span, first + (longest - span) * len(reads) // 2, reads, say)
    else:
        span = round(asked.milliseconds * 1000)
    start, end = (None if ms is None else first + round(ms * 1000) for ms in (asked.start_ms, asked.end_ms))
    return infer.windows(file, span, start_us=start, end_us=end, reads=reads), span, 1.0


def _second_opinion(file, predictor, span: int, start: int, reads: Sequence[str], say: Callable[[str], None]) -> None:
    """Check the flow of one window, or pair, of ``span`` µs from ``start`` on, in the middle of the recording: say if
    it does not make the events sharper, and if contrast maximisation (a translation) finds another motion."""
    window = next(infer.windows(file, span, start_us=start, reads=reads), None)
    if window is None or len(window.new) < LEAST_EVENTS:
        return
    flow, _ = predictor(window)
    if flow_warp_loss(window.new, flow) < 1:
        say("  the flow makes the events in the middle no sharper: nothing moves there, or many things move at once")
    mine = np.median(flow[window.new.y, window.new.x], axis=0)
    none = window.new.take(np.zeros(len(window.new), bool))
    old = window.old if len(window.old) else replace(none, t0=window.new.t0 - span, t1=window.new.t0)
    try:
        other = ContrastMaximisation("translation")(old, window.new, file.height, file.width)[0, 0]
    except BlinkGLError:
        return
    if np.hypot(*(mine - other)) > max(0.5 * np.hypot(*other), 1.0):
        say(
            f"  contrast maximisation finds a motion of ({other[0]:.1f}, {other[1]:.1f}) px in the middle window, this "
            f"flow ({mine[0]:.1f}, {mine[1]:.1f}): right if objects move independently; look at the pictures"
        )


def _beside_truth(flow: np.ndarray, truth: np.ndarray, window: StreamWindow) -> str:
    """Return two lines: errors over all pixels with truth, and over those with events."""
    valid, hit, lines = np.all(np.isfinite(truth), axis=-1), hit_pixels((window.old, window.new), *truth.shape[:2]), ""
    for name, mask in (("all pixels", valid), ("pixels with events", valid & hit)):
        m, zero = frame_metrics(flow, truth, mask), frame_metrics(np.zeros_like(flow), truth, mask)
        if m and zero:
            lines += f"\n  {name}: AEE {m['AEE']:.3f} px, cosine {m['cosine']:.4f}; zero flow AEE {zero['AEE']:.3f} px"
    return lines
