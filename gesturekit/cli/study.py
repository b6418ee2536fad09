"""gesturekit study: build a user study as a web page, plan its size, analyse its answers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from gesturekit.cli.options import FILE, FOLDER, PATH, SEED, existing_option, is_left
from gesturekit.wording import counted

if TYPE_CHECKING:
    from gesturekit.study.analysis import StudyResult


@click.group(
    "study",
    epilog="Example: gesturekit study build study.yaml --out study\n\n"
    "Example: gesturekit study power --win-rate 0.6 --systems 3\n\n"
    "Example: gesturekit study analyse answers/*.csv --out report.html",
)
def command() -> None:
    """Ask people: build a user study, plan its size, analyse its answers (docs/study.md)."""


@command.command("build", epilog="Example: gesturekit study build study.yaml --out study")
@click.argument("config", type=PATH)
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option(
    "-o", "--out", type=FOLDER, default=Path("study"), help="Folder for index.html and its clips."
)
@click.option(
    "--show", is_flag=True, help="Print every setting with its value and description, and exit."
)
@existing_option("refuse")
def build(config: Path, overrides: tuple[str, ...], out: Path, show: bool, existing: str) -> None:
    """Build the static page of a user study from CONFIG, a YAML file.

    The page needs no server: open index.html from disk, or upload the folder to any web host.
    """
    if config.is_dir():
        name = click.format_filename(config)
        raise click.UsageError(
            f"{name}: a folder; CONFIG is a YAML file with a title, the folder of each system "
            f"(systems: {{ours: {name}, other: FOLDER}}) and of the wavs (audio: FOLDER); "
            "docs/study.md has an example"
        )
    from gesturekit.study import build_study
    from gesturekit.study.config import load_study_config

    settings = load_study_config(config, overrides)
    if show:
        from gesturekit.training.config import list_settings

        for setting in list_settings(settings):
            click.echo(f"{setting.name}: {setting.value}\n    {setting.doc}")
        return
    if is_left([out / "index.html"], existing):
        return
    built = build_study(settings, out)
    click.echo(
        f"{click.format_filename(built.page)}: {counted(built.trials, 'comparison')} per rater, "
        f"{counted(built.segments, 'segment')}, {counted(built.clips, 'clip')}, "
        f"{counted(settings.lists, 'list')}; page {built.page_bytes / 1e6:.1f} MB without clips"
    )


@command.command("power", epilog="Example: gesturekit study power --win-rate 0.6 --systems 3")
@click.option(
    "--win-rate",
    default=0.6,
    help="Expected share of preferences for the better system, ties excluded.",
)
@click.option("--ties", default=0.2, help="Expected share of ties.")
@click.option(
    "--clear", default=0.4, help="Expected share of preferences that are clear rather than slight."
)
@click.option(
    "--rater-share",
    default=0.05,
    help="Expected share of raters in the variance of answers (intraclass correlation).",
)
@click.option(
    "--clip-share",
    default=0.1,
    help="Expected share of clips in it: measured on 18,000 ratings of a challenge, 0.1 for "
    "human-likeness and 0.17 for appropriateness.",
)
@click.option(
    "--clips", type=click.IntRange(min=2), default=60, help="Speech segments of the study."
)
@click.option(
    "--systems",
    type=click.IntRange(min=2),
    default=2,
    help="Systems in the study; all pairs are tested, adjusted by Holm's method.",
)
@click.option("--power", default=0.8, help="Statistical power to reach.")
def power(
    win_rate: float,
    ties: float,
    clear: float,
    rater_share: float,
    clip_share: float,
    clips: int,
    systems: int,
    power: float,
) -> None:
    """Print how many raters and comparisons are needed to detect a difference by `study
    analyse`."""
    from gesturekit.study.power import Expected, clips_needed, raters_needed

    expected = Expected(win_rate, ties, clear, rater_share, clip_share)
    pairs = systems * (systems - 1) // 2
    needed = {
        n: raters_needed(expected, n, clips, pairs, power)
        for n in (1, 2, 3, 6, 12, 24) if n <= clips
    }  # fmt: skip
    click.echo(
        f"To find a win rate of {win_rate:.0%} with {ties:.0%} ties at p < .05 with a power of "
        f"{power:.0%}\n({counted(systems, 'system')}, {counted(pairs, 'pair')} of systems, "
        f"Holm's method; {counted(clips, 'segment')}; share of raters {rater_share:g}, of clips "
        f"{clip_share:g}):\n"
    )
    click.echo("comparisons a rater   of each pair   raters   answers in all")
    for answers, raters in needed.items():
        total = f"{raters * answers * pairs:,}" if raters else "-"
        click.echo(f"{answers * pairs:>19}   {answers:>12}   {raters or '-':>6}   {total:>14}")
    click.echo("\nRaters are those who pass the attention checks: recruit about 10 % more.")
    least = clips_needed(expected, 1, pairs, power)
    if least is None or least > clips:
        click.echo(
            f"With {counted(clips, 'segment')} no number of raters is enough (-), as findings "
            f"are to hold for other segments too: take more than {least or 10_000:,} (--clips)."
        )


@command.command(
    "analyse", epilog="Example: gesturekit study analyse answers/*.csv --out report.html"
)
@click.argument("answers", nargs=-1, required=True, type=PATH, metavar="CSV...")
@click.option(
    "-o", "--out", type=FILE, metavar="HTML", help="Write a report with tables and plots."
)
@click.option("--json", "json_out", type=FILE, help="Write all results as JSON.")
@click.option(
    "--failed-checks",
    type=click.IntRange(min=0),
    default=1,
    help="Exclude raters who failed this many attention checks; 0 excludes nobody.",
)
@click.option(
    "--rounds",
    type=click.IntRange(min=1, max=1_000_000),
    default=10_000,
    help="Rounds of the bootstrap over raters and clips.",
)
@click.option("--seed", type=SEED, default=0, help="Seed of the bootstrap.")
@existing_option("refuse")
def analyse(
    answers: tuple[Path, ...],
    out: Path | None,
    json_out: Path | None,
    failed_checks: int,
    rounds: int,
    seed: int,
    existing: str,
) -> None:
    """Analyse answers: CSV files from study pages or from GENEA, or folders of them."""
    from gesturekit.evaluation import read_answers
    from gesturekit.study import analyse_study, write_study_report

    files = [path for path in (out, json_out) if path is not None]
    if files and is_left(files, existing):
        return
    result = analyse_study(
        read_answers(answers, failed_checks=failed_checks or None), rounds=rounds, seed=seed
    )
    # First: the reader of a pipe may leave before everything is printed.
    if out is not None:
        write_study_report(result, out)
    if json_out is not None:
        from gesturekit.study.report import write_json

        write_json(result, json_out)
    _print(result)
    for path in files:
        click.echo(path, err=True)


def _print(result: StudyResult) -> None:
    from gesturekit.study.report import conclusions, reservations
    from gesturekit.wording import printable

    for line in conclusions(result):
        click.echo(printable(line))
    for line in reservations(result):
        click.echo(printable(f"Note: {line}"), err=True)
