"""Writer of mp4 files that show motion with sound."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from audio_features import Wave
from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError, MotionError
from gesturekit.motion.body_model.model import BodyModel
from gesturekit.motion.resampling import checked_fps
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.sound import as_sound
from gesturekit.viewer.video import caption
from gesturekit.viewer.video.encoder import encode, require_encoder
from gesturekit.viewer.video.scene import Buffers, Scene

if TYPE_CHECKING:
    from gesturekit.motion import Motion

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
    audio: str | os.PathLike[str] | Wave | None = None,
    title: str | None = None,
    body: str | None = None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
    size: str = "720p",
    fps: float | None = None,
) -> None:
    """Write an mp4 (H.264, AAC) that shows motion, followed by a camera, with its sound.

    It lasts as long as the longest motion, or the sound if that is longer; a motion that is over
    stands still.

    Args:
        motion: what to show; or {label: motion} for several side by side, each in its own panel.
        path: the .mp4 file to write.
        audio: the speech that belongs to it, a file or a `Wave`; it starts with the motion.
        title: written in the corner of a single motion; the file's stem by default.
        body: "mannequin" (by default), "human", "skeleton" or the path of a VRM avatar; see
            `gesturekit.viewer.drawn_body`.
        body_model: shows the skin of this body in place of limbs: a `BodyModel`, its .npz file or a
            folder of models.
        size: "720p" or "1080p".
        fps: frames per second; by default the fastest motion's, at most 30.

    Raises:
        FormatError: imageio-ffmpeg (the extra `video`) is not installed, or `size` or
            `body_model` cannot be used.
        AudioError: `audio` is not sound.
        MotionError: no motion, or an invalid rate.
        OutputError: ffmpeg failed.
    """
    require_encoder()
    if size not in SIZES:
        raise FormatError(f"size is {size!r}; expected {' or '.join(SIZES)}")
    motions = dict(motion) if isinstance(motion, Mapping) else {"": motion}
    if not motions:
        raise MotionError("no motion to show: the mapping of motions is empty")
    usual = min(_USUAL_RATE, max(each.fps for each in motions.values()))
    fps = usual if fps is None else checked_fps(fps)
    path = Path(path)
    if not isinstance(motion, Mapping):
        motions = {path.stem if title is None else title: motion}
    wave = None
    if audio is not None:
        audio = as_sound(audio)
        wave = audio if isinstance(audio, Wave) else Wave.load(audio)
    drawn = {label: DrawnBody.of(motion, body, body_model) for label, motion in motions.items()}
    picture = _Picture(drawn, SIZES[size])
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

    def __init__(self, shown: Mapping[str, DrawnBody], size: tuple[int, int]) -> None:
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
            self._panels.append(_Panel(label, Scene(drawn, aspect, level, k), area))
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
            caption.write(image, panel.label, (1.3 * letters, letters), letters)
            if panel.area[1].start:
                image[:, 0] = 205
            if panel.area[0].start:
                image[0] = 205
            picture[panel.area] = image
        clock = f"{int(time // 60)}:{time % 60:04.1f}"
        caption.write(picture, clock, (self.size[1] - 1.3 * letters, -letters), letters)
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
