"""The validated YAML of ``eflow train``; every checkpoint stores its model part."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BeforeValidator, Field

from blinkgl.config.base import Config, Refused, one_of, rule


class VoxelConfig(Config):
    """Input of the correlation networks."""

    bins: int = Field(15, ge=2, le=64, description="number of time bins")
    normalise: Literal["nonzero", "all", "none"] = Field(
        "nonzero", description="cells over which mean and std are computed"
    )
    bounds: Literal["window", "events"] = Field(
        "window", description="bins span the window, or its first to last event (E-RAFT's loader)"
    )


Size = Literal["tiny", "small", "base"]
"""Size of a network: ``base`` as published, ``tiny`` about a million parameters, which a CPU trains in minutes."""


class _Refined(Config):
    """Options that E-RAFT and E-FlowFormer share."""

    input: VoxelConfig = Field(VoxelConfig(), description="the voxel grid")
    trunk: tuple[int, int, int] | None = Field(
        None, description="channels of the CNNs at 1/2, 1/4 and 1/8; null: by size"
    )
    features: int | None = Field(None, ge=16, le=1024, multiple_of=16, description="correlated channels; null: by size")
    hidden: int | None = Field(
        None, ge=16, le=1024, multiple_of=4, description="channels of the GRU's state; null: by size"
    )
    levels: int | None = Field(
        None,
        ge=1,
        le=4,
        description="levels of the correlation pyramid; the smallest input is 8 * 2^levels px; null: by size",
    )
    radius: int | None = Field(None, ge=1, le=8, description="radius of a correlation lookup, cells; null: by size")
    iterations: int = Field(12, ge=1, le=64, description="GRU iterations in evaluation")
    train_iterations: int = Field(12, ge=1, le=64, description="GRU iterations in training with gradients")
    burn_in: int | None = Field(
        None,
        ge=0,
        le=64,
        description="largest number of preceding iterations without gradients: random in half of the steps, none in "
        "the others; null: iterations - train_iterations",
    )
    damping: float = Field(
        0.5,
        ge=0,
        le=1,
        description="in evaluation, the step of the k-th iteration beyond train_iterations and burn_in is multiplied "
        "by damping^k",
    )
    context_norm: Literal["batch", "instance"] = Field(
        "batch", description="norm of the context CNN; instance for batches of one or two"
    )
    correlation: Literal["auto", "dense", "on_demand"] = Field("auto", description="auto: dense below 8192 tokens")
    checkpoint_iterations: bool = Field(
        False, description="recompute iterations in the backward pass: less memory, ~30 % slower"
    )
    border: Literal["replicate", "zero"] = Field(
        "replicate", description="flow outside the image in the convex upsampling; zero: as E-RAFT's code"
    )
    padding: Literal["end", "start"] = Field(
        "end",
        description="end: right and bottom, to multiples of 8; start: left and top, to multiples of 32, as E-RAFT's "
        "code",
    )

    @rule("trunk")
    def _widths(trunk: tuple[int, ...] | None):
        if trunk is not None and not all(8 <= w <= 1024 for w in trunk):
            raise Refused("not widths", where="trunk", value=list(trunk), accepted="three numbers from 8 to 1024")


class EraftConfig(_Refined):
    """E-RAFT (Gehrig et al., 3DV 2021)."""

    name: Literal["eraft"] = "eraft"
    size: Size = Field("base", description="number of parameters (docs/eflow.md); base: as published")


class EFlowFormerConfig(_Refined):
    """E-FlowFormer (BlinkFlow, IROS 2023)."""

    name: Literal["eflowformer"] = "eflowformer"
    size: Size = Field(
        "base",
        description="base: 4 layers, as published; small: 2; tiny: 1; otherwise widths of E-RAFT's sizes",
    )
    attention: Literal["separable", "twins"] = Field(
        "separable", description="twins: keys reduced by a dense convolution, and an MLP after each attention"
    )
    quick: bool = Field(
        False,
        description="for trainings of minutes (docs/eflow.md); init, match_prior and context_norm are not used, "
        "layers is 0 by default",
    )
    layers: int | None = Field(None, ge=0, le=32, description="enhancement layers; null: by size")
    init: Literal["match", "zero"] = Field(
        "match", description="initial flow of the GRU: the matching layer's flow, or zero as E-RAFT"
    )
    match_prior: float | None = Field(
        0.5,
        gt=0,
        le=1000,
        description="matching layer: initial standard deviation, cells of 8 px, of a learned prior for short flow; "
        "null: none",
    )

    @rule("quick", "trunk", "input.normalise")
    def _quick(quick: bool, trunk: tuple[int, int, int] | None, normalise: str):
        if quick and trunk is not None and trunk[2] % 2:
            raise Refused("not widths", where="trunk", value=list(trunk), accepted="an even last width with quick")
        if quick and normalise == "all":  # quick weighs cells by their events, and without events a cell is 0 no more
            raise Refused("not with quick", where="input.normalise", value=normalise, accepted="nonzero or none")


class EvFlowNetConfig(Config):
    """EV-FlowNet (Zhu et al., RSS 2018), supervised."""

    name: Literal["ev_flownet"] = "ev_flownet"
    size: Size = Field("base", description="base: 64 channels, as published; small: 32; tiny: 16")
    input: Literal["counts", "voxel"] = Field(
        "counts", description="4 channels of counts and latest times, or a voxel grid"
    )
    bins: int = Field(15, ge=2, le=64, description="time bins of the voxel input")
    width: int | None = Field(
        None, ge=4, le=512, multiple_of=2, description="channels of the first encoder; null: by size"
    )
    consensus: bool = Field(
        False,
        description="adds an affine field fitted to the coarsest scale: global motion for areas without events",
    )


class SpikeFlowNetConfig(Config):
    """Spike-FlowNet (Lee et al., ECCV 2020), supervised."""

    name: Literal["spike_flownet"] = "spike_flownet"
    size: Size = Field("base", description="base: 64 channels, as published; small: 32; tiny: 16")
    width: int | None = Field(
        None, ge=4, le=512, multiple_of=4, description="channels of the first encoder; null: by size"
    )
    steps: int = Field(5, ge=1, le=50, description="spike time steps per group")
    threshold: float = Field(0.75, gt=0, description="firing threshold of the integrate-and-fire neurons")


class SteFlowNetConfig(Config):
    """STE-FlowNet (Ding et al., AAAI 2022), supervised."""

    name: Literal["ste_flownet"] = "ste_flownet"
    size: Size = Field(
        "base",
        description="base: 64 channels, as published; small: 32; tiny: 8, and a radius of 2 cells instead of 4",
    )
    width: int | None = Field(
        None, ge=4, le=512, multiple_of=4, description="channels of the first encoder; null: by size"
    )
    radius: int | None = Field(None, ge=1, le=8, description="radius of the local correlation, cells; null: by size")
    slices: int = Field(5, ge=2, le=20, description="slices of the window, of equal duration")
    sweeps: int = Field(3, ge=1, le=10, description="passes over the slices")


ModelConfig = one_of("name", EraftConfig, EFlowFormerConfig, EvFlowNetConfig, SpikeFlowNetConfig, SteFlowNetConfig)
NetworkConfig: TypeAlias = EraftConfig | EFlowFormerConfig | EvFlowNetConfig | SpikeFlowNetConfig | SteFlowNetConfig
"""The configuration of a network, one of those that a field of ``ModelConfig`` takes."""
Probability = Annotated[float, Field(ge=0, le=1)]


class AugmentConfig(Config):
    """Probabilities and strengths."""

    horizontal_flip: Probability = Field(0.5, description="probability of flipping horizontally")
    vertical_flip: Probability = Field(0.1, description="probability of flipping vertically")
    transpose: Probability = Field(0.0, description="probability of transposing; needs a square data.crop")
    polarity: Probability = Field(0.5, description="probability of swapping all polarities")
    time_reversal: Probability = Field(
        0.0, description="probability of reversing time, with the backward flow as target; needs backward labels"
    )
    drop_probability: Probability = Field(0.3, description="probability of dropping events")
    drop: float = Field(0.3, ge=0, lt=1, description="largest fraction of dropped events")
    hot_probability: Probability = Field(0.2, description="probability of adding hot pixels")
    hot_pixels: int = Field(20, ge=1, le=100_000, description="largest number of hot pixels")
    hot_rate: float = Field(500.0, ge=0, le=1e6, description="largest rate of a hot pixel, events/s")
    noise_probability: Probability = Field(0.3, description="probability of adding background noise")
    noise_rate: float = Field(1.0, ge=0, le=1e4, description="largest rate of background noise, events/s per pixel")
    scale_probability: Probability = Field(
        0.3, description="probability of scaling; needs data.crop (sparse labels move pixel by pixel)"
    )
    scale: tuple[float, float] = Field((-0.2, 0.5), description="log2 of the scale factor, [low, high]")

    @rule("scale")
    def _ordered(scale: tuple[float, float]):
        if not -3 <= scale[0] <= scale[1] <= 3:
            raise Refused("not a range", where="scale", value=list(scale), accepted="[low, high] within [-3, 3]")


_OF_FOLDERS = ("format", "dt")
_OF_RECIPES = ("set", "workers", "samples", "uses", "window_ms", "min_events", "max_flow", "min_density")
"""Keys of a source that is a folder, and of one that is rendered."""


class SourceConfig(Config):
    """One data set: a folder, a recipe that is rendered during training, or a share of the training folders."""

    path: str | None = Field(None, description="folder; relative to the YAML file")
    format: Literal["auto", "blinkgl", "dsec", "mvsec", "blinkflow", "windows"] = Field(
        "auto", description="layout of the set; auto: detected from its files"
    )
    dt: Literal[1, 4] = Field(1, description="MVSEC: number of images between the ends of the flow")
    weight: float = Field(1.0, gt=0, le=1e6, description="relative weight of this set in the mixture")
    share: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="for validation: this share of the training folders' sequences, chosen by name, which are then "
        "not trained on",
    )
    recipe: str | None = Field(
        None, description="YAML file of `blinkgl generate`, instead of a folder; relative to the YAML file"
    )
    online: bool = Field(
        False, description="render the recipe's sequences during training; no sample is repeated (but see uses)"
    )
    set: tuple[str, ...] = Field((), description="overrides of the recipe, as `a.b=c`")
    workers: int = Field(1, ge=0, le=256, description="rendering processes; 0: render in the training process")
    samples: int = Field(8, ge=1, le=1000, description="windows per sequence, each with its own flow")
    uses: int = Field(
        1,
        ge=1,
        le=1000,
        description="times that each rendered sample is used, each time augmented differently",
    )
    window_ms: tuple[float, float] | None = Field(
        None,
        description="window lengths, [shortest, longest], log-uniform; null: the recipe's label interval",
    )
    min_events: int = Field(1, ge=1, le=10**9, description="fewest events in each of a sample's two windows")
    max_flow: float = Field(400.0, gt=0, le=1e4, description="longest median flow of a sample, px")
    min_density: float = Field(
        0.0,
        ge=0,
        le=1e3,
        description="fewest events per pixel and per px of mean flow (at least 0.3 px); below 0.01 flow can hardly be "
        "estimated",
    )

    @rule("path", "recipe", "share", "online")
    def _folder_or_recipe(path, recipe, share, online):
        if [path, recipe, share].count(None) != 2:
            raise Refused("give a folder (path) or a recipe, or for validation a share, one of these")
        if (recipe is not None) != online:
            raise Refused(
                "a recipe is rendered while it is trained on: online: true says so"
                if recipe is not None
                else "a folder is not rendered",
                where="online",
                value=online,
                accepted="recipe: FILE with online: true, or the folder that blinkgl generate made of it as path",
            )

    @rule("path", "recipe", *_OF_FOLDERS, *_OF_RECIPES)
    def _of_one_kind(path, recipe, *values):
        for key, value in zip(_OF_FOLDERS + _OF_RECIPES, values, strict=True):
            has, kind = (path, "a folder (path)") if key in _OF_FOLDERS else (recipe, "a recipe")
            if has is None and value != SourceConfig.model_fields[key].default:
                raise Refused(f"only for {kind}", where=key, value=value)

    @rule("window_ms")
    def _ordered(window_ms: tuple[float, float] | None):
        if window_ms is not None and not 0.01 <= window_ms[0] <= window_ms[1] <= 1e6:
            raise Refused("not a range", where="window_ms", value=list(window_ms), accepted="0.01 <= low <= high, ms")


def _as_list(sets: object) -> object:
    return [sets] if isinstance(sets, dict) else sets


class DataConfig(Config):
    """Training and validation data."""

    train: tuple[SourceConfig, ...] = Field(min_length=1, description="training sets, mixed by weight")
    validate_on: Annotated[tuple[SourceConfig, ...], BeforeValidator(_as_list)] = Field(
        (), description="validation sets; a single one needs no list: {share: 0.1}"
    )
    validate_samples: int = Field(64, ge=1, description="samples of each validation set, evenly spaced")
    crop: tuple[int, int] | None = Field(None, description="[height, width] of the random crop, px; null: whole frames")
    leave_out: tuple[int, int] = Field(
        (0, 0), description="[rows at the bottom, columns at the left] that are not trained on, px"
    )
    batch: int = Field(6, ge=1, le=4096, description="samples per step, over all GPUs")
    workers: int = Field(0, ge=0, le=256, description="loader processes per GPU; 0: load in the training process")
    empty: Literal["error", "skip"] = Field(
        "error", description="a sample with an empty window is an error, or left out"
    )
    augment: AugmentConfig | None = Field(
        AugmentConfig(), description="random changes of the training samples; null: none"
    )

    @rule("train.*.share", "train.*.path", "validate_on.*.share")
    def _shared(shares: tuple[float | None, ...], folders, held):
        for k, share in enumerate(shares):
            if share is not None:
                raise Refused("a share is for validation", where=f"train.{k}.share", value=share)
        held = [share for share in held if share is not None]
        if len(held) > 1 or (held and not any(folders)):
            raise Refused(
                "a share of what", where="validate_on", value=held, accepted="one share, with a folder in data.train"
            )

    @rule("train.*.workers", "train.*.online", "workers")
    def _who_renders(rendering, online, loaders):
        for k, (workers, live) in enumerate(zip(rendering, online, strict=True)):
            if live and workers == 0 and loaders > 0:
                raise Refused(
                    "loader processes do not render", where=f"train.{k}.workers", value=0, accepted="1 or more"
                )

    @rule("crop", "augment.scale_probability")
    def _one_size(crop, scaling):
        if crop is None and scaling:
            raise Refused("scaled samples differ in size: set crop, or augment.scale_probability to 0")

    @rule("leave_out", "crop")
    def _left_out(leave_out: tuple[int, int], crop):
        if not all(0 <= side <= 10_000 for side in leave_out):
            raise Refused("not numbers of px", where="leave_out", value=list(leave_out), accepted="0 to 10000")
        if any(leave_out) and crop is None:
            raise Refused("crops leave it out", where="leave_out", value=list(leave_out), accepted="with data.crop")

    @rule("crop", "augment.transpose")
    def _square(crop: tuple[int, int] | None, transpose: float):
        if transpose and (crop is None or crop[0] != crop[1]):
            raise Refused("transposed samples differ in size: set a square crop, or augment.transpose to 0")


class LossConfig(Config):
    """The loss: a weighted sum of terms of each pixel's error."""

    l1: float = Field(1.0, ge=0, le=1e6, description="weight of the absolute error of the components, px")
    epe: float = Field(0.0, ge=0, le=1e6, description="weight of the end-point error, px")
    length: float = Field(0.0, ge=0, le=1e6, description="weight of |log(predicted / true length)| (with knee)")
    knee: float = Field(
        1.0,
        gt=0,
        le=1e3,
        description="added to both lengths in the logarithm, px",
    )

    @rule("l1", "epe")
    def _something(l1, epe):
        if not l1 + epe:  # the length alone has no direction
            raise Refused("no term has a weight", where="l1", value=0, accepted="l1 or epe above 0")


class OptimConfig(Config):
    """AdamW and its schedule: the learning rate rises, stays, and falls, by steps or by time."""

    steps: int = Field(200_000, ge=1, le=10**9, description="number of weight updates")
    accumulate: int = Field(
        1,
        ge=1,
        le=4096,
        description="parts in which a batch is processed, to save memory; batch norm takes its statistics from each "
        "part",
    )
    freeze_norm: bool = Field(
        False,
        description="for fine-tuning: batch norm keeps the statistics of init_from",
    )
    minutes: float | None = Field(
        None,
        gt=0,
        le=1e6,
        description="minutes after which training ends, resumed parts included, if before the last step; such a run "
        "is not exactly repeatable. null: only steps",
    )
    lr: float = Field(2e-4, gt=0, le=1, description="peak learning rate")
    warmup: float = Field(0.05, ge=0, lt=1, description="fraction of the training in which the rate rises")
    cooldown: float = Field(
        0.4, ge=0, le=1, description="fraction of the training, at its end, in which the rate falls"
    )
    weight_decay: float = Field(1e-4, ge=0, le=1, description="decoupled weight decay of AdamW")
    clip: float = Field(1.0, gt=0, description="largest gradient norm")
    loss: LossConfig = Field(LossConfig(), description="terms of the loss")
    gamma: float = Field(0.8, gt=0, le=1, description="decay of the loss towards early iterations")
    match_weight: float = Field(0.5, ge=0, description="weight of the matching layer's loss; the last iteration's is 1")
    ema: float = Field(0.999, ge=0, lt=1, description="decay of the weight average; 0: none")

    @rule("warmup", "cooldown")
    def _fit(warmup, cooldown):
        if warmup + cooldown > 1 + 1e-9:
            raise Refused(
                "more than the whole training", where="cooldown", value=cooldown, accepted="at most 1 - warmup"
            )


class RunConfig(Config):
    """How a training runs and what it writes."""

    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: a GPU if there is one")
    precision: Literal["fp32", "bf16"] = Field(
        "fp32", description="bf16: autocast with fp32 islands; fp32 if the device has no bf16 instructions"
    )
    tf32: bool = Field(True, description="use TF32 units for fp32 products, except in fp32 islands")
    channels_last: bool = Field(False, description="memory layout with faster convolutions on some GPUs")
    compile: bool = Field(False, description="torch.compile of the update step, or of a whole network without one")
    threads: int | None = Field(None, ge=1, description="CPU threads; null: torch's default")
    log_every: int = Field(20, ge=1, description="steps between log lines")
    validate_every: int = Field(2000, ge=1, description="steps between validations")
    checkpoint_every: int = Field(2000, ge=1, description="steps between checkpoints")
    keep_checkpoints: int = Field(3, ge=1, description="number of kept checkpoints; older ones are deleted")
    picture_every: int = Field(2000, ge=1, description="steps between sample pictures")
    time_limit: float | None = Field(
        None,
        gt=0,
        description="minutes after which this call stops with a checkpoint, to be resumed",
    )


class TrainConfig(Config):
    """One training run."""

    seed: int = Field(0, ge=0, lt=2**63, description="of weights, order and augmentation; 0 is a seed")
    model: ModelConfig = Field(description="the network")
    data: DataConfig = Field(description="training and validation data")
    optim: OptimConfig = Field(OptimConfig(), description="optimiser, its schedule and the loss")
    run: RunConfig = Field(RunConfig(), description="how it runs and what it writes")
    init_from: str | None = Field(
        None,
        description="checkpoint, or name of a shipped network, with the initial weights (and the network, without "
        "`model`)",
    )
