"""The version of the package, which manifests and files state."""

__version__ = "0.2.0"
