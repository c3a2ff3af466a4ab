"""The training loop. Reads top to bottom; runs on the CPU, one GPU, or several:

    eflow train configs/eflow/smoke.yaml --out out/smoke
    torchrun --nproc-per-node 8 -m eflow.cli train configs/eflow/eflowformer.yaml --out out/base

A run folder holds config.yaml, log.jsonl, tb/ (tensorboard), checkpoints/<step>/ and pictures/. SIGINT and SIGTERM end
the current step, write a checkpoint and exit 0; ``--resume`` goes on from the newest one and is, on the CPU, bit for
bit what the uninterrupted run would have been: data order and augmentation are functions of (seed, step), the rate of
the step alone. (With ``optim.minutes`` the rate goes by the clock, which checkpoints keep, and a run that is as
long on another day is another run.)
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from blinkgl.config.reader import to_yaml
from blinkgl.errors import ConfigError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.sequence_files.sequence_dir import refuse_existing
from eflow import checkpoint as ckpt
from eflow.allocator import keep_memory
from eflow.checkpoint import resume_run, weights_of
from eflow.config import OptimConfig, TrainConfig
from eflow.data.dataset import FlowDataset, StepSampler, batches, is_endless
from eflow.data.sources import Source
from eflow.metrics import sequence_loss
from eflow.models import FlowModel, build_model
from eflow.pictures import comparison, events_of, write_picture
from eflow.precision import precision_on, use_tf32
from eflow.progress import Log, Readings, Signals, TrainProgress, Waiting, told
from eflow.training_data import check_sizes, training_sets, validate, validation_sets


@dataclass
class TrainResult:
    """How a run ended: ``reason`` is "finished", "signal", "time limit" or "stop"."""

    step: int
    reason: str
    checkpoint: Path
    loss: float


def learning_rate(done: float, peak: float, warmup: float, cooldown: float) -> float:
    """The rate when a share ``done`` (0 … 1) of the training is over: linear from peak / 25 up to ``peak`` over its
    first ``warmup``, then ``peak``, and linear down to peak / 25e4 over its last ``cooldown``."""
    start, end = peak / 25, peak / 25e4
    if done < warmup:
        return start + (peak - start) * done / warmup
    if done < 1 - cooldown:
        return peak
    return peak + (end - peak) * min((done - (1 - cooldown)) / max(cooldown, 1e-9), 1)


@dataclass
class Course:
    """How far a training is, by steps and, where ``optim.minutes`` says so, by the clock of all its parts together.

    before : seconds of the parts before this one."""

    optim: OptimConfig
    began: float
    before: float
    clock: Callable[[], float]

    @property
    def seconds(self) -> float:
        return self.before + self.clock() - self.began

    def done(self, step: int, device: torch.device, world: int) -> float:
        """Share of the training that is over after ``step`` steps; the same on all ranks."""
        share = step / self.optim.steps
        if self.optim.minutes is None:
            return share
        if world == 1:
            return max(share, self.seconds / (60 * self.optim.minutes))
        seconds = torch.tensor(self.seconds, dtype=torch.float64, device=device)
        dist.broadcast(seconds, 0)
        return max(share, float(seconds) / (60 * self.optim.minutes))

    def minutes_left(self, time_limit: float | None) -> float | None:
        """Until the end or this call's ``time_limit``; None where there is no clock."""
        ends = [] if time_limit is None else [time_limit]
        ends += [] if self.optim.minutes is None else [self.optim.minutes - self.before / 60]
        return min(ends, default=None)


def train(
    config: TrainConfig,
    out: str | os.PathLike,
    *,
    resume: bool = False,
    stop_after: int | None = None,
    quiet: bool = False,
    clock: Callable[[], float] = time.monotonic,
) -> TrainResult:
    """Trains to the end of ``config.optim.steps`` or ``minutes``. ``stop_after``: leave after this many steps of this
    call, as a signal would. clock : seconds, of ``optim.minutes``.

    Raises ConfigError, AssetError, EventDataError (data), OutputError (run folder exists), TrainingError (loss not
    finite: the batch's sample names are in ``nan_batch.json``)."""
    with contextlib.ExitStack() as stack:  # of what renders while it is trained on
        made = Training(config, Path(out), stack, resume=resume, stop_after=stop_after, clock=clock, quiet=quiet)
        return made.run()


class Training:
    """One call's part of a run: made ready when it is made, and gone through once by :meth:`run`.

    stack : ends what renders while it is trained on."""

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
        self.rank, self.world, self.device = _setup(config)
        self.lead, self.out, self.quiet = self.rank == 0, out, quiet
        precision = precision_on(self.device, config.run.precision, quiet=not self.lead)
        self.config = config.model_copy(update={"run": config.run.model_copy(update={"precision": precision})})
        if self.lead:
            importlib.import_module("torch.utils.tensorboard")  # where it is missing, nothing has been written yet
        if self.lead and not resume:
            refuse_existing(out)
        self.model = self._network(from_weights=not resume)
        self.optimizer = _optimizer(self.model, config.optim, self.device)
        self.ema = {k: v.detach().clone() for k, v in self.model.state_dict().items()} if config.optim.ema else None
        start, spent = resume_run(out, self.config, self.model, self.optimizer, self.ema) if resume else (0, 0.0)
        self.start = self.step = start
        self.stop = config.optim.steps if stop_after is None else min(config.optim.steps, start + stop_after)
        if config.data.batch % self.world:
            raise ConfigError(
                "not a multiple of the number of processes",
                where="data.batch",
                value=config.data.batch,
                accepted=f"a multiple of {self.world}",
            )
        self.mixture, self.sources = training_sets(config, start, self.rank, self.world, stack)
        self.dataset = FlowDataset(
            self.sources,
            self.model.representation,
            seed=config.seed,
            augment=config.data.augment,
            crop=config.data.crop,
            empty=config.data.empty,
            reads=self.model.reads,
        )
        check_sizes(self.dataset, self.model, config.data.crop)
        self.validation = validation_sets(config, self.model) if self.lead else []
        if config.run.compile and hasattr(self.model, "update"):
            self.model.update.compile()
        self.net = self.model
        if self.world > 1:
            devices = [self.device.index] if self.device.type == "cuda" else None
            self.net = DistributedDataParallel(self.model, device_ids=devices)
        self.net.train()
        if self.lead:
            _write_config(out, self.config)
        self.began, self.read = time.monotonic(), Readings(out)
        self.course = Course(config.optim, clock(), spent, clock)
        self.done = self.course.done(start, self.device, self.world)
        self.path = out
        """The newest checkpoint; the run's folder on ranks that write none."""

    def _network(self, from_weights: bool) -> FlowModel:
        torch.manual_seed(self.config.seed)
        model = build_model(self.config.model)
        if self.config.init_from and from_weights:
            ckpt.load_weights(model, *weights_of(self.config))
        model.to(self.device)
        if self.config.run.channels_last:
            model.to(memory_format=torch.channels_last)
        return model

    def run(self) -> TrainResult:
        """Goes through the steps that are left, and ends the process group."""
        config, device = self.config, self.device
        stop = self.start if self.done >= 1 else self.stop
        sampler = StepSampler(self.mixture, config.data.batch, self.start, stop, self.rank, self.world)
        reason = None
        with (
            Signals() as signals,
            Log(self.out, self.start, enabled=self.lead) as log,
            TrainProgress(
                config.optim.steps,
                self.start,
                config.data.batch,
                enabled=self.lead and not self.quiet,
                where=f"{device.type}, {config.run.precision}",
                minutes=self.course.minutes_left(config.run.time_limit),
            ) as progress,
        ):
            waiting = Waiting(batches(self.dataset, sampler, config.data.workers, pin=device.type == "cuda"))
            for batch in waiting:
                batch = _to_device(batch, device, config.run.channels_last)
                rate, flow = self._take(batch)
                # What is between processes, or between device and host, makes everybody wait: now and then is enough.
                looking = self.step == self.start + 1 or self._every("log", "validate", "checkpoint")
                reason = self._reason(signals, looking)
                last = self.step == self.stop or self.done >= 1
                progress.update(self.step, self.read.values() if looking or last or reason else ())
                if self.lead:
                    self._tell(batch, flow, rate, reason, log, progress, waiting)
                if reason is not None:
                    break
            else:
                if self.lead:  # nothing was left to do
                    self.path = ckpt.newest(self.out) or self._save()
            if self.lead and any(is_endless(s) for s in self.sources):
                progress.say("online: " + told(_rendering(self.sources), waiting.share))
        if self.world > 1:
            dist.barrier()
            dist.destroy_process_group()
        return TrainResult(self.step, reason or "finished", self.path, self.read.loss)

    def _take(self, batch: dict) -> tuple[float, Tensor]:
        """One step; the rate that it was taken at and the last field."""
        optim = self.config.optim
        rate = learning_rate(self.done, optim.lr, optim.warmup, optim.cooldown)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.zero_grad(set_to_none=True)
        loss, epe, flow = _forward(self.net, batch, self.config, self.world)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), optim.clip)
        self.read.add(self.step, batch["name"], loss, epe, norm)
        self.optimizer.step()
        self.step += 1
        if self.ema is not None:
            _average(self.ema, self.model, min(optim.ema, self.step / (self.step + 10)))
        return rate, flow

    def _every(self, *whats: str) -> bool:
        """Whether this step is one of those at which one of these things is done."""
        return any(self.step % getattr(self.config.run, f"{what}_every") == 0 for what in whats)

    def _reason(self, signals: Signals, looking: bool) -> str | None:
        """Why the training ends after this step; None: it goes on. The same on all ranks."""
        if self.world == 1 or looking:
            self.done = self.course.done(self.step, self.device, self.world)
        if self.done >= 1:
            return "finished"
        last = self.step == self.stop
        if self.world > 1 and not (looking or last):
            return None
        limit = "time limit" if _over(self.began, self.config.run.time_limit) else None
        reason = signals.reason or limit or ("stop" if last else None)
        return _agree(reason, self.device) if self.world > 1 else reason

    def _tell(
        self,
        batch: dict,
        flow: Tensor,
        rate: float,
        reason: str | None,
        log: Log,
        progress: TrainProgress,
        waiting: Waiting,
    ) -> None:
        """Log, picture, validation and checkpoint, where this step has them."""
        last = self.step == self.stop or self.done >= 1
        if self._every("log") or last:
            log.write(
                self.step,
                "train",
                loss=self.read.loss,
                epe=self.read.epe,
                lr=rate,
                grad_norm=self.read.norm,
                samples_per_s=progress.rate,
                processor_s=time.process_time(),
                waited=waiting.share,
                **_rendering(self.sources),
            )
        if self._every("picture"):
            _picture(self.out / "pictures" / f"{self.step:09d}.png", batch, flow)
        # The clock ends a training as its last step does; a signal is in a hurry.
        ended = reason in ("finished", "time limit")
        if self.validation and (self._every("validate") or ended):
            size = -(-self.config.data.batch // self.world)
            scores = validate(self.model, self.ema, self.validation, self.config.run.precision, size)
            log.write(self.step, "validation", **scores)
            progress.note(self.step, scores)
        if self._every("checkpoint") or reason is not None:
            self.path = self._save()

    def _save(self) -> Path:
        about = {"seconds": self.course.seconds, "config": json.loads(self.config.model_dump_json())}
        return ckpt.save_checkpoint(
            self.out, self.step, self.model, self.ema, self.optimizer, about, self.config.run.keep_checkpoints
        )


def _optimizer(model: FlowModel, optim: OptimConfig, device: torch.device) -> torch.optim.Optimizer:
    """AdamW, whose weight decay leaves biases and norms alone."""
    decay = [p for p in model.parameters() if p.ndim > 1]
    no_decay = [p for p in model.parameters() if p.ndim <= 1]
    return torch.optim.AdamW(
        [{"params": decay}, {"params": no_decay, "weight_decay": 0.0}],
        lr=optim.lr,
        weight_decay=optim.weight_decay,
        fused=device.type == "cuda",
    )


def _forward(net, batch: dict, config: TrainConfig, world: int) -> tuple[Tensor, Tensor, Tensor]:
    """loss, end-point error of the last field, and that field; nothing is read back from the device."""
    kind = batch["new"].device.type
    with (
        _compile_errors(config.run.compile),
        torch.autocast(kind, torch.bfloat16, enabled=config.run.precision == "bf16"),
    ):
        prediction = net({k: batch[k] for k in ("old", "new") if k in batch})
    count = None
    # DDP averages gradients over ranks: dividing by the mean count makes it the mean over all valid pixels.
    if world > 1:
        count = batch["valid"].sum().float()
        dist.all_reduce(count)
        count = count / world
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
        error = (prediction.flow - torch.where(valid[:, None], batch["flow"], 0)).norm(dim=1)
        epe = torch.where(valid, error, 0).sum() / valid.sum().clamp(min=1)
    return loss, epe, prediction.flow.detach()


def _rendering(sources: list[Source]) -> dict[str, float]:
    """What the online sources say of themselves, for the log; nothing of folders."""
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


@contextlib.contextmanager
def _compile_errors(enabled: bool):
    """What torch.compile needs and does not find (a C++ compiler, Triton) is the machine's lack, not a bug of ours."""
    try:
        yield
    except Exception as error:
        if enabled and type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise ConfigError(
                f"torch.compile does not work here: {reason}", where="run.compile", value=True, accepted="false"
            ) from error
        raise


def _setup(config: TrainConfig) -> tuple[int, int, torch.device]:
    """(rank, world, device); joins torchrun's process group where there is one."""
    rank, world, local = (int(os.environ.get(k, d)) for k, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0)))
    kind = config.run.device
    if kind == "auto":
        kind = "cuda" if torch.cuda.is_available() else "cpu"
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError("no CUDA device on this machine", where="run.device", value="cuda", accepted="cpu or auto")
    device = torch.device("cuda", local) if kind == "cuda" else torch.device("cpu")
    if kind == "cuda":
        torch.cuda.set_device(device)
        use_tf32(device, config.run.tf32)
    if kind == "cpu":
        keep_memory()
    if config.run.threads:
        torch.set_num_threads(config.run.threads)
    if world > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if kind == "cuda" else "gloo")
    return rank, world, device


def _to_device(batch: dict, device: torch.device, channels_last: bool) -> dict:
    out = {k: v.to(device, non_blocking=True) if torch.is_tensor(v) else v for k, v in batch.items()}
    if channels_last:
        out.update({k: out[k].contiguous(memory_format=torch.channels_last) for k in ("old", "new") if k in out})
    return out


@torch.no_grad()
def _average(ema: dict[str, Tensor], model: FlowModel, decay: float) -> None:
    for k, v in model.state_dict().items():
        ema[k].lerp_(v, 1 - decay) if v.is_floating_point() else ema[k].copy_(v)


def _picture(path: Path, batch: dict, flow: Tensor) -> None:
    first = lambda k: batch[k][0].detach().float().cpu().numpy()
    write_picture(
        path,
        comparison(
            events_of(first("new")),
            flow[0].float().cpu().numpy().transpose(1, 2, 0),
            first("flow").transpose(1, 2, 0),
            batch["valid"][0].cpu().numpy(),
        ),
    )


def _over(began: float, minutes: float | None) -> bool:
    return minutes is not None and time.monotonic() - began > 60 * minutes


def _agree(reason: str | None, device: torch.device) -> str | None:
    """All ranks stop at the same step: the first reason any of them has; None goes on."""
    codes = [None, "signal", "time limit", "stop"]
    code = torch.tensor(codes.index(reason), device=device)
    dist.all_reduce(code, op=dist.ReduceOp.MAX)
    return codes[int(code)]


def as_yaml(config: TrainConfig) -> str:
    """All keys with their values, as a run folder's ``config.yaml`` has them."""
    return to_yaml(json.loads(config.model_dump_json()))


def _write_config(out: Path, config: TrainConfig) -> None:
    with atomic_file(out / "config.yaml") as path, output_errors(path):
        Path(path).write_text(as_yaml(config), encoding="utf-8")
