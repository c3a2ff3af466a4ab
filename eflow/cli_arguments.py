"""Arguments of the ``eflow`` commands: options that several commands share, and the parsing of their values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from blinkgl.errors import ConfigError
from eflow.methods.table import METHODS, Method, make_method

if TYPE_CHECKING:
    from eflow.config import SourceConfig
    from eflow.data.online import Held
    from eflow.models import FlowModel

Answer = Annotated[
    str,
    typer.Argument(
        help="Run folder, checkpoint folder, .safetensors file, a network that comes with the package (eflow "
        f"models), or a method that needs no training: {', '.join(METHODS)}."
    ),
]
Network = Annotated[
    str,
    typer.Argument(
        help="Run folder, checkpoint folder, .safetensors file, or a network that comes with the package (eflow "
        "models)."
    ),
]
Focal = Annotated[
    float | None, typer.Option(min=1e-3, help="Focal length in px; contrast-rotation needs it.", show_default=False)
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")
]
WindowMs = Annotated[
    str | None,
    typer.Option(metavar="LOW-HIGH", help="Lengths of windows, of a recipe only. Default: its label interval."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress.")]
Iterations = Annotated[int | None, typer.Option(min=1, help="GRU iterations, for networks that have them.")]

Dataset = Annotated[
    str,
    typer.Argument(
        help="Folder of BlinkGL, DSEC, MVSEC or BlinkFlow sequences or of rendered windows, or a recipe (.yaml), "
        "whose test groups are rendered."
    ),
]
Protocol = Annotated[str, typer.Option(help="MVSEC: frames and rows to score: all, ste-flownet or e-raft (20 Hz).")]
Frames = Annotated[
    list[str] | None,
    typer.Option("--frames", metavar="FIRST-LAST", help="MVSEC: images (or 20 Hz fields) to score; may be repeated."),
]
Dense = Annotated[bool, typer.Option("--dense", help="MVSEC: score pixels without events, too.")]
Sharpened = Annotated[
    bool, typer.Option("--sharpen", help="Scale the flow of a network to the length that makes the events sharpest.")
]
Span = Annotated[
    str,
    typer.Option("--window-ms", help="Length Δ of each of the two windows; auto: motion of about 5 px in a window."),
]
Whole = Annotated[
    bool, typer.Option("--whole", help="One flow for the whole file: as one window, or its halves as a pair.")
]
WarmStart = Annotated[
    bool, typer.Option("--warm-start", help="Start the refinement of each window from the previous flow.")
]
Sharpen = Annotated[
    bool,
    typer.Option(help="Scale the flow of a network to the length that makes the events sharpest."),
]


def answerer(
    name: str, focal: float | None, *, iterations: int | None = None, warm_start: bool = False
) -> FlowModel | Method:
    """Return the method of that name, or the trained network, on a GPU if there is one.

    Raises ConfigError: it lacks one of the options. AssetError: no such network."""
    if name not in METHODS or Path(name).exists():
        if focal is not None:
            raise ConfigError("only a method uses it", where="--focal", value=focal, accepted=", ".join(METHODS))
        return network_of(name, iterations=iterations, warm_start=warm_start)
    for option, value in (("--iterations", iterations), ("--warm-start", warm_start)):
        if value:
            raise ConfigError(f"{name} is not a network", where=option, value=value)
    return make_method(name, focal)


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

    from eflow.allocator import keep_memory
    from eflow.checkpoint import load_model

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


def rendered(recipe: str, window_ms: str | None, limit: int | None) -> Held:
    """Return samples of a recipe, rendered and kept in memory."""
    from eflow.data.online import held

    return held(windows_of(recipe, window_ms, samples=4, min_events=40, max_flow=40.0), limit or 128)


def windows_of(recipe: str, window_ms: str | None, **how) -> SourceConfig:
    """Return the online source of a recipe for the options of a command line."""
    from blinkgl.config.problems import validate
    from eflow.config import SourceConfig

    tree: dict = {"recipe": recipe, "online": True, **how}
    if window_ms is not None:
        ends = window_ms.split("-")
        try:
            tree["window_ms"] = tuple(float(end) for end in (ends if len(ends) > 1 else 2 * ends))
            validate(SourceConfig, tree)
        except (ValueError, ConfigError):
            raise ConfigError(
                "not a range of window lengths",
                where="--window-ms",
                value=window_ms,
                accepted="LOW-HIGH in ms, such as 5-100",
            ) from None
    return validate(SourceConfig, tree)
