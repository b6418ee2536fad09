"""A trained multires model: load it, give it speech or a style or nothing, get motion."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, hear
from gesturekit.errors import ModelError
from gesturekit.motion.motion import Motion
from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.chunks import Condition, LevelConditions, sample
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.data import Normaliser
from gesturekit.multires.editing import full_frames, keep_unedited, level_motion, motion_level
from gesturekit.multires.interpolation import resample
from gesturekit.multires.networks import MultiresGenerator
from gesturekit.multires.styles import asked_styles, level_track
from gesturekit.postprocess import lock_feet
from gesturekit.training.config import build, to_dict
from gesturekit.training.model_folder import ModelParts, load_model, model_readme, save_model
from gesturekit.training.seeds import generator

_MARGIN_COARSE = 2
"""Frames of the first level that are made before a motion and after it, and cut off."""


@dataclass(frozen=True)
class TrainedSequence:
    """A training sequence, as far as its reconstruction needs it: frames, and its style."""

    frames: int
    style: str | None = None


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
        network: the generators.
        sigma: (N, L) noise spread of each training sequence and level.
        z_star: the noise from which each training sequence is reconstructed, by its name.
        sequences: what else that takes, by its name.
        speakers: a reference skeleton for each speaker that the corpus named.
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
        network: MultiresGenerator,
        sigma: Tensor,
        z_star: Mapping[str, Tensor],
        sequences: Mapping[str, TrainedSequence],
        speakers: Mapping[str, Skeleton],
    ) -> None:
        self.fps = fps
        self.representation = representation
        self.conditioner = conditioner
        self.styles = tuple(styles)
        self.normaliser = normaliser
        self.network_config = network_config
        self.residual = residual
        self.network = network
        self.sigma = sigma
        self.z_star = dict(z_star)
        self.sequences = dict(sequences)
        self.speakers = dict(speakers)

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
        path: str | Path | None = None,
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
        foot_lock: bool = True,
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
            path: this kind of model has none.
            events: this kind of model has none.
            guidance: this kind of model has none.
            speaker: whose body to move: one of `speakers`; None takes the reference skeleton.
            level_style: styles of single levels, 1 the coarsest, which go before `style`:
                `1-4=describe,5-8=angry`.
            levels: stop after so many levels; the motion has their lower frame rate. Edited, it
                comes back as `keyframes`. It is made without margins, and so is not the beginning
                of what the same seed makes whole.
            keyframes: a motion that takes the place of a coarse level; the finer levels add
                detail. It decides the length, and all but this: where it is what this `seed`
                made by `levels`, the untouched parts are taken as they were made.
                Of the model's rig, or of another one that moves like it (style transfer).
            keyframe_level: which level that is, 1 the coarsest.
            foot_lock: keep feet where they stand, by the contact labels that the model makes; see
                `gesturekit.postprocess`. False gives the motion as it comes out of the network.

        Raises:
            ModelError: a control, style or speaker this model does not have, or neither speech
                nor seconds.
            AudioError: the speech cannot be read.
        """
        unknown = {"path": path, "events": events, "guidance": guidance}
        if not self.styles:
            unknown |= {"style": style, "level_style": level_style}
        for name, value in unknown.items():
            if value is not None:
                raise ModelError(f"{name}={value!r}: this multires model knows no {name}")
        if speaker is not None and speaker not in self.speakers:
            known = ", ".join(sorted(self.speakers)) or "its corpus named none"
            raise ModelError(f"speaker={speaker!r}: the model does not know them ({known})")
        if samples < 1:
            raise ModelError(f"samples={samples}: ask for at least 1")
        n_levels = self.network_config.levels
        for name, value in {"levels": levels, "keyframe_level": keyframe_level}.items():
            if value is not None and not 1 <= value <= n_levels:
                raise ModelError(f"{name}={value}: the model has levels 1 (coarse) to {n_levels}")
        if isinstance(keyframes, (str, Path)):
            keyframes = Motion.load(keyframes)
        if keyframes is not None and speech is None and seconds is None:
            seconds = full_frames(keyframes, self.fps) / self.fps
        features = hear(self.conditioner, speech, seconds, self.fps)
        # A coarse level is edited frame by frame: its own frames, and none around them.
        whole = keyframes is None and levels in (None, n_levels)
        margin = self.margin if whole else 0
        # Mirrored, the speech goes on as it is at its ends: talking or silent.
        features = np.pad(features, ((margin, margin), (0, 0)), mode="reflect")
        lengths = af.level_lengths(len(features), n_levels)

        def motion(number: int) -> Motion:
            told: list[Tensor] = []
            if self.styles:
                rng = generator(seed, "sample", number, "style")
                told = asked_styles(self.styles, style, level_style, lengths, self.fps, rng, margin)
            condition = self._condition(features, lengths, told)
            if keyframes is not None:
                vectors = self._above(
                    keyframes, keyframe_level - 1, condition, lengths, seed, number
                )
            else:
                vectors = self._sample(condition, lengths[:levels], seed, number)
            values = self._values(vectors[..., margin : vectors.shape[-1] - margin])
            if keyframes is None and not whole:
                return level_motion(self.representation, values, self.fps, lengths[-1])
            skeleton = None if speaker is None else self.speakers[speaker]
            return self._decoded(values, skeleton, foot_lock)

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

    def _above(
        self,
        motion: Motion,
        level: int,
        condition: Condition | None,
        lengths: list[int],
        seed: int,
        number: int,
    ) -> Tensor:
        """(1, D, T) what the levels above make of a motion in the place of this one."""
        values = motion_level(self.representation, motion, self.fps, lengths, level)
        if motion.n_frames == lengths[level]:
            # Perhaps an edit of what this seed made.
            made = self._values(self._sample(condition, lengths[: level + 1], seed, number))
            unedited = level_motion(self.representation, made, self.fps, lengths[-1])
            read = motion_level(self.representation, unedited, self.fps, lengths, level)
            values = keep_unedited(values, made, read)
        given = self.normaliser.forward(torch.from_numpy(values.T).float()[None])
        above = level + 1
        noises = [None] * (len(lengths) - above)
        return sample(self.network, noises, lengths[above:], condition, first=above, coarser=given)

    def _condition(
        self, features: np.ndarray, lengths: Sequence[int], styles: Sequence[Tensor]
    ) -> Condition | None:
        """What each level is told; None where there is nothing to tell."""
        if not features.shape[1] and not styles:
            return None
        return LevelConditions(features, lengths, self.residual, styles)

    def _sample(
        self, condition: Condition | None, lengths: list[int], seed: int, number: int
    ) -> Tensor:
        """(1, D, T) normalised motion vectors of sample `number`, margins included."""
        rng = generator(seed, "sample", number, "level", 1)
        spread = self.sigma[:, 0].mean()
        noises: list[Tensor | None] = [torch.randn(1, 1, lengths[0], generator=rng) * spread]
        noises += [None] * (len(lengths) - 1)
        return sample(self.network, noises, lengths, condition)

    def _values(self, vectors: Tensor) -> np.ndarray:
        """(T, 6 K + C + 3) normalised vectors (1, D, T) in their own units."""
        values = self.normaliser.inverse(vectors)[0].T.double().numpy()
        if not np.isfinite(values).all():
            raise ModelError("the model gave NaN; its weights are damaged or it was trained badly")
        return values

    def _decoded(self, values: np.ndarray, skeleton: Skeleton | None, foot_lock: bool) -> Motion:
        motion = self.representation.decode(values, self.fps, skeleton=skeleton)
        if not foot_lock:
            return motion
        return lock_feet(motion, self.representation.contacts(values))

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        config = {
            "kind": self.kind,
            "fps": self.fps,
            "joints": list(self.representation.joints),
            "features": None
            if self.conditioner is None
            else {
                "spec": self.conditioner.extractor.spec,
                "align": self.conditioner.align,
                "residual": self.residual,
            },
            "styles": list(self.styles),
            "network": to_dict(self.network_config),
            "sequences": {name: asdict(about) for name, about in self.sequences.items()},
        }
        rig = {
            "skeleton": self.skeleton.to_json(),
            "motion": self.representation.to_json(),
            "speakers": {name: body.to_json() for name, body in self.speakers.items()},
        }
        tensors = {f"network.{k}": v.contiguous() for k, v in self.network.state_dict().items()}
        tensors |= {f"z_star.{name}": value for name, value in self.z_star.items()}
        tensors |= {
            "sigma": self.sigma,
            "motion.mean": self.normaliser.mean,
            "motion.scale": self.normaliser.scale,
        }
        if self.conditioner is not None:
            tensors["features.centre"] = torch.from_numpy(self.conditioner.centre)
            tensors["features.scale"] = torch.from_numpy(self.conditioner.scale)
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
    def load(cls, folder: str | Path, *, weights: str | Path | None = None) -> MultiresModel:
        """Read a model folder.

        Args:
            folder: as written by `save`.
            weights: the WavLM weights it was trained with, where it hears by WavLM.

        Raises:
            ModelError: a part is missing, damaged, or of a newer format.
            WeightsError: weights are asked for, or are not those of training.
        """
        return load_model(folder, cls.kind, lambda parts: cls._assemble(parts, weights))

    @classmethod
    def _assemble(cls, parts: ModelParts, weights: str | Path | None) -> MultiresModel:
        config, rig, tensors = parts.config, parts.rig, parts.tensors
        where = str(parts.folder / "config.yaml")
        fps = float(config["fps"])
        skeleton = Skeleton.from_json(rig["skeleton"])
        representation = MultiresRepresentation.from_json(skeleton, rig["motion"])
        features, conditioner = config["features"], None
        if features is not None:
            conditioner = SpeechConditioner(
                af.extractor_from_spec(features["spec"], weights=weights),
                fps,
                features["align"],
                tensors["features.centre"].numpy(),
                tensors["features.scale"].numpy(),
            )
        styles = tuple(map(str, config.get("styles", ())))
        n_condition = len(styles) + (0 if conditioner is None else conditioner.dim)
        network_config = build(NetworkConfig, config["network"], where=where)
        network = MultiresGenerator(representation, n_condition, network_config)
        network.load_state_dict(
            {k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")}
        )
        return cls(
            fps=fps,
            representation=representation,
            conditioner=conditioner,
            styles=styles,
            normaliser=Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
            network_config=network_config,
            residual=bool(features and features["residual"]),
            network=network.eval(),
            sigma=tensors["sigma"],
            z_star={
                k.removeprefix("z_star."): v for k, v in tensors.items() if k.startswith("z_star.")
            },
            # Models of before this was kept can do all but reconstruct.
            sequences={
                name: build(TrainedSequence, about, where=where)
                for name, about in config.get("sequences", {}).items()
            },
            speakers={name: Skeleton.from_json(body) for name, body in rig["speakers"].items()},
        )
