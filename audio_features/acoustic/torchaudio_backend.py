"""Optional torchaudio backend: resampling and log-mel on the CPU or a GPU.

No other module needs torchaudio. With a CPU-only torch, PyPI's torchaudio raises OSError on
import because it is built for CUDA; everything else still works.
"""

from __future__ import annotations

import numpy as np

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


class Backend:
    """torchaudio on a device; values agree with the default's to about 0.01 dB.

    Resampling differs above 7 kHz, where the two filters roll off differently. The whole sound
    is resampled on the device at once; the spectrum is computed in blocks of frames.

    Raises FeatureError if torchaudio or the device cannot be used.
    """

    def __init__(self, device: str) -> None:
        import torch

        try:
            import torchaudio.functional

            torch.zeros(1, device=device)
        except (ImportError, OSError) as error:
            problem = f"does not import: {error}"
            if isinstance(error, OSError):
                problem = f"its extension does not load (built for another torch): {error}"
            elif error.name == "torchaudio":
                problem = "not installed"
            remedy = "install the build that matches torch, or leave the backend out"
            how = f"{remedy} (see `gesturekit doctor`)"
            raise FeatureError(f"backend='torchaudio': torchaudio is {problem}: {how}") from error
        except (RuntimeError, AssertionError) as error:
            raise FeatureError(f"device={device!r}: {str(error).splitlines()[0]}") from error
        self._functional, self._device = torchaudio.functional, device

    def resampled(self, wave: Wave, rate: int) -> Wave:
        """Resample a sound."""
        import torch

        if wave.sample_rate == rate:
            return wave
        given = torch.from_numpy(wave.samples).to(self._device)
        with torch.inference_mode():
            samples = self._functional.resample(given, wave.sample_rate, rate, **_RESAMPLER)
        return Wave(samples.cpu().numpy(), rate, wave.source)

    def power(
        self, sound: np.ndarray, n_frames: int, window: np.ndarray, n_fft: int, hop: int
    ) -> np.ndarray:
        """Return the power (T, n_fft/2 + 1) float32 of a sound (N,) in windows (W,) every hop."""
        import torch

        samples, taper = torch.from_numpy(sound), torch.from_numpy(window).to(self._device)
        power = np.empty((n_frames, n_fft // 2 + 1), dtype=np.float32)
        settings = {"n_fft": n_fft, "hop_length": hop, "win_length": len(window), "power": 2.0}
        with torch.inference_mode():
            for first in range(0, n_frames, _BLOCK_FRAMES):
                count = min(_BLOCK_FRAMES, n_frames - first)
                start = first * hop - n_fft // 2
                stop = start + (count - 1) * hop + n_fft
                block = samples[max(start, 0) : max(stop, 0)].to(self._device)
                missing = (max(-start, 0), stop - max(start, 0) - len(block))
                block = torch.nn.functional.pad(block, missing)
                spectrum = self._functional.spectrogram(
                    block, pad=0, window=taper, normalized=False, center=False, **settings
                )
                power[first : first + count] = spectrum.T.cpu().numpy()
        return power

    def mel_filters(self, n_mels: int) -> np.ndarray:
        """Return (n_mels, 257) float32 triangles as `acoustic.mel_filters` does."""
        return (
            self._functional.melscale_fbanks(257, 50.0, 8000.0, n_mels, 16000, mel_scale="slaney")
            .numpy()
            .T
        )
