"""Converting motion: what is written where, what is changed, what is refused."""

import json
import os
import pickle
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import at_rest

from gesturekit.conversion import Changes, Conversion, parse_trim
from gesturekit.errors import ConfigError
from gesturekit.formats.smpl import Rig, smpl_skeleton
from gesturekit.formats.sources import motions_in
from gesturekit.jobs.batch import Execution
from gesturekit.jobs.records import STATE
from gesturekit.jobs.result import Result
from gesturekit.motion import Motion
from gesturekit.motion.face import smplx_face
from gesturekit.motion.skeleton import BodyShape


def outcomes(*arguments, **options) -> list[Result]:
    return list(Conversion(*arguments, **options).run())


def written(folder: Path) -> set[str]:
    files = [path for path in folder.rglob("*") if path.is_file() and STATE not in path.parts]
    return {path.relative_to(folder).as_posix() for path in files}


@pytest.fixture
def take(gesture, tmp_path) -> Path:
    """A BVH of two seconds at 30 fps."""
    path = tmp_path / "take.bvh"
    gesture(2.0).save(path)
    return path


@pytest.fixture
def frames() -> list[dict]:
    """Twelve frames of somebody who stands, as EasyMocap holds them."""
    person = {"id": 3, "Rh": [[0.0, 0.0, 0.0]], "poses": [[0.01] * 72], "shapes": [[0.0] * 10]}
    return [[person | {"Th": [[0.1 * k, 1.2, 0.0]]}] for k in range(12)]


def write_frames(folder: Path, frames: list) -> Path:
    folder.mkdir(parents=True)
    for k, people in enumerate(frames):
        (folder / f"{k:06d}.json").write_text(json.dumps(people))
    return folder


def smpl_motion(fps: float = 30.0, n_joints: int = 55, **more) -> Motion:
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (30, n_joints, 1))
    return Motion(smpl_skeleton(n_joints), rotations, np.tile([0, 0.93, 0], (30, 1)), fps, **more)


def test_one_file_to_another_format_and_back(take, tmp_path):
    (done,) = outcomes(take, tmp_path / "a.npz")
    assert (done.error, done.facts["warnings"], done.facts["done"]) == (None, (), ())
    assert done.files == (tmp_path / "a.npz",)
    for fact in ("cm", "30 fps", "60 frames", "19 joints"):
        assert fact in done.facts["found"]
    (back,) = outcomes(tmp_path / "a.npz", tmp_path / "b.bvh")
    assert back.error is None
    first, last = Motion.load(take), Motion.load(tmp_path / "b.bvh")
    np.testing.assert_allclose(first.positions(), last.positions(), atol=1e-6)


def test_a_folder_keeps_its_structure_and_a_broken_file_is_skipped(gesture, frames, tmp_path):
    folder, out = tmp_path / "takes", tmp_path / "out"
    for name in ("a.bvh", "deep/er/b.b.bvh", "deep/c.npz", ".hidden/d.bvh", ".e.bvh"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        gesture(0.5).save(folder / name)
    (folder / "broken.bvh").write_text("Dear diary,\n")
    (folder / "notes.txt").write_text("not motion")
    np.savez(folder / "smpl.npz", v_template=np.zeros((3, 3)), kintree_table=np.zeros((2, 1)))
    np.savez(folder / "sound.npz", values=np.zeros((3, 2)), times=np.arange(3.0), spec="{}")
    write_frames(folder / "capture" / "smpl", frames)
    write_frames(folder / "capture" / "keypoints3d", [[{"id": 3, "keypoints3d": []}]])
    done = {os.path.relpath(o.source, folder): o for o in outcomes(folder, out, formats=["bvh"])}
    assert set(done) == {"a.bvh", "broken.bvh", "capture", "deep/c.npz", "deep/er/b.b.bvh"}
    assert [name for name, outcome in done.items() if outcome.error] == ["broken.bvh"]
    assert "broken.bvh:1" in done["broken.bvh"].error
    assert written(out) == {"a.bvh", "capture.bvh", "deep/c.bvh", "deep/er/b.b.bvh"}
    assert Motion.load(out / "capture.bvh").n_frames == 12


def test_files_of_a_folder_that_only_another_program_reads_are_named(gesture, tmp_path):
    gesture(0.5).save(tmp_path / "in" / "a.bvh")
    (tmp_path / "in" / "b.fbx").write_bytes(b"x")
    with pytest.warns(UserWarning, match="fbx"):
        outcomes(tmp_path / "in", tmp_path / "out", formats=["npz"])


def test_results_among_the_inputs_are_not_converted_again(gesture, tmp_path):
    folder = tmp_path / "takes"
    folder.mkdir()
    gesture(0.5).save(folder / "a.bvh")
    for _ in range(2):
        outcomes(folder, folder / "npz", formats=["npz"], existing="replace")
    assert written(folder) == {"a.bvh", "npz/a.npz"}


def test_existing_files_are_not_overwritten_by_default(take, tmp_path):
    out = tmp_path / "out"
    outcomes(take, out, formats=["npz"])
    before = (out / "take.npz").read_bytes()
    change = {"formats": ["npz", "bvh"], "changes": Changes(mirror=True)}
    with pytest.raises(ConfigError, match=r"(?=.*take\.npz)(?=.*mirror)"):
        outcomes(take, out, **change)
    assert written(out) == {"take.npz"}
    (done,) = outcomes(take, out, **change, existing="skip")
    assert done.files == (out / "take.bvh",)
    assert (out / "take.npz").read_bytes() == before
    outcomes(take, out, **change, existing="replace")
    assert (out / "take.npz").read_bytes() != before
    (done,) = outcomes(take, out, **change, existing="skip")
    assert (done.files, done.error) == ((), None)


def test_a_dry_run_reads_and_writes_nothing(take, tmp_path):
    (done,) = outcomes(take, tmp_path / "out", formats=["npz"], dry_run=True)
    assert done.files == (tmp_path / "out" / "take.npz",) and "60 frames" in done.facts["found"]
    assert not (tmp_path / "out").exists()
    (done,) = outcomes(take, tmp_path / "a.npz", dry_run=True, changes=Changes(joints=("Tail",)))
    assert "'Tail'" in done.error and str(take) in done.error


def test_invalid_requests_are_refused_before_anything_is_written(take, gesture, tmp_path):
    other = tmp_path / "other.bvh"
    gesture(0.5).save(other)
    (tmp_path / "empty").mkdir()
    namesake = tmp_path / "empty" / ".second" / "take.npz"
    namesake.parent.mkdir()
    gesture(0.5).save(namesake)
    before = written(tmp_path)
    for sources, out, options, says in (
        ([take, other], tmp_path / "x.bvh", {}, "2 inputs"),
        ([tmp_path], tmp_path / "x.npz", {}, re.escape(str(tmp_path))),
        (take, take, {"existing": "replace"}, r"take\.bvh"),
        (take, tmp_path / "x.c3d", {}, ".c3d"),
        (take, tmp_path / "x", {}, "--format npz"),
        (take, other, {"formats": ["npz"]}, r"other\.bvh & npz"),
        (tmp_path / "empty", tmp_path / "x", {"formats": ["bvh"]}, "empty"),
        ([take, namesake], tmp_path / "x", {"formats": ["npz"]}, r"take\.bvh & take\.npz"),
        (take, tmp_path / "x.npz", {"write": {"unit": "m"}}, "--unit & bvh"),
        (namesake, tmp_path / "x.bvh", {"read": {"unit": "m"}}, r"--in-unit & bvh & only \.npz"),
        (take, tmp_path / "x.obj", {}, "--body-model"),
        (take, tmp_path / "x.npz", {"body_model": "smpl.npz"}, "--body-model"),
    ):
        with pytest.raises(ConfigError) as caught:
            outcomes(sources, out, **options)
        assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))
    assert written(tmp_path) == before


def test_of_a_bvh_and_an_npz_of_one_name_the_one_that_holds_more_is_read(
    gesture, frames, tmp_path, recwarn
):
    folder = tmp_path / "takes"
    for stem in ("ours", "theirs"):
        for kind in ("bvh", "npz"):
            gesture(0.5).save(folder / f"{stem}.{kind}")
    poses = np.array([people[0]["poses"] for people in frames]).reshape(len(frames), -1)
    trans = np.zeros((len(frames), 3))
    np.savez(folder / "theirs.npz", poses=poses, trans=trans, mocap_frame_rate=30.0)
    done = outcomes(folder, tmp_path / "out", formats=["bvh"])
    assert [Path(one.source).name for one in done] == ["ours.npz", "theirs.bvh"]
    assert not any(one.error for one in done)
    said = " ".join(str(warning.message) for warning in recwarn)
    assert "ours.npz" in said and "theirs.bvh" in said
    (folder / "take.fbx").write_bytes(b"x")
    (done,) = outcomes(folder / "take.fbx", tmp_path / "x.bvh")
    assert "take.fbx" in done.error and "Blender" in done.error
    # What was passed over is an input all the same, never written over.
    with pytest.raises(ConfigError, match=r"\.bvh"):
        outcomes(folder, folder, formats=["bvh"], existing="replace")


def test_links_do_not_lead_out_of_the_folder(gesture, tmp_path):
    folder, out, elsewhere = tmp_path / "takes", tmp_path / "out", tmp_path / "elsewhere"
    for path in (folder / "a", out, elsewhere):
        path.mkdir(parents=True)
    gesture(0.5).save(folder / "a" / "b.bvh")
    (folder / "a" / "loop").symlink_to(folder)
    (out / "a").symlink_to(elsewhere)
    with pytest.raises(ConfigError, match=re.escape(str(out / "a"))):
        outcomes(folder, out, formats=["npz"])
    assert not written(elsewhere)
    (out / "a").unlink()
    assert len(outcomes(folder, out, formats=["npz"])) == 1


def test_pipes_and_missing_files_are_reported(tmp_path):
    os.mkfifo(tmp_path / "pipe.bvh")
    os.mkfifo(tmp_path / "pipe.npz")
    assert len(list(motions_in(tmp_path))) == 2, "looking into them would never end"
    for name in ("pipe.bvh", "pipe.npz", "none.bvh", "none"):
        (done,) = outcomes(tmp_path / name, tmp_path / "x.html")
        assert str(tmp_path / name) in done.error and not done.files


def test_changes_are_made_in_order(take, tmp_path):
    changes = Changes(trim=(0.5, 1.25), mirror=True, joints="body", fps=60.0)
    (done,) = outcomes(take, tmp_path / "a.npz", changes=changes)
    assert done.error is None
    # 1.25 s lies on frame 37.5, which rounds up.
    for text, fact in zip(done.facts["done"], ("0.77 s", "mirror", "60 fps"), strict=True):
        assert fact in text
    motion, source = Motion.load(tmp_path / "a.npz"), Motion.load(take)
    assert (motion.n_frames, motion.fps) == (46, 60.0)
    left, right = (source.skeleton.index(f"{side}Hand") for side in ("Left", "Right"))
    expected = source.positions()[15:38, left] * [-1, 1, 1]
    np.testing.assert_allclose(motion.positions()[::2, right], expected, atol=1e-9)
    (done,) = outcomes(take, tmp_path / "b.npz", changes=Changes(trim=(1.5, 60.0)))
    assert Motion.load(tmp_path / "b.npz").n_frames == 15, "what there is is kept"
    (done,) = outcomes(take, tmp_path / "c.npz", changes=Changes(trim=(2.0, 6.0)))
    assert re.search(r"\b2 s", done.error) and str(take) in done.error


def test_trim_is_written_in_seconds():
    for text, seconds in (("2:10.5", (2, 10.5)), (":3", (0, 3)), ("1:", (1, float("inf")))):
        assert parse_trim(text) == seconds
    for text in ("", "3", "2:2", "-1:4", "a:b"):
        with pytest.raises(ConfigError, match="trim"):
            parse_trim(text)


def test_fast_movement_is_filtered_out_of_a_lower_rate_on_request(skeleton):
    """A nod at 12.5 Hz, at 60 fps, is one at 2.5 Hz when each fourth frame alone is taken.

    The largest of its six frames a turn is at 60 degrees: 0.15 times 0.866.
    """
    motion = at_rest(skeleton, 240, fps=60.0)
    angles = 0.3 * np.sin(2 * np.pi * 12.5 * motion.times)
    motion.rotations[:, skeleton.index("Head"), 0] = np.sin(angles / 2)
    motion.rotations[:, skeleton.index("Head"), 3] = np.cos(angles / 2)
    nods = []
    for antialias in (False, True):
        lower, said = Changes(fps=15.0, antialias=antialias)(motion)
        assert "15 fps" in said[0] and lower.fps == 15
        nods.append(np.abs(lower.rotations[8:-8, skeleton.index("Head"), 0]).max())
    assert nods[0] == pytest.approx(0.13, abs=0.005) and nods[1] < 0.01
    same, said = Changes(fps=60.0, antialias=True)(motion)
    assert same is motion and said == []


def test_names_of_what_is_written_decide_between_a_file_and_a_folder(take, tmp_path):
    """Any other name, if formats are given, is that of a folder."""
    outcomes(take, tmp_path / "x.c3d", formats=["npz"])
    outcomes(take, tmp_path / "a.NPZ", formats=["npz"])
    assert written(tmp_path) == {"take.bvh", "x.c3d/take.npz", "a.NPZ"}
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=f"{tmp_path}/file is a file; give a folder"):
        outcomes(take, tmp_path / "file", formats=["npz"])
    with pytest.raises(ConfigError, match=r"(?=.*b\.npz)(?=.*shards)"):
        outcomes(take, tmp_path / "b.npz", execution=Execution(shard=(1, 2)))


def test_bones_below_a_removed_joint_are_reported(take, tmp_path):
    names = ("Hips", "Chest", "LeftForeArm", "LeftHand", "RightArm", "RightForeArm")
    (done,) = outcomes(take, tmp_path / "a.bvh", changes=Changes(joints=names))
    warning = done.facts["warnings"][0]
    assert all(name in warning for name in ("Chest", "LeftForeArm", "RightArm"))
    cut, whole = Motion.load(tmp_path / "a.bvh"), Motion.load(take)
    hand = [m.positions()[:, m.skeleton.index("LeftHand")] for m in (cut, whole)]
    np.testing.assert_allclose(*hand, atol=1e-6)


def test_data_that_a_format_cannot_store_causes_a_warning(tmp_path):
    motion = smpl_motion(25.0, face=smplx_face(np.ones((30, 100))))
    rig = replace(motion.skeleton, body_shape=BodyShape((1.0,) * 10))
    motion = replace(motion, skeleton=rig)
    with pytest.warns(UserWarning, match="25 fps"):
        motion.save(tmp_path / "a.npz")
    (bvh,) = outcomes(tmp_path / "a.npz", tmp_path / "a.bvh")
    assert [w for w in bvh.facts["warnings"] if re.search("(?=.*face)(?=.*betas)", w)]
    for name, lost in (("a.glb", "betas"), ("a.vrma", "SMPL-X face.*betas")):
        (made,) = outcomes(tmp_path / "a.npz", tmp_path / name)
        (warning,) = [w for w in made.facts["warnings"] if "betas" in w]
        assert re.search(f"holds no .*{lost}", warning)
    (npz,) = outcomes(tmp_path / "a.npz", tmp_path / "b.npz")
    assert [w for w in npz.facts["warnings"] if "--fps 30" in w] and len(npz.facts["warnings"]) == 1
    (npz,) = outcomes(tmp_path / "a.npz", tmp_path / "c.npz", changes=Changes(fps=30))
    assert npz.facts["warnings"] == ()


def face_csv(path: Path, value: float) -> Path:
    rows = [f"00:00:{k // 30:02d}:{2 * k % 60:02d}.000,61,{value}\n" for k in range(60)]
    path.write_text("Timecode,BlendshapeCount,JawOpen\n" + "".join(rows))
    return path


def test_a_face_is_added_from_a_file_or_a_folder(gesturekit, take, tmp_path):
    face = face_csv(tmp_path / "face.csv", 0.25)
    done = gesturekit("convert", take, tmp_path / "one.npz", "--face", face)
    assert done.status == 0, done.err
    assert Motion.load(tmp_path / "one.npz").face.values.tolist() == [[0.25]] * 60
    Motion.load(take).save(tmp_path / "other.bvh")
    both = (take, tmp_path / "other.bvh", tmp_path / "out", "--format", "npz,csv")
    gesturekit("convert", *both, "--face", face).fails(2, "one file for 2 motions")
    gesturekit("convert", *both, "--face", tmp_path / "none.csv").fails(2, "no such file")
    (tmp_path / "faces").mkdir()
    face_csv(tmp_path / "faces" / "take.csv", 0.5)
    done = gesturekit("convert", *both, "--face", tmp_path / "faces")
    done.fails(1, "no other.csv in", "no face")
    assert written(tmp_path / "out") == {"take.npz", "take.csv", "other.npz"}
    # A changed face is a changed input.
    face_csv(tmp_path / "faces" / "take.csv", 0.75)
    more = ("--face", tmp_path / "faces", "--existing", "replace")
    gesturekit("convert", *both, *more)
    assert Motion.load(tmp_path / "out" / "take.npz").face.values[0].tolist() == [0.75]
    assert "0.750000" in (tmp_path / "out" / "take.csv").read_text()


def test_a_mesh_needs_its_model(capsule_body, tmp_path):
    smpl_motion(n_joints=24).save(tmp_path / "a.npz")
    with pytest.warns(UserWarning, match="(?=.*obj)(?=.*--body-model)") as said:
        (done,) = outcomes(tmp_path / "a.npz", tmp_path / "out", formats=["obj", "bvh"])
    assert done.error is None and written(tmp_path / "out") == {"a.bvh"} and len(said) == 1
    np.savez(tmp_path / "model.npz", **capsule_body(24))
    (done,) = outcomes(tmp_path / "a.npz", tmp_path / "a.obj", body_model=tmp_path / "model.npz")
    assert done.error is None and (tmp_path / "a.obj").read_text().startswith("v ")
    outcomes(tmp_path / "a.npz", tmp_path / "limbs.html")
    outcomes(tmp_path / "a.npz", tmp_path / "skin.html", body_model=tmp_path / "model.npz")
    sizes = [(tmp_path / f"{name}.html").stat().st_size for name in ("limbs", "skin")]
    assert sizes[1] > sizes[0] + 10_000


def test_a_file_with_the_joints_of_smpl_gives_its_own_size(tmp_path):
    motion = smpl_motion(n_joints=24)
    tall = replace(motion, skeleton=motion.skeleton.scaled(1.3))
    motion.save(tmp_path / "a.npz")
    tall.save(tmp_path / "tall.bvh")
    rig = Rig.load(tmp_path / "tall.bvh")
    outcomes(tmp_path / "a.npz", tmp_path / "b.npz", changes=Changes(rig=rig))
    made = Motion.load(tmp_path / "b.npz").skeleton
    assert set(made.names) == set(tall.skeleton.names)
    order = [made.index(name) for name in tall.skeleton.names[1:]]
    np.testing.assert_allclose(made.offsets[order], tall.skeleton.offsets[1:], atol=1e-6)


def test_a_pickle_is_refused_with_the_command_that_makes_an_npz_of_it(gesturekit, tmp_path):
    """The keys are those of AIST++; its lengths are scaled."""
    poses, trans = np.full((9, 72), 0.1), np.full((9, 3), 50.0)
    values = {"smpl_poses": poses, "smpl_trans": trans, "smpl_scaling": np.array([100.0])}
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(values))
    done = gesturekit("convert", tmp_path / "x.pkl", tmp_path / "x.bvh")
    assert done.status == 1 and "x.pkl" in done.err and "pickle" in done.err
    command = shlex.split(re.search(r'python -c ".*"', done.err).group())
    subprocess.run([sys.executable, *command[1:]], cwd=tmp_path, check=True, timeout=60)
    motion = Motion.load(tmp_path / "x.npz", up="y")
    assert (motion.n_frames, motion.fps, motion.skeleton.n_joints) == (9, 60, 24)
    assert motion.translation[0, 0] == pytest.approx(0.5, abs=0.05)
