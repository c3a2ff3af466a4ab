"""Modules of POSIX systems; None elsewhere, where one process makes data sets without locks."""

from __future__ import annotations

try:
    import fcntl
    import resource
except ImportError:
    fcntl = resource = None

__all__ = ["fcntl", "peak_kib", "resource"]


def peak_kib() -> int:
    """Return the largest memory use of this process, KiB; 0 where the system does not report it."""
    return 0 if resource is None else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
