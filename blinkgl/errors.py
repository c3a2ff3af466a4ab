"""Errors that a user can cause and read.

Every such error (a misspelt key, a missing mesh, a full disk) is raised as a :class:`BlinkGLError` whose ``str`` is one
line: the place (a config path, a file), the problem, the value, and what is accepted. The command line prints that line
and exits with status 2; ``--debug`` shows the traceback. Programming errors are ordinary exceptions.
"""

from __future__ import annotations

import errno

_MAX_VALUE_CHARS = 120
_MAX_TEXT_CHARS = 400


def _short(value: object) -> str:
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python does not print integers of more than 4300 digits
        text = "a number of thousands of digits"
    return text if len(text) <= _MAX_VALUE_CHARS else text[: _MAX_VALUE_CHARS - 1] + "…"


def printable(text: str, besides: str = "") -> str:
    """Return ``text`` with what is not printed escaped: control characters and a terminal's sequences, marks that turn
    the direction of text, halves of surrogates. besides : characters that are kept."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in besides else repr(c)[1:-1] for c in text)


def _plain(text: str) -> str:
    """Return ``text`` as one readable line; names of files and keys may contain anything and have any length."""
    text = printable(text)
    return text if len(text) <= _MAX_TEXT_CHARS else f"{text[: _MAX_TEXT_CHARS // 2]}…{text[-_MAX_TEXT_CHARS // 2 :]}"


class BlinkGLError(Exception):
    """An error for the user, one line.

    Parameters
    ----------
    problem : what is wrong, without a trailing full stop.
    where : config path (``scene.objects.count``), file or frame of the problem.
    value : the wrong value; it is shortened for display. Leave it out when there is none.
    accepted : what is accepted, or the command that solves the problem.
    """

    exit_status = 2
    passing = False
    """Whether the same work may succeed when it is tried again without any change; see :func:`may_pass`."""

    def __init__(self, problem: str, *, where: str | None = None, value: object = ..., accepted: str | None = None):
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
        super().__init__(printable(line))


class ConfigError(BlinkGLError):
    """A YAML file, ``--set`` option or Python config value that cannot be used."""


class AssetError(BlinkGLError):
    """A mesh, texture, video or other input file that is missing, corrupt or too large."""


class GLError(BlinkGLError):
    """OpenGL is not usable, or a shader does not compile."""

    passing = True  # a GPU was reset, or another process fills it


class OutputError(BlinkGLError):
    """Output cannot be written: existing folder, full disk, no permission."""

    passing = True


class EventDataError(BlinkGLError):
    """Frames or events that violate the emulator's or a format's requirements (time order, range, shape).

    pixel : (x, y) of the wrong pixel of a frame, if it is one.   t_ns : time of the wrong frame, if it is known."""

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
    """Return whether work that failed with ``error`` is worth another attempt with the same input.

    True for errors of the machine: memory, a file system that did not answer (also as the cause of another error, such
    as an asset on a network disk), output, OpenGL, and unknown exceptions (moderngl and drivers raise bare ones). False
    for errors that the input alone determines: configuration, assets, events, and bugs."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno in _MACHINE_TROUBLE):
            return True
        cause = cause.__cause__ or cause.__context__
    return error.passing if isinstance(error, BlinkGLError) else not isinstance(error, _BUGS)
