"""glTF and FBX files that we write, as other programs and engines take them."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avatars import avatar, avatar_json, packed, picture
from gltf_files import QUARTER_TURN, arm
from rigs import rig_of

from gesturekit.errors import FormatError
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.vrm import our_names, read_avatar
from gesturekit.motion import Motion
from gesturekit.motion.rotations import matrix_from_quaternion
from gesturekit.viewer.drawn_body import DrawnBody

ROOT = Path(__file__).resolve().parents[2]
MODULES = ROOT / "gesturekit" / "viewer" / "player" / "node_modules"


def interop():
    spec = importlib.util.spec_from_file_location("interop", ROOT / "tests/interop/interop.py")
    sys.modules["interop"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def odd_motion() -> Motion:
    """Joints that move, random rotations, 29.97 fps, names with blanks and colons."""
    return interop().odd_motion()


def test_every_joint_survives_a_round_trip(odd_motion, tmp_path):
    odd_motion.save(tmp_path / "a.glb")
    again = Motion.load(tmp_path / "a.glb")
    rig, same = odd_motion.skeleton, again.skeleton
    assert (same.names, same.parents, again.fps) == (rig.names, rig.parents, odd_motion.fps)
    np.testing.assert_allclose(same.offsets, rig.offsets, atol=1e-6)
    np.testing.assert_allclose(same.end_sites["bone39"][0], rig.end_sites["bone39"][0], atol=1e-6)
    assert again.joint_translations.keys() == odd_motion.joint_translations.keys()
    np.testing.assert_allclose(again.positions(), odd_motion.positions(), atol=1e-5)
    agreement = np.abs((again.rotations * odd_motion.rotations).sum(axis=-1))
    np.testing.assert_allclose(agreement, 1, atol=1e-6)


def test_a_body_that_stands_still_keeps_its_length(gesture, tmp_path):
    motion = gesture(0.5)
    still = replace(motion, rotations=np.repeat(motion.rotations[:1], motion.n_frames, axis=0))
    for part in (still, still[:1]):
        part.save(tmp_path / "a.glb")
        assert Motion.load(tmp_path / "a.glb").n_frames == part.n_frames


def test_keys_do_not_change_sign(gesture, tmp_path):
    """Programs that blend quaternions by their numbers would turn the long way round."""
    motion = gesture(0.5)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], motion.rotations.shape[:2])
    replace(motion, rotations=motion.rotations * signs[..., None]).save(tmp_path / "a.glb")
    gltf = Gltf(tmp_path / "a.glb")
    (animation,) = gltf.json["animations"]
    for channel in animation["channels"]:
        if channel["target"]["path"] == "rotation":
            keys = gltf.array(animation["samplers"][channel["sampler"]]["output"], "keys", 4)
            assert ((keys[1:] * keys[:-1]).sum(axis=1) > 0.9).all()


def skinned(path: Path, frame: int) -> dict[str, np.ndarray]:
    """Vertices of each material of a file in a frame, by linear blend skinning."""
    gltf, motion = Gltf(path), Motion.load(path)
    names = [node["name"] for node in gltf.json["nodes"]]
    joints = [names[node] for node in gltf.json["skins"][0]["joints"]]
    inverse = gltf.array(gltf.json["skins"][0]["inverseBindMatrices"], "inverse", 16)
    world = np.tile(np.eye(4), (len(joints), 1, 1))
    places, turns = motion.positions()[frame], motion.global_rotations()[frame]
    for k, name in enumerate(joints):
        if name in motion.skeleton.names:
            j = motion.skeleton.index(name)
            world[k, :3, :3], world[k, :3, 3] = matrix_from_quaternion(turns[j]), places[j]
    moves = world @ inverse.reshape(-1, 4, 4).swapaxes(1, 2)
    found = {}
    for part in gltf.json["meshes"][0]["primitives"]:
        values = [
            gltf.array(part["attributes"][name], name, width)
            for name, width in (("POSITION", 3), ("JOINTS_0", 4), ("WEIGHTS_0", 4))
        ]
        points = np.concatenate([values[0], np.ones((len(values[0]), 1))], axis=1)
        moved = np.einsum("vkij,vj,vk->vi", moves[values[1].astype(int)], points, values[2])
        found[gltf.json["materials"][part["material"]]["name"]] = moved[:, :3]
    return found


def test_the_human_mesh_follows_its_joints(gesture, tmp_path, gesturekit):
    gesture(0.5).save(tmp_path / "a.bvh")
    gesturekit("convert", tmp_path / "a.bvh", tmp_path / "a.glb", "--body", "human").ok()
    motion, parts = Motion.load(tmp_path / "a.glb"), skinned(tmp_path / "a.glb", 12)
    places = motion.positions()[12]
    for joint, material in (("LeftHand", "skin"), ("RightFoot", "shoes"), ("Head", "hair")):
        away = np.linalg.norm(parts[material] - places[motion.skeleton.index(joint)], axis=1)
        assert away.min() < 0.12, joint
    expected = DrawnBody.of(gesture(0.5), "human").motion
    np.testing.assert_allclose(motion.positions(), expected.positions(), atol=1e-5)


def test_a_rig_of_more_joints_than_a_byte_counts_keeps_its_bones(tmp_path):
    chain = {f"j{k}": (f"j{k - 1}" if k else None, (0.0, 0.1, 0.0)) for k in range(258)}
    rig = rig_of(chain)
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (2, 258, 1))
    turns[:, 256] = QUARTER_TURN
    Motion(rig, turns, np.zeros((2, 3)), 30.0).save(tmp_path / "a.glb")
    (vertices,) = skinned(tmp_path / "a.glb", 1).values()
    assert np.linalg.norm(vertices - [-0.1, 25.6, 0.0], axis=1).min() < 1e-4


@pytest.mark.parametrize("version", [0, 1])
def test_an_avatar_keeps_its_file_and_moves(version, gesture, tmp_path):
    """Its hips hang on a node that is scaled, and stands elsewhere."""
    me = tmp_path / "me.vrm"
    content, data = avatar_json(version)
    content["nodes"][-2]["translation"] = [0.3, 0.1, -0.2]
    me.write_bytes(packed(content, data))
    gesture(0.5).save(tmp_path / "a.glb", body=str(me))
    found, _ = read_avatar(me)
    drawn = DrawnBody.of(gesture(0.5), str(me)).motion
    motion, gltf = Motion.load(tmp_path / "a.glb"), Gltf(tmp_path / "a.glb")
    for node, place in zip(found.nodes, np.moveaxis(drawn.positions(), 1, 0)):
        joint = motion.skeleton.index(found.gltf.json["nodes"][node]["name"])
        np.testing.assert_allclose(motion.positions()[:, joint], place, atol=1e-5)
    assert gltf.view(gltf.json["images"][0]["bufferView"]).startswith(picture())
    assert gltf.json["materials"] == found.gltf.json["materials"]
    assert "VRM" not in json.dumps(gltf.json)


def test_vrm_animations_rest_in_a_t_pose_and_point_as_the_motion_does(gesture, tmp_path):
    gesture(0.5).save(tmp_path / "a.vrma")
    found = Gltf(tmp_path / "a.vrma").json
    bones = found["extensions"]["VRMC_vrm_animation"]["humanoid"]["humanBones"]
    names = {bone: found["nodes"][entry["node"]]["name"] for bone, entry in bones.items()}
    assert names["hips"] == "Hips" and names["leftThumbMetacarpal"] == "LeftHandThumb1"
    motion, human = Motion.load(tmp_path / "a.vrma"), DrawnBody.of(gesture(0.5), "human").motion
    rig = motion.skeleton
    for side, out in (("Left", 1), ("Right", -1)):
        for bone in ("ForeArm", "Hand"):
            offset = rig.offsets[rig.index(side + bone)]
            np.testing.assert_allclose(offset / np.linalg.norm(offset), [out, 0, 0], atol=1e-3)
    for name in ("LeftHand", "RightHandIndex2", "Head", "LeftToeBase"):
        places = [one.positions()[:, one.skeleton.index(name)] for one in (motion, human)]
        np.testing.assert_allclose(*places, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("prefix", ["", "mixamorig:", "mixamorig9"])
def test_avatars_with_the_names_of_mixamo_are_bodies(prefix, gesture, tmp_path):
    """Ready Player Me's have the same names, without a prefix."""
    found, data = avatar_json(1)
    called = our_names(True)
    for node in found["nodes"]:
        node["name"] = prefix + called.get(node["name"], node["name"])
    expected = tmp_path / "vrm.vrm"
    expected.write_bytes(packed(found, data))
    del found["extensions"]
    (tmp_path / "me.glb").write_bytes(packed(found, data))
    (rig, skin), (same, other) = (read_avatar(tmp_path / name) for name in ("me.glb", "vrm.vrm"))
    assert not rig.is_backwards and rig.nodes == same.nodes
    np.testing.assert_array_equal(skin.vertices, other.vertices)
    gesture(0.2).save(tmp_path / "a.glb", body=str(tmp_path / "me.glb"))
    gesture(0.2).save(tmp_path / "b.glb", body=str(expected))
    places = [Motion.load(tmp_path / f"{name}.glb").positions() for name in "ab"]
    np.testing.assert_allclose(*places, atol=1e-6)


def test_an_avatar_with_numbers_that_json_lacks_is_refused(gesture, tmp_path):
    """Python reads NaN and Infinity; no other program would read the file that we wrote."""
    found, data = avatar_json(1)
    found["extras"] = {"weight": float("inf")}
    (tmp_path / "me.vrm").write_bytes(packed(found, data))
    with pytest.raises(FormatError, match=r"me\.vrm.*JSON"):
        gesture(0.1).save(tmp_path / "a.glb", body=str(tmp_path / "me.vrm"))
    assert not (tmp_path / "a.glb").exists()


def test_three_puts_the_joints_where_we_do(odd_motion, gesture, tmp_path):
    """`make interop` asks Blender and Khronos' validator too, on more files."""
    if not (MODULES / "three").exists():
        pytest.skip("three.js is not installed (make setup)")
    odd_motion.save(tmp_path / "odd.glb")
    gesture(0.5).save(tmp_path / "gesture.glb")
    for how in ("STEP", "CUBICSPLINE"):
        arm(how).save(tmp_path / f"{how}.glb")
    files = sorted(tmp_path.glob("*.glb"))
    assert not interop().between_three_and_us(files)


def test_fbx_needs_blender_and_says_so(gesture, tmp_path, monkeypatch):
    monkeypatch.setenv("GESTUREKIT_BLENDER", str(tmp_path / "none"))
    with pytest.raises(FormatError, match=r"a\.fbx.*(?=.*Blender).*none"):
        gesture(0.1).save(tmp_path / "a.fbx")
    monkeypatch.delenv("GESTUREKIT_BLENDER")
    monkeypatch.setenv("PATH", str(tmp_path))
    if importlib.util.find_spec("bpy") is None:
        with pytest.raises(FormatError, match=r"a\.fbx.* GESTUREKIT_BLENDER"):
            gesture(0.1).save(tmp_path / "a.fbx")
    assert not (tmp_path / "a.fbx").exists()


@pytest.fixture
def copying_blender(tmp_path, monkeypatch) -> None:
    """A program that copies the file that it is given."""
    program = tmp_path / "blender"
    program.write_text(
        f"#!{sys.executable}\nimport shutil, sys\n"
        "source, target = sys.argv[sys.argv.index('--') + 1:][:2]\n"
        "shutil.copyfile(source, target)\nopen(target[:-4] + '.txt', 'w').write('25.0')\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("GESTUREKIT_BLENDER", str(program))


@pytest.mark.usefixtures("copying_blender")
def test_fbx_files_are_read_with_the_options_of_glb_files(tmp_path):
    """The hand stands at (1, 1, 0) in the file and turns to (0, 2, 0) in one of 25 frames."""
    file = arm(times=(0, 1 / 30, 2 / 30)).animate([(0, "rotation", [0, 1], [(0, 0, 0, 1)] * 2)])
    file.json["animations"][0]["name"] = "idle"
    file.save(tmp_path / "a.fbx")
    read = {"animation": "idle", "unit": "cm", "up": "z", "forward": "x"}
    motion = Motion.load(tmp_path / "a.fbx", **read)
    # X of the file is +Z of the motion, Y is +X, Z is +Y.
    np.testing.assert_allclose(motion.positions()[0, 1], [0.01, 0, 0.01], atol=1e-8)
    np.testing.assert_allclose(motion.positions()[1, 1], [0.02, 0, 0], atol=1e-8)
    facts = {key: motion.info[key] for key in read} | {"source": motion.info["source"]}
    assert facts == read | {"source": str(tmp_path / "a.fbx")}
    assert (motion.fps, motion.n_frames) == (25, 3)
    faster = Motion.load(tmp_path / "a.fbx", fps=50.0, **read)
    assert (faster.fps, faster.n_frames) == (50, 6)
    with pytest.warns(UserWarning, match=rf"{tmp_path}/a\.fbx.* animations"):
        Motion.load(tmp_path / "a.fbx")


def test_a_folder_reads_each_motion_once_and_passes_over_mere_meshes(gesture, tmp_path, gesturekit):
    folder = tmp_path / "takes"
    folder.mkdir()
    gesture(0.2).save(folder / "a.glb")
    gesture(0.3).save(folder / "a.bvh")
    gesture(0.2).save(folder / "b.glb")
    (folder / "me.glb").write_bytes(avatar(1))
    done = gesturekit("convert", folder, tmp_path / "out", "--format", "npz").ok()
    assert {path.name for path in (tmp_path / "out").glob("*.npz")} == {"a.npz", "b.npz"}
    assert Motion.load(tmp_path / "out" / "a.npz").n_frames == 9
    assert str(folder / "a.glb") in done.err, "which is not read"
