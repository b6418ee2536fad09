"""Arrays, trees, curves and colours of glTF files, against numpy, scipy and the standard."""

from __future__ import annotations

import json
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from avatars import avatar_json, packed, picture
from gltf_files import GltfFile, arm
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from gesturekit.errors import FormatError
from gesturekit.formats.gltf.animation import Curve, read_animation
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.materials import Colours, is_seen, reduce_colours
from gesturekit.formats.gltf.nodes import Nodes
from gesturekit.formats.gltf.vrm import avatar_facts
from gesturekit.motion import Motion


def gltf(path: Path, **found: Any) -> Gltf:
    """Return a file of these JSON values, without arrays."""
    text = json.dumps({"asset": {"version": "2.0"}, "nodes": [{}], **found}).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s4I", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A)
    path.write_bytes(head + text)
    return Gltf(path)


def numbers(path: Path, values: list, dtype: str, component: int, **more: Any) -> np.ndarray:
    """Return values as the reader gives them."""
    file = arm()
    view = file.view(np.array(values, dtype).tobytes())
    accessor = {"bufferView": view, "type": "SCALAR", "componentType": component}
    file.json["accessors"].append(accessor | {"count": len(values)} | more)
    index = len(file.json["accessors"]) - 1
    return Gltf(file.save(path)).array(index, "numbers", 1)[:, 0]


@pytest.mark.parametrize(
    ("dtype", "component", "values", "shares"),
    [
        ("i1", 5120, [-128, -127, 0, 127], [-1, -1, 0, 1]),
        ("u1", 5121, [0, 51, 255], [0, 0.2, 1]),
        ("<i2", 5122, [-32768, 0, 32767], [-1, 0, 1]),
        ("<u2", 5123, [13107, 65535], [0.2, 1]),
        ("<u4", 5125, [0, 2**32 - 1], [0, 1]),
        ("<f4", 5126, [0.5, -2.0], [0.5, -2.0]),
    ],
)
def test_normalised_whole_numbers_are_shares_of_the_greatest(
    tmp_path, dtype, component, values, shares
):
    plain = numbers(tmp_path / "a.glb", values, dtype, component)
    assert plain.tolist() == values and plain.dtype == np.dtype(dtype)
    found = numbers(tmp_path / "a.glb", values, dtype, component, normalized=True)
    np.testing.assert_allclose(found, shares, atol=1e-9)
    assert numbers(tmp_path / "a.glb", values, dtype, component, normalized=1).tolist() == values


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "cli copy a.gltf out.glb"),
        ([{"asset": {"version": "2.0"}}], "its JSON part is not an object"),
        ({"nodes": 4_000_001 * [0]}, "its JSON part has over 4000000 values"),
    ],
)
def test_files_that_cannot_be_read_at_all_say_why(tmp_path, content, says):
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    with pytest.raises(FormatError, match=rf"a\.gltf: .*{says}"):
        Gltf(tmp_path / "a.gltf")


def test_a_file_of_over_256_mebibytes_is_not_opened(tmp_path):
    with (tmp_path / "a.glb").open("wb") as file:
        file.write(b"glTF")
        file.truncate((256 << 20) + 1)
    with pytest.raises(FormatError, match=r"a\.glb: 256 MiB; files of up to 256 are read"):
        Gltf(tmp_path / "a.glb")


def test_numbers_up_to_a_million_are_read(tmp_path):
    for value in (1e6, -1e6):
        assert numbers(tmp_path / "a.glb", [value], "<f4", 5126).tolist() == [value]
    for value in (1.001e6, -1.001e6, np.nan, np.inf):
        with pytest.raises(FormatError, match="not finite, or over 1e"):
            numbers(tmp_path / "a.glb", [value], "<f4", 5126)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"type": "MAT3"}, "of type 'MAT3'"),
        ({"type": 3}, "of type '3'"),
        ({"type": "VEC3", "count": 1}, "has 3 numbers an element; expected 1"),
        ({"componentType": 5124}, "components of type '5124'"),
        ({"componentType": True}, "components of type 'True'"),
        ({"count": -1}, "count of numbers is -1; expected 0 to 3"),
        ({"count": True}, "count of numbers is True"),
        ({"byteOffset": 13}, "byteOffset of numbers is 13; expected 0 to 12"),
        ({"byteOffset": 8, "count": 2}, "count of numbers is 2; expected 0 to 1"),
        ({"bufferView": 99}, "index into bufferViews is 99"),
        ({"sparse": {"count": 1, "indices": {"bufferView": 0, "componentType": 5126},
                     "values": {"bufferView": 0}}}, "indices of numbers are beyond"),
        ({"sparse": 3}, "sparse is not an object"),
    ],
)  # fmt: skip
def test_damaged_accessors_are_named(tmp_path, changes, says):
    with pytest.raises(FormatError, match=says):
        numbers(tmp_path / "a.glb", [1, 2, 3], "<f4", 5126, **changes)


@pytest.mark.parametrize(("stride", "is_right"), [(4, True), (252, True), (3, False), (256, False)])
def test_elements_are_a_stride_apart(tmp_path, stride, is_right):
    file = arm()
    data = np.zeros(600, np.uint8)
    data[:4].view("<f4")[:], data[stride : stride + 4] = 1.5, np.array([2.5], "<f4").view("u1")
    view = file.view(data.tobytes())
    file.json["bufferViews"][view]["byteStride"] = stride
    file.json["accessors"] = [
        {"bufferView": view, "type": "SCALAR", "componentType": 5126, "count": 2}
    ]
    found = Gltf(file.save(tmp_path / "a.glb"))
    if is_right:
        assert found.array(0, "x", 1)[1, 0] == 2.5
    else:
        with pytest.raises(FormatError, match=f"byteStride of {stride}"):
            found.array(0, "x", 1)


def test_zeros_with_few_values_may_take_32_mebibytes(tmp_path):
    """An accessor without a buffer view is of zeros; the file itself has 12 bytes of arrays."""
    file = GltfFile([{}])
    places, values = (
        file.view(np.array([k], dtype).tobytes()) for k, dtype in ((2, "u1"), (7, "<f4"))
    )
    sparse = {"count": 1, "indices": {"bufferView": places, "componentType": 5121},
              "values": {"bufferView": values}}  # fmt: skip
    zeros = {"type": "VEC4", "componentType": 5126}
    few = {"type": "SCALAR", "componentType": 5126, "count": 4, "sparse": sparse}
    file.json["accessors"] = [few, zeros | {"count": 2_097_152}]
    path = file.save(tmp_path / "a.glb")
    assert Gltf(path).array(0, "x", 1)[:, 0].tolist() == [0, 0, 7, 0]
    assert Gltf(path).array(1, "x", 4).shape == (2_097_152, 4)
    empty = gltf(tmp_path / "b.glb", accessors=[zeros | {"count": 2_099_000}])
    with pytest.raises(FormatError, match="x would take more memory or time than a file of 0 KiB"):
        empty.array(0, "x", 4)
    few["count"] = 2
    with pytest.raises(FormatError, match="indices of x are beyond its 2 elements"):
        Gltf(file.save(path)).array(0, "x", 1)


def test_values_of_the_json_part_are_checked(tmp_path):
    found = gltf(tmp_path / "a.glb", many=[0] * 20_000, more=[0] * 20_001, odd=[3], one={"v": 2})
    assert len(found.values(found.json, "many")) == 20_000 and found.values(found.json, "x") == []
    for call, says in (
        (lambda: found.values(found.json, "more"), "more is not a list of at most 20000"),
        (lambda: found.values(found.json, "one"), "one is not a list"),
        (lambda: found.items("odd"), "odd holds something that is not an object"),
        (lambda: found.object(found.json, "odd"), "odd is not an object"),
        (lambda: found.item("nodes", 1), "index into nodes is 1; expected 0 to 0"),
        (lambda: found.item("nodes", -1), "index into nodes is -1"),
        (lambda: found.item("nodes", None), "index into nodes is None"),
        (lambda: found.numbers({"s": [1, 2]}, "s", [1.0] * 3), "expected 3 numbers up to 1e"),
        (lambda: found.numbers({"s": [True]}, "s", [1.0]), "s is"),
        (lambda: found.numbers({"s": [1.1e6]}, "s", [1.0]), "s is"),
        (lambda: found.numbers({"s": "ab"}, "s", [1.0, 2.0]), "s is ab"),
        (lambda: found.resource(3), "the uri '3' is not text"),
        (lambda: found.resource("data:text/plain,abc"), "is not base64"),
        (lambda: found.resource("data:;base64,a"), "is not base64"),
    ):
        with pytest.raises(FormatError, match=says) as error:
            call()
        assert str(error.value).startswith(f"{tmp_path / 'a.glb'}: ")
    assert found.numbers({"s": [1e6, -1e6]}, "s", [0.0] * 2).tolist() == [1e6, -1e6]
    assert found.numbers({}, "s", [3.0]).tolist() == [3.0]
    assert found.resource("data:;base64,YWI=") == b"ab"


@pytest.mark.parametrize("version", ["2.0", "2.1"])
def test_versions_of_the_standard_from_two_on_are_read(tmp_path, version):
    assert gltf(tmp_path / "a.glb", asset={"version": version}).json["asset"]
    for other in ("1.0", 3, "20"):
        with pytest.raises(FormatError, match=f"glTF version {other}; expected 2.0"):
            gltf(tmp_path / "a.glb", asset={"version": other})


def rest(node: dict) -> np.ndarray:
    """Return the matrix (4, 4) of a node, as the standard composes it."""
    if "matrix" in node:
        return np.array(node["matrix"]).reshape(4, 4).T
    matrix = np.eye(4)
    turn = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    matrix[:3, :3] = turn * node.get("scale", [1, 1, 1])
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def test_nodes_stand_where_the_matrices_put_them(tmp_path):
    """Children before parents, a turned and mirrored matrix, and uneven scales at the ends."""
    mirrored = np.diag([-2.0, 3.0, 1.0, 1.0])
    mirrored[:3, :3] = Rotation.from_euler("xyz", [0.3, 0.5, -1]).as_matrix() @ mirrored[:3, :3]
    mirrored[:3, 3] = [4, 5, 6]
    nodes = [
        {"translation": [1, 2, 3], "scale": [2, 3, 4]},
        {"rotation": [0.36, 0.48, 0, 0.8], "translation": [0, 1, 0], "children": [0, 4]},
        {"scale": [2, 2, 2], "translation": [1, 0, 0], "children": [3]},
        {"matrix": mirrored.T.ravel().tolist(), "children": [1]},
        {"rotation": [0, 0, -1, 1]},
        {"translation": [7, 0, 0]},
    ]
    tree = Nodes(gltf(tmp_path / "a.glb", nodes=nodes))
    assert tree.parents == [1, 3, -1, 2, 1, -1] and tree.depth == [3, 2, 0, 1, 3, 0]
    assert tree.order == [2, 3, 1, 0, 4, 5]
    nodes[4]["rotation"] = (np.array([0, 0, -1, 1]) / 2**0.5).tolist()
    for node, matrix in enumerate(tree.matrices()):
        expected = np.eye(4)
        while node >= 0:
            expected, node = rest(nodes[node]) @ expected, tree.parents[node]
        np.testing.assert_allclose(matrix, expected, atol=1e-9)
    assert tree.with_ancestors([4]) == [2, 3, 1, 4] and tree.with_ancestors([5]) == [5]


def test_a_flat_matrix_has_a_scale_of_zero(tmp_path):
    flat = [1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    tree = Nodes(gltf(tmp_path / "a.glb", nodes=[{"matrix": flat}]))
    assert np.isfinite(tree.matrices()).all() and tree.rest["scale"].tolist() == [[1, 0, 1]]


@pytest.mark.parametrize(
    ("nodes", "says"),
    [
        ([{"children": [1]}, {"children": [1]}], "node 1 has two parents"),
        ([{"children": [2]}, {"children": [2]}, {}], "node 2 has two parents"),
        ([{"children": [1]}, {"children": [0]}], "its nodes form no tree"),
        ([{"children": [5]}], "children is 5; expected 0 to 0"),
    ],
)
def test_nodes_that_form_no_tree_are_refused(tmp_path, nodes, says):
    with pytest.raises(FormatError, match=says):
        Nodes(gltf(tmp_path / "a.glb", nodes=nodes))


def test_a_thousand_nodes_may_be_above_another(tmp_path):
    for count in (1000, 1001):
        chain = [{"children": [k + 1]} for k in range(count)] + [{}]
        found = gltf(tmp_path / "a.glb", nodes=chain)
        if count == 1000:
            assert max(Nodes(found).depth) == 1000
        else:
            with pytest.raises(FormatError, match="over 1000 nodes"):
                Nodes(found)


def test_a_skin_may_leave_out_joints_of_its_skeleton(tmp_path):
    """Programs leave out those that no vertex follows, here an elbow that holds a camera."""
    nodes = [
        {"name": "shoulder", "children": [1]},
        {"name": "elbow", "translation": [0, 0.3, 0], "children": [2], "camera": 0},
        {"name": "wrist", "translation": [0, 0.2, 0], "children": [3]},
        {"name": "hand", "translation": [0, 0.1, 0]},
    ]
    turns = [(0, 0, 0, 1), (0, 0, 1, 0)]
    file = GltfFile(nodes, [[0, 2, 3]]).animate([(0, "rotation", [0, 1], turns)])
    found = Motion.load(file.save(tmp_path / "a.glb"))
    assert found.skeleton.names == ("shoulder", "elbow", "wrist", "hand")
    assert found.skeleton.parents == (-1, 0, 1, 2)


def test_long_animations_are_computed_in_blocks(tmp_path):
    """Two nodes in 70 000 frames: the root turns a quarter a second and goes along Z."""
    tree = Nodes(gltf(tmp_path / "a.glb", nodes=[{"children": [1]}, {"translation": [2, 0, 0]}]))
    way = Curve(np.array([0.0, 700.0]), np.array([[0.0, 0, 0], [0, 0, 700.0]]), "LINEAR")
    seconds = np.arange(701.0)
    turns = Rotation.from_euler("y", seconds[:, None] * np.pi / 2).as_quat()
    curves = {(0, "translation"): way, (0, "rotation"): Curve(seconds, turns, "LINEAR")}
    times = np.arange(70_000) / 100
    places, found = tree.world([1, 0], curves, times)
    angle = times * np.pi / 2
    np.testing.assert_allclose(
        places[:, 0],
        np.stack([2 * np.cos(angle), 0 * angle, times - 2 * np.sin(angle)], 1),
        atol=1e-6,
    )
    np.testing.assert_allclose(places[:, 1, 2], times, atol=1e-9)
    assert found.shape == (70_000, 2, 4)


TIMES = np.array([0.5, 1.0, 2.5, 3.0])
BETWEEN = np.array([-1.0, 0.5, 0.6, 1.0, 1.7, 2.4, 2.5, 2.9, 3.0, 9.0])


def test_splines_are_those_of_hermite():
    rng = np.random.default_rng(0)
    values, before, after = rng.normal(size=(3, 4, 3))
    found = Curve(TIMES, np.stack([before, values, after], 1), "CUBICSPLINE").at(BETWEEN)
    inside = np.clip(BETWEEN, 0.5, 3.0)
    for k in range(3):
        own = CubicHermiteSpline(TIMES[k : k + 2], values[k : k + 2], [after[k], before[k + 1]])
        chosen = (inside >= TIMES[k]) & (inside <= TIMES[k + 1])
        np.testing.assert_allclose(found[chosen], own(inside[chosen]), atol=1e-9)
    turns = np.concatenate([values, rng.normal(size=(4, 1))], axis=1)
    flat = np.zeros((4, 4))
    found = Curve(TIMES, np.stack([flat, turns, flat], 1), "CUBICSPLINE").at(BETWEEN)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)


def test_lines_turn_and_move_evenly_and_steps_hold():
    rng = np.random.default_rng(1)
    places, turns = rng.normal(size=(4, 3)), Rotation.random(4, random_state=2)
    line = Curve(TIMES, places, "LINEAR").at(BETWEEN)
    expected = np.stack([np.interp(BETWEEN, TIMES, axis) for axis in places.T], axis=1)
    np.testing.assert_allclose(line, expected, atol=1e-12)
    found = Rotation.from_quat(Curve(TIMES, turns.as_quat(), "LINEAR").at(BETWEEN))
    expected = Slerp(TIMES, turns)(np.clip(BETWEEN, 0.5, 3.0))
    np.testing.assert_allclose((found.inv() * expected).magnitude(), 0, atol=1e-6)
    # A key that was rounded to float32 is at the frame that it was made for.
    near = np.array([0.99995, 0.998, 2.50005])
    held = Curve(TIMES, places, "STEP").at(np.concatenate([BETWEEN, near]))
    keys = [0, 0, 0, 1, 1, 1, 2, 2, 3, 3, 1, 0, 2]
    np.testing.assert_array_equal(held, places[keys])
    alone = Curve(TIMES[:1], places[:1], "LINEAR").at(BETWEEN)
    np.testing.assert_array_equal(alone, np.tile(places[0], (10, 1)))


@pytest.mark.parametrize(
    ("extras", "fps"),
    [({"fps": 29.97}, 29.97), ({"fps": 60}, 60), ({"fps": 7.3}, 30), ({"fps": True}, 30),
     ({"fps": "60"}, 30), ({}, 30)],
)  # fmt: skip
def test_the_rate_that_a_file_declares_counts_if_its_keys_are_at_frames(tmp_path, extras, fps):
    times = np.arange(4) / (29.97 if fps == 29.97 else 30)
    nodes = arm().json["nodes"]
    file = GltfFile(nodes).animate([(0, "rotation", times, [(0, 0, 0, 1)] * 4)])
    file.json["animations"][0]["extras"] = extras
    assert Motion.load(file.save(tmp_path / "a.glb")).fps == pytest.approx(fps)


def test_the_rate_that_a_file_declares_is_one_that_a_motion_can_have(tmp_path):
    """A single key is at a frame of any rate."""
    file = GltfFile(arm().json["nodes"]).animate([(0, "rotation", [0], [(0, 0, 0, 1)])])
    for declared, fps in ((1e-5, 1e-5), (1e5, 1e5), (9e-6, 30), (1.1e5, 30), (0, 30)):
        file.json["animations"][0]["extras"] = {"fps": declared}
        assert Motion.load(file.save(tmp_path / "a.glb")).fps == fps


def test_curves_of_other_nodes_and_properties_are_passed_over(tmp_path):
    still = [(0, 0, 0, 1)] * 2
    file = arm().animate([(0, "rotation", [0, 9], still), (1, "rotation", [0, 3], still)])
    file.json["animations"][1]["channels"][:0] = [
        {"sampler": 0, "target": {"path": "rotation"}},
        {"sampler": 0, "target": {"node": 1, "path": "weights"}},
        {"sampler": 0, "target": {"node": 1, "path": 3}},
    ]
    found = read_animation(Gltf(file.save(tmp_path / "a.glb")), {1}, "2")
    assert list(found.curves) == [(1, "rotation")] and found.curves[1, "rotation"].times[-1] == 3.0


def test_animations_without_names_are_numbered(tmp_path):
    file = arm().animate([(0, "rotation", [0, 1], [(0, 0, 0, 1)] * 2)], name="wave")
    facts = avatar_facts(file.save(tmp_path / "a.glb"))
    assert (facts["animations"], facts["meshes"], facts["vrm"]) == (["1", "wave"], 0, None)
    assert facts["humanoid"] == 0


@pytest.mark.parametrize("version", [0, 1])
def test_who_made_an_avatar_and_under_which_licence(tmp_path, version):
    """Texts of any length and kind; the warnings of a file are those of its reading."""
    found, data = avatar_json(version)
    found["animations"] = [{"name": "a" * 61}]
    found["extensionsRequired"] = ["KHR_xmp"]
    one = {"title": "n" * 201, "author": "me", "otherLicenseUrl": "http://a.b"}
    if version:
        one = {"name": "n" * 201, "authors": ["me", 3, "you"], "licenseUrl": "http://a.b"}
    next(iter(found["extensions"].values()))["meta"] = one
    (tmp_path / "a.vrm").write_bytes(packed(found, data))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        facts = avatar_facts(tmp_path / "a.vrm")
    assert facts["name"] == "n" * 200 and facts["licence"] == "http://a.b"
    assert facts["authors"] == ("me, you" if version else "me")
    assert facts["vrm"] == ("1.0" if version else "0.x") and facts["animations"] == ["a" * 60]


def colours(path: Path, material: dict, uv: list, image: bytes = b"") -> np.ndarray:
    """Return the colours of points of a material whose texture is an image."""
    file = arm()
    view = file.view(image or picture())
    file.json |= {"materials": [material], "textures": [{"source": 0}, {}],
                  "images": [{"bufferView": view, "mimeType": "image/png"}]}  # fmt: skip
    found = Colours(Gltf(file.save(path)))
    return found.at(0, None if uv is None else np.array(uv, float), 3 if uv is None else len(uv))


def test_colours_are_srgb_of_the_base_colour_times_the_texture(tmp_path):
    """Left (200, 30, 30) and opaque, right (30, 200, 30) and transparent; 0.214 is 0.5 of sRGB."""
    path = tmp_path / "a.glb"
    surface = {"baseColorFactor": [0.2140, 1.0, 0.002, 0.8], "baseColorTexture": {"index": 0}}
    material = {"pbrMetallicRoughness": surface}
    uv = [[0.1, 0.9], [0.6, 0.1], [1.1, -0.3], [1.0, 1.0]]
    red, green = np.array([200, 30, 30]) / 255, np.array([30, 200, 30]) / 255
    factor = np.array([0.5, 1.0, 0.02584])
    found = colours(path, material, uv)
    expected = [red * factor, green * factor, red * factor, red * factor]
    np.testing.assert_allclose(found[:, :3], expected, atol=2e-4)
    assert (found[:, 3] == 1).all(), "opaque, whatever the texture says"
    found = colours(path, material | {"alphaMode": "MASK"}, uv)
    np.testing.assert_allclose(found[:, 3], [0.8, 0, 0.8, 0.8], atol=1e-6)
    np.testing.assert_allclose(colours(path, material, None)[:, :3], [factor] * 3, atol=2e-4)
    for texture in ({"index": 1}, {}):
        plain = {"pbrMetallicRoughness": surface | {"baseColorTexture": texture}}
        np.testing.assert_allclose(colours(path, plain, uv)[:, :3], [factor] * 4, atol=2e-4)
    bright = {"pbrMetallicRoughness": {"baseColorFactor": [5, -1, 0.0031, 1]}}
    np.testing.assert_allclose(colours(path, bright, uv)[0], [1, 0, 12.92 * 0.0031, 1], atol=1e-6)
    dark = {"pbrMetallicRoughness": {"baseColorFactor": [0.005, 0, 0, 1]}}
    np.testing.assert_allclose(colours(path, dark, uv)[0], [0.0610, 0, 0, 1], atol=1e-4)
    np.testing.assert_array_equal(Colours(Gltf(path)).at(None, None, 2), [[0.8, 0.8, 0.8, 1]] * 2)
    with pytest.warns(UserWarning, match=r"a\.glb: texture 0 cannot be read .*base colour"):
        found = colours(path, material, uv, b"no picture")
    np.testing.assert_allclose(found[:, :3], [factor] * 4, atol=2e-4)


def test_faces_are_seen_from_half_on():
    assert is_seen(np.array([[0.5, 0.5, 0.5], [1, 0, 0.49], [1, 1, 0]])).tolist() == [
        True,
        False,
        True,
    ]


def test_many_colours_are_reduced_to_near_ones():
    few = np.array([[0, 0, 0], [1, 0.5, 0], [0, 0, 0], [2, -1, 0.0019]])
    palette, regions = reduce_colours(few)
    assert palette[regions].tolist() == [[0, 0, 0], [255, 128, 0], [0, 0, 0], [255, 0, 0]]
    assert len(palette) == 3 and regions.dtype == np.uint8
    shades = np.stack(np.meshgrid(*[np.linspace(0, 1, 6)] * 3), -1).reshape(-1, 3)  # 216
    palette, regions = reduce_colours(shades)
    assert len(palette) == 128 and regions.max() < 128
    assert np.abs(palette[regions] / 255 - shades).max() < 0.25
    exact, _ = reduce_colours(shades[:128])
    assert len(exact) == 128 and np.isin(np.rint(shades[:128] * 255), exact).all()
