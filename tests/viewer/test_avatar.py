"""A user's VRM avatar with motion of other rigs, and damaged avatar files."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from avatars import BONES, HAIR, avatar, avatar_json, packed, picture
from pages import bundled, opened
from PIL import Image

from gesturekit.errors import FormatError
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.materials import reduce_colours
from gesturekit.formats.gltf.skin import Skin
from gesturekit.formats.gltf.vrm import avatar_facts, read_avatar
from gesturekit.motion.parts.body_size import body_height
from gesturekit.viewer import write_picture, write_video
from gesturekit.viewer.avatars import load_avatar, simplified
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.video.mesh import SkinnedBody


def test_bones_without_a_counterpart_are_passed_over_and_thumbs_are_counted(tmp_path):
    """VRM 1.0 begins the thumb with the metacarpal, 0.x with the proximal segment."""
    for version, names in enumerate((("Proximal", "Distal"), ("Metacarpal", "Distal"))):
        found, data = avatar_json(version)
        human = next(iter(found["extensions"].values()))["humanoid"]
        hand = next(node for node in found["nodes"] if node["name"] == "leftHand")
        more = {f"leftThumb{name}": len(found["nodes"]) + k for k, name in enumerate(names)}
        hand["children"] += more.values()
        found["nodes"] += [{"name": name, "translation": [1.0, 0, 4.0]} for name in more]
        more |= {"jaw": 0, "leftEye": 0}
        if version:
            human["humanBones"] |= {name: {"node": node} for name, node in more.items()}
        else:
            human["humanBones"] += [{"bone": name, "node": node} for name, node in more.items()]
            human["humanBones"] += [{"bone": ["hips"], "node": 1}, {"bone": None, "node": 1}]
        (tmp_path / "me.vrm").write_bytes(packed(found, data))
        rig = read_avatar(tmp_path / "me.vrm")[0].skeleton
        thumb = [name for name in rig.names if "Thumb" in name]
        assert thumb == ["LeftHandThumb1", "LeftHandThumb3"]
        assert avatar_facts(tmp_path / "me.vrm")["humanoid"] == rig.n_joints == len(BONES) + 2


LEFT_ARM = {"Arm": "UpperArm", "ForeArm": "LowerArm", "Hand": "Hand", "HandIndex1": "IndexProximal"}


@pytest.fixture(params=[0, 1])
def vrm(tmp_path, request) -> Path:
    (tmp_path / "me.vrm").write_bytes(avatar(request.param))
    return tmp_path / "me.vrm"


def test_both_versions_of_vrm_look_along_z_with_their_bones_and_colours(vrm):
    human = load_avatar(vrm)[0]
    rig, skin = human.skeleton, human.skins[0]
    for ours, theirs in LEFT_ARM.items():
        place = skin.rest[rig.index(f"Left{ours}")]
        np.testing.assert_allclose(place, BONES[f"left{theirs}"][1], atol=1e-5)
    assert skin.vertices.min(axis=0)[2] > HAIR[2] - 0.04 and skin.vertices[:, 2].max() > 0.1
    # Toes and crown end with the mesh, whose boxes reach 0.03 m out; a finger tip lies beyond its
    # last joint by 0.8 of the bone before, (0.09, 0, 0.03).
    ends = {name: rig.end_sites[name][0] for name in ("LeftToeBase", "Head", "LeftHandIndex1")}
    expected = {
        "LeftToeBase": (0, -0.03, 0.03),
        "Head": (0, HAIR[1] + 0.03 - 1.52, 0),
        "LeftHandIndex1": (0.072, 0, 0.024),
    }
    for name, end in expected.items():
        np.testing.assert_allclose(ends[name], end, atol=1e-5, err_msg=name)
    # The hair has no bone of ours, and moves with the head.
    hair = np.linalg.norm(skin.vertices - HAIR, axis=1) < 0.06
    assert hair.sum() == 8
    assert set(skin.joints[hair, 0]) == {rig.index("Head")}
    red, green = (skin.palette[skin.regions[chosen]].mean(axis=0) for chosen in (~hair, hair))
    np.testing.assert_array_equal(red, [200, 30, 30])
    np.testing.assert_array_equal(green, [30, 200, 30])
    assert (skin.weights.sum(axis=1) == 255).all()


@pytest.mark.parametrize(("colours", "off"), [(100, 0), (3000, 20)])
def test_a_textured_avatar_keeps_its_colours_in_a_small_palette(colours, off):
    shades = np.random.default_rng(0).integers(0, 256, (colours, 3))
    palette, regions = reduce_colours(shades / 255)
    assert len(palette) <= 128 and palette.dtype == np.uint8
    assert np.abs(palette[regions].astype(int) - shades).mean() <= off


def test_a_motion_is_retargeted_to_the_avatar(vrm, gesture):
    motion = gesture(1.0)
    drawn = DrawnBody.of(motion, str(vrm))
    rig = drawn.motion.skeleton
    assert body_height(rig) == pytest.approx(body_height(motion.skeleton), rel=1e-3)
    skinned = SkinnedBody(drawn, drawn.skins[0])
    moves = skinned.transforms(0.5)[skinned.mesh.parts[:, 0]]
    moved = np.einsum("vij,vj->vi", moves[..., :3], skinned.mesh.vertices) + moves[..., 3]
    positions = drawn.motion.positions()[15]
    hand = rig.index("LeftHand")
    boxes = moved[drawn.skins[0].joints[:, 0] == hand]
    np.testing.assert_allclose(boxes.mean(axis=0), positions[hand], atol=1e-3)
    arm = positions[hand] - positions[rig.index("LeftArm")]
    own = motion.positions()[15]
    source = np.subtract(*(own[motion.skeleton.index(n)] for n in ("LeftHand", "LeftArm")))
    assert arm @ source > 0.95 * np.linalg.norm(arm) * np.linalg.norm(source)
    assert abs(moved[:, 1].min() - drawn.figure.floor) < 0.1


@bundled
def test_pages_pictures_and_videos_show_the_avatar(
    tmp_path, vrm, gesture, open_browser, gesturekit
):
    motion = gesture(0.3)
    motion.save(tmp_path / "a.bvh")
    done = gesturekit("view", tmp_path / "a.bvh", "--body", vrm, "-o", tmp_path / "a.html")
    assert done.status == 0, done.err
    write_picture(motion, tmp_path / "a.png", body=str(vrm))
    write_video(motion, tmp_path / "a.mp4", body=str(vrm))
    browser = opened(open_browser, tmp_path / "a.html", "t=0.1")
    browser.screenshot(tmp_path / "page.png")
    for name in ("page.png", "a.png"):
        red, green, _ = np.moveaxis(matplotlib.image.imread(tmp_path / name)[..., :3], -1, 0)
        assert ((red > 0.35) & (red > 2.5 * green)).sum() > 200, name
    assert browser.lines == []


def with_changes(path: Path, *changes: Callable[[dict], None]) -> Path:
    """Write an avatar whose JSON was changed."""
    found, data = avatar_json(1)
    for change in changes:
        change(found)
    path.write_bytes(packed(found, data))
    return path


def changed(*path: Any, value: Any = None, drop: bool = False) -> Callable[[dict], None]:
    """Return a function that sets, or drops, a value in the JSON of an avatar."""

    def change(found: dict) -> None:
        place: Any = found
        for key in path[:-1]:
            place = place[key]
        if drop:
            del place[path[-1]]
        else:
            place[path[-1]] = value

    return change


def test_meshes_of_several_pieces_are_joined_without_their_lines(tmp_path):
    def add(found: dict) -> None:
        pieces = found["meshes"][0]["primitives"]
        pieces += [{**pieces[0], "mode": 1}, {**pieces[0], "mode": 4}]

    one, two = (
        read_avatar(with_changes(tmp_path / "me.vrm", *changes))[1] for changes in ((), (add,))
    )
    np.testing.assert_array_equal(two.faces, [*one.faces, *(one.faces + len(one.vertices))])
    for name in ("vertices", "joints", "weights", "regions"):
        own = getattr(one, name)
        np.testing.assert_array_equal(getattr(two, name), [*own, *own])


def test_faces_of_transparent_texture_are_left_out(tmp_path):
    masked = changed("materials", 0, "alphaMode", value="MASK")
    skin = load_avatar(with_changes(tmp_path / "me.vrm", masked))[0].skins[0]
    assert (np.linalg.norm(skin.vertices - HAIR, axis=1) > 0.06).all()
    np.testing.assert_array_equal(np.unique(skin.palette[skin.regions], axis=0), [[200, 30, 30]])


def test_webp_textures_are_read_and_written(tmp_path, gesture):
    with Image.open(io.BytesIO(picture())) as opened:
        opened.save(tmp_path / "skin.webp", lossless=True, exact=True)
    webp = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    changes = (
        changed("images", value=[{"uri": "skin.webp"}]),
        changed("textures", value=[webp]),
        changed("extensionsRequired", value=["EXT_texture_webp"]),
    )
    skin = load_avatar(with_changes(tmp_path / "me.vrm", *changes))[0].skins[0]
    palette = np.unique(skin.palette[skin.regions], axis=0)
    np.testing.assert_array_equal(palette, [[30, 200, 30], [200, 30, 30]])
    gesture(0.1).save(tmp_path / "a.glb", body=str(tmp_path / "me.vrm"))
    assert Gltf(tmp_path / "a.glb").json["images"][0]["mimeType"] == "image/webp"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("no picture", "texture skin .*image/png is none of PNG, JPEG, WEBP"),
        ("too large", "texture skin .*8 by 8 pixels"),
        ("other format", "texture 0 .*EXT_texture_avif is none"),
    ],
)
def test_a_texture_that_cannot_be_read_leaves_the_base_colour(tmp_path, change, says, monkeypatch):
    colour = ("materials", 0, "pbrMetallicRoughness", "baseColorFactor")
    changes = [changed(*colour, value=[0, 0, 1, 1]), changed("images", 0, "name", value="skin")]
    if change == "no picture":
        changes.append(changed("images", 0, "bufferView", value=0))
    elif change == "other format":
        avif = {"extensions": {"EXT_texture_avif": {"source": 0}}}
        changes.append(changed("textures", value=[avif]))
    else:
        monkeypatch.setattr("gesturekit.formats.gltf.materials._MOST_PIXELS", 63)
    with pytest.warns(UserWarning, match=f"{says}.*base colour"):
        skin = load_avatar(with_changes(tmp_path / "me.vrm", *changes))[0].skins[0]
    np.testing.assert_array_equal(skin.palette, [[0, 0, 255]])


def test_a_fine_pattern_becomes_its_mean_colour(tmp_path):
    """A vertex stands for the skin around it: not for the black or white pixel that it is at."""
    found, data = avatar_json(1)
    board = np.indices((2048, 2048)).sum(axis=0) % 2 * 255
    out = io.BytesIO()
    Image.fromarray(board.astype(np.uint8)).save(out, "PNG")
    found["bufferViews"][6] |= {"byteOffset": len(data), "byteLength": out.tell()}
    data += out.getvalue() + bytes(-out.tell() % 4)
    found["buffers"][0]["byteLength"] = len(data)
    (tmp_path / "me.vrm").write_bytes(packed(found, data))
    skin = load_avatar(tmp_path / "me.vrm")[0].skins[0]
    assert np.abs(skin.palette[skin.regions].astype(int) - 127).max() < 20


def test_textures_are_read_at_the_pixel_that_a_vertex_is_at_and_repeat(tmp_path):
    """Four by two pixels of different colours, at their middles; coordinates repeat by whole ones.

    A hair below 0 is the last pixel: float32 rounds its rest to 1.
    """
    found, data = avatar_json(1)
    pixels = np.zeros((2, 4, 4), np.uint8)
    pixels[..., 0], pixels[..., 1] = [[10, 20, 30, 40]], [[100], [200]]
    pixels[..., 3] = 255
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    uv = np.array([(0.125 + 0.25 * k, 0.25 + 0.5 * j) for j in (0, 1) for k in range(4)], "<f4")
    uv = np.concatenate([uv, uv + [2, -3], [[-1e-9, -1e-9], [0, 0]]]).astype("<f4")
    view = found["bufferViews"][3]
    every = np.frombuffer(data, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(-1, 2)
    every = np.concatenate([uv, every[len(uv) :]])
    for at, content in ((3, every.tobytes()), (6, out.getvalue())):
        found["bufferViews"][at] |= {"byteOffset": len(data), "byteLength": len(content)}
        data += content + bytes(-len(content) % 4)
    found["buffers"][0]["byteLength"] = len(data)
    found["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1, 1, 0, 1]
    (tmp_path / "me.vrm").write_bytes(packed(found, data))
    skin = read_avatar(tmp_path / "me.vrm")[1]
    colours = pixels[..., :3].reshape(-1, 3)
    expected = [*colours, *colours, colours[-1], colours[0]]
    np.testing.assert_array_equal(skin.palette[skin.regions][: len(uv)], expected)


def with_mesh(path: Path, corners: dict[str, Any], node: dict[str, Any], version: int = 1) -> Skin:
    """Return the skin of an avatar whose only mesh has these attributes, and belongs to a node."""
    found, data = avatar_json(version)
    attributes = {}
    for name, values in corners.items():
        kind = {3: "VEC3", 4: "VEC4"}[values.shape[1]]
        component = {"f4": 5126, "u2": 5123}[values.dtype.str[1:]]
        accessor = {"type": kind, "componentType": component, "count": len(values)}
        attributes[name] = len(found["accessors"])
        found["accessors"].append(accessor | {"bufferView": len(found["bufferViews"])})
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes}
        found["bufferViews"].append(view)
        data += values.tobytes()
    found["buffers"][0]["byteLength"] = len(data)
    found["meshes"] = [{"primitives": [{"attributes": attributes}]}]
    found["skins"].append({"joints": [names().index(name) for name in ("rightHand", "head")]})
    found["nodes"].pop()  # the mesh
    at = node.get("at", "root")
    place = len(found["nodes"]) - 1 if at == "root" else names().index(at)
    found["nodes"][place] |= {"mesh": 0}
    if "skin" in node:
        found["nodes"][place] |= {"skin": node["skin"]}
    path.write_bytes(packed(found, data))
    return read_avatar(path)[1]


def names() -> list[str]:
    return [*BONES, "hair"]


CORNERS = np.array([[100, 0, 0], [0, 100, 0], [0, 0, 100]], "<f4")
"""Corners of one face, in the unit of the nodes, centimetres."""


@pytest.mark.parametrize("version", [0, 1])
@pytest.mark.parametrize(
    ("node", "bone"), [("leftHand", "LeftHand"), ("hair", "Head"), ("root", "Hips")]
)
def test_a_mesh_without_a_skin_moves_with_the_bone_that_it_hangs_on(tmp_path, node, bone, version):
    """Jewellery, eyes and hats; the file of VRM 0.x is turned by half a turn."""
    skin = with_mesh(tmp_path / "me.vrm", {"POSITION": CORNERS}, {"at": node}, version)
    place = {"hair": HAIR, "root": (0, 0, 0)}.get(node) or BONES[node][1]
    turn = [1, 1, 1] if version else [-1, 1, -1]
    np.testing.assert_allclose(skin.vertices, place + np.eye(3) * turn, atol=1e-5)
    rig = read_avatar(tmp_path / "me.vrm")[0].skeleton
    assert set(skin.joints[:, 0]) == {rig.index(bone)}
    np.testing.assert_array_equal(skin.weights, [[255, 0, 0, 0]] * 3)
    np.testing.assert_array_equal(skin.faces, [[0, 1, 2]])


def test_vertices_are_blended_between_joints_by_weights_of_any_sum(tmp_path):
    """A skin without matrices rests at its joints: the right hand (-0.67, 1.4, 0), the head.

    The first vertex is at 1/4 of the hand's and 3/4 of the head's, the second without weights at
    its first joint, the third at its fourth.
    """
    weights = np.array([[0.5, 1.5, 0, 0], [0, 0, 0, 0], [0, 0, 0, 2]], "<f4")
    joints = np.array([[0, 1, 0, 0], [0, 1, 1, 1], [0, 0, 0, 1]], "<u2")
    corners = {"POSITION": CORNERS, "JOINTS_0": joints, "WEIGHTS_0": weights}
    skin = with_mesh(tmp_path / "me.vrm", corners, {"skin": 1})
    hand, head = (np.array(BONES[name][1]) for name in ("rightHand", "head"))
    expected = [0.25 * hand + 0.75 * head + [1, 0, 0], hand + [0, 1, 0], head + [0, 0, 1]]
    np.testing.assert_allclose(skin.vertices, expected, atol=1e-5)
    rig = read_avatar(tmp_path / "me.vrm")[0].skeleton
    hand, head = rig.index("RightHand"), rig.index("Head")
    assert [tuple(row) for row in skin.joints[:, :2]] == [
        (head, hand), (hand, head), (head, hand)
    ]  # fmt: skip
    # 255 / 4 is 63.75, 64; 255 * 3 / 4 is 191.25.
    np.testing.assert_array_equal(skin.weights, [[191, 64, 0, 0], [255, 0, 0, 0], [255, 0, 0, 0]])


def test_a_base_colour_is_linear_light(tmp_path):
    """As IEC 61966-2-1 has it: a fifth of the light is half of the code, hardly any is 12.92."""
    surface = {"baseColorFactor": [0.2159, 0.002, 1.0, 1.0]}
    change = changed("materials", 0, "pbrMetallicRoughness", value=surface)
    skin = load_avatar(with_changes(tmp_path / "me.vrm", change))[0].skins[0]
    np.testing.assert_array_equal(skin.palette, [[128, 7, 255]])


def at(name: str) -> int:
    return names().index(name)


HUMAN = ("extensions", "VRMC_vrm", "humanoid", "humanBones")
BAD = {
    "a leg on no hips": (
        lambda found: found["nodes"][0]["children"].remove(at("leftUpperLeg")),
        "a bone of its humanoid is not below the hips",
    ),
    "hips on a spine": (
        lambda found: found["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"].update(
            hips={"node": at("spine")}, spine={"node": at("hips")}
        ),
        "a bone of its humanoid is not below the hips",
    ),
    "few vertices": (changed("accessors", 0, "count", value=7), "indices are beyond the 7 vert"),
    "few coordinates": (changed("accessors", 3, "count", value=9), "TEXCOORD_0 has 9 elements"),
    # Bytes from the second half on are those of 96 to 191, and as signed ones partly negative.
    "negative indices": (
        lambda found: found["accessors"][4].update(componentType=5120, byteOffset=864),
        "indices are beyond the 192 vert",
    ),
    "whole weights": (changed("accessors", 2, "componentType", value=5125), "WEIGHTS_0 holds"),
    "few matrices": (changed("accessors", 5, "count", value=3), "3 inverseBindMatrices for 24"),
    "twice one node": (changed(*HUMAN, "leftHand", "node", value=0), "two bones .* are one node"),
    "a giant": (changed("nodes", len(BONES) + 1, "scale", value=[1.0] * 3), "is 1[67].* metres"),
    "a dwarf": (changed("nodes", len(BONES) + 1, "scale", value=[2e-4] * 3), "is 0.03.* metres"),
    "no metadata": (changed("extensions", drop=True), "Export it as VRM"),
    "no head": (
        changed("extensions", "VRMC_vrm", "humanoid", "humanBones", "head", drop=True),
        "no bone 'head'",
    ),
    "huge count": (changed("accessors", 0, "count", value=10**12), "count of POSITION"),
    "negative count": (changed("accessors", 0, "count", value=-1), "count of POSITION is -1"),
    "negative offset": (changed("bufferViews", 0, "byteOffset", value=-4), "byteOffset is -4"),
    "beyond the file": (changed("bufferViews", 0, "byteLength", value=1 << 40), "byteLength"),
    "other file": (
        changed("buffers", 0, "uri", value="http://a.b/c.bin"),
        "not a file in its folder",
    ),
    "two parents": (changed("nodes", 3, "children", value=[1]), "two parents"),
    "cycle": (changed("nodes", 4, "children", value=[len(BONES) + 1]), "form no tree"),
    "not a number": (changed("nodes", 2, "translation", value=[0, float("nan"), 0]), "translation"),
    "far": (changed("nodes", 2, "translation", value=[0, 1e300, 0]), "translation"),
    "one point": (
        changed("nodes", len(BONES) + 1, "scale", value=[0, 0, 0]),
        "form no body|metres tall",
    ),
    "few joints": (changed("skins", 0, "joints", value=[0]), "JOINTS_0 is beyond"),
    "compressed": (
        changed("extensionsRequired", value=["KHR_draco_mesh_compression"]),
        "export it again without compression",
    ),
    "whole places": (changed("accessors", 0, "componentType", value=5125), "POSITION holds no fl"),
    "split indices": (
        lambda found: found["accessors"][4].update(componentType=5126, count=432),
        "indices are not whole numbers",
    ),
    "many pieces": (
        lambda found: found["meshes"][0].update(primitives=found["meshes"][0]["primitives"] * 4097),
        "its triangles would take more memory or time than a file of",
    ),
    "no mesh": (changed("meshes", 0, "primitives", value=[]), "no mesh"),
    "no list": (changed("nodes", value={}), "nodes is not a list"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_avatars_are_refused_by_name(tmp_path, case):
    change, message = BAD[case]
    with pytest.raises(FormatError, match=message) as error:
        load_avatar(with_changes(tmp_path / "me.vrm", change))
    assert str(error.value).startswith(f"{tmp_path / 'me.vrm'}: ")


@pytest.mark.parametrize("n_bytes", [0, 10, 300, -500])
def test_files_that_are_cut_short_are_refused(tmp_path, n_bytes):
    (tmp_path / "me.vrm").write_bytes(avatar(0)[:n_bytes])
    with pytest.raises(FormatError, match=r"me\.vrm: (cut short|no binary glTF)"):
        load_avatar(tmp_path / "me.vrm")


@pytest.mark.parametrize(
    ("value", "says"),
    [(np.nan, "POSITION holds numbers that are not finite"), (2e4, "not finite, or kilometres")],
)
def test_values_that_are_not_numbers_or_far_are_refused(tmp_path, value, says):
    found, data = avatar_json(1)
    start = found["bufferViews"][0]["byteOffset"]
    broken = data[:start] + np.float32(value).tobytes() + data[start + 4 :]
    (tmp_path / "me.vrm").write_bytes(packed(found, broken))
    with pytest.raises(FormatError, match=says):
        load_avatar(tmp_path / "me.vrm")


def test_a_missing_avatar_is_named_on_the_command_line(tmp_path, gesture, gesturekit):
    gesture(0.2).save(tmp_path / "a.bvh")
    done = gesturekit("view", tmp_path / "a.bvh", "--body", "who.vrm", "-o", tmp_path / "a.png")
    assert done.status == 2 and "who.vrm: no such file" in done.err
    # Before a model is loaded, and once for all sounds.
    render = ("render", "--seconds", 1, "--model", "none", "--out", tmp_path / "out", "--body")
    gesturekit(*render, "who.glb").fails(2, "who.glb: no such file")
    gesturekit(*render, "who.obj").fails(2, "human", "FILE.vrm", "FILE.glb")


def test_dense_meshes_become_smaller_and_keep_their_shape():
    side = 80
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
    faces = np.concatenate([corner + [0, 1, side], corner + [1, side + 1, side]])
    joints = np.zeros((len(vertices), 4), np.uint8)
    joints[:, 0] = vertices[:, 0] > 0.5
    weights = np.tile(np.array([255, 0, 0, 0], np.uint8), (len(vertices), 1))
    weights[joints[:, 0] == 1] = [200, 55, 0, 0]
    skin = Skin(vertices, faces, joints, weights, np.zeros((2, 3)), joints[:, 0].astype(int))
    small = simplified(skin, 300, 1.7)
    assert 100 < len(small.vertices) <= 300
    a, b, c = (small.vertices[small.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(1, abs=0.2)
    right = small.vertices[:, 0] > 0.5
    for values, left_one, right_one in (
        (small.joints, [0, 0, 0, 0], [1, 0, 0, 0]),
        (small.weights, [255, 0, 0, 0], [200, 55, 0, 0]),
        (small.regions[:, None], [0], [1]),
    ):
        np.testing.assert_array_equal(values, np.where(right[:, None], right_one, left_one))
