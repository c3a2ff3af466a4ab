"""The Ray executor: the same bytes as without Ray, also when a worker or a whole node is
lost. Needs the extra [cluster]."""

import os
import signal
import sys
import tempfile
from pathlib import Path

import pytest

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.cluster import RayCluster, _first_line
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import ConfigError
from runs import RECIPE, Listener, assert_same, recipe_file

ray = pytest.importorskip("ray", reason="Ray is not installed (extra [cluster])")
psutil = pytest.importorskip("psutil")  # Ray brings it


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    list(generate_run(load_run(recipe_file(folder, **LONG)), folder / "out"))
    return folder / "out"


# Long enough that a node is lost while it is at work.
LONG = {"time": {"duration": 5.0, "label_rate": 10}, "groups": {"fly": RECIPE["groups"]["fly"]}}


@pytest.fixture
def two_nodes():
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    second = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
    try:
        yield cluster, second
    finally:
        ray.shutdown()
        cluster.shutdown()


def test_a_cluster_of_ones_own_listens_on_the_loopback_alone(tmp_path, monkeypatch):
    short = tempfile.mkdtemp(prefix="b-", dir="/tmp")
    monkeypatch.setattr(tempfile, "tempdir", short)
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    before = dict(os.environ)
    found, modes = [], []

    def scan(name, message):
        """What this process and its descendants listen on."""
        family = [psutil.Process(), *psutil.Process().children(recursive=True)]
        found.extend((p.name(), c) for p in family for c in p.net_connections() if c.status == psutil.CONN_LISTEN)
        modes.extend(oct(p.stat().st_mode & 0o777) for p in Path(tempfile.gettempdir()).glob("ray-*"))

    try:
        outcome = run_dataset(
            load_run(recipe_file(tmp_path, groups={"one": {}})),
            tmp_path / "out",
            RayCluster(1),
            listener=Listener(scan, "done"),
        )
    finally:
        ray.shutdown()
    processes = {name for name, _ in found}
    assert {"gcs_server", "raylet"} <= processes and len(found) >= 5, "or the scan saw nothing"
    assert {c.laddr.ip for _, c in found} <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    assert modes == ["0o700"], "no other user gets at its Unix sockets and logs"
    assert len(outcome.made) == 1 and os.listdir(short) == [], "nothing is left"
    ours = ("RAY_USAGE_STATS_ENABLED", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO")
    assert [os.environ.get(k) for k in ours] == [before.get(k) for k in ours]
    os.rmdir(short)


def test_a_ray_that_cannot_be_told_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.delattr("ray._private.ray_constants.ENABLE_RAY_CLUSTER")
    assert run(["generate", str(recipe_file(tmp_path)), "--out", str(tmp_path / "out"), "--executor", "ray"]) == 2
    assert "this version of Ray cannot be restricted to this machine" in capsys.readouterr().err
    assert not ray.is_initialized() and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_lost_node_leaves_no_trace(reference, tmp_path, two_nodes):
    cluster, second = two_nodes
    at_work = set()

    def lose(name, message):
        at_work.add(name)
        if len(at_work) == 2:  # both nodes are busy
            cluster.remove_node(second, allow_graceful=False)
        return len(at_work) == 2

    display = Listener(lose)
    outcome = run_dataset(load_run(recipe_file(tmp_path, **LONG)), tmp_path / "out", RayCluster(2), listener=display)
    assert display.done and display.errors and not outcome.set_aside
    assert_same(tmp_path / "out", reference)
    assert verify_dataset(tmp_path / "out", deep=1).clean


@pytest.mark.slow
def test_a_killed_worker_leaves_no_trace(reference, tmp_path):
    recipe = load_run(recipe_file(tmp_path, **LONG))

    def kill(name, message):
        log = (tmp_path / "out/.run/logs" / f"{name}.log").read_text()
        os.kill(int(log.split("pid ")[-1].split()[0]), signal.SIGKILL)

    display = Listener(kill)
    try:
        outcome = run_dataset(recipe, tmp_path / "out", RayCluster(2), listener=display)
    finally:
        ray.shutdown()
    assert display.errors == ["the worker was ended"] and len(outcome.made) == 4
    assert_same(tmp_path / "out", reference)


@pytest.mark.parametrize(
    "address, message",
    [
        ("127.0.0.1:1", "--address: cannot be reached: "),
        ("nowhere", "--address: not an address (got 'nowhere'); expected host:port"),
    ],
)
def test_unreachable_address_is_one_line_and_nothing_is_written(tmp_path, capsys, address, message):
    assert (
        run(
            [
                "generate",
                str(recipe_file(tmp_path)),
                "--out",
                str(tmp_path / "out"),
                "--executor",
                "ray",
                "--address",
                address,
            ]
        )
        == 2
    )
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_cluster_of_another_version_is_one_line_and_nothing_is_written(tmp_path, capsys, monkeypatch, two_nodes):
    cluster, _ = two_nodes
    ray.shutdown()
    monkeypatch.setattr(ray, "__version__", "2.0.0")  # what this side says it is when it connects
    assert (
        run(
            [
                "generate",
                str(recipe_file(tmp_path)),
                "--out",
                str(tmp_path / "out"),
                "--executor",
                "ray",
                "--address",
                cluster.address,
            ]
        )
        == 2
    )
    error = capsys.readouterr().err
    assert "--address: Ray's or Python's version differs from the cluster's: " in error and "2.0.0" in error
    assert error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_without_ray_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"Ray is not installed .*pip install ray"):
        RayCluster(2)
    assert _first_line(RuntimeError("\n\na\nb")) == "a"
