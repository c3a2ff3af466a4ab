"""The interface of all networks.

``model(batch) -> FlowPrediction`` with ``batch["old"]`` and ``batch["new"]``, both (N, C, H, W) float32 as made by
``model.representation``: the events of [t - Δ, t) and of [t, t + Δ). Networks of one window ignore ``old``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

from torch import Tensor, nn

from blinkgl.config.base import Config as BaseConfig
from blinkgl.errors import EventDataError
from eflow.config import NetworkConfig
from eflow.data.representation import Representation
from eflow.types import Batch

C = TypeVar("C", bound=NetworkConfig)


@dataclass(frozen=True)
class FlowPrediction:
    """The output of a network.

    flows : list of (N, 2, H, W) float32 px at input resolution, t -> t + Δ at reference time t, +x right, +y down.
        Coarse or early flow comes first, the result last. In evaluation mode there is only the result.
    kind : "sequence" (refinements of one field) or "scales" (of a decoder); it decides the weights of the loss.
    has_match : flows[0] is the flow of the matching layer.
    low : (N, 2, H/8, W/8) final low-resolution flow, in px of that resolution, for a warm start; None if the network
        has none.
    """

    flows: list[Tensor]
    kind: str = "sequence"
    has_match: bool = False
    low: Tensor | None = None

    @property
    def flow(self) -> Tensor:
        return self.flows[-1]


class FlowModel(nn.Module, Generic[C]):
    """Base class of networks. Subclasses set ``Config``, ``divisor``, ``least`` and ``representation``."""

    Config: ClassVar[type[BaseConfig]]
    """Class of its configuration; the key ``name`` of that is the name in :data:`eflow.models.NETWORKS`."""
    divisor: int = 8
    """Height and width must be multiples of this; :mod:`eflow.infer` pads."""
    least: int = 32
    """Smallest accepted height and width, px."""
    reads: ClassVar[tuple[str, ...]] = ("old", "new")
    """The windows that the network reads; a batch need not have others."""
    pad_to: int | None = None
    """Multiple that :mod:`eflow.infer` pads to; None: ``divisor``."""
    pad_start: bool = False
    """Pad at the left and top instead of the right and bottom."""
    representation: Representation
    config: C

    def check_input(self, batch: Batch) -> None:
        """Raise EventDataError if the network cannot process the size or shape of the batch."""
        new = batch["new"]
        channels = self.representation.channels
        height, width = new.shape[-2:]
        # A tensor of another representation with other channels would fail later, or give meaningless flow.
        if new.ndim != 4 or new.shape[1] != channels:
            raise EventDataError(
                "event tensor of another representation",
                where=type(self).__name__,
                value=tuple(new.shape),
                accepted=f"(N, {channels}, H, W)",
            )
        if height % self.divisor or width % self.divisor:
            raise EventDataError(
                "height and width are not multiples of the network's stride",
                where=type(self).__name__,
                value=(height, width),
                accepted=f"multiples of {self.divisor} (eflow predict and evaluate pad)",
            )
        if min(height, width) < self.least:
            raise EventDataError(
                "input is too small for the network",
                where=type(self).__name__,
                value=(height, width),
                accepted=f"at least {self.least} px a side",
            )


def initialise(module: nn.Module) -> None:
    """Initialise convolutions by Kaiming (fan-out, ReLU), linear layers by Xavier, norms by 1, biases by 0."""
    for m in module.modules():
        # Fan-out keeps the size of gradients from layer to layer. The weight of a transposed convolution has inputs
        # and outputs exchanged, so its fan-out is torch's fan_in.
        if isinstance(m, nn.Conv2d):
            nn.init.kaiming_normal_(m.weight, mode="fan_out", nonlinearity="relu")
        elif isinstance(m, nn.ConvTranspose2d):
            nn.init.kaiming_normal_(m.weight, mode="fan_in", nonlinearity="relu")
        elif isinstance(m, nn.Linear):
            nn.init.xavier_uniform_(m.weight)
        elif isinstance(m, (nn.BatchNorm2d, nn.LayerNorm)):
            nn.init.ones_(m.weight)
        else:
            continue
        if m.bias is not None:
            nn.init.zeros_(m.bias)


def parameters_of(model: nn.Module) -> int:
    """Return the number of trainable parameters."""
    return sum(p.numel() for p in model.parameters() if p.requires_grad)
