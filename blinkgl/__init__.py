"""BlinkGL: event-camera and optical-flow data sets by rasterisation."""

import os as _os

# numba's OpenMP threads would spin after every kernel and keep software OpenGL's threads off the cores (measured:
# the event kernel took 18 times as long between frames). libgomp reads this when it is loaded, hence here.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"


def __getattr__(name: str):
    # Lazy, so that `import blinkgl` stays instant: the emulators bring numba.
    if name == "simulate":
        from blinkgl.simulation import simulate

        return simulate
    raise AttributeError(f"module 'blinkgl' has no attribute {name!r}")
