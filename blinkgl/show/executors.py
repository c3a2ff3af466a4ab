"""From the options of ``blinkgl generate`` to an executor."""

from __future__ import annotations

from blinkgl.dataset.executor import Executor, Inline, Local
from blinkgl.errors import ConfigError


def choose_executor(
    name: str, workers: int | None, *, address: str | None = None, gpus: float = 0.0, devices: str | None = None
) -> Executor:
    """``local`` without ``workers`` is this process itself. Raises ConfigError: unknown name,
    options of another executor, no Ray."""
    if name not in ("local", "ray"):
        raise ConfigError("unknown executor", where="--executor", value=name, accepted="local or ray")
    if name == "local":
        for option, value in (("--address", address), ("--gpus", gpus)):
            if value:
                raise ConfigError("belongs to --executor ray", where=option, value=value)
        numbers = _devices(devices)
        return Inline() if workers is None and numbers is None else Local(workers or 1, numbers)
    if devices is not None:
        raise ConfigError("belongs to --executor local; Ray deals out GPUs itself", where="--devices", value=devices)
    from blinkgl.dataset.cluster import RayCluster

    return RayCluster(workers, address=address, gpus=gpus)


def _devices(text: str | None) -> list[int] | None:
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdigit() for part in parts):
        raise ConfigError(
            "not a list of device numbers",
            where="--devices",
            value=text,
            accepted="numbers as `blinkgl doctor` lists them, e.g. 0,1",
        )
    return [int(part) for part in parts]
