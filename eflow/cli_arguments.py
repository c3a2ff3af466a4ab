"""Arguments of the ``eflow`` commands: options that several commands share, and the parsing of their values."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_type_hints

import typer

from blinkgl.errors import ConfigError
from blinkgl.machine import event_options as of_events
from eflow.methods.table import METHODS, Method, make_method

if TYPE_CHECKING:
    from blinkgl.io.reading import EventReading
    from eflow.config import SourceConfig
    from eflow.data.sources import Part
    from eflow.models import FlowModel

ROTATION = "contrast-rotation"
Answer = Annotated[
    str,
    typer.Argument(
        help="Run folder, checkpoint folder, .safetensors file, a network that comes with the package (eflow "
        f"models), or a method that needs no training: {', '.join(METHODS)}."
    ),
]
Network = Annotated[
    str,
    typer.Argument(help="Run folder, checkpoint folder, .safetensors file, or a shipped network (eflow models)."),
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
]
WindowMs = Annotated[
    str | None,
    typer.Option(metavar="LOW-HIGH", help="Lengths of windows, of a recipe only. Default: its label interval."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no summary.")]

Dataset = Annotated[
    str,
    typer.Argument(
        help="Folder of BlinkGL, DSEC, MVSEC or BlinkFlow sequences or rendered windows, or a recipe, whose test "
        "groups are rendered."
    ),
]
Protocol = Annotated[str, typer.Option(help="MVSEC: frames and rows to score: all, ste-flownet or e-raft (20 Hz).")]
Frames = Annotated[
    list[str] | None,
    typer.Option("--frames", metavar="FIRST-LAST", help="MVSEC: images (or 20 Hz fields) to score; may be repeated."),
]
Dense = Annotated[bool, typer.Option("--dense", help="MVSEC: score pixels without events, too.")]
_REFINE = "Refine a network's flow by its dominant affine motion and by the sharpness of the events."
Refined = Annotated[bool, typer.Option("--refine", help=_REFINE)]
WarmStart = Annotated[
    bool, typer.Option("--warm-start", help="Start the refinement of each window from the previous flow.")
]
Refine = Annotated[bool | None, typer.Option("--refine/--no-refine", help=f"{_REFINE} Default: on.")]


def _known_views(views: int | None) -> int | None:
    if views is not None:
        from eflow.infer import VIEWS

        one_of("--views", str(views), tuple(map(str, VIEWS)))
    return views


Views = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        callback=_known_views,
        help="Mean flow of N views of the events: 1, 4 (mirrored, too) or 8 (with swapped polarities, too). Default: 4 "
        "where predict takes a shipped network, else 1.",
        show_default=False,
    ),
]


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with the fields of each parameter that is a dataclass as options of its own."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: kind for name, kind in hints.items() if is_dataclass(kind) and isinstance(kind, type)}
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command).parameters.items():
        of = inspect.signature(groups[name]).parameters.values() if name in groups else [parameter]
        known = get_type_hints(groups[name], include_extras=True) if name in groups else hints
        parameters += [option.replace(annotation=known[option.name]) for option in of]

    @functools.wraps(command)
    def run(**values: object) -> None:
        for name, kind in groups.items():
            values[name] = kind(**{field.name: values.pop(field.name) for field in fields(kind)})
        command(**values)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


@dataclass(frozen=True)
class Answering:
    """Options of a network or of a method. iterations, warm_start, views : of networks.   focal : px, of a method."""

    iterations: Annotated[int | None, typer.Option(min=1, help="GRU iterations, for networks that have them.")] = None
    warm_start: WarmStart = False
    views: Views = None
    focal: Annotated[
        float | None,
        typer.Option(min=1e-3, help=f"Focal length in px; {ROTATION} needs it.", show_default=False),
    ] = None


@dataclass(frozen=True)
class WindowsAsked:
    """The windows of an event file to process.

    window_ms : length of each.   at : shares of a window to which flow is wanted.   start_ms, end_ms : limits, as
    times after the first event; None: no limit.   whole : the whole file is one window, or its halves are a pair."""

    window_ms: Annotated[
        str,
        typer.Option(
            "--window-ms", help="Length Δ of each of the two windows; auto: motion of about 5 px in a window."
        ),
    ] = "100"
    start_ms: Annotated[float | None, typer.Option("--start-ms", help="Start at this time after the first event.")] = (
        None
    )
    end_ms: Annotated[float | None, typer.Option("--end-ms", help="Stop at this time after the first event.")] = None
    whole: Annotated[
        bool, typer.Option("--whole", help="One flow for the whole file: as one window, or its halves as a pair.")
    ] = False
    at: Annotated[
        str,
        typer.Option(
            metavar="SHARES", help="Flow from the start of each window to these shares of it, such as .25,.5,.75,1."
        ),
    ] = "1"

    def __post_init__(self) -> None:
        """Raise ConfigError unless the length is one, and the shares are."""
        if not all(0 < share <= 1 for share in self.shares) or not self.shares:
            raise ConfigError(
                "not shares of a window", where="--at", value=self.at, accepted="numbers above 0, up to 1: .25,.5,.75,1"
            )
        if self.window_ms != "auto" and not self.span_us:
            raise ConfigError(
                "not a window length", where="--window-ms", value=self.window_ms, accepted="milliseconds, or auto"
            )
        for option, value in (("--start-ms", self.start_ms), ("--end-ms", self.end_ms)):
            if self.whole and value is not None:
                raise ConfigError(
                    "the whole file has no limits",
                    where=option,
                    value=value,
                    accepted="--window-ms instead of --whole",
                )

    @property
    def shares(self) -> tuple[float, ...]:
        """Return the shares of a window to which flow is wanted; empty: not numbers."""
        try:
            return tuple(float(part) for part in self.at.split(","))
        except ValueError:
            return ()

    @property
    def span_us(self) -> int | None:
        """Return the length of a window, µs; None: motion of about 5 px in a window."""
        try:
            milliseconds = float(self.window_ms)
        except ValueError:
            return None
        return round(milliseconds * 1000) if 0.001 <= milliseconds < 1e9 else None

    def limits(self, first: int) -> tuple[int | None, int | None]:
        """Return the limits, µs, of a file whose first event is at ``first`` µs."""
        start, end = (None if ms is None else first + round(ms * 1000) for ms in (self.start_ms, self.end_ms))
        return start, end

    def within(self, ends: tuple[int, int]) -> tuple[int, int]:
        """Return the first and the last µs inside the limits, of a file whose first and last event are at ``ends``."""
        start, end = self.limits(ends[0])
        return max(ends[0], ends[0] if start is None else start), min(ends[1], ends[1] if end is None else end - 1)


@dataclass(frozen=True)
class Declared:
    """What an event file does not say."""

    size: Annotated[str | None, typer.Option(metavar="WxH", help="Sensor size, if the file does not store it.")] = None
    time_unit: of_events.TimeUnit = None
    origin: of_events.Origin = None
    columns: of_events.Columns = None
    polarity: of_events.Polarity = None
    stream: of_events.Stream = None
    damaged: of_events.Damaged = "refuse"
    sort: of_events.Sort = False

    def reading(self) -> EventReading:
        """Return it as readers take it. Raises ConfigError."""
        from blinkgl.io.reading import EventReading

        return EventReading.of(**vars(self))


@dataclass(frozen=True)
class Outputs:
    """What is written: a new folder of flow and pictures, a video; None: not written.

    npy : also write float32 arrays to the folder.   at_events : flow of pixels without events nearby is not valid."""

    out: Annotated[str | None, typer.Option("--out", "-o", help="New folder for flow and pictures.")] = None
    npy: Annotated[bool, typer.Option("--npy", help="Also write float32 .npy files.")] = False
    at_events: Annotated[
        bool, typer.Option("--at-events", help="Write flow of pixels without events nearby as not valid.")
    ] = False
    video: Annotated[str | None, typer.Option(help="Also write a video (.mp4) of events and flow.")] = None


def check_outputs(asked: WindowsAsked, outputs: Outputs) -> None:
    """Raise ConfigError for an option of files that are not written."""
    for option, wanted in (("--npy", outputs.npy), ("--at-events", outputs.at_events)):
        if wanted and not outputs.out:
            raise ConfigError("no folder to write to", where=option, accepted="--out FOLDER")
    if asked.shares != (1.0,) and not outputs.out and not outputs.video:
        raise ConfigError("nothing is written", where="--at", value=asked.at, accepted="--out or --video")


@dataclass(frozen=True)
class Sampling:
    """How windows are taken from rendered sequences; keys of :class:`eflow.config.SourceConfig`."""

    per_sequence: Annotated[int, typer.Option(min=1, max=1000, help="Windows from each sequence.")] = 8
    window_ms: WindowMs = None
    min_events: Annotated[
        int, typer.Option(min=1, help="Minimum number of events in each of a sample's two windows.")
    ] = 40
    max_flow: Annotated[float, typer.Option(help="Maximum median flow of a sample, px.")] = 40.0
    min_density: Annotated[float, typer.Option(help="Minimum number of events per pixel and per px of mean flow.")] = (
        0.0
    )


def answerer(name: str, options: Answering, *, refine: bool = False) -> FlowModel | Method:
    """Return the method of that name, or the trained network, on a GPU if there is one.

    refine : whether the flow of a network is asked to be refined.
    Raises ConfigError: it lacks one of the options. AssetError: no such network."""
    network = name not in METHODS or Path(name).exists()
    if options.focal is not None and (network or name != ROTATION):
        raise ConfigError("only a rotation uses it", where="--focal", value=options.focal, accepted=ROTATION)
    if network:
        return network_of(name, iterations=options.iterations, warm_start=options.warm_start)
    of_networks = {
        "--iterations": options.iterations,
        "--warm-start": options.warm_start,
        "--views": options.views,
        "--refine": refine,
    }
    for option, value in of_networks.items():
        if value:
            raise ConfigError(f"{name} is not a network", where=option, value=value)
    return make_method(name, options.focal)


def ranges_of(frames: list[str] | None) -> tuple[tuple[int, int], ...]:
    """Return the ranges [first, end) of ``--frames``. Raises ConfigError."""
    ranges = []
    for text in frames or ():
        ends = re.fullmatch(r"(\d{1,9})-(\d{1,9})", text)
        if ends is None or int(ends[1]) > int(ends[2]):
            raise ConfigError("not a range of frames", where="--frames", value=text, accepted="FIRST-LAST: 200-800")
        ranges.append((int(ends[1]), int(ends[2]) + 1))
    return tuple(ranges)


def network_of(checkpoint: str, *, iterations: int | None = None, warm_start: bool = False) -> FlowModel:
    """Return the trained network, on a GPU if there is one. Raises ConfigError: it lacks an option. AssetError: no such
    network."""
    import torch

    from eflow.checkpoint import load_model
    from eflow.machine import keep_memory

    keep_memory()
    model = load_model(checkpoint)
    for option, wanted in (("--iterations", iterations is not None), ("--warm-start", warm_start)):
        if wanted and not hasattr(model.config, "iterations"):
            raise ConfigError("this network has no iterations", where=option, value=model.config.name)
    if iterations is not None:
        model.config = model.config.model_copy(update={"iterations": iterations})
    return model.to("cuda" if torch.cuda.is_available() else "cpu")


def one_of(option: str, value: str, accepted: tuple[str, ...]) -> None:
    """Raise ConfigError if the value is not one of those accepted."""
    if value not in accepted:
        raise ConfigError("unknown choice", where=option, value=value, accepted=", ".join(accepted))


def rendered(recipe: str, window_ms: str | None, limit: int | None) -> Part:
    """Return samples of a recipe, rendered and kept in memory."""
    from eflow.data.online import held

    return held(windows_of(recipe, Sampling(4, window_ms)), limit or 128)


def windows_of(recipe: str, sampling: Sampling, **how: object) -> SourceConfig:
    """Return the online source of a recipe. how : further keys of it. Raises ConfigError."""
    from blinkgl.config.problems import validate
    from eflow.config import SourceConfig

    kept = {name: getattr(sampling, name) for name in ("min_events", "max_flow", "min_density")}
    tree = {"recipe": recipe, "online": True, "samples": sampling.per_sequence, **kept, **how}
    if sampling.window_ms is not None:
        ends = sampling.window_ms.split("-")
        try:
            tree["window_ms"] = tuple(float(end) for end in (ends if len(ends) > 1 else 2 * ends))
            validate(SourceConfig, tree)
        except (ValueError, ConfigError):
            raise ConfigError(
                "not a range of window lengths",
                where="--window-ms",
                value=sampling.window_ms,
                accepted="LOW-HIGH in ms, such as 5-100",
            ) from None
    return validate(SourceConfig, tree)
