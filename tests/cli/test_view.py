"""gesturekit view and convert write videos and pictures too."""

from __future__ import annotations

import imageio_ffmpeg
import pytest


def facts(path) -> dict:
    return next(imageio_ffmpeg.read_frames(path))


@pytest.fixture
def clip(tmp_path, gesture):
    path = tmp_path / "a \u00fc.bvh"
    gesture(0.2).save(path)
    return path


def test_view_writes_videos_and_pictures(tmp_path, clip, gesturekit):
    assert gesturekit("view", clip, "-o", tmp_path / "v.mp4", "--fps", 25).status == 0
    assert facts(tmp_path / "v.mp4")["fps"] == 25.0
    assert gesturekit("view", clip, clip, "-o", tmp_path / "v.svg").status == 0
    assert "<svg" in (tmp_path / "v.svg").read_text(encoding="utf-8")


def test_options_of_videos_are_refused_for_pages(tmp_path, clip, gesturekit):
    refused = gesturekit("view", clip, "-o", tmp_path / "v.html", "--size", "720p")
    assert refused.status == 2
    assert "--size is an option of mp4" in refused.err
    refused = gesturekit("view", clip, "-o", tmp_path / "v.avi")
    assert refused.status == 2
    assert ".mp4" in refused.err


def test_convert_writes_videos_and_pictures(tmp_path, clip, gesturekit):
    done = gesturekit("convert", clip, tmp_path / "o", "--format", "mp4,pdf", "--size", "1080p")
    assert done.status == 0
    assert facts(tmp_path / "o" / "a \u00fc.mp4")["size"] == (1920, 1080)
    assert (tmp_path / "o" / "a \u00fc.pdf").read_bytes().startswith(b"%PDF")


def test_a_folder_with_a_broken_motion_is_shown_without_it_and_the_exit_code_is_1(
    tmp_path, clip, gesturekit
):
    command = ("view", tmp_path, "-o", tmp_path / "v.html")
    assert gesturekit(*command).status == 0
    (tmp_path / "broken.bvh").write_text("HIERARCHY\n")
    done = gesturekit(*command)
    assert done.status == 1 and "motion" in (tmp_path / "v.html").read_text(encoding="utf-8")
    assert [line[:8] for line in done.err.splitlines() if "broken.bvh" in line] == ["Failed: "]
    assert gesturekit("view", tmp_path / "broken.bvh", "-o", tmp_path / "w.html").status == 2
