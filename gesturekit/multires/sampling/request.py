"""What motions are asked for by: checked, files read, and how long each level must be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any

import numpy as np

import audio_features as af
from gesturekit.corpus.speech import speech_features
from gesturekit.errors import ModelError
from gesturekit.formats.tables.root_path import as_root_path
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.constraints.inbetweening import KeptParts
from gesturekit.multires.constraints.keyframes import fit_keyframes, full_frames
from gesturekit.multires.sampling.styles import asked_styles
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel


@dataclass(frozen=True, eq=False)
class Request:
    """Motions to make that differ by chance alone.

    Attributes:
        samples: how many.
        seed: where chance comes from, with the number of a motion.
        wave: the speech, or None.
        features: (T + 2 margin, S) what the model hears; S is 0 for one that does not.
        margin: frames made before a motion and after it, and cut off.
        lengths: frames of each level, margins included.
        levels: how many of them are made from noise.
        style: see `asked_styles`.
        level_style: see `asked_styles`.
        skeleton: whose body moves; None for the reference one.
        start: a motion that takes the place of a level, so that noise is not needed; or None.
        start_level: which level that is, from 0.
        held_to_start: finer levels leave what is slow in `start` as it is (keyframes), or may
            change all of it (likeness).
        path: what the root follows, T frames at the model's rate, or None.
        kept: parts of the motion that are given, or None.
        foot_lock: whether feet are kept where they stand.
        smooth: seconds of `smooth_motion`; None or 0 for none.
    """

    samples: int
    seed: int
    wave: af.Wave | None
    features: np.ndarray
    margin: int
    lengths: list[int]
    levels: int
    style: str | None
    level_style: str | None
    skeleton: Skeleton | None
    start: Motion | None
    start_level: int
    held_to_start: bool
    path: RootPath | None
    kept: KeptParts | None
    foot_lock: bool
    smooth: float | None

    @classmethod
    def of(
        cls,
        model: MultiresModel,
        *,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
        samples: int,
        seed: int,
        style: str | None,
        level_style: str | None,
        speaker: str | None,
        levels: int | None,
        keyframes: str | Path | Motion | None,
        keyframe_level: int,
        like: str | Path | Motion | None,
        path: str | Path | RootPath | Motion | None,
        keep: Mapping[float, str | Path | Motion] | None,
        foot_lock: bool,
        smooth: float | None,
        unknown: Mapping[str, Any],
    ) -> Request:
        """What `MultiresModel.generate` is asked, whose words and errors these are.

        Args:
            unknown: what no model of this kind can be asked, by name.
        """
        check_controls(
            model,
            samples=samples,
            style=style,
            level_style=level_style,
            speaker=speaker,
            levels=levels,
            keyframe_level=keyframe_level,
            unknown=unknown,
        )
        start = keyframes if like is None else like
        n_levels = model.network_config.levels
        whole = start is None and levels in (None, n_levels)
        leads = {"path": path, "keyframes": keyframes, "like": like, "keep": keep}
        named = [name for name, lead in leads.items() if lead is not None]
        _check_together(named, levels not in (None, n_levels), speaker)
        if isinstance(start, (str, Path)):
            start = Motion.load(start)
        kept = None if keep is None else KeptParts(keep, model.representation, model.fps)
        way = None if path is None else as_root_path(path, model.representation.scale)
        is_led = speech is None and seconds is None

        def fitted(n_frames: int | None) -> Motion:
            levels, level = n_levels, keyframe_level - 1
            return fit_keyframes(model.representation, start, model.fps, levels, level, n_frames)

        if is_led:
            start = start if keyframes is None else fitted(None)
            seconds = _own_seconds(model.fps, start, kept, way)
        if model.conditioner is not None and not isinstance(speech, (af.Wave, NoneType)):
            speech = af.Wave.load(speech)
        features = speech_features(model.conditioner, speech, seconds, model.fps)
        n_frames = len(features)
        if keyframes is not None and not is_led:
            start = fitted(n_frames)
        if kept is not None:
            _check_within(kept, n_frames)
        # A coarse level is edited frame by frame: its own frames, and none around them.
        margin = model.network_config.margin if whole else 0
        return cls(
            samples=samples,
            seed=seed,
            wave=speech,
            # Mirrored, the speech goes on as it is at its ends: talking or silent.
            features=np.pad(features, ((margin, margin), (0, 0)), mode="reflect"),
            margin=margin,
            lengths=af.level_lengths(n_frames + 2 * margin, n_levels),
            levels=n_levels if levels is None else levels,
            style=style,
            level_style=level_style,
            skeleton=None if speaker is None else model.speakers[speaker],
            start=start,
            start_level=keyframe_level - 1,
            held_to_start=like is None,
            path=None if way is None else way.resample(model.fps, n_frames),
            kept=kept,
            foot_lock=foot_lock,
            smooth=model.smooth if smooth is None else smooth,
        )

    @property
    def n_frames(self) -> int:
        """T."""
        return self.lengths[-1] - 2 * self.margin


def check_controls(
    model: MultiresModel,
    *,
    samples: int,
    style: str | None,
    level_style: str | None,
    speaker: str | None,
    levels: int | None,
    keyframe_level: int,
    unknown: Mapping[str, Any],
) -> None:
    """Check what does not depend on the speech; arguments as for `Request.of`.

    Raises:
        ModelError: a control, style, level or speaker that the model does not have.
    """
    if model.styles:
        lengths = [1] * model.network_config.levels
        rng = rng_for(0, "check")
        asked_styles(model.styles, style, level_style, lengths, model.fps, rng)
    else:
        unknown = {**unknown, "style": style, "level_style": level_style}
    _check_known(model, unknown, speaker, samples)
    _check_levels(model, levels=levels, keyframe_level=keyframe_level)


def _check_known(
    model: MultiresModel, unknown: Mapping[str, Any], speaker: str | None, samples: int
) -> None:
    for name, value in unknown.items():
        if value is not None:
            raise ModelError(f"{name}={value!r}: this multires model knows no {name}")
    if speaker is not None and speaker not in model.speakers:
        known = ", ".join(sorted(model.speakers)) or "its corpus named none"
        raise ModelError(f"speaker={speaker!r}: the model does not know them ({known})")
    if samples < 1:
        raise ModelError(f"samples={samples}: ask for at least 1")


def _check_levels(model: MultiresModel, **levels: int | None) -> None:
    count = model.network_config.levels
    for name, level in levels.items():
        if level is not None and not 1 <= level <= count:
            raise ModelError(f"{name}={level}: the model has levels 1 (coarse) to {count}")


def _check_together(leads: list[str], fewer_levels: bool, speaker: str | None) -> None:
    """Of what may lead a motion one at most, and with all levels."""
    if len(leads) > 1:
        raise ModelError(f"{' and '.join(leads)}: give one of them")
    if fewer_levels and leads:
        raise ModelError(f"{leads[0]} goes with all levels: leave levels away")
    if fewer_levels and speaker is not None:
        raise ModelError("speaker goes with all levels: coarse ones move the reference skeleton")
    if leads == ["keep"] and speaker is not None:
        raise ModelError("keep goes without speaker: what is kept has a body of its own")


def _check_within(kept: KeptParts, n_frames: int) -> None:
    if kept.end > n_frames:
        raise ModelError(
            f"keep: the last part ends at {kept.end / kept.fps:g} s, after the motion's end "
            f"({n_frames / kept.fps:g} s)"
        )


def _own_seconds(
    fps: float, start: Motion | None, kept: KeptParts | None, path: RootPath | None
) -> float | None:
    """How long a motion is that nothing but what leads it gives a length."""
    if start is not None:
        return full_frames(start, fps) / fps
    if kept is not None:
        return kept.end / fps
    return None if path is None else path.frames_within(fps) / fps
