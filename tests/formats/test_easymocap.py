from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
from rigs import at_rest
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.formats import read_easymocap
from gesturekit.formats.smpl.skeleton import model_pelvis, smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model.model import BodyModel

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


def test_the_body_model_places_the_pelvis(tmp_path, capsule_body):
    person = recorded()
    np.savez(tmp_path / "BODY.npz", **capsule_body(24))
    body = BodyModel.load(tmp_path / "BODY.npz")
    motion = read_easymocap(write(tmp_path, [person]), body_model=body)
    pelvis = body.joints_at_rest(person["shapes"][0])[0]
    z_up = Rotation.from_rotvec(person["Rh"]).apply(pelvis) + person["Th"]
    expected = np.stack([z_up[:, 0], z_up[:, 2], -z_up[:, 1]], axis=-1)
    np.testing.assert_allclose(motion.translation, expected, atol=1e-9)


@pytest.mark.parametrize(("recorded_on", "model"), [(55, 24), (24, 55)])
def test_a_body_model_of_another_family_leaves_the_pelvis_where_it_is(
    tmp_path, capsule_body, recorded_on, model
):
    """The betas of SMPL mean another body in SMPL-X: the pelvis is that of the mean body."""
    person = recorded(width=3 * recorded_on)
    np.savez(tmp_path / "BODY.npz", **capsule_body(model))
    body = BodyModel.load(tmp_path / "BODY.npz")
    motion = read_easymocap(write(tmp_path, [person]), body_model=body)
    assert motion.skeleton.n_joints == model
    plain = read_easymocap(tmp_path)
    # The rig of the model stands at its own pelvis: the ways are those without a model.
    ways = [one.translation - one.translation[0] for one in (motion, plain)]
    np.testing.assert_allclose(*ways, atol=1e-9)


def test_one_of_several_people(tmp_path):
    people = [recorded(3, seed=1), recorded(5, seed=2)]
    folder = write(tmp_path, people, missing={(3, 0), (3, 1)})
    with pytest.warns(UserWarning, match=r"3 \(38 frames\), 5 \(40 frames\); 5 is read"):
        assert read_easymocap(folder).info["person"] == 5
    third = read_easymocap(folder, person=3)
    assert (third.n_frames, third.info["first_frame"]) == (38, 2)
    with pytest.raises(FormatError, match="no person 4; it has 3"):
        read_easymocap(folder, person=4)


def test_short_gaps_are_filled_and_long_ones_refused(tmp_path):
    person = recorded()
    whole = Motion.load(write(tmp_path / "whole", [person]))
    folder = write(tmp_path / "gap", [person], missing={(0, t) for t in range(10, 15)})
    (folder / "000020.json").unlink()
    with pytest.warns(UserWarning, match="6 missing frames"):
        motion = Motion.load(folder)
    assert (motion.n_frames, motion.info["filled_frames"]) == (FRAMES, 6)
    np.testing.assert_allclose(motion.rotations[15:20], whole.rotations[15:20])
    assert np.linalg.norm(motion.positions() - whole.positions(), axis=-1).max() < 0.02
    with pytest.raises(FormatError, match=r"frames 10 to 14 are missing, 0.17 s.*max_gap"):
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


@pytest.mark.parametrize(("width", "n_joints"), [(78, 52), (87, 55)])
def test_pca_hands_are_left_at_rest_with_a_warning(tmp_path, width, n_joints):
    person = recorded(width=width)
    motion = Motion.load(write(tmp_path, [person]))
    names = motion.skeleton.names
    assert motion.skeleton.n_joints == n_joints and "PCA" in motion.info["hands"]
    fingers = [j for j, name in enumerate(names) if name[-1] in "123" and "spine" not in name]
    assert len(fingers) == 30
    np.testing.assert_array_equal(motion.rotations[:, fingers, 3], 1.0)
    if n_joints == 55:
        jaw = Rotation.from_quat(motion.rotations[:, names.index("jaw")]).as_rotvec()
        np.testing.assert_allclose(jaw, person["poses"][:, 78:81], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not a readable JSON"),
        ("[" * 100_000, "not a readable JSON"),
        ("{}", "a JSON object with no keys"),
        ('{"reference": 1, "models": 2, "definitions": 3}', "that gesturekit evaluate wrote"),
        ("[1]", "entry 0 is not a person"),
        ('[{"id": "a"}]', "id 'a'"),
        ('[{"id": 0}]', "no 'Rh'"),
        ('[{"id": 0, "Rh": [[0, 0]]}]', "2 numbers; expected 3"),
        ('[{"id": 0, "Rh": [[0, [0], 0]]}]', "not a table of numbers"),
        ('[{"id": 0, "Rh": {"a": 1}}]', "not a table of numbers"),
        ('[{"id": 0, "Rh": [0, 0, NaN]}]', "finite"),
        ('[{"id": 0, "Rh": [0, 0, 1e999]}]', "finite"),
        ('[{"id":0, "Rh":[0,0,0], "Th":[0,0,0], "poses":[1,2]}]', "2 numbers; expected 66"),
        ("[]", "nobody"),
        ("[" + "9" * 5000 + "]", "JSON"),
    ],
)
def test_broken_frames_name_their_file(tmp_path, text, says):
    (tmp_path / "000000.json").write_text(text)
    with pytest.raises(FormatError) as caught:
        Motion.load(tmp_path)
    assert says in str(caught.value) and str(tmp_path) in str(caught.value)


def test_other_folders_and_settings_are_refused(tmp_path):
    with pytest.raises(FormatError, match="no frames of EasyMocap"):
        Motion.load(tmp_path)
    with pytest.raises(FormatError, match="no such file"):
        read_easymocap(tmp_path / "absent")
    (tmp_path / "large").mkdir()
    with (tmp_path / "large" / "000000.json").open("wb") as file:
        file.truncate((16 << 20) + 1)
    with pytest.raises(FormatError, match=r"000000\.json: larger than 16 MiB"):
        read_easymocap(tmp_path / "large")
    folder = write(tmp_path, [recorded(n_frames=2)])
    for options in ({"fps": 0.0}, {"fps": float("nan")}, {"up": "x"}):
        with pytest.raises(FormatError):
            read_easymocap(folder, **options)
    mixed = write(tmp_path / "mixed", [recorded(n_frames=2)])
    short = {"id": 0, "Rh": [0, 0, 0], "Th": [0, 0, 0], "poses": [0] * 66, "shapes": []}
    (mixed / "000001.json").write_text(json.dumps([short]))
    with warnings.catch_warnings(), pytest.raises(FormatError, match="in some frames"):
        Motion.load(mixed)


def test_a_number_that_is_no_frames_is_refused(tmp_path):
    folder = write(tmp_path / "smpl", [recorded(n_frames=1)])
    (folder / "000000.json").rename(folder / f"{10**30}.json")
    with pytest.raises(FormatError, match="frame's number of over 9 digits"):
        read_easymocap(folder)


def test_of_people_in_equally_many_frames_the_first_id_is_read(tmp_path):
    people = [recorded(5, n_frames=3), recorded(3, n_frames=3, seed=1), recorded(4, n_frames=2)]
    folder = write(
        tmp_path, [{k: v[:3] if k != "id" else v for k, v in p.items()} for p in people[:2]]
    )
    with pytest.warns(UserWarning, match="3 is read"):
        motion = read_easymocap(folder)
    assert motion.info["people"] == {5: 3, 3: 3} and motion.info["person"] == 3


@pytest.mark.parametrize(("missing", "is_right"), [(15, True), (16, False)])
def test_a_gap_of_half_a_second_is_filled(tmp_path, missing, is_right):
    """15 frames at 30 fps; positions and faces in between lie on a straight line."""
    person = recorded(n_frames=30) | {"expression": np.arange(30.0)[:, None] * [[1.0, -2.0]]}
    folder = write(tmp_path, [person], missing={(0, t) for t in range(5, 5 + missing)}, first=100)
    if not is_right:
        with pytest.raises(
            FormatError, match=r"frames 105 to 120 are missing, 0\.53 s; .*now 0\.5 s"
        ):
            read_easymocap(folder)
        return
    with pytest.warns(UserWarning, match="15 missing frames filled in"):
        motion = read_easymocap(folder)
    assert (motion.n_frames, motion.info["first_frame"]) == (30, 100)
    np.testing.assert_allclose(motion.expressions, person["expression"], atol=1e-9)
    line = np.linspace(motion.translation[4], motion.translation[20], 17)
    np.testing.assert_allclose(motion.translation[4:21], line, atol=1e-9)
    turned = Rotation.from_quat(motion.rotations[:, 3])
    halves = (turned[4].inv() * turned[12]).magnitude(), (turned[12].inv() * turned[20]).magnitude()
    assert halves[0] == pytest.approx(halves[1], rel=1e-6)


def entry(**changed) -> dict:
    return {"id": 0, "Rh": [0, 0, 0], "Th": [1, 2, 3], "poses": [0] * 72} | changed


@pytest.mark.parametrize(
    ("content", "n_joints", "person"),
    [
        ([entry()], 24, 0),
        ({"annots": [entry()]}, 24, 0),
        ([{k: v for k, v in entry(personID=7).items() if k != "id"}], 24, 7),
        ([entry(poses=[0] * 66)], 22, 0),
        ([entry(poses=[0] * 66, handl=[0] * 6)], 52, 0),
        ([entry(shapes=[0.1] * 1000)], 24, 0),
    ],
)
def test_other_forms_of_a_frame_are_read(tmp_path, content, n_joints, person):
    (tmp_path / "999999999.json").write_text(json.dumps(content))
    motion = read_easymocap(tmp_path, up="y")
    assert (motion.skeleton.n_joints, motion.info["person"], motion.n_frames) == (
        n_joints,
        person,
        1,
    )
    assert motion.expressions is None and motion.info["filled_frames"] == 0
    np.testing.assert_allclose(motion.translation[0], model_pelvis(n_joints) + [1, 2, 3])
    n_betas = 1000 if "shapes" in str(content) else 0
    assert len(motion.skeleton.body_shape.betas) == n_betas


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"shapes": [0.1] * 1001}, "'shapes' of person 0 holds no finite numbers, or too many"),
        ({"id": 1.5}, "entry 0 has id 1.5; expected a whole number"),
        ({"Th": [0, 0, 0, 0]}, "'Th' of person 0 has 4 numbers; expected 3"),
    ],
)
def test_damaged_people_are_named(tmp_path, changed, says):
    (tmp_path / "000000.json").write_text(json.dumps([entry(**changed)]))
    with pytest.raises(FormatError, match=says):
        read_easymocap(tmp_path)
