"""BlinkGL: event-camera and optical-flow data sets by rasterisation."""

__version__ = "0.1.0"
