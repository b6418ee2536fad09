"""A trained multires model: load it and generate motion from speech, a style, both or nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Unpack

import numpy as np
import torch
from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import Speech, as_speech, speech_features, to_output_rate
from gesturekit.errors import ModelError, gesturekit_errors
from gesturekit.model import build_controls, document_controls
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.backend import requested_backend
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.kinematics import measured_state
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.networks import MultiresGenerator, load_generator
from gesturekit.multires.pyramid import (
    Conditions,
    TrainedNoise,
    TrainedSequence,
    generated,
    level_range,
    requested_styles,
    style_levels,
)
from gesturekit.multires.retrieval import (
    RecordedLibrary,
    library_row,
    library_tensors,
    library_values,
    load_library,
)
from gesturekit.multires.sampler import Sampler
from gesturekit.multires.stream import MultiresStream
from gesturekit.state.channels import StateChannels
from gesturekit.state.prediction import AheadPrediction, live_rows
from gesturekit.state.process import load_state, state_values
from gesturekit.training.config import build, to_dict
from gesturekit.training.features import conditioner_values, load_conditioner
from gesturekit.training.model_folder import ModelParts, TrainedModel, with_faces
from gesturekit.training.seeds import checked_draw, rng_for

_OF_LEVELS = ("levels", "level_style", "level_speech", "keyframes", "like", "keep", "path")
"""Controls that a model without levels, which plays recordings, does not take."""
_OF_ALL_LEVELS = ("path", "like", "keyframes", "keep", "speaker")
"""Controls that a motion of a coarse level does not take."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class MultiresModel(TrainedModel):
    """Model that generates motion by a pyramid of GANs, from speech, a style, both or nothing.

    Attributes (beside those of `TrainedModel`):
        network_config: architecture of the pyramid.
        noise: the model's noise.
        library: recorded motion that is played; None without.
        fastest: ground speed in the fastest second of the training motion, m/s.
    """

    kind: ClassVar[str] = "multires"

    representation: MultiresRepresentation
    normaliser: Normaliser
    conditions: Conditions
    network_config: NetworkConfig
    network: MultiresGenerator
    noise: TrainedNoise
    library: RecordedLibrary | None
    fastest: float

    @property
    def retrieves(self) -> bool:
        """True for a model that plays whole bodies, without its network."""
        return self.library is not None and self.library.is_whole

    @property
    def ahead(self) -> tuple[AheadPrediction, ...]:
        """Predictions for live speech; empty for a model that cannot stream."""
        return () if self.state_process is None else self.state_process.ahead

    def _measured_state(self, vectors: np.ndarray) -> np.ndarray:
        """Return the state of movement (C, T) of motion vectors (T, D), in their own units."""
        assert self.state_process is not None
        channels = self.state_process.channels
        return measured_state(vectors, self.representation, channels, self.fps)

    @document_controls(MultiresControls)
    @gesturekit_errors()
    def generate(
        self,
        speech: Speech | None = None,
        sample_rate: int | None = None,
        *,
        seconds: float | None = None,
        samples: int = 1,
        seed: int = 0,
        item: str = "",
        **controls: Unpack[MultiresControls],
    ) -> Motion | list[Motion]:
        """Generate motion as long as the speech or `seconds`; frame k is at k / fps.

        Args:
            speech: an audio file, a `Wave`, or an array of samples (see `Wave.from_array`), for a
                model with speech input. Without it, such a model gets silence for `seconds`.
            sample_rate: of an array, in Hz.
            seconds: length without speech, in s.
            samples: number of different motions; more than one gives a list.
            seed: the same seed, item, request and sample number give the same motion.
            item: name of the utterance. Motions of different items are different draws.
            controls: the fields of `MultiresControls`.

        Raises:
            ModelError: a control, style or speaker that this model does not have, controls that
                cannot be combined, an item that is not text, or no length.
            AudioError, FormatError: a file cannot be read, or an array is not audio.
            MotionError: a `smooth` below 0.
        """
        asked = self.check_controls(samples=samples, seed=seed, **controls)
        seed, item = checked_draw(seed, item)
        sampler = Sampler(self, asked, as_speech(speech, sample_rate), seconds)
        # One at a time: batching changes the order of sums, and the last digits of a sample would
        # depend on the number of samples.
        motions = [
            sampler.placement.applied(sampler.motion(seed, item, number))
            for number in range(samples)
        ]
        rate = asked["fps"]
        if rate is None and not sampler.is_coarse:
            rate = self.recorded_fps if asked["keyframes"] is None else self.fps
        if rate is not None:
            motions = [to_output_rate(motion, rate, sampler.wave, seconds) for motion in motions]
        motions = with_faces(motions, sampler.wave, asked, seed, item)
        return motions[0] if samples == 1 else motions

    @gesturekit_errors()
    def stream(
        self,
        sample_rate: int,
        look_ahead: float = 0.2,
        seed: int = 0,
        item: str = "",
        **controls: Unpack[MultiresControls],
    ) -> MultiresStream:
        """Return a stream that generates motion while sound comes in.

        Args:
            sample_rate: of the sound, Hz.
            look_ahead: seconds of sound that a frame waits for: 0, 0.1, 0.2 or 0.4. With less, the
                motion follows the speech less.
            seed: the same seed and item give the same motion for the same sound.
            item: name of the stream.
            controls: style, speaker, liveliness, mood_seed, foot_lock and smooth of
                `MultiresControls`.

        Raises:
            ModelError: a model that cannot stream, or a control that a stream does not take.
            AudioError: a sample rate out of range.

        Examples:
            >>> model = gk.load("demo")
            >>> stream = model.stream(16000)
            >>> half_a_second = np.zeros(8000, np.float32)
            >>> stream.step(half_a_second).n_frames + stream.finish().n_frames
            15
        """
        asked = self.check_controls(seed=seed, **controls)
        return MultiresStream(self, sample_rate, look_ahead, seed, item, asked)

    def check_controls(
        self, *, samples: int = 1, seed: int = 0, **controls: Unpack[MultiresControls]
    ) -> MultiresControls:
        """Return the controls of `generate`, after the checks that do not depend on the speech.

        Raises:
            ModelError: a control, style, level or speaker that this model does not have.
            ConfigError: GESTUREKIT_BACKEND names no backend.
        """
        requested_backend()
        checked_draw(seed)
        asked = build_controls(MultiresControls, controls, self.kind)
        if problem := next(self._problems(asked, samples), None):
            raise ModelError(problem)
        return asked

    def _problems(self, controls: MultiresControls, samples: int) -> Iterator[str]:
        """Yield what is wrong with controls; a style or a level's text is wrong by a ModelError."""
        n_levels, levels = self.network_config.levels, controls["levels"]
        if self.styles:
            lengths, rng = [1] * n_levels, rng_for(0, "check")
            requested_styles(self.styles, controls, lengths, fps=self.fps, rng=rng)
        for name, value in (("style", controls["style"]), ("level_style", controls["level_style"])):
            if value is not None and not self.styles:
                yield f"{name}={value!r}: this multires model has no {name}"
        for text in controls["level_speech"] or ():
            level_range(text, n_levels, "level speech")
            if self.conditions.conditioner is None:
                yield "level_speech: this model takes no speech"
        yield from self.problems(controls, samples)
        for name, level in (("levels", levels), ("keyframe_level", controls["keyframe_level"])):
            if level is not None and not 1 <= level <= n_levels:
                yield f"{name}={level}: the model has levels 1 (coarse) to {n_levels}"
        of_levels = [name for name, value in controls.items() if name in _OF_LEVELS and value]
        if self.retrieves and of_levels:
            yield f"{of_levels[0]}: this model plays recordings, without a network's levels"
        whole = [n for n, v in controls.items() if n in _OF_ALL_LEVELS and v is not None]
        if {"path", "like"} <= {*whole}:
            yield "path and like: give one of them"
        if levels not in (None, n_levels):
            fps = controls["fps"]
            if fps is not None:
                yield f"fps={fps:g}: with levels={levels} a motion has that level's rate"
            if whole:
                yield f"{whole[0]} goes with all levels: leave levels away"

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
        lengths = self.network_config.lengths(sequence.frames)
        styles: list[Tensor] = []
        if sequence.style is not None:
            numbers = torch.full((1, len(lengths)), self.styles.index(sequence.style))
            styles = style_levels(numbers, len(self.styles), lengths)
        condition = self.conditions.of_motion(features, lengths, styles)
        noise = self.noise.z_star[name].reshape(1, -1, lengths[0])
        values = generated(self, [noise, *[None] * (len(lengths) - 1)], lengths, condition)
        return self.representation.decode(values, self.fps)

    def _contents(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return what a multires model adds to config.yaml and model.safetensors."""
        conditions, noise = self.conditions, self.noise
        conditioner = conditions.conditioner
        config = {
            "features": None
            if conditioner is None
            else {**conditioner_values(conditioner), "residual": conditions.residual},
            "styles": list(self.styles),
            "z_star_shuffle": noise.z_star_shuffle,
            "noise_levels": noise.noise_levels,
            "network": to_dict(self.network_config),
            "sequences": {name: asdict(sequence) for name, sequence in noise.sequences.items()},
            "recorded": None if self.library is None else library_values(self.library),
            "state": None if self.state_process is None else state_values(self.state_process),
            "fastest": self.fastest,
            "smooth": self.smooth,
        }
        tensors = {f"z_star.{name}": value for name, value in noise.z_star.items()}
        tensors["sigma"] = noise.sigma
        return config, tensors | ({} if self.library is None else library_tensors(self.library))

    def _readme(self) -> tuple[dict[str, str], str]:
        """Return the facts of README.md, and the arguments of `generate` in its example."""
        rows = {"Kind": f"multires, {self.network_config.levels} levels", **self._common_rows()}
        rows["Moved by"] = "recordings" if self.retrieves else "the network"
        if self.library is not None:
            rows["Moved by"] += f"; {library_row(self.library)}"
        rows |= self._state_rows() | live_rows(self.ahead)
        call = "seconds=10" if self.conditions.conditioner is None else '"speech.wav"'
        if self.styles:
            rows["Styles"] = ", ".join(self.styles)
            call += f', style="{self.styles[0]}"'
        return rows, call

    @classmethod
    def _fields(
        cls,
        parts: ModelParts,
        weights: WeightPlaces | None,
        device: torch.device,
        dtype: torch.dtype,
    ) -> dict[str, Any]:
        """Return the fields of a folder that are a multires model's own; see `load`."""
        config, tensors, features = parts.config, parts.tensors, parts.config["features"]
        where, fps = str(parts.folder / "config.yaml"), float(config["fps"])
        network_config = build(NetworkConfig, config["network"], where=where)
        skeleton, conditioner = Skeleton.from_json(parts.rig["skeleton"]), None
        representation = MultiresRepresentation.from_json(skeleton, parts.rig["motion"])
        if features is not None:
            conditioner = load_conditioner(features, tensors, fps, weights, str(device))
        n_speech = 0 if conditioner is None else conditioner.dim
        channels = StateChannels.find(skeleton, representation.joints)
        state = load_state(config["state"], tensors, channels, fps, n_speech)
        conditions = Conditions(
            conditioner,
            tuple(map(str, config["styles"])),
            bool(features and features["residual"]),
            None if state is None else channels,
        )
        trained = parts.tensors_under("network.")
        network = load_generator(representation, conditions.width, network_config, trained)
        recorded = config["sequences"].items()
        noise = TrainedNoise(
            sigma=tensors["sigma"],
            z_star=parts.tensors_under("z_star."),
            sequences={name: build(TrainedSequence, own, where=where) for name, own in recorded},
            z_star_shuffle=int(config["z_star_shuffle"]),
            noise_levels=int(config["noise_levels"]),
        )
        return {
            "representation": representation,
            "normaliser": Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
            "conditions": conditions,
            "network_config": network_config,
            "network": network,
            "noise": noise,
            "library": load_library(parts, representation, len(channels.names)),
            "state_process": state,
            "fastest": float(config["fastest"]),
        }
