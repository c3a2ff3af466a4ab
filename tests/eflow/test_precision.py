"""A device that has no bf16 gets fp32 and a line that says so; progress is told from the first
moment, on a clock that the test turns."""

import pytest

torch = pytest.importorskip("torch")

from eflow import machine  # noqa: E402
from eflow.machine import precision_on  # noqa: E402

CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)


def test_bf16_where_it_is_and_fp32_elsewhere(monkeypatch, capsys):
    monkeypatch.setattr(machine, "bf16_instructions", lambda: "AMX")
    assert precision_on(CPU, "bf16") == "bf16" and precision_on(CPU, "fp32") == "fp32"
    monkeypatch.setattr(machine, "bf16_instructions", lambda: "")
    assert precision_on(CPU, "fp32") == "fp32" and capsys.readouterr().err == ""
    assert precision_on(CPU, "bf16") == "fp32"
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err.startswith(
        "precision: fp32 instead of bf16: this CPU has neither AVX-512 BF16 nor AMX"
    )
    assert precision_on(CPU, "bf16", quiet=True) == "fp32" and capsys.readouterr().err == ""
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Old Card")
    assert precision_on(CUDA, "bf16") == "fp32" and "Old Card has no bf16 units" in capsys.readouterr().err
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: True)
    assert precision_on(CUDA, "bf16") == "bf16"
