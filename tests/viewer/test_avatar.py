"""A user's VRM avatar with motion of other rigs, and damaged avatar files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from avatars import BONES, HAIR, avatar, avatar_json, packed

from gesturekit.errors import FormatError
from gesturekit.motion.parts.body_size import body_height
from gesturekit.viewer import write_picture, write_video
from gesturekit.viewer.drawn_body import DrawnBody, load_avatar
from gesturekit.viewer.scene import SkinnedBody

LEFT_ARM = {"Arm": "UpperArm", "ForeArm": "LowerArm", "Hand": "Hand", "HandIndex1": "IndexProximal"}


@pytest.fixture(params=[0, 1])
def vrm(tmp_path, request) -> Path:
    (tmp_path / "me.vrm").write_bytes(avatar(request.param))
    return tmp_path / "me.vrm"


def test_both_versions_of_vrm_look_along_z_with_their_bones_and_colours(vrm):
    avatar, skins = load_avatar(vrm)
    rig, skin = avatar.skeleton, skins[0]
    for ours, theirs in LEFT_ARM.items():
        place = skin.rest[rig.index(f"Left{ours}")]
        np.testing.assert_allclose(place, BONES[f"left{theirs}"][1], atol=1e-5)
    assert skin.vertices.min(axis=0)[2] > HAIR[2] - 0.04 and skin.vertices[:, 2].max() > 0.1
    # Toes and crown end with the mesh, whose boxes reach 0.03 m out.
    expected = {"LeftToeBase": (0, -0.03, 0.03), "Head": (0, HAIR[1] + 0.03 - 1.52, 0)}
    for name, end in expected.items():
        np.testing.assert_allclose(rig.end_sites[name][0], end, atol=1e-5, err_msg=name)
    # A finger goes on as the bone before its last joint does, (0.09, 0, 0.03).
    tip = rig.end_sites["LeftHandIndex1"][0]
    assert 0.04 < tip[0] < 0.1 and tip == pytest.approx(tip[0] * np.array([1, 0, 1 / 3]), abs=1e-5)
    # The hair has no bone of ours, and moves with the head.
    hair = np.linalg.norm(skin.vertices - HAIR, axis=1) < 0.06
    by_head = (skin.weights * (skin.joints == rig.index("Head"))).sum(axis=1)
    assert hair.any() and (by_head == skin.weights.sum(axis=1))[hair].all()
    red, green = (skin.palette[skin.regions[chosen]].mean(axis=0) for chosen in (~hair, hair))
    np.testing.assert_array_equal(red, [200, 30, 30])
    np.testing.assert_array_equal(green, [30, 200, 30])


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
    boxes = moved[((drawn.skins[0].joints == hand) & (drawn.skins[0].weights > 0)).any(axis=1)]
    np.testing.assert_allclose(boxes.mean(axis=0), positions[hand], atol=1e-3)
    arm = positions[hand] - positions[rig.index("LeftArm")]
    own = motion.positions()[15]
    source = np.subtract(*(own[motion.skeleton.index(n)] for n in ("LeftHand", "LeftArm")))
    assert arm @ source > 0.95 * np.linalg.norm(arm) * np.linalg.norm(source)
    assert abs(moved[:, 1].min() - drawn.figure.floor) < 0.1


def reddish(image: np.ndarray) -> int:
    """Count the pixels of the avatar's red."""
    red, green, _ = np.moveaxis(image[..., :3], -1, 0)
    return int(((red > 0.35) & (red > 2.5 * green)).sum())


@pytest.mark.parametrize("vrm", [1], indirect=True)
def test_pictures_and_videos_show_the_avatar(tmp_path, vrm, gesture, read_video):
    write_picture(gesture(0.3), tmp_path / "a.png", body=str(vrm), frames=1)
    write_video(gesture(0.04), tmp_path / "a.mp4", body=str(vrm))
    assert reddish(matplotlib.image.imread(tmp_path / "a.png")) > 100
    assert reddish(read_video(tmp_path / "a.mp4")[0][0] / 255) > 1000


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


def test_faces_of_transparent_texture_are_left_out(tmp_path):
    masked = changed("materials", 0, "alphaMode", value="MASK")
    skin = load_avatar(with_changes(tmp_path / "me.vrm", masked))[1][0]
    assert (np.linalg.norm(skin.vertices - HAIR, axis=1) > 0.06).all()
    np.testing.assert_array_equal(np.unique(skin.palette[skin.regions], axis=0), [[200, 30, 30]])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("no picture", "(?=.*skin)(?=.*image/png).*PNG"),
        ("other format", r"(?=.*texture 0\b).*EXT_texture_avif"),
    ],
)
def test_a_texture_that_cannot_be_read_leaves_the_base_colour(tmp_path, change, says):
    colour = ("materials", 0, "pbrMetallicRoughness", "baseColorFactor")
    changes = [changed(*colour, value=[0, 0, 1, 1]), changed("images", 0, "name", value="skin")]
    if change == "no picture":
        changes.append(changed("images", 0, "bufferView", value=0))
    else:
        avif = {"extensions": {"EXT_texture_avif": {"source": 0}}}
        changes.append(changed("textures", value=[avif]))
    with pytest.warns(UserWarning, match=says):
        skin = load_avatar(with_changes(tmp_path / "me.vrm", *changes))[1][0]
    np.testing.assert_array_equal(skin.palette, [[0, 0, 255]])


BAD = {
    "a leg on no hips": (
        lambda found: found["nodes"][0]["children"].remove(list(BONES).index("leftUpperLeg")),
        "hips",
    ),
    "few vertices": (changed("accessors", 0, "count", value=7), r"(?=.*indices).*\b7\b"),
    # Bytes from the second half on are those of 96 to 191, and as signed ones partly negative.
    "negative indices": (
        lambda found: found["accessors"][4].update(componentType=5120, byteOffset=864),
        r"(?=.*indices).*\b192\b",
    ),
    "few matrices": (changed("accessors", 5, "count", value=3), r"(?=.*inverseBindMatrices).*\b24"),
    "a giant": (changed("nodes", len(BONES) + 1, "scale", value=[1.0] * 3), r"1[67]\d\b.* metres"),
    "no metadata": (changed("extensions", drop=True), "VRM"),
    "no head": (
        changed("extensions", "VRMC_vrm", "humanoid", "humanBones", "head", drop=True),
        "'head'",
    ),
    "huge count": (changed("accessors", 0, "count", value=10**12), "POSITION.*1000000000000"),
    "beyond the file": (changed("bufferViews", 0, "byteLength", value=1 << 40), "byteLength"),
    "other file": (changed("buffers", 0, "uri", value="http://a.b/c.bin"), r"'http://a\.b/c\.bin'"),
    "cycle": (changed("nodes", 4, "children", value=[len(BONES) + 1]), "tree"),
    "not a number": (changed("nodes", 2, "translation", value=[0, float("nan"), 0]), "translation"),
    "one point": (
        changed("nodes", len(BONES) + 1, "scale", value=[0, 0, 0]),
        "body",
    ),
    "few joints": (changed("skins", 0, "joints", value=[0]), r"(?=.*JOINTS_0).*\b1\b"),
    "compressed": (
        changed("extensionsRequired", value=["KHR_draco_mesh_compression"]),
        "'KHR_draco_mesh_compression'",
    ),
    "whole places": (changed("accessors", 0, "componentType", value=5125), "(?=.*POSITION).*float"),
    "many pieces": (
        lambda found: found["meshes"][0].update(primitives=found["meshes"][0]["primitives"] * 4097),
        "memory",
    ),
    "no mesh": (changed("meshes", 0, "primitives", value=[]), "mesh"),
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
    with pytest.raises(FormatError, match=r"me\.vrm"):
        load_avatar(tmp_path / "me.vrm")


@pytest.mark.parametrize(
    ("value", "says"),
    [(np.nan, "POSITION"), (2e4, "kilometres")],
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
    assert done.status == 2 and "who.vrm" in done.err
    # Before a model is loaded, and once for all sounds.
    render = ("render", "--seconds", 1, "--model", "none", "--out", tmp_path / "out", "--body")
    gesturekit(*render, "who.glb").fails(2, "who.glb")
    gesturekit(*render, "who.obj").fails(2, "human", "FILE.vrm", "FILE.glb")
