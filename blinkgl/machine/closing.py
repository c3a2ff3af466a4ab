"""Base classes of what a ``with`` closes."""

from __future__ import annotations

from typing import Self


class Closing:
    """Closed at the end of its ``with``."""

    def close(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None = None, *_: object) -> None:
        self.close()


class Releasing:
    """Released at the end of its ``with``: what holds OpenGL's resources."""

    def release(self) -> None:
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


class Finishing(Closing):
    """Finished at the end of its ``with``, or given up where that ends in an exception."""

    def abort(self) -> None:
        """Stop without finishing; never raises."""
        raise NotImplementedError

    def __exit__(self, kind: type[BaseException] | None = None, *_: object) -> None:
        self.close() if kind is None else self.abort()
