"""Optional torchaudio backend: resampling and log-mel on the CPU or a GPU.

No other module needs torchaudio. With a CPU-only torch, PyPI's torchaudio raises OSError on
import because it is built for CUDA; everything else still works.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from types import ModuleType

import numpy as np

from audio_features.acoustic.analysis import (
    HOP,
    N_FFT,
    SAMPLE_RATE,
    WINDOW,
    ShortTimeSpectrum,
    hann_window,
)
from audio_features.errors import FeatureError
from audio_features.wave import Wave

# The windowed sinc filter closest to soxr HQ (torchaudio's documentation, "kaiser_best").
_RESAMPLER = {
    "lowpass_filter_width": 64,
    "rolloff": 0.9475937167399596,
    "resampling_method": "sinc_interp_kaiser",
    "beta": 14.769656459379492,
}
_BLOCK_FRAMES = 6000  # one minute on the device at a time


@lru_cache
def import_torchaudio() -> tuple[ModuleType | None, str | None]:
    """Return (torchaudio, None), or (None, the reason why it cannot be used)."""
    try:
        import torchaudio
        import torchaudio.functional
    except ImportError as error:
        missing = getattr(error, "name", None) == "torchaudio"
        return None, "not installed" if missing else f"does not import: {error}"
    except OSError as error:
        return None, f"its extension does not load (built for another torch): {error}"
    return torchaudio, None


def check_device(device: str) -> ModuleType:
    """Return torchaudio; raise FeatureError if it or the device cannot be used."""
    import torch

    module, problem = import_torchaudio()
    if module is None:
        raise FeatureError(
            f"backend='torchaudio': torchaudio is {problem}: install the build that matches "
            "torch, or leave the backend out (see `gesturekit doctor`)"
        )
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise FeatureError(f"device={device!r}: {str(error).splitlines()[0]}") from error
    return module


class TorchaudioSpectrum(ShortTimeSpectrum):
    """Short-time spectrum by torchaudio; values agree with the default's to about 0.01 dB.

    Resampling differs above 7 kHz, where the two filters roll off differently. The whole sound
    is resampled on the device at once; the spectrum is computed in blocks of frames.

    Raises FeatureError if torchaudio or the device cannot be used.
    """

    def __init__(self, wave: Wave, device: str = "cpu") -> None:
        import torch

        self._functional = check_device(device).functional
        self._device = torch.device(device)
        super().__init__(wave)

    def _resampled(self, wave: Wave) -> Wave:
        import torch

        if wave.sample_rate == SAMPLE_RATE:
            return wave
        with torch.inference_mode():
            samples = self._functional.resample(
                torch.from_numpy(wave.samples).to(self._device),
                wave.sample_rate,
                SAMPLE_RATE,
                **_RESAMPLER,
            )
        return Wave(samples.cpu().numpy(), SAMPLE_RATE, wave.source)

    @cached_property
    def power(self) -> np.ndarray:
        """Power (T, 257) float32; a frame's sum is its mean square relative to active speech."""
        import torch

        samples = torch.from_numpy(self.wave.samples)
        window = torch.from_numpy(hann_window()).to(self._device)
        power = np.empty((self.n_frames, N_FFT // 2 + 1), dtype=np.float32)
        with torch.inference_mode():
            for first in range(0, self.n_frames, _BLOCK_FRAMES):
                count = min(_BLOCK_FRAMES, self.n_frames - first)
                start = first * HOP - N_FFT // 2
                stop = start + (count - 1) * HOP + N_FFT
                block = samples[max(start, 0) : max(stop, 0)].to(self._device)
                missing = (max(-start, 0), stop - max(start, 0) - len(block))
                spectrum = self._functional.spectrogram(
                    torch.nn.functional.pad(block, missing),
                    pad=0,
                    window=window,
                    n_fft=N_FFT,
                    hop_length=HOP,
                    win_length=WINDOW,
                    power=2.0,
                    normalized=False,
                    center=False,
                )
                power[first : first + count] = spectrum.T.cpu().numpy()
        return power

    def _mel_filters(self, n_mels: int) -> np.ndarray:
        filters = self._functional.melscale_fbanks(
            N_FFT // 2 + 1, 50.0, SAMPLE_RATE / 2, n_mels, SAMPLE_RATE, mel_scale="slaney"
        )
        return filters.numpy().T
