"""Arrays, trees, curves and colours of glTF files, against numpy, scipy and the standard."""

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
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.scene import Curve, Nodes
from gesturekit.formats.gltf.vrm import avatar_facts, colours_of
from gesturekit.motion import Motion


def gltf(path: Path, **found: Any) -> Gltf:
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
        ("u1", 5121, [0, 51, 255], [0, 0.2, 1]),
        ("<i2", 5122, [-32768, 0, 32767], [-1, 0, 1]),
        ("<u2", 5123, [13107, 65535], [0.2, 1]),
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


def test_a_file_of_over_256_mebibytes_is_not_opened(tmp_path):
    with (tmp_path / "a.glb").open("wb") as file:
        file.write(b"glTF")
        file.truncate((256 << 20) + 1)
    with pytest.raises(FormatError, match=r"a\.glb.*256 MiB"):
        Gltf(tmp_path / "a.glb")


SPARSE = {
    "indices": {"bufferView": 0, "componentType": 5126},
    "values": {"bufferView": 0},
}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"type": "MAT3"}, "'MAT3'"),
        ({"type": "VEC3", "count": 1}, r"(?=.*\b3\b).*\b1$"),
        ({"count": -1}, "(?=.*count).*-1"),
        ({"count": 10**12}, r"(?=.*count).*\b1000000000000"),
        ({"byteOffset": 13}, r"(?=.*byteOffset)(?=.*\b13).*\b12"),
        ({"bufferView": 99}, r"(?=.*bufferViews).*\b99"),
        ({"sparse": SPARSE | {"count": 1}}, "indices"),
        ({"sparse": SPARSE | {"count": 10**9}}, r"(?=.*count).*\b1000000000"),
    ],
)
def test_damaged_accessors_are_named(tmp_path, changes, says):
    with pytest.raises(FormatError, match=says):
        numbers(tmp_path / "a.glb", [1, 2, 3], "<f4", 5126, **changes)


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
    assert tree.parents == [1, 3, -1, 2, 1, -1]
    place = [tree.order.index(node) for node in range(6)]
    assert all(parent < 0 or place[parent] < place[k] for k, parent in enumerate(tree.parents))
    nodes[4]["rotation"] = (np.array([0, 0, -1, 1]) / 2**0.5).tolist()
    for node, matrix in enumerate(tree.matrices()):
        expected = np.eye(4)
        while node >= 0:
            expected, node = rest(nodes[node]) @ expected, tree.parents[node]
        np.testing.assert_allclose(matrix, expected, atol=1e-9)
    assert set(tree.with_ancestors([4])) == {2, 3, 1, 4} and tree.with_ancestors([5]) == [5]


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


@pytest.mark.parametrize("version", [0, 1])
def test_who_made_an_avatar_and_under_which_licence(tmp_path, version):
    """Texts of any length and kind; the warnings of a file are those of its reading."""
    found, data = avatar_json(version)
    found["animations"] = [{"name": "a" * 900}]
    found["extensionsRequired"] = ["KHR_xmp"]
    one = {"title": "n" * 9000, "author": "me", "otherLicenseUrl": "http://a.b"}
    if version:
        one = {"name": "n" * 9000, "authors": ["me", 3, "you"], "licenseUrl": "http://a.b"}
    next(iter(found["extensions"].values()))["meta"] = one
    (tmp_path / "a.vrm").write_bytes(packed(found, data))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        facts = avatar_facts(tmp_path / "a.vrm")
    assert facts["name"].startswith("n" * 50) and len(facts["name"]) < 500
    assert facts["licence"] == "http://a.b" and len(facts["animations"][0]) < 200
    assert facts["authors"] == ("me, you" if version else "me")
    assert facts["vrm"] == ("1.0" if version else "0.x")


def colours(path: Path, material: dict, uv: list, image: bytes = b"") -> np.ndarray:
    file = arm()
    view = file.view(image or picture())
    file.json |= {"materials": [material], "textures": [{"source": 0}, {}],
                  "images": [{"bufferView": view, "mimeType": "image/png"}]}  # fmt: skip
    places, n_points = (None, 3) if uv is None else (np.array(uv, float), len(uv))
    return colours_of(Gltf(file.save(path)), {}, 0, places, n_points)


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
    with pytest.warns(UserWarning, match=r"a\.glb.*texture 0"):
        found = colours(path, material, uv, b"no picture")
    np.testing.assert_allclose(found[:, :3], [factor] * 4, atol=2e-4)
