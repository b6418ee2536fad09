"""A trained multires model: load it, give it speech or a style or nothing, get motion."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, hear
from gesturekit.errors import ModelError
from gesturekit.formats.root_path import as_root_path
from gesturekit.motion.motion import Motion
from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.chunks import Condition, LevelConditions, sample
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.data import Normaliser
from gesturekit.multires.editing import (
    full_frames,
    keep_unedited,
    level_motion,
    lock_feet_but,
    motion_level,
    moved,
    over_keyframes,
)
from gesturekit.multires.holding import (
    Hold,
    KeyframeHold,
    PathHold,
    fastest_second,
    normalised,
    plain_values,
)
from gesturekit.multires.interpolation import resample
from gesturekit.multires.keeping import KeptParts
from gesturekit.multires.model_format import TrainedSequence, model_arguments, model_parts
from gesturekit.multires.networks import MultiresGenerator
from gesturekit.multires.noise import Recall
from gesturekit.multires.styles import asked_styles, level_track
from gesturekit.postprocess import smooth_motion
from gesturekit.training.device import prepare_device
from gesturekit.training.model_folder import load_model, model_readme, save_model
from gesturekit.training.seeds import generator

_MARGIN_COARSE = 2
"""Frames of the first level that are made before a motion and after it, and cut off."""


_TOO_FAST = 1.25
_STROLL = 0.1
"""Times the fastest second in training, and m/s: faster than both is worth a warning."""

log = logging.getLogger(__name__)


class MultiresModel:
    """Motion by a pyramid of small generators: for speech, for a style, for both or for nothing.

    Args:
        fps: frames per second of the motion.
        representation: the rig and its modelled joints.
        conditioner: turns waves into the features the model hears; None for one that does not.
        styles: names of the styles it knows; empty for one that was told none.
        normaliser: of motion vectors.
        network_config: how the pyramid is built.
        residual: whether finer levels hear only what the coarser ones lack.
        recall: frames of the pieces of z* that noise is put together from; 0 draws it anew.
        network: the generators.
        sigma: (N, L) noise spread of each training sequence and level.
        z_star: the noise from which each training sequence is reconstructed, by its name.
        sequences: what else that takes, by its name.
        speakers: a reference skeleton for each speaker that the corpus named.
        fastest: m/s over the ground in the fastest second of the training; None if unknown.
        smooth: seconds, of `smooth_motion` on what is generated; None for none.
    """

    kind = "multires"

    def __init__(
        self,
        *,
        fps: float,
        representation: MultiresRepresentation,
        conditioner: SpeechConditioner | None,
        styles: Sequence[str] = (),
        normaliser: Normaliser,
        network_config: NetworkConfig,
        residual: bool,
        recall: int = 0,
        network: MultiresGenerator,
        sigma: Tensor,
        z_star: Mapping[str, Tensor],
        sequences: Mapping[str, TrainedSequence],
        speakers: Mapping[str, Skeleton],
        fastest: float | None = None,
        smooth: float | None = None,
    ) -> None:
        self.fps = fps
        self.representation = representation
        self.conditioner = conditioner
        self.styles = tuple(styles)
        self.normaliser = normaliser
        self.network_config = network_config
        self.residual = residual
        self.recall = recall
        self.network = network
        self.sigma = sigma
        self.z_star = dict(z_star)
        self.sequences = dict(sequences)
        self.speakers = dict(speakers)
        self.fastest = fastest
        self.smooth = smooth

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def margin(self) -> int:
        """Frames made before a motion and after it, and cut off.

        At its ends a pyramid moves less: levels hold their end frames when they are upsampled,
        and convolutions see the motion mirrored. With a margin that happens outside of what is
        kept, and a motion of a single frame is no special case.
        """
        return round(_MARGIN_COARSE * (4 / 3) ** (self.network_config.levels - 1))

    def generate(
        self,
        speech: str | Path | af.Wave | None = None,
        *,
        style: str | None = None,
        path: str | Path | RootPath | Motion | None = None,
        events: Any = None,
        seconds: float | None = None,
        samples: int = 1,
        seed: int = 0,
        guidance: float | None = None,
        speaker: str | None = None,
        level_style: str | None = None,
        levels: int | None = None,
        keyframes: str | Path | Motion | None = None,
        keyframe_level: int = 1,
        like: str | Path | Motion | None = None,
        keep: Mapping[float, str | Path | Motion] | None = None,
        foot_lock: bool = True,
        smooth: float | None = None,
    ) -> Motion | list[Motion]:
        """Motion, as long as the speech or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file or a `Wave`, for a model that hears. Without it, such a model
                moves idly for `seconds`.
            seconds: length without speech, s.
            samples: how many different motions to make; more than one gives a list.
            seed: the same seed, speech and sample number give the same motion.
            style: one of `styles`, or spans of seconds that blend into one another:
                `old@0-10,angry@10-20`. None draws one for each sample.
            path: what the root follows over the ground, within 10 cm, facing where the path looks:
                a table or a motion file, see `load_root_path`. Without speech
                and seconds it decides the length; past its end the body stays there.
            events: this kind of model has none.
            guidance: this kind of model has none.
            speaker: whose body to move: one of `speakers`; None takes the reference skeleton.
            level_style: styles of single levels, 1 the coarsest, which go before `style`:
                `1-4=describe,5-8=angry`.
            levels: stop after so many levels; the motion has their lower frame rate. Edited, it
                comes back as `keyframes`. It is made without margins, and so is not the beginning
                of what the same seed makes whole.
            keyframes: a motion that takes the place of a coarse level; the finer levels add
                detail, and what is slow stays as it is given. It decides the length, and all but
                this: where it is what this `seed` made by `levels`, the untouched parts are taken
                as they were made. Of the model's rig, or of another one that moves like it.
            keyframe_level: which level that is, 1 the coarsest.
            like: as `keyframes`, but the finer levels may change all of it: a motion done in the
                manner of the model (style transfer).
            keep: motions by the second at which each begins; the model makes what is between,
                before and after them, up to `seconds` or to the end of the last one. They come
                back as they are, and where they are in the world.
            foot_lock: keep feet where they stand, by the contact labels that the model makes; see
                `gesturekit.postprocess`. False leaves them as the network moves them.
            smooth: seconds; movements of the upper body that are shorter are smoothed away, but for
                its beats, see `gesturekit.postprocess.smooth_motion`. None takes what the model was
                trained to be given (its `smooth`), 0 smooths nothing.

        Raises:
            ModelError: a control, style or speaker this model does not have, or neither speech
                nor seconds.
            AudioError: the speech cannot be read.
        """
        unknown = {"events": events, "guidance": guidance}
        if not self.styles:
            unknown |= {"style": style, "level_style": level_style}
        self._check(unknown, speaker, samples, {"levels": levels, "keyframe_level": keyframe_level})
        seconds_smoothed = self.smooth if smooth is None else smooth
        n_levels = self.network_config.levels
        controls = {"path": path, "keyframes": keyframes, "like": like, "keep": keep}
        named = [name for name, value in controls.items() if value is not None]
        # A coarse level is edited frame by frame: its own frames, and none around them.
        whole = keyframes is None and like is None and levels in (None, n_levels)
        if len(named) > 1 or (named in (["path"], ["keep"]) and not whole):
            raise ModelError(f"{' and '.join(named)}: give one of them, and all levels with it")
        if keep is not None and speaker is not None:
            raise ModelError("keep goes without speaker: what is kept has a body of its own")
        skeleton = None if speaker is None else self.speakers[speaker]
        start = keyframes if like is None else like
        if isinstance(start, (str, Path)):
            start = Motion.load(start)
        if start is not None and speech is None and seconds is None:
            seconds = full_frames(start, self.fps) / self.fps
        kept = None if keep is None else KeptParts(keep, self.representation, self.fps)
        if kept is not None and speech is None and seconds is None:
            seconds = kept.end / self.fps
        if path is not None:
            path = as_root_path(path)
        if path is not None and speech is None and seconds is None:
            seconds = path.frames_within(self.fps) / self.fps
        features = hear(self.conditioner, speech, seconds, self.fps)
        n_frames = len(features)
        if kept is not None and kept.end > n_frames:
            raise ModelError(
                f"keep: the last part ends at {kept.end / self.fps:g} s, after the motion's end "
                f"({n_frames / self.fps:g} s)"
            )
        margin = self.margin if whole else 0
        # Mirrored, the speech goes on as it is at its ends: talking or silent.
        features = np.pad(features, ((margin, margin), (0, 0)), mode="reflect")
        lengths = af.level_lengths(len(features), n_levels)
        along = held = None
        if path is not None:
            path = path.resample(self.fps, n_frames)
            size = self.representation.size_of(skeleton)
            own = replace(path, positions=path.positions / size)
            held = along = PathHold(own, self.representation, self.normaliser, lengths, margin)
            steps = np.diff(own.positions, axis=0)
            self._warn_of_speed("the path", fastest_second(steps, self.fps))
        elif kept is not None:
            self._warn_of_speed("between the kept parts the body", kept.fastest_gap())
            held = kept.hold(self.normaliser, lengths, margin)

        def motion(number: int) -> Motion:
            told: list[Tensor] = []
            if self.styles:
                rng = generator(seed, "sample", number, "style")
                told = asked_styles(self.styles, style, level_style, lengths, self.fps, rng, margin)
            condition = self._condition(features, lengths, told)
            given = np.zeros(n_frames) if kept is None else kept.given(n_frames)
            wanted, edited = None, np.zeros(0, bool)
            if start is not None:
                values, touched = self._in_place(
                    start, keyframe_level - 1, condition, lengths, seed, number
                )
                coarse = normalised(self.normaliser, values)
                hold = None
                if like is None:
                    hold = KeyframeHold(coarse, touched, self.representation)
                    edited = touched.any(axis=1)
                    wanted = level_motion(self.representation, values, self.fps, n_frames)
                    given = hold.stepped(n_frames)
                vectors = self._above(coarse, keyframe_level, condition, lengths, hold)
            else:
                vectors = self._sample(condition, lengths[:levels], seed, number, held)
            values = self._values(vectors)
            if along is not None:
                values = along.placed(values)
            values = values[margin : len(values) - margin]
            if start is None and not whole:
                return level_motion(self.representation, values, self.fps, lengths[-1])
            if kept is not None:
                made = kept.placed(values)
            else:
                made = self.representation.decode(values, self.fps, skeleton=skeleton)
            if path is not None:
                made = moved(self.representation, made, path.positions[0])
            if seconds_smoothed:
                made = smooth_motion(made, seconds_smoothed)
            free = made
            if foot_lock:
                labels = self.representation.contacts(values)
                made = lock_feet_but(free, labels, given, keep_path=held is not None)
            if edited.any():
                made = over_keyframes(
                    self.representation, free, self._path(made), self._path(wanted), edited
                )
                if foot_lock:
                    made = lock_feet_but(made, labels, given, keep_path=True)
            return made if kept is None else kept.restored(made)

        # One motion at a time: in a batch, sums would be made in another order, and a motion
        # would depend on how many were asked for.
        motions = [motion(number) for number in range(samples)]
        return motions[0] if samples == 1 else motions

    def reconstruct(self, name: str, speech: str | Path | af.Wave | None = None) -> Motion:
        """A training sequence, from the noise that stands for it; it faces +Z on the whole.

        Args:
            name: one of `sequences`.
            speech: its sound, for a model that hears.

        Raises:
            ModelError: an unknown sequence, or a model that hears and is given nothing.
        """
        if name not in self.sequences:
            known = ", ".join(sorted(self.sequences)) or "the model names none"
            raise ModelError(f"sequence {name!r}: the model was not trained on it ({known})")
        sequence = self.sequences[name]
        if self.conditioner is not None and speech is None:
            raise ModelError(f"sequence {name!r}: the model hears; give the sequence's speech")
        seconds = sequence.frames / self.fps if speech is None else None
        features = hear(self.conditioner, speech, seconds, self.fps)[: sequence.frames]
        lengths = af.level_lengths(sequence.frames, self.network_config.levels)
        if len(features) < sequence.frames:
            raise ModelError(
                f"sequence {name!r}: it has {sequence.frames} frames, its speech {len(features)}"
            )
        told: list[Tensor] = []
        if self.styles:
            track = level_track(self.styles, sequence.style or "", lengths[-1], self.fps)
            told = [resample(track, n)[None] for n in lengths]
        noises = [self.z_star[name].reshape(1, -1, lengths[0]), *[None] * (len(lengths) - 1)]
        condition = self._condition(features, lengths, told)
        vectors = sample(self.network, noises, lengths, condition)
        return self.representation.decode(self._values(vectors), self.fps)

    def _path(self, motion: Motion) -> np.ndarray:
        """(T, 2) where the root is over the ground, x and z, m."""
        return motion.positions()[:, self.representation.root][:, [0, 2]]

    def _check(
        self,
        unknown: Mapping[str, Any],
        speaker: str | None,
        samples: int,
        levels: Mapping[str, int | None],
    ) -> None:
        """Whether the model can do what it is asked."""
        for name, value in unknown.items():
            if value is not None:
                raise ModelError(f"{name}={value!r}: this multires model knows no {name}")
        if speaker is not None and speaker not in self.speakers:
            known = ", ".join(sorted(self.speakers)) or "its corpus named none"
            raise ModelError(f"speaker={speaker!r}: the model does not know them ({known})")
        if samples < 1:
            raise ModelError(f"samples={samples}: ask for at least 1")
        count = self.network_config.levels
        for name, level in levels.items():
            if level is not None and not 1 <= level <= count:
                raise ModelError(f"{name}={level}: the model has levels 1 (coarse) to {count}")

    def _in_place(
        self,
        motion: Motion,
        level: int,
        condition: Condition | None,
        lengths: list[int],
        seed: int,
        number: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """(T_i, D) vectors of a motion in the place of a level, and which of them were edited."""
        values = motion_level(self.representation, motion, self.fps, lengths, level)
        if motion.n_frames != lengths[level]:
            return values, np.ones(values.shape, bool)
        # Perhaps an edit of what this seed made.
        made = self._values(self._sample(condition, lengths[: level + 1], seed, number))
        unedited = level_motion(self.representation, made, self.fps, lengths[-1])
        read = motion_level(self.representation, unedited, self.fps, lengths, level)
        return keep_unedited(values, made, read)

    def _above(
        self,
        coarse: Tensor,
        above: int,
        condition: Condition | None,
        lengths: list[int],
        hold: Hold | None,
    ) -> Tensor:
        """(1, D, T) what the levels from `above` on make of a level (1, D, T_i) below them."""
        return sample(
            self.network,
            [None] * (len(lengths) - above),
            lengths[above:],
            condition,
            first=above,
            coarser=coarse,
            hold=hold,
        )

    def _condition(
        self, features: np.ndarray, lengths: Sequence[int], styles: Sequence[Tensor]
    ) -> Condition | None:
        """What each level is told; None where there is nothing to tell."""
        if not features.shape[1] and not styles:
            return None
        return LevelConditions(features, lengths, self.residual, styles)

    def _sample(
        self,
        condition: Condition | None,
        lengths: list[int],
        seed: int,
        number: int,
        hold: Hold | None = None,
    ) -> Tensor:
        """(1, D, T) normalised motion vectors of sample `number`, margins included."""
        rng = generator(seed, "sample", number, "level", 1)
        noises = [self._noise(condition, lengths[0], rng), *[None] * (len(lengths) - 1)]
        return sample(self.network, noises, lengths, condition, hold=hold)

    def _noise(self, condition: Condition | None, n_frames: int, rng: torch.Generator) -> Tensor:
        """(1, 1 or D, T_1) that a random motion begins with."""
        if not self.recall:
            return torch.randn(1, 1, n_frames, generator=rng) * self.sigma[:, 0].mean()
        names = sorted(self.z_star)
        owners, wanted = [0] * len(names), [0] * n_frames
        if self.styles:
            owners = [self.styles.index(self.sequences[name].style) for name in names]
            told = condition(0, 0, n_frames)[0, -len(self.styles) :]
            wanted = told.argmax(dim=0).tolist()
        return Recall([self.z_star[name] for name in names], owners, self.recall)(wanted, rng)

    def _values(self, vectors: Tensor) -> np.ndarray:
        """(T, 6 K + C + 3) normalised vectors (1, D, T) in their own units."""
        values = plain_values(self.normaliser, vectors)
        if not np.isfinite(values).all():
            raise ModelError("the model gave NaN; its weights are damaged or it was trained badly")
        return values

    def _warn_of_speed(self, what: str, speed: float) -> None:
        if self.fastest is not None and speed > max(_TOO_FAST * self.fastest, _STROLL):
            log.warning(
                "%s goes %.2f m/s; nothing in the training was faster than %.2f m/s, and feet will "
                "slide",
                what,
                speed,
                self.fastest,
            )

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        config, rig, tensors = model_parts(self)
        save_model(folder, config, rig, tensors, self._readme(notes or {}))

    def _readme(self, notes: Mapping[str, str]) -> str:
        rows = {
            "Kind": f"multires, {self.network_config.levels} levels",
            "Motion": f"{self.fps:g} fps, {len(self.representation.joints)} of "
            f"{self.skeleton.n_joints} joints modelled",
        }
        call = "seconds=10"
        if self.conditioner is not None:
            rows["Hears"] = json.dumps(self.conditioner.extractor.spec)
            call = '"speech.wav"'
        if self.styles:
            rows["Styles"] = ", ".join(self.styles)
            call += f', style="{self.styles[0]}"'
        return model_readme(rows | notes, call)

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        weights: str | Path | None = None,
        device: str = "cpu",
        dtype: Literal["fp32"] = "fp32",
    ) -> MultiresModel:
        """Read a model folder.

        Args:
            folder: as written by `save`.
            weights: the WavLM weights it was trained with, where it hears by WavLM.
            device: where WavLM computes: auto, cpu, cuda, cuda:1 ... The pyramid stays on the CPU.
            dtype: of the pyramid; there is one only.

        Raises:
            ModelError: a part is missing, damaged, or of a newer format; another dtype.
            WeightsError: weights are asked for, or are not those of training.
            ConfigError: there is no such device.
        """
        if dtype != "fp32":
            raise ModelError(f"dtype={dtype!r}: {folder} is a multires model, which is fp32 only")
        device = str(prepare_device(device))
        return load_model(
            folder, cls.kind, lambda parts: cls(**model_arguments(parts, weights, device))
        )
