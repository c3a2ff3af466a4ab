"""Execution on Ray (extra ``[cluster]``): an existing cluster, or a local one for the duration of the run.

All nodes need this BlinkGL, the recipe's asset folders and the output folder under the same paths (a shared file
system): a sequence is written by the node that made it. Before any work each node reports its versions and the content
hashes of its assets.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator
from typing import Any

from blinkgl.dataset.executor import Executor
from blinkgl.dataset.messages import Message
from blinkgl.dataset.work import Job, Maker, environment_differences, thread_environment
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.gl.context import egl_devices
from blinkgl.machine.extras import install
from blinkgl.machine.plugins import load_plugins, plugin_files
from blinkgl.types.trees import Tree

_HELLO_S = 600.0
_STOP_S = 15.0
_CONNECT_S = 5.0


class RayCluster(Executor):
    """Executor of :mod:`blinkgl.dataset.run` on Ray. A lost worker costs an attempt, a lost node does not.

    workers : tasks at a time; default: the number of CPUs of the cluster, new nodes included.
    address : of a running cluster ("host:6379", "auto", "ray://host:10001"); default: the one this process is connected
        to, else that of the environment's RAY_ADDRESS, else a new one on this machine, closed with the run. That one
        has no dashboard and listens only on 127.0.0.1: anyone who reaches a Ray port may run code (Ray 2.60 requires a
        token, earlier versions nothing).
    gpus : GPUs per task, e.g. 0.25 for four tasks on each. Ray assigns them; the task draws on that GPU's EGL
    device.
    """

    def __init__(self, workers: int | None = None, *, address: str | None = None, gpus: float = 0.0):
        # Ray reads these when it is imported and started; they are restored after the run.
        self._own_variables = [
            name for name in ("RAY_USAGE_STATS_ENABLED", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO") if name not in os.environ
        ]
        os.environ.update(dict.fromkeys(self._own_variables, "0"))
        try:
            import ray
        except ImportError:
            self._restore_environment()
            raise ConfigError(
                "Ray is not installed", where="--executor", value="ray", accepted=f"run {install('ray')}"
            ) from None
        self._ray, self._workers, self._address, self._gpus = ray, workers, address, gpus
        self._ours = False
        self._tasks: dict[Any, int] = {}  # object reference -> task
        self._reasons: dict[int, str] = {}  # task -> why it was killed
        self._board = None
        self._folder: str | None = None  # of our own cluster

    def open(self, job: Job) -> list[Message]:
        ray = self._ray
        if not ray.is_initialized():
            self._connect()
        nodes = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]
        if not nodes:
            raise ConfigError("the cluster has no node with a CPU", where="--address", value=self._address)
        self._job = ray.put((job.to_dict(), plugin_files()))
        # A node that joins later is compared by its first task.
        hellos = [self._ask(node) for node in nodes]
        self._expected = hellos[0]["environment"], hellos[0]["assets"]
        here = self._affinity(ray.get_runtime_context().get_node_id(), soft=True)
        self._board = ray.remote(_Board).options(num_cpus=0, scheduling_strategy=here).remote()
        # Ray repeats nothing by itself: the run counts the attempts.
        self._work = ray.remote(_work).options(num_cpus=1, num_gpus=self._gpus, max_retries=0)
        return hellos

    def free(self) -> int:
        wanted = self._workers or int(self._ray.cluster_resources().get("CPU", 1))
        return wanted - len(self._tasks)

    def submit(self, task: int, attempt: int) -> None:
        self._tasks[self._work.remote(self._job, task, attempt, self._expected, self._board)] = task

    def poll(self, timeout_s: float) -> list[Message]:
        if not self._tasks:
            return []
        ready, _ = self._ray.wait(list(self._tasks), num_returns=1, timeout=timeout_s)
        # Whatever else is ready by now is collected in the same turn.
        more, _ = self._ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=0)
        for message in self._news():
            if message["task"] in self._tasks.values():
                self.listener(message)
        return [self._collect(reference) for reference in dict.fromkeys([*ready, *more])]

    def kill(self, task: int, reason: str) -> None:
        for reference, number in self._tasks.items():
            if number == task and task not in self._reasons:
                self._reasons[task] = reason
                self._ray.cancel(reference, force=True)

    def close(self) -> None:
        ray = self._ray
        self._restore_environment()
        if not ray.is_initialized():
            self._discard_folder()
            return
        try:
            for reference in self._tasks:
                ray.cancel(reference)  # as Ctrl-C: the sequence in progress is discarded
            if self._tasks:
                _, left = ray.wait(list(self._tasks), num_returns=len(self._tasks), timeout=_STOP_S)
                for reference in left:
                    ray.cancel(reference, force=True)
                if left:
                    time.sleep(1.0)
            if self._board is not None:
                ray.kill(self._board)
        except Exception:  # noqa: BLE001 - the cluster may be gone; there is nothing left to stop then
            pass
        finally:
            self._tasks.clear()
            self._reasons.clear()
            if self._ours:
                ray.shutdown()
            self._ours = False
            self._discard_folder()

    def _restore_environment(self) -> None:
        for name in self._own_variables:
            os.environ.pop(name, None)
        self._own_variables = []

    def _discard_folder(self) -> None:
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    # ---- machinery -------------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        ray, address = self._ray, self._address or os.environ.get("RAY_ADDRESS") or "local"
        if address not in ("auto", "local"):
            _reachable(address)
        try:
            # Ray puts the folder where it is started first on its workers' path: not the user's.
            with contextlib.chdir("/"):
                if address == "local":
                    self._start_own()
                else:
                    ray.init(address=address, log_to_driver=False, logging_level="ERROR", configure_logging=True)
        except BlinkGLError:
            raise
        except Exception as error:  # noqa: BLE001 - Ray raises ConnectionError, RuntimeError, ValueError, grpc's own
            text = " ".join(str(error).split())[:200]
            what = (
                "Ray's or Python's version differs from the cluster's"
                if "ersion mismatch" in text
                else "cannot connect to Ray"
            )
            raise ConfigError(
                f"{what}: {text}",
                where="--address",
                value=address if address != "local" else "a local cluster",
                accepted="a running Ray of the same version",
            ) from None
        self._ours = True

    def _start_own(self) -> None:
        """Start a cluster only on 127.0.0.1, with its files unreadable for other users of the machine."""
        # 0700; Ray's own folder in it is readable by everybody.
        self._folder = tempfile.mkdtemp(prefix="ray-", dir=_short_folder())
        with _loopback_only():
            self._ray.init(
                address="local",
                include_dashboard=False,
                num_cpus=self._workers or len(os.sched_getaffinity(0)),
                log_to_driver=False,
                logging_level="ERROR",
                configure_logging=True,
                _temp_dir=f"{self._folder}/r",
            )

    def _ask(self, node: Tree) -> Message:
        ray, name = self._ray, node.get("NodeManagerHostname") or node["NodeID"]
        ask = ray.remote(_hello).options(
            num_cpus=1,
            num_gpus=self._gpus,
            max_retries=0,
            scheduling_strategy=self._affinity(node["NodeID"], soft=False),
        )
        try:
            hello = ray.get(ask.remote(self._job), timeout=_HELLO_S)
        except Exception as error:  # noqa: BLE001
            raise ConfigError(
                f"node {name} cannot work: {_first_line(error)}",
                where="--executor",
                accepted="this version of BlinkGL, and the GPUs asked for, on every node",
            ) from None
        if hello["kind"] == "refused":
            raise BlinkGLError(f"node {name}: {hello['error']}")
        return hello

    @staticmethod
    def _affinity(node: str, *, soft: bool):
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        return NodeAffinitySchedulingStrategy(node_id=node, soft=soft)

    def _collect(self, reference: object) -> Message:
        task = self._tasks.pop(reference)
        reason = self._reasons.pop(task, None)
        exceptions = self._ray.exceptions
        try:
            message = self._ray.get(reference)
            if message["kind"] == "refused":
                raise BlinkGLError(message["error"])
            return message
        except BlinkGLError:
            raise
        except exceptions.NodeDiedError as error:
            return _failure(task, f"the node was lost: {_first_line(error)}", lost=True)
        except exceptions.WorkerCrashedError:
            return _failure(task, reason or "the worker was ended")
        except exceptions.RayError as error:
            return _failure(
                task,
                reason or _first_line(error),
                lost=reason is None and "node" in str(error).lower() and "died" in str(error).lower(),
            )

    def _news(self) -> list[Message]:
        try:
            assert self._board is not None
            return self._ray.get(self._board.take.remote(), timeout=2.0)
        except Exception:  # noqa: BLE001 - progress is a courtesy
            return []


class _Board:
    """Latest progress of each worker's task, for the driver's display."""

    def __init__(self) -> None:
        self._latest: dict[int, Message] = {}

    def put(self, message: Message) -> None:
        self._latest[message["task"]] = message

    def take(self) -> list[Message]:
        latest, self._latest = list(self._latest.values()), {}
        return latest


_maker: Maker | None = None  # of this worker process: Ray gives it one task after another


def _open(job: Tree, plugins: list[str]) -> tuple[Maker, Message]:
    global _maker
    import numba
    import ray

    # A task requests one CPU from Ray. numba is already imported here, OpenGL's library is not.
    os.environ.update({k: v for k, v in thread_environment(2, 2).items() if k == "LP_NUM_THREADS"})
    numba.set_num_threads(1)
    if _maker is not None:
        _maker.__exit__()
        _maker = None
    load_plugins(plugins)
    made = Maker(Job(**job), _egl_device(ray.get_gpu_ids()))
    hello = made.open()
    _maker = made
    return made, hello


def _egl_device(gpu_ids: list) -> int | None:
    """Return the EGL device of the GPU that Ray assigned to this task: GPUs have the same order, but EGL also lists
    software devices."""
    if not gpu_ids or not str(gpu_ids[0]).isdigit():
        return None
    cards = [number for number, text in enumerate(egl_devices()) if "software" not in text.lower()]
    return cards[int(gpu_ids[0])] if int(gpu_ids[0]) < len(cards) else None


def _hello(job: tuple[dict[str, object], list[str]]) -> Message:
    try:
        return _open(*job)[1]
    except BlinkGLError as error:
        return {"kind": "refused", "error": str(error)}


def _work(
    job: tuple[dict[str, object], list[str]], task: int, attempt: int, expected: tuple[dict[str, str], str], board: Any
) -> Message:
    try:
        if _maker is None or _maker.job.to_dict() != job[0]:
            _, hello = _open(*job)
            if different := environment_differences(hello["environment"], expected[0]):
                return {
                    "kind": "refused",
                    "error": f"a worker on {socket.gethostname()} differs from the run's first in version or hardware: "
                    f"{different}",
                }
            if hello["assets"] != expected[1]:
                return {"kind": "refused", "error": f"node {socket.gethostname()} finds other meshes or textures"}
    except BlinkGLError as error:
        return {"kind": "refused", "error": str(error)}
    assert _maker is not None
    return _maker.make(task, attempt, board.put.remote)


def _failure(task: int, error: str, lost: bool = False) -> Message:
    return {"kind": "failed", "task": task, "error": error, "final": False, "stop": False, "lost": lost}


def _first_line(error: BaseException) -> str:
    cause = getattr(error, "cause", None) or error
    lines = [line.strip() for line in str(cause).splitlines() if line.strip()]
    return lines[0][:200] if lines else type(error).__name__


def _reachable(address: str) -> None:
    """Raise ConfigError at once, where Ray itself would try for half a minute."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(
            "not an address", where="--address", value=address, accepted="host:port, ray://host:port or auto"
        )
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
    except OSError as error:
        raise ConfigError(
            f"cannot be reached: {error.strerror or error}",
            where="--address",
            value=address,
            accepted="a running Ray cluster",
        ) from None


@contextlib.contextmanager
def _loopback_only() -> Iterator[None]:
    """Make Ray use 127.0.0.1 as this machine's address, so that all its servers bind to it.

    Ray does so on macOS and Windows, where it does not support clusters; it reads the constant behind that when a
    cluster starts. (Ray replaces ``_node_ip_address="127.0.0.1"`` by the external address.)"""
    from ray._private import ray_constants

    before = getattr(ray_constants, "ENABLE_RAY_CLUSTER", None)
    if before is None:
        raise ConfigError(
            "this version of Ray cannot be restricted to this machine",
            where="--executor",
            value="ray",
            accepted="Ray 2.60; or your own cluster with --address",
        )
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


def _short_folder() -> str:
    """Return the folder for temporary files, unless its name is too long for Ray's sockets: Unix allows 107
    characters."""
    folder = tempfile.gettempdir()
    return folder if len(folder) <= 20 else "/tmp"
