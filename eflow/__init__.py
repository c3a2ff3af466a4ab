"""Optical flow from events: networks, training and evaluation. This package reads files of ``blinkgl.io`` or windows
that :mod:`blinkgl.online` renders during training; it never imports render or scene.

In:    data sets, a YAML of eflow.config.
Out:   a trained network, its scores, submission files of benchmarks.
Start: train.py; evaluate.py, infer.py, cli.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from eflow.checkpoint import load_model
    from eflow.infer import Predictor, open_sized, windows

__all__ = ["Predictor", "load_model", "open_sized", "windows"]
_FROM = {"load_model": "checkpoint", "Predictor": "infer", "open_sized": "infer", "windows": "infer"}


def __getattr__(name: str) -> object:
    """Import the names above when they are first used, so that ``import eflow`` does not import torch."""
    if name not in _FROM:
        raise AttributeError(f"module 'eflow' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"eflow.{_FROM[name]}"), name)
