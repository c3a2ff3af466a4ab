"""Fast operations against their slow twins and against closed forms."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import raft_reference  # noqa: E402
from eflow.ops import attention  # noqa: E402
from eflow.ops.correlation import (  # noqa: E402
    DenseCorrelation,
    OnDemandCorrelation,
    local_correlation,
    pixel_grid,
)
from eflow.ops.resample import backward_warp, bilinear_upsample, convex_upsample, forward_warp  # noqa: E402

H, W = 17, 21


@pytest.fixture
def maps():
    torch.manual_seed(0)
    return torch.randn(2, 32, H, W), torch.randn(2, 32, H, W)


def targets() -> torch.Tensor:
    """Coordinates inside, across every edge, far outside, on integers."""
    torch.manual_seed(1)
    coords = pixel_grid(H, W, torch.zeros(1)) + 6 * torch.randn(2, 2, H, W)
    coords[0, :, 0] = coords[0, :, 0].round()
    coords[1, :, 1] = torch.tensor([[-60.0], [500.0]])
    return coords


def test_lookup_gather_cpu_and_on_demand_equal_rafts(maps):
    coords = targets()
    dense = DenseCorrelation(*maps)
    slow = raft_reference.lookup(dense.levels, coords)
    assert slow.shape == (2, 324, H, W)
    with torch.enable_grad():
        gather = dense.lookup(coords)
    with torch.no_grad():
        kernel = dense.lookup(coords)
    on_demand = OnDemandCorrelation(*maps).lookup(coords)
    for taps in (gather, kernel, on_demand):
        assert (taps - slow).abs().max() < 4e-5


def test_lookup_gradients_equal_rafts(maps):
    coords, weights = targets(), torch.randn(2, 324, H, W)
    gradients = []
    for make in (DenseCorrelation, raft_reference.SampledCorrelation, OnDemandCorrelation):
        f1, f2 = (m.clone().requires_grad_() for m in maps)
        (make(f1, f2).lookup(coords) * weights).sum().backward()
        gradients.append((f1.grad, f2.grad))
    for other in gradients[1:]:
        for a, b in zip(gradients[0], other):
            assert (a - b).abs().max() < 1e-3 * a.abs().max()


def test_matching_dense_equals_on_demand_equals_the_definition(maps):
    h, w = H, W
    dense, on_demand = DenseCorrelation(*maps), OnDemandCorrelation(*maps)
    volume = torch.einsum("ndi,ndj->nij", maps[0].flatten(2).double(), maps[1].flatten(2).double()) / np.sqrt(32)
    grid = pixel_grid(h, w, volume).double().flatten(2)
    expected = (volume.softmax(-1) @ grid[0].T).transpose(1, 2).view(2, 2, h, w) - grid.view(1, 2, h, w)
    for flow in (dense.match(), on_demand.match()):
        assert (flow - expected).abs().max() < 1e-4


def test_convex_upsampling_equals_its_twin_and_keeps_constants():
    torch.manual_seed(3)
    flow, mask = torch.randn(2, 2, 7, 9), torch.randn(2, 576, 7, 9)
    assert (convex_upsample(flow, mask) - raft_reference.convex_upsample(flow, mask)).abs().max() < 1e-5
    constant = torch.full((1, 2, 7, 9), 3.0)
    for upsample in (convex_upsample, raft_reference.convex_upsample):
        assert torch.allclose(upsample(constant, mask[:1]), torch.tensor(24.0))  # edges and corners too
    assert torch.allclose(bilinear_upsample(constant), torch.tensor(24.0))


@pytest.mark.parametrize("size", [(20, 30), (23, 17), (8, 41)])
def test_window_attention_with_masked_padding_equals_unpadded(size):
    """Against attention computed window by window on the real tokens alone."""
    torch.manual_seed(5)
    layer, x = attention.WindowAttention(32, 4, 10), torch.randn(2, *size, 32)
    expected = torch.empty_like(x)
    for top in range(0, size[0], 10):
        for left in range(0, size[1], 10):
            part = x[:, top : top + 10, left : left + 10]
            tokens = part.reshape(2, -1, 32)
            q, k, v = layer.qkv(tokens).chunk(3, -1)
            heads = lambda t: t.view(2, -1, 4, 8).transpose(1, 2)
            p = (heads(q) @ heads(k).transpose(-1, -2) / np.sqrt(8)).softmax(-1)
            expected[:, top : top + 10, left : left + 10] = layer.proj(
                (p @ heads(v)).transpose(1, 2).reshape(2, -1, 32)
            ).view(part.shape)
    assert (layer(x) - expected).abs().max() < 1e-5


def test_local_correlation_and_warping():
    torch.manual_seed(6)
    f1 = torch.randn(1, 16, 12, 14)
    f2 = torch.roll(f1, (2, -1), (2, 3))
    taps = local_correlation(f1, f2)
    assert taps.shape == (1, 81, 12, 14)
    best = taps[0, :, 5, 7].argmax()
    assert (int(best) // 9 - 4, int(best) % 9 - 4) == (2, -1)
    flow = torch.tensor([-1.0, 2.0])[None, :, None, None].expand(1, 2, 12, 14)
    assert torch.allclose(backward_warp(f2, flow)[..., 1:9, 2:12], f1[..., 1:9, 2:12], atol=1e-5)
    assert torch.allclose(backward_warp(f2, torch.zeros_like(flow)), f2, atol=1e-5)


def test_forward_warp_carries_flow_along():
    flow = torch.zeros(1, 2, 10, 12)
    flow[..., 4, 5] = torch.tensor([2.0, -1.0])
    moved = forward_warp(flow)
    assert moved[0, :, 3, 7].tolist() == [1.0, -0.5]  # average with the still pixel it lands on
    assert moved[0, :, 4, 5].tolist() == [0.0, 0.0]
    constant = torch.tensor([1.5, 0.25])[None, :, None, None].expand(1, 2, 10, 12)
    assert torch.allclose(forward_warp(constant)[..., 2:, 3:], constant[..., 2:, 3:], atol=1e-6)
