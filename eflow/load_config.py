"""The configuration of a training: a YAML file, overrides, and the network that it goes on from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from blinkgl.config.problems import validate
from blinkgl.config.reader import apply_overrides, read_table
from eflow import shipped
from eflow.checkpoint import config_of
from eflow.config import TrainConfig


def load_train_config(
    path: str | Path | None,
    overrides: list[str] | tuple[str, ...] = (),
    *,
    model: Mapping[str, object] | None = None,
    data: Sequence[str] = (),
    minutes: float | None = None,
) -> TrainConfig:
    """Read a YAML file and apply ``a.b=c`` overrides; data paths become absolute, relative to the YAML file's folder.

    model, data, minutes : values of the command line that replace the file's ``model``, ``data.train`` (folders, or
    recipes to render during training) and ``optim.minutes``; relative to the working folder. path : None: only those
    and the overrides; images are then not scaled, which would need a crop.
    Raises ConfigError: missing file, bad YAML, unknown key, bad value; without a file, no model or no data."""
    tree = {"data": {"augment": {"scale_probability": 0}}} if path is None else read_table(path)
    if model is not None:
        tree = {**tree, "model": model}
    if data:
        sets = [
            {"recipe": str(Path(p).resolve()), "online": True}
            if p.endswith((".yaml", ".yml"))
            else {"path": str(Path(p).resolve())}
            for p in data
        ]
        tree = _laid_over(tree, "data", "train", sets)
    if minutes is not None:
        tree = _laid_over(tree, "optim", "minutes", minutes)
    path = Path("train.yaml" if path is None else path)
    absolute = lambda p: str(path.parent.resolve() / p)  # an absolute p is unchanged
    tree = apply_overrides(tree, overrides)
    own = tree.get("init_from")
    if tree.get("model") is None and isinstance(own, str) and (start := _start(own, absolute)) is not None:
        tree = {**tree, "model": config_of(start)}
    config = validate(TrainConfig, tree)
    sources = {
        k: tuple(
            s.model_copy(update={key: absolute(p) for key in ("path", "recipe") if (p := getattr(s, key)) is not None})
            for s in getattr(config.data, k)
        )
        for k in ("train", "validate_on")
    }
    return config.model_copy(
        update={
            "data": config.data.model_copy(update=sources),
            "init_from": _start(config.init_from, absolute),
        }
    )


def _laid_over(tree: dict, section: str, key: str, value: object) -> dict:
    """Return the tree with a value in a section; as it is where that is no table, which the validation refuses."""
    table = tree.get(section) or {}
    return {**tree, section: {**table, key: value}} if isinstance(table, dict) else tree


def _start(init_from: str | None, absolute: Callable[[str], str]) -> str | None:
    """Return a checkpoint's path or a shipped network's name; a file beside the YAML goes before a network of that
    name."""
    if not init_from:
        return None
    path = absolute(init_from)
    return init_from if init_from in shipped.names() and not Path(path).exists() else path
