"""The training loop. From top to bottom: :func:`train`, the parts of a run, its loop, one step, its output.

It runs on the CPU or a GPU (``run.device``; auto uses a GPU if there is one), or on several:

    eflow train configs/eflow/smoke.yaml --out out/smoke
    eflow train configs/eflow/smoke.yaml --out out/smoke --resume
    torchrun --nproc-per-node 8 -m eflow.cli train configs/eflow/eflowformer.yaml --out out/base

A run folder holds config.yaml, log.jsonl, tb/ (tensorboard), checkpoints/<step>/, pictures/ and the
weights of the best validation, best.safetensors. SIGINT and
SIGTERM end the current step and write a checkpoint; the command then exits 130 or 143. ``--resume`` continues from the
newest checkpoint, and begins where there is none yet, so that a job script needs one line. On the
CPU the result is bit for bit that of an uninterrupted run: data order and augmentation depend on (seed, step) alone,
and the learning rate on the step. With ``optim.minutes`` the learning rate depends on the time, which checkpoints
store; such a run does not repeat bit for bit.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from blinkgl.config.reader import to_yaml
from blinkgl.errors import ConfigError, OutputError
from blinkgl.io.atomic import LOCK, locked_folder, make_folders, output_errors, refuse_existing, write_whole
from eflow import checkpoint as ckpt
from eflow.checkpoint import resume_run, weights_of
from eflow.config import OptimConfig, TrainConfig
from eflow.data.content import content_of
from eflow.data.dataset import FlowDataset, StepSampler, batches, is_endless
from eflow.data.sources import Source
from eflow.machine import agree, compile_errors, precision_on, setup, to_device
from eflow.metrics import sequence_loss
from eflow.models import FlowModel, build_model
from eflow.progress import Log, Readings, Signals, TrainProgress, Waiting, cost_of
from eflow.schedule import Course, learning_rate
from eflow.training_data import check_sizes, check_truth, training_sets, validate, validation_sets
from eflow.types import Picture
from eflow.writers import comparison, events_of, write_picture


@dataclass
class TrainResult:
    """How a run ended: ``reason`` is "finished", "signal", "time limit" or "stop"."""

    step: int
    reason: str
    checkpoint: Path
    loss: float


def train(
    config: TrainConfig,
    out: str | os.PathLike,
    *,
    resume: bool = False,
    stop_after: int | None = None,
    quiet: bool = False,
    clock: Callable[[], float] = time.monotonic,
) -> TrainResult:
    """Train to the end of ``config.optim.steps`` or ``minutes`` and return how it ended.

    stop_after : stop after this many steps, as a signal would. clock : seconds, for ``optim.minutes``.

    Raises ConfigError, AssetError, EventDataError (data), OutputError (run folder exists), TrainingError (loss not
    finite: the batch's sample names are in ``nan_batch.json``)."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        # A loader process imports a script without `if __name__ == "__main__":`, which would train again. The first
        # process says so.
        raise SystemExit(2)
    with contextlib.ExitStack() as stack:  # ends the rendering processes
        training = Training(config, Path(out), stack, resume=resume, stop_after=stop_after, clock=clock, quiet=quiet)
        return training.run()


class Training:
    """One call's part of a run: the constructor prepares everything, :meth:`run` trains."""

    def __init__(
        self,
        config: TrainConfig,
        out: Path,
        stack: contextlib.ExitStack,
        *,
        resume: bool,
        stop_after: int | None,
        clock: Callable[[], float],
        quiet: bool,
    ):
        self.rank, self.world, self.device = setup(config)
        # Only the first process writes files and messages.
        self.lead, self.out, self.quiet = self.rank == 0, out, quiet
        precision = precision_on(self.device, config.run.precision, quiet=not self.lead)
        self.config = config.model_copy(update={"run": config.run.model_copy(update={"precision": precision})})
        if self.lead:
            importlib.import_module("torch.utils.tensorboard")  # fail before anything is written
        if self.lead and not resume:
            refuse_existing(out)
        self.saved = ckpt.newest(out) if resume else None
        """The checkpoint to go on from; None: the training begins, also with ``resume`` after an early end."""
        self.begins_anew = resume and self.saved is None
        state = self._make_network()
        self.start = self.step = state["step"]
        self.stop = config.optim.steps if stop_after is None else min(config.optim.steps, self.start + stop_after)
        self._make_data(stack)
        if self.lead:  # now that nothing is wrong with the data
            self.content = content_of(config)
            ckpt.same_content(state.get("content", self.content), self.content, config)
            stack.enter_context(_held(out, resume, lambda: self.step > self.start))
        self.net = self._parallel()
        self.net.train()
        if self.lead:
            if self.saved is None:  # a part that ended before its first checkpoint may have left weights
                (out / "best.safetensors").unlink(missing_ok=True)
            write_whole(out / "config.yaml", as_yaml(self.config))
        self.began, self.read = time.monotonic(), Readings(out)
        self.course = Course(config.optim, clock(), state["seconds"], clock)
        self.done = self.course.done(self.start, self.device, self.world)
        self.path = out
        """The newest checkpoint, or the run folder on ranks that do not write."""

    def _make_network(self) -> ckpt.State:
        """Make network, optimiser and averaged weights, new or from a checkpoint; return its state."""
        config = self.config
        torch.manual_seed(config.seed)
        self.model = build_model(config.model)
        if config.init_from and self.saved is None:
            ckpt.load_weights(self.model, *weights_of(config))
        self.norms = [m for m in self.model.modules() if isinstance(m, torch.nn.BatchNorm2d)]
        if config.optim.freeze_norm and not self.norms:
            raise ConfigError("this network has no batch norm", where="optim.freeze_norm", value=True, accepted="false")
        self.model.to(self.device)
        if config.run.channels_last:
            self.model.to(memory_format=torch.channels_last)  # type: ignore[no-matching-overload]
        self.optimizer = _optimizer(self.model, config.optim, self.device)
        self.ema = {k: v.detach().clone() for k, v in self.model.state_dict().items()} if config.optim.ema else None
        if self.saved is None:
            return {"format": ckpt.FORMAT, "step": 0, "seconds": 0.0}
        return resume_run(self.saved, config, self.model, self.optimizer, self.ema)

    def _make_data(self, stack: contextlib.ExitStack) -> None:
        """Open the training and validation sets, and check that they fit the network before anything is written."""
        config = self.config
        if config.data.batch % (parts := self.world * config.optim.accumulate):
            raise ConfigError(
                "not a multiple of the number of processes times optim.accumulate",
                where="data.batch",
                value=config.data.batch,
                accepted=f"a multiple of {parts}",
            )
        self.mixture, self.sources = training_sets(config, self.start, self.rank, self.world, stack)
        self.dataset = FlowDataset(
            self.sources,
            self.model.representation,
            seed=config.seed,
            augment=config.data.augment,
            crop=config.data.crop,
            leave_out=config.data.leave_out,
            empty=config.data.empty,
            reads=self.model.reads,
        )
        check_sizes(self.dataset, self.model, config.data.crop)
        self.validation = validation_sets(config, self.model) if self.lead else []
        check_truth(self.dataset, self.mixture, self.validation)

    def _parallel(self) -> torch.nn.Module:
        """Return the network, compiled or wrapped to average gradients over processes if the configuration asks for
        it."""
        if self.config.run.compile:  # most of the time of a network with refinements goes to their steps
            getattr(self.model, "update", self.model).compile()
        if self.world == 1:
            return self.model
        return DistributedDataParallel(
            self.model, device_ids=[self.device.index] if self.device.type == "cuda" else None
        )

    # ---- the loop ----------------------------------------------------------------------------------------------------

    def run(self) -> TrainResult:
        """Run the remaining steps and end the process group."""
        config, device = self.config, self.device
        stop = self.start if self.done >= 1 else self.stop
        sampler = StepSampler(self.mixture, config.data.batch, self.start, stop, self.rank, self.world)
        reason = None
        with (
            Signals() as signals,
            Log(self.out, self.start, config.data.batch, enabled=self.lead) as log,
            TrainProgress(
                config.optim.steps,
                self.start,
                config.data.batch,
                enabled=self.lead and not self.quiet,
                where=f"{device.type}, {config.run.precision}",
                minutes=self.course.minutes_left(config.run.time_limit),
            ) as progress,
        ):
            if self.lead:
                log.describe(as_yaml(config), ckpt.leaves(json.loads(config.model_dump_json())))
            if self.begins_anew:
                progress.say(f"no checkpoint in {self.out} yet: the training begins")
            waiting = Waiting(batches(self.dataset, sampler, config.data.workers, pin=device.type == "cuda"))
            for batch in waiting:
                batch = to_device(batch, device, config.run.channels_last)
                rate, flow = self._take(batch)
                # Communication between processes, or between device and host, waits for all work: not at every step.
                looking = self.step == self.start + 1 or self._every("log", "validate", "checkpoint")
                reason = self._reason(signals, looking)
                progress.update(self.step, self.read.values() if looking or self._last or reason else ())
                if self.lead:
                    self._log(log, rate, progress, waiting)
                    if self._every("picture"):
                        strip = _picture(batch, flow)
                        write_picture(self.out / "pictures" / f"{self.step:09d}.png", strip)
                        log.picture(self.step, strip)
                    # A time limit validates as the last step does; a signal should end soon.
                    if self.validation and (self._every("validate") or reason in ("finished", "time limit")):
                        self._validate(log, progress)
                    if self._every("checkpoint") or reason is not None:
                        self.path = self._save()
                if reason is not None:
                    break
            else:
                if self.lead:  # no step was left
                    self.path = ckpt.newest(self.out) or self._save()
            if self.lead and any(is_endless(s) for s in self.sources):
                progress.say("online: " + cost_of(_rendering(self.sources), waiting.share))
        if self.world > 1:
            dist.barrier()
            dist.destroy_process_group()
        return TrainResult(self.step, reason or "finished", self.path, self.read.loss)

    def _take(self, batch: dict) -> tuple[float, Tensor]:
        """Take one step; return its learning rate and the predicted flow, (N, 2, H, W) px."""
        optim = self.config.optim
        rate = learning_rate(self.done, optim.lr, optim.warmup, optim.cooldown)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        for norm in self.norms:  # a validation before this step switched all layers
            norm.train(not optim.freeze_norm)
        self.optimizer.zero_grad(set_to_none=True)
        loss, epe, flow = self._backward(batch)
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), optim.clip)
        self.read.add(self.step, batch["name"], loss, epe, norm)
        self.optimizer.step()
        self.step += 1
        if self.ema is not None:
            # The first steps average over few weights, so that the random initial weights lose their influence.
            _average(self.ema, self.model, min(optim.ema, self.step / (self.step + 10)))
        return rate, flow

    def _backward(self, batch: dict) -> tuple[Tensor, Tensor, Tensor]:
        """Add up the gradients of the batch's parts; return loss, end-point error, px, and the first part's flow."""
        size, count = len(batch["name"]) // self.config.optim.accumulate, batch["valid"].sum().float()
        # DDP averages gradients over ranks: dividing by the mean count makes it the mean over all valid pixels.
        if self.world > 1:
            dist.all_reduce(count)
            count = count / self.world
        done = []
        for first in range(0, len(batch["name"]), size):
            part = {k: v[first : first + size] for k, v in batch.items()}
            later = first + size < len(batch["name"])  # several processes add up their gradients once, at the end
            with (
                self.net.no_sync()
                if later and isinstance(self.net, DistributedDataParallel)
                else contextlib.nullcontext()
            ):
                done.append(_forward(self.net, part, self.config, count))
                done[-1][0].backward()
        losses, errors, flows = zip(*((loss.detach(), error, flow) for loss, error, flow in done), strict=True)
        return sum(losses[1:], losses[0]), sum(errors[1:], errors[0]) / count.clamp(min=1), flows[0]

    def _every(self, *whats: str) -> bool:
        """Whether one of these actions is due at this step."""
        return any(self.step % getattr(self.config.run, f"{what}_every") == 0 for what in whats)

    @property
    def _last(self) -> bool:
        return self.step == self.stop or self.done >= 1

    def _reason(self, signals: Signals, looking: bool) -> str | None:
        """Return why the training ends after this step, or None; the same on all ranks."""
        if self.world == 1 or looking:
            self.done = self.course.done(self.step, self.device, self.world)
        if self.done >= 1:
            return "finished"
        last = self.step == self.stop
        # A signal or the clock may reach the ranks at different steps; they end together only where all of them ask.
        if self.world > 1 and not (looking or last):
            return None
        minutes = self.config.run.time_limit
        over = minutes is not None and time.monotonic() - self.began > 60 * minutes
        reason = signals.reason or ("time limit" if over else None) or ("stop" if last else None)
        return agree(reason, self.device) if self.world > 1 else reason

    # ---- what is written ---------------------------------------------------------------------------------------------

    def _log(self, log: Log, rate: float, progress: TrainProgress, waiting: Waiting) -> None:
        if self._every("log") or self._last:
            log.write(
                self.step,
                "train",
                loss=self.read.loss,
                epe=self.read.epe,
                lr=rate,
                grad_norm=self.read.norm,
                samples_per_s=progress.rate,
                waited=waiting.share,
                **_rendering(self.sources),
            )

    def _validate(self, log: Log, progress: TrainProgress) -> None:
        # The batch of one process: a larger one might not fit the memory of its GPU.
        size = -(-self.config.data.batch // self.world)
        scores = validate(self.model, self.ema, self.validation, self.config.run.precision, size)
        log.write(self.step, "validation", **scores)
        # The best weights are those of the least mean share of zero flow's error, so that a set of fast motion does not
        # outweigh the others.
        shares = [scores[f"{name}/AEE"] / max(scores[f"{name}/zero"], 1e-9) for name, *_ in self.validation]
        ckpt.keep_best(self.out, self.model, self.ema, self.step, sum(shares) / len(shares))
        progress.note(self.step, scores)

    def _save(self) -> Path:
        config = json.loads(self.config.model_dump_json())
        about = {"seconds": self.course.seconds, "config": config, "content": self.content}
        return ckpt.save_checkpoint(
            self.out, self.step, self.model, self.ema, self.optimizer, about, self.config.run.keep_checkpoints
        )


def _optimizer(model: FlowModel, optim: OptimConfig, device: torch.device) -> torch.optim.Optimizer:
    """Return AdamW without weight decay on biases and norms."""
    # Biases and the factors of norms have one axis, weights have more.
    decay = [p for p in model.parameters() if p.ndim > 1]
    no_decay = [p for p in model.parameters() if p.ndim <= 1]
    return torch.optim.AdamW(
        [{"params": decay}, {"params": no_decay, "weight_decay": 0.0}],
        lr=optim.lr,
        weight_decay=optim.weight_decay,
        fused=device.type == "cuda",
    )


def _forward(net: torch.nn.Module, batch: dict, config: TrainConfig, count: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the loss (its sum over valid pixels divided by ``count``), the sum of the end-point errors of the last
    field, px, and that field, all still on the device."""
    kind = batch["new"].device.type
    with (
        compile_errors(config.run.compile),
        torch.autocast(kind, torch.bfloat16, enabled=config.run.precision == "bf16"),
    ):
        prediction = net({k: batch[k] for k in ("old", "new") if k in batch})
    loss = sequence_loss(
        prediction,
        batch["flow"],
        batch["valid"],
        loss=config.optim.loss,
        gamma=config.optim.gamma,
        match_weight=config.optim.match_weight,
        count=count,
    )
    with torch.no_grad():
        valid = batch["valid"]
        # The truth may be NaN where it is not valid, and NaN times 0 is NaN: chosen, not multiplied.
        error = (prediction.flow - torch.where(valid[:, None], batch["flow"], 0)).square().sum(1).sqrt()
        total = torch.where(valid, error, 0).sum()
    return loss, total, prediction.flow.detach()


def _rendering(sources: list[Source]) -> dict[str, float]:
    """Return statistics of the online sources for the log; empty if there are none."""
    stats = [s.stats for s in sources if is_endless(s)]
    if not stats:
        return {}
    made = sum(s.samples for s in stats)
    return {
        "rendered": made,
        "render_ms": 1000 * sum(s.cpu_s for s in stats) / max(made, 1),
        "failed_sequences": sum(s.failures for s in stats),
        "replaced_workers": sum(s.replaced for s in stats),
    }


@torch.no_grad()
def _average(ema: dict[str, Tensor], model: FlowModel, decay: float) -> None:
    for k, v in model.state_dict().items():
        # The counters of batch norm are integers, which have no average.
        ema[k].lerp_(v, 1 - decay) if v.is_floating_point() else ema[k].copy_(v)


def _picture(batch: dict, flow: Tensor) -> Picture:
    """Return the first sample of a batch as a strip: events, truth, prediction, error."""
    first = lambda k: batch[k][0].detach().float().cpu().numpy()
    return comparison(
        events_of(first("new")),
        flow[0].float().cpu().numpy().transpose(1, 2, 0),
        first("flow").transpose(1, 2, 0),
        batch["valid"][0].cpu().numpy(),
    )


def as_yaml(config: TrainConfig) -> str:
    """Return all keys with their values as YAML, the text of ``config.yaml`` in a run folder."""
    return to_yaml(json.loads(config.model_dump_json()))


# log.csv : of earlier versions.
_OURS = {"config.yaml", "log.csv", "log.jsonl", "tb", "checkpoints", "pictures", "best.safetensors", "nan_batch.json"}


@contextlib.contextmanager
def _held(out: Path, resume: bool, begun: Callable[[], bool]) -> Iterator[None]:
    """Hold the run folder, so that no other training writes into it. A new one is removed if the training ends before
    its first step. Raises OutputError: it exists, with ``resume`` and files that are no training's; another run uses
    it."""
    made = not out.exists()
    with output_errors(out):
        make_folders(out)
    with locked_folder(out):
        try:
            _refuse_others(out, resume)
            yield
        finally:
            if made and not begun():
                shutil.rmtree(out, ignore_errors=True)


def _refuse_others(out: Path, resume: bool) -> None:
    """Raise OutputError for a locked run folder that holds anything, with ``resume`` anything that is no training's."""
    others = sorted(p.name for p in out.iterdir() if p.name != LOCK.parts[0])
    if others and not resume:  # another one may have ended in between
        refuse_existing(out)
    if foreign := [name for name in others if name not in _OURS and not name.startswith(".")]:
        raise OutputError(
            "holds other files than a training's",
            where=str(out),
            value=foreign[0],
            accepted="the run folder of this training, or a new folder",
        )
