"""The ``blinkgl`` command: thin functions over the library, one line per error.

Exit status: 0 done, 2 the user's input or machine (``error: …`` on stderr, one line), 130 interrupted. A traceback means a
bug in BlinkGL, or ``--debug``. Commands import what they need inside the function, so that ``--help`` answers at once.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from typing import Annotated, Optional

import typer

from blinkgl import __version__
from blinkgl.errors import BlinkGLError

app = typer.Typer(name="blinkgl", add_completion=False, pretty_exceptions_enable=False)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"blinkgl {__version__}")
        raise typer.Exit()


@app.callback()
def _global_options(
    version: Annotated[bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error; allowed after the command, too.")] = False,
) -> None:
    """Event-camera and optical-flow data sets by rasterisation."""


# --- commands ---------------------------------------------------------------------------------------------------------


@app.command()
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
    backend: Annotated[str, typer.Option(help="OpenGL backend to examine: auto, egl or osmesa.")] = "auto",
    device: Annotated[int, typer.Option(min=0, help="EGL device to examine.")] = 0,
) -> None:
    """Say what this machine offers, what is missing, and the command that mends it. Exit status 2 if something required is missing."""
    from blinkgl import doctor as examination

    report = examination.examine(backend, device)
    if as_json:
        typer.echo(report.to_json())
    else:
        examination.show(report)
    if not report.ok:
        raise typer.Exit(BlinkGLError.exit_status)


@app.command()
def generate(
    config: Annotated[str, typer.Argument(help="YAML file; see configs/ for examples.")],
    out: Annotated[str, typer.Option("--out", "-o", help="Folder for the data set; sequences go to OUT/SPLIT/NAME_000000 ….")],
    num: Annotated[Optional[int], typer.Option("--num", "-n", min=1, help="Number of sequences (default: output.sequences).")] = None,
    seed: Annotated[Optional[int], typer.Option("--seed", help="Seed of the run (default: the file's).")] = None,
    overrides: Annotated[Optional[list[str]], typer.Option("--set", metavar="a.b=c", help="Override a value; may be repeated.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no table.")] = False,
) -> None:
    """Generate event + optical-flow sequences from one YAML file."""
    from blinkgl.dataset.show import generate_with_progress

    generate_with_progress(config, out, num=num, seed=seed, overrides=overrides or [], quiet=quiet)


# --- frame ------------------------------------------------------------------------------------------------------------


def run(arguments: list[str]) -> int:
    """Run one command line (without the program name); returns the exit status and raises nothing a user can cause."""
    debug = "--debug" in arguments
    arguments = [a for a in arguments if a != "--debug"] or ["--help"]
    try:
        # Not standalone: typer then hands errors up instead of printing its own boxes.
        status = app(arguments, prog_name="blinkgl", standalone_mode=False)
        return status if isinstance(status, int) else 0
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `blinkgl … | head`: nobody reads any more, which is no error of ours
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        line = _user_line(error)
        if debug or line is None:
            traceback.print_exc()
        if line is None:
            print("this is a bug in BlinkGL; please report the lines above and the command", file=sys.stderr)
            return 1
        print(f"error: {line}", file=sys.stderr)
        if isinstance(error, BlinkGLError):
            if getattr(error, "detail", ""):  # a shader's messages with the source around them
                print(f"\n{error.detail}", file=sys.stderr)
            return error.exit_status
        return BlinkGLError.exit_status


_MACHINE_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO, errno.ENAMETOOLONG,
                   errno.EMFILE, errno.ENFILE, errno.EFBIG}


def _user_line(error: Exception) -> str | None:
    """The line for an error that the user or the machine caused; None for a bug."""
    if isinstance(error, BlinkGLError):
        return str(error)
    if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # typer's usage errors; their class moved between versions
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "blinkgl"
        message = " ".join(error.format_message().split()).rstrip(".")
        return f"{message}; see '{command} --help'"
    if isinstance(error, OSError):
        code = error.errno
        if code is None and "No space left" in str(error):  # h5py keeps the number inside its text
            code = errno.ENOSPC
        if code in _MACHINE_ERRNOS:
            return f"{error.filename}: {os.strerror(code).lower()}" if error.filename else os.strerror(code).lower()
    return None


def main() -> None:
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
