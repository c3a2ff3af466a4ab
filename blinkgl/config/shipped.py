"""What ships with the program, by name: runs, and tables of sensors, rigs, quality presets, emulators' recipes."""

from __future__ import annotations

import copy
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from blinkgl.config.reader import parse_yaml
from blinkgl.errors import ConfigError


@lru_cache
def shipped_names(kind: str) -> tuple[str, ...]:
    """Names of all of a kind, a folder of ``blinkgl/configs``, sorted."""
    files = (resources.files("blinkgl.configs") / kind).iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))


def shipped(kind: str, name: str) -> dict[str, Any]:
    """A copy of the table of this name, one of :func:`shipped_names`."""
    return copy.deepcopy(_read(kind, name))


@lru_cache
def _read(kind: str, name: str) -> dict[str, Any]:
    text = (resources.files("blinkgl.configs") / kind / f"{name}.yaml").read_text(encoding="utf-8")
    return parse_yaml(text, f"{kind}/{name}.yaml")


_RUNS = ("*.yaml", "scenes/*.yaml", "eflow/*_data.yaml")


@lru_cache
def shipped_runs() -> dict[str, Path]:
    """The files of whole runs, by name: "demo", "flags" …"""
    folder = Path(str(resources.files("blinkgl.configs")))
    return {path.stem: path for pattern in _RUNS for path in sorted(folder.glob(pattern))}


def run_file(given: str | Path) -> Path:
    """The file ``given``, or, where there is none, the shipped run that it names: "demo", "demo.yaml" and
    "configs/demo.yaml" are one. (A folder is none: after ``generate demo --out demo`` there is one.) Raises
    ConfigError."""
    path = Path(given)
    shipped_one = shipped_runs().get(path.stem)
    if (path.exists() or path.is_symlink()) and not (path.is_dir() and str(path) == path.stem and shipped_one):
        return path
    named = shipped_one is not None and shipped_one.as_posix().endswith(f"/{path.with_suffix('.yaml').as_posix()}")
    if shipped_one is not None and (named or path.parent == Path()):
        return shipped_one
    raise ConfigError("no such file", where=str(given), accepted="a YAML file, or a name that 'blinkgl configs' lists")
