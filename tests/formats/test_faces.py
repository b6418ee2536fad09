"""Faces in glTF and VRM animation files: those of others are read, ours hold all channels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avatars import avatar_json, packed
from gltf_files import QUARTER_TURN, GltfFile, arm

import gesturekit as gk
from gesturekit.errors import FormatError
from gesturekit.formats.gltf.faces import expressions_of
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.writing import animated_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model import Morph, Skin
from gesturekit.motion.face import smplx_face

TURNS = [(0, 0, 0, 1), QUARTER_TURN]


def with_morphs(*meshes: tuple[list[str], int]) -> GltfFile:
    """An arm, and a node with a mesh for each list of target names and number of targets."""
    file = arm()
    file.json["animations"].clear()
    file.json["meshes"] = []
    for names, count in meshes:
        file.json["nodes"].append({"name": "head", "mesh": len(file.json["meshes"])})
        primitive = {"attributes": {}, "targets": [{}] * count}
        file.json["meshes"].append({"primitives": [primitive], "extras": {"targetNames": names}})
    return file


def with_face(motion: Motion, names: tuple[str, ...], *rows: list[float], **more) -> Motion:
    """A motion whose face repeats rows of values."""
    values = [rows[k % len(rows)] for k in range(motion.n_frames)]
    return replace(motion, face=gk.FaceTrack(names, values, **more))


@pytest.mark.parametrize(
    ("how", "keys", "expected"),
    [
        # Keys at 0, 1 and 3 s; frames at every half second up to 2 s.
        ("LINEAR", [0, 0.2, 1, 0.4, 0, 0.8], [[0, 0.5, 1, 0.75, 0.5], [0.2, 0.3, 0.4, 0.5, 0.6]]),
        ("STEP", [0, 0.2, 1, 0.4, 0, 0.8], [[0, 0, 1, 1, 1], [0.2, 0.2, 0.4, 0.4, 0.4]]),
        # In-tangents, values and out-tangents of each key: flat ones ease, a slope of 1 is a line.
        (
            "CUBICSPLINE",
            [*(0, 0, 0, 0, 0, 0.5), *(0, 0.5, 1, 0.5, 0, 0), *(0, 0, 1, 0.5, 0, 0)],
            [[0, 0.5, 1, 1, 1], [0, 0.25, 0.5, 0.5, 0.5]],
        ),
    ],
)
def test_weights_of_any_interpolation_are_resampled_to_the_frames(tmp_path, how, keys, expected):
    file = with_morphs((["jawOpen", "mine"], 2))
    file.animate([(2, "weights", [0, 1, 3], keys)], how)
    weights = file.json["animations"].pop()
    file.animate([(0, "rotation", [0, 2], TURNS)])
    offset = len(file.json["animations"][0]["samplers"])
    file.json["animations"][0]["samplers"] += weights["samplers"]
    file.json["animations"][0]["channels"].append(weights["channels"][0] | {"sampler": offset})
    face = Motion.load(file.save(tmp_path / "a.glb"), fps=2).face
    assert (face.names, face.origin) == (("jawOpen", "mine"), "recorded")
    np.testing.assert_allclose(face.values.T, expected, atol=1e-6)


def test_four_channels_are_no_rotation_and_arkits_are_limited(tmp_path):
    file = with_morphs((["jawOpen", "b", "c", "d"], 4))
    curves = [(0, "rotation", [0, 1], TURNS), (2, "weights", [0, 1], [1.5, 2, -3, 0] * 2)]
    face = Motion.load(file.animate(curves).save(tmp_path / "a.glb"), fps=1).face
    assert face.values.tolist() == [[1, 2, -3, 0]] * 2


def test_of_meshes_with_one_name_the_first_is_read(tmp_path):
    file = with_morphs((["jawOpen", "smile"], 2), (["smile", "tongueOut"], 2))
    curves = [(0, "rotation", [0, 1], TURNS), (2, "weights", [0], [0.1, 0.2])]
    curves.append((3, "weights", [0], [0.3, 0.4]))
    face = Motion.load(file.animate(curves).save(tmp_path / "a.glb"), fps=1).face
    assert face.names == ("jawOpen", "smile", "tongueOut")
    np.testing.assert_allclose(face.values, [[0.1, 0.2, 0.4]] * 2)


def test_a_face_may_move_on_a_body_that_does_not_or_in_an_animation_of_its_own(tmp_path):
    file = with_morphs((["jawOpen"], 1)).animate([(2, "weights", [0, 1, 2], [0, 1, 0])])
    motion = Motion.load(file.save(tmp_path / "a.glb"), fps=1)
    assert motion.face.values[:, 0].tolist() == [0, 1, 0]
    file.animate([(0, "rotation", [0, 1], TURNS)])
    motion = Motion.load(file.save(tmp_path / "b.glb"), fps=1)
    assert motion.face.values[:, 0].tolist() == [0, 1]
    assert not np.allclose(motion.rotations[0], motion.rotations[1])


@pytest.mark.parametrize(
    ("names", "count", "says"),
    [([], 2, "2 .* 0 targetNames"), (["a"] * 2000, 2000, "2000 .* at most 1000")],
)
def test_targets_without_names_or_too_many_are_left_out(tmp_path, names, count, says):
    file = with_morphs((names, count))
    curves = [(0, "rotation", [0, 1], TURNS), (2, "weights", [0], [0.5] * count)]
    with pytest.warns(UserWarning, match=f"a.glb: {says}"):
        motion = Motion.load(file.animate(curves).save(tmp_path / "a.glb"), fps=1)
    assert motion.face is None and motion.n_frames == 2


HOSTILE = {
    "not finite": ([(2, "weights", [0, 1], [0, np.nan])], r"weights holds numbers"),
    "too few": ([(2, "weights", [0, 1], [0.5])], r"1 values of weights for 2 times"),
    "no mesh of this number": ([(4, "weights", [0, 1], [0, 1])], "index into meshes"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_weights_are_refused_in_one_line(tmp_path, case):
    curves, says = HOSTILE[case]
    file = with_morphs((["jawOpen"], 1))
    file.json["nodes"] += [{}, {"mesh": 99}]
    path = file.animate([(0, "rotation", [0, 1], TURNS), *curves]).save(tmp_path / "a.glb")
    with pytest.raises(FormatError, match=says) as error:
        Motion.load(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def test_small_files_with_one_mesh_at_many_nodes_do_not_take_minutes(tmp_path):
    file = with_morphs(([f"c{k}" for k in range(500)], 500))
    file.json["nodes"] += [{"mesh": 0}] * 15_000
    file.animate([(2, "weights", [0], [0.5] * 500), (0, "rotation", [0, 1], TURNS)])
    file.json["animations"][0]["channels"] += [
        {"sampler": 0, "target": {"node": node, "path": "weights"}} for node in range(3, 15_000)
    ]
    with pytest.raises(FormatError, match=r"a\.glb: names of its morph targets would take"):
        Motion.load(file.save(tmp_path / "a.glb"), fps=1)


def test_small_files_with_long_faces_do_not_fill_memory(tmp_path):
    """A thousand channels of two keys, 9 hours apart."""
    file = with_morphs(([f"c{k}" for k in range(1000)], 1000))
    curves = [(0, "rotation", [0, 32000], TURNS), (2, "weights", [0, 1], [0.5] * 2000)]
    with pytest.raises(FormatError, match=r"a\.glb: its face would take more memory"):
        Motion.load(file.animate(curves).save(tmp_path / "a.glb"), fps=1)


def json_of(path: Path) -> dict:
    return Gltf(path).json


@pytest.mark.parametrize("body", [None, "human"])
def test_a_figure_has_all_channels_by_name(gesture, tmp_path, body):
    names = ("jawOpen", "eyeBlinkLeft", "mine")
    rows = [0.25, 0, -2], [0.5, 1, 3]
    motion = with_face(gesture(1.0), names, *rows, origin="rules")
    motion.save(tmp_path / "a.glb", **({"body": body} if body else {}))
    again = Motion.load(tmp_path / "a.glb")
    assert (again.face.names, again.face.origin) == (names, "rules")
    np.testing.assert_allclose(again.face.values, motion.face.values)
    written = json_of(tmp_path / "a.glb")
    named = [mesh for mesh in written["meshes"] if "extras" in mesh]
    assert [mesh["extras"] for mesh in named] == [{"targetNames": list(names)}]
    assert all(len(each["targets"]) == 3 for each in named[0]["primitives"])
    views, accessors = written["bufferViews"], written["accessors"]
    for part in (part for mesh in written["meshes"] for part in mesh["primitives"]):
        if "indices" in part:  # numbers of WebGL's kinds of arrays
            used = [*part["attributes"].values(), part["indices"]]
            kinds = [views[accessors[k]["bufferView"]].get("target") for k in used]
            assert {*kinds[:-1]} == {34962} and kinds[-1] == 34963
    assert len(written["scenes"][0]["nodes"]) == len(written["meshes"]) + 1
    assert written["animations"][0]["extras"]["face"] == "rules"
    with_face(gesture(1.0), names, *rows).save(tmp_path / "b.glb")
    assert "face" not in json_of(tmp_path / "b.glb")["animations"][0]["extras"]


def test_morphs_of_a_skin_become_targets(gesture, tmp_path):
    """A strip of eight vertices in two regions: of one vertex, of all, and of none."""
    motion = with_face(gesture(0.1), ("jawOpen", "cheekPuff", "tongueOut"), [1, 0, 0])
    vertices = np.array([[k // 2, k % 2, 0] for k in range(8)], float)
    faces = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]], np.uint32)
    weights = np.tile(np.array([255, 0, 0, 0], np.uint8), (8, 1))
    skin = Skin(vertices, faces, 0 * weights, weights, vertices[:1], np.repeat([0, 1], 4))
    moved = np.arange(24).reshape(8, 3) + 1.0
    morphs = {
        "jawOpen": Morph(np.array([6]), np.array([[0, -3.0, 0]])),
        "cheekPuff": Morph(np.arange(8)[::-1], moved[::-1]),
    }
    colours = {"a": (0, 0, 0), "b": (9, 9, 9)}
    content = animated_skeleton(motion, "x", replace(skin, morphs=morphs), colours, 0.5)
    (tmp_path / "a.glb").write_bytes(content)
    gltf = Gltf(tmp_path / "a.glb")
    (mesh,) = gltf.json["meshes"]
    targets = [
        [gltf.array(target["POSITION"], "POSITION", 3).tolist() for target in each["targets"]]
        for each in mesh["primitives"]
    ]
    zero = [[0, 0, 0]] * 4
    assert targets[0] == [zero, (0.5 * moved[:4]).tolist(), zero]
    assert targets[1] == [[*zero[:2], [0, -1.5, 0], zero[0]], (0.5 * moved[4:]).tolist(), zero]
    full = gltf.json["accessors"][mesh["primitives"][1]["targets"][1]["POSITION"]]
    assert "sparse" not in full  # as indices would take more
    one = gltf.json["accessors"][mesh["primitives"][1]["targets"][0]["POSITION"]]
    assert one["sparse"]["count"] == 1 and (one["min"], one["max"]) == ([0, -1.5, 0], [0, 0, 0])
    assert Motion.load(tmp_path / "a.glb").face.values.tolist() == [[1, 0, 0]] * 3


def test_an_avatars_own_targets_are_animated(gesture, tmp_path):
    """Targets that are not channels keep the weights of the avatar's mesh."""
    content, data = avatar_json(1)
    (mesh,) = content["meshes"]
    mesh["primitives"][0]["targets"] = [{"POSITION": 0}] * 3
    mesh |= {"extras": {"targetNames": ["fat", "jawOpen", "cry"]}, "weights": [0.75, 0, 0]}
    (tmp_path / "me.vrm").write_bytes(packed(content, data))
    motion = with_face(gesture(0.5), ("jawOpen", "eyeBlinkLeft"), [0.25, 1], [0.5, 1])
    motion.save(tmp_path / "a.glb", body=str(tmp_path / "me.vrm"))
    face = Motion.load(tmp_path / "a.glb").face
    assert face.names == ("fat", "jawOpen", "cry")
    assert face.values[:2].tolist() == [[0.75, 0.25, 0], [0.75, 0.5, 0]]
    other = with_face(gesture(0.5), ("tongueOut",), [0.25])
    other.save(tmp_path / "b.glb", body=str(tmp_path / "me.vrm"))
    face = Motion.load(tmp_path / "b.glb").face
    assert face.names == ("tongueOut",) and face.values[0].tolist() == [0.25]


@pytest.mark.parametrize(
    ("channels", "expected"),
    [
        ({"jawOpen": 0.8}, {"aa": 0.8}),
        ({"jawOpen": 0.8, "mouthClose": 0.6}, {"aa": 0.2}),
        ({"jawOpen": 0.5, "mouthFunnel": 0.6}, {"aa": 0.2, "oh": 0.6}),
        ({"jawOpen": 0.5, "mouthStretchLeft": 0.4, "mouthStretchRight": 0.8},
         {"aa": 0.2, "ih": 0.3, "ee": 0.3}),
        ({"mouthPucker": 1, "mouthFunnel": 1}, {"ou": 0.5, "oh": 0.5}),
        ({"eyeBlinkRight": 0.3}, {"blinkRight": 0.3}),
        ({"jawOpen": 1, "aa": 0.4}, {"aa": 0.4}),
        ({"lookUp": 1, "happy": 2, "mine": -1}, {"happy": 1}),
    ],
)  # fmt: skip
def test_vowels_and_blinks_of_arkits_channels(channels, expected):
    face = gk.FaceTrack(tuple(channels), [list(channels.values())])
    found = {name: float(values[0]) for name, values in expressions_of(face).items()}
    shown = {name: found[name] for name in found.keys() - channels.keys() | expected.keys()}
    assert {name: value for name, value in shown.items() if value} == pytest.approx(expected)
    assert "lookUp" not in found and found.get("mine", 0) == 0
    assert expressions_of(smplx_face(np.ones((1, 10)))) == {}


def test_a_vrm_animation_has_expressions_as_specified(gesture, tmp_path):
    names = ("jawOpen", "eyeBlinkLeft", "happy")
    motion = with_face(gesture(1.0), names, [0.5, 1, 0.1], [1, 0, 0.1], origin="rules")
    motion.save(tmp_path / "a.vrma")
    gltf = Gltf(tmp_path / "a.vrma")
    expressions = gltf.json["extensions"]["VRMC_vrm_animation"]["expressions"]
    assert expressions["preset"].keys() == {*("aa", "ih", "ou", "ee", "oh"), "blinkLeft", "happy"}
    assert expressions["custom"].keys() == {"jawOpen", "eyeBlinkLeft"}
    (animation,) = gltf.json["animations"]
    outputs = {
        channel["target"]["node"]: animation["samplers"][channel["sampler"]]["output"]
        for channel in animation["channels"]
        if channel["target"]["path"] == "translation"
    }
    blink = gltf.array(outputs[expressions["preset"]["blinkLeft"]["node"]], "x", 3)
    assert blink[:3].tolist() == [[1, 0, 0], [0, 0, 0], [1, 0, 0]]
    again = Motion.load(tmp_path / "a.vrma")
    assert again.face.origin == "rules" and again.skeleton.n_joints == 52
    np.testing.assert_allclose(
        np.stack([again.face.channel(name) for name in names], 1), motion.face.values, atol=1e-7
    )
    assert set(again.face.names) == set(names)  # and no presets that were made of these


def test_a_face_that_the_file_holds_is_not_said_to_be_lost(gesture, tmp_path, gesturekit):
    with_face(gesture(0.1), ("jawOpen",), [0.5]).save(tmp_path / "a.npz")
    for name in ("a.vrma", "a.glb"):
        done = gesturekit("convert", tmp_path / "a.npz", tmp_path / name).ok()
        assert "holds no" not in done.err


def test_expressions_of_other_programs_are_no_joints(tmp_path):
    """Beside the hips, one of them above a root that holds all."""
    nodes = [
        {"name": "root", "children": [1, 3, 4]},
        {"name": "hips", "children": [2], "translation": [0, 1, 0]},
        {"name": "head", "translation": [0, 0.5, 0]},
        {"name": "preset_aa"},
        {"name": "custom_sneer"},
    ]
    x = [(0.5, 7, 7), (1, 7, 7)]
    file = GltfFile(nodes).animate(
        [
            (1, "rotation", [0, 1], TURNS),
            (3, "translation", [0, 1], x),
            (4, "translation", [0, 1], x),
        ]
    )
    preset, custom = {"aa": {"node": 3}}, {"Sneer": {"node": 4}}
    extension = {"expressions": {"preset": preset, "custom": custom}}
    file.json["extensions"] = {"VRMC_vrm_animation": extension}
    motion = Motion.load(file.save(tmp_path / "a.vrma"), fps=1)
    assert motion.skeleton.names == ("hips", "head")
    assert motion.face.names == ("aa", "Sneer")
    assert motion.face.values.tolist() == [[0.5, 0.5], [1, 1]]
    extension["expressions"]["custom"] = {"Sneer": {"node": 99}}
    with pytest.raises(FormatError, match=r"a\.vrma: node of 'Sneer' is 99"):
        Motion.load(file.save(tmp_path / "a.vrma"))
