"""WavLM features as computed by DiffuseStyleGesture (Yang et al. 2023), quirks included.

Its released checkpoints need exactly these features. For anything else use `WavLM` without a
preset and `FeatureTrack.to_rate`, which aligns frames by time.

Both presets stretch the WavLM frames of a segment to its motion frames by the ratio of lengths
(`interpolate` with align_corners=True) instead of by time, and use Large's last layer.

"dsg" (ZEGGS, 20 motion frames per second)
    The sound is cut every 80 motion frames. Each clip is processed with the 8 motion frames
    before it (zeros before the first), 4.4 s in all, and its 219 WavLM frames are stretched to
    88. The waveform is not normalised, although Large was trained on normalised sound
    (YoungSeng/DiffuseStyleGesture issue 23). One difference: they drop the remainder after the
    last whole clip; here it is padded with zeros to a whole clip.

"dsg+" (BEAT and TWH, 30 motion frames per second)
    The whole sound is normalised as the checkpoint says, padded with zeros to (N // 5 s + 1)
    times 5 s, and processed in pieces of 5 s without context. All frames, including those of the
    padding, are stretched to the motion frames of the sound without padding, so the features run
    ahead by up to 5 s at the end. Their number of motion frames is the minimum over MFCC, mel
    and prosody; here it is the sound's own, which differs by a few frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from audio_features.wavlm.weights import MICROSOFT_EPS

HiddenStates = Callable[[np.ndarray], np.ndarray]
"""Function from samples (N,) at 16 kHz to hidden states (T, D)."""

_RATE = 16_000


@dataclass(frozen=True)
class Preset:
    """Feature extraction of one published system.

    Attributes:
        eps: function from the number that the weights expect to be added to the waveform's
            variance to the number that the system adds; None means no normalisation.
        extract: function from `HiddenStates` and the normalised samples (N,) to values (T, D)
            and times (T,) in seconds.
    """

    eps: Callable[[float | None], float | None]
    extract: Callable[[HiddenStates, np.ndarray], tuple[np.ndarray, np.ndarray]]


def _dsg(hidden_states: HiddenStates, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fps, clip, seed = 20, 88, 8
    hop = _RATE // fps
    n_frames = max(1, len(samples) // hop)
    stride = clip - seed
    pieces = -(-n_frames // stride)
    padded = np.zeros((pieces * stride + seed) * hop, dtype=np.float32)
    used = samples[: pieces * stride * hop]
    padded[seed * hop : seed * hop + len(used)] = used
    values = [
        _stretched(hidden_states(padded[at * hop : (at + clip) * hop]), clip)[seed:]
        for at in range(0, pieces * stride, stride)
    ]
    return np.concatenate(values)[:n_frames], np.arange(n_frames) / fps


def _dsg_plus(hidden_states: HiddenStates, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fps, piece = 30, 5 * _RATE
    n_frames = max(1, math.floor(len(samples) * fps / _RATE + 0.5))
    pieces = len(samples) // piece + 1
    padded = np.zeros(pieces * piece, dtype=np.float32)
    padded[: len(samples)] = samples
    frames = [hidden_states(part) for part in padded.reshape(pieces, piece)]
    return _stretched(np.concatenate(frames), n_frames), np.arange(n_frames) / fps


def _stretched(values: np.ndarray, n_frames: int) -> np.ndarray:
    import torch

    stretched = torch.nn.functional.interpolate(
        torch.from_numpy(values.T)[None], size=n_frames, mode="linear", align_corners=True
    )
    return stretched[0].T.numpy()


PRESETS = {
    "dsg": Preset(lambda expected: None, _dsg),
    "dsg+": Preset(lambda expected: None if expected is None else MICROSOFT_EPS, _dsg_plus),
}
