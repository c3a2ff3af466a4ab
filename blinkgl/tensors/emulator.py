"""``events.device: cuda``: ESIM and V2E on a GPU with the interface of the other emulators.

A batch of one environment makes the events; checks, saving and restoring are those of the CPU emulator, so that a saved
state of one continues in the other, and files are the same.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from blinkgl.errors import EventDataError
from blinkgl.events.bands import BLOCK
from blinkgl.events.emulator import Emulator
from blinkgl.events.esim import Esim
from blinkgl.events.v2e import V2e
from blinkgl.tensors.batch import Batch
from blinkgl.tensors.esim import TensorEsim
from blinkgl.tensors.v2e import TensorV2e
from blinkgl.types.events import Events

DEVICE = "cuda"
"""torch's device for ``events.device: cuda``; tests without a GPU set "cpu"."""
_trials: dict[tuple[str, str], bool] = {}


class _OnDevice(Emulator):
    """Mix-in for a class before the emulator whose events it makes."""

    device = "cuda"
    _batch_kind: ClassVar[Any]

    def __init__(self, height: int, width: int, config: object = None, seed: int = 0, device: object = DEVICE):
        super().__init__(height, width, config, seed)  # type: ignore[bad-argument-type]
        self._batch: Batch = self._batch_kind(height, width, self.config, device=device, seed=seed)
        self.tensor_device = self._batch.device

    def step(self, luminance: Any, t_ns: int, rows: Any = None) -> Events:
        # Arrays are checked by the CPU emulator, which then calls _start or _advance.
        if not isinstance(luminance, Tensor):
            return super().step(luminance, t_ns, rows)
        # A frame on the device: the batch checks it there.
        t_ns = self._checked_time(t_ns)
        events = self._made(luminance[None] if luminance.ndim == 2 else luminance, t_ns)
        # The changed rows of a frame on the device are not known.
        self.t_ns, self._rows_before = t_ns, None
        self.frames += 1
        return events

    def _made(self, frames: Tensor, t_ns: int) -> Events:
        try:
            events = self._batch.step(frames, t_ns).numpy()[0]
        except EventDataError as error:  # there is only one environment, so its number is left out
            where = (error.where or "").replace("environment 0, ", "") or None
            alone = EventDataError(error.problem, where=where, value=error.value, accepted=error.accepted)
            alone.pixel = error.pixel
            raise alone from None
        self.saturated = int(self._batch.saturated[0])
        return events if len(events) else Events.empty()

    def _of_array(self, frame: np.ndarray, t_ns: int) -> Events:
        light = np.ascontiguousarray(self.decoded(frame)).reshape(1, self.height, self.width)
        return self._made(torch.from_numpy(light).to(self._batch.device), t_ns)

    def _start(self, frame: np.ndarray, t_ns: int) -> Events:
        return self._of_array(frame, t_ns)

    def _advance(self, frame: np.ndarray, t_ns: int) -> Events:
        return self._of_array(frame, t_ns)

    def decoded(self, frame: Any) -> Any:
        """Return the decoded frame as :meth:`Emulator.decoded`; a tensor unchanged."""
        return frame if isinstance(frame, Tensor) else super().decoded(frame)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state of the CPU emulator."""
        there = self._batch.state_dict()
        # The batch keeps V2e's leak clock in another form.
        epoch = {"_epoch_ns": there["clock"][:, 3]}
        for name, values in {**there, **epoch}.items():
            if name in self._state:
                mine = getattr(self, name)
                mine[...] = values.cpu().numpy().reshape(mine.shape)
        return super().state_dict()

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        super().load_state_dict(state)
        there = self._batch.state_dict()
        # The batch's clock: started, time, frames, start of the leak clock (Batch._clock).
        epoch = int(getattr(self, "_epoch_ns", [0])[0])
        clock = [self.t_ns is not None, self.t_ns or 0, self.frames, epoch]
        there["clock"] = torch.tensor([clock], dtype=torch.int64)
        there["saturated"] = torch.tensor([self.saturated])
        for name in there:
            if name in self._state:
                there[name] = torch.from_numpy(np.array(getattr(self, name)).reshape(-1))
        self._batch.load_state_dict(there)


class DeviceEsim(_OnDevice, Esim):
    """:class:`~blinkgl.events.esim.Esim` on a torch device."""

    _batch_kind = TensorEsim


class DeviceV2e(_OnDevice, V2e):
    """:class:`~blinkgl.events.v2e.V2e` on a torch device. A step in which the CPU would cut events by
    ``max_events_per_step`` raises EventDataError, because files must be the same on both; the emulator cannot go on
    after it."""

    _batch_kind = TensorV2e

    def _made(self, frames: Tensor, t_ns: int) -> Events:
        events = super()._made(frames, t_ns)
        # The CPU's limit is divided among blocks of pixels, see Emulator._run.
        share = max(BLOCK, self.config.max_events_per_step // -(-self.height * self.width // BLOCK))
        if len(events) > share:
            pixels = events.pixel(self.width)
            if np.bincount(pixels // BLOCK).max() > share:
                raise EventDataError(
                    "more events in a step than the CPU would keep",
                    where="events.max_events_per_step",
                    value=self.config.max_events_per_step,
                    accepted="a higher limit, or events.device: cpu",
                )
        return events


KINDS: dict[Any, type[_OnDevice]] = {Esim: DeviceEsim, V2e: DeviceV2e}
"""Classes for a device, by those for the CPU."""


def emulator_on(kind: Any, config: Any, height: int, width: int, seed: int) -> Emulator:
    """Return the emulator ``kind`` on :data:`DEVICE`; for ``events.device: auto`` the CPU's where it is not supported.

    Raises EventDataError, naming the key, where the GPU is requested and cannot do it."""
    problem = _problem(kind, config, DEVICE)
    if problem is None:
        return KINDS[kind](height, width, config, seed, DEVICE)
    if config.device == "auto":
        return kind(height, width, config, seed)
    raise problem


def _problem(kind: object, config: Any, device: Any) -> EventDataError | None:
    """Return why this device cannot make these events; None: it can."""
    if kind not in KINDS:
        return EventDataError(
            "not computed on tensors", where="events.device", value=config.device, accepted="cpu, or auto"
        )
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        return EventDataError(
            "torch finds no CUDA GPU", where="events.device", value=config.device, accepted="cpu, or auto"
        )
    if not same_events(kind, config, device):
        return EventDataError(
            "the GPU's events of a trial differ from the CPU's",
            where="events.device",
            value=config.device,
            accepted="cpu, or another driver",
        )
    return None


def same_events(kind: Any, config: Any, device: Any) -> bool:
    """Return whether a short clip, 32 x 64 pixels and three intervals, has the same events on a device as on the CPU.
    Tested once per configuration, device and process."""
    # The trial's few pixels must not be cut: the limit is compared with each step.
    limit = type(config).model_fields["max_events_per_step"].default
    config = config.model_copy(update={"max_events_per_step": limit})
    # The trial's result is kept for the process: a GPU does not change meanwhile.
    key = (str(device), config.model_dump_json())
    if key not in _trials:
        # Noise fires pixels of both polarities; 1_000_003 ns is not a whole number of microseconds.
        rng = np.random.default_rng(1)
        clip = np.exp(rng.normal(-1, 0.5, (4, 32, 64))).astype(np.float32)
        both = KINDS[kind](32, 64, config, 1, device), kind(32, 64, config, 1)
        steps = [[one.step(frame, 1_000_003 * k) for k, frame in enumerate(clip)] for one in both]
        ours, theirs = (Events.concatenate(chunks) for chunks in steps)
        _trials[key] = ours.columns == theirs.columns and all(
            np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in theirs.columns
        )
    return _trials[key]
