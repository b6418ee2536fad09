"""Launchers: the shards of a rendering as jobs; the same files, whatever happens to a job."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from outputs import finished, results

from gesturekit.cli import cli
from gesturekit.cli.launchers import ShardCommand
from gesturekit.jobs.status import status_of


@pytest.fixture
def render(tmp_path, write_speech, monkeypatch):
    """render(out, *options, files=3): a folder of sounds by the demo model; the click result."""
    monkeypatch.chdir(tmp_path)

    def run(out: str, *options: str, files: int = 3):
        for number in range(files):
            write_speech(tmp_path / "speech" / f"{number}.wav", 0.5 + 0.25 * (number % 3))
        arguments = ["render", "speech", "--model", "demo", "--out", out, *options]
        return CliRunner().invoke(cli, arguments)

    return run


def test_slurm_makes_the_same_files(render, tmp_path):
    pytest.importorskip("submitit")
    assert render("plain").exit_code == 0
    jobs = ("--launcher", "slurm", "--jobs", "2", "--launcher-option", "cluster=debug")
    done = render("sharded", *jobs)
    assert done.exit_code == 0, done.output
    assert results(tmp_path / "sharded") == results(tmp_path / "plain")
    assert len(results(tmp_path / "plain")) == 3
    assert sorted(n for n, _ in status_of(tmp_path / "sharded").shards) == [1, 2]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--launcher", "slurm", "--shard", "1/2"], "give --jobs, not --shard"),
        (["--jobs", "2"], "require --launcher"),
        (["--launcher", "ray", "--launcher-option", "a=b"], "--launcher-option is for slurm"),
        (["--launcher", "slurm", "--address", "x"], "--address for ray"),
        (["--launcher", "slurm", "--launcher-option", "partition"], "expected KEY=VALUE"),
    ],
)
def test_options_that_do_not_fit_are_refused(render, tmp_path, options, says):
    refused = render("out", *options)
    assert (refused.exit_code, says in refused.output) == (2, True), refused.output
    assert not (tmp_path / "out").exists()


def child_of(parent: int) -> int:
    """Process id of the only child of a process."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it ended
            continue
        if int(fields[1]) == parent:
            return int(path.parent.name)
    raise AssertionError(f"process {parent} has no child")


@pytest.mark.stress
def test_a_job_that_is_preempted_is_requeued_and_goes_on(render, tmp_path):
    submitit = pytest.importorskip("submitit")
    assert render("plain", files=40).exit_code == 0
    executor = submitit.LocalExecutor(tmp_path / "jobs")
    arguments = ("render", "speech", "--model", "demo", "--out", "out")
    job = executor.submit(ShardCommand(arguments, str(tmp_path)), "1/1")
    out = tmp_path / "out"
    for _ in range(1200):
        if len(results(out)) >= 3:
            break
        time.sleep(0.05)
    os.kill(child_of(job._process.pid), signal.SIGUSR2)  # as Slurm does before it ends a job
    assert job.result() == 0
    assert "Caught signal SIGUSR2" in job.stderr() and " kept in " in job.stderr()
    assert results(out) == results(tmp_path / "plain")
    assert sorted(one["id"] for one in finished(out)) == sorted(str(number) for number in range(40))


@pytest.mark.stress
def test_shards_of_a_lost_ray_node_are_run_again(render, tmp_path, monkeypatch):
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    assert render("plain", files=40).exit_code == 0
    root = str(Path(__file__).resolve().parents[2])
    monkeypatch.setenv("PYTHONPATH", root)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    second = cluster.add_node(num_cpus=1)
    try:
        import threading

        out = tmp_path / "out"

        def lose() -> None:
            while len(results(out)) < 4:
                time.sleep(0.05)
            cluster.remove_node(second, allow_graceful=False)

        thread = threading.Thread(target=lose, daemon=True)
        thread.start()
        jobs = ("--launcher", "ray", "--jobs", "4", "--address", cluster.address)
        done = render("out", *jobs, files=40)
        thread.join(60)
        assert done.exit_code == 0, done.output
        assert "was lost with its node" in done.output
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert results(out) == results(tmp_path / "plain")
    assert sorted(one["id"] for one in finished(out)) == sorted(str(number) for number in range(40))
