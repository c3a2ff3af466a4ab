"""The command's frame: one line per error, its exit status, a traceback only when asked for."""

from __future__ import annotations

import errno
import importlib
import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from blinkgl import __version__, cli
from blinkgl.errors import ConfigError
from blinkgl.gl import ShaderError
from blinkgl.machine.command_line import new_app


def gone_of(program: str) -> list[str]:
    """Commands and options that it no longer has."""
    if program.startswith("eflow") and importlib.util.find_spec("torch") is None:
        return []
    return sorted(importlib.import_module(program).GONE)


@pytest.fixture
def failing(monkeypatch):
    """``failing(error)`` makes ``blinkgl fail`` raise it."""
    app = new_app("blinkgl", "A command that fails.")
    error: list[BaseException] = []

    @app.command()
    def fail() -> None:
        raise error[0]

    @app.command()
    def other() -> None:
        """So that typer keeps 'fail' a sub-command."""

    monkeypatch.setattr(cli, "app", app)

    def make(e: BaseException) -> None:
        error[:] = [e]

    return make


def outcome(capsys, *arguments: str) -> tuple[int, str, str]:
    status = cli.run(list(arguments))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_user_error_is_one_line_and_2(failing, capsys):
    failing(ConfigError("must be positive", where="camera.width", value=-3, accepted="1 to 16384 px"))
    status, out, err = outcome(capsys, "fail")
    assert (status, out) == (2, "")
    assert err == "error: camera.width: must be positive (got -3); expected 1 to 16384 px\n"


@pytest.mark.parametrize("arguments", [("--debug", "fail"), ("fail", "--debug")])
def test_debug_adds_the_traceback(failing, capsys, arguments):
    failing(ConfigError("must be positive", where="camera.width"))
    status, _, err = outcome(capsys, *arguments)
    assert status == 2 and "Traceback" in err and "in fail" in err
    assert err.endswith("error: camera.width: must be positive\n")


def test_shader_error_shows_its_source(failing, capsys):
    failing(ShaderError("bad", where="a.glsl:3", detail="> 3 | x"))
    assert outcome(capsys, "fail") == (2, "", "error: a.glsl:3: bad\n\n> 3 | x\n")


@pytest.mark.parametrize(
    "error, line",
    [
        (OSError(errno.ENOSPC, "No space left on device", "out/events.h5"), "out/events.h5: no space left on device"),
        (OSError(errno.ENOSPC, "No space left on device"), "no space left on device"),
        (
            OSError("Can't write data (file write failed: errno = 28, error message = 'No space left on device')"),
            "no space left on device",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "/data"), "/data: permission denied"),
        (OSError(errno.EROFS, "Read-only file system", "/data"), "/data: read-only file system"),
    ],
)
def test_the_machines_errors_are_one_line_and_2(failing, capsys, error, line):
    failing(error)
    assert outcome(capsys, "fail") == (2, "", f"error: {line}\n")


def test_interrupt_is_130(failing, capsys):
    failing(KeyboardInterrupt())
    status, _, err = outcome(capsys, "fail")
    assert status == 130 and "Traceback" not in err


def test_a_bug_keeps_its_traceback(failing, capsys):
    failing(ZeroDivisionError("division by zero"))
    status, _, err = outcome(capsys, "fail")
    assert status == 1 and "ZeroDivisionError" in err and "bug in BlinkGL" in err


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--nope",), ["--nope", "see 'blinkgl --help'"]),
        (("doctr",), ["doctr", "see 'blinkgl --help'"]),
        (("doctor", "--device", "-1"), ["--device", "see 'blinkgl doctor --help'"]),
        (("doctor", "extra"), ["extra", "see 'blinkgl doctor --help'"]),
    ],
)
def test_usage_errors_are_one_line_and_2(capsys, arguments, words):
    status, out, err = outcome(capsys, *arguments)
    assert (status, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1 and all(word in err for word in words)


@pytest.mark.parametrize(("program", "words"), [(p, w) for p in ("blinkgl.cli", "eflow.cli") for w in gone_of(p)])
def test_what_was_removed_says_what_to_do_instead(capsys, program, words):
    """Also with a value, and where the rest of the line is not one that could be run."""
    module = importlib.import_module(program)
    command, dashes, option = words.partition(" --")
    for ending in ([], ["20,0.6"]):
        assert module.run([*command.split(), *([f"--{option}"] if dashes else []), *ending]) == 2
        where = f"--{option}" if dashes else command
        line = f"error: {where}: was removed; expected {module.GONE[words]}\n"
        assert capsys.readouterr().err == line


def test_version_and_help(capsys):
    assert outcome(capsys, "--version") == (0, f"blinkgl {__version__}\n", "")
    for arguments in ((), ("--help",)):
        status, out, err = outcome(capsys, *arguments)
        assert status == 0 and "doctor" in out and err == ""


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from blinkgl import cli; cli.run(['--help']);heavy = {'numpy', 'numba', 'moderngl', 'trimesh', "
        "'scipy', 'cv2', 'h5py', 'torch', 'matplotlib', 'pydantic'} & set(sys.modules);sys.exit(f'imported: "
        "{sorted(heavy)}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 7.45 GiB for an array"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("LLVM ERROR: out of memory"),
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
    ],
)
@pytest.mark.parametrize("program", ["blinkgl", "eflow"])
def test_no_memory_left_is_one_line_that_says_what_helps(program, error, capsys, monkeypatch):
    from eflow import cli as eflow_cli

    def fail(*_, **__):
        raise RuntimeError("while doing something") from error

    module = cli if program == "blinkgl" else eflow_cli
    monkeypatch.setattr(module, "app", fail)
    status = module.run(["doctor"])
    err = capsys.readouterr().err
    assert (
        status == 2
        and err.count("\n") == 1
        and "error: out of memory; use a smaller image" in err
        and "ulimit -v" in err
    )


def test_a_memory_limit_ends_a_command_in_one_line(tmp_path):
    """simulate of frames that do not fit into what 'ulimit -v' leaves."""
    np.lib.format.open_memmap(tmp_path / "frames.npy", "w+", np.uint8, (2, 30_000, 30_000))[:1, :1, :1] = 1
    command = (
        f"ulimit -v 3000000; exec {sys.executable} -m blinkgl simulate {tmp_path}/frames.npy --fps 100 -o "
        f"{tmp_path}/e.npz"
    )
    done = subprocess.run(
        command, shell=True, capture_output=True, text=True, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    )
    assert done.returncode == 2 and done.stderr.startswith("error: out of memory; ") and done.stderr.count("\n") == 1, (
        done.stderr
    )
    assert not (tmp_path / "e.npz").exists()


@pytest.mark.parametrize("words, given", [([], []), (["--both-sides"], ["true"]), (["--one-side"], ["false"])])
def test_sides_of_files_are_an_override(monkeypatch, words, given):
    seen = {}
    monkeypatch.setattr("blinkgl.show.generate.run", lambda *_, **keys: seen.update(keys) or 0)
    assert cli.run(["generate", "a.yaml", "-o", "out", "--set", "seed=3", *words]) == 0
    assert seen["overrides"] == ["seed=3", *(f"scene.both_sides={value}" for value in given)]


@pytest.mark.parametrize("program", ["blinkgl", "blinkgl shader", "eflow"])
def test_every_summary_fits_80_columns(program, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    name, *group = program.split()
    __import__({"blinkgl": "blinkgl.cli", "eflow": "eflow.cli"}[name], fromlist=["run"]).run([*group, "--help"])
    out = capsys.readouterr().out
    assert "Commands:" in out and "..." not in out.partition("Commands:")[2]
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.parametrize("words", ["", "generate", "simulate", "shader probe", "verify", "compare"])
def test_the_short_word_for_help_is_help(capsys, words):
    assert cli.run([*words.split(), "-h"]) == 0
    short = capsys.readouterr().out
    assert cli.run([*words.split(), "--help"]) == 0
    assert short == capsys.readouterr().out and "-h, --help" in short
