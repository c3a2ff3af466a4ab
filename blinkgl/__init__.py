"""BlinkGL: event-camera and optical-flow data sets by rasterisation."""

__version__ = "0.1.0"


def __getattr__(name: str):
    # Lazy, so that `import blinkgl` stays instant: the emulators bring numba.
    if name == "simulate":
        from blinkgl.simulation import simulate

        return simulate
    raise AttributeError(f"module 'blinkgl' has no attribute {name!r}")
