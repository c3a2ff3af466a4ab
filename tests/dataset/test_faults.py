"""What others do to a run while it is on: stopped workers, deleted files, clocks that jump,
second drivers, links, refusals."""

import os
import re
import shutil
import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset import executor as executor_module, work
from blinkgl.dataset.assets import check_assets
from blinkgl.dataset.executor import Inline, Local
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError, BlinkGLError, EventDataError, GLError, OutputError
from runs import RECIPE, Listener, assert_same, recipe_file, temporaries
from tests.tiny_recipe import TINY

FLY = {"fly": {**RECIPE["groups"]["fly"], "output": {"sequences": 3}}}
NAMES = [f"train/fly_{i:06d}" for i in range(3)]


def template(folder: Path, **changes):
    folder.mkdir(exist_ok=True)
    return load_run(recipe_file(folder, **{"groups": FLY, **changes}))


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    list(generate_run(template(folder), folder / "out"))
    return folder / "out"


# ---- which errors are worth another attempt --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error, attempts",
    [
        (AssetError("the mesh is corrupt"), 1),
        (EventDataError("time goes back"), 1),
        (ValueError("a bug"), 1),
        (GLError("lost"), 3),
        (MemoryError("no memory"), 3),
    ],
)
def test_attempts(tmp_path, monkeypatch, error, attempts):
    """One sequence of three fails, always alike."""
    tried = []

    def generate(config, index, *arguments, **options):
        tried.append(index)
        if index == 1:
            raise error
        return make(config, index, *arguments, **options)

    make = work.generate_sequence
    monkeypatch.setattr(work, "generate_sequence", generate)
    outcome = run_dataset(template(tmp_path), tmp_path / "out")
    assert tried.count(1) == attempts and list(outcome.set_aside) == [NAMES[1]] and len(outcome.made) == 2


# ---- refused runs ----------------------------------------------------------------------------------------------------


def test_a_refused_run_leaves_nothing(tmp_path, capsys):
    """Not the folders above OUT, no record, no log; and what was there before stays."""
    recipe = recipe_file(tmp_path, gl={"backend": "egl", "device": 99})
    (tmp_path / "mine/empty").mkdir(parents=True)
    for out, workers in (("a/b/out", []), ("a/b/out", ["--workers", "1"]), ("mine", [])):
        assert run(["generate", str(recipe), "--out", str(tmp_path / out), *workers]) == 2
        assert "no such EGL device" in capsys.readouterr().err
        assert sorted(p.name for p in tmp_path.rglob("*")) == ["empty", "mine", "recipe.yaml"]


def test_workers_that_cannot_start_leave_the_log_their_error_names(tmp_path, monkeypatch):
    monkeypatch.setattr(executor_module, "_BAD_STARTS", 1)
    recipe = template(tmp_path)
    (tmp_path / "blinkgl").mkdir()
    (tmp_path / "blinkgl/__init__.py").write_text("raise ImportError('half an installation')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(BlinkGLError, match="workers cannot start: .*worker-0.log") as failure:
        run_dataset(recipe, tmp_path / "out", Local(1))
    assert len(os.listdir("/proc/self/fd")) == before, "a worker that is gone keeps no pipe open"
    assert "half an installation" in Path(failure.value.accepted.removeprefix("see ")).read_text()


# ---- links -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["train", ".run"])
def test_a_link_in_the_place_of_our_folder_is_refused(tmp_path, name):
    for folder in ("out", "elsewhere"):
        (tmp_path / folder).mkdir()
    (tmp_path / "out" / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match=rf"out/{name}: is a symbolic link; expected a folder"):
        run_dataset(template(tmp_path), tmp_path / "out")
    assert list((tmp_path / "elsewhere").iterdir()) == []


# ---- many sequences --------------------------------------------------------------------------------------------------


def test_memory_does_not_grow_with_the_number_of_sequences(tmp_path):
    """A run is planned and begun, and ends with its first message."""

    class Enough(Exception): ...

    def stop(name, message):
        raise Enough

    class Nothing(Inline):
        def open(self, job):
            super().open(job)
            return [{"environment": {}, "assets": work.digest(check_assets(self._maker.plan))}]

        def poll(self, timeout_s):
            return [{"kind": "progress", "task": self._next[0], "error": "stop here"}]

    def peak_of(sequences: int) -> int:
        run = template(tmp_path, groups={"fly": {"output": {"sequences": sequences}}})
        tracemalloc.start()
        try:
            with pytest.raises(Enough):
                run_dataset(run, tmp_path / f"{sequences}", Nothing(), listener=Listener(stop))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak_of(3)  # what is made once
    small, large = peak_of(10), peak_of(10_000_000)
    assert large < 1.5 * small + 1e6, f"{small} and {large} bytes"


# ---- files deleted under a run ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["events.h5", "everything", "the folder"])
def test_a_temporary_that_is_deleted_costs_an_attempt_and_no_half_sequence_appears(reference, tmp_path, what):
    out = tmp_path / "out"

    def delete(name, message):
        (folder,) = temporaries(out)
        if what == "the folder":
            shutil.rmtree(folder)
        else:
            for path in [folder / what] if what != "everything" else [p for p in folder.rglob("*") if p.is_file()]:
                path.unlink()

    display = Listener(delete, name=NAMES[1])
    outcome = run_dataset(template(tmp_path), out, listener=display)
    (failed,) = [m for _, m in display.messages if m["kind"] == "failed"]
    assert (
        NAMES[1] in failed["error"] and "tmp" not in failed["error"].replace(str(tmp_path), "") and failed["expected"]
    )
    assert len(outcome.made) == 3 and not outcome.set_aside
    assert_same(out, reference)
    assert verify_dataset(out).clean


@pytest.mark.parametrize("executor", [Inline(), Local(1)], ids=["inline", "local"])
def test_an_output_folder_that_is_deleted_stops_the_run(tmp_path, executor):
    out = tmp_path / "out"
    with pytest.raises(OutputError, match="out: was deleted, moved or replaced during the run"):
        run_dataset(template(tmp_path), out, executor, listener=Listener(lambda *_: shutil.rmtree(out), "done"))
    assert not temporaries(out) and not (out / "index.jsonl").exists() and not (out / ".run/run.json").exists()
    assert all(verify_dataset(manifest.parent).clean for manifest in out.rglob("manifest.json")), (
        "what was made since is whole"
    )
    run_dataset(template(tmp_path), out, resume=True)
    assert verify_dataset(out).clean


def test_a_record_that_is_deleted_is_written_again(reference, tmp_path):
    out = tmp_path / "out"
    run_dataset(template(tmp_path), out, listener=Listener(lambda *_: shutil.rmtree(out / ".run"), "done"))
    assert_same(out, reference)
    with pytest.raises(OutputError, match="another recipe"):
        run_dataset(template(tmp_path, seed=12), out, resume=True)


# ---- others at work --------------------------------------------------------------------------------------------------


def test_a_driver_that_meets_another_takes_nothing_of_it_away(tmp_path):
    """The loser made no folder, and the winner's empty one is not its to remove; a lock on
    a folder that is gone is none."""
    out = tmp_path / "out"
    first, second = RunFolder(out), RunFolder(out)
    with first.locked():
        with pytest.raises(OutputError, match="another run uses this folder"), second.locked():
            raise AssertionError
        assert out.is_dir() and first.in_place
        shutil.rmtree(out)
        with second.locked():
            assert second.in_place and not first.in_place
            with pytest.raises(OutputError, match="deleted"):
                first.check_in_place()
    assert not out.exists()


# ---- locks and power cuts --------------------------------------------------------------------------------------------

NO_LOCKS = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
int flock(int fd, int op) { errno = ENOLCK; return -1; }
static int call(const char *name, int fd, int cmd, void *arg) {
    if (cmd == F_OFD_SETLK) { errno = ENOLCK; return -1; }
    return ((int (*)(int, int, ...))dlsym(RTLD_NEXT, name))(fd, cmd, arg);
}
int fcntl(int fd, int cmd, ...) { va_list a; va_start(a, cmd); return call("fcntl", fd, cmd, va_arg(a, void *)); }
int fcntl64(int fd, int cmd, ...) { va_list a; va_start(a, cmd); return call("fcntl64", fd, cmd, va_arg(a, void *)); }
"""
NFS_FLOCK = """
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <sys/file.h>
#include <sys/syscall.h>
#include <unistd.h>
int flock(int fd, int op) {  /* flock(2), "NFS details" */
    if ((op & LOCK_EX) && (fcntl(fd, F_GETFL) & O_ACCMODE) == O_RDONLY) { errno = EBADF; return -1; }
    return syscall(SYS_flock, fd, op);
}
"""


@pytest.mark.parametrize(
    "system, exclusive", [("", True), (NFS_FLOCK, True), (NO_LOCKS, False)], ids=["", "nfs", "none"]
)
def test_one_run_at_a_time_where_the_system_has_locks(tmp_path, system, exclusive):
    """Two processes; without locks a line says so, and both may go on."""
    environment = dict(os.environ)
    if system:
        if shutil.which("cc") is None:
            pytest.skip("no C compiler to emulate the file system with")
        (tmp_path / "fs.c").write_text(system)
        command = ["cc", "-shared", "-fPIC", "-o", tmp_path / "fs.so", tmp_path / "fs.c", "-ldl"]
        subprocess.run(command, check=True, capture_output=True)
        environment["LD_PRELOAD"] = str(tmp_path / "fs.so")
    program = (
        "import sys, pathlib\nfrom blinkgl.io.atomic import locked_folder\nfrom blinkgl.errors import OutputError\n"
        "try:\n    with locked_folder(pathlib.Path(sys.argv[1])):\n        print('held', flush=True)\n"
        "        sys.stdin.read()\n"
        "except OutputError as error:\n    print(error)\n"
    )

    def start():
        command = [sys.executable, "-c", program, str(tmp_path / "out")]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=environment)

    (tmp_path / "out/.run").mkdir(parents=True)
    # Of a machine that died: a file locks nothing.
    (tmp_path / "out/.run/lock").write_text("process 1 of a dead machine, and more of it than the next one writes " * 2)
    first = start()
    assert first.stdout.readline() == "held\n"
    second = start()
    said = second.stdout.readline()
    if exclusive:
        assert re.fullmatch(
            rf".*out: another run uses this folder \(got 'process {first.pid} of .*'\); expected another --out, or "
            "--resume after it has ended\n",
            said,
        )
    else:
        assert said == "held\n"
    notes = [process.communicate()[1] for process in (first, second)]
    assert [note.count("has no locks; start no other run here\n") for note in notes] == [not exclusive] * 2
    assert not (tmp_path / "out/.run").exists()


@pytest.mark.slow
def test_what_is_renamed_has_reached_the_disk(tmp_path):
    """The order of the system calls of a run in a new folder below new folders: contents before their names, and every
    name, those of OUT and its parents, too, before the run ends."""
    if shutil.which("strace") is None:
        pytest.skip("no strace")
    recipe, log = recipe_file(tmp_path, groups=FLY), tmp_path / "calls"
    calls = "trace=mkdir,rename,renameat2,fsync"
    traced = ["strace", "-f", "-y", "-qq", "-s", "4096", "-e", calls, "-o", str(log)]
    words = ["generate", str(recipe), "--out", str(tmp_path / "a/b/out"), "--num", "1", "--quiet"]
    done = subprocess.run([*traced, sys.executable, "-m", "blinkgl.cli", *words], capture_output=True, text=True)
    if "ptrace" in done.stderr:
        pytest.skip("this machine lets nobody trace")
    assert done.returncode == 0, done.stderr
    names, synced, renamed = set(), set(), 0
    for line in log.read_text().splitlines():
        if made := re.search(r'mkdir\("([^"]+)".* = 0', line):
            names.add(Path(made[1]))
        elif found := re.search(r"fsync\(\d+<([^>]+)>\) += 0", line):
            synced.add(path := Path(found[1]))
            names -= {name for name in names if name.parent == path}
        elif moved := re.search(r'rename\w*\([^"]*"([^"]+)"[^"]*"([^"]+)".* = 0', line):
            before, after = map(Path, moved.groups())
            if after.is_relative_to(tmp_path):
                renamed += 1
                assert before in synced, f"{before} was renamed before it was synced"
                names = {name for name in names if not name.is_relative_to(before)} | {after}
    assert renamed >= 6
    logs = tmp_path / "a/b/out/.run/logs"
    assert not {name for name in names if name.is_relative_to(tmp_path) and not name.is_relative_to(logs)}


@pytest.mark.slow
def test_a_long_run_keeps_its_memory_and_files(tmp_path):
    """Five hundred sequences in one process: the last four hundred take no more than the first hundred did."""
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump({**TINY, "output": {"sequences": 500}}))
    kept = []

    def look(name, message):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        kept.append((pages * os.sysconf("SC_PAGE_SIZE") / 2**20, len(os.listdir("/proc/self/fd"))))
        return False

    outcome = run_dataset(load_run(path), tmp_path / "out", listener=Listener(look, "done"))
    assert len(outcome.made) == 500
    memory, files = zip(*kept, strict=True)
    assert max(memory[400:]) < 1.05 * max(memory[:100]) + 5, "MiB"
    assert max(files) == max(files[:10])
