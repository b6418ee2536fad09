"""gesturekit train: train a model from a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import PATH

if TYPE_CHECKING:
    from gesturekit.training.config import Setting


@click.command(
    "train",
    context_settings={"ignore_unknown_options": True},  # refused below
    epilog="Example: gesturekit train own_corpus corpus=corpus.jsonl out=runs/mine",
)
@click.argument("config", type=PATH, required=False)
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option("--resume", is_flag=True, help="Continue a run: gesturekit train --resume runs/mine.")
@click.option("--plan", "only_plan", is_flag=True, help="Print data and estimated time, and exit.")
@click.option(
    "--arrays", "only_arrays", is_flag=True, help="Make the arrays of a long corpus, and exit."
)
@click.option("--workers", type=click.IntRange(1), metavar="N", help="Processes for --arrays.")
@click.option("--show", is_flag=True, help="Print every setting with its description, and exit.")
def command(
    config: Path | None,
    overrides: tuple[str, ...],
    resume: bool,
    only_plan: bool,
    only_arrays: bool,
    workers: int | None,
    show: bool,
) -> None:
    """Train the model that CONFIG describes; KEY=VALUE changes a setting (training.batch=8).

    CONFIG is a YAML file or the name of a recipe: own_corpus (gesturekit recipes ls).

    The run folder (out=...) gets the resolved config, metrics, TensorBoard events, checkpoints,
    and at the end the model.
    """
    import logging
    import shlex

    from gesturekit.systems import make_arrays, plan_training, resolved_settings, train

    if resume and (only_plan or only_arrays):
        option = "--plan" if only_plan else "--arrays"
        raise click.UsageError(f"{option} is for a new run; leave out --resume")
    _refuse_options([str(config or ""), *overrides])
    if config is None or ("=" in str(config) and not config.exists()):
        given = shlex.join([str(config), *overrides]) if config else "corpus=CORPUS.jsonl"
        raise click.UsageError(f"name a recipe or a file: gesturekit train own_corpus {given}")
    if workers is not None:
        overrides = (*overrides, f"workers={workers}")
    if show:
        _show(resolved_settings(config, overrides))
        return
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if only_plan:
        plan_training(config, overrides)
        return
    if only_arrays:
        make_arrays(config, overrides)
        return
    try:
        model = train(config, overrides, resume=resume)
    except KeyboardInterrupt as error:
        if error.args:  # how to continue
            raise
        raise KeyboardInterrupt("Nothing was trained yet; begin with the same command.") from None
    run = model.parent
    click.echo(f"Report: {run / 'report.html'}")
    click.echo(f"Losses and metrics: {run / 'metrics.jsonl'}")
    curves = "in the report; for TensorBoard: pip install 'gesturekit[tensorboard]'"
    if (run / "events").is_dir():
        curves = shlex.join(["tensorboard", "--logdir", str(run / "events")])
    click.echo(f"Curves: {curves}")
    click.echo(f"Model: {model}")
    for line in _next_steps(model):
        click.echo(line)


_OPTIONS = ("--resume", "--plan", "--arrays", "--workers", "--show")


def _refuse_options(arguments: Sequence[str]) -> None:
    """Refuse options that do not exist; most are settings written as options.

    Raises:
        UsageError: there is one.
    """
    from gesturekit.wording import did_you_mean

    for text, after in zip(arguments, [*arguments[1:], ""], strict=True):
        if not text.startswith("-"):
            continue
        name, _, value = text.partition("=")
        if near := did_you_mean(name, _OPTIONS, "{}"):
            raise click.NoSuchOption(text, possibilities=[near])
        is_value = after and "=" not in after and not after.startswith("-")
        setting = f"{name.lstrip('-')}={value or (after if is_value else 'VALUE')}"
        raise click.UsageError(f"No such option: {text}; settings have no --: {setting}")


def _show(settings: Sequence[Setting]) -> None:
    """Print settings, each with its docstring below it, as wide as the terminal."""
    import shutil
    import textwrap

    width = shutil.get_terminal_size((100, 24)).columns
    for setting in settings:
        is_section = setting.value is None
        line = f"\n[{setting.name}]" if is_section else f"{setting.name}={setting.value}"
        if setting.default is not None:
            is_required = setting.default == "required"
            line += "  (required)" if is_required else f"  (default: {setting.default})"
        click.echo(line)
        if setting.doc:
            indent = "" if is_section else "    "
            click.echo(
                textwrap.fill(setting.doc, width, initial_indent=indent, subsequent_indent=indent)
            )


def _next_steps(model: Path) -> list[str]:
    """Return the commands that render with a model and evaluate it on held-out speech.

    The last line is what the model's README says of held-out recordings, if anything.
    """
    import shlex

    from audio_features.extractor import needs_of
    from gesturekit.corpus import Manifest
    from gesturekit.errors import CorpusError
    from gesturekit.inspection.model import readme_notes
    from gesturekit.training.config import read_yaml

    config, run = read_yaml(model / "config.yaml"), read_yaml(model.parent / "config.yaml")
    takes_speech = config.get("features") is not None
    needed = []
    if takes_speech:
        needed += _weights_arguments(run["features"])
    if config.get("path"):
        needed += ["--path", "way.csv"]
    if styles := config.get("styles"):
        needed += ["--style", str(styles[0])]
    start = ["gesturekit", "render"]
    given = ["speech.wav"] if takes_speech else [] if config.get("path") else ["--seconds", "20"]
    end = ["--model", str(model), *needed, "--out", "rendered"]
    lines = [f"Render with: {shlex.join([*start, *given, *end])}"]
    lines += [f"It needs {need}" for need in needs_of((config.get("features") or {}).get("spec"))]
    corpus = run["corpus"]
    try:
        is_held_out = takes_speech and bool(Manifest.load(corpus).paired("test"))
    except CorpusError:
        is_held_out = False  # deleted since; the model does not need it
    if is_held_out:
        split = ["--corpus", corpus, "--split", "test"]
        lines += [
            f"Held-out speech: {shlex.join([*start, *split, *end])}",
            f"Evaluate with: {shlex.join(['gesturekit', 'evaluate', 'rendered', *split])}",
        ]
    if measured := readme_notes(model / "README.md").get("Measured"):
        lines.append(f"Measured {measured}")
    return lines


def _weights_arguments(features: Mapping[str, Any]) -> list[str]:
    """Return the options of `render` that name the weights of the encoders."""
    from gesturekit.training.features import FeatureConfig

    places = FeatureConfig(features["extractors"], features.get("weights")).encoder_places
    if len(places) == 1:
        return ["--weights", *map(str, places.values())]
    return [text for kind, place in places.items() for text in ("--weights", f"{kind}={place}")]
