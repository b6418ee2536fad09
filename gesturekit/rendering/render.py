"""Many wavs through one model; a broken one never stops the others."""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import audio_features as af
from gesturekit.errors import ConfigError, GestureKitError, ModelError
from gesturekit.formats.rig import Rig
from gesturekit.formats.sources import SPEECH_SUFFIXES
from gesturekit.motion.motion import Motion

FORMATS = ("bvh", "npz", "html", "png")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """What became of one input: the files written, and the reason why some or all are missing."""

    source: str
    files: tuple[Path, ...] = ()
    error: str | None = None


def render(
    model: Any,
    sources: Sequence[Path],
    out: Path,
    *,
    formats: Sequence[str] = ("bvh",),
    seed: int = 0,
    samples: int = 1,
    seconds: float | None = None,
    speaker: str | None = None,
    channel: int | None = None,
    rig: str | os.PathLike[str] | None = None,
    rig_parts: Mapping[str, str] | None = None,
    foot_lock: bool = True,
    smooth: float | None = None,
    controls: Mapping[str, Any] | None = None,
    skip_existing: bool = False,
) -> Iterator[Outcome]:
    """Generate motion for each audio file and write it as STEM.bvh (STEM_s1.bvh ... for samples).

    What is wrong with a sound (`Wave.faults`) is warned about, and it is rendered all the same.

    Args:
        model: as `gesturekit.load` gives it.
        sources: audio files; folders stand for the audio files in them. A file that is named
            twice is rendered once.
        out: folder for the results.
        formats: of bvh, npz, html (a player with sound), png (a picture).
        seed: the same seed gives the same files, whatever else is rendered beside.
        samples: how many motions for each file.
        seconds: without sources, how long an idle motion to make.
        speaker: whose body to move, of those that the model's corpus named.
        channel: which channel of each file to hear, counted from 1; None for the mean of all.
        rig: whose body to move instead: a motion file, of any names, size and rest pose, or smpl,
            smplh or smplx; see `gesturekit.formats.rig`.
        rig_parts: parts of that body named by hand, where its joints' names do not tell them.
        foot_lock: keep feet where they stand; another body's feet then stand where these do.
        smooth: seconds; movements of the upper body that are shorter are smoothed away, but for
            its beats; see `gesturekit.postprocess.smooth_motion`. None takes what the model says
            of itself, 0 smooths nothing.
        controls: what else `generate` shall be told: style, keyframes ...
        skip_existing: leave out files whose results are all there, whatever they were made with:
            to go on after a stop. Files are written whole or not at all.

    Yields:
        an outcome for each file, as it is done.

    Raises:
        ModelError: a control that this kind of model does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, or a folder for the results that cannot be written to.
        FormatError, MotionError: a rig that cannot be read, or whose parts cannot be told.
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise ConfigError(f"format {', '.join(unknown) or '(none)'}: known: {', '.join(FORMATS)}")
    files = _expand(sources)
    _refuse_clashes(files, out)
    body = None if rig is None else Rig.load(rig, rig_parts)
    asked = {"samples": samples, "seed": seed, "speaker": speaker, "foot_lock": foot_lock}
    asked |= {"smooth": smooth, **(controls or {})}
    _refuse_controls(model, asked)

    def motions(speech: af.Wave | None) -> list[Motion]:
        made = model.generate(speech, seconds=None if sources else seconds, **asked)
        return made if isinstance(made, list) else [made]

    _make_folder(out)
    for path in files if sources else [None]:
        stem = "motion" if path is None else path.stem
        names = [stem] if samples == 1 else [f"{stem}_s{n}" for n in range(1, samples + 1)]
        results = [[out / f"{name}.{kind}" for kind in formats] for name in names]
        if skip_existing and all(file.exists() for made in results for file in made):
            yield Outcome(_source(path))
        else:
            yield _render_one(path, channel, results, body, motions)


def _source(audio: Path | None) -> str:
    return "motion" if audio is None else str(audio)


def _render_one(
    audio: Path | None,
    channel: int | None,
    results: Sequence[Sequence[Path]],
    body: Rig | None,
    generate: Callable[[af.Wave | None], list[Motion]],
) -> Outcome:
    """Fill the files of one sound, a sequence of them for each sample."""
    source = _source(audio)
    files: list[Path] = []
    try:
        wave = None if audio is None else _heard(audio, channel)
        # Where all channels are heard, players get the file as it is.
        sound = audio if channel is None else wave
        for motion, paths in zip(generate(wave), results, strict=True):
            motion = motion if body is None else body.put(motion)
            for path in paths:
                options = {} if body is None else body.options.get(path.suffix, {})
                if path.suffix in (".html", ".png") and audio:
                    options = {"audio": sound}
                motion.save(path, **options)
                files.append(path)
    # torch says RuntimeError where memory runs out.
    except (GestureKitError, af.AudioFeaturesError, OSError, MemoryError, RuntimeError) as error:
        reason = str(error) or "not enough memory"
        # Not every reason names the input: a model that gives NaN, a disk that is full.
        reason = reason if source in reason else f"{source}: {reason}"
        # One line, and printable: a file name need not be text.
        reason = " ".join(reason.encode("utf-8", "replace").decode().splitlines())
        return Outcome(source, tuple(files), reason)
    return Outcome(source, tuple(files))


def _heard(path: Path, channel: int | None) -> af.Wave:
    wave = af.Wave.load(path, channel=channel)
    if not wave.is_silent:  # of silence the model itself tells, and what becomes of it
        for fault in wave.faults():
            log.warning("%s: %s", path, fault)
    return wave


def _expand(sources: Sequence[Path]) -> list[Path]:
    files: dict[str, Path] = {}
    for source in sources:
        inside = [source]
        if source.is_dir():
            inside = sorted(
                path
                for path in source.iterdir()
                if path.suffix.lower() in SPEECH_SUFFIXES and not path.name.startswith(".")
            )
            if not inside:
                raise ConfigError(f"{source}: the folder holds no audio files")
        for path in inside:
            files.setdefault(os.path.realpath(path), path)
    return list(files.values())


def _refuse_clashes(files: Sequence[Path], out: Path) -> None:
    seen: dict[str, Path] = {}
    for path in files:
        if path.stem in seen:
            raise ConfigError(
                f"{seen[path.stem]} and {path} would both be written as {out / path.stem}; "
                "render them into different folders"
            )
        seen[path.stem] = path


def _refuse_controls(model: Any, controls: Mapping[str, Any]) -> None:
    known = inspect.signature(model.generate).parameters
    for name in controls:
        if name not in known:
            raise ModelError(f"{name}: a {model.kind} model knows no {name}")


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        writable = os.access(out, os.W_OK | os.X_OK)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be made ({error.strerror})") from None
    if not writable:
        raise ConfigError(f"{out}: cannot be written to; give another folder")
