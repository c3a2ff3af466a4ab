"""Compilation is reported by itself and counts in no other figure; kernels on disk are used only if they are whole."""

import importlib
import subprocess
import sys

import numba
import numpy as np
import pytest
import typer

import blinkgl.events.v2e  # noqa: F401 - looked at by name
from blinkgl.machine import command_line, compiling, kernels
from blinkgl.machine.kernels import kernel
from blinkgl.sequence.request import StageClock


def test_compilation_is_counted_once():
    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) * 2

    before = compiling.compiled_s()
    assert outer(3) == 8
    took = compiling.compiled_s() - before
    assert took > 0, "both, the inner one once"
    outer(4)
    assert compiling.compiled_s() == before + took, "compiled already"


@pytest.fixture
def watch(monkeypatch):
    """A watch of its own, and a clock that stands still."""
    now = [10.0]
    monkeypatch.setattr(compiling.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(compiling, "watch", watch := compiling.Watch())
    watch.now = now
    return watch


def test_stages_and_total_are_without_compilation(watch):
    clock = StageClock()
    with clock("events"):
        watch.now[0] += 1.0
        watch.start()
        watch.start()
        watch.now[0] += 14.0
        watch.end()
        watch.end()
        watch.now[0] += 0.5
    assert clock.seconds == {"events": 1.5} and clock.total == 1.5 and clock.compile_s == 14.0


@pytest.fixture
def ahead(monkeypatch, watch, tmp_path):
    """The calls of the program that compiles all kernels, which here only prints."""
    calls = []

    def run(command, **_):
        calls.append(command)
        watch.now[0] += 30.0
        return subprocess.CompletedProcess(command, 0, "compiled 70 kernels in 30 s\n")

    monkeypatch.setattr(compiling.subprocess, "run", run)
    monkeypatch.setattr(kernels, "watch", watch)
    monkeypatch.setattr(kernels, "_stamp", lambda: tmp_path / "stamp")
    return calls


def test_the_first_kernel_that_is_missing_has_all_compiled_which_is_said_once(kept, tmp_path, ahead, watch):
    for file in tmp_path.rglob("*.nb?"):
        file.unlink()
    outer, inner = [], []
    with compiling.announced_compiling(outer.append), compiling.announced_compiling(inner.append):
        twice = kept()
        assert twice(3) == 6 and twice(1.5) == 3.0
    assert [call[-1] for call in ahead] == ["blinkgl.show.compile_kernels"] and outer == []
    assert inner == ["compiling kernels, once per machine and version: about a minute", "compiled 70 kernels in 30 s"]
    assert watch.seconds >= 30.0, "it belongs to no stage of a sequence"
    watch.all_compiled = False  # another process, and a kernel of no common command
    with compiling.announced_compiling(inner.append):
        assert kept()(np.int8(3)) == 6
    assert len(ahead) == 1 and len(inner) == 2


def test_nothing_is_compiled_ahead_where_nobody_listens_or_kernels_cannot_be_kept(kept, ahead, watch):
    assert kept()(np.int8(3)) == 6
    said = []
    with compiling.announced_compiling(said.append):
        compiling.kernel_cache_failed("the disk is full")
        assert kept()(np.int16(3)) == 6
    assert ahead == [] and said == ["warning: the disk is full"]


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """A function that imports a module with a kernel anew; what is kept of it lies beside it."""
    (tmp_path / "kernels_of_a_test.py").write_text(
        "from blinkgl.machine.kernels import kernel\n\n\n@kernel\ndef twice(x):\n    return 2 * x\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))

    def imported():
        sys.modules.pop("kernels_of_a_test", None)
        return importlib.import_module("kernels_of_a_test").twice

    twice = imported()
    assert twice(3) == 6 and twice(1.5) == 3.0
    yield imported
    sys.modules.pop("kernels_of_a_test", None)


def test_a_kernel_is_compiled_once(kept):
    again = kept()
    assert again(3) == 6 and again.stats.cache_hits == {numba.typeof(3).name and again.signatures[0]: 1}


@pytest.mark.parametrize("where", [0, 9, 40, -30, -1])
@pytest.mark.parametrize("pattern", ["*.nbi", "*.1.nbc"])
def test_a_damaged_kernel_is_said_and_compiled_again(kept, tmp_path, pattern, where):
    (file,) = tmp_path.rglob(pattern)
    content = bytearray(file.read_bytes())
    content[where] ^= 0x5A
    file.write_bytes(content)
    said = []
    with compiling.announced_compiling(said.append):
        twice = kept()
        assert twice(3) == 6 and twice(1.5) == 3.0
    assert len([line for line in said if "damaged" in line]) <= 1
    assert all(str(file.parent) in line for line in said if "damaged" in line)
    healed = kept()
    assert healed(3) == 6 and healed(1.5) == 3.0 and not healed.stats.cache_misses, "it was kept again"


def test_an_index_that_leads_to_the_code_of_other_types_is_not_followed(kept, tmp_path):
    one, other = sorted(tmp_path.rglob("*.nbc"))
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    with pytest.warns(RuntimeWarning, match="damaged or unreadable and are compiled again"):
        assert kept()(3) == 6
    assert kept()(1.5) == 3.0


def test_what_cannot_be_kept_is_compiled_in_memory(kept, tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    twice = kept()
    monkeypatch.setattr(twice._cache._cache_file, "_open_for_write", refuse)
    with pytest.warns(RuntimeWarning, match=r"cannot be kept there \(Permission denied\)"):
        assert twice(np.int8(4)) == 8


def test_no_folder_for_kernels_is_a_line_and_kernels_run(monkeypatch):
    def nowhere(self, function):
        raise RuntimeError("cannot cache function 'thrice': no locator available")

    monkeypatch.setattr("blinkgl.machine.kernels._Cache.__init__", nowhere)
    monkeypatch.setattr(kernels, "_said", set())
    with pytest.warns(RuntimeWarning, match="compiled in every process. NUMBA_CACHE_DIR=FOLDER keeps them") as said:
        thrice, fourfold = map(kernel, (lambda x: 3 * x, lambda x: 4 * x))
    assert thrice(2) == 6 and fourfold(2) == 8 and len(said) == 1


def test_an_edit_of_a_function_that_a_kernel_calls_is_seen():
    of_v2e = {name for name, _, _ in kernels._stamps_of_imports("blinkgl.events.v2e")}
    assert {f"blinkgl.events.{name}" for name in ("v2e", "v2e_blocks", "v2e_model", "arith", "philox")} <= of_v2e
    assert not any("config" in name for name in of_v2e), "no kernel calls those"


def test_every_command_says_that_it_compiles(monkeypatch, capsys, ahead, watch, tmp_path):
    app = typer.Typer()

    @app.command()
    def some(nothing: bool = False) -> None:
        watch.compile_all(tmp_path / "stamp")

    monkeypatch.setattr(command_line, "announced_compiling", compiling.announced_compiling)
    assert command_line.run_app(app, ["--nothing"], "some", "BlinkGL") == 0
    assert "compiling kernels, once per machine" in capsys.readouterr().err
