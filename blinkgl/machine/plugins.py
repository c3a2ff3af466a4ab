"""Plug-ins: Python files of the user that register emulators, labels, primitives, deformers, formats, networks.

``blinkgl --plugin my.py COMMAND …`` loads a file, and the entry points ``blinkgl.plugins`` of installed packages are
loaded before every command. Worker processes load the same ones, and manifests name them. Nothing is ever loaded
because a data file or a YAML asks for it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import sys
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points
from pathlib import Path

from blinkgl.errors import BlinkGLError, ConfigError

GROUP = "blinkgl.plugins"
"""Entry point group of packages that register something when they are imported."""
_VARIABLE = "BLINKGL_PLUGINS"
"""Files for the processes that this one starts, as a JSON list: a path may hold any separator."""
_PREFIX = "plug-in "
_LOADED: dict[str, str] = {}
_PATHS: dict[str, Path] = {}


def load_plugins(files: Iterable[str | os.PathLike] = ()) -> None:
    """Import the files, those of the process that started this one, and the entry points; each once.

    Raises ConfigError: a file is missing, fails, or has the name of another."""
    started_with = json.loads(os.environ.get(_VARIABLE) or "[]")
    for path in [Path(file).absolute() for file in (*started_with, *files)]:
        # Workers inherit the variable and are given the files, too: each is loaded once, however its path is written.
        if path.resolve() in [known.resolve() for known in _PATHS.values()]:
            continue
        if not path.is_file():
            raise ConfigError("no such file", where="--plugin", value=str(path), accepted="a Python file")
        if path.stem in _PATHS:
            raise ConfigError(f"{_PATHS[path.stem]} has this name, too", where="--plugin", value=str(path))
        spec = importlib.util.spec_from_file_location(f"blinkgl_plugin_{path.stem}", path)
        if spec is None or spec.loader is None:
            raise ConfigError("not a Python file", where="--plugin", value=str(path), accepted="NAME.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # where pydantic looks up the names of annotations
        _guarded(str(path), lambda: spec.loader.exec_module(module))  # noqa: B023
        _PATHS[path.stem] = path
        # The manifest names 64 bits of the sum: enough to tell two versions of a file apart.
        _LOADED[path.stem] = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    # Processes that are started from here load the same files before their first job.
    os.environ[_VARIABLE] = json.dumps(plugin_files())
    for point in entry_points(group=GROUP):
        if point.name not in _LOADED:
            _guarded(f"{GROUP}: {point.name}", point.load)
            source = sys.modules[point.module].__file__
            _LOADED[point.name] = hashlib.sha256(Path(source or "").read_bytes()).hexdigest()[:16]


def _guarded(where: str, load):
    try:
        return load()
    except BlinkGLError:
        raise
    except Exception as error:
        words = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError("the plug-in fails", where=where, value=words, accepted="a file that imports") from error


def plugin_files() -> list[str]:
    """Return the paths of the files that are loaded here, for workers on other machines."""
    return [str(path) for path in _PATHS.values()]


def plugin_versions() -> dict[str, str]:
    """Return what manifests say of the loaded plug-ins: "plug-in NAME" -> the beginning of its SHA-256."""
    return {_PREFIX + name: _LOADED[name] for name in sorted(_LOADED)}


def missing_plugins(versions: Mapping[str, str]) -> list[str]:
    """Return a line for every plug-in among a manifest's ``versions`` that is not loaded, or differs."""
    here, lines = plugin_versions(), []
    for key, digest in versions.items():
        if key.startswith(_PREFIX) and here.get(key) != digest:
            what = "is not loaded: blinkgl --plugin FILE" if key not in here else f"differs here (sha256 {here[key]} …)"
            lines.append(f"made with the {key} (sha256 {digest} …), which {what}")
    return lines
