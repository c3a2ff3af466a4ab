"""What makes a card wait: nothing of a training step is read back, or made on the host and copied over."""

from collections import Counter

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

from eflow.config import TrainConfig  # noqa: E402
from eflow.machine import fp32, use_tf32  # noqa: E402
from eflow.models import build_model, model_config  # noqa: E402
from eflow.progress import Readings  # noqa: E402
from eflow.train import _forward  # noqa: E402
from eflow.training_data import _alike, validate  # noqa: E402

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
        loss, epe, _ = _forward(net, batch, whole, batch["valid"].sum().float())
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
