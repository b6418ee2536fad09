"""Models that gesturekit evaluate compares: their names, folders, and samples of model folders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from gesturekit.cli.options import resumable


def _named(text: str) -> tuple[str | None, str]:
    """Return (name or None, folder) of [NAME=]DIR; a folder that exists is no NAME=DIR."""
    name, equals, folder = text.partition("=")
    if not equals or not name or Path(text).exists():
        return None, text
    return name, folder


def place_of(text: str) -> str:
    """Return the folder of [NAME=]DIR."""
    return _named(text)[1]


def folders_of(
    names: Sequence[str], reference: Path | None, options: Mapping[str, Any]
) -> dict[str, Path]:
    """Return {label: folder of motion}; sample model folders first (not with --corpus)."""
    from gesturekit.systems import bundled_models

    folders: dict[str, Path] = {}
    places = [Path(place_of(name)).resolve() for name in names]
    for text, place in zip(names, places):
        if places.count(place) > 1:
            raise click.UsageError(f"{text} is named twice")
        label, name = _named(text)
        path = Path(name)
        if label in folders:
            raise click.UsageError(f"two models are named {label}")
        if label is None:
            label = place.stem if path.is_file() else place.name
            if label in folders:
                label = f"{place.parent.name}/{label}"
            if label in folders:
                label = str(place)
        folders[label] = path
        if path.exists() and not (path / "config.yaml").is_file():
            continue
        if not path.exists() and name not in bundled_models():
            continue  # `evaluate` reports that there is no such folder
        if options["protocol"] is None:
            raise click.UsageError(
                f"{name} is a model: render it first (gesturekit render), or say by --protocol "
                "how it is to be sampled"
            )
        folders[label] = options["samples_dir"] / label.replace("/", "_")
        _sample(name, label, folders[label], reference, options)
    return folders


def _sample(
    name: str, label: str, folder: Path, reference: Path | None, options: Mapping[str, Any]
) -> None:
    """Sample a model by the protocol into a folder."""
    from gesturekit.progress import Progress
    from gesturekit.rendering import sampling
    from gesturekit.systems import load

    skip, audio = options["existing"] == "skip", options["audio"]
    if not skip and folder.is_dir() and any(folder.iterdir()):
        raise click.UsageError(
            f"{folder} holds samples of an earlier run, which would be measured too: "
            "name another --samples-dir, measure that folder in place of the model, or go on "
            "with the sampling by --existing skip"
        )
    model = load(name, weights=options["weights"])
    settings = {"seed": options["seed"], "skip": skip}
    if options["samples"] is not None:
        settings["samples"] = options["samples"]
    if options["protocol"] == "lda":
        if audio is None:
            raise click.UsageError("--protocol lda samples models on speech: give --audio")
        files = sampling.sample_lda(model, audio, folder, **settings)
    else:
        files = sampling.sample_multires(model, reference, folder, audio=audio, **settings)
    with resumable(lambda: "With --existing skip the same command goes on."):
        for _ in Progress(files, desc=f"sampling {label}", unit="clip"):
            pass
