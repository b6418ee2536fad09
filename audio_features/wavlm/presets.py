"""WavLM features as DiffuseStyleGesture (Yang et al. 2023) makes them, its quirks included.

A released checkpoint of theirs needs just these features. For anything else use `WavLM` without
a preset and `FeatureTrack.to_rate`, which knows where the frames are.

Both stretch the frames of a stretch of sound to its motion frames by the ratio of lengths
(`interpolate` with align_corners=True) instead of placing them by time, and both use Large's
last layer.

"dsg" (ZEGGS, 20 motion frames per second)
    The sound is cut every 80 motion frames; each clip is heard with the 8 motion frames before
    it (zeros before the first), 4.4 s in all, and its 219 WavLM frames are stretched to 88. The
    waveform is not normalised, although Large was trained on normalised sound
    (YoungSeng/DiffuseStyleGesture issue 23). Ours: what is left after the last whole clip, which
    they drop, is heard as a clip filled up with zeros.

"dsg+" (BEAT and TWH, 30 motion frames per second)
    The whole sound is normalised as the checkpoint says, padded with zeros to (N // 5 s + 1)
    times 5 s, and heard in pieces of 5 s without context; all frames, those of the padding too,
    are stretched to the motion frames of the sound without padding, so that the features run
    ahead by up to 5 s at the end. Their number of motion frames is the least that MFCC, mel and
    prosody give; here it is the sound's own, a few frames apart from theirs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from audio_features.wavlm.weights import MICROSOFT_EPS, Weights

if TYPE_CHECKING:
    from audio_features.wavlm.extractor import WavLM

_RATE = 16_000


@dataclass(frozen=True)
class Preset:
    """A pipeline: `normalize` gives eps or None for weights, `extract` rows and their times."""

    normalize: Callable[[Weights], float | None]
    extract: Callable[[WavLM, np.ndarray], tuple[np.ndarray, np.ndarray]]


def _dsg(network: WavLM, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fps, clip, seed = 20, 88, 8
    hop = _RATE // fps
    n_frames = max(1, len(samples) // hop)
    stride = clip - seed
    pieces = -(-n_frames // stride)
    padded = np.zeros((pieces * stride + seed) * hop, dtype=np.float32)
    heard = samples[: pieces * stride * hop]
    padded[seed * hop : seed * hop + len(heard)] = heard
    rows = [
        _stretched(network.hidden_states(padded[at * hop : (at + clip) * hop]), clip)[seed:]
        for at in range(0, pieces * stride, stride)
    ]
    return np.concatenate(rows)[:n_frames], np.arange(n_frames) / fps


def _dsg_plus(network: WavLM, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    fps, piece = 30, 5 * _RATE
    n_frames = max(1, math.floor(len(samples) * fps / _RATE + 0.5))
    pieces = len(samples) // piece + 1
    padded = np.zeros(pieces * piece, dtype=np.float32)
    padded[: len(samples)] = network.normalized(samples)
    frames = [network.hidden_states(part) for part in padded.reshape(pieces, piece)]
    return _stretched(np.concatenate(frames), n_frames), np.arange(n_frames) / fps


def _stretched(values: np.ndarray, n_frames: int) -> np.ndarray:
    import torch

    rows = torch.from_numpy(values.T)[None]
    stretched = torch.nn.functional.interpolate(
        rows, size=n_frames, mode="linear", align_corners=True
    )
    return stretched[0].T.numpy()


PRESETS = {
    "dsg": Preset(lambda weights: None, _dsg),
    "dsg+": Preset(lambda weights: None if weights.normalize is None else MICROSOFT_EPS, _dsg_plus),
}
