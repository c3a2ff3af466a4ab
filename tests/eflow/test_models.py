"""The networks: size and arithmetic as published, the equalities between them, and what they refuse."""

import pytest

torch = pytest.importorskip("torch")

from blinkgl.errors import BlinkGLError  # noqa: E402
from eflow.counting import count  # noqa: E402
from eflow.infer import predict  # noqa: E402
from eflow.losses import sequence_loss  # noqa: E402
from eflow.models import FlowPrediction, build_model, model_config  # noqa: E402


def build(seed: int = 0, **tree):
    torch.manual_seed(seed)
    return build_model(model_config(tree))


def batch_for(model, n=1, height=128, width=128, seed=0) -> dict:
    torch.manual_seed(seed)
    return {k: torch.randn(n, model.representation.channels, height, width) for k in ("old", "new")}


PUBLISHED = [  # million parameters, GMACs at 480x640 with 12 and with 6 iterations
    ({"name": "eraft"}, 5.33, 257, None),
    ({"name": "eflowformer", "variant": "small"}, 9.05, 294, 204),
    ({"name": "eflowformer"}, 12.76, 332, 242),
    ({"name": "eflowformer", "variant": "twins"}, 14.28, 307, 217),
    ({"name": "ev_flownet", "input": "voxel"}, 14.1, 62, None),
    ({"name": "spike_flownet"}, 13.0, None, None),
    ({"name": "ste_flownet"}, 48.3, None, None),
]


@pytest.mark.parametrize(
    "tree, parameters, gmacs, gmacs_6", PUBLISHED, ids=lambda v: "-".join(v.values()) if isinstance(v, dict) else ""
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
def test_fast_path_equals_the_raft_style_twin_and_on_demand_correlation(name):
    """The same flow to 1e-3 px: lookup, hoisted context, mask and upsampling once; and without the volume."""
    model = build(name=name, iterations=4).eval()
    loud(model)
    batch = batch_for(model, 2, 136, 152)
    fast = predict(model, batch).flow
    assert fast.abs().mean() > 1  # otherwise equality says nothing
    model.plain = True
    plain = predict(model, batch).flow
    model.plain = False
    model.config = model.config.model_copy(update={"correlation": "on_demand"})
    on_demand = predict(model, batch).flow
    assert (fast - plain).abs().max() < 1e-3
    assert (fast - on_demand).abs().max() < 1e-3


def loud(model) -> None:
    """Freshly initialised heads say next to nothing; give them a voice."""
    torch.manual_seed(9)
    torch.nn.init.normal_(model.update.flow_head[-1].weight, std=0.02)


def test_training_gradients_of_fast_and_plain_agree():
    gradients = []
    for plain in (False, True):
        model = build(name="eflowformer", variant="small", train_iterations=2, context_norm="instance").train()
        loud(model)
        model.plain = plain
        batch = batch_for(model)
        prediction = model(batch)
        sequence_loss(prediction, torch.zeros(1, 2, 128, 128), torch.ones(1, 128, 128, dtype=torch.bool)).backward()
        gradients.append({n: p.grad for n, p in model.named_parameters()})
    assert all(g is not None for g in gradients[0].values())  # every parameter is trained
    for name, a in gradients[0].items():
        b = gradients[1][name]
        assert (a - b).abs().max() <= 2e-3 * b.abs().max() + 1e-5, name


def test_match_is_supervised_detached_and_first():
    model = build(name="eflowformer", variant="small", train_iterations=2, context_norm="instance").train()
    prediction = model(batch_for(model))
    assert (
        prediction.has_match
        and len(prediction.flows) == 3
        and all(f.shape == (1, 2, 128, 128) for f in prediction.flows)
    )
    # nothing of the refinement reaches the enhancement layers through V0 itself: only through the volume's lookups
    first = torch.autograd.grad(prediction.flows[0].sum(), model.layers[0].local.qkv.weight, retain_graph=True)[0]
    assert first.abs().max() > 0
    model.want_backward = True
    out = predict(model, batch_for(model))
    assert out.backward_match.shape == (1, 2, 16, 16) and len(out.flows) == 1


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


def test_warm_start_starts_there():
    model = build(name="eraft", iterations=1).eval()
    torch.nn.init.zeros_(model.update.flow_head[-1].weight)
    batch = batch_for(model)
    warm = torch.randn(1, 2, 16, 16)
    assert torch.equal(predict(model, {**batch, "flow_init": warm}).low, warm)
    assert torch.equal(predict(model, batch).low, torch.zeros(1, 2, 16, 16))


@pytest.mark.parametrize("name", ["ev_flownet", "spike_flownet", "ste_flownet"])
def test_baselines_train_every_parameter_and_answer_at_full_size(name):
    model = build(name=name).train()
    batch = {k: (v.abs() * 3).round() for k, v in batch_for(model, 1, 64, 80).items()}
    prediction = model(batch)
    assert prediction.kind == "scales" and all(f.shape == (1, 2, 64, 80) for f in prediction.flows)
    sequence_loss(prediction, torch.ones(1, 2, 64, 80), torch.ones(1, 64, 80, dtype=torch.bool)).backward()
    silent = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not silent
    out = predict(model, {k: v[..., :60, :75] for k, v in batch.items()})  # padded and cut back
    assert len(out.flows) == 1 and out.flow.shape == (1, 2, 60, 75) and out.flow.abs().max() < 60


def test_spikes_are_binary_and_conserve_charge():
    """Soft reset: membrane = summed current - threshold x spikes, so over many steps the rate follows the current."""
    from eflow.models.spike_flownet import _Fire

    current, membrane, spikes = torch.tensor([0.1, 0.4, -0.2]), torch.zeros(3), torch.zeros(3)
    for _ in range(100):
        membrane = membrane + current
        s = _Fire.apply(membrane, 0.75)
        assert set(s.tolist()) <= {0.0, 1.0}
        membrane, spikes = membrane - 0.75 * s, spikes + s
    assert torch.allclose(membrane, 100 * current - 0.75 * spikes, atol=1e-4)
    assert spikes.tolist() == pytest.approx([100 * 0.1 / 0.75, 100 * 0.4 / 0.75, 0], abs=1)
    x = torch.tensor([0.2, 2.0], requires_grad=True)
    _Fire.apply(x, 0.5).sum().backward()
    assert x.grad.tolist() == [2.0, 2.0]


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


def test_loss_by_hand():
    valid = torch.tensor([[[True, True, False]]])
    target = torch.tensor([[[[1.0, 2.0, float("nan")]], [[0.0, 0.0, float("nan")]]]])
    flows = [torch.zeros(1, 2, 1, 3), torch.ones(1, 2, 1, 3), target.nan_to_num(7)]
    errors = [(1 + 2) / 2, (0 + 1 + 1 + 1) / 2, 0.0]  # |du| + |dv|, mean over the two valid pixels
    loss = sequence_loss(FlowPrediction(flows), target, valid, gamma=0.8)
    assert loss.item() == pytest.approx(0.64 * errors[0] + 0.8 * errors[1])
    loss = sequence_loss(FlowPrediction(flows, has_match=True), target, valid, gamma=0.8, match_weight=3)
    assert loss.item() == pytest.approx(3 * 0.64 * errors[0] + 0.8 * errors[1])
    assert sequence_loss(FlowPrediction(flows, kind="scales"), target, valid).item() == pytest.approx(sum(errors) / 3)
    doubled = sequence_loss(FlowPrediction(flows), target.repeat(2, 1, 1, 1), torch.cat([valid, valid & False]))
    assert doubled.item() == pytest.approx(0.64 * errors[0] + 0.8 * errors[1])  # more invalid pixels do not dilute it
    assert sequence_loss(FlowPrediction(flows), target, valid & False).item() == 0


def test_share_of_the_matching_term():
    """12 iterations at gamma 0.8: V0 holds 1.45 % of the weights."""
    weights = [0.8 ** (12 - i) for i in range(13)]
    one = torch.ones(1, 2, 1, 1)
    zero_target, valid = torch.zeros(1, 2, 1, 1), torch.ones(1, 1, 1, dtype=torch.bool)
    full = sequence_loss(FlowPrediction([one] * 13, has_match=True), zero_target, valid)
    without = sequence_loss(FlowPrediction([one] * 13, has_match=True), zero_target, valid, match_weight=0)
    share = (1 - without / full).item()
    assert share == pytest.approx(weights[0] / sum(weights), rel=1e-4) and share == pytest.approx(0.0145, abs=1e-4)
