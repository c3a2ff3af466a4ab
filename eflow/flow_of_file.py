"""Flow of an event file, window by window: one line each, and optionally pictures, arrays and a video."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import EventFile
from eflow import infer
from eflow.cli_arguments import Outputs, WindowsAsked
from eflow.data.window import StreamWindow
from eflow.infer import Predictor
from eflow.methods.contrast import LEAST_EVENTS, ContrastMaximisation
from eflow.methods.iwe import flow_warp_loss
from eflow.models.contract import FlowModel
from eflow.writers import Answer, Writer, flow_folder, flow_video


def show_flows(
    file: EventFile, predictor: Predictor, asked: WindowsAsked, outputs: Outputs, say: Callable[[str], None]
) -> None:
    """Process every window: say a line about it and write ``outputs``.

    Raises BlinkGLError: the file has no events, or is shorter than its windows."""
    stream, span, factor = _windows(file, predictor, asked, say)
    predictor.unsharpened.clear()  # of the windows that were looked at to choose their length
    count, still, before, speeds = 0, 0, None, []
    with contextlib.ExitStack() as opened:
        writers: list[Writer] = []
        folder = None
        if outputs.out:
            folder = opened.enter_context(flow_folder(outputs.out, npy=outputs.npy, at_events=outputs.at_events))
            writers.append(folder)
        if outputs.video:
            fps = min(20.0, 1e6 / span) * len(asked.shares)  # windows per second of video: real time, but at most 20
            writers.append(opened.enter_context(flow_video(outputs.video, *infer.sensor_of(file), fps)))
        for window in stream:
            flow, tensor = predictor(window)
            sharper = flow_warp_loss(window.new, flow)
            count += 1
            still += not flow.any()
            if flow.any() and np.isfinite(flow).all() and len(window.new):
                speeds.append(float(np.median(np.hypot(*flow[window.new.y, window.new.x].T))))
            flow = flow * np.float32(factor)
            begin = window.new.t0 if factor == 1 else window.old.t0
            say(
                f"t {begin} us  {len(window.old) + len(window.new)} events  mean speed "
                f"{np.hypot(*np.moveaxis(flow, -1, 0)).mean():.3f} px  FWL {sharper:.3f}"
            )
            # Flow at a time within the window: the events until then, and the flow so far, for which the flow of the
            # window before tells the velocity at the beginning.
            for share in asked.shares if writers else ():
                end = begin + round(share * (window.new.t1 - begin))
                to_end = replace(window, new=replace(window.new, t0=begin, t1=end))
                for writer in writers:
                    writer.add(Answer(to_end, infer.within(flow, before, share), tensor))
            before = flow
        if not count:
            raise BlinkGLError(
                f"shorter than {'two windows' if 'old' in predictor.reads else 'a window'} of {span / 1000:g} ms",
                where=str(file.path),
                accepted="a smaller --window-ms, or --whole",
            )
    if still:
        say(f"  {still} of {count} flows are zero: too few events, or nothing moves")
    if isinstance(predictor.model, FlowModel) and speeds:
        _propose_longer(file, predictor, span, speeds, asked, say)
    if folder is not None and folder.lost:
        say(f"  {folder.lost} flows beyond ±256 px are not valid in the PNGs, which cannot hold them (--npy can)")
    for why, windows in predictor.unsharpened.items():
        say(f"  {windows} of {count} flows have the network's own length: {why} (--no-refine for all)")
    for path in filter(None, (outputs.out, outputs.video)):
        say(f"written: {path}")


def _propose_longer(
    file: EventFile,
    predictor: Predictor,
    span: int,
    speeds: list[float],
    asked: WindowsAsked,
    say: Callable[[str], None],
) -> None:
    """Say that the flow of most windows is too short for the networks, and which window is long enough. speeds : px a
    window."""
    short = sum(speed < infer.SHORTEST_PX for speed in speeds)
    if 2 * short <= len(speeds):
        return
    where = f"below {infer.SHORTEST_PX:g} px, where the networks of the package are wrong by a third or more"
    line = f"  {short} of {len(speeds)} flows are {where}"
    first, last = asked.within(infer.ends_of(file) or (0, -1))
    # A network of two windows needs both of them inside the recording.
    longest = 0 if asked.whole else (last + 1 - first) // len(predictor.reads)
    # Longer in the ratio of the lengths: the motion is taken to go on.
    fitting = min(round(span * infer.LIKELY_PX / max(float(np.median(speeds)), 1e-3)), longest)
    # Three digits, rounded down: of a longer window than the recording there is none.
    fitting -= fitting % 10 ** max(len(str(fitting)) - 3, 0)
    if fitting > 1.2 * span:
        say(f"{line}: try --window-ms {fitting / 1000:.15g}")
    else:
        say(f"{line}; this recording is too short for longer windows")


def _windows(
    file: EventFile, predictor: Predictor, asked: WindowsAsked, say: Callable[[str], None]
) -> tuple[Iterable[StreamWindow], int, float]:
    """Return (windows, their length in µs, factor to multiply the flow with)."""
    reads = predictor.reads
    if asked.whole:
        window, factor = infer.whole_file(file, reads)
        return [window], window.new.t1 - window.old.t0, factor
    first = next((int(c.t[0]) for c in file.chunks()), None)
    if first is None:
        raise BlinkGLError("holds no events", where=str(file.path))
    if (span := asked.span_us) is None:
        part = asked.within(infer.ends_of(file) or (first, first))
        span, longest = infer.likely_span(file, predictor, reads, part)
        say(f"windows of {span / 1000:g} ms")
        if span == longest:
            say(f"  the longest window of this recording: motion in it is below {infer.LIKELY_PX:g} px")
        _second_opinion(file, predictor, span, part[0] + (longest - span) * len(reads) // 2, say)
    start, end = asked.limits(first)
    return infer.windows(file, span, start_us=start, end_us=end, reads=reads), span, 1.0


def _second_opinion(file: EventFile, predictor: Predictor, span: int, start: int, say: Callable[[str], None]) -> None:
    """Check the flow of one window, or pair, of ``span`` µs from ``start`` on, in the middle of the recording: say if
    it does not make the events sharper, and if contrast maximisation (a translation) finds another motion."""
    window = next(infer.windows(file, span, start_us=start, reads=predictor.reads), None)
    if window is None or len(window.new) < LEAST_EVENTS:
        return
    flow, _ = predictor(window)
    if flow_warp_loss(window.new, flow) < 1:
        say("  the flow makes the events in the middle no sharper: nothing moves there, or many things move at once")
    mine = np.median(flow[window.new.y, window.new.x], axis=0)
    none = window.new.take(np.zeros(len(window.new), bool))
    # Contrast maximisation reads two windows; where the network reads one, the older is empty and as long.
    old = window.old if len(window.old) else replace(none, t0=window.new.t0 - span, t1=window.new.t0)
    try:
        other = ContrastMaximisation("translation")(old, window.new, *infer.sensor_of(file))[0, 0]
    except BlinkGLError:
        return
    if np.hypot(*(mine - other)) > max(0.5 * np.hypot(*other), 1.0):
        say(
            f"  contrast maximisation finds a motion of ({other[0]:.1f}, {other[1]:.1f}) px in the middle window, this "
            f"flow ({mine[0]:.1f}, {mine[1]:.1f}): right if objects move independently; look at the pictures"
        )
