"""Launchers: the shards of a rendering as jobs; the same files, whatever happens to a job."""

import re
import sys
from functools import partial
from types import ModuleType, SimpleNamespace

import pytest
from click.testing import CliRunner
from outputs import results

from gesturekit.cli import cli
from gesturekit.jobs.records import status_of


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


@pytest.mark.stress
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
        (["--launcher", "slurm", "--shard", "1/2"], "--shard"),
        (["--jobs", "2"], "--launcher"),
        (["--launcher", "ray", "--launcher-option", "a=b"], "slurm"),
        (["--launcher", "slurm", "--address", "x"], "--address"),
    ],
)
def test_options_that_do_not_fit_are_refused(render, tmp_path, options, says):
    refused = render("out", *options)
    assert (refused.exit_code, says in refused.output) == (2, True), refused.output
    assert not (tmp_path / "out").exists()


class LocalRay(ModuleType):
    """A cluster of ray in this process; one of lost nodes raises its error."""

    def __init__(self, *, is_lost: bool = False) -> None:
        super().__init__("ray")
        self.is_lost, self.is_running, self.options = is_lost, False, {}
        self.exceptions = SimpleNamespace(RayError=type("RayError", (Exception,), {}))

    def init(self, address=None, **options) -> None:
        if address == "nowhere":
            raise ConnectionError("no cluster at nowhere")
        self.is_running = True

    def shutdown(self) -> None:
        self.is_running = False

    def remote(self, **options):
        self.options = options
        return lambda function: SimpleNamespace(remote=partial(partial, function))

    def get(self, calls):
        if self.is_lost:
            raise self.exceptions.RayError("all nodes are lost")
        return [call() for call in calls]


def test_ray_makes_the_same_files(render, tmp_path, monkeypatch):
    ray = LocalRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    done = render("out", "--launcher", "ray", "--jobs", "3")
    assert done.exit_code == 0, done.output
    assert len(results(tmp_path / "out")) == 3 and not ray.is_running
    assert [n for n, _ in status_of(tmp_path / "out").shards] == [1, 1, 1]
    assert ray.options["max_retries"] == -1, "a shard of a lost node starts again"


def test_a_cluster_that_is_lost_or_absent_is_one_line(render, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", LocalRay(is_lost=True))
    lost = render("out", "--launcher", "ray", "--jobs", "3")
    assert lost.exit_code != 0 and "nodes" in str(lost.exception)
    absent = render("out", "--launcher", "ray", "--address", "nowhere")
    assert "nowhere" in str(absent.exception)
    monkeypatch.setitem(sys.modules, "ray", None)
    missing = render("out", "--launcher", "ray")
    assert "gesturekit[ray]" in str(missing.exception)
    monkeypatch.setitem(sys.modules, "submitit", None)
    missing = render("out", "--launcher", "slurm")
    assert "gesturekit[slurm]" in str(missing.exception)


class Slurm(ModuleType):
    """submitit on a cluster that ends each job by a given exit code, or an error."""

    def __init__(self, *outcomes: int | Exception) -> None:
        super().__init__("submitit")
        self.outcomes, self.parameters, self.shards = list(outcomes), {}, []

    def AutoExecutor(self, **place):  # noqa: N802
        self.place = place
        return self

    def update_parameters(self, **parameters) -> None:
        if "wrong" in parameters:
            raise NameError("Unknown argument 'wrong'")
        self.parameters = parameters

    def map_array(self, command, shards):
        self.shards = [(command, shard) for shard in shards]
        return [SimpleNamespace(job_id=71 + k, result=self.result) for k in range(len(shards))]

    def result(self) -> int:
        outcome = self.outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


@pytest.mark.parametrize(
    ("outcomes", "code"),
    [((2, 1), 1), ((130, 1), 130), ((RuntimeError("trace\nout of memory\n"), 2), 1)],
)
def test_the_worst_job_gives_the_exit_code(gesturekit, tmp_path, monkeypatch, outcomes, code):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "submitit", slurm := Slurm(*outcomes))
    jobs = ("--launcher", "slurm", "--jobs", 2, "--launcher-option", "slurm_partition=cpu")
    done = gesturekit("render", "speech", "--model", "demo", "--out", "out", *jobs)
    assert done.status == code and "2 jobs" in done.err
    failed = re.search(r"(?=.*1/2)(?=.*\b71\b)(?=.*out of memory)", done.err)
    assert (failed is not None) == isinstance(outcomes[0], Exception)
    assert [shard for _, shard in slurm.shards] == ["1/2", "2/2"]
    assert slurm.parameters["slurm_partition"] == "cpu"
    assert slurm.parameters["timeout_min"] > 60
    (arguments,) = {command.arguments for command, _ in slurm.shards}
    assert arguments[:2] == ("render", "speech")
    assert {command.folder for command, _ in slurm.shards} == {str(tmp_path)}


@pytest.mark.parametrize("command", ["convert in out --format npz", "features in --out out"])
def test_other_commands_are_repeated_elsewhere_and_do_nothing_here(
    gesturekit, tmp_path, monkeypatch, command
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "submitit", slurm := Slurm(0, 1))
    jobs = ("--launcher", "slurm", "--jobs", 2)
    done = gesturekit(*command.split(), *jobs)
    assert done.status == 1 and "gesturekit jobs out" in done.err
    (arguments,) = {shard.arguments for shard, _ in slurm.shards}
    assert list(arguments[:3]) == command.split()[:3] and not (tmp_path / "in").exists()


def test_options_of_the_launcher_replace_the_usual_ones(gesturekit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "submitit", slurm := Slurm(0))
    command = ("render", "speech", "--model", "demo", "--out", "out", "--launcher", "slurm")
    command += ("--launcher-option",)
    gesturekit(*command, "timeout_min=60", "--launcher-option", "cluster=debug").ok()
    assert slurm.parameters["timeout_min"] == 60
    assert slurm.place["cluster"] == "debug" and len(slurm.shards) == 1, "one job without --jobs"
    gesturekit(*command, "wrong=1").fails(2, "slurm", "'wrong'")
    gesturekit(*command, "a b=1").fails(2, "a b=1", "KEY=VALUE")
