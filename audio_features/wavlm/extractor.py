"""WavLM: hidden states of a speech network as features."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.errors import FeatureError, WeightsError
from audio_features.track import FeatureTrack
from audio_features.wave import Wave
from audio_features.wavlm.architecture import HOP, WINDOW

if TYPE_CHECKING:
    from audio_features.wavlm.layers import Layer

SAMPLE_RATE = 16_000

_DEFAULT_SECONDS = {"full_context": 300.0, "chunk": 30.0, "context": 5.0}
_SETTINGS = ("layer", "final_norm", "normalize", *_DEFAULT_SECONDS)
_SETTINGS += ("dtype", "preset", "fingerprint")
_GPU_BATCH = 8


class WavLM:
    """Hidden states of WavLM (Chen et al. 2022), 50 frames per second.

    Frame t sees samples [320t, 320t + 400) at 16 kHz and is centred at 0.0125 + 0.02t seconds;
    a sound of N samples has floor((N - 400)/320) + 1 frames. Values are those of transformers'
    own forward, to a relative 1e-5.

    Sounds of up to `full_context` seconds are seen whole. In longer ones the convolutions still
    are exact, with Base's normalisation over the whole sound; the transformer sees chunks of one
    length, and of each chunk the frames within `context` seconds of its edges are left to its
    neighbours. Memory stays bounded; values differ a little from those of the whole.

    The sound's level is left as it is: what the weights expect of the waveform is applied, over
    the whole sound, and nothing else.

    Args:
        weights: Hugging Face's folder, Microsoft's WavLM-*.pt or a torchaudio state dict.
        layer: counts as transformers' `hidden_states` (0 enters the first layer, k leaves the
            k-th); layers above are not computed. "last" is the network's output; several
            numbers stand side by side; "mean" is the mean of all states, {6: 1, 9: 3} a
            weighted one (weights are scaled to sum to 1).
        final_norm: whether the topmost state is taken after Large's final normalisation (Base
            has none). None: for "last" it is, as in all three code bases' output; a number
            names the raw state, as transformers 5 and torchaudio's `extract_features` have it.
        normalize: None does with the waveform what these weights expect; False leaves it as it
            is, a number takes it to mean 0 and variance 1, with that number added to the
            variance (Hugging Face adds 1e-7, Microsoft 1e-5).
        full_context: longest sound that is seen whole, in seconds.
        chunk, context: longest chunk of longer sounds, and what of it is context on either
            side, in seconds. The chunks of one sound are as few as will do and of one length.
        dtype: "fp32", or "bf16" for matrix products in bfloat16: faster where the processor has
            it, and a little different.
        preset: "dsg" or "dsg+", see `audio_features.wavlm.presets`; fixes all of the above but
            the weights and dtype.
        fingerprint: of the weights that are asked for, as a spec names them; others are refused.
        device: where to compute, "cpu" or "cuda"; no part of the spec.

    Attributes:
        weights: what was found; `weights.describe()` says it in a line.
        normalize: what is added to the waveform's variance, None where it is taken as it is.

    Raises WeightsError where the weights cannot be used, FeatureError for a setting that they
    or the extractor do not have.
    """

    def __init__(
        self,
        weights: str | os.PathLike[str],
        layer: Layer = "last",
        *,
        final_norm: bool | None = None,
        normalize: bool | float | None = None,
        full_context: float = 300.0,
        chunk: float = 30.0,
        context: float = 5.0,
        dtype: str = "fp32",
        preset: str | None = None,
        fingerprint: str | None = None,
        device: str = "cpu",
    ) -> None:
        import torch

        from audio_features.wavlm.encoder import Encoder
        from audio_features.wavlm.front_end import FrontEnd
        from audio_features.wavlm.layers import LayerChoice
        from audio_features.wavlm.presets import PRESETS
        from audio_features.wavlm.weights import read_weights

        kinds = {"fp32": torch.float32, "bf16": torch.bfloat16}
        if dtype not in kinds:
            raise FeatureError(f"dtype={dtype!r}: 'fp32' or 'bf16'")
        self.seconds = _checked_seconds(full_context, chunk, context)
        self._full, self._chunk, self._context = (
            round(seconds * SAMPLE_RATE / HOP) for seconds in self.seconds.values()
        )
        self._device = _checked_device(device)
        self.weights, tensors = read_weights(weights)
        if fingerprint not in (None, self.fingerprint):
            raise WeightsError(
                f"{os.fspath(weights)}: these weights have fingerprint {self.fingerprint}, "
                f"the features were made with {fingerprint}: give the weights that the model was "
                "trained on"
            )
        self.dtype, self.preset = dtype, preset
        shape = self.weights.architecture
        self._choice = LayerChoice(layer, final_norm, shape.layers)
        self.normalize = _checked_eps(self.weights.normalize if normalize is None else normalize)
        if preset is not None:
            if preset not in PRESETS:
                raise FeatureError(f"preset={preset!r}: one of {', '.join(PRESETS)}")
            free = self.seconds == _DEFAULT_SECONDS and final_norm is None and normalize is None
            if layer != "last" or not free:
                raise FeatureError(
                    f"preset={preset!r} fixes layer, normalisation and chunks: leave them out"
                )
            self.normalize = PRESETS[preset].normalize(self.weights)
        tensors = {name: tensor.to(self._device) for name, tensor in tensors.items()}
        self._front = FrontEnd(shape, tensors, kinds[dtype])
        self._encoder = Encoder(shape, tensors, max(self._choice.indices), kinds[dtype])

    @classmethod
    def from_spec(
        cls,
        settings: dict[str, Any],
        weights: str | os.PathLike[str] | None,
        device: str = "cpu",
    ) -> WavLM:
        """What `spec` describes, with the weights that it names by fingerprint.

        Settings that a spec leaves out have their defaults. Raises FeatureError for unknown
        settings, WeightsError where weights are missing or not those of the spec.
        """
        settings = {key: value for key, value in settings.items() if key != "kind"}
        unknown = sorted(settings.keys() - _SETTINGS)
        if unknown:
            raise FeatureError(
                f"feature spec of WavLM: unknown setting {unknown[0]!r}; "
                f"there are {', '.join(_SETTINGS)}"
            )
        if weights is None:
            wanted = settings.get("fingerprint")
            which = f" with fingerprint {wanted}" if wanted else ""
            raise WeightsError(
                f"WavLM weights{which} are needed: name their folder or file "
                "(features.weights=PATH to train, else --weights PATH)"
            )
        return cls(weights, **settings, device=device)

    @property
    def fingerprint(self) -> str:
        """Names the weights, see `Weights`."""
        return self.weights.fingerprint

    @property
    def layer(self) -> Any:
        """The layer or layers, as in the spec."""
        return self._choice.spec

    @property
    def centred(self) -> tuple[bool, ...]:
        """All columns: a clip's mean tells of voice and room."""
        return (True,) * self.dim

    @property
    def spec(self) -> dict[str, Any]:
        """Kind, every setting that makes the values, and the weights' fingerprint."""
        made_by: dict[str, Any] = {"kind": "wavlm"}
        if self.preset is not None:
            made_by["preset"] = self.preset
        else:
            made_by |= {
                "layer": self.layer,
                "final_norm": self._choice.final_norm,
                "normalize": False if self.normalize is None else self.normalize,
                **self.seconds,
            }
        return {**made_by, "dtype": self.dtype, "fingerprint": self.fingerprint}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the columns: wavlm_0 …, with the layer before it where there are several."""
        width = range(self.weights.architecture.width)
        if not self._choice.is_list:
            return tuple(f"wavlm_{i}" for i in width)
        return tuple(f"wavlm_{layer}_{i}" for layer in self._choice.indices for i in width)

    @property
    def dim(self) -> int:
        """Number of columns D: 768 a layer for Base and Base+, 1024 for Large."""
        return len(self.names)

    def extract(self, wave: Wave) -> FeatureTrack:
        """The hidden states of a sound of any rate: values (T, D).

        With a preset, the frames are those of its motion (20 or 30 per second).
        """
        from audio_features.wavlm.presets import PRESETS

        samples = wave.resample(SAMPLE_RATE).samples
        if self.preset is not None:
            values, times = PRESETS[self.preset].extract(self, samples)
        else:
            values = self.hidden_states(self.normalized(samples))
            times = (np.arange(len(values)) * HOP + WINDOW / 2) / SAMPLE_RATE
        return FeatureTrack(values, times, self.spec, self.names)

    def normalized(self, samples: np.ndarray) -> np.ndarray:
        """The waveform (N,) float32 as the network is to see it."""
        if self.normalize is None:
            return samples
        # In float32, as all three code bases: frames of near silence, which Large normalises
        # one by one, would show the rounding of anything else.
        scale = np.sqrt(samples.var() + np.float32(self.normalize))
        return (samples - samples.mean()) / scale

    def hidden_states(self, samples: np.ndarray) -> np.ndarray:
        """(T, D) float32 from (N,) samples at 16 kHz, taken as they are."""
        import torch

        from audio_features.wavlm.front_end import SoundFrames

        n_frames = (len(samples) - WINDOW) // HOP + 1
        values = np.empty((n_frames, self.dim), dtype=np.float32)
        longest = n_frames if n_frames <= self._full else self._chunk
        chunks = list(_chunks(n_frames, longest, self._context))
        size = 1 if self._device.type == "cpu" else _GPU_BATCH
        before, after = self._encoder.reach
        # Convolutions on a GPU would by default be rounded to TF32.
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            sound = torch.from_numpy(np.ascontiguousarray(samples)).to(self._device)
            frames = SoundFrames(self._front, sound)
            for at in range(0, len(chunks), size):
                batch = chunks[at : at + size]
                seen = [frames.window(c.start - before, c.stop + after) for c, _ in batch]
                states = self._encoder.states(torch.stack(seen))
                for (chunk, keep), picked in zip(batch, self._choice.pick(self._encoder, states)):
                    part = picked[keep.start - chunk.start : keep.stop - chunk.start]
                    values[keep] = part.cpu().numpy()
        return values

    def __repr__(self) -> str:
        return f"WavLM({self.weights.path!r}, {self.spec})"


def _chunks(n_frames: int, longest: int, context: int) -> Iterator[tuple[slice, slice]]:
    """Yield (frames seen, frames kept): as few chunks as will do, all of one length.

    The kept frames follow each other; a chunk keeps its context only where the sound begins or
    ends.
    """
    count = max(1, -(-(n_frames - 2 * context) // (longest - 2 * context)))
    length = min(n_frames, -(-(n_frames + (count - 1) * 2 * context) // count))
    done = 0
    while done < n_frames:
        start = min(max(0, done - context), n_frames - length)
        stop = start + length
        keep = slice(done, n_frames if stop == n_frames else stop - context)
        yield slice(start, stop), keep
        done = keep.stop


def _checked_seconds(full_context: Any, chunk: Any, context: Any) -> dict[str, float]:
    given = f"full_context={full_context!r}, chunk={chunk!r}, context={context!r}"
    try:
        full, length, around = float(full_context), float(chunk), float(context)
    except (TypeError, ValueError) as error:
        raise FeatureError(f"{given}: give three numbers of seconds") from error
    if not (
        0 <= full < 1e6 and 0 <= around < 1e6 and 2 * around + HOP / SAMPLE_RATE <= length < 1e6
    ):
        raise FeatureError(
            f"{given}: give seconds from 0 to 1000000, and chunks longer than twice their context"
        )
    return {"full_context": full, "chunk": length, "context": around}


def _checked_eps(normalize: bool | float | None) -> float | None:
    """What is added to the variance, None for a waveform taken as it is."""
    if normalize is None or normalize is False:
        return None
    if not isinstance(normalize, float) or not 0 < normalize < 1:
        raise FeatureError(f"normalize={normalize!r}: False, or a number between 0 and 1")
    return normalize


def _checked_device(name: str) -> Any:
    import torch

    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise FeatureError(f"device={name!r} cannot be used: {reason}: give 'cpu'") from error
    return device
