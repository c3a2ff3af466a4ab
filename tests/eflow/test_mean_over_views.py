"""The mean over views of the events: a network that leans to one side no longer does."""

import numpy as np
import pytest
import torch

from eflow.data.window import RawSample, StreamWindow
from eflow.infer import Predictor, default_views
from eflow.models import build_model, model_config
from flow_data import SPAN, moving_events
from trainings import FAST

HEIGHT, WIDTH = 70, 90
"""Padding to the networks' stride is on one side, so that no mirrored view has it where another has."""


@pytest.fixture(
    scope="module", params=[FAST, {"name": "eraft", "size": "tiny", "iterations": 2}], ids=lambda tree: tree["name"]
)
def model(request):
    torch.manual_seed(3)
    made = build_model(model_config(request.param)).eval()
    for parameter in made.parameters():  # heads begin at zero
        torch.nn.init.normal_(parameter, std=0.05) if parameter.dim() > 1 else None
    return made


def samples() -> list[RawSample]:
    """Two pairs of windows, of which one follows the other."""
    events = moving_events(HEIGHT, WIDTH, 0, 3 * SPAN, n=6_000)
    pairs = [StreamWindow.of(events, k * SPAN, (k + 1) * SPAN, (k + 2) * SPAN) for k in (0, 1)]
    return [RawSample(old=p.old, new=p.new, height=HEIGHT, width=WIDTH, name="", scene="a") for p in pairs]


CHANGES = {
    "x": (lambda s: s.flip("x"), lambda f: f[:, ::-1] * [-1, 1]),
    "y": (lambda s: s.flip("y"), lambda f: f[::-1] * [1, -1]),
    "polarity": (lambda s: s.invert(), lambda f: f),
}


@pytest.mark.parametrize(("views", "change"), [(4, "x"), (4, "y"), (8, "polarity")])
def test_changed_events_have_changed_flow(model, views, change):
    """Which the network alone does not give: mirrored events, mirrored flow; swapped polarities, the same flow. The
    second window starts from the first one's flow, where the network refines it."""
    warm = hasattr(model.config, "iterations")
    changed, back = CHANGES[change]
    predict = lambda number: Predictor(model, HEIGHT, WIDTH, views=number, warm_start=warm)
    plain, other, alone, alone_other = predict(views), predict(views), predict(1), predict(1)
    for sample in samples():
        right = plain(sample)[0]
        length = np.abs(right).max()
        np.testing.assert_allclose(back(other(changed(sample))[0]), right, atol=1e-4 * length)
        assert np.abs(back(alone_other(changed(sample))[0]) - alone(sample)[0]).max() > 0.01 * length
    assert plain.warm == warm


def test_the_mean_is_that_of_the_samples_views(model):
    """Whose events are changed here, not tensors."""
    sample, one = samples()[0], Predictor(model, HEIGHT, WIDTH)
    flows = [one(sample)[0], one(sample.flip("x"))[0][:, ::-1] * [-1, 1], one(sample.flip("y"))[0][::-1] * [1, -1]]
    flows.append(-one(sample.flip("x").flip("y"))[0][::-1, ::-1])
    four = Predictor(model, HEIGHT, WIDTH, views=4)(sample)[0]
    np.testing.assert_allclose(four, np.mean(flows, axis=0), atol=1e-4 * np.abs(four).max())
    inverted = Predictor(model, HEIGHT, WIDTH, views=4)(sample.invert())[0]
    eight = Predictor(model, HEIGHT, WIDTH, views=8)(sample)[0]
    np.testing.assert_allclose(eight, (four + inverted) / 2, atol=1e-4 * np.abs(eight).max())


def test_the_default_is_for_networks_that_were_trained_on_mirrored_samples():
    assert [default_views(name) for name in ("real_small", "real_bodies", "out/run")] == [4, 4, 1]
