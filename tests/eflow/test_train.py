"""Training: exactly resumable, stops cleanly, never leaves half a checkpoint, refuses what it cannot use."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.torch import load_file  # noqa: E402

from blinkgl.errors import BlinkGLError, ConfigError, OutputError  # noqa: E402
from eflow import checkpoint as ckpt  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.load_config import load_train_config  # noqa: E402
from eflow.progress import Log, TrainingError  # noqa: E402
from eflow.train import learning_rate, train  # noqa: E402
from flow_data import blinkgl_set  # noqa: E402
from trainings import FAST, config_file, log, tensors  # noqa: E402


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return blinkgl_set(tmp_path_factory.mktemp("train"), sequences=2, labels=2)


TINY = {"name": "eflowformer", "size": "tiny", "levels": 4, "train_iterations": 1, "input": {"bins": 3}}


def test_resumed_equals_uninterrupted_bit_for_bit(tmp_path, data):
    k, n = 3, 1  # two steps are an epoch: the cut is inside the second
    config = load_train_config(config_file(tmp_path, data, TINY, steps=k + n, crop=(128, 128)))
    whole = train(config, tmp_path / "whole", quiet=True)
    assert (whole.step, whole.reason) == (k + n, "finished")
    stopped = train(config, tmp_path / "parts", stop_after=k, quiet=True)
    assert (stopped.step, stopped.reason) == (k, "stop")
    torch.manual_seed(123)  # another process would have another state
    train(config, tmp_path / "parts", resume=True, quiet=True)
    a, b = tensors(tmp_path / "whole"), tensors(tmp_path / "parts")
    assert a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)
    folders = [ckpt.newest(tmp_path / name) for name in ("whole", "parts")]
    for name in ("weights", "ema", "optimizer"):  # the order of names in their headers included
        files = [(folder / f"{name}.safetensors").read_bytes() for folder in folders]
        assert files[0] == files[1], name
    assert any(key.endswith("exp_avg") for key in a) and any(key.startswith("ema/") for key in a)
    logs = [log(tmp_path / d) for d in ("whole", "parts")]
    same = ("step", "samples", "loss", "epe", "lr")
    assert [[row[key] for key in same] for row in logs[0]] == [[row[key] for key in same] for row in logs[1]]
    spent = [[row[key] for row in logs[1]] for key in ("processor_s", "wall_s")]
    assert len(logs[0]) == k + n and all(sorted(seconds) == seconds and seconds[0] > 0 for seconds in spent)


def test_it_learns_a_constant_flow(tmp_path, data):
    """Sixteen steps on four samples of constant flow: the error falls to less than half."""
    config = load_train_config(config_file(tmp_path, data, steps=16, data__augment=None, optim__lr=2e-3, optim__ema=0))
    train(config, tmp_path / "run", quiet=True)
    epe = [r["epe"] for r in log(tmp_path / "run")]
    assert np.mean(epe[-4:]) < 0.5 * np.mean(epe[:4])


def test_a_run_folder_is_complete_and_not_overwritten(tmp_path, data, capsys):
    path = config_file(
        tmp_path,
        data,
        steps=2,
        run__picture_every=2,
        run__validate_every=2,
        data__validate_on=[{"path": str(data)}],
        data__validate_samples=2,
    )
    out = tmp_path / "run"
    assert run(["train", str(path), "--out", str(out)]) == 0
    err = capsys.readouterr().err
    assert "step 2/2" in err and "samples/s" in err and "left" in err and "finished at step 2" in err
    assert (
        (out / "config.yaml").is_file()
        and list((out / "tb").glob("events.*"))
        and (out / "pictures/000000002.png").is_file()
    )
    kinds = [r["kind"] for r in log(out)]
    assert kinds == ["train", "train", "validation"]
    assert {f"{data.name}/AEE", f"{data.name}/zero"} <= log(out)[-1].keys()
    rows = log(out)
    assert [(row["step"], row["samples"]) for row in rows] == [(1, 2), (2, 4), (2, 4)]
    assert rows[-1][f"{data.name}/AEE"] > 0
    assert sorted(p.name for p in ckpt.newest(out).iterdir()) == [
        "ema.safetensors",
        "optimizer.safetensors",
        "state.json",
        "weights.safetensors",
    ]
    before = (out / "log.jsonl").read_bytes()
    assert run(["train", str(path), "--out", str(out)]) == 2
    assert "output folder exists" in capsys.readouterr().err and (out / "log.jsonl").read_bytes() == before
    # the run's own config.yaml is a configuration
    assert load_train_config(out / "config.yaml") == load_train_config(path)


def test_resume_from_the_command_line_and_only_from_whole_checkpoints(tmp_path, data, capsys):
    path, out = config_file(tmp_path, data, steps=3), tmp_path / "run"
    train(load_train_config(path), out, stop_after=2, quiet=True)
    folder, before = ckpt.newest(out), (out / "log.jsonl").read_bytes()
    for name in ("weights.safetensors", "ema.safetensors", "optimizer.safetensors", "state.json"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) // 2])
        assert run(["train", str(path), "--out", str(out), "--resume"]) == 2
        err = capsys.readouterr().err
        assert err.startswith(f"error: {folder / name}: ") and err.count("\n") == 1, err
        (folder / name).write_bytes(whole)
    assert (out / "log.jsonl").read_bytes() == before  # nothing was touched
    assert run(["train", str(path), "--out", str(out), "--resume"]) == 0
    assert "finished at step 3" in capsys.readouterr().err and [r["step"] for r in log(out)] == [1, 2, 3]


def test_a_damaged_log_goes_on(tmp_path):
    """Half a line and lines past the checkpoint are dropped, as older versions wrote them; seconds add up."""
    (tmp_path / "log.jsonl").write_text(
        '{"step": 1, "kind": "train", "loss": 1.0}\n{"step": 2, "kind": "train", "processor_s": 5.0, "wall_s": 6.0}\n'
        '{"step": 3, "kind": "train"}\n{"step": 3, "ki'
    )
    with Log(tmp_path, 2, 2, enabled=True) as file:
        file.write(3, "train", loss=2.0)
    rows = log(tmp_path)
    assert [(r["step"], r.get("loss")) for r in rows] == [(1, 1.0), (2, None), (3, 2.0)]
    assert rows[-1]["samples"] == 6 and rows[-1]["processor_s"] >= 5 and rows[-1]["wall_s"] >= 6


def test_resuming_with_another_configuration_names_the_key(tmp_path, data):
    path = config_file(tmp_path, data, steps=4)
    train(load_train_config(path), tmp_path / "run", stop_after=1, quiet=True)
    for option, key in (
        ("optim.lr=0.5", r"optim\.lr"),
        ("model.bins=7", r"model\.bins"),
        ("data.batch=1", r"data\.batch"),
    ):
        with pytest.raises(ConfigError, match=f"^{key}: differs from the run"):
            train(load_train_config(path, [option]), tmp_path / "run", resume=True, quiet=True)
    # How it runs may change.
    train(load_train_config(path, ["run.log_every=2"]), tmp_path / "run", resume=True, stop_after=1, quiet=True)


def test_old_checkpoints_are_deleted(tmp_path, data):
    train(
        load_train_config(config_file(tmp_path, data, steps=4, run__checkpoint_every=1, run__keep_checkpoints=2)),
        tmp_path / "run",
        quiet=True,
    )
    assert sorted(p.name for p in (tmp_path / "run/checkpoints").iterdir()) == ["000000003", "000000004"]


def test_fine_tuning_starts_from_the_weights(tmp_path, data):
    first = train(load_train_config(config_file(tmp_path, data, steps=2)), tmp_path / "first", quiet=True)
    path = config_file(tmp_path, data, steps=3, optim__lr=1e-12)
    config = load_train_config(path, [f"init_from={first.checkpoint}"])
    tuned = train(config, tmp_path / "tuned", stop_after=1, quiet=True)
    a, b = (
        load_file(c / f) for c, f in ((first.checkpoint, "ema.safetensors"), (tuned.checkpoint, "weights.safetensors"))
    )
    assert all(torch.allclose(a[k], b[k], atol=1e-6) for k in a)
    with pytest.raises(BlinkGLError, match="checkpoint of another model"):
        train(
            load_train_config(path, [f"init_from={first.checkpoint}", "model={name: spike_flownet}"]),
            tmp_path / "x",
            quiet=True,
        )


def test_nan_stops_and_names_the_samples(tmp_path, data, monkeypatch):
    import eflow.train as module

    calls = []
    original = module.sequence_loss

    def poisoned(*args, **kw):
        calls.append(1)
        return original(*args, **kw) * (float("nan") if len(calls) == 2 else 1)

    monkeypatch.setattr(module, "sequence_loss", poisoned)
    config = load_train_config(config_file(tmp_path, data, run__checkpoint_every=1))
    with pytest.raises(TrainingError, match="nan_batch.json: loss or gradient is not finite at step 1"):
        train(config, tmp_path / "run", quiet=True)
    saved = json.loads((tmp_path / "run/nan_batch.json").read_text())
    assert (
        saved["step"] == 1 and len(saved["samples"]) == 2 and all(s.startswith("train/seq_") for s in saved["samples"])
    )
    weights = load_file(ckpt.newest(tmp_path / "run") / "weights.safetensors")
    assert ckpt.newest(tmp_path / "run").name == "000000001" and all(v.isfinite().all() for v in weights.values())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_writes_a_checkpoint_and_says_so(tmp_path, data, number, monkeypatch, capsys):
    import eflow.train as module

    calls = []
    original = module.sequence_loss

    def interrupted(*args, **kw):
        calls.append(1)
        if len(calls) == 2:
            os.kill(os.getpid(), number)
        return original(*args, **kw)

    monkeypatch.setattr(module, "sequence_loss", interrupted)
    before = signal.getsignal(number)
    path = config_file(tmp_path, data, steps=1000)
    status = run(["train", str(path), "--out", str(tmp_path / "run"), "--quiet", "--resume"])
    assert (status, capsys.readouterr().err) == (128 + number, "interrupted; --resume continues\n")
    assert signal.getsignal(number) is before
    folder = ckpt.newest(tmp_path / "run")  # the step that was under way is finished first
    assert folder.name == "000000002" and ckpt.read_state(folder)["step"] == 2


def test_learning_rate_rises_stays_and_falls():
    rates = np.array([learning_rate(s / 1000, 2e-4, 0.05, 0.4) for s in range(1001)])
    assert rates[0] == pytest.approx(2e-4 / 25) and (rates[50:600] == 2e-4).all() and 0 < rates[-1] < 1e-8
    assert np.allclose(np.diff(rates[:51], 2), 0, atol=1e-18) and np.allclose(np.diff(rates[600:], 2), 0, atol=1e-18)
    cycle = [learning_rate(s / 1000, 2e-4, 0.05, 0.95) for s in range(1001)]
    assert cycle[50] == max(cycle) == 2e-4 and sorted(cycle[50:], reverse=True) == cycle[50:], "the papers' one cycle"
    flat = [learning_rate(d, 1.0, 0.0, 0.0) for d in (0.0, 0.5, 0.999)]
    assert flat == [1.0] * 3


def test_a_training_as_long_as_the_clock_says(tmp_path, data):
    """A minute of which every reading of the clock takes ten seconds: the rate rises, stays and falls by the clock, and
    a resumed part goes on where the first one stopped."""
    path = config_file(tmp_path, data, steps=1000, optim__minutes=1.0, optim__warmup=0.3, optim__cooldown=0.3)
    config = load_train_config(path)

    def ticking(folder, **options):
        now = iter(np.arange(0, 1e4, 10.0))
        return train(config, folder, quiet=True, clock=lambda: float(next(now)), **options)

    whole = ticking(tmp_path / "whole")
    lines = log(tmp_path / "whole")
    # The clock is read when it begins, before the first step, and after each.
    assert (whole.reason, whole.step) == ("finished", 5) and ckpt.read_state(whole.checkpoint)["seconds"] >= 60
    expected = [learning_rate(d, 1e-3, 0.3, 0.3) for d in np.arange(1, 6) / 6]
    assert [line["lr"] for line in lines] == pytest.approx(expected)
    first = ticking(tmp_path / "parts", stop_after=1)
    assert first.reason == "stop"
    spent = ckpt.read_state(first.checkpoint)["seconds"]
    assert spent == 30.0, "the clock began, was read twice, and once more for the state"
    second = ticking(tmp_path / "parts", resume=True)
    assert (second.reason, second.step) == ("finished", 3)
    again = ticking(tmp_path / "parts", resume=True)
    assert (again.reason, again.step, again.checkpoint) == ("finished", 3, second.checkpoint), "nothing is left to do"


@pytest.mark.slow
def test_data_parallel_equals_one_process(tmp_path, data):
    """Two processes over gloo, one sample each, against one process with both: the loss is
    the mean over all valid pixels."""
    path = config_file(tmp_path, data, steps=2, optim__ema=0)
    train(load_train_config(path), tmp_path / "one", quiet=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MASTER_ADDR": "127.0.0.1"}
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "torch.distributed.run",
            "--standalone",
            "--nproc-per-node",
            "2",
            "-m",
            "eflow.cli",
            "train",
            str(path),
            "--out",
            str(tmp_path / "two"),
            "--quiet",
        ],
        capture_output=True,
        text=True,
        timeout=300,
        env=environment,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    a, b = tensors(tmp_path / "one"), tensors(tmp_path / "two")
    weights = [k for k in a if k.startswith("weights/")]
    assert weights and all(torch.allclose(a[k], b[k], atol=2e-5) for k in weights)
    for key in ("loss", "epe", "grad_norm"):  # of all samples, not of the first process
        one, two = ([row[key] for row in log(tmp_path / name)] for name in ("one", "two"))
        assert two == pytest.approx(one, rel=1e-3), key


# ---- configurations and checkpoints that cannot be used --------------------------------------------------------------


@pytest.mark.parametrize(
    "model, crop, message",
    [
        (
            TINY,
            [120, 128],
            r"data\.crop: a size the network cannot train on \(got \(120, 128\)\); expected multiples of 8, at least",
        ),
        (TINY, [132, 128], "multiples of 8"),
        (FAST, [64, 72], "multiples of 16"),
        (
            TINY,
            None,
            r"data\.crop is not set, train/seq_000000/000000.*\(got \(128, 132\)\); .*: --set data\.crop=\[128,128\]",
        ),
    ],
)
def test_sizes_are_refused_before_anything_is_written(tmp_path, model, crop, message):
    small = blinkgl_set(tmp_path / "small", sequences=1, labels=1, width=132)
    path = config_file(
        tmp_path, small, model, crop=crop or (128, 128), **({} if crop else {"data__crop": None, "data__augment": None})
    )
    with pytest.raises(ConfigError, match=message):
        train(load_train_config(path), tmp_path / "run", quiet=True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("model", [TINY, FAST], ids=["the update step", "the whole network"])
def test_every_network_can_be_compiled(tmp_path, data, monkeypatch, model):
    compiled = []
    monkeypatch.setattr(torch.nn.Module, "compile", lambda module: compiled.append(type(module).__name__))
    config = load_train_config(config_file(tmp_path, data, model, steps=1, crop=(128, 128), run__compile=True))
    train(config, tmp_path / "run", quiet=True)
    assert compiled == [{"eflowformer": "Update", "ev_flownet": "EvFlowNet"}[model["name"]]]


@pytest.mark.slow
def test_a_compiled_update_step_computes_the_same(tmp_path, data):
    losses = []
    for name in ("eager", "compiled"):
        config = load_train_config(
            config_file(tmp_path, data, TINY, steps=2, crop=(128, 128), run__compile=name == "compiled")
        )
        train(config, tmp_path / name, quiet=True)
        losses.append([r["loss"] for r in log(tmp_path / name)])
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)
    assert tensors(tmp_path / "eager").keys() == tensors(tmp_path / "compiled").keys()  # no prefixes of the compiler's


def test_a_compiler_that_fails_is_one_line(tmp_path, data, monkeypatch):
    import torch._dynamo.exc as dynamo

    import eflow.train as module

    def broken(*args, **kw):
        with module.compile_errors(True):
            raise dynamo.InternalTorchDynamoError("no C++ compiler\nand pages more")

    monkeypatch.setattr(module, "_forward", broken)
    with pytest.raises(
        ConfigError, match="^run.compile: torch.compile does not work here: no C.. compiler .got True.; expected false$"
    ):
        train(load_train_config(config_file(tmp_path, data, steps=1)), tmp_path / "run", quiet=True)


@pytest.fixture(scope="module")
def trained(tmp_path_factory, data) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    return train(load_train_config(config_file(folder, data, steps=1)), folder / "run", quiet=True).checkpoint


def test_a_pickle_is_refused_and_never_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    torch.save({"weights": Trap()}, tmp_path / "model.safetensors")
    torch.save({"weights": Trap()}, tmp_path / "old.safetensors", _use_new_zipfile_serialization=False)
    for name in ("model", "old"):
        with pytest.raises(BlinkGLError, match=rf"{name}\.safetensors: is a PyTorch pickle.*refused"):
            ckpt.load_model(tmp_path / f"{name}.safetensors")
    assert not (tmp_path / "sprung").exists()


def test_checkpoint_of_another_model(trained, tmp_path):
    from eflow.models import build_model, model_config

    tensors_, metadata = ckpt.read_tensors(trained / "weights.safetensors")
    forged = {**metadata, "model": json.dumps({**FAST, "bins": 7})}
    ckpt.write_tensors(tmp_path / "forged.safetensors", tensors_, forged)
    with pytest.raises(BlinkGLError, match=r"forged\.safetensors: tensor 'encoders\.0\.weight' has another shape"):
        ckpt.load_model(tmp_path / "forged.safetensors")
    ckpt.write_tensors(tmp_path / "bare.safetensors", tensors_, {})
    with pytest.raises(BlinkGLError, match=r"bare\.safetensors: safetensors file without a model configuration"):
        ckpt.load_model(tmp_path / "bare.safetensors")
    model = build_model(model_config({**FAST}))
    with pytest.raises(BlinkGLError, match="x: lacks the tensor"):
        ckpt.load_weights(model, {}, "x")


def test_a_full_disk_leaves_no_checkpoint(tmp_path, data, monkeypatch):
    def full(*args, **kw):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ckpt, "save_file", full)
    with pytest.raises(OutputError, match="no space left"):
        train(load_train_config(config_file(tmp_path, data, steps=1)), tmp_path / "run", quiet=True)
    assert not list((tmp_path / "run/checkpoints").iterdir())
