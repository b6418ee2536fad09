import json

import numpy as np
import pytest
from rigs import at_rest
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.formats import read_easymocap
from gesturekit.formats.smpl import model_pelvis, smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model import BodyModel

FRAMES = 40


def recorded(name=0, n_frames=FRAMES, width=72, seed=0):
    """One person as EasyMocap keeps it: a smooth random motion, Z up."""
    rng = np.random.default_rng(seed)
    time = np.arange(n_frames)[:, None] / 30
    swing = rng.uniform(-0.3, 0.3, width) * np.sin(2 * time + rng.uniform(0, 6, width))
    swing[:, :3] = 0
    upright = Rotation.from_euler("x", 90, degrees=True)
    turn = Rotation.from_rotvec(np.outer(np.arange(n_frames), [0.0, 0, 0.02])) * upright
    return {
        "id": name,
        "Rh": turn.as_rotvec(),
        "Th": np.array([1.0, 2.0, 1.2]) + 0.1 * time * rng.normal(size=3),
        "poses": swing,
        "shapes": np.tile(rng.normal(size=10), (n_frames, 1)),
    }


def write(folder, people, *, first=0, missing=()):
    """smpl/000000.json, ...; `missing` holds (id, frame)."""
    folder = folder / "smpl"
    folder.mkdir(parents=True, exist_ok=True)
    n_frames = len(people[0]["Rh"])
    for t in range(n_frames):
        entries = [
            {k: v if k == "id" else [v[t].tolist()] for k, v in person.items()}
            for person in people
            if (person["id"], t) not in missing
        ]
        (folder / f"{first + t:06d}.json").write_text(json.dumps(entries))
    return folder


def test_the_root_turns_about_the_models_origin(tmp_path):
    person = recorded()
    motion = Motion.load(write(tmp_path, [person]), fps=50.0)
    assert motion.skeleton.names == smpl_skeleton(24).names
    assert (motion.n_frames, motion.fps, motion.info["up"]) == (FRAMES, 50.0, "z")
    # V = R X + T of each joint of the unturned body X, whose pelvis is at J.
    unturned = at_rest(motion.skeleton, FRAMES, model_pelvis(24), 50.0)
    unturned.rotations[:, 1:] = motion.rotations[:, 1:]
    turn = Rotation.from_rotvec(person["Rh"]).as_matrix()
    z_up = np.einsum("tab,tjb->tja", turn, unturned.positions()) + person["Th"][:, None]
    y_up = np.stack([z_up[..., 0], z_up[..., 2], -z_up[..., 1]], axis=-1)
    np.testing.assert_allclose(motion.positions(), y_up, atol=1e-9)
    np.testing.assert_allclose(motion.skeleton.body_shape.betas, person["shapes"][0], atol=1e-12)
    assert motion.positions()[:, motion.skeleton.index("head"), 1].min() > 1.0  # it stands


def test_the_folder_above_and_a_single_frame_are_read_too(tmp_path):
    folder = write(tmp_path, [recorded()])
    whole = Motion.load(tmp_path)
    one = Motion.load(folder / "000007.json")
    assert (whole.n_frames, one.n_frames) == (FRAMES, 1)
    np.testing.assert_allclose(one.rotations[0], whole.rotations[7], atol=1e-12)
    bare = {key: value for key, value in recorded().items() if key != "shapes"}
    assert not Motion.load(write(tmp_path / "bare", [bare])).skeleton.body_shape.betas


def test_the_body_model_places_the_pelvis(tmp_path, capsule_body):
    person = recorded()
    np.savez(tmp_path / "BODY.npz", **capsule_body(24))
    body = BodyModel.load(tmp_path / "BODY.npz")
    motion = read_easymocap(write(tmp_path, [person]), body_model=body)
    pelvis = body.joints_at_rest(person["shapes"][0])[0]
    z_up = Rotation.from_rotvec(person["Rh"]).apply(pelvis) + person["Th"]
    expected = np.stack([z_up[:, 0], z_up[:, 2], -z_up[:, 1]], axis=-1)
    np.testing.assert_allclose(motion.translation, expected, atol=1e-9)


def test_one_of_several_people(tmp_path):
    people = [recorded(3, seed=1), recorded(5, seed=2)]
    folder = write(tmp_path, people, missing={(3, 0), (3, 1)})
    with pytest.warns(UserWarning, match=r"(?=.*\b38\b).*\b40\b"):
        assert read_easymocap(folder).info["person"] == 5
    third = read_easymocap(folder, person=3)
    assert (third.n_frames, third.info["first_frame"]) == (38, 2)
    with pytest.raises(FormatError, match=r"(?=.*\b4).*\b3\b"):
        read_easymocap(folder, person=4)


def test_short_gaps_are_filled_and_long_ones_refused(tmp_path):
    person = recorded()
    whole = Motion.load(write(tmp_path / "whole", [person]))
    folder = write(tmp_path / "gap", [person], missing={(0, t) for t in range(10, 15)})
    (folder / "000020.json").unlink()
    with pytest.warns(UserWarning, match=r"\b6 "):
        motion = Motion.load(folder)
    assert (motion.n_frames, motion.info["filled_frames"]) == (FRAMES, 6)
    np.testing.assert_allclose(motion.rotations[15:20], whole.rotations[15:20])
    assert np.linalg.norm(motion.positions() - whole.positions(), axis=-1).max() < 0.02
    with pytest.raises(FormatError, match=r"(?=.*\b10\b)(?=.*14\b)(?=.*0.17 s).*max_gap"):
        read_easymocap(folder, max_gap=0.1)


@pytest.mark.parametrize(
    ("width", "n_joints"), [(63, 22), (66, 22), (69, 24), (72, 24), (156, 52), (165, 55)]
)
def test_poses_of_every_length(tmp_path, width, n_joints):
    person = recorded(width=3 * n_joints)
    person["poses"] = person["poses"][:, 3 * n_joints - width :]
    motion = Motion.load(write(tmp_path, [person]))
    assert motion.skeleton.n_joints == n_joints and "hands" not in motion.info
    full = recorded(width=3 * n_joints)["poses"].reshape(FRAMES, n_joints, 3)
    turned = Rotation.from_quat(motion.rotations[:, 5]).as_rotvec()
    np.testing.assert_allclose(turned, full[:, 5], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "JSON"),
        ("[" * 100_000, "JSON"),
        ('{"reference": 1, "models": 2, "definitions": 3}', "gesturekit evaluate"),
        ('[{"id": 0}]', "'Rh'"),
        ('[{"Rh": [0, 0, 0]}]', "entry 0"),
        ("[3]", "entry 0"),
        ('[{"id": 0, "Rh": [[0, 0]]}]', "2 numbers"),
        ('[{"id": 0, "Rh": {"a": 1}}]', "'Rh'"),
        ('[{"id": 0, "Rh": [0, 0, NaN]}]', "finite"),
        ('[{"id":0, "Rh":[0,0,0], "Th":[0,0,0], "poses":[1,2]}]', "66"),
    ],
)
def test_broken_frames_name_their_file(tmp_path, text, says):
    (tmp_path / "000000.json").write_text(text)
    with pytest.raises(FormatError) as caught:
        Motion.load(tmp_path)
    assert says in str(caught.value) and str(tmp_path) in str(caught.value)
