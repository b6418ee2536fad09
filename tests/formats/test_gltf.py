"""Motion from glTF files of any program: curves, trees, arrays, and files that are hostile."""

import json
import os
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from gltf_files import HALF, QUARTER_TURN, GltfFile, arm
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.motion import Motion


def hand(path: Path, **options) -> np.ndarray:
    motion = Motion.load(path, **options)
    return motion.positions()[:, motion.skeleton.index("hand")]


def angle(path: Path, **options) -> np.ndarray:
    """Degrees by which the hand stands above the horizon of the shoulder."""
    x, y, _ = hand(path, **options).T
    return np.degrees(np.arctan2(y - 1, x))


def test_linear_curves_turn_evenly(tmp_path):
    path = arm().save(tmp_path / "a.glb")
    np.testing.assert_allclose(
        angle(path, fps=4), [0, 22.5, 45, 67.5, 90, 67.5, 45, 22.5, 0], atol=1e-4
    )


@pytest.mark.parametrize(
    ("times", "fps"),
    [
        (np.arange(20) / 24, 24),
        (np.arange(9) / 33, 33),
        (np.arange(99) * 1.001 / 240, 240 / 1.001),
        (np.round(np.arange(60) / 30, 3), 30),
        (np.array([0, 1, 2, 3, 4, 7, 30, 31, 90]) / 40, 120),  # keys at every frame would tell 40
        (np.array([0, 1.5]), 24),
    ],
)
def test_the_rate_is_that_of_the_keys(tmp_path, times, fps):
    turns = np.tile([0, 0, 0, 1], (len(times), 1))
    nodes = arm().json["nodes"]
    path = GltfFile(nodes).animate([(0, "rotation", times, turns)]).save(tmp_path / "a.glb")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion = Motion.load(path)
    assert motion.fps == pytest.approx(fps, rel=1e-9)
    assert motion.n_frames == round(times[-1] * fps) + 1


def scaled_rig() -> GltfFile:
    """A rig in centimetres, lying, in an object that scales and raises it, with a bone between."""
    nodes = [
        {
            "name": "Armature",
            "scale": [0.01] * 3,
            "rotation": [-HALF, 0, 0, HALF],
            "children": [1, 4],
        },
        {"name": "hips", "translation": [0, 0, 90], "rotation": [*QUARTER_TURN], "children": [2]},
        {
            "name": "between",
            "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 20, 1],
            "children": [3],
        },
        {"name": "head", "translation": [0, 0, 30]},
        {"name": "mesh", "mesh": 0},
    ]
    return GltfFile(nodes, [[1], [3]])


def test_scales_and_turns_above_the_skeleton_count(tmp_path):
    turn = Rotation.from_quat(QUARTER_TURN)
    tilted = (turn * Rotation.from_euler("y", 90, degrees=True)).as_quat()
    curves = [(1, "rotation", [0, 1], [QUARTER_TURN, tilted])]
    motion = Motion.load(scaled_rig().animate(curves).save(tmp_path / "a.glb"), fps=1)
    assert motion.skeleton.names == ("hips", "between", "head")
    # Z of the armature is up; turning about Y of the hips, which is -X of the armature, lays the
    # spine to its +Y, which is -Z of the world.
    places = motion.positions()
    np.testing.assert_allclose(places[0], [[0, 0.9, 0], [0, 1.1, 0], [0, 1.4, 0]], atol=1e-6)
    np.testing.assert_allclose(places[1], [[0, 0.9, 0], [0, 0.9, -0.2], [0, 0.9, -0.5]], atol=1e-6)
    np.testing.assert_allclose(motion.skeleton.offsets[1:], [[0, 0.2, 0], [0, 0.3, 0]], atol=1e-6)
    assert not motion.joint_translations


def test_joints_that_move_keep_their_ways(tmp_path):
    places = [(1, 0, 0), (1, 0.5, 0)]
    file = GltfFile(arm().json["nodes"], [[0, 1]]).animate([(1, "translation", [0, 1], places)])
    motion = Motion.load(file.save(tmp_path / "a.glb"), fps=1)
    np.testing.assert_allclose(motion.joint_translations["hand"], places)
    np.testing.assert_allclose(motion.skeleton.offsets[1], [1, 0, 0])


def test_animated_scale_moves_what_hangs_below(tmp_path):
    curves = [(0, "scale", [0, 1], [(1, 1, 1), (2, 2, 2)])]
    path = GltfFile(arm().json["nodes"], [[0, 1]]).animate(curves).save(tmp_path / "a.glb")
    np.testing.assert_allclose(hand(path, fps=1), [[1, 1, 0], [2, 1, 0]], atol=1e-6)


def test_sparse_short_and_normalised_arrays(tmp_path):
    """Three turns as 16-bit numbers, the second of which is stored apart."""
    file = GltfFile(arm().json["nodes"], [[0, 1]])
    still = np.tile(np.array([0, 0, 0, 32767], "<i2"), (3, 1))
    turns = file.array(still, "<i2", normalized=True)
    file.json["accessors"][turns]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": file.view(np.array([1], "<u2").tobytes()), "componentType": 5123},
        "values": {
            "bufferView": file.view(np.rint(np.array(QUARTER_TURN) * 32767).astype("<i2").tobytes())
        },
    }
    path = file.animate([(0, "rotation", [0, 1, 2], turns)]).save(tmp_path / "a.glb")
    np.testing.assert_allclose(angle(path, fps=1), [0, 90, 0], atol=0.01)


def test_arrays_may_lie_in_the_text_or_beside_it(tmp_path):
    (tmp_path / "a.gltf").write_bytes(arm().gltf())
    (tmp_path / "b c.bin").write_bytes(arm().data)
    (tmp_path / "b.gltf").write_bytes(arm().gltf("b%20c.bin"))
    for name in ("a.gltf", "b.gltf"):
        np.testing.assert_allclose(angle(tmp_path / name, fps=1), [0, 90, 0], atol=1e-4)


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "{folder}/secret.bin", "link.bin", "http://a.b/secret.bin", "a\0b"]
)
def test_no_file_of_another_folder_is_opened(tmp_path, uri):
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret.bin").write_bytes(arm().data)
    (inside / "link.bin").symlink_to(tmp_path / "secret.bin")
    (inside / "a.gltf").write_bytes(arm().gltf(uri.format(folder=tmp_path)))
    with pytest.raises(FormatError, match=r"a\.gltf"):
        Motion.load(inside / "a.gltf")


def two_animations() -> GltfFile:
    file = arm().animate([(0, "rotation", [0, 3], [(0, 0, 0, 1), QUARTER_TURN])], name="wave")
    file.json["animations"][0]["name"] = "idle"
    file.json["animations"].append({"samplers": [], "channels": []})
    return file


def test_the_longest_animation_is_read_or_that_which_is_named(tmp_path):
    """The animation of 2 s has one curve of 2 s, that of 3 s one of 3 s and one of 1 s."""
    file = two_animations()
    turns = file.json["animations"][1]["samplers"]
    turns.append({"input": file.array([0, 1]), "output": turns[0]["output"]})
    file.json["animations"][1]["channels"].append(
        {"sampler": 1, "target": {"node": 1, "path": "rotation"}}
    )
    path = file.save(tmp_path / "a.glb")
    with pytest.warns(UserWarning, match=r"(?=.*idle)(?=.*wave)(?=.*\b3\b).*--animation"):
        assert Motion.load(path).info["animation"] == "wave"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("idle", "1"):
            assert Motion.load(path, animation=name).info["animation"] == "idle"
        del file.json["animations"][0]
        only = Motion.load(file.save(tmp_path / "b.glb"))
        assert (only.info["animation"], only.n_frames) == ("wave", 3 * 24 + 1)
    for name in ("run", "0", "4"):
        with pytest.raises(FormatError, match=f"(?=.*'{name}')(?=.*idle).*wave"):
            Motion.load(path, animation=name)


def test_without_a_skin_the_tree_of_animated_nodes_is_read(tmp_path):
    nodes = [
        {"name": "scene", "children": [1]},
        {"name": "root", "children": [2, 3]},
        {"name": "left", "children": [4]},
        {"name": "right"},
        {"name": "tip"},
        {"name": "face"},
    ]
    turns = [(0, 0, 0, 1), QUARTER_TURN]
    file = GltfFile(nodes).animate([(k, "rotation", [0, 1], turns) for k in (2, 3)])
    file.animate([(5, "weights", [0, 1], [0, 1])])
    file.json["animations"][0]["channels"].append({"sampler": 0, "target": {"path": "rotation"}})
    assert Motion.load(file.save(tmp_path / "a.glb")).skeleton.names == (
        "root",
        "left",
        "right",
        "tip",
    )


def test_a_body_that_faces_backwards_rests_forwards_and_stays_where_it_is(tmp_path, gesture):
    """VRM 0.x and others look along -Z: the world is kept, the rig at rest is turned."""
    motion = gesture(0.5)
    motion.save(tmp_path / "a.glb")
    content = (tmp_path / "a.glb").read_bytes()
    size = int.from_bytes(content[12:16], "little")
    found = json.loads(content[20 : 20 + size])
    found["nodes"].append({"rotation": [0, 1, 0, 0], "children": [0]})
    found["scenes"][0]["nodes"] = [len(found["nodes"]) - 1]
    found["buffers"][0]["uri"] = "a.bin"
    (tmp_path / "a.bin").write_bytes(content[28 + size :])
    (tmp_path / "b.gltf").write_text(json.dumps(found))
    turned = Motion.load(tmp_path / "b.gltf")
    np.testing.assert_allclose(turned.positions(), motion.positions() * [-1, 1, -1], atol=1e-5)
    np.testing.assert_allclose(turned.skeleton.offsets[1:], motion.skeleton.offsets[1:], atol=1e-6)
    facing = Motion.load(tmp_path / "b.gltf", forward="-z")
    np.testing.assert_allclose(facing.positions(), motion.positions(), atol=1e-5)


def test_compressed_files_are_refused_by_name(tmp_path):
    file = arm()
    file.json["bufferViews"][1]["extensions"] = {"EXT_meshopt_compression": {}}
    with pytest.raises(FormatError, match="(?=.*EXT_meshopt)(?=.*gltf-transform).*a.glb"):
        Motion.load(file.save(tmp_path / "a.glb"))
    file.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    del file.json["bufferViews"][1]["extensions"]
    np.testing.assert_allclose(angle(file.save(tmp_path / "b.glb"), fps=1), [0, 90, 0], atol=1e-4)
    file.json["extensionsRequired"] = ["KHR_texture_transform", "KHR_materials_unlit", "VRMC_vrm"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Motion.load(file.save(tmp_path / "b.glb"))
    file.json["extensionsRequired"] = ["KHR_xmp"]
    with pytest.warns(UserWarning, match="'KHR_xmp'"):
        Motion.load(file.save(tmp_path / "c.glb"))


def changed(key: str, value: object, *path: object):
    def change(file: GltfFile) -> None:
        place = file.json
        for part in path:
            place = place[part]
        place[key] = value

    return change


def change_all(*changes):
    return lambda file: [change(file) for change in changes]


def read_the_same_bytes_often(file: GltfFile) -> None:
    turns = file.array(np.tile(QUARTER_TURN, (100_000, 1)))
    file.json["animations"].clear()
    repeat(file, file.json["accessors"][turns])


def have_zeros_often(file: GltfFile) -> None:
    file.json["animations"].clear()
    repeat(file, {"type": "VEC4", "componentType": 5126, "count": 100_000})


def repeat(file: GltfFile, accessor: dict) -> None:
    first = len(file.json["accessors"])
    file.json["accessors"] += [accessor] * 40
    file.animate([(0, "rotation", [0, 1], first + k) for k in range(40)])


HOSTILE = {
    "frames": (changed("uri", None), r"(?=.*\b21600001\b).*--in-fps"),
    "nothing": (change_all(changed("skins", []), changed("animations", [])), "skeleton"),
    "zeros often": (have_zeros_often, "(?=.*rotation).*memory"),
    "same bytes": (read_the_same_bytes_often, "memory"),
    "cycle": (changed("children", [0], "nodes", 1), "tree"),
    "far away": (
        change_all(*(changed("translation", [9e5, 0, 0], "nodes", k) for k in (0, 1))),
        "1e",
    ),
    "not json": (changed("nodes", [3]), "nodes"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_refused_by_name(tmp_path, case):
    change, message = HOSTILE[case]
    file = arm(times=(0, 1, 9e5)) if case == "frames" else arm()
    change(file)
    path = file.save(tmp_path / "a.glb")
    with pytest.raises(FormatError, match=message) as error:
        Motion.load(path)
    assert str(error.value).startswith(f"{path}: ")


def test_deep_trees_are_counted_not_recursed_into(tmp_path):
    nodes = [{"children": [k + 1]} for k in range(15_000)] + [{}]
    with pytest.raises(FormatError, match="1000"):
        Motion.load(GltfFile(nodes, [[0]]).save(tmp_path / "a.glb"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_a_pipe_beside_the_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.bin")
    (tmp_path / "a.gltf").write_bytes(arm().gltf("a.bin"))
    with pytest.raises(FormatError, match="a.bin"):
        Motion.load(tmp_path / "a.gltf")


def head(size: int = 0, version: int = 2, kind: int = 0x4E4F534A, n_json: int | None = None):
    """Return the 20 bytes before the JSON part of a binary file, and the shortest JSON."""
    text = b'{"nodes":[{}],"skins":[{"joints":[0]}]}  '
    text += b" " * (-len(text) % 4)
    n_json = len(text) if n_json is None else n_json
    return struct.pack("<4s4I", b"glTF", version, size or 20 + len(text), n_json, kind) + text


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (head()[:19], r"a\.glb"),
        (head(version=1), r"(?=.*\b1\b).*\b2"),
        (head(size=65), "64 of 65"),
        (head() + struct.pack("<2I", 5, 0x004E4942) + b"1234", "4 of 5"),
    ],
)
def test_damaged_heads_of_binary_files_are_refused(tmp_path, content, says):
    assert len(head()) == 64
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(FormatError, match=says):
        Motion.load(tmp_path / "a.glb")
