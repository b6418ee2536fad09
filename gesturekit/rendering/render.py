"""Many wavs through one model; a broken one never stops the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import audio_features as af
from gesturekit.corpus.pairing import SPEECH_SUFFIXES
from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.motion.motion import Motion

FORMATS = ("bvh", "npz", "html", "png")


@dataclass(frozen=True)
class Outcome:
    """What became of one input: the files written, or the reason why there are none."""

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
) -> Iterator[Outcome]:
    """Generate motion for each audio file and write it as STEM.bvh (STEM_s1.bvh ... for samples).

    Args:
        model: as `gesturekit.load` gives it.
        sources: audio files; folders stand for the audio files in them.
        out: folder for the results.
        formats: of bvh, npz, html (a player with sound), png (a picture).
        seed: the same seed gives the same files, whatever else is rendered beside.
        samples: how many motions for each file.
        seconds: without sources, how long an idle motion to make.

    Yields:
        an outcome for each file, as it is done.

    Raises:
        ConfigError: an unknown format, or two sources that would write the same file.
    """
    unknown = [name for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise ConfigError(f"format {', '.join(unknown) or '(none)'}: known: {', '.join(FORMATS)}")
    if not sources:
        yield _render_one(
            "motion",
            None,
            out / "motion",
            formats,
            lambda: model.generate(seconds=seconds, samples=samples, seed=seed),
        )
        return
    files = _expand(sources)
    _refuse_clashes(files, out)
    for path in files:
        yield _render_one(
            str(path),
            path,
            out / path.stem,
            formats,
            lambda path=path: model.generate(path, samples=samples, seed=seed, seconds=seconds),
        )


def _render_one(
    source: str,
    audio: Path | None,
    stem: Path,
    formats: Sequence[str],
    generate: Callable[[], Motion | list[Motion]],
) -> Outcome:
    try:
        made = generate()
        motions = made if isinstance(made, list) else [made]
        files = []
        for number, motion in enumerate(motions, start=1):
            name = stem.name if len(motions) == 1 else f"{stem.name}_s{number}"
            for kind in formats:
                path = stem.with_name(f"{name}.{kind}")
                sound = {"audio": audio} if kind in ("html", "png") and audio else {}
                motion.save(path, **sound)
                files.append(path)
    except (GestureKitError, af.AudioFeaturesError, OSError) as error:
        return Outcome(source, error=str(error))
    return Outcome(source, tuple(files))


def _expand(sources: Sequence[Path]) -> list[Path]:
    files = []
    for source in sources:
        if source.is_dir():
            inside = sorted(p for p in source.iterdir() if p.suffix.lower() in SPEECH_SUFFIXES)
            if not inside:
                raise ConfigError(f"{source}: the folder holds no audio files")
            files.extend(inside)
        else:
            files.append(source)
    return files


def _refuse_clashes(files: Sequence[Path], out: Path) -> None:
    seen: dict[str, Path] = {}
    for path in files:
        if path.stem in seen and seen[path.stem] != path:
            raise ConfigError(
                f"{seen[path.stem]} and {path} would both be written as {out / path.stem}; "
                "render them into different folders"
            )
        seen[path.stem] = path
