"""Vocal effort: how calmly or forcefully somebody speaks, over windows of several seconds."""

from __future__ import annotations

import numpy as np

from audio_features.acoustic.extractors import AcousticExtractor
from audio_features.acoustic.frames import FRAME_RATE
from audio_features.acoustic.pitch import F0_RANGE
from audio_features.acoustic.spectrum import N_FFT, ShortTimeSpectrum
from audio_features.errors import FeatureError

_LOW_BAND, _HIGH_BAND = (80.0, 1000.0), (1000.0, 5000.0)
"""Bands of the spectral tilt, Hz: forceful voices have more of the upper one."""
_AUDIBLE_DB = -30.0
"""Frames below this, relative to active speech, have no spectral tilt."""
_FEW = 0.5
"""Seconds of the clip's own value that count into every window, for windows with little speech."""
_HOP = 0.5
"""Seconds between windows; values between them are interpolated."""
_QUIET_TILT = -30.0
"""Spectral tilt of a clip without speech, dB."""


class Effort(AcousticExtractor):
    """Vocal effort in a window around each frame: three columns.

    - `effort_f0_median`, `effort_f0_high`: median and 90 % quantile of the pitch over voiced
      frames, semitones above 60 Hz; 0 in a clip without voice.
    - `effort_tilt`: 90 % quantile of the spectral tilt, the power in 1 to 5 kHz over that in 80 Hz
      to 1 kHz, over audible frames, in dB.

    Raised voices are higher and have more power in the upper band (Traunmüller and Eriksson 2000).
    Neither depends on the level of the recording. A calm clip has low values throughout, so the
    clip's mean must not be subtracted.

    Args:
        seconds: length of the window.
    """

    names = ("effort_f0_median", "effort_f0_high", "effort_tilt")
    centred = (False, False, False)

    def __init__(self, seconds: float = 8.0) -> None:
        if not isinstance(seconds, (int, float)) or not 0.5 <= seconds <= 120:
            raise FeatureError(f"seconds={seconds!r}: a number from 0.5 to 120")
        self.seconds = float(seconds)
        self.spec = {"kind": "effort", "seconds": self.seconds}

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        melody = spectrum.melody()
        pitch = np.zeros(spectrum.n_frames)
        pitch[melody.voiced] = 12.0 * np.log2(melody.f0[melody.voiced] / F0_RANGE[0])
        hertz = np.fft.rfftfreq(N_FFT, 0.5 / 8000.0)
        bands = [(hertz >= low) & (hertz < high) for low, high in (_LOW_BAND, _HIGH_BAND)]
        power = spectrum.power @ np.stack(bands, axis=1).astype(np.float32) + 1e-6
        tilt = 10.0 * np.log10(power[:, 1] / power[:, 0])
        audible = melody.energy >= _AUDIBLE_DB
        columns = [
            self._quantile(pitch, melody.voiced, 0.5, 0.0),
            self._quantile(pitch, melody.voiced, 0.9, 0.0),
            self._quantile(tilt, audible, 0.9, _QUIET_TILT),
        ]
        return np.stack(columns, axis=1)

    def _quantile(
        self, values: np.ndarray, valid: np.ndarray, share: float, empty: float
    ) -> np.ndarray:
        """Return the quantile (T,) of the valid values in the window around each frame."""
        if not valid.any():
            return np.full(len(values), empty)
        own = np.quantile(values[valid], share)
        hop, half = round(_HOP * FRAME_RATE), round(self.seconds * FRAME_RATE / 2)
        centres = np.arange(0, len(values) + hop, hop)
        quantiles = []
        for centre in centres:
            window = slice(max(0, centre - half), centre + half)
            inside = values[window][valid[window]]
            few = _FEW * FRAME_RATE
            found = np.quantile(inside, share) if len(inside) else own
            quantiles.append((len(inside) * found + few * own) / (len(inside) + few))
        return np.interp(np.arange(len(values)), centres, quantiles)
