"""OnlineSequences: the same samples whoever renders and whoever takes them; two kinds; batches for torch."""

import itertools
import os
import signal
import sys
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from tiny_recipe import TINY

from blinkgl import AssetError, ConfigError, EventDataError, GLError, OnlineSequences, StreamSample, WindowSample, load
from blinkgl.online import stream
from blinkgl.online.job import MIX
from blinkgl.online.stream import Share, share_of_process

RECIPE = {**TINY, "output": {"sequences": 3}}


@pytest.fixture(scope="module")
def recipe(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("online") / "recipe.yaml"
    path.write_text(yaml.safe_dump(RECIPE))
    return path


def told(sample: WindowSample | StreamSample) -> tuple:
    """Everything of a sample, comparable."""
    parts = (sample.old, sample.new) if isinstance(sample, WindowSample) else sample.windows
    columns = [getattr(part, c).tobytes() for part in parts for c in "xytp"]
    return sample.name, sample.flow.tobytes(), sample.valid.tobytes(), *columns


def test_who_renders_makes_no_difference_nor_does_a_worker_that_dies(recipe):
    """(Of "windows", tests/eflow/test_online.py shows it.)"""
    how = {"kind": "streams", "steps": 3, "window_ms": (3, 8), "per_sequence": 2, "seed": 4}
    count = 2 * MIX + 3  # into the second block
    with OnlineSequences(recipe, workers=0, **how) as sequences:
        alone = [told(s) for s in islice(sequences, count)]
    assert len({sample[0] for sample in alone}) == count, "no sample twice"
    with OnlineSequences(recipe, workers=1, **how) as sequences:
        os.kill(sequences.stream._executor._processes[0].popen.pid, signal.SIGKILL)
        assert [told(s) for s in islice(sequences, count)] == alone
        assert sequences.stats.replaced == 1 and sequences.stats.failures == 0
        assert sequences.stats.samples >= count and 0 < sequences.stats.waited_s <= sequences.stats.open_s
        spool = sequences.stream.spool
        assert len(list(spool.glob("*.npz"))) <= 2 * sequences.block
    assert not spool.exists()
    with OnlineSequences(recipe, workers=0, first=count - 1, **how) as sequences:
        assert told(next(iter(sequences))) == alone[-1], "resumed"
        with pytest.raises(EventDataError, match="this sample was taken"):
            sequences[count - 1]
        with pytest.raises(ConfigError, match=f"n: .*expected {count - 1} to"):
            sequences[0]


def test_windows_of_a_stream_follow_each_other(recipe):
    with OnlineSequences(load(recipe), kind="streams", steps=4, window_ms=5, workers=0) as sequences:
        sample = next(iter(sequences))
    assert (sample.height, sample.width) == (32, 32)
    assert sample.flow.shape == (4, 32, 32, 2) and sample.valid.shape == (4, 32, 32)
    assert np.array_equal(np.diff(sample.t_us), [5000] * 4) and len(sample.windows) == 4
    for (t0, t1), window in zip(pairwise(sample.t_us), sample.windows, strict=True):
        assert len(window) and t0 <= window.t[0] and window.t[-1] < t1
    # Little changes within 5 ms: the flow of one window is nearly that of the next.
    lengths = [np.linalg.norm(f[v], axis=-1).mean() for f, v in zip(sample.flow, sample.valid, strict=True)]
    assert min(lengths) > 0 and max(lengths) < 1.5 * min(lengths)


def test_ranks_deal_one_stream_out_between_them(recipe):
    """Block by block, so that each renders what it takes; the samples are those of one process alone."""

    def taken(first, **how):
        with OnlineSequences(recipe, workers=0, per_sequence=1, first=first, **how) as sequences:
            return [told(s) for s in islice(sequences, 2)], sequences.stats.slots

    whole = {block: taken(MIX * block)[0] for block in (0, 1, 2)}
    assert taken(0, rank=0, world=2) == (whole[0], 2), "and no slot of the other's is rendered"
    assert taken(0, rank=1, world=2)[0] == taken(0, rank=1, world=3)[0] == whole[1]
    assert taken(MIX, rank=0, world=2)[0] == whole[2], "resumed"


def test_what_others_say_of_a_process(recipe, monkeypatch):
    assert share_of_process({}) == Share(0, 1, None)
    assert share_of_process({"RANK": "3", "WORLD_SIZE": "8", "LOCAL_RANK": "1"}) == Share(3, 8, 1)
    assert share_of_process({"WORLD_SIZE": "8"}) == Share()
    for wrong, said in (({"RANK": "one"}, r"^RANK: not a number .*'one'"), ({"RANK": "8"}, r"^RANK: .*0 to 7")):
        with pytest.raises(ConfigError, match=said):
            share_of_process({"WORLD_SIZE": "8", **wrong})
    for name, value in (("RANK", "1"), ("WORLD_SIZE", "2"), ("LOCAL_RANK", "1")):
        monkeypatch.setenv(name, value)
    with OnlineSequences(recipe, workers=0) as told, OnlineSequences(recipe, workers=0, world=1) as whole:
        assert (told.stream.job.rank, told.stream.job.world) == (1, 2)
        assert (whole.stream.job.rank, whole.stream.job.world) == (0, 1)

    # As Ray Train has it (2.x): numbers in a worker; outside of one, None or an error, by version. It is not imported.
    def context(*numbers):
        ranks = dict(zip(("get_world_rank", "get_world_size", "get_local_rank"), numbers, strict=True))
        return SimpleNamespace(**{name: (lambda value=value: value) for name, value in ranks.items()})

    train = SimpleNamespace(get_context=lambda: context(5, 6, 2))
    monkeypatch.setitem(sys.modules, "ray.train", train)
    assert share_of_process() == Share(5, 6, 2)
    train.get_context = lambda: context(None, None, None)
    assert share_of_process() == Share(1, 2, 1)
    train.get_context = lambda: (_ for _ in ()).throw(RuntimeError("not a worker"))
    assert share_of_process() == Share(1, 2, 1)


def voxels(samples: list[WindowSample]):
    """Counts and flow of a batch, and its names."""
    torch = pytest.importorskip("torch")
    counts = np.zeros((len(samples), 32, 32), np.float32)
    for k, sample in enumerate(samples):
        np.add.at(counts[k], (sample.new.y, sample.new.x), 1)
    flow = np.stack([sample.flow for sample in samples])
    return torch.from_numpy(counts), torch.from_numpy(flow), [sample.name for sample in samples]


def test_batches_are_the_same_however_many_loader_processes(recipe):
    data = pytest.importorskip("torch.utils.data")
    found = []
    for processes in (0, 2):
        with OnlineSequences(recipe, workers=1, per_sequence=2, seed=4) as sequences:
            loader = data.DataLoader(sequences.batches(3, voxels, count=5), batch_size=None, num_workers=processes)
            found.append([(c.numpy().tobytes(), f.numpy().tobytes(), names) for c, f, names in loader])
            if not processes:
                with pytest.raises(EventDataError, match="this sample was taken"):
                    next(iter(sequences))
    assert found[0] == found[1] and len(found[0]) == 5
    names = [name for _, _, batch in found[0] for name in batch]
    assert len(set(names)) == 15


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"kind": "frames"}, "kind: unknown kind (got 'frames'); expected windows, streams"),
        ({"window_ms": (20, 5)}, "window_ms: the shortest is longer than the longest"),
        ({"window_ms": (1, 2, 3)}, "window_ms: not lengths of windows"),
        ({"window_ms": float("nan")}, "window_ms: not a finite number"),
        ({"steps": 0, "kind": "streams"}, "steps: not a whole number in range"),
        ({"split": "val"}, "split: unknown choice (got 'val'); expected 'train' or 'test'"),
        ({"split": "test"}, "the recipe has no sequences of split 'test'"),
        ({"workers": -1}, "workers: not a whole number in range"),
        ({"rank": 2, "world": 2}, "rank: not a whole number in range"),
        ({"first": 1.5}, "first: not a whole number in range"),
    ],
)
def test_bad_arguments(recipe, arguments, said):
    with pytest.raises(ConfigError) as caught:
        OnlineSequences(recipe, **{"workers": 0, **arguments})
    assert said in str(caught.value)


def test_a_recipe_that_gives_nothing_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match="not readable|no such file|does not exist|not found"):
        OnlineSequences(tmp_path / "none.yaml", workers=0)
    still = {**RECIPE, "scene": {**RECIPE["scene"], "camera_motion": {"kind": "static"}}}
    (tmp_path / "still.yaml").write_text(yaml.safe_dump(still))
    with OnlineSequences(tmp_path / "still.yaml", workers=0) as sequences, pytest.raises(ConfigError) as caught:
        next(iter(sequences))
    assert "gave 0 of 8 samples" in str(caught.value) and "\n" not in str(caught.value)
    with OnlineSequences(tmp_path / "still.yaml", kind="streams", steps=200, window_ms=1, workers=0) as sequences:
        with pytest.raises(ConfigError, match="holds no 200 windows of 1 ms"):
            next(iter(sequences))


def test_a_context_that_is_lost_costs_no_sample(recipe, monkeypatch):
    """Found when a sequence is drawn, and when its flow is: the slot is made again, with another context."""
    from blinkgl.gl import GLContext

    how = {"workers": 0, "per_sequence": 2}
    with OnlineSequences(recipe, **how) as sequences:
        wanted = [told(sample) for sample in islice(sequences, 3)]
    calls, check = [], GLContext.check

    def lose(self):
        calls.append(self)
        if len(calls) in (1, 3):
            self.lost = True
            raise GLError("the GPU has lost its context")
        check(self)

    monkeypatch.setattr(GLContext, "check", lose)
    with OnlineSequences(recipe, **how) as sequences:
        assert [told(sample) for sample in islice(sequences, 3)] == wanted
    assert len(set(map(id, calls[:4]))) == 3


def test_sequences_that_fail_are_counted_and_bounded(recipe, monkeypatch):
    """Three of four: others take their place until there were too many; then one line with the numbers and the
    last."""
    from blinkgl.online import maker

    simulate, count = maker.simulate_sequence, itertools.count()

    def fails(*args, **how):
        if next(count) % 4:
            raise AssetError("no such mesh", where="pool/a.glb")
        return simulate(*args, **how)

    monkeypatch.setattr(maker, "simulate_sequence", fails)
    monkeypatch.setattr(stream, "_FREE_FAILURES", 4)
    with OnlineSequences(recipe, workers=0, per_sequence=2) as sequences, pytest.raises(ConfigError) as caught:
        list(islice(sequences, 60))
    stats = sequences.stats
    assert 4 + stats.sequences / 2 < stats.failures < stats.sequences < 60 and stats.samples > 0
    assert str(caught.value).startswith(f"recipe: {stats.failures} of {stats.sequences} sequences failed, the last: ")
    assert str(caught.value).endswith("pool/a.glb: no such mesh")


def test_workers_that_cannot_start_are_named_as_python_names_them(recipe, tmp_path, monkeypatch):
    """At once, and where they die later; with what they wrote last, since their log goes with the stream."""
    dies = "import os\nos.write(2, b'first\\nno room for the driver\\n')\nos._exit(3)\n"
    why = (
        "workers: workers cannot start: the worker ended with status 3; the last that it wrote: no room for the driver"
    )
    (tmp_path / "sitecustomize.py").write_text(dies)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(ConfigError) as caught:
        OnlineSequences(recipe, workers=1)
    assert str(caught.value) == why
    (tmp_path / "sitecustomize.py").write_text("")
    with OnlineSequences(recipe, workers=1, per_sequence=2) as sequences:
        (tmp_path / "sitecustomize.py").write_text(dies)
        os.kill(sequences.stream._executor._processes[0].popen.pid, signal.SIGKILL)
        with pytest.raises(ConfigError) as caught:
            list(islice(sequences, 1000))
    assert str(caught.value) == why


def test_a_slot_without_samples_says_why_its_first_sequence_gave_none(recipe, monkeypatch):
    """By the name that `generate` gives its folder."""
    from blinkgl.online import maker

    count = itertools.count(1)

    def fails(*args, **how):
        raise AssetError("no such mesh", where=f"pool/{next(count)}.glb")

    monkeypatch.setattr(maker, "simulate_sequence", fails)
    named = load(recipe, ["output.name=flying"])
    with OnlineSequences(named, workers=0) as sequences, pytest.raises(ConfigError) as caught:
        next(iter(sequences))
    assert "; the first that gave none: flying_000001: pool/1.glb: no such mesh" in str(caught.value)
