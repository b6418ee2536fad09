"""A trained multires model: load it and generate motion from speech, a style, both or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal, Unpack

from torch import Tensor

import audio_features as af
from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import Speech, as_speech, speech_features, to_output_rate
from gesturekit.errors import ModelError, gesturekit_errors
from gesturekit.motion.motion import Motion
from gesturekit.motion.resampling import checked_fps
from gesturekit.multires.backend import requested_backend
from gesturekit.multires.controls import MultiresControlArguments, MultiresControls
from gesturekit.multires.model_format import model_arguments, model_parts, readme
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.pyramid import Pyramid
from gesturekit.multires.sampling.request import Request, check_controls
from gesturekit.multires.sampling.sampler import Sampler
from gesturekit.multires.sampling.styles import level_track
from gesturekit.multires.trained_model import TrainedModel
from gesturekit.training.model_folder import load_model, model_digest, save_model
from gesturekit.training.run.device import prepare_device
from gesturekit.training.seeds import checked_seed


class MultiresModel(TrainedModel):
    """Model that generates motion by a pyramid of small GANs, from speech, a style, both or
    nothing."""

    @gesturekit_errors()
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: int = 1,
        seed: int = 0,
        **controls: Unpack[MultiresControlArguments],
    ) -> Motion | list[Motion]:
        """Generate motion as long as the speech or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file, a `Wave`, or an array of samples (see `Wave.from_array`), for a
                model with speech input. Without it, such a model gets silence for `seconds`.
            sample_rate: of an array, in Hz.
            seconds: length without speech, in s.
            samples: number of different motions; more than one gives a list.
            seed: the same seed, request and sample number give the same motion.
            controls: the fields of `MultiresControls`.

        Raises:
            ModelError: a control, style or speaker that this model does not have, controls that
                cannot be combined, or no length.
            AudioError, FormatError: a file cannot be read, or an array is not audio.
            MotionError: a `smooth` below 0.
        """
        asked = MultiresControls.build(controls, self.kind)
        seed = checked_seed(seed)
        rate = self._rate(asked)
        self._check(asked, samples)
        if asked.smooth is None:
            asked = replace(asked, smooth=self.smooth)
        request = Request.build(
            asked,
            as_speech(speech, sample_rate),
            seconds,
            fps=self.fps,
            representation=self.representation,
            conditions=self.conditions,
            network_config=self.network_config,
            speakers=self.speakers,
        )
        library = None if asked.recall is False else self.library
        sampler = Sampler(
            replace(request, library=library),
            fps=self.fps,
            representation=self.representation,
            normaliser=self.normaliser,
            network=self.network,
            conditions=self.conditions,
            noise=self.noise.source(self.styles),
            fastest=self.fastest,
        )
        # One at a time: batching changes the order of sums, and the last digits of a sample would
        # depend on the number of samples.
        motions = [sampler.motion(seed, number) for number in range(samples)]
        if rate is not None:
            motions = [to_output_rate(motion, rate, request.wave, seconds) for motion in motions]
        return motions[0] if samples == 1 else motions

    def check_controls(
        self, *, samples: int = 1, seed: int = 0, **controls: Unpack[MultiresControlArguments]
    ) -> MultiresControls:
        """Return the controls of `generate`, after the checks that do not depend on the speech.

        Raises:
            ModelError: a control, style, level or speaker that this model does not have.
            ConfigError: GESTUREKIT_BACKEND names no backend.
        """
        requested_backend()
        checked_seed(seed)
        asked = MultiresControls.build(controls, self.kind)
        self._check(asked, samples)
        return asked

    def _rate(self, controls: MultiresControls) -> float | None:
        """Return the frames per second of the result; None for the rate of a coarse level."""
        coarse = controls.levels not in (None, self.network_config.levels)
        if controls.fps is None:
            own = self.recorded_fps if controls.keyframes is None else self.fps
            return None if coarse else own
        rate = checked_fps(controls.fps)
        if coarse:
            raise ModelError(
                f"fps={rate:g}: with levels={controls.levels} a motion has that level's rate"
            )
        return rate

    def _check(self, controls: MultiresControls, samples: int) -> None:
        check_controls(
            controls,
            samples,
            fps=self.fps,
            styles=self.styles,
            levels=self.network_config.levels,
            speakers=self.speakers,
            recalls=self.library is not None,
            takes_speech=self.conditions.conditioner is not None,
        )

    def reconstruct(
        self, name: str, speech: Speech | None = None, sample_rate: int | None = None
    ) -> Motion:
        """Reconstruct a training sequence from its z*, at the model's own rate.

        Args:
            name: of the sequence. Its mean heading becomes +Z, as in training.
            speech: the sequence's speech, for a model with speech input; as in `generate`.
            sample_rate: of an array, in Hz.

        Raises:
            ModelError: an unknown sequence, or no speech for a model with speech input.
        """
        sequences, conditioner = self.noise.sequences, self.conditions.conditioner
        if name not in sequences:
            known = ", ".join(sorted(sequences)) or "the model names none"
            raise ModelError(f"sequence {name!r}: the model was not trained on it ({known})")
        sequence = sequences[name]
        if conditioner is not None and speech is None:
            raise ModelError(
                f"sequence {name!r}: the model has speech input; give the sequence's speech"
            )
        seconds = sequence.frames / self.fps if speech is None else None
        features = speech_features(conditioner, as_speech(speech, sample_rate), seconds, self.fps)
        features = features[: sequence.frames]
        if len(features) < sequence.frames:
            raise ModelError(
                f"sequence {name!r}: it has {sequence.frames} frames, its speech {len(features)}"
            )
        lengths = af.level_lengths(sequence.frames, self.network_config.levels)
        styles: list[Tensor] = []
        if self.styles:
            track = level_track(self.styles, sequence.style or "", lengths[-1], self.fps)
            styles = [resample(track, n)[None] for n in lengths]
        condition = self.conditions.of_motion(features, lengths, styles)
        noise = self.noise.z_star[name].reshape(1, -1, lengths[0])
        values = Pyramid(self.network, self.normaliser, lengths, condition).from_noise(noise)
        return self.representation.decode(values, self.fps)

    def fingerprint(self) -> str:
        """Return the SHA-256 of what `save` writes, its README apart."""
        return model_digest(*model_parts(self))

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        save_model(folder, *model_parts(self), readme(self, notes or {}))

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        weights: WeightPlaces | None = None,
        device: str = "cpu",
        dtype: Literal["fp32"] = "fp32",
    ) -> MultiresModel:
        """Read a model folder.

        Args:
            folder: as written by `save`.
            weights: path of the encoder weights used in training; {kind: path} for several
                encoders.
            device: where WavLM computes: auto, cpu, cuda, cuda:1 ... The pyramid stays on the CPU.
            dtype: precision of the pyramid; only fp32.

        Raises:
            ModelError: a part is missing, damaged, or of a newer format; another dtype.
            WeightsError: weights are missing, or differ from those used in training.
            ConfigError: there is no such device.
        """
        if dtype != "fp32":
            raise ModelError(f"dtype={dtype!r}: {folder} is a multires model, which is fp32 only")
        device = str(prepare_device(device))
        return load_model(
            folder, cls.kind, lambda parts: cls(**model_arguments(parts, weights, device))
        )
