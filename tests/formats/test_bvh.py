import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.formats import read_bvh, write_bvh
from gesturekit.formats.bvh_parser import parse_bvh
from gesturekit.motion import Motion, Skeleton

SMALL = """HIERARCHY
ROOT Hips
{
\tOFFSET 0 90 0
\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
\tJOINT Chest
\t{
\t\tOFFSET 0 50 0
\t\tCHANNELS 3 Zrotation Xrotation Yrotation
\t\tEnd Site
\t\t{
\t\t\tOFFSET 0 30 0
\t\t}
\t}
}
MOTION
Frames: 3
Frame Time: 0.0333333
0 90 0 0 0 0 10 20 30
1 91 0 0 0 5 11 21 31
2 92 0 0 0 9 12 22 32
"""


@pytest.fixture
def write(tmp_path):
    def to_file(text: str | bytes) -> Path:
        path = tmp_path / "clip.bvh"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return to_file


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r"),
        lambda text: "\ufeff" + text.replace(" ", "\t"),
        lambda text: text.replace("End Site", "END SITE").replace("JOINT", "Joint"),
        lambda text: text.replace("Hips\n{", "Hips {").replace("\n\t\t}\n\t}", "}}"),
        lambda text: text.replace("1 91 0 0", "1e0 9.1E+1 -0 0.0"),
        lambda text: text.replace("Frames: 3", "Frames 3").replace("Time:", "Time  :"),
        lambda text: text.replace("OFFSET 0 30 0", "OFFSET 0 30 0\nCHANNELS 0"),
        lambda text: text.encode("utf-16"),
    ],
)
def test_variants_of_other_writers_are_read(write, change):
    plain, other = read_bvh(write(SMALL)), read_bvh(write(change(SMALL)))
    assert other.skeleton.names == ("Hips", "Chest")
    np.testing.assert_array_equal(plain.end_positions()["Chest"], other.end_positions()["Chest"])


@pytest.mark.parametrize(
    ("old", "new", "line", "says"),
    [
        ("HIERARCHY", "WAVE", 1, "HIERARCHY"),
        ("Frames: 3", "Frames: -3", 17, "-3"),
        (SMALL[SMALL.index("0 90 0 0 0") :], "", 18, "3 "),
        ("12 22 32\n", "12 22 32\n5 5\n", 22, r"(?=.*\b4 of 3\b).*\b2 values.*need 9 .*cut"),
        ("5 11 21", "5 11,5, 21", 20, "'11.5,'"),
        ("5 11 21", "5 nan 21", 20, "value 7 of frame 2 is nan.*the gap"),
        ("5 11 21", "5 1e10 21", 20, "value 7 of frame 2 is 1.*up to [^;]*$"),
        ("11 21 31\n", "11 21\n31 ", 20, " 8 "),
        ("OFFSET 0 50 0", "OFFSET 0 50", 8, "'0 50'"),
        ("CHANNELS 3", "CHANNELS 4", 9, r"(?=.*'4').*\b3\b"),
        ("CHANNELS 3", "CHANNELS", 9, r"(?=.*'Zrotation').*\b2\b"),
        ("CHANNELS 3 Zrotation Xrotation Yrotation", "CHANNELS", 9, "''.* 0 "),
        ("3 Zrotation Xrotation", "3 Zrotation Zrotation", 9, "Zrotation Zrotation"),
        ("JOINT Chest", "ROOT Chest", 6, "(?=.*'Chest').*'Hips'"),
        ("JOINT Chest", "BONE Chest", 6, "'BONE Chest'.* in a joint"),
        ("HIERARCHY\n", "HIERARCHY\nBONE Chest\n", 2, "'BONE Chest'.* outside any joint"),
    ],
)
def test_broken_files_are_named_with_their_line(write, old, new, line, says):
    assert old in SMALL
    path = write(SMALL.replace(old, new))
    with pytest.raises(FormatError, match=rf"{path}:{line}\b.*{says}"):
        read_bvh(path)


@pytest.mark.parametrize("value", ["0", "x", "", "100000.5"])
def test_an_invalid_frame_time_is_an_error_unless_fps_is_given(write, value):
    path = write(SMALL.replace("0.0333333", value))
    with pytest.raises(FormatError, match="(?=.*Frame Time).*--in-fps"):
        read_bvh(path)
    motion = read_bvh(path, fps=50)
    assert motion.fps == 50 and motion.info["frame_time"] == value


def test_a_file_that_is_cut_later_keeps_its_whole_frames(write):
    whole = read_bvh(write(SMALL))
    last_value = SMALL.rindex("32")  # a cut within the last number cannot be seen
    for cut in range(SMALL.index("1 91 0"), last_value):
        kept = SMALL[:cut].count("\n", SMALL.index("0 90 0 0"))
        with pytest.warns(UserWarning, match=rf"(?=.*\b3\b)(?=.*\b{kept}\b).*cut"):
            motion = read_bvh(write(SMALL[:cut]))
        np.testing.assert_array_equal(motion.rotations, whole.rotations[:kept])


@pytest.mark.parametrize(
    ("old", "new", "kept", "says"),
    [
        ("Frames: 3", "Frames: 99999999999999", 3, r"(?=.*\b99999999999999\b).*\b3\b"),
        ("Frames: 3", "Frames: 2", 3, r"(?=.*\b2\b).*\b3\b"),
        ("Frames: 3", "Frames: 0", 3, r"(?=.*\b0\b).*\b3\b"),
        ("12 22 32\n", "12 22\n\n \n", 2, r"(?=.*\b3\b)(?=.*\b2\b).*last"),
    ],
)
def test_the_frames_of_a_file_count_more_than_their_number(write, old, new, kept, says):
    with pytest.warns(UserWarning, match=says):
        assert read_bvh(write(SMALL.replace(old, new))).n_frames == kept


def test_decimal_commas_are_read_as_points(write):
    points = SMALL.replace("5 11 21", "5.25 -11.5 21e-1").replace("0 50 0", "0 50.5 0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expected = read_bvh(write(points))
    with pytest.warns(UserWarning, match="clip.bvh.*commas"):
        read_bvh(write(SMALL.replace("5 11 21", "5,25 11 21")))
    with pytest.warns(UserWarning, match="clip.bvh.*commas"):
        motion = read_bvh(write(points.replace(".", ",")))
    assert motion.fps == expected.fps == 30
    np.testing.assert_array_equal(motion.rotations, expected.rotations)
    np.testing.assert_array_equal(motion.skeleton.offsets, expected.skeleton.offsets)


def test_files_that_are_not_bvh_are_refused(write, tmp_path):
    with pytest.raises(FormatError, match="HIERARCHY"):
        read_bvh(write(bytes(range(256)) * 50))
    with pytest.raises(FormatError, match="(?=.*glTF).*HIERARCHY"):
        read_bvh(write(b"glTF" + bytes(20)))
    with pytest.raises(FormatError, match="clip.bvh.* 1048576"):
        read_bvh(write(b"x" * (1 << 22)))
    with pytest.raises(FormatError, match="clip.bvh:20.* 1048576"):
        read_bvh(write(SMALL.replace("21 31", "1 " * (1 << 21))))
    with pytest.raises(FormatError, match="clip.bvh:20.*'#'"):
        read_bvh(write(SMALL.replace("21 31", "21 31 # x")))
    with pytest.raises(FormatError, match="absent.bvh"):
        read_bvh(tmp_path / "absent.bvh")
    with pytest.raises(FormatError, match=str(tmp_path)):
        read_bvh(tmp_path)


def test_names_in_another_encoding(write):
    text = SMALL.replace("Chest", "Brustkörbchen")
    assert read_bvh(write(text)).skeleton.names[1] == "Brustkörbchen"
    for encoding in ("latin-1", "utf-8-sig", "utf-16"):
        assert read_bvh(write(text.encode(encoding))).skeleton.names[1] == "Brustkörbchen"
    big = text.encode("utf-16-be")
    assert read_bvh(write(b"\xfe\xff" + big)).skeleton.names[1] == "Brustkörbchen"


@pytest.mark.parametrize("long_ones", [0.0, 0.05, 0.5])
@pytest.mark.parametrize("no_point", [False, True])
def test_numbers_are_parsed_as_by_python(write, long_ones, no_point):
    rng = np.random.default_rng(0)
    plain = ("%.6f", "%.1f", "%.3f", "%+.4f", "%08.2f", "%.0f.", "%.12f")
    odd = ("%.15f", "%.17f", "%.30f", "%040.6f")
    kinds = [rng.choice(odd if rng.random() < long_ones else plain) for _ in range(9 * 500)]
    words = [kind % value for kind, value in zip(kinds, rng.normal(0, 100, len(kinds)))]
    words = [word.replace("0.", ".", 1) if word.startswith("0.") else word for word in words]
    if no_point:
        words[77], words[99] = "12", "-1.5E+2"
    rows = "\n".join(" ".join(words[i : i + 9]) for i in range(0, len(words), 9))
    head = SMALL[: SMALL.index("0 90 0 0 0")].replace("Frames: 3", "Frames: 500")
    frames = parse_bvh(write(head + rows)).frames
    np.testing.assert_array_equal(frames.ravel(), [float(word) for word in words])


def test_still_position_channels_become_the_offset(write):
    text = SMALL.replace("CHANNELS 3", "CHANNELS 6 Xposition Yposition Zposition")
    rows = text.replace("10 20 30", "7 60 0 10 20 30").replace("11 21 31", "7 60 0 11 21 31")
    still = read_bvh(write(rows.replace("12 22 32", "7 60 0 12 22 32")))
    assert not still.joint_translations
    np.testing.assert_allclose(still.skeleton.offsets[1], [0.07, 0.6, 0])
    moving = read_bvh(write(rows.replace("12 22 32", "7 60 1 12 22 32")))
    np.testing.assert_allclose(moving.joint_translations["Chest"][:, 2], [0, 0, 0.01])
    np.testing.assert_allclose(moving.skeleton.offsets[1], [0, 0.5, 0])


@pytest.mark.parametrize(
    ("text", "fps"),
    [
        ("0.0333333", 30),
        ("0.033", 30),
        ("0.041667", 24),
        ("0.00833", 120),
        ("0.017", 60),
        ("0.0333667", 30000 / 1001),
        ("0.035", 29),  # 30 is 1.7 of the last digit away
        ("0.039", 26),  # 25 is one whole digit away
    ],
)
def test_frame_rates(write, text, fps):
    found = read_bvh(write(SMALL.replace("0.0333333", text))).fps
    assert found == pytest.approx(fps, rel=1e-9)
    if fps == int(fps):
        assert found == fps


def test_unit_and_axes_can_be_set(write):
    path = write(SMALL)
    assert read_bvh(path, unit="m").translation[0, 1] == 90
    assert read_bvh(path, unit="mm").translation[0, 1] == pytest.approx(0.09)
    assert read_bvh(path, unit="inch").translation[0, 1] == pytest.approx(90 * 0.0254)
    with pytest.raises(FormatError, match="(?=.*'foot').*inch"):
        read_bvh(path, unit="foot")
    with pytest.raises(FormatError, match="'w'"):
        read_bvh(path, up="w")
    with pytest.raises(FormatError, match="(?=.*'-y').*'y'"):
        read_bvh(path, up="y", forward="-y")


def test_a_name_that_would_break_the_file_is_refused(write, tmp_path):
    motion = read_bvh(write(SMALL))
    bad = replace(motion, skeleton=replace(motion.skeleton, names=("Hips", "a } b"), end_sites={}))
    with pytest.raises(FormatError, match="a } b"):
        write_bvh(bad, tmp_path / "out.bvh")
    with pytest.raises(FormatError, match="'furlong'"):
        write_bvh(motion, tmp_path / "out.bvh", unit="furlong")
    assert not (tmp_path / "out.bvh").exists()


def test_joints_in_any_order_are_written_as_a_tree(tmp_path):
    """A skeleton may list all children of a joint before their own children; a file cannot."""
    names, parents = ("root", "a", "b", "a1", "b1"), (-1, 0, 0, 1, 2)
    rng = np.random.default_rng(0)
    q = Rotation.random(10 * 5, random_state=0).as_quat().reshape(10, 5, 4)
    rig = Skeleton(names, parents, rng.normal(size=(5, 3)))
    moving = {"b1": rng.normal(size=(10, 3))}
    motion = Motion(rig, q, rng.normal(size=(10, 3)), 30, joint_translations=moving)
    write_bvh(motion, tmp_path / "a.bvh")
    again = read_bvh(tmp_path / "a.bvh", unit="cm")
    order = [again.skeleton.index(name) for name in names]
    np.testing.assert_allclose(again.positions()[:, order], motion.positions(), atol=1e-6)
