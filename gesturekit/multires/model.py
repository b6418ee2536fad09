"""A trained multires model: load it, give it speech or a style or nothing, get motion."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import (
    Speech,
    SpeechConditioner,
    as_speech,
    speech_features,
    to_output_rate,
)
from gesturekit.errors import ModelError, gesturekit_errors
from gesturekit.model import Inputs
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import checked_fps
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.model_format import TrainedSequence, model_arguments, model_parts
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.pyramid import Pyramid
from gesturekit.multires.sampling.request import Request, check_controls
from gesturekit.multires.sampling.sampler import Generation
from gesturekit.multires.sampling.styles import level_track
from gesturekit.multires.training.data import Normaliser
from gesturekit.training.model_folder import load_model, model_readme, rates, save_model
from gesturekit.training.run.device import prepare_device
from gesturekit.training.seeds import checked_seed


class MultiresModel:
    """Motion by a pyramid of small generators: for speech, for a style, for both or for nothing.

    Args:
        fps: frames per second at which the pyramid works.
        representation: the rig and its modelled joints.
        conditioner: turns waves into the features the model hears; None for one that does not.
        styles: names of the styles it knows; empty for one that was told none.
        normaliser: of motion vectors.
        network_config: how the pyramid is built.
        residual: whether finer levels hear only what the coarser ones lack.
        z_star_shuffle: frames of the patches of z* that random noise is made of; 0 draws it anew.
        noise_levels: how many of the coarsest levels are given noise.
        network: the generators.
        sigma: (N, L) noise spread of each training sequence and level.
        z_star: the noise from which each training sequence is reconstructed, by its name.
        sequences: what else that takes, by its name.
        speakers: a reference skeleton for each speaker that the corpus named.
        fastest: m/s over the ground in the fastest second of the training; None if unknown.
        smooth: seconds, of `smooth_motion` on what is generated; None for none.
        recorded_fps: the recordings' rate, which generated motion gets; None for `fps`.
    """

    kind = "multires"
    folder: Path | None = None

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
        z_star_shuffle: int = 0,
        noise_levels: int = 1,
        network: MultiresGenerator,
        sigma: Tensor,
        z_star: Mapping[str, Tensor],
        sequences: Mapping[str, TrainedSequence],
        speakers: Mapping[str, Skeleton],
        fastest: float | None = None,
        smooth: float | None = None,
        recorded_fps: float | None = None,
    ) -> None:
        self.fps = fps
        self.representation = representation
        self.conditioner = conditioner
        self.styles = tuple(styles)
        self.normaliser = normaliser
        self.network_config = network_config
        self.residual = residual
        self.z_star_shuffle = z_star_shuffle
        self.noise_levels = noise_levels
        self.network = network
        self.sigma = sigma
        self.z_star = dict(z_star)
        self.sequences = dict(sequences)
        self.speakers = dict(speakers)
        self.fastest = fastest
        self.smooth = smooth
        self.recorded_fps = fps if recorded_fps is None else recorded_fps

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        return Inputs(speech=self.conditioner is not None)

    @gesturekit_errors()
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
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
        fps: float | None = None,
    ) -> Motion | list[Motion]:
        """Motion, as long as the speech or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file, a `Wave`, or an array of samples (see `Wave.from_array`), for a
                model that hears. Without it, such a model moves idly for `seconds`.
            sample_rate: Hz, of an array.
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
                of what the same seed makes whole. Nothing but style and speech goes with it.
            keyframes: a motion that takes the place of a coarse level; the finer levels add
                detail, and what is slow stays as it is given. Without speech and seconds it decides
                the length, and always all but this: where it is what this `seed` made by `levels`,
                the untouched parts are taken as they were made. Of the model's rig, or of another
                one that moves like it.
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
            fps: frames per second of the motion, made at the model's own rate and resampled; None
                takes the recordings' rate, and the model's own with `keyframes`. Not for `levels`.

        Raises:
            ModelError: a control, style or speaker this model does not have, or neither speech
                nor seconds.
            AudioError, FormatError: a file cannot be read, or an array is no sound.
            MotionError: a `smooth` below 0.
        """
        seed = checked_seed(seed)
        own = self.recorded_fps if keyframes is None else self.fps
        rate = own if fps is None else checked_fps(fps)
        coarse = levels not in (None, self.network_config.levels)
        if coarse and fps is not None:
            raise ModelError(f"fps={fps:g}: with levels={levels} a motion has that level's rate")
        request = Request.of(
            self,
            speech=as_speech(speech, sample_rate),
            seconds=seconds,
            samples=samples,
            seed=seed,
            style=style,
            level_style=level_style,
            speaker=speaker,
            levels=levels,
            keyframes=keyframes,
            keyframe_level=keyframe_level,
            like=like,
            path=path,
            keep=keep,
            foot_lock=foot_lock,
            smooth=smooth,
            unknown={"events": events, "guidance": guidance},
        )
        motions = Generation(self, request).motions()
        if not coarse:
            motions = [to_output_rate(motion, rate, request.wave, seconds) for motion in motions]
        return motions[0] if samples == 1 else motions

    def check_controls(
        self,
        *,
        samples: int = 1,
        seed: int = 0,
        style: str | None = None,
        level_style: str | None = None,
        speaker: str | None = None,
        levels: int | None = None,
        keyframe_level: int = 1,
        events: str | Path | None = None,
        guidance: float | None = None,
        **others: Any,
    ) -> None:
        """Check the controls of `generate` that do not depend on the speech.

        Raises:
            ModelError: a control, style, level or speaker that this model does not have.
        """
        checked_seed(seed)
        check_controls(
            self,
            samples=samples,
            style=style,
            level_style=level_style,
            speaker=speaker,
            levels=levels,
            keyframe_level=keyframe_level,
            unknown={"events": events, "guidance": guidance},
        )

    def reconstruct(
        self, name: str, speech: Speech | None = None, sample_rate: int | None = None
    ) -> Motion:
        """A training sequence at the model's own rate, from its noise; it faces +Z on the whole.

        Args:
            name: one of `sequences`.
            speech: its sound, for a model that hears; as in `generate`.
            sample_rate: Hz, of an array.

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
        features = speech_features(
            self.conditioner, as_speech(speech, sample_rate), seconds, self.fps
        )
        features = features[: sequence.frames]
        lengths = af.level_lengths(sequence.frames, self.network_config.levels)
        if len(features) < sequence.frames:
            raise ModelError(
                f"sequence {name!r}: it has {sequence.frames} frames, its speech {len(features)}"
            )
        told: list[Tensor] = []
        if self.styles:
            track = level_track(self.styles, sequence.style or "", lengths[-1], self.fps)
            told = [resample(track, n)[None] for n in lengths]
        noise = self.z_star[name].reshape(1, -1, lengths[0])
        values = Pyramid(self, lengths, features, told).from_noise(noise)
        return self.representation.decode(values, self.fps)

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        config, rig, tensors = model_parts(self)
        save_model(folder, config, rig, tensors, self._readme(notes or {}))

    def _readme(self, notes: Mapping[str, str]) -> str:
        rows = {
            "Kind": f"multires, {self.network_config.levels} levels",
            "Motion": f"{rates(self.fps, self.recorded_fps)}, {len(self.representation.joints)} of "
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
