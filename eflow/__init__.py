"""Optical flow from events: networks, training, scores. Reads what ``blinkgl.io`` wrote, or
what :mod:`blinkgl.online` renders meanwhile; never imports render or scene.

In:    data sets, a YAML of eflow.config.
Out:   a trained network, its scores, files for benchmarks.
Start: train.py; evaluate.py, infer.py, cli.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from eflow.checkpoint import load_model
    from eflow.infer import Predictor, open_sized, windows

__all__ = ["Predictor", "load_model", "open_sized", "windows"]
_FROM = {"load_model": "checkpoint", "Predictor": "infer", "open_sized": "infer", "windows": "infer"}


def __getattr__(name: str) -> Any:
    """The names above, looked up when they are first used: torch is not imported before."""
    if name not in _FROM:
        raise AttributeError(f"module 'eflow' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"eflow.{_FROM[name]}"), name)
