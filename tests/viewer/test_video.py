"""Videos must show the motion at the right time, with its sound."""

import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from audio_features import AudioError, Wave
from gesturekit.errors import FormatError
from gesturekit.formats.smpl import fit_body, smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model import BodyModel
from gesturekit.viewer import raster, write_html, write_picture, write_video
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.scene import SkinnedBody

RATE, JUMP = 16_000, 0.1


def sound_of(path: Path) -> np.ndarray:
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-ac", "1"]
    command += ["-ar", str(RATE), "-f", "f32le", "-"]
    return np.frombuffer(subprocess.run(command, check=True, capture_output=True).stdout, "<f4")


def a_jump(gesture) -> Motion:
    motion = gesture(0.2, 30.0)
    up = np.where(motion.times >= JUMP - 1e-9, 0.4, 0.0)
    return replace(motion, translation=motion.translation + up[:, None] * [0, 1, 0])


def a_clap() -> Wave:
    samples = np.zeros(int(0.2 * RATE), np.float32)
    samples[int(JUMP * RATE) :][:320] = np.random.default_rng(0).normal(0, 0.3, 320)
    return Wave(samples, RATE)


def coloured(frames: np.ndarray) -> np.ndarray:
    """Return where the limbs are: the floor, the text and the trunk are almost grey."""
    frames = frames.astype(int)
    return frames.max(axis=-1) - frames.min(axis=-1) > 60


def test_a_jump_and_a_clap_are_at_the_same_time(tmp_path, gesture, read_video):
    write_video(a_jump(gesture), tmp_path / "jump.mp4", audio=a_clap())
    frames, fps = read_video(tmp_path / "jump.mp4")
    assert frames.shape[1:] == (720, 1280, 3)
    assert (len(frames), fps) == (6, 30.0)
    heights = [np.argwhere(frame)[:, 0].mean() for frame in coloured(frames)]
    assert np.argmin(np.diff(heights)) + 1 == round(JUMP * fps)
    sound = sound_of(tmp_path / "jump.mp4")
    assert np.argmax(np.abs(sound) > 0.1) / RATE == pytest.approx(JUMP, abs=0.02)
    assert len(sound) / RATE == pytest.approx(0.2, abs=1 / 30)


def test_a_video_that_the_disk_has_no_room_for_is_none(tmp_path, gesture, gesturekit):
    """While the files of this process may not grow over 8 kB."""
    gesture(0.2).save(tmp_path / "a.bvh")
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, usual[1]))
    try:
        done = gesturekit("convert", tmp_path / "a.bvh", out := tmp_path / "a.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    done.fails(1, str(out))
    assert not [path for path in tmp_path.iterdir() if path.suffix == ".mp4"]


def test_a_video_shows_the_body_from_the_waist_up(tmp_path, gesture, gesturekit, read_video):
    gesture(0.04).save(tmp_path / "a.bvh")
    wide = {}
    for framing in ("whole", "waist"):
        out = tmp_path / f"{framing}.mp4"
        gesturekit("convert", tmp_path / "a.bvh", out, "--framing", framing).ok()
        wide[framing] = np.ptp(np.argwhere(coloured(read_video(out)[0])[0])[:, 1])
    assert wide["waist"] > 1.5 * wide["whole"]


def test_the_whole_figure_is_framed_whatever_its_size_and_path(tmp_path, gesture, read_video):
    motion = gesture(1.0, 2.0)
    walk = np.linspace(0, 3, motion.n_frames)[:, None] * [1.0, 0, 0]
    motion = replace(motion, translation=motion.translation + walk)
    write_video({"giant": motion.scaled(50), "dwarf": motion.scaled(0.01)}, tmp_path / "two.mp4")
    frames, _ = read_video(tmp_path / "two.mp4")
    for panel in (coloured(frames)[:, :, :640], coloured(frames)[:, :, 640:]):
        for frame in panel:
            rows, columns = np.nonzero(frame)
            assert np.ptp(rows) > 250
            assert rows.min() > 2 and rows.max() < 717
            assert columns.min() > 2 and columns.max() < 637


def test_rate_size_and_length_can_be_chosen(tmp_path, gesture, read_video):
    write_video(gesture(0.1, 120.0), tmp_path / "x.mp4", size="1080p", fps=25, audio=a_clap())
    frames, fps = read_video(tmp_path / "x.mp4")
    assert frames.shape[1:3] == (1080, 1920)
    assert fps == 25.0 and abs(len(frames) - 0.2 * 25) <= 1
    write_video(gesture(0.05, 120.0), tmp_path / "y.mp4")
    assert read_video(tmp_path / "y.mp4")[1] == 30.0
    with pytest.raises(FormatError, match=r"(?=.*\b720p).*1080p"):
        gesture(0.2).save(tmp_path / "z.mp4", size="huge")
    assert not (tmp_path / "z.mp4").exists()


def test_the_same_motion_makes_the_same_bytes(tmp_path, gesture):
    for name in ("a", "b"):
        write_video(gesture(0.1), tmp_path / name / "x.mp4", audio=a_clap())
    assert (tmp_path / "a/x.mp4").read_bytes() == (tmp_path / "b/x.mp4").read_bytes()


def test_without_the_extra_the_error_names_it(tmp_path, gesture, monkeypatch):
    def absent() -> str:
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", absent)
    for _ in range(2):
        with pytest.raises(FormatError, match=r"gesturekit\[video\]"):
            gesture(0.2).save(tmp_path / "x.mp4")
        monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", [write_video, write_picture, write_html])
def test_an_invalid_sound_is_refused_and_leaves_no_file(tmp_path, gesture, write):
    (tmp_path / "speech.wav").write_text("no sound")
    target = tmp_path / {write_video: "x.mp4", write_picture: "x.png"}.get(write, "x.html")
    with pytest.raises(AudioError, match=r"speech\.wav"):
        write(gesture(0.2), target, audio=tmp_path / "speech.wav")
    assert not list(tmp_path.glob("x.*"))


def placed(body, time: float) -> np.ndarray:
    mesh = body.mesh
    vertices, normals = np.empty_like(mesh.vertices), np.empty_like(mesh.vertices)
    raster.place(
        *(mesh.vertices, mesh.normals, mesh.parts, mesh.weights, body.transforms(time)),
        *(vertices, normals),
    )
    return vertices


def test_a_body_model_is_drawn(tmp_path, capsule_body, read_video):
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
    motion.trim(0, 0.1).save(tmp_path / "x.mp4", body_model=tmp_path / "BODY.npz")
    assert len(read_video(tmp_path / "x.mp4")[0]) == 2
