"""What every model takes and gives.

``model(batch) -> FlowPrediction`` with ``batch["old"]`` and ``batch["new"]``, both (N, C, H, W) float32 as made by
``model.representation``: the events of [t - Δ, t) and of [t, t + Δ). Models of one window ignore ``old``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor, nn

from blinkgl.errors import EventDataError

if TYPE_CHECKING:
    from blinkgl.config.base import Config as BaseConfig
    from eflow.data.representation import Representation


@dataclass(frozen=True)
class FlowPrediction:
    """flows : list of (N, 2, H, W) float32 px at input resolution, t -> t + Δ at reference
    t, +x right, +y down; coarse or early
        first, the last is the answer. Evaluation mode gives only the last.
    kind : "sequence" (refinements of one field) or "scales" (decoder scales); decides the weights of the loss.
    has_match : flows[0] is the matching layer's field, not the refinement's.
    low : (N, 2, H/8, W/8) final low-resolution flow in units of low-resolution px, for a
    warm start; None where there is none.
    """

    flows: list[Tensor]
    kind: str = "sequence"
    has_match: bool = False
    low: Tensor | None = None

    @property
    def flow(self) -> Tensor:
        return self.flows[-1]


class FlowModel(nn.Module):
    """Base: the input check. Subclasses name their ``Config`` and set ``divisor``, ``least`` and ``representation``."""

    Config: ClassVar[type[BaseConfig]]
    """What the network is made from; its key ``name`` is the network's in :data:`eflow.models.NETWORKS`."""
    divisor: int = 8
    """Height and width must be multiples of this; :mod:`eflow.infer` pads."""
    least: int = 32
    """Smallest accepted height and width, px."""
    reads: ClassVar[tuple[str, ...]] = ("old", "new")
    """The windows that it looks at; a batch need not hold others."""
    pad_to: int | None = None
    """Multiple that :mod:`eflow.infer` pads to; None: ``divisor``."""
    pad_start: bool = False
    """Pad at the left and top instead of the right and bottom."""
    representation: Representation
    config: Any

    def check_input(self, batch: dict) -> None:
        """Raises EventDataError for sizes and shapes the network cannot work on."""
        new = batch["new"]
        channels = self.representation.channels
        height, width = new.shape[-2:]
        # The representation decides the channels; a tensor of another one would run through and mean
        # nothing.
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
    """Kaiming for convolutions (fan-out, ReLU), ones and zeros for norms, Xavier for linear layers; biases zero."""
    for m in module.modules():
        # Fan-out keeps the size of gradients from layer to layer. Of a transposed convolution, whose
        # weight has inputs and outputs exchanged, torch's fan_in is just that.
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
    """Number of trainable parameters."""
    return sum(p.numel() for p in model.parameters() if p.requires_grad)
