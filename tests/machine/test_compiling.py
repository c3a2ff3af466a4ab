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
def fresh(kept, tmp_path):
    """The same, with nothing on disk."""
    for file in tmp_path.rglob("*.nb?"):
        file.unlink()
    return kept


def test_what_compiles_is_said_once_and_counted_at_the_end(fresh):
    outer, inner = [], []
    compiling.watch._announced, compiling.watch.reported = False, (compiling.watch.kernels, compiling.watch.seconds)
    with compiling.announced_compiling(outer.append), compiling.announced_compiling(inner.append):
        twice = fresh()
        assert twice(3) == 6 and twice(1.5) == 3.0
    # Another process of the tests may have the turn.
    inner = [line for line in inner if not line.startswith("waiting for another process")]
    assert len(inner) == 2 and inner[0].startswith(
        "compiling the kernels that this needs, once per machine and version"
    )
    assert inner[1].startswith("compiled 2 kernels in ") and outer == []
    again = []
    with compiling.announced_compiling(again.append):
        assert fresh()(3) == 6
    assert not again, "it was kept"


PROGRAM = """
import sys, time
sys.path.insert(0, sys.argv[1])
from kernels_of_a_test import twice
print("ready", flush=True); sys.stdin.readline()
twice(3), twice(1.5), twice(3 + 1j)
from blinkgl.machine.compiling import watch
print(watch.kernels)
"""


@pytest.mark.usefixtures("fresh")
def test_one_process_compiles_and_the_others_find_it(tmp_path):
    """Four processes need the same three kernels at the same time."""
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen(command, **pipes) for _ in range(4)]
    assert all(process.stdout.readline() == "ready\n" for process in processes)
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    assert sum(int(process.communicate()[0]) for process in processes) == 3


@pytest.mark.usefixtures("fresh")
def test_a_process_that_is_ended_passes_its_turn_on(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", "from blinkgl.machine.kernels import turn; turn.begin(); print(1, flush=True); input()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdout.readline() == b"1\n"
    waiter = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert waiter.stdout.readline() == "ready\n"
    waiter.stdin.write("go\n")
    waiter.stdin.flush()
    with pytest.raises(subprocess.TimeoutExpired):
        waiter.wait(timeout=2)
    holder.kill()
    assert int(waiter.communicate()[0]) == 3


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
    monkeypatch.setattr(kernels, "_reported", set())
    with pytest.warns(RuntimeWarning, match="compiled in every process. NUMBA_CACHE_DIR=FOLDER keeps them") as said:
        thrice, fourfold = map(kernel, (lambda x: 3 * x, lambda x: 4 * x))
    assert thrice(2) == 6 and fourfold(2) == 8 and len(said) == 1


def test_an_edit_of_a_function_that_a_kernel_calls_is_seen():
    of_v2e = {name for name, _, _ in kernels._stamps_of_imports("blinkgl.events.v2e")}
    assert {
        f"blinkgl.events.{name}" for name in ("v2e", "v2e_blocks", "v2e_events", "v2e_model", "arith", "philox")
    } <= of_v2e
    assert not any("config" in name for name in of_v2e), "no kernel calls those"


def test_every_command_says_that_it_compiles(monkeypatch, capsys, watch):
    app = typer.Typer()

    @app.command()
    def some(nothing: bool = False) -> None:
        watch.start()
        watch.end()

    monkeypatch.setattr(command_line, "announced_compiling", compiling.announced_compiling)
    assert command_line.run_app(app, ["--nothing"], "some", "BlinkGL") == 0
    assert "compiling the kernels that this needs, once per machine" in capsys.readouterr().err
