"""Trained models: their common fields, their folders, and the data from which a run resumes."""

from __future__ import annotations

import hashlib
import json
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

import audio_features as af
from audio_features.atomic import remove_unfinished, write_tensors, write_text
from audio_features.extractor import needs_of
from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import ConfigError, ModelError, gesturekit_errors
from gesturekit.face.speech import Eyes, faces_from_speech
from gesturekit.model import Controls, Inputs
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import unidentified
from gesturekit.motion.resampling import checked_fps
from gesturekit.motion.skeleton import Skeleton
from gesturekit.state.process import StateProcess, state_tensors
from gesturekit.training.clips import on_rig
from gesturekit.training.config import dump_yaml, read_yaml
from gesturekit.training.features import conditioner_tensors
from gesturekit.training.run_config import MOST_SMOOTH
from gesturekit.training.run_folder import read_rig, unfinished
from gesturekit.training.seeds import rng_for
from gesturekit.training.session import memory_ran_out, prepare_device, warn_of_slow_bfloat16
from gesturekit.wording import counted

FORMAT = 1
_MOST_HEADER = 4 << 20  # some 40,000 tensors; the largest of our models have 2,000


Data = TypeVar("Data")
_DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ModelParts:
    """Contents of a model folder.

    Attributes:
        folder: its path.
        config: `config.yaml`.
        rig: `skeleton.json`.
        tensors: `model.safetensors`.
    """

    folder: Path
    config: dict[str, Any]
    rig: dict[str, Any]
    tensors: dict[str, Tensor]

    def tensors_under(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names begin with a prefix, named without it."""
        return {k.removeprefix(prefix): v for k, v in self.tensors.items() if k.startswith(prefix)}


def save_model(
    folder: str | Path,
    config: Mapping[str, Any],
    rig: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    readme: str,
) -> None:
    """Write a model folder, and remove what a killed process left of writing it.

    Args:
        folder: created if missing.
        config: with `kind` and `fps`; the format's number is added.
        rig: content of `skeleton.json`.
        tensors: content of `model.safetensors`.
        readme: content of `README.md`.
    """
    folder = Path(folder)
    for name in ("skeleton.json", "model.safetensors", "README.md", "config.yaml"):
        remove_unfinished(folder / name)
    write_text(folder / "skeleton.json", json.dumps(rig))
    write_tensors(folder / "model.safetensors", tensors)
    write_text(folder / "README.md", readme)
    # Last: a folder with a config.yaml is a whole model.
    write_text(folder / "config.yaml", dump_yaml({"format": FORMAT, **config}))


def model_digest(
    config: Mapping[str, Any], rig: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> str:
    """Return the SHA-256 of what `save_model` writes, its README apart, without writing it."""
    digest = hashlib.sha256(json.dumps(rig).encode())
    digest.update(dump_yaml({"format": FORMAT, **config}).encode())
    for name, tensor in sorted(tensors.items()):
        # Half precision, in which a bundled model is stored, is read as single.
        values = tensor.float() if tensor.dtype == torch.half else tensor
        values = values.detach().cpu().contiguous()
        digest.update(f"{name} {values.dtype} {tuple(values.shape)}".encode())
        digest.update(values.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def load_parts(folder: Path, kind: str) -> ModelParts:
    """Read the files of a model folder of this kind.

    Raises:
        ModelError: a file is missing or damaged, or of another format or kind.
    """
    path, file = folder / "config.yaml", folder / "model.safetensors"
    try:
        config = read_yaml(path)
    except ConfigError as error:
        raise ModelError(unfinished(folder) or f"not a model folder: {error}") from None
    if (config.get("format"), config.get("kind")) != (FORMAT, kind):
        raise ModelError(
            unfinished(folder)
            or f"{path}: format {config.get('format')!r} and kind {config.get('kind')!r}; this "
            f"gesturekit reads format {FORMAT} of {kind}. A newer format needs a newer gesturekit"
        )
    rig = read_rig(folder)
    try:
        if file.exists() and not file.is_file():  # reading a pipe may never end
            raise ValueError("not a regular file")
        with file.open("rb") as opened:
            header = int.from_bytes(opened.read(8), "little")  # bytes of JSON about the tensors
        if header > _MOST_HEADER:
            raise ValueError(f"{header} bytes of names")
        return ModelParts(folder, config, rig, load_file(file))
    except (OSError, ValueError, SafetensorError) as error:
        raise ModelError(f"{file}: missing or damaged ({error})") from error


def unusable(folder: Path, error: Exception) -> ModelError:
    """Return the error about a folder of which no model can be built, on one line."""
    if isinstance(error, torch.cuda.OutOfMemoryError):
        why = f"{memory_ran_out(error)}; free it, or load the model with device cpu"
    elif isinstance(error, af.FeatureError):
        folder, why = folder / "config.yaml", f"features: {error}"
    else:
        # Damage, memory that ran out, a library that is missing. torch lists every tensor that does
        # not fit, on a line of its own.
        reason = " ".join(str(error).splitlines()[:2]).replace("\t", " ")
        reason = f"{type(error).__name__}: {reason}".removesuffix(": ")
        why = f"the model is damaged or cannot be used ({reason})"
    return ModelError(f"{folder}: {why}")


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TrainedModel(ABC):
    """Fields of every trained model; each system adds its own, its networks and its generation.

    The value goes whole to whoever samples from it.

    Attributes:
        fps: frames per second at which the network (its finest level) works.
        representation: the motion vector of the rig.
        conditions: inputs of the model beside noise or the noisy motion.
        normaliser: mean and scale of motion vectors.
        network: in evaluation mode.
        state_process: from which the state of movement is drawn; None for a model without it.
        speakers: a reference skeleton for each speaker that the corpus named.
        smooth: default of the control `smooth`, in seconds; None for no smoothing.
        recorded_fps: the recordings' rate, which generated motion gets.
        folder: folder that it was loaded from; None for one that was not loaded.
    """

    kind: ClassVar[str]
    dtypes: ClassVar[tuple[str, ...]] = ("fp32",)

    fps: float
    representation: Any
    conditions: Any
    normaliser: Any
    network: Any
    state_process: StateProcess | None = None
    speakers: Mapping[str, Skeleton] = field(default_factory=dict)
    smooth: float | None = None
    recorded_fps: float
    folder: Path | None = None

    def __post_init__(self) -> None:
        self.network.eval()

    def __repr__(self) -> str:
        folder = "" if self.folder is None else f"{str(self.folder)!r}: "
        return f"{type(self).__name__}({folder}{self._rates_and_joints()})"

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of its styles; empty for a model without styles."""
        return self.conditions.styles

    @property
    def inputs(self) -> Inputs:
        """Inputs besides style and speaker."""
        speech = self.conditions.conditioner
        if speech is None:
            return Inputs()
        return Inputs(speech=True, words=speech.takes_words, files=speech.files)

    def problems(self, controls: Mapping[str, Any], samples: int) -> Iterator[str]:
        """Yield what is wrong with a request's common controls, and its number of motions."""
        speaker = controls["speaker"]
        if speaker is not None and speaker not in self.speakers:
            known = ", ".join(sorted(self.speakers)) or "its corpus named none"
            yield f"speaker={speaker!r}: the model does not know them ({known})"
        if samples < 1:
            yield f"samples={samples}: ask for at least 1"
        if controls["transcript"] is not None and controls["face"] != "phones":
            yield "transcript: only a face from phones uses one: face='phones' (--face phones)"
        if controls["face"] == "phones" and find_spec("pocketsphinx") is None:
            yield "face='phones': pip install 'gesturekit[face]' first, or take face='energy'"
        if controls["state"] is not None and self.state_process is None:
            yield "state: this model was trained without the state of movement"
        for name, default in (("liveliness", 1), ("mood_seed", None)):
            value = controls[name]
            if value != default and self.state_process is None:
                yield f"{name}={value}: only models that draw how lively they are take it"
            for other in ("like", "state"):
                if value != default and controls[other] is not None:
                    yield f"{name}={value}: {other} sets the movement; give one of them"

    @torch.no_grad()
    @gesturekit_errors()
    def state(self, motion: str | Path | Motion) -> np.ndarray:
        """Measure the state of movement of a motion: what `generate` takes as `state`.

        Args:
            motion: a motion or its file; one on another rig is retargeted.

        Returns:
            (T, C) at the model's frame rate; `state_process.channels.names` names the channels.

        Raises:
            ModelError: a model without a state of movement, or a rig that cannot be retargeted.
            FormatError: the file cannot be read.
        """
        if self.state_process is None:
            raise ModelError("state: this model was trained without the state of movement")
        motion = motion if isinstance(motion, Motion) else Motion.load(motion)
        motion = on_rig(self.representation, motion.resample(self.fps))
        return self._measured_state(self.representation.encode(motion)).T

    @abstractmethod
    def _measured_state(self, vectors: np.ndarray) -> np.ndarray:
        """Return the state of movement (C, T) of motion vectors, in their own units."""

    def fingerprint(self) -> str:
        """Return the SHA-256 of what `save` writes, its README apart.

        That of a loaded model is of what was read and of the weights in memory: of changes in
        place, those of other arrays are not seen.
        """
        if (read := _READ.get(self)) is None:
            return model_digest(*self.parts())
        return model_digest(read.config, read.rig, read.tensors | self._weights())

    def save(self, folder: str | Path, *, notes: Mapping[str, str] | None = None) -> None:
        """Write the model folder: config.yaml, skeleton.json, model.safetensors, README.md."""
        rows, call = self._readme()
        lines = [f"- **{key}**: {value}" for key, value in {**rows, **(notes or {})}.items()]
        readme = (
            "# A gesturekit model\n\n" + "\n".join(lines) + "\n\n```python\nimport gesturekit as gk"
            '\n\nmodel = gk.load("THIS FOLDER")\n'
            f'model.generate({call}, seed=0).save("motion.bvh")\n```\n'
        )
        save_model(folder, *self.parts(), readme)

    def parts(self) -> tuple[dict[str, Any], dict[str, Any], dict[str, Tensor]]:
        """Return the contents of config.yaml, skeleton.json and model.safetensors."""
        first = {
            "kind": self.kind,
            "fps": self.fps,
            "recorded_fps": self.recorded_fps,
            "joints": list(self.representation.joints),
        }
        fitted = fitted_tensors(self.normaliser, self.conditions.conditioner, self.state_process)
        config, further = self._contents()
        tensors = self._weights() | fitted | further
        return first | config, rig_values(self.representation, self.speakers), tensors

    def _weights(self) -> dict[str, Tensor]:
        network = self.network.state_dict().items()
        return {f"network.{name}": value.contiguous() for name, value in network}

    @abstractmethod
    def _contents(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return what the system adds to config.yaml and model.safetensors."""

    @abstractmethod
    def _readme(self) -> tuple[dict[str, str], str]:
        """Return the facts of README.md, and the arguments of `generate` in its example."""

    def _rates_and_joints(self) -> str:
        rate = "" if self.recorded_fps == self.fps else f", resampled to {self.recorded_fps:g} fps"
        joints = f"{len(self.representation.joints)} of {self.skeleton.n_joints} joints modelled"
        return f"{self.fps:g} fps{rate}, {joints}"

    def _common_rows(self) -> dict[str, str]:
        """Return the motion and the speech features, for README.md."""
        rows, conditioner = {"Motion": self._rates_and_joints()}, self.conditions.conditioner
        if conditioner is None:
            return rows
        spec = conditioner.extractor.spec
        rows["Speech features"] = json.dumps(spec)
        if needs := needs_of(spec):
            rows["Needs"] = "; ".join(needs)
        if conditioner.components is not None:
            width, count = conditioner.components.shape
            components = counted(count, "component")
            rows["Reduced features"] = f"{width} features reduced to {components}"
        return rows

    def _state_rows(self) -> dict[str, str]:
        """Return the channels of the state of movement and their prediction, for README.md."""
        if (process := self.state_process) is None:
            return {}
        rows = {"State of movement": ", ".join(process.channels.names)}
        if process.wanted is not None:
            rows["Hand movement from speech"] = process.wanted.summary()
        return rows

    @classmethod
    def load(
        cls,
        folder: str | Path,
        *,
        weights: WeightPlaces | None = None,
        device: str = "cpu",
        dtype: str = "fp32",
    ) -> Self:
        """Read a model folder.

        Args:
            folder: as written by `save`.
            weights: path of the encoder weights used in training; {kind: path} for several
                encoders.
            device: where encoders and the denoiser of a diffusion model compute: auto, cpu, cuda,
                cuda:1 ... The pyramid of a multires model stays on the CPU.
            dtype: precision of the network. `bf16`, of diffusion models, halves memory and is
                faster on processors that support it; predictions then differ by about 1 %.

        Raises:
            ModelError: a part is missing, damaged, or of a newer format; another dtype; a GPU's
                memory ran out.
            WeightsError: weights are missing, or differ from those used in training.
            ConfigError: there is no such device.
        """
        if dtype not in cls.dtypes:
            raise ModelError(f"dtype={dtype!r}: a {cls.kind} model is {' or '.join(cls.dtypes)}")
        place = prepare_device(device)
        if dtype == "bf16":
            warn_of_slow_bfloat16(place)
        parts = load_parts(Path(folder), cls.kind)
        try:
            smooth = parts.config["smooth"]
            if not (smooth is None or 0 <= smooth <= MOST_SMOOTH):
                raise ValueError(f"smooth: {smooth!r} must be 0 to {MOST_SMOOTH:g}")
            model = cls(
                fps=checked_fps(float(parts.config["fps"])),
                speakers=read_speakers(parts.rig),
                smooth=None if smooth is None else float(smooth),
                recorded_fps=checked_fps(parts.config["recorded_fps"]),
                folder=parts.folder.resolve(),
                **cls._fields(parts, weights, place, _DTYPES[dtype]),
            )
        except (af.AudioError, af.WeightsError, ModelError):
            raise
        except Exception as error:
            raise unusable(parts.folder, error) from error
        if missing := unidentified(model.skeleton):
            locked = "feet are not locked, and " if missing.startswith("legs") else ""
            log.warning(
                "%s: %s of the rig cannot be identified: %sthe upper body is not smoothed",
                *(folder, missing, locked),
            )
        others = {n: value for n, value in parts.tensors.items() if not n.startswith("network.")}
        _READ[model] = replace(parts, tensors=others)
        return model

    @classmethod
    @abstractmethod
    def _fields(
        cls,
        parts: ModelParts,
        weights: WeightPlaces | None,
        device: torch.device,
        dtype: torch.dtype,
    ) -> dict[str, Any]:
        """Return the system's own fields, of a folder; see `load`.

        Raises KeyError, TypeError, ValueError or RuntimeError for a damaged folder.
        """


_READ: WeakKeyDictionary[TrainedModel, ModelParts] = WeakKeyDictionary()
"""Parts of loaded models as read, without weights; a copy of a model has no entry."""


def fitted_tensors(
    normaliser: Any, conditioner: SpeechConditioner | None, process: StateProcess | None
) -> dict[str, Tensor]:
    """Return the tensors of what training fits to its recordings, before the network."""
    return {
        "motion.mean": normaliser.mean,
        "motion.scale": normaliser.scale,
        **conditioner_tensors(conditioner),
        **({} if process is None else state_tensors(process)),
    }


def rig_values(representation: Any, speakers: Mapping[str, Skeleton]) -> dict[str, Any]:
    """Return the content of skeleton.json, which run folders store too."""
    return {
        "skeleton": representation.skeleton.to_json(),
        "motion": representation.to_json(),
        "speakers": {name: body.to_json() for name, body in speakers.items()},
    }


def read_speakers(rig: Mapping[str, Any]) -> dict[str, Skeleton]:
    """Return the reference skeletons in `rig_values`."""
    return {name: Skeleton.from_json(body) for name, body in rig["speakers"].items()}


def save_data(folder: Path, tensors: dict[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write the training data of a run: `data.safetensors`, and plain values in `data.json`.

    Features and encoded motion computed again would differ in their last bits, because numpy's
    vector instructions depend on the alignment of arrays.
    """
    for name in ("data.safetensors", "data.json"):
        remove_unfinished(folder / name)
    write_tensors(folder / "data.safetensors", tensors)
    write_text(folder / "data.json", json.dumps(about))


def load_data(folder: Path, assemble: Callable[[dict[str, Any], dict[str, Tensor]], Data]) -> Data:
    """Read what `save_data` wrote.

    Args:
        folder: as written by `save_data`.
        assemble: build the data from plain values and tensors.

    Raises:
        ConfigError: the folder's data is missing or damaged.
        WeightsError: the WavLM weights differ from those at the start of the run.
    """
    try:
        about = json.loads((folder / "data.json").read_text(encoding="utf-8"))
        return assemble(about, load_file(folder / "data.safetensors"))
    except af.WeightsError:
        raise
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise ConfigError(
            f"{folder}: the run's training data cannot be read ({error}); start a new run"
        ) from error


def with_faces(
    motions: Sequence[Motion], wave: af.Wave | None, controls: Controls, seed: int, item: str
) -> list[Motion]:
    """Return the samples of one request with faces by rules, unless `face` is off.

    Mouths are alike, as they follow the sound; blinks and eye movements are drawn for each sample.

    Args:
        motions: the samples 0, 1 ... of equal length, at the frame rate of the result.
        wave: the speech; None for silence, in which the mouth stays closed.
        controls: any system's.
        seed: with `item` and the number of a sample, it decides all random numbers.
        item: name of the utterance.

    Raises:
        GestureKitError: the face cannot be made, such as from phones without the extra `face`.
    """
    method, text = controls["face"], controls["transcript"]
    if method == "off":
        return [*motions]
    if wave is None:
        log.warning("face=%r: there is no speech; the mouth stays closed", method)
        wave = af.Wave(np.zeros(16_000, np.float32), 16_000)
    rngs = (rng_for(seed, item, "sample", number, "face") for number in range(len(motions)))
    eyes, first = [Eyes(rng.initial_seed() >> 1) for rng in rngs], motions[0]
    faces = faces_from_speech(wave, first.fps, first.n_frames, method, text, eyes)
    return [replace(motion, face=face) for motion, face in zip(motions, faces)]
