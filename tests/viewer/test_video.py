"""Videos must show the motion at the right time, with its sound."""

from __future__ import annotations

import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from audio_features import AudioError, Wave
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.smpl.skeleton import fit_body, smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model.model import BodyModel
from gesturekit.viewer import write_html, write_picture, write_video
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.figure import Figure
from gesturekit.viewer.video import raster, writer
from gesturekit.viewer.video.mesh import Mannequin, SkinnedBody
from gesturekit.viewer.video.scene import Camera
from gesturekit.viewer.video.writer import text_mask, write_caption

RATE, JUMP = 16_000, 0.5


def read(path: Path) -> tuple[np.ndarray, float]:
    """Return frames (T, H, W, 3) and frames a second."""
    stream = imageio_ffmpeg.read_frames(path)
    facts = next(stream)
    width, height = facts["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in stream]
    return np.array(frames), facts["fps"]


def sound_of(path: Path) -> np.ndarray:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-ac", "1"]
    command += ["-ar", str(RATE), "-f", "f32le", "-"]
    return np.frombuffer(subprocess.run(command, check=True, capture_output=True).stdout, "<f4")


def a_jump(gesture, seconds: float = 1.0, fps: float = 30.0) -> Motion:
    motion = gesture(seconds, fps)
    up = np.where(motion.times >= JUMP - 1e-9, 0.4, 0.0)
    return replace(motion, translation=motion.translation + up[:, None] * [0, 1, 0])


def a_clap(seconds: float = 1.0) -> Wave:
    samples = np.zeros(int(seconds * RATE), np.float32)
    samples[int(JUMP * RATE) :][:320] = np.random.default_rng(0).normal(0, 0.3, 320)
    return Wave(samples, RATE)


def coloured(frames: np.ndarray) -> np.ndarray:
    """Return where the limbs are: the floor, the text and the trunk are almost grey."""
    frames = frames.astype(int)
    return frames.max(axis=-1) - frames.min(axis=-1) > 60


def test_a_jump_and_a_clap_are_at_the_same_time(tmp_path, gesture):
    write_video(a_jump(gesture), tmp_path / "jump.mp4", audio=a_clap())
    frames, fps = read(tmp_path / "jump.mp4")
    assert frames.shape[1:] == (720, 1280, 3)
    assert (len(frames), fps) == (30, 30.0)
    heights = [np.argwhere(frame)[:, 0].mean() for frame in coloured(frames)]
    assert np.argmin(np.diff(heights)) + 1 == round(JUMP * fps)
    sound = sound_of(tmp_path / "jump.mp4")
    assert np.argmax(np.abs(sound) > 0.1) / RATE == pytest.approx(JUMP, abs=0.02)
    assert len(sound) / RATE == pytest.approx(1.0, abs=1 / 30)


def test_a_video_that_the_disk_has_no_room_for_is_none(tmp_path, gesture):
    """In a process whose files may not grow over 20 kB."""
    gesture(0.5).save(tmp_path / "a.bvh")
    limit = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))}
    command = [sys.executable, "-m", "gesturekit", "convert", tmp_path / "a.bvh"]
    done = subprocess.run(
        [*command, out := tmp_path / "a.mp4"], text=True, capture_output=True, **limit
    )
    assert done.returncode == 1 and f"{out}: File too large" in done.stderr
    assert not [path for path in tmp_path.iterdir() if path.suffix == ".mp4"]


def test_a_video_shows_the_body_from_the_waist_up(tmp_path, gesture, gesturekit):
    gesture(0.1).save(tmp_path / "a.bvh")
    wide = {}
    for framing in ("whole", "waist"):
        out = tmp_path / f"{framing}.mp4"
        gesturekit("convert", tmp_path / "a.bvh", out, "--framing", framing).ok()
        wide[framing] = np.ptp(np.argwhere(coloured(read(out)[0])[0])[:, 1])
    assert wide["waist"] > 1.5 * wide["whole"]


def test_the_whole_figure_is_framed_whatever_its_size_and_path(tmp_path, gesture):
    motion = gesture(2.0, 4.0)
    walk = np.linspace(0, 3, motion.n_frames)[:, None] * [1.0, 0, 0]
    motion = replace(motion, translation=motion.translation + walk)
    write_video({"giant": motion.scaled(50), "dwarf": motion.scaled(0.01)}, tmp_path / "two.mp4")
    frames, _ = read(tmp_path / "two.mp4")
    for panel in (coloured(frames)[:, :, :640], coloured(frames)[:, :, 640:]):
        for frame in panel:
            rows, columns = np.nonzero(frame)
            assert 300 < np.ptp(rows) < 700
            assert rows.min() > 5 and rows.max() < 715
            assert columns.min() > 5 and columns.max() < 635


@pytest.mark.parametrize("framing", ["whole", "waist"])
@pytest.mark.parametrize("aspect", [0.4, 16 / 9])
def test_the_figure_fills_its_view_and_is_never_cut(gesture, aspect, framing):
    """Seen through a field of 30 degrees, all limbs keep 14 % of the view free, and no more."""
    figure = Figure.of(gesture(1.0))
    camera = Camera(figure, aspect, framing)
    lowest = figure.floor + (0.45 * figure.height if framing == "waist" else -1.0)
    points = np.maximum(figure.points, [-np.inf, lowest, -np.inf])
    thickest = max(max(limb.radii) * limb.width for limb in figure.limbs)
    thickest *= framing == "whole"
    shares = []
    for k in range(len(figure.points)):
        right, up, back, eye = camera.at(k / figure.fps)
        offset = points[k] - eye
        view = np.tan(np.radians(15.0)) * (-offset @ back - thickest)
        shares.append((np.abs(offset @ up) + thickest) / view)
        shares.append((np.abs(offset @ right) + thickest) / view / aspect)
    largest = np.max(shares)
    assert 0.84 < largest < 0.87
    beside, above = (max(share.max() for share in shares[k::2]) for k in (1, 0))
    assert (beside > above) == (aspect < 1)


def test_rate_size_and_length_can_be_chosen(tmp_path, gesture):
    write_video(gesture(0.5, 120.0), tmp_path / "x.mp4", size="1080p", fps=25, audio=a_clap(0.9))
    frames, fps = read(tmp_path / "x.mp4")
    assert frames.shape[1:3] == (1080, 1920)
    assert fps == 25.0 and abs(len(frames) - 0.9 * 25) <= 1
    write_video(gesture(0.5, 120.0), tmp_path / "y.mp4")
    assert read(tmp_path / "y.mp4")[1] == 30.0


def test_the_same_motion_makes_the_same_bytes(tmp_path, gesture):
    for name in ("a", "b"):
        write_video(gesture(0.2), tmp_path / name / "x.mp4", audio=a_clap(0.6))
    assert (tmp_path / "a/x.mp4").read_bytes() == (tmp_path / "b/x.mp4").read_bytes()


def test_without_the_extra_the_error_names_it(tmp_path, gesture, monkeypatch):
    def absent() -> str:
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", absent)
    for says in (r"gesturekit\[video\].* \(No ffmpeg exe could be found\)", r"gesturekit\[video\]"):
        with pytest.raises(FormatError, match=says):
            gesture(0.2).save(tmp_path / "x.mp4")
        monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", [write_video, write_picture, write_html])
def test_an_invalid_sound_is_refused_and_leaves_no_file(tmp_path, gesture, write):
    (tmp_path / "speech.wav").write_text("no sound")
    target = tmp_path / {write_video: "x.mp4", write_picture: "x.png"}.get(write, "x.html")
    with pytest.raises(AudioError, match=r"speech\.wav"):
        write(gesture(0.2), target, audio=tmp_path / "speech.wav")
    with pytest.raises(FormatError, match="720p or 1080p"):
        gesture(0.2).save(tmp_path / "x.mp4", size="huge")
    assert not list(tmp_path.glob("x.*"))


def darkest(image: np.ndarray) -> tuple[int, int, int, int]:
    """Return first and last row and column of what is darker than the rest."""
    rows, columns = np.nonzero(image.min(axis=2) < 150)
    return rows.min(), rows.max(), columns.min(), columns.max()


def test_captions_lie_where_they_are_put_and_are_cut_off():
    def written(text: str, at: tuple[float, float], size: float = 20) -> np.ndarray:
        image = np.full((60, 300, 3), 200, np.uint8)
        write_caption(image, text, at, size)
        return image

    mask = text_mask("HHH", 20)
    height, width = mask.shape
    assert 14 <= height <= 16 and mask.max() == 1 and mask.min() == 0
    image = written("HHH", (30, 50))
    ink = np.array([38, 48, 59])
    expected = np.full((60, 300, 3), 200.0)
    top = round(30 - height / 2)
    part = expected[top : top + height, 50 : 50 + width]
    part += mask[..., None] * (ink - part)
    assert np.abs(image - expected).max() <= 1
    # From the right edge to the text's right edge.
    assert (written("HHH", (30, -20)) == written("HHH", (30, 300 - 20 - width))).all()
    first, last, left, right = darkest(written("HHH", (2, 290)))
    assert first <= 1 and right == 299 and left >= 290 and last < height
    assert darkest(written("HHH", (58, 10)))[1] == 59
    assert darkest(written("HHH", (30, -400)))[2] < 4, "never beyond the left edge"
    # Letters twice as large, letters that the font lacks, and no more than 80 of them.
    assert abs(text_mask("HHH", 40).shape[0] - 2 * height) <= 1
    assert (text_mask("a\U0001f9ff", 20) == text_mask("a?", 20)).all()
    assert (written("i" * 81, (30, 5), 8) == written("i" * 79 + "…", (30, 5), 8)).all()
    assert (written("i" * 80, (30, 5), 8) != written("i" * 79 + "…", (30, 5), 8)).any()


@pytest.fixture
def encoded(monkeypatch, tmp_path):
    """encoded(motion, **options): frames, size, rate and sound as they reach the encoder."""
    kept = []

    def encode(frames, path, size, fps, wave) -> None:
        kept.append((list(frames), size, fps, wave))
        path.write_bytes(b"video")

    monkeypatch.setattr(writer, "encode", encode)

    def write(motion, **options):
        write_video(motion, tmp_path / "film.mp4", **options)
        return kept[-1]

    return write


@pytest.mark.parametrize(
    ("n", "columns", "rows"), [(1, 1, 1), (2, 2, 1), (3, 3, 1), (4, 2, 2), (5, 3, 2), (7, 3, 3)]
)
def test_panels_share_the_picture_with_lines_between(encoded, gesture, n, columns, rows):
    motion = gesture(0.03)
    shown = {f"take {k}": motion for k in range(n)}
    (frame,), size, _, wave = encoded(shown if n > 1 else motion)
    assert size == (1280, 720) and frame.shape == (720, 1280, 3) and wave is None
    wide, high = 1280 / columns, 720 / rows
    grey = (frame == 205).all(axis=2)
    across = [x for x in range(1280) if grey[: int(high) - 30, x].all()]
    down = [y for y in range(720) if grey[y, : int(wide)].all()]
    assert across == [int(k * wide) for k in range(1, columns)]
    assert down == [int(k * high) for k in range(1, rows)]
    for k in range(rows * columns):
        row, column = divmod(k, columns)
        panel = frame[int(row * high) + 1 : int((row + 1) * high),
                      int(column * wide) + 1 : int((column + 1) * wide)]  # fmt: skip
        is_empty = k >= n
        clock = k == rows * columns - 1
        body = panel[: int(high) - 40] if clock else panel
        assert (np.ptp(body.astype(int), axis=2).max() < 30) == is_empty
        if is_empty:
            assert (body == 245).all()
        else:  # its label, at the height of 1.3 letters of 0.028 of the picture
            first, last, left, _ = darkest(panel[:38, :110])
            assert (first + last) / 2 == pytest.approx(26, abs=4) and 18 <= left <= 24


def test_the_clock_counts_minutes(encoded, gesture):
    still = gesture(0.1)[:1]
    slow = replace(still, fps=1.0)
    long = replace(
        slow,
        rotations=np.repeat(slow.rotations, 121, axis=0),
        translation=np.repeat(slow.translation, 121, axis=0),
    )
    frames, *_ = encoded({"": long}, fps=0.08)
    assert len(frames) == 10
    expected = np.full((720, 1280, 3), 245, np.uint8)
    letters = 0.028 * 720
    for k, text in ((0, "0:00.0"), (1, "0:12.5"), (7, "1:27.5")):
        write_caption(expected, text, (720 - 1.3 * letters, -letters), letters)
        _, _, left, right = darkest(expected[640:])
        found = darkest(frames[k][640:, 1100:])
        assert (found[2] + 1100, found[3] + 1100) == (left, right), text
        expected[:] = 245


@pytest.mark.parametrize(
    ("fps", "asked", "rate", "n_frames"),
    [(25.0, None, 25.0, 15), (120.0, None, 30.0, 18), (30.0, 10, 10.0, 6), (30.0, 2.5, 2.5, 2)],
)
def test_a_video_has_the_rate_of_the_motion_up_to_thirty(
    encoded, gesture, fps, asked, rate, n_frames
):
    frames, _, found, _ = encoded(gesture(0.6, fps), fps=asked)
    assert (found, len(frames)) == (rate, n_frames)


def test_a_video_lasts_as_long_as_the_longest_and_what_is_over_stands_still(encoded, gesture):
    fast = gesture(0.2, 10.0)
    frames, _, fps, wave = encoded({"a": fast, "b": gesture(0.4, 20.0)}, audio=a_clap(0.6))
    assert (fps, len(frames), wave.duration) == (20.0, 12, 0.6)
    left, right = (np.array(frames)[:, 60:640, half] for half in (slice(0, 640), slice(641, 1280)))
    assert (left[0] != left[1]).any() and (left[4] == left[11]).all()
    assert (right[4] != right[7]).any() and (right[8] == right[11]).all()
    assert len(encoded(gesture(0.1, 10.0), fps=1.0)[0]) == 1, "at least one frame"
    with pytest.raises(MotionError, match="no motion to show"):
        encoded({})


def test_the_title_of_one_motion_is_its_files_name_or_what_is_given(encoded, gesture):
    """The other corner of the picture has no text."""
    motion = gesture(0.03)
    (usual,), *_ = encoded(motion)
    (same,), *_ = encoded({"film": motion})
    (other,), *_ = encoded({"another": motion})
    assert (usual == same).all() and (usual != other).any()
    assert np.argwhere((usual != other).any(axis=2)).max(axis=0)[0] < 50


def placed(body, time: float) -> np.ndarray:
    mesh = body.mesh
    vertices, normals = np.empty_like(mesh.vertices), np.empty_like(mesh.vertices)
    raster.place(
        *(mesh.vertices, mesh.normals, mesh.parts, mesh.weights, body.transforms(time)),
        *(vertices, normals),
    )
    return vertices


def test_limbs_reach_from_point_to_point(gesture):
    motion = gesture(0.5)
    figure = Figure.of(motion)
    body = Mannequin(figure)
    vertices = placed(body, 7 / motion.fps)
    for k, limb in enumerate(figure.limbs):
        own = vertices[body.mesh.parts[:, 0] == k]
        for end, radius in zip(limb.ends, limb.radii, strict=True):
            gap = np.linalg.norm(own - figure.points[7, end], axis=1)
            assert gap.min() <= radius * limb.width + 0.02 * figure.height


def test_a_body_model_is_drawn(tmp_path, capsule_body):
    np.savez(tmp_path / "BODY.npz", **capsule_body(24))
    body = BodyModel.load(tmp_path / "BODY.npz")
    angles = 0.3 * np.sin(np.arange(20)[:, None, None] / 5 + np.arange(24)[:, None])
    turns = np.concatenate([np.repeat(np.sin(angles), 3, axis=2) / 3**0.5, np.cos(angles)], axis=2)
    path = np.linspace([0, 0.9, 0], [1, 0.9, 2], 20)
    motion = fit_body(Motion(smpl_skeleton(24), turns, path, 20.0), body)
    drawn = DrawnBody.of(motion, body_model=body)
    skinned = SkinnedBody(drawn, drawn.skins[0])
    # The corrections for the pose, millimetres here, are left out.
    np.testing.assert_allclose(placed(skinned, 0.5), body.vertices(motion)[10], atol=0.01)
    motion.trim(0, 0.2).save(tmp_path / "x.mp4", body_model=tmp_path / "BODY.npz")
    assert len(read(tmp_path / "x.mp4")[0]) == 4
