"""The toy corpora: walks worth following, dances on their beats, fights as their flags say."""

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import audio_features as af
from gesturekit.evaluation import beat_alignment, foot_skate, music_beats
from gesturekit.formats.tables import load_events, load_root_path
from gesturekit.motion import Motion
from gesturekit.motion.contacts import foot_positions
from gesturekit.motion.root_path import RootPath

RECIPES = Path(__file__).resolve().parents[2] / "recipes"
sys.path[:0] = [str(RECIPES / f"diffusion_{name}") for name in ("locomotion", "events", "dance")]
from moves import met  # noqa: E402


def prepare(recipe: str, folder: Path, clips: int, seconds: float) -> Path:
    options = ["--out", folder, "--clips", clips, "--seconds", seconds, "--seed", 3]
    main = runpy.run_path(str(RECIPES / recipe / "prepare.py"))["main"]
    main([str(option) for option in options])
    return folder


@pytest.fixture(scope="module")
def walks(tmp_path_factory) -> Path:
    return prepare("diffusion_locomotion", tmp_path_factory.mktemp("walks"), 2, 5.0)


@pytest.fixture(scope="module")
def dances(tmp_path_factory) -> Path:
    return prepare("diffusion_dance", tmp_path_factory.mktemp("dances"), 2, 15.0)


def test_walkers_are_where_their_path_is(walks):
    files = sorted(walks.glob("*.bvh"))
    assert [file.name for file in files] == ["walk_00.bvh", "walk_01.bvh"]
    for file in files:
        motion, path = Motion.load(file), load_root_path(file.with_suffix(".path.csv"))
        own = RootPath.of(motion)
        assert motion.n_frames == path.n_frames == 300 and motion.fps == path.fps == 60.0
        assert np.abs(own.positions - path.positions).max() < 1e-4
        # The hips swing about the heading of the path; smoothed over 60 frames.
        assert (
            np.abs(replace(own, fps=180.0).smoothed().headings - path.headings)[60:-60].max() < 0.1
        )


def test_standing_feet_neither_slide_nor_sink(walks):
    for file in walks.glob("*.bvh"):
        motion = Motion.load(file)
        assert foot_skate(motion) < 0.06
        toes = foot_positions(motion)[:, [1, 3]]
        assert toes[..., 1].min() > 0.02 - 1e-4, "over the floor"
        # Of the two feet one stands at any time, to the millimetre.
        speed = np.linalg.norm(np.diff(toes, axis=0), axis=-1) * motion.fps
        assert np.quantile(speed.min(axis=1), 0.98) < 0.06


@pytest.mark.stress
def test_dancers_meet_the_beats_of_their_track(dances):
    for file in sorted(dances.glob("*.bvh")):
        motion, wave = Motion.load(file), af.Wave.load(file.with_suffix(".wav"))
        assert motion.duration == pytest.approx(wave.duration)
        found = beat_alignment(motion, music_beats(wave))
        assert found.score > found.chance_mean + 3 * found.chance_sd
        assert found.score > 0.35
        assert foot_skate(motion) < 1e-3


def test_fighters_move_when_their_table_says_so_and_at_no_other_time(tmp_path):
    (file,) = prepare("diffusion_events", tmp_path, 1, 20.0).glob("*.bvh")
    motion, events = Motion.load(file), load_events(file.with_suffix(".events.csv"))
    for name in ("punch", "duck"):
        moments = np.array([event.time for event in events if event.name == name])
        assert len(moments) >= 3
        assert met(motion, name, moments) == 1 and met(motion, name, moments + 0.5) < 0.3
    assert foot_skate(motion) < 1e-3
    again = prepare("diffusion_events", tmp_path / "again", 1, 20.0)
    for made in (file, file.with_suffix(".events.csv")):
        assert (again / made.name).read_bytes() == made.read_bytes()
