"""Compiling kernels is told by itself and is in nobody's seconds."""

import importlib
import pickle
import sys

import numba
import pytest

from blinkgl.machine import compiling
from blinkgl.machine.command_line import user_line
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


def test_stages_and_total_are_without_compilation(monkeypatch):
    now = [10.0]
    monkeypatch.setattr(compiling.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(compiling, "_watch", watch := compiling._Watch())
    clock = StageClock()
    with clock("events"):
        now[0] += 1.0
        watch.on_start(None)
        watch.on_start(None)
        now[0] += 14.0
        watch.on_end(None)
        watch.on_end(None)
        now[0] += 0.5
    assert clock.seconds == {"events": 1.5} and clock.total == 1.5 and clock.compile_s == 14.0


def test_the_next_compilation_is_announced_once():
    import numba

    said = []
    first, second, third = (numba.njit(lambda x, k=k: x + k) for k in (1, 2, 3))
    with compiling.announced_compiling(said.append):
        first(1)
        first(1)
        second(1)
    third(1)  # nobody listens any more
    assert said == ["compiling kernels, once per machine: this may take a minute or two"]


def test_damaged_kernels_are_a_line_that_names_their_folder(tmp_path, monkeypatch):
    module = tmp_path / "kernels_of_a_test.py"
    module.write_text("import numba\n\n\n@numba.njit(cache=True)\ndef twice(x):\n    return 2 * x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    twice = importlib.import_module("kernels_of_a_test").twice
    assert twice(3) == 6
    (index,) = tmp_path.rglob("*.nbi")
    index.write_bytes(b"\x09nonsense" * 9)
    del sys.modules["kernels_of_a_test"]
    with pytest.raises(pickle.UnpicklingError) as damaged:
        importlib.import_module("kernels_of_a_test").twice(3)
    assert user_line(damaged.value).startswith(f"{index.parent}: the kernels that numba keeps there are damaged")
    assert user_line(pickle.UnpicklingError("elsewhere")) is None
