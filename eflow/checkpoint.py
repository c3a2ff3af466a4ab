"""Checkpoints: folders of safetensors files and one JSON file, written completely or not at all.
Reading one cannot execute code.

    000500/weights.safetensors      parameters and buffers; the metadata holds the model configuration
           ema.safetensors          their moving average, which evaluation uses (if optim.ema is set)
           optimizer.safetensors    AdamW's moments, named by parameter, and torch's generator states
           state.json               step, seconds, configuration, digests of the data (eflow.data.content)
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import NotRequired, TypedDict

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from blinkgl.errors import AssetError, ConfigError, OutputError
from blinkgl.io.atomic import atomic_file, atomic_folder, output_errors
from blinkgl.io.records import parse, read_text
from eflow import shipped
from eflow.config import TrainConfig
from eflow.models import FlowModel, build_model, model_config

FORMAT = "eflow-1"


class State(TypedDict):
    """``state.json``. seconds : of the whole training.   config : of the training.   content : digests of its data."""

    format: str
    step: int
    seconds: float
    config: NotRequired[dict[str, object]]
    content: NotRequired[dict[str, str]]


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors and the metadata of a safetensors file.

    Raises AssetError: the file is missing, truncated or of another format, e.g. a pickle."""
    try:
        with open(path, "rb") as file:
            head = file.read(9)
        # A safetensors file starts with 8 bytes of header length, which may look like a pickle's; then comes a brace.
        if head[8:] != b"{" and (head[:2] == b"PK" or head[:1] == b"\x80"):
            raise AssetError(
                "is a PyTorch pickle, which could run any code when loaded; refused",
                where=str(path),
                accepted="a .safetensors file",
            )
        with safe_open(path, framework="pt") as file:
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 - it has keys() but is not a mapping
            return tensors, dict(file.metadata() or {})
    except FileNotFoundError:
        raise AssetError("no such file", where=str(path)) from None
    except OSError as error:
        raise AssetError(
            f"cannot be read: {os.strerror(error.errno) if error.errno else error}".lower(), where=str(path)
        ) from error
    except SafetensorError as error:
        raise AssetError(
            f"truncated or not a safetensors file ({' '.join(str(error).split())})", where=str(path)
        ) from error


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str]) -> None:
    """Write named tensors as a safetensors file. Raises OutputError."""
    with output_errors(path):
        try:
            save_file({k: v.detach().contiguous().cpu() for k, v in tensors.items()}, path, metadata)
        except SafetensorError as error:
            raise OutputError(f"cannot write: {' '.join(str(error).split())}", where=str(path)) from error
        _sort_header(path)


def _sort_header(path: Path) -> None:
    """Sort the names in a file's header, so that two equal runs write equal files: the library writes metadata in
    the random order of a hash map."""
    with open(path, "r+b") as file:
        # A file begins with 8 bytes, the length of the JSON header that follows; data are relative to its end.
        size = int.from_bytes(file.read(8), "little")
        header = json.loads(file.read(size))
        data = json.dumps(header, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
        if len(data) <= size:  # the format allows blanks at the end of the header
            file.seek(8)
            file.write(data.ljust(size))


def metadata_of(model: FlowModel) -> dict[str, str]:
    """Return the metadata of a file of weights: the format and the configuration of its network."""
    return {"format": FORMAT, "model": model.config.model_dump_json()}


def find_weights(path: str | os.PathLike) -> Path:
    """Return the file of weights of the checkpoint that ``path`` names: a .safetensors file, a checkpoint folder (the
    averaged weights, if there are any), a run folder (its newest checkpoint), or a network that comes with the package
    (:mod:`eflow.shipped`). A file or folder of that name has priority over the package's network. Raises AssetError."""
    path = Path(path)
    if path.is_file():
        return path
    if shipped.is_shipped(path):
        return shipped.weights_of(shipped.FOLDER / path)
    if not path.is_dir():
        raise AssetError(
            f"no such checkpoint{shipped.suggestion(str(path))}",
            where=str(path),
            accepted=f"a .safetensors file, a checkpoint folder or a run folder{shipped.known()}",
        )
    if (path / shipped.WEIGHTS).is_file():
        return shipped.weights_of(path)
    folder = path if (path / "weights.safetensors").is_file() else newest(path)
    if folder is None:
        raise AssetError(
            "no checkpoint in this folder", where=str(path), accepted="weights.safetensors, or checkpoints/<step>"
        )
    ema = folder / "ema.safetensors"
    return ema if ema.is_file() else folder / "weights.safetensors"


def newest(run: Path) -> Path | None:
    """Return the checkpoint with the highest step in ``run/checkpoints``, or None."""
    return max(_steps(run / "checkpoints"), key=lambda p: int(p.name), default=None)


def _steps(folder: Path) -> list[Path]:
    """Return the checkpoints in a folder, in order."""
    return sorted(p for p in folder.glob("*") if re.fullmatch("[0-9]{1,18}", p.name) and p.is_dir())


def config_of(path: str | os.PathLike) -> dict[str, object]:
    """Return the configuration of a checkpoint's network as plain data. Raises AssetError: as :func:`load_model`."""
    return json.loads(load_model(path).config.model_dump_json())


def load_model(path: str | os.PathLike) -> FlowModel:
    """Return the model of a checkpoint, in evaluation mode on the CPU.

    Raises AssetError: no checkpoint, a damaged one, or a pickle."""
    file = find_weights(path)
    tensors, metadata = read_tensors(file)
    try:
        if metadata["format"] != FORMAT:
            raise AssetError("checkpoint of another format", where=str(file), value=metadata["format"], accepted=FORMAT)
        tree = parse(metadata["model"])
    except (KeyError, ValueError):
        raise AssetError(
            "safetensors file without a model configuration", where=str(file), accepted="a checkpoint of eflow train"
        ) from None
    config = model_config(tree)
    with torch.device("meta"):  # shapes without memory: a small file may ask for a network of any size
        _require_fit(build_model(config).state_dict(), tensors, str(file))
    model = build_model(config)
    load_weights(model, tensors, str(file))
    return model.eval()


def load_weights(model: FlowModel, tensors: dict[str, Tensor], where: str) -> None:
    """Copy tensors into the model.

    Raises AssetError, and leaves the model unchanged: a name, a shape or a type does not fit, or a value is not
    finite."""
    _require_fit(model.state_dict(), tensors, where)
    for name, value in tensors.items():
        if not torch.isfinite(value).all():
            raise AssetError(
                f"tensor '{name}' holds NaN or infinity",
                where=where,
                accepted="a checkpoint from before the training diverged",
            )
    model.load_state_dict(tensors)


def _require_fit(wanted: dict[str, Tensor], tensors: dict[str, Tensor], where: str) -> None:
    """Raise AssetError when a name, a shape or a type of ``tensors`` is not that of ``wanted``."""
    for name in sorted(set(wanted) | set(tensors)):
        if name not in tensors:
            raise AssetError(f"lacks the tensor '{name}' of this model", where=where)
        if name not in wanted:
            raise AssetError(f"holds a tensor '{name}' that this model does not have", where=where)
        if wanted[name].shape != tensors[name].shape:
            raise AssetError(
                f"tensor '{name}' has another shape",
                where=where,
                value=tuple(tensors[name].shape),
                accepted=str(tuple(wanted[name].shape)),
            )
        if wanted[name].is_floating_point() != tensors[name].is_floating_point():
            raise AssetError(
                f"tensor '{name}' has another type",
                where=where,
                value=str(tensors[name].dtype),
                accepted=str(wanted[name].dtype),
            )


def save_checkpoint(
    run: Path,
    step: int,
    model: FlowModel,
    ema: dict[str, Tensor] | None,
    optimizer: torch.optim.Optimizer,
    state: Mapping[str, object],
    keep: int,
) -> Path:
    """Write ``run/checkpoints/<step>`` completely or not at all, then delete all but the newest ``keep``
    checkpoints."""
    final = run / "checkpoints" / f"{step:09d}"
    with atomic_folder(final, overwrite=True) as temporary:
        metadata = metadata_of(model)
        write_tensors(temporary / "weights.safetensors", model.state_dict(), metadata)
        if ema is not None:
            write_tensors(temporary / "ema.safetensors", ema, metadata)
        write_tensors(temporary / "optimizer.safetensors", optimizer_tensors(model, optimizer), {"format": FORMAT})
        with output_errors(final):
            (temporary / "state.json").write_text(
                json.dumps({"format": FORMAT, "step": step, **state}, indent=1) + "\n", encoding="utf-8"
            )
    for old in _steps(final.parent)[:-keep]:
        shutil.rmtree(old, ignore_errors=True)
    return final


def keep_best(run: Path, model: FlowModel, ema: dict[str, Tensor] | None, step: int, score: float) -> None:
    """Write the weights, averaged if they are, to ``run/best.safetensors`` if ``score``, the mean over validation sets
    of the AEE as a share of zero flow's, is lower than that of the file there."""
    path = run / "best.safetensors"
    best = float(read_tensors(path)[1].get("score", "inf")) if path.is_file() else math.inf
    # `not <` instead of `>=`: a score of NaN never replaces weights. Any other replaces those with a score of NaN.
    if path.is_file() and not score < (math.inf if math.isnan(best) else best):
        return
    with atomic_file(path) as temporary:
        about = {**metadata_of(model), "step": str(step), "score": repr(score)}
        write_tensors(Path(temporary), model.state_dict() if ema is None else ema, about)


def optimizer_tensors(model: FlowModel, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return AdamW's state by parameter name, and the states of torch's random generators (CPU, and GPU if any)."""
    names = {p: n for n, p in model.named_parameters()}
    tensors = {
        f"{name}/{k}": v
        for p, name in names.items()
        for k, v in optimizer.state.get(p, {}).items()
        if torch.is_tensor(v)
    }
    tensors["/rng/cpu"] = torch.get_rng_state()
    if torch.cuda.is_available():
        tensors["/rng/cuda"] = torch.cuda.get_rng_state()
    return tensors


def load_optimizer(path: Path, model: FlowModel, optimizer: torch.optim.Optimizer) -> None:
    """Restore what :func:`optimizer_tensors` returned. Raises AssetError."""
    tensors, _ = read_tensors(path)
    for name, p in model.named_parameters():
        moments = {k.removeprefix(f"{name}/"): v for k, v in tensors.items() if k.startswith(f"{name}/")}
        if any(v.shape not in ((), p.shape) for v in moments.values()):
            raise AssetError(f"optimiser state of '{name}' has another shape", where=str(path))
        if moments:  # AdamW keeps its step counter on the CPU, unless it is fused
            here = p.device if optimizer.defaults.get("fused") else torch.device("cpu")
            optimizer.state[p] = {k: v.to(here if k == "step" else p.device, copy=True) for k, v in moments.items()}
    if "/rng/cpu" not in tensors:
        raise AssetError("no generator state", where=str(path))
    torch.set_rng_state(tensors["/rng/cpu"])
    if "/rng/cuda" in tensors and torch.cuda.is_available():
        torch.cuda.set_rng_state(tensors["/rng/cuda"])


def read_state(folder: Path) -> State:
    """Return the content of ``state.json``. Raises AssetError."""
    path = folder / "state.json"
    try:
        state = parse(read_text(path))
        if state["format"] != FORMAT or type(state["step"]) is not int or state["step"] < 0:
            raise ValueError
        state["seconds"] = float(state.get("seconds", 0.0))  # of the whole training; old files lack it
        if not 0 <= state["seconds"] < 1e12:
            raise ValueError
    except OSError as error:
        raise AssetError("cannot be read", where=str(path)) from error
    except (ValueError, KeyError, TypeError, RecursionError):
        raise AssetError("damaged", where=str(path), accepted="a state.json of eflow train") from None
    return state


# ---------------------------------------------------------------------------------------------------------------------
# How a training starts: from the weights of another network, or from the newest checkpoint of its run.

_FREE = {"run"}
"""Sections of the configuration that may change when a run is resumed: they do not change the result."""
_OTHER = {
    "optim.clock": "wall",
    "optim.scale_gamma": 1.0,
    "optim.loss.relative": 0.0,
    "optim.loss.log": 0.0,
    "data.augment.transpose": 0.0,
    "optim.freeze_norm": False,
    "data.leave_out": [0, 0],
    "model.quick": False,
}
"""Keys that earlier versions had or lacked, with the values that reproduce what those versions computed."""


_PLACES = re.compile(r"data\.(train|validate_on)\.\d+\.(path|recipe)|init_from")
"""Keys that say where something is on this machine; :func:`same_content` compares what is there."""


def resume_run(
    folder: Path,
    config: TrainConfig,
    model: FlowModel,
    optimizer: torch.optim.Optimizer,
    ema: dict[str, Tensor] | None,
) -> State:
    """Restore a run from its newest checkpoint ``folder``; return its state. A finished training may get more steps or
    minutes."""
    state = read_state(folder)
    # Compared leaf by leaf, with defaults for keys that an older version did not have.
    saved, now = leaves(state.get("config", {})), {**_OTHER, **leaves(json.loads(config.model_dump_json()))}
    saved = {path: 1 for path in now if path.endswith(".uses")} | {**_OTHER, **saved}
    done = {"optim.steps": state["step"], "optim.minutes": state["seconds"] / 60}
    for path in sorted({*saved, *now}):
        before, wanted = saved.get(path), now.get(path)
        # Folders, workers and logs are facts of the machine, not of the training.
        free = path.split(".")[0] in _FREE or re.fullmatch(r"data\.(train\.\d+\.)?workers", path)
        if before is not None and wanted is not None:
            free = free or ("content" in state and _PLACES.fullmatch(path))
            # A finished run may get more steps.
            free = free or (path in done and _extends(wanted, before, done[path]))
        if not free and before != wanted:
            raise ConfigError(
                "differs from the run that is resumed",
                where=path,
                value=wanted,
                accepted=f"{before!r}, or a new run with init_from",
            )
    weights, _ = read_tensors(folder / "weights.safetensors")
    averaged = read_tensors(folder / "ema.safetensors")[0] if ema is not None else {}
    load_weights(model, weights, str(folder / "weights.safetensors"))
    load_optimizer(folder / "optimizer.safetensors", model, optimizer)
    # Copied in place: the run's averages are the tensors of this mapping.
    for k, average in (ema or {}).items():
        if k not in averaged or averaged[k].shape != average.shape:
            raise AssetError(f"lacks the tensor '{k}' of this model", where=str(folder / "ema.safetensors"))
        average.copy_(averaged[k])
    return state


def _extends(wanted: object, before: object, done: float) -> bool:
    """Whether a finished training gets a longer one: all steps or minutes of ``before`` are done."""
    number = (int, float)
    return isinstance(before, number) and isinstance(wanted, number) and done >= before and wanted > before


def same_content(saved: dict[str, str], now: dict[str, str], config: TrainConfig) -> None:
    """Raise ConfigError where data have another content than in the run that is resumed. A file of ``init_from`` that
    has gone is not needed any more."""
    places = leaves(json.loads(config.model_dump_json()))
    for path in sorted({*saved, *now}):
        if saved.get(path) != now.get(path, saved.get(path) if path == "init_from" else None):
            raise ConfigError(
                "another content than in the run that is resumed",
                where=path,
                value=places.get(path),
                accepted="the same files, wherever they are, or a new run with init_from",
            )


def leaves(tree: object, prefix: str = "") -> dict[str, object]:
    """Return the values of a tree of tables by their dotted keys."""
    if isinstance(tree, dict) and tree:
        return {
            k: v for key, node in tree.items() for k, v in leaves(node, f"{prefix}.{key}" if prefix else key).items()
        }
    if isinstance(tree, list) and tree and isinstance(tree[0], dict):
        return {k: v for i, node in enumerate(tree) for k, v in leaves(node, f"{prefix}.{i}").items()}
    return {prefix: tree}


def weights_of(config: TrainConfig) -> tuple[dict[str, Tensor], str]:
    """Return the weights that ``init_from`` names, and that name. Raises AssetError: they are of another model."""
    assert config.init_from is not None
    model = load_model(config.init_from)
    if model.config.name != config.model.name:
        raise AssetError(
            "checkpoint of another model",
            where=f"init_from: {config.init_from}",
            value=model.config.name,
            accepted=config.model.name,
        )
    return model.state_dict(), config.init_from
