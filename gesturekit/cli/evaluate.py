"""gesturekit evaluate: how good generated motion is, in numbers and as a page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import (
    existing_option,
    is_left,
    read_from,
    recording_options,
    resumable,
)
from gesturekit.wording import counted, listed

if TYPE_CHECKING:
    from gesturekit.evaluation import Evaluation, Items
    from gesturekit.evaluation.results import ModelResult


@click.command(
    "evaluate",
    epilog="Example: gesturekit evaluate rendered recordings --audio recordings --out report.html "
    "--compare rendered_without_film baseline",
)
@click.argument("generated")
@click.argument("reference", type=click.Path(path_type=Path), required=False)
@click.argument("others", nargs=-1, metavar="[MODEL]...")
@click.option("--compare", is_flag=True, help="Compare with the folders named last.")
@click.option(
    "--corpus",
    type=click.Path(path_type=Path),
    metavar="CORPUS.jsonl",
    help="In place of REFERENCE and --audio: the items of a manifest, cut as it says.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Which items of --corpus.  [default: test]",
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
    help="What gesturekit fit-features made, for FGD.",
)
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="HTML report.")
@click.option("--json", "json_out", type=click.Path(path_type=Path, dir_okay=False), help="JSON.")
@click.option(
    "--protocol",
    type=click.Choice(["multires", "lda"]),
    help="multires: patches of each training sequence, 200 samples of twice its length. lda: "
    "Fréchet distances of 10 s windows, 3 samples each, against all of REFERENCE. GENERATED and "
    "MODEL may then be model folders, too: they are sampled first.",
)
@click.option(
    "--samples",
    type=click.IntRange(min=1),
    help="Samples, where models are sampled.  [default: the protocol's]",
)
@click.option(
    "--samples-dir",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("evaluation_samples"),
    show_default=True,
    help="Where sampled motion goes.",
)
@click.option(
    "--weights", type=click.Path(path_type=Path), help="WavLM weights of models that are sampled."
)
@click.option(
    "--variant",
    type=click.Choice(["ganimator", "paper"]),
    default="ganimator",
    show_default=True,
    help="How patches are compared.",
)
@click.option(
    "--threshold",
    type=click.FloatRange(min=0, min_open=True),
    help="Distance below which a patch is covered.  [default: 2.0; none for paper]",
)
@click.option("--seed", default=0, show_default=True, help="Of samples and intervals.")
@existing_option("replace", note="; samples of an earlier run are only skipped or refused")
@recording_options
@click.pass_context
def command(
    ctx: click.Context,
    generated: str,
    reference: Path | None,
    others: tuple[str, ...],
    compare: bool,
    corpus: Path | None,
    split: str | None,
    audio: Path | None,
    semantic: Path | None,
    features: Path | None,
    out: Path | None,
    json_out: Path | None,
    protocol: str | None,
    samples: int | None,
    samples_dir: Path,
    weights: Path | None,
    variant: str,
    threshold: float | None,
    seed: int,
    existing: str,
    **reading: object,
) -> None:
    """Measure generated motion (GENERATED: folder or file, npz or BVH) against recordings.

    Clips and recordings belong together by name; STEM_s1, STEM_s2 ... are samples for STEM. With
    --compare, each further folder is a model of its own. Without --audio nothing is said about
    speech. Prints a table; --out and --json write all of it. Held-out recordings:

    \b
    gesturekit render --corpus corpus.jsonl --split test --model M --out rendered
    gesturekit evaluate rendered --corpus corpus.jsonl --split test

    --in-unit and the like say how REFERENCE is read; a manifest keeps its own.

    Exit codes: 0 every clip was measured; 1 some were left out, as listed; 2 nothing could be
    measured. Clips of other splits of --corpus, and of its items without motion, are not meant to
    be measured: a note names them.
    """
    import shlex
    import sys

    from gesturekit.evaluation import FeatureModel, PatchOptions, evaluate, write_report
    from gesturekit.progress import Progress

    if corpus is not None and reference is not None:
        # There is no REFERENCE: it is the first of the models.
        reference, others = None, (str(reference), *others)
    recordings = _recordings(reference, corpus, split, audio, protocol, read_from(reading))
    if others and not compare:
        raise click.UsageError(f"what is {others[0]}? Add --compare to compare with it")
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise click.UsageError(f"--out {out}: the report is HTML: name it .html (--json for data)")
    if compare and not others:
        raise click.UsageError("--compare needs folders to compare with, named last")
    out, json_out = (
        None if path is None or is_left([path], existing) else path for path in (out, json_out)
    )
    for path in filter(None, (out, json_out)):
        _require_writable(path)
    folders = _folders(
        (generated, *others),
        reference or Path(),  # with --corpus no model is sampled
        audio,
        protocol,
        samples,
        samples_dir,
        weights,
        seed,
        existing,
    )
    try:
        found = evaluate(
            folders,
            recordings,
            audio=audio,
            semantic=semantic,
            protocol=protocol or "",
            patches=PatchOptions(variant, threshold),
            features=None if features is None else FeatureModel.load(features),
            seed=seed,
            progress=lambda pairs, label: Progress(pairs, desc=label, unit="clip"),
        )
    except KeyboardInterrupt:
        click.echo("Stopped, and nothing was written. The same command measures anew.", err=True)
        raise
    for line in _table(found):
        click.echo(line)
    for line in _notes(found):
        click.echo(line, err=True)
    for model, name in zip(found.models, (generated, *others)):
        if warning := _trained_on(model, name):
            click.echo(f"Warning: {model.label}: {warning}", err=True)
            model.notes.append(warning)
    if json_out is not None:
        found.write_json(json_out)
        click.echo(f"written  {json_out}")
    if out is not None:
        write_report(found, out, command=shlex.join(["gesturekit", *sys.argv[1:]]))
        click.echo(f"written  {out}")
    click.echo(_summary(found, out or json_out))
    ctx.exit(0 if found.is_complete else 1)


def _recordings(
    reference: Path | None,
    corpus: Path | None,
    split: str | None,
    audio: Path | None,
    protocol: str | None,
    reading: Mapping[str, Any],
) -> Path | Items:
    """The recordings to compare with: a folder or file, or items of a manifest."""
    from gesturekit.evaluation import Items

    if corpus is None:
        if split is not None:
            raise click.UsageError("--split chooses items of --corpus: give it as well")
        if reference is None:
            raise click.UsageError("name the recordings: a folder (REFERENCE), or --corpus")
        return Items.of_folder(reference, reading) if reading else reference
    if audio is not None or reading:
        raise click.UsageError("--corpus says where the sound is and how motion is read")
    if protocol is not None:
        raise click.UsageError("--protocol goes with a folder of recordings, not with --corpus")
    return Items.of_manifest(corpus, split or "test")


def _notes(found: Evaluation) -> Iterator[str]:
    """Return the notes on the figures; metrics left out for one reason share a line."""
    for model in found.models:
        yield from (f"Note: {model.label}: {note}" for note in model.notes)
        measures: dict[str, tuple[list[str], list[str]]] = {}
        for item in model.excluded:
            if item.what == "clip":
                yield f"Left out: {model.label}: {item.name}: clip: {item.reason}"
                continue
            names, whats = measures.setdefault(item.reason, ([], []))
            names.append(item.name)
            whats.append(item.what)
        for reason, (names, whats) in measures.items():
            what, of = ", ".join(dict.fromkeys(whats)), listed(list(dict.fromkeys(names)), 3)
            yield f"Left out: {model.label}: {of}: {what}: {reason}"


def _trained_on(model: ModelResult, name: str) -> str:
    """Return a warning where a model was trained on recordings that it is measured on.

    Args:
        model: what was measured.
        name: as it was named on the command line: a folder of motion, or a model.
    """
    from gesturekit.evaluation.pairs import Stretch
    from gesturekit.systems import model_folder
    from gesturekit.training.data.sources import is_trained_on, load_sources

    sources = load_sources(_made_by(model.path) or model_folder(name))
    measured = {clip.pair.stem: clip.pair for clip in model.clips}
    seen = []
    for stem, pair in measured.items():
        if isinstance(pair.reference, Stretch):
            item = pair.reference.item
            stretch = {"start": item.motion_start, "duration": item.duration}
            known = item.split == "train"
            known = known or is_trained_on(sources, item.motion, item.audio, **stretch)
        else:
            known = is_trained_on(sources, pair.reference, pair.audio)
        seen += [stem] if known else []
    if not seen:
        return ""
    return (
        f"the model was trained on {len(seen)} of {counted(len(measured), 'recording')}, or on a "
        f"part of each ({listed(seen, 3)}): the figures do not say how it does on new ones"
    )


def _made_by(rendered: Path) -> Path | None:
    """The model folder that the record beside rendered motion names, if it does."""
    import json

    from gesturekit.rendering.record import RECORD

    try:
        lines = (rendered / RECORD).read_text(encoding="utf-8", errors="replace").splitlines()
        return Path(json.loads(lines[-1])["model_folder"])
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return None


def _summary(found: Evaluation, report: Path | None) -> str:
    """The last line: how much was measured, and where the rest can be read."""
    clips = sum(len(model.clips) for model in found.models)
    left_out = sum(item.what == "clip" for model in found.models for item in model.excluded)
    where = f"; all of it in {report}" if report else "; --out report.html shows each"
    return f"{counted(clips, 'clip')} measured, {left_out} left out{where}"


def _require_writable(path: Path) -> None:
    """Refuse a place that cannot be written before hours of measuring, not after."""
    import tempfile

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise click.UsageError(f"{path} cannot be written: {error.strerror}") from None


def _folders(
    names: Sequence[str],
    reference: Path,
    audio: Path | None,
    protocol: str | None,
    samples: int | None,
    samples_dir: Path,
    weights: Path | None,
    seed: int,
    existing: str,
) -> dict[str, Path]:
    """Label to folder of motion; models are sampled."""
    from gesturekit.progress import Progress
    from gesturekit.systems import bundled_models, load

    folders: dict[str, Path] = {}
    places = [Path(name).resolve() for name in names]
    for name, place in zip(names, places):
        if places.count(place) > 1:
            raise click.UsageError(f"{name} is named twice")
        path = Path(name)
        label = place.stem if path.is_file() else place.name
        if label in folders:
            label = f"{place.parent.name}/{label}"
        if label in folders:
            label = str(place)
        folders[label] = path
        if path.exists() and not (path / "config.yaml").is_file():
            continue
        if not path.exists() and name not in bundled_models():
            continue  # told by whoever looks for motion in it
        if protocol is None:
            raise click.UsageError(
                f"{name} is a model: render it first (gesturekit render), or say by --protocol "
                "how it is to be sampled"
            )
        from gesturekit.rendering import sampling

        count = {} if samples is None else {"samples": samples}
        folders[label] = samples_dir / label.replace("/", "_")
        skip = existing == "skip"
        if not skip and folders[label].is_dir() and any(folders[label].iterdir()):
            raise click.UsageError(
                f"{folders[label]} holds samples of an earlier run, which would be measured too: "
                "name another --samples-dir, measure that folder in place of the model, or go on "
                "with the sampling by --existing skip"
            )
        model = load(name, weights=weights)
        if protocol == "lda":
            if audio is None:
                raise click.UsageError("--protocol lda samples models on speech: give --audio")
            files = sampling.sample_lda(model, audio, folders[label], seed=seed, skip=skip, **count)
        else:
            files = sampling.sample_multires(
                model, reference, folders[label], audio=audio, seed=seed, skip=skip, **count
            )
        with resumable(lambda: "With --existing skip the same command goes on."):
            for _ in Progress(files, desc=f"sampling {label}", unit="clip"):
                pass
    return folders


def _table(found: Evaluation) -> list[str]:
    """One line a measure: each model's mean and interval, and the recordings' own."""
    from tqdm.utils import disp_len

    from gesturekit.evaluation.report.tables import number

    rows = [["", *(model.label for model in found.models), "recording"]]
    for definition in found.definitions():
        figures = [model.figures.get(definition.key) for model in found.models]
        unit = f", {definition.unit}" if definition.unit else ""
        row = [f"{definition.name}{unit}"]
        for figure in figures:
            if figure is None:
                row.append("-")
                continue
            i = figure.interval
            spread = "" if i.low is None else f" [{number(i.low)}, {number(i.high)}]"
            row.append(f"{number(i.value)}{spread}")
        own = next((f.recording for f in figures if f and f.recording is not None), None)
        row.append("" if own is None else number(own))
        rows.append(row)
    # Wide characters, as in Chinese names, take two columns.
    widths = [max(disp_len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(cell + " " * (w - disp_len(cell)) for cell, w in zip(row, widths)).rstrip()
        for row in rows
    ]
