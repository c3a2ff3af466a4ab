"""What makes a card wait: nothing of a training step is read back, or made on the host and copied over."""

from collections import Counter

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

from eflow.checkpoint import load_optimizer, optimizer_tensors, write_tensors  # noqa: E402
from eflow.config import TrainConfig  # noqa: E402
from eflow.data.window import Window  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402
from eflow.ops.precision import fp32  # noqa: E402
from eflow.precision import use_tf32  # noqa: E402
from eflow.train import _forward  # noqa: E402
from eflow.training_data import _alike, validate  # noqa: E402
from eflow.training_log import Readings  # noqa: E402

WAITS = {
    "aten::_local_scalar_dense": "a number that Python reads: float(t), int(t), if t",
    "aten::nonzero": "a mask used as an index: its size is read",
    "aten::masked_select": "its size is read",
    "aten::lift_fresh": "a tensor made of Python numbers, copied over",
    "aten::is_nonzero": "a truth value that Python reads",
    "aten::equal": "a truth value that Python reads",
}


class Waiting(TorchDispatchMode):
    """Counts operations that a card and its host would wait for each other in."""

    def __init__(self):
        super().__init__()
        self.found = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name
        masked = name in ("aten::index", "aten::index_put_", "aten::index_put") and any(
            torch.is_tensor(i) and i.dtype in (torch.bool, torch.uint8) for i in args[1]
        )
        if masked or name in WAITS:
            self.found[name] += 1
        return function(*args, **(kwargs or {}))


def config(**model):
    return TrainConfig.model_validate({"model": model, "data": {"train": [{"path": "x"}], "crop": [64, 64]}})


@pytest.mark.parametrize(
    "model, size",
    [
        ({"name": "ev_flownet", "width": 4, "consensus": True}, 32),
        ({"name": "spike_flownet", "width": 4}, 32),
        ({"name": "ste_flownet", "width": 4, "sweeps": 1}, 32),
        ({"name": "eraft", "size": "tiny", "levels": 2, "train_iterations": 2, "iterations": 2}, 64),
        ({"name": "eraft", "size": "tiny", "levels": 2, "train_iterations": 2, "correlation": "on_demand"}, 64),
        ({"name": "eflowformer", "size": "tiny", "levels": 2, "train_iterations": 2}, 64),
    ],
    ids=lambda value: None if isinstance(value, int) else "-".join(map(str, value.values())),
)
def test_a_training_step_waits_for_nothing(model, size, tmp_path):
    torch.manual_seed(0)
    whole = config(**model)
    net = build_model(whole.model).train()
    optimizer = torch.optim.AdamW(net.parameters(), 1e-4, foreach=True)
    batch = {k: torch.randn(2, net.representation.channels, size, size) for k in net.reads}
    batch |= {"flow": torch.randn(2, 2, size, size), "valid": torch.rand(2, size, size) < 0.5}
    read = Readings(tmp_path)
    waiting = Waiting()
    with waiting:
        loss, epe, _ = _forward(net, batch, whole, 1)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        read.add(0, ["a", "b"], loss, epe, norm)
    if net.config.name in ("eraft", "eflowformer") and net.config.iterations > net.config.train_iterations:
        waiting.found["aten::_local_scalar_dense"] -= 1  # the draw of a burn-in, of the host's generator
    assert not +waiting.found, {WAITS.get(k, "a mask as an index"): n for k, n in waiting.found.items()}
    optimizer.step()
    with Waiting() as counted:
        assert float(loss.detach()) == pytest.approx(read.values()[0][0])
    assert counted.found["aten::_local_scalar_dense"] >= 1, "the guard sees a number that is read"
    assert read.values() == []


def test_the_error_that_is_told_is_the_mean_over_valid_pixels():
    whole = config(name="ev_flownet", width=4)
    net = build_model(whole.model).train()
    batch = {"new": torch.randn(1, 4, 32, 32), "flow": torch.full((1, 2, 32, 32), 3.0)}
    batch["valid"] = torch.zeros(1, 32, 32, dtype=torch.bool)
    batch["flow"][0, :, 0] = float("nan")
    assert float(_forward(net, batch, whole, 1)[1]) == 0, "nothing is valid"
    batch["valid"][0, 5:9] = True
    _, epe, flow = _forward(net, batch, whole, 1)
    assert float(epe) == pytest.approx(float((flow - batch["flow"]).norm(dim=1)[0, 5:9].mean()), rel=1e-5)


def test_validation_in_batches_is_validation_one_by_one():
    torch.manual_seed(0)
    net = build_model(model_config({"name": "ev_flownet", "width": 4}))
    rng = np.random.default_rng(0)

    def sample(height):
        grids = {k: torch.randn(4, height, 48) for k in ("old", "new")}
        valid = torch.from_numpy(rng.random((height, 48)) < 0.7)
        return {
            **grids,
            "flow": torch.randn(2, height, 48),
            "valid": valid,
            "mask": torch.ones_like(valid),
            "name": "x",
        }

    samples = [sample(h) for h in (32, 32, 32, 40, 40, 32)]
    sizes = [tuple(b["new"].shape[::2]) for b in _alike(samples, 2)]
    assert sizes == [(2, 32), (1, 32), (2, 40), (1, 32)]
    one, many = (validate(net, None, [("set", samples, list(range(6)))], "fp32", size) for size in (1, 4))
    assert one["set/AEE"] == pytest.approx(many["set/AEE"], abs=1e-5) and one["set/zero"] == many["set/zero"]


def test_merging_new_events_is_sorting_all_of_them():
    rng = np.random.default_rng(1)
    for n, m in ((1000, 50), (0, 20), (30, 0), (5, 500)):
        t = np.sort(rng.integers(0, 60, n))  # many equal times
        window = Window(np.arange(n, dtype=np.uint16), np.zeros(n, np.uint16), t, np.ones(n, np.uint8), 0, 100)
        x, new = 2000 + np.arange(m), rng.integers(0, 60, m)
        merged = window.with_events(x, np.ones(m, int), new, np.zeros(m, np.uint8))
        order = np.argsort(np.concatenate([t, new]), kind="stable")
        assert np.array_equal(merged.x, np.concatenate([window.x, x])[order]) and merged.x.dtype == np.uint16
        assert np.array_equal(merged.t, np.concatenate([t, new])[order]) and merged.p.sum() == n


def test_tf32_by_capability_and_never_in_islands(monkeypatch):
    cuda = torch.device("cuda", 0)
    for capability, wanted, able in (((8, 0), True, True), ((7, 5), True, False), ((9, 0), False, False)):
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device, c=capability: c)
        assert use_tf32(cuda, wanted) is able and torch.backends.cudnn.allow_tf32 is able
    assert not use_tf32(torch.device("cpu"))
    torch.backends.cuda.matmul.allow_tf32 = True
    try:

        class OnCard:
            device = cuda

        with fp32(OnCard()):
            assert not torch.backends.cuda.matmul.allow_tf32 and not torch.is_autocast_enabled("cuda")
        assert torch.backends.cuda.matmul.allow_tf32
    finally:
        torch.backends.cuda.matmul.allow_tf32 = False


@pytest.mark.parametrize("fused", [False, True])
def test_the_state_of_a_fused_optimiser_comes_back(fused, tmp_path):
    torch.manual_seed(0)
    net = build_model(model_config({"name": "ev_flownet", "width": 4}))
    make = lambda: torch.optim.AdamW(net.parameters(), 1e-3, fused=fused)
    first = make()
    for p in net.parameters():
        p.grad = torch.randn_like(p)
    first.step()
    write_tensors(tmp_path / "o.safetensors", optimizer_tensors(net, first), {})
    second = make()
    load_optimizer(tmp_path / "o.safetensors", net, second)
    for p in net.parameters():
        assert all(torch.equal(first.state[p][k], second.state[p][k]) for k in ("step", "exp_avg", "exp_avg_sq"))
    second.step()
