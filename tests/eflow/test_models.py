"""The networks: size and arithmetic as published, the equalities between them, and what they refuse."""

import math
import warnings
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from torch.utils.flop_counter import FlopCounterMode  # noqa: E402

from blinkgl.errors import BlinkGLError  # noqa: E402
from eflow.config import LossConfig  # noqa: E402
from eflow.infer import predict  # noqa: E402
from eflow.metrics import pixel_error, sequence_loss  # noqa: E402
from eflow.models import NETWORKS, SIZES, FlowPrediction, build_model, model_config, parameters_of, preset  # noqa: E402
from eflow.models.unets import Consensus, seen_cells  # noqa: E402
from raft_reference import as_raft  # noqa: E402


def count(config) -> tuple[int, float]:
    """(parameters, GMACs of one forward pass at 640x480): convolutions and matrix products, attention's included. The
    paper's arithmetic: the mask head in every iteration, nothing hoisted."""
    with torch.device("meta"):
        model = build_model(config).eval()
        batch = {k: torch.zeros(1, model.representation.channels, 480, 640) for k in ("old", "new")}
    counter = FlopCounterMode(display=False)
    with pytest.MonkeyPatch.context() as patch, torch.inference_mode(), counter:
        if hasattr(model, "update"):
            as_raft(patch, model)
        model(batch)
    return parameters_of(model), counter.get_total_flops() / 2e9


def build(seed: int = 0, **tree):
    torch.manual_seed(seed)
    return build_model(model_config(tree))


def batch_for(model, n=1, height=128, width=128, seed=0) -> dict:
    torch.manual_seed(seed)
    return {k: torch.randn(n, model.representation.channels, height, width) for k in ("old", "new")}


@pytest.mark.parametrize(
    "tree",
    [
        {"name": "eraft", "size": "tiny", "iterations": 2},
        {"name": "eflowformer", "size": "tiny", "iterations": 2},
        {"name": "eflowformer", "size": "tiny", "iterations": 2, "correlation": "on_demand"},
        {"name": "eflowformer", "size": "tiny", "quick": True, "levels": 2},
        {"name": "ev_flownet", "width": 8, "consensus": True},
        {"name": "spike_flownet", "width": 8},
        {"name": "ste_flownet", "width": 8, "sweeps": 1},
    ],
    ids=lambda tree: "-".join(map(str, tree.values())),
)
def test_a_trace_without_gradients_follows_its_input(tree):
    model = build(**tree).eval()
    for name, p in model.named_parameters():  # flow heads start near zero: agreement of nothing shows nothing
        if "heads." in name or ".flow" in name:
            torch.nn.init.normal_(p, std=0.05)
    flow = FlowOnly(model)
    inputs = [tuple(batch_for(model, seed=seed).values()) for seed in (1, 2)]
    with torch.no_grad(), warnings.catch_warnings(action="ignore"):  # that sizes are constants
        traced = torch.jit.trace(flow, inputs[0], check_trace=False)
    first, other = (flow(*pair).detach() for pair in inputs)  # with gradients no short cut is taken
    assert (first - other).abs().max() > 0.1
    assert (traced(*inputs[1]) - other).abs().max() < 1e-3 * other.abs().max()


class FlowOnly(torch.nn.Module):
    """A network with tensors as arguments and result."""

    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, old, new):
        return self.model({"old": old, "new": new}).flow


PUBLISHED = [  # million parameters, GMACs at 480x640 with 12 and with 6 iterations
    ({"name": "eraft"}, 5.33, 257, None),
    ({"name": "eflowformer", "layers": 2}, 9.05, 294, 204),
    ({"name": "eflowformer"}, 12.76, 332, 242),
    ({"name": "eflowformer", "layers": 2, "attention": "twins"}, 14.28, 307, 217),
    ({"name": "ev_flownet", "input": "voxel"}, 14.1, 62, None),
    ({"name": "spike_flownet"}, 13.0, None, None),
    ({"name": "ste_flownet"}, 48.3, None, None),
]


@pytest.mark.parametrize(
    "tree, parameters, gmacs, gmacs_6",
    PUBLISHED,
    ids=lambda v: "-".join(map(str, v.values())) if isinstance(v, dict) else "",
)
def test_parameters_and_arithmetic_within_one_percent(tree, parameters, gmacs, gmacs_6):
    found, macs = count(model_config(tree))
    assert found / 1e6 == pytest.approx(parameters, rel=0.01)
    if gmacs:
        assert macs == pytest.approx(gmacs, rel=0.01)
    if gmacs_6:
        assert count(model_config({**tree, "iterations": 6}))[1] == pytest.approx(gmacs_6, rel=0.01)


def test_without_layers_and_from_zero_it_is_eraft():
    eraft, empty = build(name="eraft", iterations=3), build(1, name="eflowformer", layers=0, init="zero", iterations=3)
    assert list(eraft.state_dict()) == list(empty.state_dict())
    empty.load_state_dict(eraft.state_dict())
    batch = batch_for(eraft)
    for training in (False, True):
        a, b = (m.train(training)(batch) for m in (eraft, empty))
        assert len(a.flows) == len(b.flows) and not a.has_match and not b.has_match
        assert all(torch.equal(x, y) for x, y in zip(a.flows, b.flows))
    same_seed = build(name="eflowformer", layers=0, init="zero")
    assert all(
        torch.equal(a, b) for a, b in zip(build(name="eraft").state_dict().values(), same_seed.state_dict().values())
    )


@pytest.mark.parametrize("name", ["eraft", "eflowformer"])
def test_it_equals_rafts_arithmetic_and_on_demand_correlation(name, monkeypatch):
    """The same flow to 1e-3 px: lookup, hoisted context, mask and upsampling once; and without the volume."""
    model = build(name=name, iterations=4).eval()
    loud(model)
    batch = batch_for(model, 2, 136, 152)
    fast = predict(model, batch).flow
    assert fast.abs().mean() > 1  # otherwise equality says nothing
    with monkeypatch.context() as patch:
        as_raft(patch, model)
        plain = predict(model, batch).flow
    model.config = model.config.model_copy(update={"correlation": "on_demand"})
    on_demand = predict(model, batch).flow
    assert (fast - plain).abs().max() < 1e-3
    assert (fast - on_demand).abs().max() < 1e-3


def test_the_quick_eflowformer_trains_every_parameter_from_a_flow_of_its_own(monkeypatch):
    """Its first field is the U-Net's; sizes of an odd number of cells and no volume in memory change nothing."""
    torch.manual_seed(0)
    model = build_model(model_config(preset("eflowformer-quick"))).train()
    batch = batch_for(model, 1, 72, 88)
    prediction = model(batch)
    assert prediction.has_match and [f.shape for f in prediction.flows] == [(1, 2, 72, 88)] * 2
    sequence_loss(prediction, torch.ones(1, 2, 72, 88), torch.ones(1, 72, 88, dtype=torch.bool)).backward()
    assert not [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    loud(model)
    dense = predict(model, batch).flow
    with monkeypatch.context() as patch:
        as_raft(patch, model)
        plain = predict(model, batch).flow
    model.config = model.config.model_copy(update={"correlation": "on_demand"})
    assert (dense - plain).abs().max() < 1e-3 and (dense - predict(model, batch).flow).abs().max() < 1e-3
    started = predict(model, {**batch, "flow_init": torch.full((1, 2, 9, 11), 5.0)}).flow
    assert (started - dense).mean() > 20, "a warm start takes the place of its own"
    with torch.device("meta"):
        assert parameters_of(build_model(model_config(preset("eflowformer-quick")))) < 1.8e6


def loud(model) -> None:
    """Freshly initialised heads say next to nothing; give them a voice."""
    torch.manual_seed(9)
    torch.nn.init.normal_(model.update.flow_head[-1].weight, std=0.02)


def test_iteration_checkpointing_changes_no_gradient():
    gradients = []
    for checkpointing in (False, True):
        model = build(
            name="eraft", train_iterations=2, context_norm="instance", checkpoint_iterations=checkpointing
        ).train()
        sequence_loss(
            model(batch_for(model)), torch.ones(1, 2, 128, 128), torch.ones(1, 128, 128, dtype=torch.bool)
        ).backward()
        gradients.append([p.grad for p in model.parameters()])
    assert all(torch.allclose(a, b, rtol=1e-4, atol=1e-6) for a, b in zip(*gradients))


@pytest.mark.parametrize("name", ["ev_flownet", "spike_flownet", "ste_flownet"])
def test_baselines_train_every_parameter_and_answer_at_full_size(name):
    model = build(name=name, size="tiny").train()
    batch = {k: (v.abs() * 3).round() for k, v in batch_for(model, 1, 64, 80).items()}
    prediction = model(batch)
    assert prediction.kind == "scales" and all(f.shape == (1, 2, 64, 80) for f in prediction.flows)
    sequence_loss(prediction, torch.ones(1, 2, 64, 80), torch.ones(1, 64, 80, dtype=torch.bool)).backward()
    silent = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not silent
    out = predict(model, {k: v[..., :60, :75] for k, v in batch.items()})  # padded and cut back
    assert len(out.flows) == 1 and out.flow.shape == (1, 2, 60, 75) and out.flow.abs().max() < 60


def test_spikes_reset_to_zero_and_pass_gradients_where_they_fired():
    """Hard reset, as published: what a membrane exceeds the threshold by is lost; below it nothing is."""
    from eflow.models.spike_flownet import integrate_and_fire

    current, membrane, count = torch.tensor([0.1, 0.4, -0.2, 2.0]), torch.zeros(4), torch.zeros(4)
    for _ in range(99):
        spikes, membrane = integrate_and_fire(membrane + current, 0.75)
        assert set(spikes.tolist()) <= {0.0, 1.0} and (membrane[spikes > 0] == 0).all()
        count += spikes
    # 0.8 is the first multiple of 0.1, and of 0.4, above 0.75
    assert count.tolist() == [99 // 8, 99 // 2, 0, 99]
    x = torch.tensor([0.2, 2.0], requires_grad=True)
    spikes, after = integrate_and_fire(x, 0.5)
    (spikes.sum() + 10 * after.sum()).backward()
    assert x.grad.tolist() == [10.0, 2.0]


@pytest.mark.parametrize("name", NETWORKS)
def test_sizes_of_every_network(name):
    """tiny about a million parameters, as many as the page says, and it takes its smallest input and answers
    at its size."""
    with torch.device("meta"):
        parameters = [parameters_of(build(name=name, size=size)) for size in SIZES]
    page = (Path(__file__).parents[2] / "docs/eflow.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith(f"|`{name}`|"))
    assert row.split("|")[3].split(", ") == [f"{n / 1e6:.{1 if n > 1e7 else 2}f}" for n in parameters]
    assert parameters[0] > parameters[1] > parameters[2] and 0.8e6 < parameters[2] < 1.6e6
    model = build(name=name, size="tiny")
    assert predict(model, batch_for(model, 1, model.least, model.least + 4)).flow.shape[-2:] == (
        model.least,
        model.least + 4,
    )


@pytest.mark.parametrize(
    "name, size, message",
    [
        ("eraft", (130, 128), "Eraft: height and width are not multiples"),
        ("eflowformer", (120, 128), "EFlowFormer: input is too small"),
        ("ev_flownet", (40, 64), "EvFlowNet: height and width are not multiples"),
        ("ste_flownet", (16, 64), "SteFlowNet: input is too small"),
    ],
)
def test_refused_sizes(name, size, message):
    model = build(name=name)
    with pytest.raises(BlinkGLError, match=message):
        model(batch_for(model, 1, *size))
    with pytest.raises(BlinkGLError, match="another representation"):
        model({k: torch.zeros(1, 3, 128, 128) for k in ("old", "new")})
    with pytest.raises(BlinkGLError, match="too small"):
        predict(model, batch_for(model, 1, 24, 24))


@pytest.mark.parametrize("features", [48, 112, 176])
def test_heads_divide_the_features(features):
    model = build(name="eflowformer", size="tiny", features=features, iterations=1).eval()
    assert model(batch_for(model, 1, 64, 64)).flow.shape == (1, 2, 64, 64)


def test_heads_of_the_sizes_as_published():
    heads = lambda **tree: {layer.local.heads for layer in build(name="eflowformer", layers=1, **tree).layers}
    assert [heads(size=size) for size in ("base", "small", "tiny")] == [{8}, {4}, {4}]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"trunk": [8, 8, 9]}, r"model.trunk: not widths \(got \[8, 8, 9\]\); expected an even last width"),
        ({"input": {"normalise": "all"}}, r"model.input.normalise: not with quick \(got 'all'\)"),
    ],
)
def test_what_quick_cannot_be(keys, said):
    with pytest.raises(BlinkGLError, match=said):
        model_config({"name": "eflowformer", "quick": True, **keys})
    assert build(name="eflowformer", size="tiny", layers=1, **keys)


def test_loss_by_hand():
    valid = torch.tensor([[[True, True, False]]])
    target = torch.tensor([[[[1.0, 2.0, float("nan")]], [[0.0, 0.0, float("nan")]]]])
    flows = [torch.zeros(1, 2, 1, 3), torch.ones(1, 2, 1, 3), target.nan_to_num(7)]
    errors = [(1 + 2) / 2, (0 + 1 + 1 + 1) / 2, 0.0]  # |du| + |dv|, mean over the two valid pixels
    loss = sequence_loss(FlowPrediction(flows), target, valid, gamma=0.8)
    assert loss.item() == pytest.approx(0.64 * errors[0] + 0.8 * errors[1])
    loss = sequence_loss(FlowPrediction(flows, has_match=True), target, valid, gamma=0.8, match_weight=3)
    assert loss.item() == pytest.approx(3 * errors[0] + 0.8 * errors[1])
    scales = FlowPrediction(flows, kind="scales")
    assert sequence_loss(scales, target, valid).item() == pytest.approx(sum(errors) / 3)
    doubled = sequence_loss(FlowPrediction(flows), target.repeat(2, 1, 1, 1), torch.cat([valid, valid & False]))
    assert doubled.item() == pytest.approx(0.64 * errors[0] + 0.8 * errors[1])  # more invalid pixels do not dilute it
    assert sequence_loss(FlowPrediction(flows), target, valid & False).item() == 0


def test_a_loss_of_nothing_is_refused():
    with pytest.raises(Exception, match="no term has a weight"):
        LossConfig(l1=0)


def test_consensus_gives_an_affine_field_back_wherever_it_is_seen():
    """What is affine over the image is found from the places that have a say, at any size, and carried to the rest;
    places without weight change nothing."""
    torch.manual_seed(0)
    layer = Consensus(8, groups=2)
    layer.RIDGE = 0.0
    for height, width in ((8, 8), (11, 15)):
        v, u = torch.meshgrid(torch.arange(height) * 1.0, torch.arange(width) * 1.0, indexing="ij")
        slopes = torch.randn(8, 3, 1, 1)
        true = (slopes[:, 0] + slopes[:, 1] * u + slopes[:, 2] * v)[None]
        seen = torch.zeros(1, 2, height, width)
        seen[..., 2:7, 1:6] = torch.rand(5, 5) + 0.5
        noisy = torch.where(seen[:, :1] > 0, true, true + 1e-2 * torch.randn_like(true))
        assert (layer.fitted(noisy, seen) - true).abs().max() < 2e-2
        assert (layer.fitted(true, torch.rand(1, 2, height, width)) - true).abs().max() < 1e-3
    # A line of places has no slope across it: the ridge keeps it flat there.
    line = torch.zeros(1, 2, 8, 8)
    line[..., 3, :] = 1
    flat = Consensus(8, groups=2).fitted(torch.randn(1, 8, 8, 8), line)
    assert flat.isfinite().all() and (flat[..., 7, :] - flat[..., 0, :]).abs().max() < 0.5
    with torch.autocast("cpu", torch.bfloat16):
        x = torch.randn(1, 8, 8, 8, dtype=torch.bfloat16)
        assert Consensus(8)(x).dtype == torch.bfloat16


def test_a_silent_surround_has_no_say():
    """A view in the middle of a larger sensor, with stray events around: cells far from it get no weight, so what they
    hold is the same to the network."""
    torch.manual_seed(0)
    events = torch.zeros(1, 2, 256, 320)
    events[..., 64:192, 64:192] = (torch.rand(1, 2, 128, 128) < 0.1).float()
    events[0, 0, torch.randint(256, (60,)), torch.randint(320, (60,))] = 1
    seen = seen_cells(events, 16)
    inside = torch.zeros(1, 1, 16, 20)
    inside[..., 4:12, 4:12] = 1
    assert (seen[inside > 0] == 1).all() and seen.sum() <= 12 * 12
    layer, x = Consensus(8, groups=2), torch.randn(1, 8, 16, 20)
    other = torch.where(seen > 0, x, 99 * torch.randn_like(x))
    weight = torch.rand(1, 2, 16, 20) * seen
    fields = [layer.fitted(one, weight)[..., 4:12, 4:12] for one in (x, other)]
    assert (fields[0] - fields[1]).abs().max() < 1  # 1e-4 of the weight remains, so that silence is not 0 / 0
    assert seen_cells(torch.zeros(1, 2, 64, 64), 16).isfinite().all()


def test_length_is_priced_either_way_and_whatever_the_direction():
    loss = LossConfig(l1=0, epe=1e-9, length=1, knee=1)
    target = torch.tensor([3.0, 0.0]).reshape(1, 2, 1, 1)
    price = lambda u, v: float(pixel_error(torch.tensor([u, v]).reshape(1, 2, 1, 1), target, loss))
    assert price(3.0, 0.0) < 1e-5 and price(0.0, -3.0) < 1e-5
    assert price(1.0, 0.0) == pytest.approx(math.log(2), abs=1e-4) and price(7.0, 0.0) == pytest.approx(
        math.log(2), abs=1e-4
    )
    still = torch.zeros(1, 2, 1, 1, requires_grad=True)
    pixel_error(still, target, loss).sum().backward()
    assert still.grad.isfinite().all()
