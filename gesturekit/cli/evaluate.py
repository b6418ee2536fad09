"""gesturekit evaluate: metrics of generated motion, as a table and a report."""

from __future__ import annotations

import shlex
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.evaluate_models import folders_of, place_of, rendered_baselines
from gesturekit.cli.evaluate_sanity import sanity
from gesturekit.cli.options import (
    RECORDING_OPTIONS,
    SEED,
    body_option,
    comma_separated,
    existing_option,
    is_left,
    read_from,
    recording_options,
    weights_option,
)
from gesturekit.cli.trained_on import trained_on
from gesturekit.wording import counted, listed

if TYPE_CHECKING:
    from gesturekit.evaluation import Evaluation, Items
    from gesturekit.evaluation.statistics.answers import Answer


@click.command(
    "evaluate",
    epilog="Example: gesturekit evaluate rendered recordings --audio recordings --out report.html "
    "--compare rendered_without_film --compare other=baseline/rendered",
)
@click.argument("generated")
@click.argument("reference", type=click.Path(path_type=Path), required=False)
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
    "still), other_utterance (the recording of another utterance), retrieval (pieces of the "
    "training recordings, chosen by the speech; with --corpus), speech_blind (GENERATED's model "
    "with the speech of another recording; with --corpus).",
)
@click.option(
    "--corpus",
    type=click.Path(path_type=Path),
    metavar="CORPUS.jsonl",
    help="Compare with the items of a manifest instead of REFERENCE and --audio.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Split of --corpus to use.  [default: test; train with --protocol multires]",
)
@click.option("--audio", type=click.Path(path_type=Path), help="Sound of the recordings.")
@click.option(
    "--semantic",
    type=click.Path(path_type=Path),
    help="Semantic tracks for SRGR: feature files (npz) or BEAT's tables (txt).",
)
@click.option(
    "--features",
    type=click.Path(path_type=Path, file_okay=False),
    help="Feature model of gesturekit fit-features, for FGD.",
)
@click.option(
    "--study",
    type=click.Path(path_type=Path),
    metavar="CSV",
    help="Answers of a user study on these models in the format of gesturekit study (a file or a "
    "folder); shows how well each metric agrees with people's ranking of the models.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, dir_okay=False), help="Write an HTML report."
)
@click.option(
    "--json",
    "json_out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write all results as JSON.",
)
@click.option(
    "--csv",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write the table of all metrics as CSV.",
)
@click.option(
    "--markdown",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write the table in Markdown.",
)
@click.option(
    "--latex",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write the table in LaTeX (booktabs).",
)
@click.option(
    "--protocol",
    type=click.Choice(["multires", "lda"]),
    help="Evaluation of one of the papers. multires: patch metrics of each training sequence, 200 "
    "samples of twice its length. lda: Fréchet distances of 10 s windows, 3 samples each, against "
    "all of REFERENCE or of --corpus. With a protocol, GENERATED and --compare may be model "
    "folders: motion is sampled first, each recording in its own style; models with styles need "
    "--corpus, which states them.",
)
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    help="Number of samples from a model folder.  [default: that of the protocol]",
)
@click.option(
    "--samples-dir",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("evaluation_samples"),
    show_default=True,
    help="Folder for motion sampled from model folders.",
)
@click.option(
    "--postprocess",
    is_flag=True,
    help="Lock feet and smooth in motion sampled from model folders, as gesturekit render does. "
    "[default: the network's raw output, as in the papers]",
)
@weights_option
@click.option(
    "--variant",
    type=click.Choice(["ganimator", "paper"]),
    default="ganimator",
    show_default=True,
    help="Definition of the patch metrics.",
)
@click.option(
    "--threshold",
    type=click.FloatRange(min=0, min_open=True),
    help="Coverage threshold: largest distance at which a patch counts as covered.  [default: "
    "2.0; none for paper]",
)
@click.option(
    "--bas",
    type=click.Choice(["seconds", "bailando"]),
    default="seconds",
    show_default=True,
    help="Definition of beat alignment (BAS). seconds: speed low-passed at 6 Hz, beats between "
    "frames, the same at any frame rate. bailando: frame differences, beats on frames, as in the "
    "code of the papers.",
)
@click.option(
    "--sanity",
    is_flag=True,
    help="GENERATED is a folder of recordings (with their sound, or --audio): evaluate known-bad "
    "motion made from them, and print which of it each metric detects.",
)
@click.option(
    "--seed",
    type=SEED,
    default=0,
    show_default=True,
    help="Seed for samples and confidence intervals.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Number of processes; does not change the results.  [default: number of cores]",
)
@body_option
@existing_option("replace", note="; samples of an earlier run are only skipped or refused")
@recording_options
@click.pass_context
def command(
    ctx: click.Context,
    generated: str,
    reference: Path | None,
    surplus: tuple[str, ...],
    compare: tuple[str, ...],
    out: Path | None,
    json_out: Path | None,
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
    from gesturekit.evaluation.report.metric_table import WRITERS
    from gesturekit.evaluation.statistics.agreement import agreement, shared_models

    if options["sanity"]:
        ctx.exit(sanity((generated, reference, *surplus, *compare), out, json_out, options))
    _refuse_surplus(reference, surplus, options["corpus"])
    recordings = _recordings(reference, options)
    names = (generated, *compare)
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise click.UsageError(f"--out {out}: the report is HTML: name it .html (--json for data)")
    tables = {form: _to_write(options[form], options["existing"]) for form in WRITERS}
    out, json_out = (_to_write(path, options["existing"]) for path in (out, json_out))
    answers = _answers(options["study"])
    folders = folders_of(names, recordings, options)
    temporary = Path(ctx.with_resource(tempfile.TemporaryDirectory(prefix="gesturekit-")))
    folders |= rendered_baselines(Path(place_of(generated)), folders, temporary, options)
    if answers:
        shared_models(list(folders), answers)  # before hours of measuring
    found = _evaluated(folders, recordings, options)
    if answers:
        found.agreement = agreement(found.models, answers, options["seed"])
    for model, name in zip(found.models, map(place_of, names)):
        if warning := trained_on(model, name):
            click.echo(f"Warning: {model.label}: {warning}", err=True)
            model.notes.append(warning)
            model.marks.append("trained on these")
    # First: the reader of a pipe, such as head, may leave before everything is printed.
    written = _write(found, tables, json_out, out, options["body"])
    _print(found)
    for path in written:
        click.echo(f"written  {path}")
    click.echo(_summary(found, out or json_out))
    ctx.exit(0 if found.is_complete else 1)


def _print(found: Evaluation) -> None:
    """Print verdicts and table, and notes to standard error."""
    from gesturekit.evaluation.report.metric_table import agreement_lines, terminal_lines

    for line in (*found.verdicts(), *terminal_lines(found), *agreement_lines(found)):
        click.echo(line)
    for line in _notes(found):
        click.echo(line, err=True)


def _write(
    found: Evaluation,
    tables: Mapping[str, Path | None],
    json_out: Path | None,
    out: Path | None,
    body: str | None,
) -> list[Path]:
    """Write the requested files and return them."""
    import sys

    from gesturekit.evaluation import write_report
    from gesturekit.evaluation.report.metric_table import write_table

    for form, path in tables.items():
        if path is not None:
            write_table(found, path, form)
    if json_out is not None:
        found.write_json(json_out)
    if out is not None:
        command = shlex.join(["gesturekit", *sys.argv[1:]])
        write_report(found, out, command=command, body=body)
    return [path for path in (*tables.values(), json_out, out) if path is not None]


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


def _answers(study: Path | None) -> Sequence[Answer]:
    """Read the results of a study; print what is left out to standard error."""
    if study is None:
        return ()
    from gesturekit.evaluation import read_answers

    found = read_answers([study])
    for user, reason in found.excluded.items():
        click.echo(f"Left out: {study}: rater {user}: {reason}", err=True)
    for note in found.notes:
        click.echo(f"Note: {study}: {note}", err=True)
    return found.kept


def _evaluated(
    folders: dict[str, Path], recordings: Path | Items, options: Mapping[str, Any]
) -> Evaluation:
    """Run the evaluation with the options of the command line."""
    import os

    from gesturekit.evaluation import FeatureModel, Variants, evaluate
    from gesturekit.progress import Progress

    features = options["features"]
    try:
        return evaluate(
            folders,
            recordings,
            audio=options["audio"],
            semantic=options["semantic"],
            protocol=options["protocol"] or "",
            variants=Variants(options["variant"], options["threshold"], options["bas"]),
            baselines=[
                name for name in comma_separated(options["baseline"]) if name not in folders
            ],
            features=None if features is None else FeatureModel.load(features),
            seed=options["seed"],
            workers=options["workers"] or os.cpu_count() or 1,
            progress=lambda tasks, total, label: Progress(
                tasks, total=total, desc=label, unit="recording"
            ),
        )
    except KeyboardInterrupt:
        click.echo(
            "Stopped; nothing was written. Finished measurements are cached: the same command "
            "continues from there.",
            err=True,
        )
        raise


def _recordings(reference: Path | None, options: Mapping[str, Any]) -> Path | Items:
    """Return the recordings to compare with: a folder or file, or the items of a manifest."""
    from gesturekit.evaluation import Items

    reading = read_from({name: options[name] for name in RECORDING_OPTIONS})
    corpus, split = options["corpus"], options["split"]
    if corpus is None:
        if split is not None:
            raise click.UsageError("--split requires --corpus")
        if reference is None:
            raise click.UsageError("name the recordings: a folder (REFERENCE), or --corpus")
        return Items.of_folder(reference, reading) if reading else reference
    if options["audio"] is not None or reading:
        raise click.UsageError(
            "--corpus already gives the sound and how motion is read: leave out --audio and "
            "--in-..."
        )
    usual = "train" if options["protocol"] == "multires" else "test"
    return Items.of_manifest(corpus, split or usual)


def _notes(found: Evaluation) -> Iterator[str]:
    """Yield notes on the metrics; metrics left out for the same reason share a line."""
    from gesturekit.evaluation.report.headline import interval_warnings

    yield from (f"Warning: {warning}." for warning in interval_warnings(found))
    for model in found.models:
        yield from (f"Note: {model.label}: {note}" for note in model.notes)
        metrics: dict[str, tuple[list[str], list[str]]] = {}
        for item in model.excluded:
            if item.what == "clip":
                yield f"Left out: {model.label}: {item.name}: clip: {item.reason}"
                continue
            names, left_out = metrics.setdefault(item.reason, ([], []))
            names.append(item.name)
            left_out.append(item.what)
        for reason, (names, left_out) in metrics.items():
            what, of = ", ".join(dict.fromkeys(left_out)), listed(list(dict.fromkeys(names)), 3)
            yield f"Left out: {model.label}: {of}: {what}: {reason}"


def _summary(found: Evaluation, report: Path | None) -> str:
    """Return the last line: how many clips were measured, and where all results are."""
    clips = sum(len(model.clips) for model in found.models)
    left_out = sum(item.what == "clip" for model in found.models for item in model.excluded)
    where = f"; all of it in {report}" if report else "; --out report.html shows each"
    return f"{counted(clips, 'clip')} measured, {left_out} left out{where}"


def _to_write(path: Path | None, existing: str) -> Path | None:
    """Return a file if it is to be written, else None.

    Raises:
        UsageError: it cannot be written; raised before hours of measuring.
    """
    if path is None or is_left([path], existing):
        return None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            return path
    except OSError as error:
        raise click.UsageError(f"{path} cannot be written: {error.strerror}") from None
