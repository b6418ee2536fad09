"""A motion to begin from: near it with little noise, free of it with nothing but noise."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import prefixed

from gesturekit import Motion, Skeleton
from gesturekit.errors import FormatError, ModelError

ASKED = {"foot_lock": False, "steps": 6}


@pytest.fixture(scope="module")
def model(untrained):
    return untrained(styles=("old", "angry"))


@pytest.fixture(scope="module")
def given(gesture) -> Motion:
    """A gesture somewhere else than at the origin."""
    made = gesture(2.0, seed=0)
    return replace(made, translation=made.translation + [3.0, 0.0, -2.0])


def apart(one: Motion, other: Motion) -> float:
    """Metres between joints, on average."""
    return float(np.linalg.norm(one.positions() - other.positions(), axis=-1).mean())


def test_smaller_changes_stay_nearer_to_the_given_motion(model, given):
    made = [model.generate(like=given, change=change, **ASKED) for change in (0.01, 0.1, 0.5, 1)]
    assert made[0].n_frames == given.n_frames
    distances = [apart(motion, given) for motion in made]
    assert distances == sorted(distances)
    free = model.generate(seconds=2.0, **ASKED)
    from_elsewhere = replace(free, translation=free.translation + [3.0, 0.0, -2.0])
    assert distances[0] < 0.05
    assert distances[-1] > 0.5 * apart(from_elsewhere, given) > 4 * distances[0]


def test_seconds_shorten_or_extend_the_given_motion(model, given):
    for seconds in (1.0, 3.0):
        made = model.generate(like=given, seconds=seconds, change=0.01, **ASKED)
        assert apart(made, given.resample(30.0, made.n_frames)) < 0.05
        assert made.n_frames == 30 * seconds


def test_a_motion_on_another_rig_is_retargeted_and_stands_on_the_floor(model, given):
    low = given.translation - [0.0, 0.9, 0.0]  # its pelvis is where others have their floor
    made = model.generate(like=prefixed(replace(given, translation=low)), change=0.01, **ASKED)
    assert made.skeleton.names == given.skeleton.names
    assert apart(made, given) < 0.2  # its feet are held where they stand, which moves the whole
    assert abs((made.positions() - given.positions())[..., 1].mean()) < 0.02


def test_motions_that_cannot_be_a_start_are_errors(model, given, tmp_path):
    for change in (0.0, 1.5, float("nan")):
        with pytest.raises(ModelError, match="change="):
            model.generate(like=given, change=change)
    with pytest.raises(FormatError, match=r"none\.bvh"):
        model.generate(like=tmp_path / "none.bvh")
    chain = Skeleton(("a", "b"), (-1, 0), np.array([[0.0, 0, 0], [0, 1, 0]]))
    stick = Motion(chain, np.tile([0.0, 0, 0, 1], (30, 2, 1)), np.zeros((30, 3)), 30.0)
    with pytest.raises(ModelError, match="retargeted"):
        model.generate(like=stick)
