"""Errors that are meant for the person at the keyboard.

Everything a user can cause (a misspelt key, a missing mesh, a full disk) is raised as a
:class:`BlinkGLError` whose ``str`` is one line: where it is (a config path, a file), the value, and what
would be accepted. The command line prints that line and exits with status 2; ``--debug`` shows the
traceback. Programming errors stay ordinary exceptions.
"""

from __future__ import annotations

import errno
from typing import Any

_MAX_VALUE_CHARS = 120
_MAX_TEXT_CHARS = 400


def _short(value: Any) -> str:
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python prints no whole number of more than 4300 digits
        text = "a number of thousands of digits"
    return text if len(text) <= _MAX_VALUE_CHARS else text[: _MAX_VALUE_CHARS - 1] + "…"


def _plain(text: str) -> str:
    """One readable line: what a file or a key is called may hold anything, and be of any length."""
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return text if len(text) <= _MAX_TEXT_CHARS else f"{text[: _MAX_TEXT_CHARS // 2]}…{text[-_MAX_TEXT_CHARS // 2 :]}"


class BlinkGLError(Exception):
    """One line for the user.

    Parameters
    ----------
    problem : what is wrong, without a trailing full stop.
    where : config path (``scene.objects.count``), file or frame the problem is at.
    value : the offending value; shown shortened. Leave out when there is none.
    accepted : what would be accepted, or the command that mends it.
    """

    exit_status = 2
    passing = False
    """Whether the same work may succeed when it is tried again without anybody mending anything;
    see :func:`may_pass`."""

    def __init__(self, problem: str, *, where: str | None = None, value: Any = ..., accepted: str | None = None):
        self.problem, self.where, self.value, self.accepted = problem, where, value, accepted
        line = f"{_plain(where)}: {_plain(problem)}" if where else _plain(problem)
        if value is not ...:
            line += f" (got {_short(value)})"
        if accepted:
            line += (
                f"; expected {accepted}"
                if not accepted.startswith(("run ", "try ", "use ", "see "))
                else f"; {accepted}"
            )
        super().__init__(line)


class ConfigError(BlinkGLError):
    """A YAML file, ``--set`` option or Python config value that cannot be used."""


class AssetError(BlinkGLError):
    """A mesh, texture, video or other input file that is missing, corrupt or beyond a limit."""


class GLError(BlinkGLError):
    """No usable OpenGL, or a shader that does not compile."""

    passing = True  # a card that was reset, or that another process fills


class OutputError(BlinkGLError):
    """Output that cannot be written: existing folder, full disk, no permission."""

    passing = True


class EventDataError(BlinkGLError):
    """Frames or events outside the emulator's or a format's contract (time order, range, shape).

    pixel : (x, y) of the pixel of a frame that is at fault, where it is one.   t_ns : time of
    the frame that is, where it is known."""

    pixel: tuple[int, int] | None = None
    t_ns: int | None = None


_MACHINE_TROUBLE = frozenset(
    {
        errno.EIO,
        errno.ESTALE,
        errno.ETIMEDOUT,
        errno.EAGAIN,
        errno.EMFILE,
        errno.ENFILE,
        errno.ENOMEM,
        errno.EBUSY,
        errno.ENODEV,
        errno.ENXIO,
        errno.EREMOTEIO,
        errno.ECONNRESET,
    }
)
_BUGS = (
    TypeError,
    ValueError,
    LookupError,
    ArithmeticError,
    AttributeError,
    AssertionError,
    NameError,
    ImportError,
    NotImplementedError,
)


def may_pass(error: BaseException) -> bool:
    """Whether work that failed with ``error`` is worth another attempt with the same input.

    True for what the machine did: memory, a file system that did not answer (also as the cause of another error: an
    asset that a network disk would not give), output, OpenGL, and whatever has no name here (moderngl and drivers raise
    bare exceptions). False for what the input decides alone: configuration, assets, events, and bugs."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno in _MACHINE_TROUBLE):
            return True
        cause = cause.__cause__ or cause.__context__
    return error.passing if isinstance(error, BlinkGLError) else not isinstance(error, _BUGS)
