"""gesturekit evaluate: metrics of generated motion, as a table and a report."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from gesturekit.cli.evaluate_inputs import (
    folders_of,
    place_of,
    recordings_of,
    rendered_baselines,
    sampling_options,
    trained_on,
)
from gesturekit.cli.options import (
    FILE,
    FOLDER,
    PATH,
    SEED,
    GroupedCommand,
    body_option,
    comma_separated,
    existing_option,
    is_left,
    recording_options,
    resumable,
    take_option,
    weights_option,
)

if TYPE_CHECKING:
    from gesturekit.evaluation import Evaluation, Items

_FORMS = ("csv", "markdown", "latex", "json", "html")
"""Options that name a file to write."""
_VARIANTS = ("variant", "threshold", "bas", "kinetic")
_USED_BY_SANITY = ("sanity", "audio", "html", "json", *_VARIANTS, "seed", "workers")
"""Options of `gesturekit evaluate` that --sanity takes."""


def _choice(flag: str, *names: str, help: str) -> Callable[..., Any]:
    """Add an option with one of some values, of which the first is the default."""
    kind = click.Choice(names)
    return click.option(flag, type=kind, default=names[0], help=help)


@click.command(
    "evaluate",
    cls=GroupedCommand,
    groups={},
    epilog="gesturekit evaluate rendered recordings --audio recordings --out report.html "
    "--compare rendered_without_film --compare other=baseline/rendered",
)
@click.argument("generated")
@click.argument("reference", type=PATH, required=False)
@click.argument("surplus", nargs=-1, metavar="")
@click.option(
    "--compare",
    multiple=True,
    metavar="[NAME=]DIR",
    help="Compare with another model: its folder of motion, named in the report by NAME. May be "
    "repeated.",
)
@click.option(
    "--baseline",
    metavar="NAMES",
    help="Compare with baselines, comma-separated: mean_pose (the recordings' mean pose, held "
    "still), other_utterance (the recording of another utterance), retrieval (recorded bodies, in "
    "pieces chosen by a drawn state of movement; with --corpus), speech_blind (GENERATED's model "
    "with the speech of another recording; with --corpus).",
)
@click.option(
    "--corpus",
    type=PATH,
    metavar="CORPUS.jsonl",
    help="Compare with the items of a manifest instead of REFERENCE and --audio.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Split of --corpus to use.  [default: test; train with --protocol multires]",
)
@click.option("--audio", type=PATH, help="Sound of the recordings.")
@click.option("--semantic", type=PATH, help="Semantic tracks for SRGR: npz, or BEAT's tables.")
@click.option(
    "--features",
    type=PATH,
    help="Feature extractor for FGD: the folder of gesturekit fit-features, or BEAT2's weight file "
    "(AESKConv_240_100.bin) for motion on the SMPL-X rig.",
)
@click.option(
    "--study",
    type=PATH,
    metavar="CSV",
    help="Results of a user study on these models (a file or a folder): ratings, with the columns "
    "rater, system, clip, question, value, or votes in the format of gesturekit study. Shows how "
    "well each metric agrees with people's ranking of the models.",
)
@take_option("Intervals and tests are over takes.")
@click.option("-o", "--out", "html", type=FILE, help="Write an HTML report.")
@click.option("--json", type=FILE, help="Write all results as JSON.")
@click.option("--against", type=FILE, help="Print the differences from an earlier --json file.")
@click.option("--csv", type=FILE, help="Write the table of all metrics as CSV.")
@click.option("--markdown", type=FILE, help="Write the table in Markdown.")
@click.option("--latex", type=FILE, help="Write the table in LaTeX (booktabs).")
@click.option(
    "--protocol",
    type=click.Choice(["multires", "lda"]),
    help="Evaluation of one of the papers. multires: patch metrics of each training sequence, 200 "
    "samples of twice its length. lda: Fréchet distances of 10 s windows, 3 samples each, against "
    "all of REFERENCE or of --corpus. With a protocol, GENERATED and --compare may be model "
    "folders: motion is sampled first, each recording in its own style; models with styles need "
    "--corpus, which states them. All controls of gesturekit render but --fps apply, such as "
    "--guidance; --raw is the default, and --no-raw samples as render does.",
)
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    help="Number of samples from a model folder.  [default: that of the protocol]",
)
@click.option(
    "--samples-dir",
    type=FOLDER,
    default=Path("evaluation_samples"),
    help="Folder for motion sampled from model folders.",
)
@weights_option
@_choice("--variant", "ganimator", "paper", help="Definition of the patch metrics.")
@click.option(
    "--threshold",
    type=click.FloatRange(min=0, min_open=True),
    help="Coverage threshold: largest distance at which a patch counts as covered.  [default: "
    "2.0; none for paper]",
)
@_choice(
    "--bas",
    "seconds",
    "bailando",
    help="Definition of beat alignment (BAS). seconds: speed low-passed at 6 Hz, beats between "
    "frames, the same at any frame rate. bailando: frame differences, beats on frames, kernels of "
    "5 and 3 frames at any rate, as in the code of the papers.",
)
@_choice(
    "--kinetic",
    "corrected",
    "released",
    help="Kinetic features of FID_k and Div_k. released: as in the code of the papers, with its "
    "slip in the acceleration, which published values contain.",
)
@click.option(
    "--sanity",
    is_flag=True,
    help="GENERATED is a folder of recordings (with their sound, or --audio): evaluate known-bad "
    "motion made from them, and print which of it each metric detects.",
)
@click.option("--seed", type=SEED, default=0, help="Seed of samples, intervals.")
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Number of processes; does not change the results.  [default: number of cores]",
)
@body_option
@existing_option("replace", note="; samples of an earlier run are only skipped or refused")
@recording_options
@sampling_options
@click.pass_context
def command(
    ctx: click.Context,
    generated: str,
    reference: Path | None,
    surplus: tuple[str, ...],
    compare: tuple[str, ...],
    **options: Any,
) -> None:
    """Measure generated motion (GENERATED: folder or file, npz or BVH) against recordings.

    Clips are matched with recordings by name; STEM_s1, STEM_s2 ... are samples for STEM. GENERATED
    may also be NAME=DIR. Without --audio, speech metrics are left out. Prints a verdict in words
    and a table; --out and --json write all results. Measurements are cached by content (see
    gesturekit cache), so that a rerun only measures new clips. To evaluate on held-out recordings:

    \b
    gesturekit render --corpus corpus.jsonl --split test --model M --out rendered
    gesturekit evaluate rendered --corpus corpus.jsonl --split test

    --in-unit and similar options set how REFERENCE is read; a manifest stores its own.

    Exit codes: 0 every clip was measured; 1 some were left out, as listed; 2 nothing could be
    measured. With --corpus, clips of other splits and of items without motion do not count as left
    out: a note lists them.
    """
    if options["sanity"]:
        ctx.exit(_sanity(ctx, (generated, reference, *surplus, *compare), options))
    _refuse_surplus(reference, surplus, options["corpus"])
    from gesturekit.evaluation import read_ratings
    from gesturekit.evaluation.report import text
    from gesturekit.evaluation.results import read_results
    from gesturekit.evaluation.statistics.agreement import agreement, shared_systems

    recordings = recordings_of(reference, options)
    names, baselines = (generated, *compare), comma_separated(options["baseline"])
    files = _files(options)
    before = None if options["against"] is None else read_results(options["against"])
    ratings = None if options["study"] is None else read_ratings([options["study"]])
    folders = folders_of(names, recordings, options)
    temporary = Path(ctx.with_resource(tempfile.TemporaryDirectory(prefix="gesturekit-")))
    folders |= rendered_baselines(Path(place_of(generated)), folders, temporary, options)
    if ratings is not None:
        shared_systems([*folders, *baselines], ratings)  # before hours of measuring
    found = _evaluated(folders, recordings, options)
    if ratings is not None:
        found.agreement = agreement(found.models, ratings, options["seed"])
    _mark_trained(found, names)
    # First: the reader of a pipe, such as head, may leave before everything is printed.
    line = shlex.join(["gesturekit", *sys.argv[1:]])
    _write(found, files, command=line, body=options["body"])
    _echo(text.report_lines(found))
    _echo(text.note_lines(found), err=True)
    _echo(() if before is None else text.differences(found, before))
    _echo(f"written  {path}" for path in files.values())
    click.echo(text.summary_line(found, files.get("html") or files.get("json")))
    ctx.exit(0 if found.is_complete else 1)


def _echo(lines: Iterable[str], *, err: bool = False) -> None:
    for line in lines:
        click.echo(line, err=err)


def _mark_trained(found: Evaluation, names: Sequence[str]) -> None:
    """Mark models that were trained on recordings of their evaluation, and print a warning."""
    for model, name in zip(found.models, map(place_of, names)):
        if warning := trained_on(model, name):
            click.echo(f"Warning: {model.label}: {warning}", err=True)
            model.notes.append(warning)
            model.marks.append("trained on these")


def _files(options: Mapping[str, Any]) -> dict[str, Path]:
    """Return {form: file} of the files that are to be written.

    Raises:
        UsageError: one cannot be written; raised before hours of measuring.
    """
    html, files = options["html"], {}
    if html is not None and html.suffix.lower() not in (".html", ".htm"):
        raise click.UsageError(f"--out {html}: the report is HTML: name it .html (--json for data)")
    for form in _FORMS:
        path = options[form]
        if path is None or is_left([path], options["existing"]):
            continue
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path.parent):
                files[form] = path
        except OSError as error:
            raise click.UsageError(f"{path} cannot be written: {error.strerror}") from None
    return files


def _write(found: Evaluation, files: Mapping[str, Path], **page: str | None) -> None:
    """Write files by their forms; `page` are keywords of `write_report`."""
    from audio_features.atomic import write_text
    from gesturekit.evaluation import write_report
    from gesturekit.evaluation.report.text import WRITERS

    for form, path in files.items():
        if form == "html":
            write_report(found, path, **page)
        else:
            write_text(path, WRITERS[form](found))


def _refuse_surplus(reference: Path | None, surplus: Sequence[str], corpus: Path | None) -> None:
    """Refuse positional arguments after GENERATED and REFERENCE.

    Raises:
        UsageError: there are some.
    """
    if corpus is not None and reference is not None:
        surplus = (str(reference), *surplus)
    if surplus:
        raise click.UsageError(
            f"unexpected argument {surplus[0]}: give each model to compare with its own --compare, "
            f"such as {' '.join(f'--compare {shlex.quote(name)}' for name in surplus)}"
        )


def _evaluated(
    folders: dict[str, Path], recordings: Path | Items, options: Mapping[str, Any]
) -> Evaluation:
    """Run the evaluation with the options of the command line."""
    from gesturekit.evaluation import evaluate, load_extractor

    features = options["features"]
    with resumable(lambda: "What is measured is cached: the same command continues."):
        return evaluate(
            folders,
            recordings,
            **{name: options[name] for name in ("audio", "semantic", "take_pattern", "take_table")},
            protocol=options["protocol"] or "",
            baselines=comma_separated(options["baseline"]),
            features=None if features is None else load_extractor(features),
            **_measuring(options, "recording"),
        )


def _measuring(options: Mapping[str, Any], unit: str) -> dict[str, Any]:
    """Return the options of `evaluate` that say how to measure; `unit` is that of the progress."""
    from gesturekit.evaluation import Variants
    from gesturekit.progress import Progress

    return {
        "variants": Variants(*(options[name] for name in _VARIANTS)),
        "seed": options["seed"],
        "workers": options["workers"] or os.cpu_count() or 1,
        "progress": lambda portions, total, label: Progress(
            portions, total=total, desc=label, unit=unit
        ),
    }


def _sanity(ctx: click.Context, names: Sequence[object], options: Mapping[str, Any]) -> int:
    """Evaluate known-bad motion made from recordings, print the table and return the exit code.

    Args:
        ctx: says which options were given.
        names: the positional arguments; the first one is the recordings.
        options: the options of `gesturekit evaluate`.

    Raises:
        UsageError: more is named than the recordings, or an option that would be ignored.
    """
    recordings, *surplus = filter(None, names)
    if surplus:
        raise click.UsageError("--sanity takes only a folder of recordings, and --audio")
    for option in ctx.command.params:
        given = ctx.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
        if given and isinstance(option, click.Option) and option.name not in _USED_BY_SANITY:
            raise click.UsageError(
                f"--sanity does not use {option.opts[-1]}; leave it out (--out and --json write "
                "all results)"
            )
    from gesturekit.evaluation.report.sanity import conclusion, run_sanity, table_lines
    from gesturekit.evaluation.report.text import headline_lines

    files = _files(options)
    measuring = _measuring(options, "task")
    found, left_out = run_sanity(Path(str(recordings)), options["audio"], **measuring)
    # First: the reader of a pipe may leave before everything is printed.
    _write(found, files, title=f"Known-bad motion made from {recordings}")
    _echo((*headline_lines(found), "", *table_lines(found), conclusion(found)))
    _echo((f"Left out: {name}: {reason}" for name, reason in left_out.items()), err=True)
    _echo(f"written  {path}" for path in files.values())
    return 1 if left_out else 0
