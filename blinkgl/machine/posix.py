"""What POSIX systems alone have; None elsewhere, where one process makes data sets and locks nothing."""

from __future__ import annotations

try:
    import fcntl
    import resource
except ImportError:
    fcntl = resource = None

__all__ = ["fcntl", "peak_kib", "resource"]


def peak_kib() -> int:
    """The most memory that this process has had, KiB; 0 where the system does not say."""
    return 0 if resource is None else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
