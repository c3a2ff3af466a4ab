"""A device that has no bf16 gets fp32 and a line that says so; progress is told from the first
moment, on a clock that the test turns."""

import pytest

torch = pytest.importorskip("torch")

from blinkgl.machine import cpu  # noqa: E402
from blinkgl.show import checks as doctor  # noqa: E402
from eflow import precision  # noqa: E402
from eflow.config import load_train_config  # noqa: E402
from eflow.precision import precision_on  # noqa: E402
from eflow.progress import TrainProgress  # noqa: E402
from eflow.train import train  # noqa: E402
from test_train import config_file, data, log  # noqa: E402, F401

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


def test_training_falls_back_says_so_and_records_it(tmp_path, data, monkeypatch, capsys):  # noqa: F811
    monkeypatch.setattr(precision, "bf16_instructions", lambda: "")
    seen = []
    real = torch.autocast
    monkeypatch.setattr(torch, "autocast", lambda *a, **k: seen.append(k.get("enabled")) or real(*a, **k))
    config = load_train_config(config_file(tmp_path, data, steps=2, run__precision="bf16"))
    train(config, tmp_path / "run")
    err = capsys.readouterr().err
    assert seen and not any(seen) and "precision: fp32 instead of bf16" in err
    assert "training: 2 steps of 2 samples on cpu, fp32\n" in err and "step 1/2  loss" in err
    assert "precision: fp32" in (tmp_path / "run/config.yaml").read_text()


def test_a_training_that_its_clock_ends_is_validated(tmp_path, data):  # noqa: F811
    config = load_train_config(
        config_file(
            tmp_path,
            data,
            steps=50,
            run__time_limit=1e-9,
            data__validate_on=[{"path": str(data)}],
            data__validate_samples=1,
        )
    )
    result = train(config, tmp_path / "run", quiet=True)
    assert (result.step, result.reason) == (1, "time limit")
    assert [line["kind"] for line in log(tmp_path / "run")].count("validation") == 1


def test_progress_tells_rate_and_time_left_by_steps_and_by_clock(capsys):
    now = [100.0]

    def lines():
        return capsys.readouterr().err.splitlines()

    with TrainProgress(100, 0, 4, True, "cpu, fp32", clock=lambda: now[0]) as progress:
        assert lines() == ["training: 100 steps of 4 samples on cpu, fp32"]
        now[0] += 2.0
        progress.update(1, [(3.0, 5.0)])
        assert lines() == ["step 1/100  loss 3.00  EPE 5.00 px  2.00 samples/s  0:03:18 left"], "at once, with a rate"
        for step in range(2, 6):
            now[0] += 2.0
            progress.update(step, [(3.0, 5.0)])
        assert lines() == []
        now[0] += 2.0
        progress.update(6, [(3.0, 5.0)])
        assert lines() == ["step 6/100  loss 3.00  EPE 5.00 px  2.00 samples/s  0:03:08 left"], "every ten seconds"
    with TrainProgress(100, 50, 4, True, "cpu, fp32", minutes=1.0, began=now[0] - 10, clock=lambda: now[0]) as progress:
        assert lines() == ["training: 50 steps of 4 samples on cpu, fp32, 0:00:50 at most"]
        now[0] += 2.0
        progress.update(51, [(3.0, 5.0)])
        assert lines() == [
            "step 51/100  loss 3.00  EPE 5.00 px  2.00 samples/s  0:00:48 left, the time limit, at about step 75"
        ]
        now[0] += 60.0
        progress.note(51, {"set/AEE": 2.0})
        assert lines() == ["step 51  set/AEE 2.000"]
