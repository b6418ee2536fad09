"""Writer of mp4 files that show motion with sound: captions, encoder, and the panels of figures."""

from __future__ import annotations

import os
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
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
from gesturekit.viewer.scene import Buffers, Scene

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
    picture = _Picture(drawn, SIZES[size], framing)
    seconds = max(picture.duration, wave.duration if wave else 0.0)
    n_frames = max(1, int(seconds * fps + 0.5))
    with atomic_write(path) as temporary:
        encode(_frames(picture, n_frames, fps), temporary, picture.size, fps, wave)


@dataclass(frozen=True)
class _Panel:
    label: str
    scene: Scene
    area: tuple[slice, slice]


class _Picture:
    """All panels of the video, and captions.

    Attributes:
        size: (W, H) in pixels.
        duration: of the longest motion, seconds.
    """

    def __init__(self, shown: Mapping[str, DrawnBody], size: tuple[int, int], framing: str) -> None:
        self.size = size
        n_columns = min(len(shown), 3 if len(shown) != 4 else 2)
        n_rows = -(-len(shown) // n_columns)
        level = int(np.searchsorted(_LEVELS, n_columns * n_rows, side="right"))
        columns, rows = (
            np.linspace(0, whole, n + 1).astype(int)
            for whole, n in zip(size, (n_columns, n_rows), strict=True)
        )
        self._panels = []
        for k, (label, drawn) in enumerate(shown.items()):
            row, column = divmod(k, n_columns)
            area = (slice(rows[row], rows[row + 1]), slice(columns[column], columns[column + 1]))
            aspect = (area[1].stop - area[1].start) / (area[0].stop - area[0].start)
            self._panels.append(_Panel(label, Scene(drawn, aspect, level, k, framing), area))
        self.duration = max(panel.scene.duration for panel in self._panels)
        # An empty panel is like the background.
        self._blank = np.full((size[1], size[0], 3), 245, np.uint8)
        shapes = {self._blank[panel.area].shape[:2] for panel in self._panels}
        self._shapes = sorted(shapes)

    def buffers(self) -> dict[tuple[int, ...], Buffers]:
        """Return memory for one thread, by the panels' shapes."""
        return {shape: Buffers(*shape) for shape in self._shapes}

    def draw(self, time: float, buffers: dict[tuple[int, ...], Buffers]) -> np.ndarray:
        """Return the picture (H, W, 3) uint8 at `time` seconds."""
        picture = self._blank.copy()
        letters = _TEXT * self.size[1]
        for panel in self._panels:
            image = np.empty_like(picture[panel.area])
            panel.scene.draw(time, image, buffers[image.shape[:2]])
            write_caption(image, panel.label, (1.3 * letters, letters), letters)
            if panel.area[1].start:
                image[:, 0] = 205
            if panel.area[0].start:
                image[0] = 205
            picture[panel.area] = image
        clock = f"{int(time // 60)}:{time % 60:04.1f}"
        write_caption(picture, clock, (self.size[1] - 1.3 * letters, -letters), letters)
        return picture


def _frames(picture: _Picture, n_frames: int, fps: float) -> Iterator[np.ndarray]:
    """Yield the frames in order; as many threads as there are cores draw ahead."""
    n_threads = min(os.cpu_count() or 1, 8)
    free = deque(picture.buffers() for _ in range(n_threads))
    waiting: deque[Future[np.ndarray]] = deque()

    def drawn(time: float) -> np.ndarray:
        buffers = free.popleft()
        try:
            return picture.draw(time, buffers)
        finally:
            free.append(buffers)

    with ThreadPoolExecutor(n_threads) as pool:
        try:
            for k in range(n_frames):
                waiting.append(pool.submit(drawn, k / fps))
                if len(waiting) > 2 * n_threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
