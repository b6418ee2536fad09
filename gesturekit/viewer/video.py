"""Writer of mp4 files that show motion with sound: captions, encoder, and the panels of figures."""

from __future__ import annotations

import os
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import soundfile
from matplotlib import font_manager
from matplotlib.ft2font import FT2Font

from audio_features import Wave
from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError, OutputError
from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.resampling import checked_fps
from gesturekit.viewer.drawn_body import DrawnBody, drawn_bodies
from gesturekit.viewer.page_data import Playable, as_wave
from gesturekit.viewer.scene import Scene

if TYPE_CHECKING:
    from gesturekit.motion import Motion

INK = np.array([38, 48, 59], np.float32)
_LONGEST = 80
_DPI = 72


def write_caption(image: np.ndarray, text: str, at: tuple[float, float], size: float) -> None:
    """Write text on an image (H, W, 3) uint8; what does not fit is cut off.

    Args:
        image: changed in place.
        text: a line.
        at: (row, column) of the middle of its left edge, pixels; a negative column counts from
            the right edge to the text's right edge.
        size: of the letters, pixels.
    """
    mask = text_mask(text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…", size)
    height, width = image.shape[:2]
    row, column = at
    top = max(0, round(row - mask.shape[0] / 2))
    left = max(0, round(column if column >= 0 else width + column - mask.shape[1]))
    mask = mask[: height - top, : width - left]
    area = image[top : top + mask.shape[0], left : left + mask.shape[1]]
    area[...] = area + mask[..., None] * (INK - area)


@lru_cache(64)
def text_mask(text: str, size: float) -> np.ndarray:
    """Return how much of each pixel a line of text covers, (H, W) float32 from 0 to 1.

    Letters that the font lacks are question marks.
    """
    font = FT2Font(font_manager.findfont("DejaVu Sans"))
    font.set_size(size, _DPI)
    font.set_text("".join(letter if font.get_char_index(ord(letter)) else "?" for letter in text))
    font.draw_glyphs_to_bitmap(antialiased=True)
    return np.asarray(font.get_image(), np.float32) / 255


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
        how = f"pip install 'gesturekit[video]' ({error})"
        raise FormatError(f"mp4 needs imageio-ffmpeg: {how}") from None


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
        OSError: the disk is full.
        OutputError: ffmpeg failed otherwise.
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
            reason = "it wrote no complete file"
        except OSError as error:
            reason = str(error).splitlines()[0]
        finally:
            writer.close()
    with path.open("rb+") as written:
        # The table of frames, which ffmpeg moves to the front when all else is written.
        if b"moov" in written.read(64):
            return
        written.seek(0, os.SEEK_END)
        written.write(bytes(1 << 20))  # raises what ffmpeg met and only prints: a full disk
    raise OutputError(f"{path}: ffmpeg failed: {reason}")


SIZES = {"720p": (1280, 720), "1080p": (1920, 1080)}
"""Width and height of a picture by its name."""
_USUAL_RATE = 30.0
_LEVELS = (3, 7)
"""Numbers of panels from which bodies are drawn with fewer vertices, and with fewer still."""
_TEXT = 0.028
"""Size of the letters as a share of the picture's height."""


def write_video(
    motion: Motion | Mapping[str, Motion],
    path: str | os.PathLike[str],
    *,
    audio: Playable | None = None,
    body: str | None = None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
    framing: str = "whole",
    size: str = "720p",
    fps: float | None = None,
) -> None:
    """Write an mp4 (H.264, AAC) that shows motion, followed by a camera, with its sound.

    It lasts as long as the longest motion, or the sound if that is longer; a motion that is over
    stands still.

    Args:
        motion: what to show; or {label: motion} for several side by side, each in its own panel.
            A single one is labelled by the file's stem.
        path: the .mp4 file to write.
        audio: the speech that belongs to it, a file or a `Wave`; it starts with the motion.
        body: "mannequin" (by default), "human", "skeleton" or the path of a VRM avatar; see
            `gesturekit.viewer.drawn_body`.
        body_model: shows the skin of this body in place of limbs: a `BodyModel`, its .npz file or a
            folder of models.
        framing: the view, "whole", "waist" (from there up, without the legs) or "face".
        size: "720p" or "1080p".
        fps: frames per second; by default the fastest motion's, at most 30.

    Raises:
        FormatError: imageio-ffmpeg (the extra `video`) is not installed, or `framing`, `size` or
            `body_model` cannot be used.
        AudioError: `audio` is not sound.
        MotionError: no motion, or an invalid rate.
        OutputError: ffmpeg failed.
    """
    require_encoder()
    if size not in SIZES:
        raise FormatError(f"size is {size!r}; expected {' or '.join(SIZES)}")
    path, wave = Path(path), as_wave(audio)
    motions = motion if isinstance(motion, Mapping) else {path.stem: motion}
    drawn = drawn_bodies(motions, body, body_model)
    usual = min(_USUAL_RATE, max(each.motion.fps for each in drawn.values()))
    fps = usual if fps is None else checked_fps(fps)
    panels = _panels(drawn, SIZES[size], framing)
    seconds = max(each.motion.duration for each in drawn.values())
    seconds = max(seconds, wave.duration if wave else 0.0)
    times = np.arange(max(1, int(seconds * fps + 0.5))) / fps
    frames = (partial(_picture, panels, SIZES[size], time) for time in times.tolist())
    with atomic_write(path) as temporary:
        encode(_drawn_ahead(frames), temporary, SIZES[size], fps, wave)


_Panel = tuple[str, Scene, tuple[slice, slice]]
"""Label, figure, and the rows and columns of the picture that show it."""


def _panels(shown: Mapping[str, DrawnBody], size: tuple[int, int], framing: str) -> list[_Panel]:
    """Return the panels of a picture of this width and height, row by row."""
    n_columns = min(len(shown), 3 if len(shown) != 4 else 2)
    n_rows = -(-len(shown) // n_columns)
    level = int(np.searchsorted(_LEVELS, n_columns * n_rows, side="right"))
    columns, rows = (
        np.linspace(0, whole, n + 1).astype(int)
        for whole, n in zip(size, (n_columns, n_rows), strict=True)
    )
    panels = []
    for k, (label, drawn) in enumerate(shown.items()):
        row, column = divmod(k, n_columns)
        top, bottom, left, right = *rows[row : row + 2], *columns[column : column + 2]
        scene = Scene(drawn, (right - left) / (bottom - top), level, k, framing)
        panels.append((label, scene, (slice(top, bottom), slice(left, right))))
    return panels


def _picture(panels: Sequence[_Panel], size: tuple[int, int], time: float) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of all panels at `time` seconds, with captions."""
    width, height = size
    # An empty panel is like the background.
    picture, letters = np.full((height, width, 3), 245, np.uint8), _TEXT * height
    for label, scene, area in panels:
        image = np.empty_like(picture[area])
        scene.draw(time, image)
        write_caption(image, label, (1.3 * letters, letters), letters)
        rows, columns = area
        if columns.start:
            image[:, 0] = 205
        if rows.start:
            image[0] = 205
        picture[area] = image
    clock = f"{int(time // 60)}:{time % 60:04.1f}"
    write_caption(picture, clock, (height - 1.3 * letters, -letters), letters)
    return picture


def _drawn_ahead(frames: Iterable[Callable[[], np.ndarray]]) -> Iterator[np.ndarray]:
    """Yield the frames in order; as many threads as there are cores draw ahead."""
    n_threads = min(os.cpu_count() or 1, 8)
    waiting: deque[Future[np.ndarray]] = deque()
    with ThreadPoolExecutor(n_threads) as pool:
        try:
            for draw in frames:
                waiting.append(pool.submit(draw))
                if len(waiting) > 2 * n_threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
