"""A frame that OpenGL has drawn as a torch tensor: read, and handed to torch's device."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from blinkgl.errors import GLError


def as_tensor(picture: np.ndarray, device: Any) -> Any:
    """A picture that was read, as a torch tensor on a device of torch's. Raises GLError: no torch, or no such device
    here."""
    try:
        torch = importlib.import_module("torch")
    except ImportError:
        raise GLError(
            "tensors need torch", where="device", accepted="pip install blinkgl[tensors], or read()"
        ) from None
    try:
        return torch.from_numpy(picture).to(device)
    except Exception as error:  # noqa: BLE001 - torch raises what it likes for a device that is not there
        said = str(error).splitlines()[0][:120]
        raise GLError(f"no such device for torch ({said})", where="device", value=str(device), accepted="cpu") from None
