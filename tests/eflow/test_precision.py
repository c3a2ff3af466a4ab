"""A device that has no bf16 gets fp32 and a line that says so; progress is told from the first
moment, on a clock that the test turns."""

import pytest

torch = pytest.importorskip("torch")

from blinkgl.machine import cpu  # noqa: E402
from blinkgl.show import checks as doctor  # noqa: E402
from eflow import precision  # noqa: E402
from eflow.precision import precision_on  # noqa: E402

CPU, CUDA = torch.device("cpu"), torch.device("cuda", 0)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("flags\t\t: fpu avx2 avx512f avx512_bf16 amx_bf16\n", "AVX-512 BF16, AMX"),
        ("flags : fpu avx2 avx512f\n", ""),
        ("Features\t: fp asimd bf16\n", "Arm BF16"),
        ("model name : x\n", ""),
    ],
)
def test_instructions_are_read_from_the_kernel(text, found, tmp_path, monkeypatch):
    (tmp_path / "cpuinfo").write_text("processor : 0\n" + text)
    flags = cpu.cpu_flags(str(tmp_path / "cpuinfo"))
    monkeypatch.setattr(cpu, "cpu_flags", lambda: flags)
    assert cpu.bf16_instructions() == found
    assert cpu.cpu_flags is not None and {c.name: c.value for c in doctor._numba()}["bf16"].startswith(
        found or "no instructions"
    )


def test_bf16_where_it_is_and_fp32_elsewhere(monkeypatch, capsys):
    monkeypatch.setattr(precision, "bf16_instructions", lambda: "AMX")
    assert precision_on(CPU, "bf16") == "bf16" and precision_on(CPU, "fp32") == "fp32"
    monkeypatch.setattr(precision, "bf16_instructions", lambda: "")
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
