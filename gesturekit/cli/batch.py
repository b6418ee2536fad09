"""Options and output of commands that work on many files, and where their shards run.

A launcher repeats the command elsewhere, with `--shard K/N`.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import ARGUMENTS, resumable, together, workers_option
from gesturekit.errors import ConfigError
from gesturekit.wording import counted

if TYPE_CHECKING:
    from gesturekit.conversion import Conversion
    from gesturekit.jobs.batch import Batch, Execution
    from gesturekit.jobs.result import Result

GROUPS = {
    "Many files": ("workers", "shard", "deadline", "retry_failed", "dry_run"),
    "Clusters": ("launcher", "jobs", "launcher_options", "address"),
}
"""Groups of the options of `batch_options` in the help."""
_MINUTES = 24 * 60
_OUTCOMES = (0, 1, 2, 130)  # exit codes of the command line


def _shard(text: str) -> tuple[int, int]:
    """Parse --shard: 1/8 to (1, 8)."""
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text, re.ASCII)
    if match is None:
        raise click.UsageError(f"--shard {text!r}: expected two numbers, such as 1/8 or 8/8")
    return int(match[1]), int(match[2])


batch_options = together(
    workers_option,
    click.option("--shard", metavar="K/N", help="Process part K of N, such as 1/8."),
    click.option(
        "--launcher",
        type=click.Choice(["local", "slurm", "ray"]),
        default="local",
        help="Where shards run: on this machine, as Slurm jobs (submitit), or on a Ray cluster.",
    ),
    click.option("--jobs", type=click.IntRange(1, 10_000), help="Shards for slurm or ray."),
    click.option(
        *("--launcher-option", "launcher_options"),
        multiple=True,
        metavar="KEY=VALUE",
        help="Parameter of submitit, such as slurm_partition=cpu. May be repeated.",
    ),
    click.option("--address", help="Address of a Ray cluster; by default one is started here."),
    click.option(
        "--deadline",
        type=click.FloatRange(min=0, min_open=True),
        metavar="SECONDS",
        help="Abandon an input after this time.",
    ),
    click.option("--retry-failed", is_flag=True, help="Retry inputs that failed three times."),
    click.option("--dry-run", is_flag=True, help="Write nothing; print what would be done."),
)
"""Options of `pop_execution`."""


def pop_execution(ctx: click.Context, out: Path, options: dict[str, Any]) -> tuple[Execution, bool]:
    """Pop the `batch_options` from all options; with a launcher, do the work there and exit.

    Returns:
        how the work is done, and whether that is only a dry run.
    """
    _run_elsewhere(ctx, out, options)
    from gesturekit.jobs.batch import Execution

    shard = _shard(options.pop("shard") or "1/1")
    names = ("workers", "deadline", "retry_failed")
    execution = Execution(shard=shard, **{name: options.pop(name) for name in names})
    return execution, options.pop("dry_run")


def show(
    work: Batch | Conversion,
    description: str,
    add: Callable[[Result], str | None],
    summary: Callable[[], str] | None = None,
) -> int:
    """Do work with a progress bar, and return how many inputs failed; a full disk counts as one.

    Args:
        work: what to do.
        description: name of the bar.
        add: called with each result, to print it; it may return a text for the bar.
        summary: returns what was done so far, for the message of Ctrl-C; without it, the number
            that failed is printed at the end.
    """
    from tqdm.contrib.logging import logging_redirect_tqdm

    from gesturekit.errors import OutputError
    from gesturekit.progress import Progress

    errors: list[str | None] = []
    done = summary or (lambda: f"{len(errors)} done")
    try:
        with (
            resumable(lambda: f"{done()}; the same command continues"),
            logging_redirect_tqdm(tqdm_class=Progress),
            Progress(total=len(work.tasks), desc=description, unit="file") as bar,
        ):
            for result in work.run():
                errors.append(result.error)
                with Progress.external_write_mode():
                    text = add(result)
                if text is not None:
                    bar.set_postfix_str(text, refresh=False)
                bar.update()
    except OutputError as error:
        click.echo(f"Error: {error}", err=True)
        errors.append(str(error))
    failed = len(errors) - errors.count(None)
    if summary is None and failed and len(errors) > 1:
        click.echo(f"{failed} of {len(errors)} failed.", err=True)
    return failed


def print_preview(batch: Batch) -> None:
    """Print what would be done about each sound of a batch, and the sums."""
    from gesturekit.progress import time_in_words
    from gesturekit.rendering.renderer import estimated_cost, preview
    from gesturekit.wording import listed

    words = {"left": "make", "kept": "keep", "failed": "fail"}
    counts, sound = dict.fromkeys(words.values(), 0), 0.0
    for result, length in preview(batch):
        action = words[result.status]
        where = result.error or listed(
            [str(path) for path in batch.processor.targets(result.task)], 4
        )
        shown = "      ? s" if length is None else f"{length:7.1f} s"
        click.echo(f"{action}  {shown}  {click.format_filename(result.source)} -> {where}")
        counts[action] += 1
        sound += (length or 0.0) if action == "make" else 0.0
    seconds, size = estimated_cost(batch, counts["make"], sound)
    took = time_in_words(seconds / batch.execution.workers)
    parts = ", ".join(f"{count} to {action}" for action, count in counts.items())
    parts += f"; {time_in_words(sound)} of sound, about {size / 1e6:.1f} MB and {took}"
    parts += f" with {batch.execution.workers} of --workers, besides loading: {batch.out}"
    click.echo(f"{parts} (dry run: nothing was written, and only headers were read)", err=True)


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


def _run_elsewhere(ctx: click.Context, out: Path, options: dict[str, Any]) -> None:
    """Pop the options of launchers; run the shards on a cluster and exit, if that is asked for.

    Raises:
        click.UsageError: options that cannot be combined.
        ConfigError: the launcher is not installed, or a parameter of it is wrong.
    """
    launcher, jobs = options.pop("launcher"), options.pop("jobs")
    settings, address = options.pop("launcher_options"), options.pop("address")
    if launcher == "local":
        if options["shard"] is None and (jobs or settings or address):
            raise click.UsageError("--jobs, --launcher-option and --address require --launcher.")
        return
    if options["shard"] is not None:
        raise click.UsageError(f"--launcher {launcher} makes the shards: give --jobs, not --shard.")
    if (settings and launcher != "slurm") or (address and launcher != "ray"):
        raise click.UsageError("--launcher-option is for slurm, and --address for ray.")
    if options["dry_run"]:
        return
    command = ShardCommand((ctx.info_name or "", *ctx.meta[ARGUMENTS]), str(Path.cwd()))
    shards = [f"{number}/{jobs or 1}" for number in range(1, (jobs or 1) + 1)]
    codes = (
        _run_slurm(command, shards, out, settings)
        if launcher == "slurm"
        else _run_ray(command, shards, address)
    )
    click.echo(f"{counted(len(shards), 'shard')}: gesturekit jobs {out} shows the result", err=True)
    ctx.exit(max(codes, key=(0, 2, 1, 130).index))


def _run_slurm(
    command: ShardCommand, shards: Sequence[str], out: Path, settings: Sequence[str]
) -> list[int]:
    """Run each shard as a job of an array, and return the exit codes."""
    from gesturekit.jobs.records import state_folder

    submitit = _imported("submitit", "slurm")
    values: dict[str, Any] = dict(map(_setting, settings))
    folder = state_folder(out) / "slurm"
    try:
        executor = submitit.AutoExecutor(folder=folder / "%j", cluster=values.pop("cluster", None))
        executor.update_parameters(**{"name": "gesturekit", "timeout_min": _MINUTES, **values})
        jobs = executor.map_array(command, shards)
    except (NameError, RuntimeError, ValueError, AssertionError) as error:
        raise ConfigError(f"slurm: {error}") from None
    submitted = f"Submitted {counted(len(jobs), 'job')}"
    click.echo(f"{submitted}; Ctrl-C stops waiting, but not the jobs.", err=True)
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
    ray = _imported("ray", "ray")
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


def _imported(name: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ConfigError(f"not installed; run: pip install 'gesturekit[{extra}]'") from None
