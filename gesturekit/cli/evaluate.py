"""gesturekit evaluate: how good generated motion is, in numbers and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from gesturekit.cli.options import existing_option, is_left, resumable

if TYPE_CHECKING:
    from gesturekit.evaluation import Evaluation


@click.command(
    "evaluate",
    epilog="Example: gesturekit evaluate rendered recordings --audio recordings --out report.html "
    "--compare rendered_without_film baseline",
)
@click.argument("generated")
@click.argument("reference", type=click.Path(path_type=Path))
@click.argument("others", nargs=-1, metavar="[MODEL]...")
@click.option("--compare", is_flag=True, help="Compare with the folders named last.")
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
@click.pass_context
def command(
    ctx: click.Context,
    generated: str,
    reference: Path,
    others: tuple[str, ...],
    compare: bool,
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
) -> None:
    """Measure generated motion (GENERATED: folder or file, npz or BVH) against recordings.

    Clips and recordings belong together by name; STEM_s1, STEM_s2 ... are samples for STEM. With
    --compare, each further folder is a model of its own. Without --audio nothing is said about
    speech. Prints a table; --out and --json write all of it.

    Exit codes: 0 every clip was measured; 1 some were left out, as listed; 2 nothing could be
    measured.
    """
    import shlex
    import sys

    from tqdm import tqdm

    from gesturekit.evaluation import FeatureModel, PatchOptions, evaluate, write_report

    if others and not compare:
        raise click.UsageError(f"what is {others[0]}? Add --compare to compare with it")
    if compare and not others:
        raise click.UsageError("--compare needs folders to compare with, named last")
    out, json_out = (
        None if path is None or is_left([path], existing) else path for path in (out, json_out)
    )
    for path in filter(None, (out, json_out)):
        _require_writable(path)
    folders = _folders(
        (generated, *others),
        reference,
        audio,
        protocol,
        samples,
        samples_dir,
        weights,
        seed,
        existing,
    )
    found = evaluate(
        folders,
        reference,
        audio=audio,
        semantic=semantic,
        protocol=protocol or "",
        patches=PatchOptions(variant, threshold),
        features=None if features is None else FeatureModel.load(features),
        seed=seed,
        progress=lambda pairs, label: tqdm(
            pairs, desc=label, unit="clip", disable=None, leave=False
        ),
    )
    for line in _table(found):
        click.echo(line)
    for model in found.models:
        for note in model.notes:
            click.echo(f"Note: {model.label}: {note}", err=True)
        for item in model.excluded:
            click.echo(
                f"Left out: {model.label}: {item.name}: {item.what}: {item.reason}", err=True
            )
    if json_out is not None:
        found.write_json(json_out)
        click.echo(f"written  {json_out}")
    if out is not None:
        write_report(found, out, command=shlex.join(["gesturekit", *sys.argv[1:]]))
        click.echo(f"written  {out}")
    ctx.exit(0 if found.is_complete else 1)


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
    from gesturekit.evaluation.tables import number

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
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths)).rstrip() for row in rows]
