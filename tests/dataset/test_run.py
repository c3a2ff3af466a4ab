"""Many workers, any interruption, the same bytes: faults are injected into real runs, and what is left is compared."""

import io
import itertools
import json
import os
import shutil
import signal
import subprocess
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import pytest
import trimesh
import yaml

from blinkgl.cli import run
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.dataset import run as run_module
from blinkgl.dataset.executor import Inline, Local
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.report import SequenceReport
from blinkgl.dataset.run import Outcome, run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import ConfigError, OutputError
from blinkgl.io.atomic import machine_token
from blinkgl.machine.terminal import plain_console, size
from blinkgl.sequence_files.index import read_index
from blinkgl.show import generate as display_module
from blinkgl.show.generate import Display
from runs import NAMES, RECIPE, Listener, alive, assert_same, children, recipe_file, start, temporaries, tree, wait_for


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    """The uninterrupted run, by the plainest loop there is."""
    folder = tmp_path_factory.mktemp("reference")
    reports = list(generate_run(load_run(recipe_file(folder)), folder / "out"))
    assert [r.path.relative_to(folder / "out").as_posix() for r in reports] == NAMES
    return folder / "out"


def worker_of(executor: Local, message) -> int:
    return next(p.popen.pid for p in executor._processes if p.task == message["task"])


# ---- workers -----------------------------------------------------------------------------------------------------


def test_killed_workers_leave_no_trace(reference, tmp_path):
    """Two workers; one is killed with -9 in the middle of a sequence."""
    executor = Local(2)
    sabotage = Listener(lambda name, message: os.kill(worker_of(executor, message), signal.SIGKILL))
    outcome = run_dataset(load_run(recipe_file(tmp_path)), tmp_path / "out", executor, listener=sabotage)
    assert sabotage.errors == ["the worker was ended by SIGKILL"] and not outcome.set_aside and len(outcome.made) == 6
    assert_same(tmp_path / "out", reference)
    costs = [json.loads(line) for line in (tmp_path / "out/.run/costs.jsonl").read_text().splitlines()]
    assert sorted(c["attempts"] for c in costs) == [1, 1, 1, 1, 1, 2] and all(c["peak_rss_kib"] > 1e4 for c in costs)
    assert [line["path"] for line in read_index(tmp_path / "out")] == sorted(NAMES)
    assert "attempt 1 failed: the worker was ended by SIGKILL" in "".join(
        p.read_text() for p in (tmp_path / "out/.run/logs").rglob("*.log")
    )
    assert run(["verify", str(tmp_path / "out"), "--deep", "--sample", "2"]) == 0


@pytest.mark.slow
def test_a_worker_that_hangs_is_replaced_and_a_hopeless_sequence_set_aside(reference, tmp_path, monkeypatch):
    """A sequence's worker is stopped each time it is tried: after the last attempt (two
    here) the run does without it."""
    monkeypatch.setattr(run_module, "ATTEMPTS", 2)

    class Stopping(Local):
        """The second sequence is given to a worker that is stopped; on its messages it might be done already."""

        def submit(self, task: int, attempt: int) -> None:
            if task == 1:
                (worker,) = self._processes
                os.kill(worker.popen.pid, signal.SIGSTOP)
            super().submit(task, attempt)

    template = load_run(recipe_file(tmp_path))
    outcome = run_dataset(template, tmp_path / "out", Stopping(1), num=4, time_limit_s=10.0)
    assert outcome.set_aside == {NAMES[1]: "took longer than the limit of 10 s"}
    assert len(outcome.made) == 3
    found = verify_dataset(tmp_path / "out")
    assert found.problems == {NAMES[1]: ["set aside: took longer than the limit of 10 s"]}
    again = run_dataset(template, tmp_path / "out", Inline(), resume=True)  # and the two that --num had left out
    assert (again.found, len(again.made), again.set_aside) == (3, 3, {})
    assert_same(tmp_path / "out", reference)
    assert verify_dataset(tmp_path / "out").clean


# ---- the driver --------------------------------------------------------------------------------------------------


def in_the_middle(out: Path) -> bool:
    """One sequence is whole, another being written."""
    return any((out / name).is_dir() for name in NAMES) and bool(temporaries(out))


def test_driver_killed_then_terminated_then_resumed(reference, tmp_path, capfd):
    recipe, out = recipe_file(tmp_path), tmp_path / "out"
    driver = start(recipe, "--out", out, "--workers", 2)
    wait_for(lambda: in_the_middle(out), driver)
    workers = children(driver.pid)
    driver.kill()
    driver.communicate()
    assert len(workers) == 2
    wait_for(lambda: not any(alive(pid) for pid in workers))
    half = [p for p in out.rglob("*") if p.name in {Path(n).name for n in NAMES}]
    assert 1 <= len(half) < 6 and all((p / "manifest.json").is_file() for p in half)

    left = {p.name for p in temporaries(out)}  # by the workers that were killed
    driver = start(recipe, "--out", out, "--resume")  # in one process this time
    wait_for(lambda: any("fly" in p.name and p.name not in left for p in temporaries(out)) or driver.poll() is not None)
    driver.send_signal(signal.SIGTERM)
    said, _ = driver.communicate()
    assert (driver.returncode, said.splitlines()[-1]) == (143, "interrupted; --resume continues"), said

    assert run(["generate", str(recipe), "--out", str(out), "--resume", "--quiet"]) == 0
    assert_same(out, reference)
    assert verify_dataset(out, deep=1).clean


def test_a_second_signal_does_not_cut_the_tidying(reference, tmp_path):
    """It comes while the executor closes: what was being written is gone all the same, and the index is there."""

    class Hasty(Inline):
        def close(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)
            super().close()

    template, out, whole = load_run(recipe_file(tmp_path)), tmp_path / "out", []

    def stop(name, message):
        whole.extend(path for path in out.rglob("fly_*") if path.is_dir())
        ended = subprocess.Popen(["true"])  # a worker that was killed
        ended.wait()
        left = f".fly_000002.blinkgl-tmp-{machine_token()}-{ended.pid}-0"
        shutil.copytree(whole[0], whole[0].with_name(left))
        os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        run_dataset(template, out, Hasty(), listener=Listener(stop, "progress", NAMES[1]))
    assert whole and temporaries(out) == [] and (out / "index.jsonl").is_file()
    run_dataset(template, out, resume=True)
    assert_same(out, reference)


@pytest.mark.slow
def test_ctrl_c_stops_the_workers_and_leaves_only_whole_sequences(reference, tmp_path):
    recipe, out = recipe_file(tmp_path), tmp_path / "out"
    driver = start(recipe, "--out", out, "--workers", 2)
    wait_for(lambda: in_the_middle(out), driver)
    workers = children(driver.pid)
    driver.send_signal(signal.SIGINT)
    said, _ = driver.communicate()
    assert driver.returncode == 130 and "Traceback" not in said
    assert not any(alive(pid) for pid in workers) and temporaries(out) == []
    found = verify_dataset(out)
    assert set(found.problems) and all(
        lines == ["missing: the recipe asks for it"] for lines in found.problems.values()
    )
    outcome = run_dataset(load_run(recipe), out, resume=True)
    assert outcome.found == found.sequences
    assert_same(out, reference)


# ---- assets ------------------------------------------------------------------------------------------------------


def mesh_recipe(tmp_path: Path) -> tuple[Path, list[Path]]:
    """Two groups less: sequences drawn from eight mesh files."""
    folder = tmp_path / "meshes"
    folder.mkdir(exist_ok=True)
    for k in range(8):
        (folder / f"box{k}.obj").write_text(
            f"v 0 0 0\nv 1 0 0\nv 0 {k + 1} 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
        )
    scene = {
        "kind": "random",
        "objects": {"count": 2},
        "pool": {"primitives": [], "folders": ["meshes"], "test_fraction": 0.0},
        "textures": {
            "procedural": ["checks"],
            "variants": 4,
            "photographs": False,
            "max_size": 64,
            "test_fraction": 0.0,
        },
    }
    return recipe_file(tmp_path, scene=scene, groups={"fly": {"output": {"sequences": 4}}}), sorted(folder.iterdir())


def test_a_corrupt_asset_costs_the_sequences_that_need_it(tmp_path, capsys):
    recipe, files = mesh_recipe(tmp_path)
    files[0].write_text("v 0 0 0\nf 1 2 9\n")
    status = run(
        ["generate", str(recipe), "--out", str(tmp_path / "out"), "--quiet", "--set", "groups.fly.output.sequences=8"]
    )
    said = capsys.readouterr().err
    assert status == 3 and "set aside: train/fly_" in said and "box0.obj" in said
    failed = json.loads((tmp_path / "out/.run/failed.json").read_text())
    made = [line["path"] for line in read_index(tmp_path / "out")]
    assert set(made) | set(failed) == {f"train/fly_{i:06d}" for i in range(8)} and made and failed
    log = (tmp_path / "out/.run/logs" / f"{min(failed)}.log").read_text()
    assert log.count("attempt 1, pid") == 1 and "attempt 2" not in log, "a file is not mended by reading it again"
    assert "Traceback" in log


# ---- what may go on where ----------------------------------------------------------------------------------------


def test_assets_that_moved_are_the_same_assets(tmp_path, capsys):
    """Meshes and a trajectory at absolute paths: another mount is the same run, another content is not."""
    here = tmp_path / "disk-a"
    (here / "meshes").mkdir(parents=True)
    for k in range(1, 4):
        trimesh.creation.box((k, 1, 1)).export(here / f"meshes/{k}.obj")
    (here / "way.txt").write_text("".join(f"{t} {t} 0 0 0 0 0 1\n" for t in range(3)))

    def line(place, n):
        one, two = ({"output": {"sequences": n, "split": split}} for split in ("train", "test"))
        one["scene"] = {**RECIPE["scene"], "pool": {"primitives": [], "folders": [f"{place}/meshes"]}}
        two["scene"] = {
            "kind": "explicit",
            "meshes": {"m": {"file": f"{place}/meshes/1.obj"}},
            "objects": [{"mesh": "m", "position": [3, 0, 0]}],
            "camera": {"trajectory": {"file": f"{place}/way.txt", "form": "tum", "time_unit": "s"}},
        }
        groups = {"one": one, "two": {**two, "output": {"sequences": 1, "split": "test"}}}
        recipe = {key: value for key, value in RECIPE.items() if key != "scene"}
        path = tmp_path / "recipe.yaml"
        path.write_text(yaml.safe_dump({**recipe, "groups": groups}))
        return ["generate", str(path), "--out", str(tmp_path / "out"), "--quiet", "--resume"]

    assert run(line(here, 1)) == 0
    here.rename(tmp_path / "disk-b")
    assert run(line(tmp_path / "disk-b", 2)) == 0
    assert verify_dataset(tmp_path / "out").clean
    capsys.readouterr()
    # The mesh is one of the first group's pool, too, which is listed anew.
    for name, named in (("way.txt", "way.txt"), ("meshes/1.obj", "1.obj (changed), meshes/1.obj")):
        file = tmp_path / "disk-b" / name
        text = file.read_text()
        file.write_text(text + "\n# another\n")
        assert run(line(tmp_path / "disk-b", 3)) == 2
        assert f"the pools have changed since the run began: {named} (changed); expected" in capsys.readouterr().err
        file.write_text(text)


def test_times_beside_poses_are_an_asset(tmp_path, capsys):
    """KITTI's poses have none of their own."""
    poses = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(4))
    (tmp_path / "way.txt").write_text(poses)
    (tmp_path / "times.txt").write_text("".join(f"{k}.000000\n" for k in range(4)))
    scene = {
        "kind": "explicit",
        "meshes": {"m": {"primitive": "cuboid"}},
        "objects": [{"mesh": "m", "position": [3, 0, 0]}],
        "camera": {"trajectory": {"file": str(tmp_path / "way.txt"), "form": "kitti"}},
    }
    path = tmp_path / "recipe.yaml"
    path.write_text(yaml.safe_dump({**RECIPE, "scene": scene, "output": {"sequences": 2}}))
    line = ["generate", str(path), "--out", str(tmp_path / "out"), "--quiet", "--resume"]
    assert run([*line, "--num", "1"]) == 0
    (tmp_path / "times.txt").write_text("".join(f"{1.5 * k:f}\n" for k in range(4)))
    assert run(line) == 2
    assert "the pools have changed since the run began: times.txt (changed)" in capsys.readouterr().err


def test_another_recipe_is_refused(tmp_path):
    recipe = load_run(recipe_file(tmp_path))
    run_dataset(recipe, tmp_path / "out", num=3)
    before = tree(tmp_path / "out")
    other = load_run(recipe_file(tmp_path), ["groups.probe.camera.width=80"])
    for resume in (False, True):
        with pytest.raises(
            OutputError, match=r"contains a run of another recipe \(different: probe\); expected .*--mixed"
        ):
            run_dataset(other, tmp_path / "out", resume=resume)
    with pytest.raises(OutputError, match="exists; expected a new folder name, or --resume"):
        run_dataset(recipe, tmp_path / "out", num=3)
    assert tree(tmp_path / "out") == before
    outcome = run_dataset(other, tmp_path / "out", num=6, resume=True, mixed=True)
    assert (outcome.found, len(outcome.made)) == (3, 3)
    assert len(json.loads((tmp_path / "out/.run/run.json").read_text())["mixed"]) == 1, "the record says so"


def test_damaged_sequence_is_put_away_and_made_again(reference, tmp_path):
    recipe = load_run(recipe_file(tmp_path))
    run_dataset(recipe, tmp_path / "out")
    (tmp_path / "out" / NAMES[2] / "poses.npz").unlink()
    (tmp_path / "out" / NAMES[3] / "mine.txt").write_text("notes of a user")
    outcome = run_dataset(recipe, tmp_path / "out", resume=True)
    assert set(outcome.damaged) == {NAMES[2], NAMES[3]} and "poses.npz: missing" in outcome.damaged[NAMES[2]]
    assert (tmp_path / "out/.run/damaged" / f"{NAMES[3]}-0" / "mine.txt").read_text() == "notes of a user"
    assert_same(tmp_path / "out", reference)
    assert verify_dataset(tmp_path / "out").clean


def test_workers_that_differ_are_refused(tmp_path):
    class Odd(Inline):
        def open(self, job):
            hello = super().open(job)[0]
            return [hello, {**hello, "environment": {**hello["environment"], "numba": "0.1"}}]

    with pytest.raises(ConfigError, match=r"workers differ in version or hardware: numba 0\.1 and"):
        run_dataset(load_run(recipe_file(tmp_path)), tmp_path / "out", Odd())
    assert not (tmp_path / "out").exists()


def test_a_group_that_is_switched_off_is_not_planned(tmp_path):
    groups = {**RECIPE["groups"], "probe": {**RECIPE["groups"]["probe"], "enabled": False}}
    plan = Plan.of(load_run(recipe_file(tmp_path, groups=groups)))
    assert [task.name for task in plan.tasks] == [name for name in NAMES if "fly" in name]
    assert plan.tasks.number("test/probe_000000") is None and plan.tasks.splits == ["train"]
    off = {name: {**group, "enabled": False} for name, group in RECIPE["groups"].items()}
    with pytest.raises(ConfigError, match="groups: all groups are disabled; expected enabled: true"):
        Plan.of(load_run(recipe_file(tmp_path, groups=off)))


def test_num_is_of_the_whole_run_and_dealt_by_the_groups_own_numbers(tmp_path):
    sizes = {"flying": 16, "held_out": 3, "dice": 1, "off": 40}
    template = RunTemplate(
        {"groups": {name: {"output": {"sequences": count}, "enabled": name != "off"} for name, count in sizes.items()}},
        tmp_path,
    )
    dealt = [Plan.of(template, num).counts for num in range(1, 101)]
    assert [sum(counts.values()) for counts in dealt] == list(range(1, 101))
    for fewer, more in itertools.pairwise(dealt):
        assert all(more.get(name, 0) >= count for name, count in fewer.items()), "a larger --num only adds"
    assert dealt[19] == Plan.of(template).counts == {"flying": 16, "held_out": 3, "dice": 1}
    assert dealt[99] == {"flying": 80, "held_out": 15, "dice": 5}
    assert dealt[0] == {"flying": 1}
    # Records of runs before format_version 3 mean "of each group at most".
    assert Plan.of(template, 2, of_each=True).counts == {"flying": 2, "held_out": 2, "dice": 1}


def test_num_of_a_run_without_groups_may_be_larger_than_the_file_says(tmp_path):
    assert Plan.of(RunTemplate({"output": {"sequences": 2}}, tmp_path), 7).counts == {"": 7}


def test_time_and_size_are_foretold_once(monkeypatch):
    """By sequences that are not the first of their process: with two workers, after the first of both."""
    now = 0.0
    monkeypatch.setattr(display_module.time, "monotonic", lambda: now)
    display = Display(plain_console(file=(text := io.StringIO())), Path("/"))
    display.begin(SimpleNamespace(tasks=range(12)), Outcome(12, found=2))
    report = asdict(SequenceReport(0, Path("a"), 0.1, 9, 10, 3, 2, {}, 1.0))
    done = lambda first: {"kind": "done", "first": first, "bytes": 5_000_000, "report": report}
    for now, first in ((50.0, True), (60.0, True), (64.0, False), (68.0, False)):
        display.message(f"train/a_{now}", done(first))
    lines = [line for line in text.getvalue().splitlines() if "expected" in line]
    # 64 s, and 7 of 10 at 4 s; all the while the first ones' minute would give 21 s each.
    assert lines == ["expected: about 0:01:32 and 50.0 MB"]
    assert display.summary().endswith("0:00:24 left, 20.0 MB of about 50.0 MB")


@pytest.mark.parametrize("count, text", [(46_000, "46 kB"), (600_000, "0.6 MB"), (35.2e6, "35.2 MB"), (2e8, "0.20 GB")])
def test_sizes_of_small_sets_are_not_zero(count, text):
    assert size(count) == text
