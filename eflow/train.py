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
import itertools
import json
import os
import re
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from blinkgl.config.reader import to_yaml
from blinkgl.config.recipe import derived_seed
from blinkgl.errors import AssetError, BlinkGLError, ConfigError
from blinkgl.io.atomic import atomic_file, output_errors
from blinkgl.sequence_files.sequence_dir import refuse_existing
from eflow import checkpoint as ckpt
from eflow.allocator import keep_memory
from eflow.config import OptimConfig, SourceConfig, TrainConfig
from eflow.data.dataset import FlowDataset, Mixture, StepSampler, batches, collate, is_endless
from eflow.data.sources import Source, open_source
from eflow.infer import predict
from eflow.losses import sequence_loss
from eflow.metrics import frame_metrics
from eflow.models import FlowModel, build_model
from eflow.pictures import comparison, events_of, write_picture
from eflow.precision import precision_on, use_tf32
from eflow.progress import TrainProgress, Waiting, told


class TrainingError(BlinkGLError):
    """Training cannot go on (loss not finite)."""


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
        return _train(config, Path(out), stack, resume=resume, stop_after=stop_after, quiet=quiet, clock=clock)


def _train(
    config: TrainConfig,
    out: Path,
    stack: contextlib.ExitStack,
    *,
    resume: bool,
    stop_after: int | None,
    quiet: bool,
    clock: Callable[[], float],
) -> TrainResult:
    rank, world, device = _setup(config)
    lead = rank == 0
    precision = precision_on(device, config.run.precision, quiet=not lead)
    config = config.model_copy(update={"run": config.run.model_copy(update={"precision": precision})})
    if lead:
        importlib.import_module("torch.utils.tensorboard")  # where it is missing, nothing has been written yet
    if lead and not resume:
        refuse_existing(out)

    torch.manual_seed(config.seed)
    model = build_model(config.model)
    if config.init_from and not resume:
        ckpt.load_weights(model, *_weights_of(config))
    model.to(device)
    if config.run.channels_last:
        model.to(memory_format=torch.channels_last)
    decay, no_decay = [], []
    for p in model.parameters():
        (decay if p.ndim > 1 else no_decay).append(p)
    optimizer = torch.optim.AdamW(
        [{"params": decay}, {"params": no_decay, "weight_decay": 0.0}],
        lr=config.optim.lr,
        weight_decay=config.optim.weight_decay,
        fused=device.type == "cuda",
    )
    ema = {k: v.detach().clone() for k, v in model.state_dict().items()} if config.optim.ema else None
    start, spent = _resume(out, config, model, optimizer, ema) if resume else (0, 0.0)

    if config.data.batch % world:
        raise ConfigError(
            "not a multiple of the number of processes",
            where="data.batch",
            value=config.data.batch,
            accepted=f"a multiple of {world}",
        )
    mixture, sources = _training_sets(config, start, rank, world, stack)
    dataset = FlowDataset(
        sources,
        model.representation,
        seed=config.seed,
        augment=config.data.augment,
        crop=config.data.crop,
        empty=config.data.empty,
        reads=model.reads,
    )
    _check_sizes(dataset, model, config.data.crop)
    validation = _validation(config, model) if lead else []
    steps = config.optim.steps
    stop = steps if stop_after is None else min(steps, start + stop_after)
    sampler = StepSampler(mixture, config.data.batch, start, stop, rank, world)

    if config.run.compile and hasattr(model, "update"):
        model.update.compile()
    net = (
        DistributedDataParallel(model, device_ids=[device.index] if device.type == "cuda" else None)
        if world > 1
        else model
    )
    net.train()
    if lead:
        _write_config(out, config)
    step, reason, began = start, None, time.monotonic()
    read = Readings(out)
    course = Course(config.optim, clock(), spent, clock)
    done = course.done(step, device, world)
    if done >= 1:
        sampler = StepSampler(mixture, config.data.batch, start, start, rank, world)

    def save() -> Path:
        return ckpt.save_checkpoint(
            out,
            step,
            model,
            ema,
            optimizer,
            {"seconds": course.seconds, "config": json.loads(config.model_dump_json())},
            config.run.keep_checkpoints,
        )

    with (
        _Signals() as signals,
        _Log(out, start, enabled=lead) as log,
        TrainProgress(
            steps,
            start,
            config.data.batch,
            enabled=lead and not quiet,
            where=f"{device.type}, {precision}",
            minutes=course.minutes_left(config.run.time_limit),
        ) as progress,
    ):
        waiting = Waiting(batches(dataset, sampler, config.data.workers, pin=device.type == "cuda"))
        for batch in waiting:
            rate = learning_rate(done, config.optim.lr, config.optim.warmup, config.optim.cooldown)
            for group in optimizer.param_groups:
                group["lr"] = rate
            optimizer.zero_grad(set_to_none=True)
            batch = _to_device(batch, device, config.run.channels_last)
            loss, epe, flow = _forward(net, batch, config, world)
            loss.backward()
            norm = torch.nn.utils.clip_grad_norm_(model.parameters(), config.optim.clip)
            read.add(step, batch["name"], loss, epe, norm)
            optimizer.step()
            step += 1
            if ema is not None:
                _average(ema, model, min(config.optim.ema, step / (step + 10)))

            # What is between processes, or between device and host, makes everybody wait: now and then is enough.
            looking = step == start + 1 or any(
                step % every == 0
                for every in (config.run.log_every, config.run.validate_every, config.run.checkpoint_every)
            )
            if world == 1 or looking:
                done = course.done(step, device, world)
            last = step == stop or done >= 1
            if done >= 1:
                reason = "finished"
            elif world == 1 or looking or last:
                reason = (
                    signals.reason
                    or ("time limit" if _over(began, config.run.time_limit) else None)
                    or ("stop" if last else None)
                )
                reason = _agree(reason, device) if world > 1 else reason
            progress.update(step, read.values() if looking or last or reason else ())
            if lead and (step % config.run.log_every == 0 or last):
                log.write(
                    step,
                    "train",
                    loss=read.loss,
                    epe=read.epe,
                    lr=rate,
                    grad_norm=read.norm,
                    samples_per_s=progress.rate,
                    processor_s=time.process_time(),
                    waited=waiting.share,
                    **_rendering(sources),
                )
            if lead and step % config.run.picture_every == 0:
                _picture(out / "pictures" / f"{step:09d}.png", batch, flow)
            # The clock ends a training as its last step does; a signal is in a hurry.
            ended = reason in ("finished", "time limit")
            if lead and validation and (step % config.run.validate_every == 0 or ended):
                scores = validate(model, ema, validation, config.run.precision, -(-config.data.batch // world))
                log.write(step, "validation", **scores)
                progress.note(step, scores)
            if lead and (step % config.run.checkpoint_every == 0 or reason is not None):
                path = save()
            if reason is not None:
                break
        else:
            if lead:  # nothing was left to do
                path = ckpt.newest(out) or save()
        if lead and any(is_endless(s) for s in sources):
            progress.say("online: " + told(_rendering(sources), waiting.share))
    if world > 1:
        dist.barrier()
        dist.destroy_process_group()
    return TrainResult(step, reason or "finished", path if lead else out, read.loss)


def _training_sets(
    config: TrainConfig, start: int, rank: int, world: int, stack: contextlib.ExitStack
) -> tuple[Mixture, list[Source]]:
    """The order of the samples, and the open sets; what renders is ended by ``stack``. Each rank renders for itself,
    sequences that no other has."""
    data = config.data
    sources = {k: open_source(s.path, s.format, dt=s.dt) for k, s in enumerate(data.train) if not s.online}
    sizes = [len(sources[k]) if k in sources else None for k in range(len(data.train))]
    mixture = Mixture(sizes, [s.weight for s in data.train], config.seed)
    for k, s in enumerate(data.train):
        if s.online:
            from eflow.data.online import open_online  # brings the renderer

            first = mixture.first(k, start * data.batch, rank, world)
            seed = derived_seed(config.seed, f"rank {rank}") if rank else config.seed
            sources[k] = stack.enter_context(open_online(s, seed, first=first, batch=data.batch // world))
    return mixture, [sources[k] for k in range(len(data.train))]


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


@torch.no_grad()
def validate(
    model: FlowModel,
    ema: dict[str, Tensor] | None,
    validation: list[tuple[str, FlowDataset, list[int]]],
    precision: str,
    size: int = 1,
) -> dict[str, float]:
    """AEE per validation set, with the averaged weights; ``zero`` is the AEE of zero flow on the same samples.
    size : at most so many samples at once."""
    own = {k: v.detach().clone() for k, v in model.state_dict().items()} if ema is not None else None
    if ema is not None:
        model.load_state_dict(ema)
    try:
        scores = {}
        for name, dataset, indices in validation:
            rows = []
            for batch in _alike((dataset[i] for i in indices), size):
                flows = predict(model, batch, precision=precision).flow.permute(0, 2, 3, 1).cpu().numpy()
                truths, valids = batch["flow"].permute(0, 2, 3, 1).numpy(), (batch["valid"] & batch["mask"]).numpy()
                for flow, truth, valid in zip(flows, truths, valids, strict=True):
                    metrics, zero = frame_metrics(flow, truth, valid), frame_metrics(np.zeros_like(flow), truth, valid)
                    if metrics:
                        rows.append((metrics["AEE"], zero["AEE"]))
            scores[f"{name}/AEE"], scores[f"{name}/zero"] = (
                (float(v) for v in np.mean(rows, axis=0)) if rows else (float("nan"),) * 2
            )
        return scores
    finally:
        if own is not None:
            model.load_state_dict(own)


def _alike(samples: Iterable[dict], size: int) -> Iterator[dict]:
    """Batches, in order, of up to ``size`` samples of one height and width."""
    for _, group in itertools.groupby(samples, key=lambda sample: sample["new"].shape):
        while part := list(itertools.islice(group, size)):
            yield collate(part)


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


def _weights_of(config: TrainConfig) -> tuple[dict[str, Tensor], str]:
    model = ckpt.load_model(config.init_from, expected=None)
    if model.config.name != config.model.name:
        raise AssetError(
            "checkpoint of another model",
            where=f"init_from: {config.init_from}",
            value=model.config.name,
            accepted=config.model.name,
        )
    return model.state_dict(), config.init_from


def _check_sizes(dataset: FlowDataset, model: FlowModel, crop: tuple[int, int] | None) -> None:
    """Refuses, before anything is written, what the network would refuse at the first step."""
    sources = [source for source in dataset.sources if crop is None or is_endless(source)]
    firsts = [source.first() if is_endless(source) else source[0] for source in sources]
    if crop is not None:
        sizes = {"data.crop": crop}
    else:
        sizes = {f"data.crop is not set, {s.name}": (s.height, s.width) for s in firsts}
    for where, size in sizes.items():
        if min(size) < model.least or any(side % model.divisor for side in size):
            raise ConfigError(
                "a size the network cannot train on",
                where=where,
                value=tuple(size),
                accepted=f"multiples of {model.divisor}, at least {model.least} px: set data.crop",
            )


_FREE = {"run"}
"""Parts of the configuration that may change between a run and its resumption (how it runs, not what it computes)."""
_GONE = {"optim.clock": "wall", "optim.scale_gamma": 1.0, "optim.loss.relative": 0.0, "optim.loss.log": 0.0}
"""Keys that earlier versions had, and their defaults: what they compute today."""


def _resume(out: Path, config: TrainConfig, model: FlowModel, optimizer, ema) -> tuple[int, float]:
    """Restores everything from the newest checkpoint; returns its step and the seconds that it took."""
    folder = ckpt.newest(out)
    if folder is None:
        raise AssetError("no checkpoint to resume from", where=str(out), accepted="a run folder of eflow train")
    state = ckpt.read_state(folder)
    saved, now = _leaves(state.get("config", {})), {**_GONE, **_leaves(json.loads(config.model_dump_json()))}
    saved = {**_GONE, **saved}
    for path in sorted({*saved, *now}):
        free = path.split(".")[0] in _FREE or re.fullmatch(r"data\.(train\.\d+\.)?workers", path)
        if not free and saved.get(path) != now.get(path):
            raise ConfigError(
                "differs from the run that is resumed",
                where=path,
                value=now.get(path),
                accepted=f"{saved.get(path)!r}, or a new run with init_from",
            )
    weights, _ = ckpt.read_tensors(folder / "weights.safetensors")
    averaged = ckpt.read_tensors(folder / "ema.safetensors")[0] if ema is not None else {}
    ckpt.load_weights(model, weights, str(folder / "weights.safetensors"))
    ckpt.load_optimizer(folder / "optimizer.safetensors", model, optimizer)
    for k in ema or ():
        if k not in averaged or averaged[k].shape != ema[k].shape:
            raise AssetError(f"lacks the tensor '{k}' of this model", where=str(folder / "ema.safetensors"))
        ema[k].copy_(averaged[k])
    return state["step"], state["seconds"]


def _leaves(tree, prefix: str = "") -> dict[str, object]:
    if isinstance(tree, dict) and tree:
        return {
            k: v for key, node in tree.items() for k, v in _leaves(node, f"{prefix}.{key}" if prefix else key).items()
        }
    if isinstance(tree, list) and tree and isinstance(tree[0], dict):
        return {k: v for i, node in enumerate(tree) for k, v in _leaves(node, f"{prefix}.{i}").items()}
    return {prefix: tree}


def _validation(config: TrainConfig, model: FlowModel) -> list[tuple[str, FlowDataset, list[int]]]:
    sets = []
    for s in config.data.validate_on:
        if s.online:
            from eflow.data.online import held

            source = held(s, config.data.validate_samples)
        else:
            source = open_source(s.path, s.format, dt=s.dt)
        dataset = FlowDataset([source], model.representation, empty=config.data.empty, reads=model.reads)
        count = min(config.data.validate_samples, len(dataset))
        sets.append((_title(s), dataset, [int(i) for i in np.linspace(0, len(dataset) - 1, count).round()]))
    return sets


def _title(s: SourceConfig) -> str:
    return Path(s.path or s.recipe).stem + (f"_dt{s.dt}" if s.dt != 1 else "")


def _to_device(batch: dict, device: torch.device, channels_last: bool) -> dict:
    out = {k: v.to(device, non_blocking=True) if torch.is_tensor(v) else v for k, v in batch.items()}
    if channels_last:
        out.update({k: out[k].contiguous(memory_format=torch.channels_last) for k in ("old", "new") if k in out})
    return out


@torch.no_grad()
def _average(ema: dict[str, Tensor], model: FlowModel, decay: float) -> None:
    for k, v in model.state_dict().items():
        ema[k].lerp_(v, 1 - decay) if v.is_floating_point() else ema[k].copy_(v)


class Readings:
    """Loss, end-point error and gradient norm of the steps, which stay on the device until they are asked for: to read
    a number is to wait for all that was computed before it. The latest ones that were read are ``loss``, ``epe`` and
    ``norm``."""

    def __init__(self, out: Path):
        self._out, self._pending = out, []
        self.loss = self.epe = self.norm = float("nan")

    def add(self, step: int, names: list[str], loss: Tensor, epe: Tensor, norm: Tensor) -> None:
        """After ``step`` steps, on the samples of these names."""
        self._pending.append((step, names, torch.stack([v.detach().float() for v in (loss, epe, norm)])))

    def values(self) -> list[tuple[float, float]]:
        """(loss, end-point error) of each step since the last call, in one copy.

        Raises TrainingError at the first that is not finite, having named its samples in ``nan_batch.json``. Steps
        after it were made with what it left, so whoever saves asks before."""
        read = torch.stack([v for _, _, v in self._pending]).tolist() if self._pending else []
        for (step, names, _), (loss, _, norm) in zip(self._pending, read, strict=True):
            if not np.isfinite([loss, norm]).all():
                _stop_on_nan(self._out, step, names, loss, norm)
        if read:
            self.loss, self.epe, self.norm = read[-1]
        self._pending.clear()
        return [(loss, epe) for loss, epe, _ in read]


def _stop_on_nan(out: Path, step: int, names: list[str], loss: float, norm: float) -> None:
    path = out / "nan_batch.json"
    with output_errors(path):
        path.write_text(
            json.dumps({"step": step, "loss": str(loss), "grad_norm": str(norm), "samples": names}, indent=1) + "\n"
        )
    raise TrainingError(
        f"loss or gradient is not finite at step {step}",
        where=str(path),
        value=(loss, norm),
        accepted="see the samples named there; the last checkpoint is unharmed",
    )


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


class _Signals:
    """SIGINT and SIGTERM become a flag that the loop reads between steps; a second SIGINT interrupts at once."""

    reason: str | None = None

    def __enter__(self) -> _Signals:
        self._old = {}
        with contextlib.suppress(ValueError):  # not the main thread: the caller's business
            for s in (signal.SIGINT, signal.SIGTERM):
                self._old[s] = signal.signal(s, self._note)
        return self

    def _note(self, number: int, _) -> None:
        if self.reason and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.reason = "signal"

    def __exit__(self, *_) -> None:
        for s, handler in self._old.items():
            signal.signal(s, handler)


class _Log:
    """log.jsonl, one object per line, and tensorboard. On resuming, lines past the checkpoint
    are dropped: those steps run again."""

    def __init__(self, out: Path, start: int, enabled: bool):
        self.path, self.start, self.enabled = out / "log.jsonl", start, enabled

    def __enter__(self) -> _Log:
        if self.enabled:
            with output_errors(self.path):
                lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.is_file() else []
                kept = [
                    line
                    for line in lines
                    if line.startswith("{") and line.endswith("}") and json.loads(line)["step"] <= self.start
                ]
                self.path.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
                self._file = open(self.path, "a", encoding="utf-8")
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(self.path.parent / "tb"), purge_step=self.start + 1 if self.start else None)
        return self

    def write(self, step: int, kind: str, **values: float) -> None:
        with output_errors(self.path):
            self._file.write(json.dumps({"step": step, "kind": kind, **values}) + "\n")
            self._file.flush()
        for k, v in values.items():
            self._board.add_scalar(f"{kind}/{k}", v, step)

    def __exit__(self, *_) -> None:
        if self.enabled:
            self._file.close()
            self._board.close()
