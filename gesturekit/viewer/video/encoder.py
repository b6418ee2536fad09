"""Encoder of mp4 files: H.264 and AAC, by the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
import soundfile

from audio_features import Wave
from gesturekit.errors import FormatError, OutputError

_QUALITY = "20"
"""Constant rate factor of x264: visually good."""
_SOUND_RATE = 48_000


def require_encoder() -> None:
    """Check that videos can be written.

    Raises:
        FormatError: imageio-ffmpeg is not installed, or has no ffmpeg for this machine.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise FormatError(
            "mp4 is encoded by imageio-ffmpeg: install it with `pip install 'gesturekit[video]'` "
            f"({error})"
        ) from None


def encode(
    frames: Iterable[np.ndarray], path: Path, size: tuple[int, int], fps: float, wave: Wave | None
) -> None:
    """Write a video.

    Args:
        frames: images (H, W, 3) uint8.
        path: the .mp4 file, overwritten.
        size: (W, H), even numbers.
        fps: frames per second.
        wave: sound that starts with the first frame.

    Raises:
        OutputError: ffmpeg failed, such as on a full disk.
    """
    import imageio_ffmpeg

    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        sound = {}
        if wave is not None:
            # Never the user's file: what ffmpeg reads is ours.
            source = Path(folder) / "sound.wav"
            soundfile.write(source, wave.samples, wave.sample_rate, "FLOAT")
            sound = {"audio_path": str(source), "audio_codec": "aac"}
        writer = imageio_ffmpeg.write_frames(
            str(path.absolute()),
            size,
            fps=float(Fraction(fps).limit_denominator(1001)),
            codec="libx264",
            quality=None,
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=["-preset", "veryfast", "-crf", _QUALITY, "-ar", str(_SOUND_RATE)]
            + ["-movflags", "+faststart", "-map_metadata", "-1", "-fflags", "+bitexact"]
            + ["-flags:v", "+bitexact", "-flags:a", "+bitexact"],
            **sound,
        )
        try:
            writer.send(None)
            for frame in frames:
                writer.send(frame)
        except OSError as error:
            raise OutputError(f"{path}: ffmpeg failed: {str(error).splitlines()[0]}") from None
        finally:
            writer.close()
    if not path.stat().st_size:
        raise OutputError(f"{path}: ffmpeg wrote nothing; is the disk full?")
