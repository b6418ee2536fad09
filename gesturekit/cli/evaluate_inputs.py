"""Inputs of gesturekit evaluate: recordings, and models with their samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import RECORDING_OPTIONS, comma_separated, read_from, resumable
from gesturekit.cli.render import chosen_controls, control_options
from gesturekit.wording import counted, did_you_mean, listed

if TYPE_CHECKING:
    from gesturekit.corpus.manifest import Item
    from gesturekit.evaluation import Items
    from gesturekit.evaluation.results import ModelResult


_CONTROLS = {option.name: option for option in control_options() if option.name != "fps"}


def sampling_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of the controls with which `--protocol` samples models."""
    for option in reversed(_CONTROLS.values()):
        command = click.option(cls=lambda _, option=option: option)(command)  # type: ignore[arg-type]  # click calls it
    return command


def _named(text: str) -> tuple[str | None, str]:
    """Return (name or None, folder) of [NAME=]DIR; a folder that exists is no NAME=DIR."""
    name, equals, folder = text.partition("=")
    if not equals or not name or Path(text).exists():
        return None, text
    return name, folder


def place_of(text: str) -> str:
    """Return the folder of [NAME=]DIR."""
    return _named(text)[1]


def recordings_of(reference: Path | None, options: Mapping[str, Any]) -> Path | Items:
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


def folders_of(
    names: Sequence[str], recordings: Path | Items, options: Mapping[str, Any]
) -> dict[str, Path]:
    """Return {label: folder of motion}; sample model folders first."""
    from gesturekit.systems import bundled_models
    from gesturekit.training.run_folder import unfinished

    folders: dict[str, Path] = {}
    sampled = False
    places = [Path(place_of(name)).resolve() for name in names]
    for text, place in zip(names, places):
        if places.count(place) > 1:
            raise click.UsageError(f"{text} is given twice")
        label, name = _named(text)
        path = Path(name)
        if label in folders:
            raise click.UsageError(f"two models are named {label}")
        usual = place.stem if path.is_file() else place.name
        free = (n for n in (usual, f"{place.parent.name}/{usual}") if n not in folders)
        label = label or next(free, str(place))
        folders[label] = path
        if why := unfinished(path):
            raise click.UsageError(why)
        # `evaluate` reports that there is no such folder.
        is_model = (path / "config.yaml").is_file() if path.exists() else name in bundled_models()
        if not is_model:
            continue
        if options["protocol"] is None:
            raise click.UsageError(
                f"{name} is a model, not motion: render it first (gesturekit render), or give "
                "--protocol to sample it"
            )
        folders[label] = options["samples_dir"] / label.replace("/", "_")
        _sample(name, label, folders[label], recordings, options)
        sampled = True
    asked = [name for name in _CONTROLS if options.get(name) not in (None, ())]
    if asked and not sampled:
        raise click.UsageError(
            f"{_CONTROLS[asked[0]].opts[0]} is for models that --protocol samples, and only motion "
            "is named: give a model folder, or render the motion with it (gesturekit render)"
        )
    return folders


def _sample(
    name: str, label: str, folder: Path, recordings: Path | Items, options: Mapping[str, Any]
) -> None:
    """Sample a model by the protocol into a folder."""
    from gesturekit.progress import Progress
    from gesturekit.rendering import samples
    from gesturekit.systems import load

    skip = options["existing"] == "skip"
    if not skip and folder.is_dir() and any(folder.iterdir()):
        raise click.UsageError(
            f"{folder} holds samples of an earlier run, which would be measured too: "
            "give another --samples-dir, measure that folder instead of the model, or continue "
            "the sampling with --existing skip"
        )
    open_model = partial(load, weights=options["weights"])
    model = open_model(name)
    settings = samples.SamplingOptions(
        samples=options["samples"],
        seed=options["seed"],
        skip=skip,
        controls=chosen_controls({name: options[name] for name in _CONTROLS}, open_model),
    )
    sample = samples.sample_lda if options["protocol"] == "lda" else samples.sample_multires
    files = sample(model, _items(recordings, options), folder, settings)
    with resumable(lambda: "The same command with --existing skip continues."):
        for _ in Progress(files, desc=f"sampling {label}", unit="clip"):
            pass


def _items(recordings: Path | Items, options: Mapping[str, Any]) -> Sequence[Item]:
    """Return the recordings that the protocol samples a model for.

    Raises:
        UsageError: speech is needed, and there is none.
    """
    from gesturekit.rendering.samples import sequences_of, sounds_of

    audio = options["audio"]
    if options["corpus"] is not None and not isinstance(recordings, Path):
        return [item for item in recordings.items if item.motion is not None]
    if options["protocol"] == "multires":
        reading = read_from({name: options[name] for name in RECORDING_OPTIONS})
        folder = recordings if isinstance(recordings, Path) else recordings.path
        return sequences_of(folder, audio, reading)
    if audio is None:
        raise click.UsageError(
            "--protocol lda samples models for the recordings' windows: give --audio, or --corpus "
            "for a model with styles or without speech"
        )
    return sounds_of(audio)


RENDERED_BASELINES = ("retrieval", "speech_blind")
"""Baselines that a model renders; see `gesturekit.rendering.samples`."""


def rendered_baselines(
    generated: Path, models: Mapping[str, Path], folder: Path, options: Mapping[str, Any]
) -> dict[str, Path]:
    """Return {name: folder of motion} of those `--baseline`s that a model renders.

    Args:
        generated: the motion that is evaluated; its model is rendered with other speech.
        models: the models that are compared, by label.
        folder: an empty folder for models and motion.
        options: of the command line.

    Raises:
        UsageError: an unknown name or that of a model, no manifest, or the model of `generated` is
            not known.
    """
    from gesturekit.evaluation.measuring.made_motion import BASELINES
    from gesturekit.progress import Progress
    from gesturekit.rendering import samples
    from gesturekit.rendering.renderer import model_of_results
    from gesturekit.systems import load

    names = comma_separated(options["baseline"])
    known = (*BASELINES, *RENDERED_BASELINES)
    if unknown := [name for name in names if name not in known]:
        hint = did_you_mean(unknown[0], known) or f"it is one of {', '.join(known)}."
        raise click.UsageError(f"--baseline {unknown[0]!r}: {hint}")
    wanted = [name for name in RENDERED_BASELINES if name in names]
    if clash := [name for name in wanted if name in models]:
        raise click.UsageError(f"baseline {clash[0]} has the name of a model; give it as NAME=DIR")
    corpus, split = options["corpus"], options["split"] or "test"
    if wanted and corpus is None:
        raise click.UsageError(
            f"--baseline {wanted[0]} needs --corpus, which lists the training recordings"
        )
    folders = {}
    for name in wanted:
        if name == "retrieval":
            click.echo("Training the baseline retrieval ...", err=True)
            model = samples.train_retrieval(corpus, folder / "run", seed=options["seed"])
            sounds = samples.split_sounds(corpus, split)
        else:
            rendered = model_of_results(generated) if generated.is_dir() else None
            if rendered is None:
                raise click.UsageError(
                    f"--baseline {name} renders the model of {generated} again, which is only "
                    "known for folders written by gesturekit render"
                )
            model, sounds = rendered, samples.other_sounds(corpus, split)
        folders[name] = folder / name
        files = samples.render_baseline(
            load(model, weights=options["weights"]), sounds, folders[name], seed=options["seed"]
        )
        for _ in Progress(files, total=len(sounds), desc=name, unit="clip"):
            pass
    return folders


def trained_on(model: ModelResult, name: str) -> str:
    """Return a warning if `name`, a model, was trained on recordings of its evaluation, or ""."""
    from gesturekit.rendering.renderer import model_of_results
    from gesturekit.systems import model_folder
    from gesturekit.training.origin import is_trained_on, load_sources

    sources = load_sources(model_of_results(model.path) or model_folder(name))
    measured = {clip.pair.stem: clip.pair for clip in model.clips}
    seen = []
    for stem, pair in measured.items():
        item, audio = pair.reference, pair.audio.audio if pair.audio else None
        stretch = {"start": item.motion_start, "duration": item.duration}
        seen += [stem] if is_trained_on(sources, item.motion, audio, **stretch) else []
    if not seen:
        return ""
    return (
        f"the model was trained on {len(seen)} of {counted(len(measured), 'recording')}, or on a "
        f"part of each ({listed(seen, 3)}): the figures do not say how it does on new ones"
    )
