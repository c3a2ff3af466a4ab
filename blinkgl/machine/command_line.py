"""Runs a command line so that every error is one line for the user."""

from __future__ import annotations

import atexit
import errno
import os
import sys
import traceback
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from blinkgl.errors import BlinkGLError, ConfigError, printable
from blinkgl.machine.compiling import announced_compiling
from blinkgl.machine.extras import EXTRAS, install
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.machine.help import App
from blinkgl.machine.interrupts import STOPS, Stop, interruptible
from blinkgl.machine.plugins import load_plugins
from blinkgl.machine.terminal import never_fail_to_print
from blinkgl.version import __version__

_CTRL_C = 130


def _print_version(context: typer.Context, wanted: bool) -> None:
    if wanted:
        typer.echo(f"{context.info_name} {__version__}")
        raise typer.Exit


def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error; may also follow the command.")
    ] = False,
    plugin: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="Python file that registers parts of yours; before the command."),
    ] = None,
) -> None:
    load_plugins(plugin or ())


def new_app(name: str, about: str, examples: Mapping[str, tuple[str, ...]] | None = None) -> App:
    """Return a command without commands, with the options that every command line has. about : its help.   examples :
    as of :meth:`~blinkgl.machine.help.App.add_examples`."""
    app = App(
        name=name,
        add_completion=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback(
        help=about,
        epilog=f"\b\ndocs/tasks.md: forty tasks, a few lines each.\ndocs/… in a message is a page below\n{pages()}",
    )(_global_options)
    app.add_examples(name, examples or {})
    return app


def pages() -> Path:
    """Return the folder that holds docs/: the package's in a wheel, else the repository."""
    package = Path(__file__).resolve().parents[1]
    return package if (package / "docs").is_dir() else package.parent


def run_app(
    app: typer.Typer,
    arguments: list[str],
    program: str,
    project: str,
    gone: Mapping[str, str] | None = None,
    resumes: str = "generate",
) -> int:
    """Run ``app`` with ``arguments`` and return the exit status: 2 and one line for an error of the user or the
    machine, 130 (Ctrl-C) or 143 (SIGTERM) and one line when interrupted, 1 and a traceback for a bug.

    program : name of the command.   project : for reports of unforeseen errors.   gone : "command" or "command
    --option" of earlier versions, and what to use instead.   resumes : the command that has --resume."""
    never_fail_to_print()
    Stop.number = None
    debug = "--debug" in arguments
    arguments = [a for a in arguments if a != "--debug"] or ["--help"]
    try:
        # Not standalone: typer then raises errors instead of printing its own boxes.
        quiet = bool({"-q", "--quiet"} & {*arguments})
        with (
            interruptible(*STOPS),
            announced_compiling(lambda text: print(text, file=sys.stderr)),
            heartbeat.beating(quiet),
        ):
            _refuse_empty(arguments)
            status = app(arguments, prog_name=program, standalone_mode=False)
        # typer turns KeyboardInterrupt into this status, earlier versions into Abort.
        if status != _CTRL_C:
            return status if isinstance(status, int) else 0
        return _interrupted(arguments, resumes)
    except (KeyboardInterrupt, typer.Abort):
        return _interrupted(arguments, resumes)
    except BrokenPipeError:  # `blinkgl … | head`: the reader has gone, which is not an error
        # Python flushes stdout once more when it ends, which would fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:  # noqa: BLE001 - every error leaves as a line for the user
        if Stop.number is not None and not debug:  # some library turned the interrupt into an error of its own
            return _interrupted(arguments, resumes)
        answer = _said_of_gone(arguments, gone or {}) if _is_usage_error(error) else None
        return _report(error if answer is None else answer, debug, project)


def _refuse_empty(arguments: list[str]) -> None:
    """Raise ConfigError for an --out without a name, which is the current folder to Python: "$OUT", not set."""
    pairs = [*pairwise(arguments), *(argument.split("=", 1) for argument in arguments if "=" in argument)]
    for option, value in pairs:
        if option in ("--out", "-o") and not value:
            raise ConfigError("is empty", where=option, value=value, accepted="a name")


def _interrupted(arguments: list[str], resumes: str) -> int:
    print("interrupted" + ("; --resume continues" if resumes in arguments else ""), file=sys.stderr)
    return Stop.status()


def safe_main(run: Callable[[list[str]], int]) -> NoReturn:
    """Run the command line of this process and leave with its status. Processes that it starts, those of libraries,
    too, import nothing from the folder that the user stands in (-P of Python)."""
    os.environ.setdefault("PYTHONSAFEPATH", "1")
    status = run(sys.argv[1:])
    if Stop.number is not None:
        # An interrupt that passed through exec() makes Python end itself by SIGINT, whatever the status.
        atexit._run_exitfuncs()  # noqa: SLF001
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def _is_usage_error(error: Exception) -> bool:
    # typer's usage errors; their class moved between versions.
    return hasattr(error, "format_message") and hasattr(error, "exit_code")


def _said_of_gone(arguments: list[str], gone: Mapping[str, str]) -> ConfigError | None:
    """Return the error for a command or an option of earlier versions among the arguments; None: there is none."""
    options = {argument.partition("=")[0] for argument in arguments}
    for words, answer in gone.items():
        command, _, option = words.partition(" --")
        if arguments[: len(command.split())] == command.split() and (not option or f"--{option}" in options):
            return ConfigError("was removed", where=f"--{option}" if option else command, accepted=answer)
    return None


def _report(error: Exception, debug: bool, project: str) -> int:
    line = user_line(error)
    if debug or line is None:
        traceback.print_exception(error)
    if line is None:
        print(f"this is a bug in {project}; please report the lines above and the command", file=sys.stderr)
        return 1
    print(f"error: {printable(line)}", file=sys.stderr)
    if not isinstance(error, BlinkGLError):
        return BlinkGLError.exit_status
    if getattr(error, "detail", ""):  # a shader's messages with the source around them
        print(f"\n{error.detail}", file=sys.stderr)
    return error.exit_status


OUT_OF_MEMORY = (
    "out of memory; use a smaller image, fewer workers or shorter sequences, or raise the limit on the process "
    "('ulimit -v' shows it)"
)
_MACHINE_ERRNOS = {
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.EIO,
    errno.ENAMETOOLONG,
    errno.EMFILE,
    errno.ENFILE,
    errno.EFBIG,
}


def user_line(error: Exception) -> str | None:
    """Return the line for an error that the user or the machine caused; None for a bug."""
    if isinstance(error, BlinkGLError):
        return str(error)
    if _is_usage_error(error):
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "blinkgl"
        message = " ".join(error.format_message().split()).rstrip(".")  # type: ignore[missing-attribute]
        if type(error).__name__ == "NoArgsIsHelpError" and context is not None:  # whose message is the whole help
            message = f"Missing command, one of {', '.join(context.command.commands)}"
        return f"{message}; see '{command} --help'"
    if isinstance(error, ModuleNotFoundError) and error.name in EXTRAS["learn"][0]:
        return f"{error.name} is not installed; run {install(*EXTRAS['learn'][0])}"
    if is_out_of_memory(error):
        asked = " ".join(str(error).split())
        return OUT_OF_MEMORY + (f" ({asked[:120]})" if asked else "")
    if isinstance(error, OSError):
        code = error.errno
        if code is None and "No space left" in str(error):  # h5py keeps the number inside its text
            code = errno.ENOSPC
        if code in _MACHINE_ERRNOS:
            return f"{error.filename}: {os.strerror(code).lower()}" if error.filename else os.strerror(code).lower()
    return None


def is_out_of_memory(error: BaseException | None) -> bool:
    """Return whether memory ran out: MemoryError (NumPy's too), ENOMEM, or the words that OpenCV, LLVM, torch and HDF5
    say it in."""
    seen: set[int] = set()
    # Causes may lead back to an error that was seen before.
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            return True
        text = str(error).lower()
        if any(
            words in text
            for words in (
                "cannot allocate memory",
                "can't allocate memory",
                "insufficient memory",
                "bad_alloc",
                "out of memory",
                "unable to allocate",
                "failed to map segment",
            )
        ):
            return True
        error = error.__cause__ or error.__context__
    return False
