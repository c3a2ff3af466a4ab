"""BlinkGL: event-camera and optical-flow data sets by rasterisation."""

import os as _os

# numba's OpenMP threads would spin after every kernel and keep software OpenGL's threads off the cores (measured:
# the event kernel took 18 times as long between frames). libgomp reads this when it is loaded, hence here.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
