"""Fundamental frequency and voicing, frame by frame."""

from __future__ import annotations

import numpy as np

from audio_features.spectrum import SAMPLE_RATE, centred_frames

F0_RANGE = (60.0, 500.0)
"""Lowest and highest fundamental frequency looked for, in Hz."""

_FRAME = 1024  # 64 ms: almost four periods of the lowest voice
_LONGEST_PERIOD = int(np.ceil(SAMPLE_RATE / F0_RANGE[0]))
_CORE = _FRAME - _LONGEST_PERIOD - 1


def track_pitch(samples: np.ndarray, n_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Fundamental frequency by YIN, and how periodic each frame is at it.

    Args:
        samples: (N,) float32 at 16 kHz.
        n_frames: number of frames T; frame k is centred at k·0.01 s.

    Returns f0 (T,) Hz, always finite (YIN names a period for noise too), and periodicity (T,)
    in 0..1: the correlation coefficient of the frame with itself one period later (Boersma
    1993), which says whether to believe it.
    """
    import librosa

    f0 = np.empty(n_frames)
    periodicity = np.empty(n_frames)
    for first, frames in centred_frames(samples, _FRAME, n_frames):
        here = slice(first, first + len(frames))
        f0[here] = librosa.yin(
            np.ascontiguousarray(frames).reshape(len(frames), _FRAME),
            fmin=F0_RANGE[0],
            fmax=F0_RANGE[1],
            sr=SAMPLE_RATE,
            frame_length=_FRAME,
            hop_length=_FRAME,
            center=False,
        )[:, 0]
        period = np.clip(np.rint(SAMPLE_RATE / f0[here]).astype(int), 1, _LONGEST_PERIOD)
        later = np.lib.stride_tricks.sliding_window_view(frames, _CORE, axis=1)
        later = later[np.arange(len(frames)), period]
        now = frames[:, :_CORE]
        energy = np.einsum("tn,tn->t", now, now) * np.einsum("tn,tn->t", later, later)
        product = np.einsum("tn,tn->t", now, later)
        periodicity[here] = product / np.sqrt(np.maximum(energy, 1e-12))
    return f0, np.clip(periodicity, 0.0, 1.0)
