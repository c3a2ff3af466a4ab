"""Arguments of the ``eflow`` commands: options that several commands share, and the parsing of their values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from blinkgl.errors import ConfigError
from eflow.methods.table import METHODS, make_method

if TYPE_CHECKING:
    from eflow.config import SourceConfig

Precision = Annotated[str, typer.Option(help="fp32, or bf16 (autocast with fp32 islands).")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
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
Raw = Annotated[bool, typer.Option("--raw", help="Use the last weights instead of the averaged ones.")]
Iterations = Annotated[int | None, typer.Option(min=1, help="GRU iterations, for networks that have them.")]

Dataset = Annotated[
    str,
    typer.Argument(
        help="Folder of BlinkGL, DSEC, MVSEC or BlinkFlow sequences or of rendered windows, or a recipe (.yaml), "
        "whose test groups are rendered."
    ),
]
Protocol = Annotated[str, typer.Option(help="MVSEC: frames and rows to score: all, ste-flownet or e-raft (20 Hz).")]
GroundTruth = Annotated[
    str | None,
    typer.Option(
        "--ground-truth",
        help="MVSEC: propagated (through the 20 Hz flow) or scaled (one field). Default: the protocol's.",
    ),
]
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
Truth = Annotated[str | None, typer.Option(help="Ground truth of the flow (.npy, .png, .flo); prints AEE and cosine.")]
WarmStart = Annotated[
    bool, typer.Option("--warm-start", help="Start the refinement of each window from the previous flow.")
]
Sharpen = Annotated[
    bool,
    typer.Option(help="Scale the flow of a network to the length that makes the events sharpest."),
]


def method_named(name: str, focal: float | None, **network: object):
    """Return the method of that name; None if it is a network's name or a file.

    network : options that only networks have. Raises ConfigError: one of them is set, but the name is a method's."""
    if name not in METHODS or Path(name).exists():
        if focal is not None:
            raise ConfigError("only a method uses it", where="--focal", value=focal, accepted=", ".join(METHODS))
        return None
    for option, value in network.items():
        if value:
            raise ConfigError(f"{name} is not a network", where="--" + option.replace("_", "-"), value=value)
    return make_method(name, focal)


def ranges_of(frames: list[str] | None) -> tuple[tuple[int, int], ...]:
    """Return the ranges [first, end) of ``--frames``. Raises ConfigError."""
    found = [re.fullmatch(r"(\d{1,9})-(\d{1,9})", text) for text in frames or ()]
    for text, one in zip(frames or (), found):
        if one is None or int(one[1]) > int(one[2]):
            raise ConfigError("not a range of frames", where="--frames", value=text, accepted="FIRST-LAST: 200-800")
    return tuple((int(one[1]), int(one[2]) + 1) for one in found if one)


def network_of(
    checkpoint: str, device: str, raw: bool, precision: str, iterations: int | None = None, warm_start: bool = False
):
    """Return (the trained network on its device, the precision to use there: fp32 if it does not support bf16). Raises
    ConfigError: this network or machine lacks an option."""
    import torch

    from eflow.allocator import keep_memory
    from eflow.checkpoint import load_model
    from eflow.precision import precision_on

    one_of("--precision", precision, ("fp32", "bf16"))
    one_of("--device", device, ("auto", "cpu", "cuda"))
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("no CUDA device on this machine", where="--device", value=device, accepted="cpu or auto")
    keep_memory()
    model = load_model(checkpoint, averaged=not raw)
    for option, given in (("--iterations", iterations is not None), ("--warm-start", warm_start)):
        if given and not hasattr(model.config, "iterations"):
            raise ConfigError("this network has no iterations", where=option, value=model.config.name)
    if iterations is not None:
        model.config = model.config.model_copy(update={"iterations": iterations})
    place = torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
    return model.to(place), precision_on(place, precision)


def one_of(option: str, value: str, accepted: tuple[str, ...]) -> None:
    """Raise ConfigError if the value is not one of those accepted."""
    if value not in accepted:
        raise ConfigError("unknown choice", where=option, value=value, accepted=", ".join(accepted))


def rendered(recipe: str, window_ms: str | None, limit: int | None):
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
