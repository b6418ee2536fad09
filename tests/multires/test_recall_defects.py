"""Recalled pieces leave out what capture got wrong: joints that jump or pop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.recall.parts import defects_of_parts, motion_parts
from gesturekit.multires.recall.pieces import ChoiceWeights, PieceSearch
from gesturekit.multires.training.recall_library import _any_near

EXACT = ChoiceWeights(continuity=0.0, used=0.0, chance=0.0)


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def curves():
    """A recording of 40 frames: still vectors, and a profile of noise."""
    return [np.zeros((40, 3))], [np.random.default_rng(0).standard_normal((40, 2))]


def chosen(curves, defective) -> int:
    """Return the start of the piece for what frames 20 to 29 of the recording show."""
    search = PieceSearch(*curves, 10, 0, EXACT, defective)
    (start,) = search.choose(rng(), curves[1][0][20:30]).starts
    return int(start)


@pytest.mark.parametrize("frame", [20, 25, 29])
def test_a_piece_with_a_defect_is_not_chosen(curves, frame):
    flags = np.zeros(40, bool)
    assert chosen(curves, [flags]) == 20
    flags[frame] = True
    start = chosen(curves, [flags])
    assert not start <= frame < start + 10


@pytest.mark.parametrize("frame", [19, 30])
def test_a_defect_beside_a_piece_does_not_matter(curves, frame):
    flags = np.zeros(40, bool)
    flags[frame] = True
    assert chosen(curves, [flags]) == 20


def test_a_recording_full_of_defects_is_still_recalled(curves):
    flags = np.zeros(40, bool)
    flags[::5] = True
    assert chosen(curves, [flags]) == 20


def test_defects_are_assigned_to_the_part_with_the_defective_joint(gesture):
    motion = gesture(4.0, fps=30.0)
    rotations = motion.rotations.copy()
    elbow = motion.skeleton.index("LeftForeArm")
    off = Rotation.from_euler("x", 80, degrees=True) * Rotation.from_quat(rotations[50, elbow])
    rotations[50, elbow] = off.as_quat()
    spoilt = replace(motion, rotations=rotations)
    representation = MultiresRepresentation.fit([motion])
    parts = motion_parts(representation, separate=True)
    for made, frames in ((motion, []), (spoilt, [50])):
        values = torch.from_numpy(representation.encode(made).T)
        flags = defects_of_parts(parts, representation, 30.0, values)
        assert flags.shape == (3, 120)
        found = [np.flatnonzero(own).tolist() for own in flags]
        # The hand moves there and back at some 10 m/s, which may count as jumps around the pop.
        assert [[f for f in own if not 50 <= f <= 51] for own in found] == [[], [], []]
        assert (found[0][:1], found[1], found[2]) == (frames, [], [])


def test_flags_at_a_coarser_level_are_those_of_both_frames_around():
    flags = np.zeros((3, 12), bool)
    flags[0, 4] = flags[1, 5] = flags[2, 0] = flags[2, 11] = True
    # Frames 4 and 5 of 12 lie at (4.5 / 12) 4 - 0.5 = 1 and at 1.33 of 4, the ends outside.
    expected = [[0, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, 1]]
    assert _any_near(flags, 4).astype(int).tolist() == expected
