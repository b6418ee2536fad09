"""Launchers: where the shards of a command run. Each repeats the command with `--shard K/N`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from gesturekit.cli.options import ARGUMENTS
from gesturekit.errors import ConfigError
from gesturekit.wording import counted

_MINUTES = 24 * 60
_OUTCOMES = (0, 1, 2, 130)  # exit codes of the command line


LAUNCHER_OPTIONS = (
    click.option(
        "--launcher",
        type=click.Choice(["local", "slurm", "ray"]),
        default="local",
        show_default=True,
        help="Where to run the shards: on this machine, as Slurm jobs (submitit), or on a Ray "
        "cluster.",
    ),
    click.option(
        "--jobs", type=click.IntRange(1, 10_000), help="Number of shards for slurm or ray."
    ),
    click.option(
        "--launcher-option",
        "launcher_options",
        multiple=True,
        metavar="KEY=VALUE",
        help="For slurm, a parameter of submitit, such as slurm_partition=cpu, timeout_min=600, "
        "cpus_per_task=4 or cluster=local. May be repeated.",
    ),
    click.option(
        "--address", help="Address of a Ray cluster; by default one is started on this machine."
    ),
)


@dataclass(frozen=True)
class ShardCommand:
    """The command of one shard; all that is handed to another machine.

    What is done is recorded in the output folder, so a job that is started again continues.

    Attributes:
        arguments: those of `gesturekit`.
        folder: working folder, to which relative paths belong.
    """

    arguments: tuple[str, ...]
    folder: str

    def __call__(self, shard: str) -> int:
        """Run the command for a shard such as "1/8", and return its exit code."""
        from gesturekit.cli import main

        os.chdir(self.folder)
        try:
            main([*self.arguments, "--launcher", "local", "--shard", shard])
        except SystemExit as end:
            if end.code in _OUTCOMES:
                return int(end.code)
            raise  # submitit ends a job that is preempted
        return 0

    def checkpoint(self, shard: str) -> Any:
        """Return what submitit starts when the job was preempted: the same."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, shard)


def run_elsewhere(ctx: click.Context, out: Path, options: dict[str, Any]) -> int | None:
    """Pop the options of launchers; run the shards on a cluster and return the exit code.

    Returns:
        None for the local launcher, and for a dry run.

    Raises:
        click.UsageError: options that cannot be combined.
        ConfigError: the launcher is not installed, or a parameter of it is wrong.
    """
    launcher, jobs = options.pop("launcher"), options.pop("jobs")
    settings, address = options.pop("launcher_options"), options.pop("address")
    if launcher == "local":
        if options["shard"] is None and (jobs or settings or address):
            raise click.UsageError("--jobs, --launcher-option and --address require --launcher.")
        return None
    if options["shard"] is not None:
        raise click.UsageError(
            f"--launcher {launcher} creates the shards itself: give --jobs, not --shard."
        )
    if (settings and launcher != "slurm") or (address and launcher != "ray"):
        raise click.UsageError("--launcher-option is for slurm, and --address for ray.")
    if options["dry_run"]:
        return None
    command = ShardCommand((ctx.info_name or "", *ctx.meta[ARGUMENTS]), str(Path.cwd()))
    shards = [f"{number}/{jobs or 1}" for number in range(1, (jobs or 1) + 1)]
    codes = (
        _run_slurm(command, shards, out, settings)
        if launcher == "slurm"
        else _run_ray(command, shards, address)
    )
    click.echo(f"{counted(len(shards), 'shard')}: gesturekit jobs {out} shows the result", err=True)
    return max(codes, key=(0, 2, 1, 130).index)


def _run_slurm(
    command: ShardCommand, shards: Sequence[str], out: Path, settings: Sequence[str]
) -> list[int]:
    """Run each shard as a job of an array, and return the exit codes."""
    try:
        import submitit
    except ImportError:
        raise _missing("slurm") from None
    from gesturekit.jobs.records import state_folder

    values: dict[str, Any] = dict(map(_setting, settings))
    folder = state_folder(out) / "slurm"
    try:
        executor = submitit.AutoExecutor(folder=folder / "%j", cluster=values.pop("cluster", None))
        executor.update_parameters(**{"name": "gesturekit", "timeout_min": _MINUTES, **values})
        jobs = executor.map_array(command, shards)
    except (NameError, RuntimeError, ValueError, AssertionError) as error:
        raise ConfigError(f"slurm: {error}") from None
    click.echo(
        f"Submitted {counted(len(jobs), 'job')}; Ctrl-C stops waiting, but not the jobs.", err=True
    )
    codes = []
    for shard, job in zip(shards, jobs, strict=True):
        try:
            codes.append(job.result())
        except Exception as error:  # whatever ended it on its machine
            last = str(error).strip().splitlines()[-1:]
            click.echo(f"Failed: shard {shard}, job {job.job_id}: {' '.join(last)}", err=True)
            codes.append(1)
    return codes


def _run_ray(command: ShardCommand, shards: Sequence[str], address: str | None) -> list[int]:
    """Run the shards as tasks of a Ray cluster, and return the exit codes."""
    try:
        import ray
    except ImportError:
        raise _missing("ray") from None
    try:
        ray.init(address=address, include_dashboard=False, log_to_driver=False)

        @ray.remote(num_cpus=1, max_retries=-1)
        def run(shard: str) -> int:
            """Run a shard; if its node is lost, Ray starts it again on another one."""
            return command(shard)

        return ray.get([run.remote(shard) for shard in shards])
    except (ConnectionError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
        raise ConfigError(f"ray: {' '.join(str(error).split())}") from None
    finally:
        ray.shutdown()


def _setting(text: str) -> tuple[str, int | str]:
    name, separator, value = text.partition("=")
    if not separator or not name.isidentifier():
        raise click.UsageError(f"--launcher-option {text}: expected KEY=VALUE.")
    return name, int(value) if value.isdecimal() else value


def _missing(extra: str) -> ConfigError:
    return ConfigError(f"not installed; run: pip install 'gesturekit[{extra}]'")
