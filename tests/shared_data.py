"""Finds the real-data folder that tests may use where it is present."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_REPOSITORY = Path(__file__).resolve().parent.parent


def shared_root() -> Path | None:
    """$BLINKGL_SHARED, or the folder ``shared`` beside the repository; None when there is none."""
    candidates = [os.environ.get("BLINKGL_SHARED"), _REPOSITORY.parent / "shared"]
    return next((Path(c) for c in candidates if c and Path(c).is_dir()), None)


def shared(path: str) -> Path:
    """``path`` in the shared folder; skips the calling test, saying so, when it is not there."""
    root = shared_root()
    if root is None:
        pytest.skip(f"no shared data folder (set BLINKGL_SHARED) for {path}")
    if not (root / path).exists():
        pytest.skip(f"shared data folder has no {path}")
    return root / path
