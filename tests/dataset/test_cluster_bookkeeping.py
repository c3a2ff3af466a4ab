"""What the driver keeps of tasks on Ray, with a Ray that only writes down what it is asked."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from blinkgl.dataset import cluster as module
from blinkgl.dataset.cluster import RayCluster
from blinkgl.errors import BlinkGLError


class RayError(Exception):
    pass


class NodeDiedError(RayError):
    pass


class WorkerCrashedError(RayError):
    pass


class FakeRay:
    """``results``: reference -> what getting it gives, an exception to raise or a message.
    ``done``: what waiting finds."""

    exceptions = SimpleNamespace(RayError=RayError, NodeDiedError=NodeDiedError, WorkerCrashedError=WorkerCrashedError)
    __version__ = "0"

    def __init__(self):
        self.results, self.done, self.calls, self.alive = {}, [], [], True

    def is_initialized(self):
        return self.alive

    def cluster_resources(self):
        return {"CPU": 6.0}

    def wait(self, references, num_returns, timeout):
        assert references, "Ray refuses to wait for nothing"
        self.calls.append(("wait", num_returns))
        ready = [r for r in references if r in self.done][:num_returns]
        return ready, [r for r in references if r not in ready]

    def get(self, reference, timeout=None):
        found = self.results[reference]
        if isinstance(found, Exception):
            raise found
        return found

    def cancel(self, reference, force=False):
        self.calls.append(("cancel", reference, force))

    def kill(self, actor):
        self.calls.append(("kill", actor))

    def shutdown(self):
        self.calls.append(("shutdown",))


@pytest.fixture
def ray(monkeypatch):
    fake = FakeRay()
    monkeypatch.setitem(__import__("sys").modules, "ray", fake)
    monkeypatch.setattr(module.time, "sleep", lambda seconds: fake.calls.append(("sleep", seconds)))
    return fake


def with_tasks(*tasks: int, workers=None) -> RayCluster:
    cluster = RayCluster(workers)
    cluster._tasks = {f"r{task}": task for task in tasks}
    return cluster


@pytest.mark.parametrize(
    "found, reason, error, lost",
    [
        (NodeDiedError("node 7 is gone\nmore"), None, "the node was lost: node 7 is gone", True),
        (NodeDiedError("x"), "too slow", "the node was lost: x", True),
        (WorkerCrashedError("boom"), None, "the worker was ended", False),
        (WorkerCrashedError("boom"), "took too long", "took too long", False),
        (RayError("out of memory"), None, "out of memory", False),
        (RayError("out of memory"), "took too long", "took too long", False),
        (RayError("the Node has DIED"), None, "the Node has DIED", True),
        (RayError("the node has died"), "took too long", "took too long", False),
        (RayError("the node is well"), None, "the node is well", False),
        (RayError("the task died"), None, "the task died", False),
    ],
)
def test_what_became_of_a_task(ray, found, reason, error, lost):
    """A node that is lost is nobody's fault; a worker that was ended has the reason it was ended for."""
    cluster = with_tasks(3, 4)
    ray.results["r3"] = found
    if reason:
        cluster._reasons[3] = reason
    message = cluster._collect("r3")
    assert (
        message["task"] == 3
        and error in message["error"]
        and bool(message.get("lost")) is lost
        and message["kind"] == "failed"
    )
    assert cluster._tasks == {"r4": 4} and 3 not in cluster._reasons


def test_a_message_is_passed_on_and_a_refusal_is_raised(ray):
    cluster = with_tasks(1, 2)
    ray.results = {"r1": {"kind": "done", "task": 1}, "r2": {"kind": "refused", "error": "another version"}}
    assert cluster._collect("r1") == {"kind": "done", "task": 1}
    with pytest.raises(BlinkGLError, match="another version"):
        cluster._collect("r2")


def test_a_task_is_killed_once_and_for_its_first_reason(ray):
    cluster = with_tasks(1, 2)
    for reason in ("slow", "slower"):
        cluster.kill(2, reason)
    cluster.kill(7, "unknown")
    assert ray.calls == [("cancel", "r2", True)] and cluster._reasons == {2: "slow"}


@pytest.mark.parametrize("done, forced", [(["r1", "r2"], []), (["r1"], ["r2"]), ([], ["r1", "r2"])])
@pytest.mark.parametrize("ours", [True, False])
def test_closing(ray, tmp_path, done, forced, ours):
    """All are asked to end, those that do not are made to, and only for them it waits; a
    cluster of one's own ends with its folder."""
    cluster = with_tasks(1, 2)
    cluster._board, cluster._ours, cluster._folder = "board", ours, str(tmp_path / "ray")
    cluster._reasons = {1: "too slow"}
    (tmp_path / "ray").mkdir()
    ray.done = done
    cluster.close()
    assert ray.calls == [
        ("cancel", "r1", False),
        ("cancel", "r2", False),
        ("wait", 2),
        *(("cancel", r, True) for r in forced),
        *([("sleep", 1.0)] if forced else []),
        ("kill", "board"),
        *([("shutdown",)] if ours else []),
    ]
    assert not cluster._tasks and not (tmp_path / "ray").exists()
    assert not cluster._reasons and not cluster._ours, "of another run it knows nothing"


# --- connecting, and the worker's side --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error, said",
    [
        (
            RuntimeError("Version mismatch:\n  2.1"),
            "Ray's or Python's version differs from the cluster's: Version mismatch: 2.1",
        ),
        (ConnectionError("x" * 300), "cannot connect to Ray: " + "x" * 200 + " .got 'a:1'"),
        (BlinkGLError("ours"), "^ours$"),
    ],
)
def test_why_ray_cannot_be_connected_to(ray, monkeypatch, error, said):
    def init(**_):
        raise error

    monkeypatch.setattr(module, "_reachable", lambda address: None)
    ray.init = init
    cluster = RayCluster(address="a:1")
    with pytest.raises(BlinkGLError, match=said):
        cluster._connect()
    assert not cluster._ours
    cluster._restore_environment()


class Worker:
    """What ``_open`` makes: a maker of a job that says hello."""

    def __init__(self, job, environment="e", assets="a"):
        self.job = SimpleNamespace(to_dict=lambda: job)
        self.hello = {"kind": "hello", "environment": {"v": environment}, "assets": assets}
        self.made = []

    def make(self, task, attempt, tell):
        self.made.append((task, attempt, tell))
        return {"kind": "done", "task": task}


@pytest.mark.parametrize(
    "environment, assets, said",
    [
        ("e", "a", None),
        ("f", "a", "differs from the run's first in version or hardware: v f and e"),
        ("e", "b", "finds other meshes"),
    ],
)
def test_a_worker_looks_before_its_first_task(monkeypatch, environment, assets, said):
    # A job, and the plug-ins that it needs.
    opened, job, board = [], ({"out": "o"}, []), SimpleNamespace(put=SimpleNamespace(remote="tell"))
    worker = Worker(job[0], environment, assets)

    def open_(*asked):
        opened.append(asked)
        monkeypatch.setattr(module, "_maker", worker)
        return worker, worker.hello

    monkeypatch.setattr(module, "_open", open_)
    monkeypatch.setattr(module, "_maker", None)
    expected = ({"v": "e"}, "a")
    message = module._work(job, 3, 1, expected, board)
    if said:
        assert message["kind"] == "refused" and said in message["error"] and worker.made == []
        return
    module._work(job, 4, 2, expected, board)
    assert message == {"kind": "done", "task": 3} and worker.made == [(3, 1, "tell"), (4, 2, "tell")]
    assert opened == [job], "once for a job"
    module._work(({"out": "another"}, []), 5, 1, expected, board)
    assert len(opened) == 2

    def refuses(*asked):
        raise BlinkGLError("no OpenGL")

    monkeypatch.setattr(module, "_open", refuses)
    for message in (module._work(({"out": "third"}, []), 5, 1, expected, board), module._hello(job)):
        assert message == {"kind": "refused", "error": "no OpenGL"}


@pytest.mark.parametrize("address", ["host", ":5", "host:port", "ray://host", "host:", "host:²"])
def test_what_is_no_address(address):
    with pytest.raises(BlinkGLError, match="--address: not an address .*; expected host:port, ray://host:port or auto"):
        module._reachable(address)


@pytest.mark.parametrize("ids, device", [([], None), (["0"], 1), ([1], 3), ([2], None), (["MIG-7"], None)])
def test_cards_of_egl_without_software(monkeypatch, ids, device):
    monkeypatch.setattr(module, "egl_devices", lambda: ["Software", "a", "software b", "c"])
    assert module._egl_device(ids) == device
