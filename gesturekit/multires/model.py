"""A trained multires model: load it, give it speech, get motion."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import audio_features as af
from gesturekit.atomic import atomic_write
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import ConfigError, ModelError
from gesturekit.motion.motion import Motion
from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.chunks import Condition, SpeechCondition, sample
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.data import Normaliser
from gesturekit.multires.networks import MultiresGenerator
from gesturekit.training.config import build, dump_yaml, read_yaml, to_dict
from gesturekit.training.seeds import generator

log = logging.getLogger(__name__)

FORMAT = 1
_MARGIN_COARSE = 2
"""Frames of the first level that are made before a motion and after it, and cut off."""


class MultiresModel:
    """Speech to motion by a pyramid of small generators.

    Args:
        fps: frames per second of the motion.
        representation: the rig and its modelled joints.
        conditioner: turns waves into the features the model hears.
        normaliser: of motion vectors.
        network_config: how the pyramid is built.
        residual: whether finer levels hear only what the coarser ones lack.
        network: the generators.
        sigma: (N, L) noise spread of each training sequence and level.
        z_star: the noise from which each training sequence is reconstructed, by its name.
        speakers: a reference skeleton for each speaker that the corpus named.
    """

    kind = "multires"

    def __init__(
        self,
        *,
        fps: float,
        representation: MultiresRepresentation,
        conditioner: SpeechConditioner,
        normaliser: Normaliser,
        network_config: NetworkConfig,
        residual: bool,
        network: MultiresGenerator,
        sigma: Tensor,
        z_star: Mapping[str, Tensor],
        speakers: Mapping[str, Skeleton],
    ) -> None:
        self.fps = fps
        self.representation = representation
        self.conditioner = conditioner
        self.normaliser = normaliser
        self.network_config = network_config
        self.residual = residual
        self.network = network
        self.sigma = sigma
        self.z_star = dict(z_star)
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
    ) -> Motion | list[Motion]:
        """Motion for speech; frame k is at k / fps, and it is as long as the speech.

        Args:
            speech: an audio file or a `Wave`. None gives idle motion of `seconds`.
            seconds: length without speech, s.
            samples: how many different motions to make; more than one gives a list.
            seed: the same seed, speech and sample number give the same motion.
            style: this kind of model has none.
            path: this kind of model has none.
            events: this kind of model has none.
            guidance: this kind of model has none.
            speaker: whose body to move: one of `speakers`; None takes the reference skeleton.

        Raises:
            ModelError: a control or a speaker this model does not have, or neither speech nor
                seconds.
            AudioError: the speech cannot be read.
        """
        unknown = {"style": style, "path": path, "events": events, "guidance": guidance}
        for name, value in unknown.items():
            if value is not None:
                raise ModelError(f"{name}={value!r}: this multires model is driven by speech alone")
        if speaker is not None and speaker not in self.speakers:
            known = ", ".join(sorted(self.speakers)) or "its corpus named none"
            raise ModelError(f"speaker={speaker!r}: the model does not know them ({known})")
        if samples < 1:
            raise ModelError(f"samples={samples}: ask for at least 1")
        features = self._features(speech, seconds)
        # Mirrored, the speech goes on as it is at its ends: talking or silent.
        features = np.pad(features, ((self.margin, self.margin), (0, 0)), mode="reflect")
        lengths = af.level_lengths(len(features), self.network_config.levels)
        condition = SpeechCondition(features, lengths, self.residual)
        # One motion at a time: in a batch, sums would be made in another order, and a motion
        # would depend on how many were asked for.
        motions = [
            self.representation.decode(
                self._sample(condition, lengths, seed, number),
                self.fps,
                skeleton=None if speaker is None else self.speakers[speaker],
            )
            for number in range(samples)
        ]
        return motions[0] if samples == 1 else motions

    def _features(self, speech: str | Path | af.Wave | None, seconds: float | None) -> np.ndarray:
        """(T, S) what the model hears."""
        if speech is not None:
            if seconds is not None:
                raise ModelError("seconds goes without speech: the motion is as long as the speech")
            wave = speech if isinstance(speech, af.Wave) else af.Wave.load(speech)
            if wave.is_silent:
                log.warning("%s: silent; the motion will be idle", wave.source or "the speech")
            n_frames = wave.n_frames(self.fps)
            if n_frames < 1:
                raise ModelError(
                    f"{wave.source or 'the speech'}: {wave.duration:.3f} s is shorter than half a "
                    f"frame at {self.fps:g} fps"
                )
            return self.conditioner(wave, n_frames)
        if seconds is None:
            raise ModelError("nothing to generate from: give speech, or seconds for idle motion")
        n_frames = int(np.floor(seconds * self.fps + 0.5)) if np.isfinite(seconds) else 0
        if n_frames < 1:
            raise ModelError(f"seconds={seconds}: must be at least one frame ({1 / self.fps:g} s)")
        return self.conditioner.silence(n_frames)

    def _sample(
        self, condition: Condition | None, lengths: list[int], seed: int, number: int
    ) -> np.ndarray:
        """(T, 6 K + C + 3) motion vectors of sample `number`, without the margins."""
        rng = generator(seed, "sample", number, "level", 1)
        spread = self.sigma[:, 0].mean()
        noises: list[Tensor | None] = [torch.randn(1, 1, lengths[0], generator=rng) * spread]
        noises += [None] * (len(lengths) - 1)
        vectors = sample(self.network, noises, lengths, condition)
        kept = vectors[..., self.margin : lengths[-1] - self.margin]
        values = self.normaliser.inverse(kept)[0].T.double().numpy()
        if not np.isfinite(values).all():
            raise ModelError("the model gave NaN; its weights are damaged or it was trained badly")
        return values

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        folder = Path(folder)
        config = {
            "format": FORMAT,
            "kind": self.kind,
            "fps": self.fps,
            "joints": list(self.representation.joints),
            "features": {
                "spec": self.conditioner.extractor.spec,
                "align": self.conditioner.align,
                "residual": self.residual,
            },
            "network": to_dict(self.network_config),
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
            "features.centre": torch.from_numpy(self.conditioner.centre),
            "features.scale": torch.from_numpy(self.conditioner.scale),
        }
        with atomic_write(folder / "skeleton.json") as temporary:
            temporary.write_text(json.dumps(rig), encoding="utf-8")
        with atomic_write(folder / "model.safetensors") as temporary:
            save_file(tensors, temporary)
        with atomic_write(folder / "README.md") as temporary:
            temporary.write_text(self._readme(notes or {}), encoding="utf-8")
        # Last: a folder with a config.yaml is a whole model.
        with atomic_write(folder / "config.yaml") as temporary:
            temporary.write_text(dump_yaml(config), encoding="utf-8")

    def _readme(self, notes: Mapping[str, str]) -> str:
        rows = {
            "Kind": f"multires, {self.network_config.levels} levels",
            "Motion": f"{self.fps:g} fps, {len(self.representation.joints)} of "
            f"{self.skeleton.n_joints} joints modelled",
            "Hears": json.dumps(self.conditioner.extractor.spec),
            **notes,
        }
        lines = [f"- **{key}**: {value}" for key, value in rows.items()]
        return (
            "# A gesturekit model\n\n"
            + "\n".join(lines)
            + "\n\n```python\nimport gesturekit as gk\n\n"
            'model = gk.load("THIS FOLDER")\n'
            'model.generate("speech.wav", seed=0).save("speech.bvh")\n```\n'
        )

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
        folder = Path(folder)
        try:
            config = read_yaml(folder / "config.yaml")
        except ConfigError as error:
            raise ModelError(f"not a model folder: {error}") from None
        found = config.get("format")
        if found != FORMAT:
            raise ModelError(
                f"{folder / 'config.yaml'}: format {found!r}; this gesturekit reads format "
                f"{FORMAT}. A newer format needs a newer gesturekit"
            )
        if config.get("kind") != cls.kind:
            raise ModelError(f"{folder / 'config.yaml'}: kind {config.get('kind')!r}, not multires")
        try:
            return cls._assemble(folder, config, weights)
        except af.AudioFeaturesError:
            raise
        except ModelError:
            raise
        except FileNotFoundError as error:
            # safetensors does not say which file it missed.
            missing = Path(error.filename or "model.safetensors").name
            raise ModelError(f"{folder}: the model lacks {missing}") from None
        except (KeyError, TypeError, ValueError, RuntimeError, OSError, MemoryError) as error:
            raise ModelError(f"{folder}: the model is damaged ({error})") from error
        except Exception as error:
            # safetensors raises an error class of its own for a damaged file.
            raise ModelError(f"{folder}: model.safetensors is damaged ({error})") from error

    @classmethod
    def _assemble(
        cls, folder: Path, config: dict[str, Any], weights: str | Path | None
    ) -> MultiresModel:
        fps = float(config["fps"])
        if not 0 < fps < float("inf"):
            raise ValueError(f"fps is {fps}")
        rig = json.loads((folder / "skeleton.json").read_text(encoding="utf-8"))
        skeleton = Skeleton.from_json(rig["skeleton"])
        representation = MultiresRepresentation.from_json(skeleton, rig["motion"])
        extractor = af.extractor_from_spec(config["features"]["spec"], weights=weights)
        tensors = load_file(folder / "model.safetensors")
        network_config = build(NetworkConfig, config["network"], where=str(folder / "config.yaml"))
        network = MultiresGenerator(representation, extractor.dim, network_config)
        network.load_state_dict(
            {k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")}
        )
        return cls(
            fps=fps,
            representation=representation,
            conditioner=SpeechConditioner(
                extractor,
                fps,
                config["features"]["align"],
                tensors["features.centre"].numpy(),
                tensors["features.scale"].numpy(),
            ),
            normaliser=Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
            network_config=network_config,
            residual=bool(config["features"]["residual"]),
            network=network.eval(),
            sigma=tensors["sigma"],
            z_star={
                k.removeprefix("z_star."): v for k, v in tensors.items() if k.startswith("z_star.")
            },
            speakers={name: Skeleton.from_json(body) for name, body in rig["speakers"].items()},
        )
