"""Pictures must show the motion they were given."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path

import matplotlib.colors
import matplotlib.figure
import matplotlib.image
import numpy as np
import pytest
from avatars import avatar
from PIL import Image
from rigs import PERSON, at_rest, rig_of
from scipy.spatial.transform import Rotation

from audio_features import FeatureTrack, LogMel, Wave
from gesturekit.errors import FormatError, MotionError
from gesturekit.motion import Motion
from gesturekit.viewer import write_picture
from gesturekit.viewer.anatomy import LEFT, MIDDLE, RIGHT
from gesturekit.viewer.drawn_body import DrawnBody
from gesturekit.viewer.feature_picture import draw_features
from gesturekit.viewer.figure import Figure
from gesturekit.viewer.pictures import COLOURS
from gesturekit.viewer.video.scene import Stills


def a_swing(amplitude: float) -> Motion:
    bones = {"root": (None, (0.0, 0.0, 0.0)), "arm": ("root", (0.0, 1.0, 0.0))}
    skeleton = rig_of(bones, end_sites={"arm": (np.array([0.0, 0.6, 0.0]),)})
    turn = np.zeros((90, 2, 3))
    turn[:, 1, 2] = amplitude * np.sin(np.arange(90) / 5)
    rotations = Rotation.from_rotvec(turn.reshape(-1, 3)).as_quat().reshape(90, 2, 4)
    return Motion(skeleton, rotations, np.zeros((90, 3)), 30.0)


def body_of(path: Path) -> np.ndarray:
    """Return (H, W) bool: where a picture shows the middle of a body."""
    image = matplotlib.image.imread(path)[:, :, :3]
    return np.abs(image - matplotlib.colors.to_rgb(COLOURS[MIDDLE])).max(axis=2) < 0.02


def widths(path: Path, n: int) -> list[int]:
    """How many pixels wide each of `n` figures in a row is."""
    found = []
    for part in np.array_split(body_of(path), n, axis=1):
        across = np.flatnonzero(part.any(axis=0))
        found.append(int(across[-1] - across[0]))
    return found


def test_nothing_and_two_bodies_at_once_are_refused(tmp_path):
    with pytest.raises(MotionError, match="no motion to draw"):
        write_picture({}, tmp_path / "a.png")
    with pytest.raises(FormatError, match="either a body or a body model, not both"):
        DrawnBody.of(a_swing(0.5), "human", tmp_path / "SMPL_NEUTRAL.npz")


def test_each_figure_shows_its_own_moment(tmp_path):
    write_picture(a_swing(0.0), tmp_path / "still.png", frames=4)
    write_picture(a_swing(1.2), tmp_path / "moving.png", frames=4)
    assert np.ptp(widths(tmp_path / "still.png", 4)) <= 2
    assert np.ptp(widths(tmp_path / "moving.png", 4)) > 20


def test_a_plot_is_the_picture_of_the_file(tmp_path):
    sound = Wave(np.zeros(48_000, np.float32), 16_000)
    options = {"audio": sound, "frames": 3, "title": "swing", "body": "skeleton"}
    a_swing(1.2).save(tmp_path / "a.png", **options)
    plot = a_swing(1.2).plot(**options)
    np.testing.assert_array_equal(plot, Image.open(tmp_path / "a.png"))
    write_picture(a_swing(1.2), tmp_path / "b.png", title="")
    np.testing.assert_array_equal(a_swing(1.2).plot(), Image.open(tmp_path / "b.png"))


def test_a_motion_too_short_for_the_first_time_is_drawn_in_its_middle(tmp_path):
    short = {"long": a_swing(0.0), "short": a_swing(0.0)[:3]}
    write_picture(short, tmp_path / "a.png")
    body = body_of(tmp_path / "a.png")
    assert body[len(body) // 2 : 3 * len(body) // 4].any()


def test_more_motions_than_colours_have_speeds_of_their_own(tmp_path):
    figure = a_swing(1.0)[:30]
    write_picture({f"take {k}": figure for k in range(8)}, tmp_path / "a.svg")
    drawn = re.findall(
        r'clip-path[^>]*style="(fill: none; [^"]*)"', (tmp_path / "a.svg").read_text()
    )
    assert len({style for style in drawn if "stroke-width: 1.4" in style}) == 8


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_files_name_us_and_no_time_of_writing(tmp_path, kind):
    write_picture(a_swing(1.0), tmp_path / f"a.{kind.upper()}", frames=1)
    data = (tmp_path / f"a.{kind.upper()}").read_bytes()
    assert b"gesturekit" in data
    assert b"dc:date" not in data and b"CreationDate" not in data


def test_a_rig_of_one_joint_is_as_tall_as_its_end(tmp_path):
    ends = {"root": (np.array([0.0, 1.0, 0.0]),)}
    lone = rig_of({"root": (None, (0.0, 0.0, 0.0))}, end_sites=ends)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (90, 1, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_picture(Motion(lone, still, np.zeros((90, 3)), 30.0), tmp_path / "a.png", frames=4)
    assert np.ptp(widths(tmp_path / "a.png", 4)) <= 2


def test_the_picture_with_sound_has_the_speech_on_it(tmp_path):
    samples = np.random.default_rng(0).normal(0, 0.1, 48_000).astype(np.float32)
    write_picture(a_swing(1.0), tmp_path / "without.png")
    write_picture(a_swing(1.0), tmp_path / "with.png", audio=Wave(samples, 16_000))
    without, with_sound = (
        matplotlib.image.imread(tmp_path / name) for name in ("without.png", "with.png")
    )
    assert with_sound.shape[0] > without.shape[0]


def test_silence_and_titles_of_any_kind_are_drawn(tmp_path):
    silence = Wave(np.zeros(16_000, dtype=np.float32), 16_000)
    write_picture(a_swing(0.2), tmp_path / "t.png", title=r"$\frac{unclosed $ \q")
    write_picture(a_swing(0.2), tmp_path / "s.png", audio=silence)
    assert (tmp_path / "s.png").stat().st_size > 1_000


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """drawn(motion, **options): the axes of the picture that was written."""
    kept, save = [], matplotlib.figure.Figure.savefig

    def saved(figure, *arguments, **options):
        kept.append(figure)
        save(figure, *arguments, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", saved)

    def draw(motion, **options):
        write_picture(motion, tmp_path / "x.png", **options)
        return kept[-1].axes

    draw.kept, draw.path = kept, tmp_path / "x.png"
    return draw


def outlines(axes) -> list[np.ndarray]:
    """Return the outline (N, 2) of each painted part, seconds and metres."""
    return [patch.get_xy()[:-1] for patch in axes.patches]


def test_limbs_are_upright_at_their_times_and_not_stretched(drawn):
    bones = {"root": (None, (0.0, 0.0, 0.0)), "tip": ("root", (0.0, 1.0, 0.0))}
    still = np.tile([0.0, 0.0, 0.0, 1.0], (90, 2, 1))
    axes, _ = drawn(Motion(rig_of(bones), still, np.zeros((90, 3)), 30.0), frames=4)
    shapes = outlines(axes)
    assert len(shapes) == 4
    for k, limb in enumerate(shapes):
        assert limb[:, 0].mean() == pytest.approx(0.375 + 0.75 * k)  # 4 times in 3 s
        # Radii of 0.011 and 0.008 of the height, at 0 and 1 m.
        low, high = limb[:, 1].min(), limb[:, 1].max()
        assert (low, high) == pytest.approx((-0.011, 1.008))
        # In pixels a limb is twice as wide as its round end is high.
        ends = axes.transData.transform(limb)
        below = axes.transData.transform([(0, 0), (0, -0.011)])
        assert np.ptp(ends[:, 0]) == pytest.approx(2 * (below[0, 1] - below[1, 1]), rel=0.02)
    assert axes.get_xlim() == (0, 3) and axes.get_ylim() == pytest.approx((-0.05, 1.09))
    assert list(axes.lines[0].get_ydata()) == [0, 0], "the floor"


def test_bodies_that_reach_above_their_row_are_not_stretched(drawn, gesture):
    """The rows become smaller by them. A skull is 0.68 wide by 0.92 high of the head's height."""
    motion = gesture(1.0, 30.0)
    jump = np.where(motion.times > 0.5, 0.8, 0.0)[:, None] * [0, 1, 0]
    motion = replace(motion, translation=motion.translation + jump)
    axes = drawn(motion, frames=2)[0]
    skull = axes.transData.transform(max(outlines(axes), key=lambda shape: shape[:, 1].max()))
    width, height = np.ptp(skull, axis=0)
    assert width / height == pytest.approx(0.68 / 0.92, rel=0.05)
    (heading,) = drawn.kept[-1].texts
    assert skull[:, 1].max() < heading.get_window_extent().y0, "nor drawn over the heading"


def colours_of(axes) -> np.ndarray:
    return np.array([matplotlib.colors.to_hex(patch.get_facecolor()) for patch in axes.patches])


def metres(axes, time: float) -> list[np.ndarray]:
    """Return the outlines in metres from the middle of the body that is drawn at a time."""
    box = axes.get_window_extent()
    wide = np.ptp(axes.get_xlim()) / box.width * box.height / np.ptp(axes.get_ylim())
    return [(shape - [time, 0]) / [wide, 1] for shape in outlines(axes)]


def test_limbs_are_as_wide_as_their_radii_and_the_trunk_is_flat(drawn, skeleton):
    """In a T-pose the left upper arm is level, from 0.17 to 0.45 m at 0.4 m above the hips."""
    motion = at_rest(skeleton, 30, (3.0, 1.0, -2.0))
    axes, figure = drawn(motion, frames=1)[0], Figure.of(motion)
    shapes = metres(axes, 0.5)
    x, hips = figure.points[0, :, 0] - 3.0, 1.0 - figure.floor
    for name, start in (("LeftForeArm", "LeftArm"), ("Spine", "Hips"), ("RightLeg", "RightUpLeg")):
        joints = [skeleton.index(name) for name in (start, name)]
        (limb,) = (limb for limb in figure.limbs if limb.ends == tuple(joints))
        ends = x[joints], figure.points[0, joints, 1] - figure.floor
        across = int(name != "LeftForeArm")
        if across:
            ends = ends[::-1]
        (first, last), (level, _) = ends
        low, high = (
            min(first - limb.radii[0], last - limb.radii[1]),
            max(first + limb.radii[0], last + limb.radii[1]),
        )
        thick = 2 * max(limb.radii) * limb.width
        found = [
            shape
            for shape in shapes
            if np.ptp(shape[:, 1 - across]) == pytest.approx(thick, rel=1e-3)
            and shape[:, across].min() == pytest.approx(low, abs=1e-4)
            and shape[:, across].max() == pytest.approx(high, abs=1e-4)
            and shape[:, 1 - across].mean() == pytest.approx(level, abs=1e-4)
        ]
        assert len(found) == 1, name
    assert hips == pytest.approx(0.89 + 0.05), "the end sites of the feet are on the floor"
    # The border between parts is white; a finger or a nose would vanish in one.
    borders = {patch.get_linewidth() for patch, c in zip(axes.patches, colours_of(axes))
               if c in COLOURS.values()}  # fmt: skip
    assert len(borders) == 1 and borders.pop() > 0


def test_fingers_have_no_border(drawn):
    bones = PERSON | {"LeftHandIndex1": ("LeftHand", (0.09, 0.0, 0.0)),
                      "LeftHandIndex2": ("LeftHandIndex1", (0.03, 0.0, 0.0))}  # fmt: skip
    axes = drawn(at_rest(rig_of(bones), 30), frames=1)[0]
    left = np.array([shape[:, 0].mean() for shape in outlines(axes)])
    widths = [patch.get_linewidth() for patch in axes.patches]
    assert widths[left.argmax()] == 0 and np.count_nonzero(widths) > 15


@pytest.mark.parametrize("lean", [-0.6, 0.5])
def test_the_head_leans_and_its_nose_points_as_it_looks(drawn, skeleton, lean):
    motion = at_rest(skeleton, 30)
    turn = Rotation.from_euler("z", lean) * Rotation.from_euler("y", 0.7)
    # On average it looks ahead: the others turn the other way.
    ahead = Rotation.from_euler("y", -0.7).as_quat()
    motion.rotations[:, skeleton.index("Head")] = ahead
    motion.rotations[15, skeleton.index("Head")] = turn.as_quat()
    axes, figure = drawn(motion, frames=1)[0], Figure.of(motion)
    shapes, colours, size = metres(axes, 0.5), colours_of(axes), figure.head.size
    base, up, face = (
        figure.points[15, [figure.head.base, figure.head.up, figure.head.face]]
        - [0, figure.floor, 0]
    )[:, :2]
    centre, upwards = base + 0.4 * (up - base), (up - base) / size
    aside = np.array([upwards[1], -upwards[0]])
    pale = [shape for shape, colour in zip(shapes, colours) if colour == COLOURS[MIDDLE]]
    skull = max(pale, key=lambda shape: (shape @ upwards).max())
    (nose,) = (s for s, c in zip(shapes, colours) if c not in COLOURS.values())
    looks = face - base
    assert abs(looks[0]) > 0.3 * size
    for shape, middle, wide, high in (
        (skull, centre, 0.68, 0.92),
        (nose, centre + 0.36 * looks, 0.12, 0.26),
    ):
        assert np.ptp(shape @ aside) == pytest.approx(wide * size, rel=0.02)
        assert np.ptp(shape @ upwards) == pytest.approx(high * size, rel=0.02)
        corners = [(shape @ axis).min() + (shape @ axis).max() for axis in (aside, upwards)]
        assert corners == pytest.approx([2 * middle @ aside, 2 * middle @ upwards], abs=0.01 * size)


def test_stills_of_a_skin_stand_at_their_times_and_are_not_stretched(drawn, gesture, tmp_path):
    (tmp_path / "me.vrm").write_bytes(avatar(1))
    body = str(tmp_path / "me.vrm")
    motion = gesture(1.0)
    axes = drawn(motion, frames=2, body=body)[0]
    stills = Stills(DrawnBody.of(motion, body), 600)
    assert axes.get_title(loc="left") == "from the front" and len(axes.images) == 2
    for image, time in zip(axes.images, (0.25, 0.75), strict=True):
        shown, (left, right, bottom, top) = stills.at(int(30 * time))
        start, end, *heights = image.get_extent()
        assert heights == pytest.approx([bottom, top])
        assert (time - start) / (end - time) == pytest.approx(-left / right)
        width, height = np.ptp(axes.transData.transform([(start, bottom), (end, top)]), axis=0)
        assert width / height == pytest.approx((right - left) / (top - bottom), rel=0.01)
        assert (np.asarray(image.get_array()) == shown).all()
    assert axes.get_xlim() == (0, 1)
    extent = DrawnBody.of(motion, body).figure.extent
    assert axes.get_ylim() == pytest.approx((-0.05 * extent, 1.09 * extent))


def test_a_motion_that_ends_at_the_first_time_is_drawn_in_its_middle(drawn):
    """Once in 3 s is at 1.5 s, when the other one is over."""
    axes = drawn({"a": a_swing(0.0), "b": a_swing(0.0)[:45]}, frames=1)
    times = [[shape[:, 0].mean() for shape in outlines(row)] for row in axes[:2]]
    assert times[0] == pytest.approx([1.5] * 2) and times[1] == pytest.approx([0.75] * 2)


def test_rows_share_a_time_axis_without_other_lines(drawn):
    sound = Wave(np.random.default_rng(0).normal(0, 0.1, 48_000).astype(np.float32), 16_000)
    rows = drawn({"_a$b$": a_swing(0.3), "b": a_swing(0.5)}, audio=sound, title="my_$title")
    canvas = drawn.kept[-1]
    for axes in rows:
        shown = {name for name, spine in axes.spines.items() if spine.get_visible()}
        assert shown == {"bottom"}
    assert [axes.get_xlabel() for axes in rows] == ["", "", "", "seconds"]
    ticks = [[t.get_fontsize() for t in axes.get_xticklabels() if t.get_text()] for axes in rows]
    assert not any(ticks[:3]) and max(ticks[3]) < 9
    assert [len(axes.get_yticks()) > 0 for axes in rows] == [False, True, False, False]
    heights = [axes.get_window_extent().height for axes in rows]
    assert heights[2] == pytest.approx(heights[3]) and heights[2] > 2 * heights[1]
    assert 1.0 < heights[1] / heights[0] < 1.2
    (heading,) = canvas.texts
    box = heading.get_window_extent()
    assert heading.get_text() == "my_$title"
    assert 0.01 < box.x0 / canvas.bbox.width < 0.02 and heading.get_fontsize() > 11
    assert all(axes.title.get_text() == "" for axes in rows), "titles are at the left"
    legend = rows[1].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == [r"a\$b\$", "b"]
    assert rows[1].get_title(loc="left") == "mean speed of all joints, m/s, over the energy of " \
        "speech (grey)"  # fmt: skip
    assert not legend.get_frame_on()
    place, axes = legend.get_window_extent(), rows[1].get_window_extent()
    # Over the axes, at their right end, in one line.
    assert axes.y1 <= place.y0 + 1 < axes.y1 + 5 and abs(place.x1 - axes.x1) < 3
    assert place.height < 30


def test_people_are_seen_from_the_front_wherever_they_stand_and_face(drawn, gesture):
    motion = gesture(1.0, 30.0)
    before = outlines(drawn(motion, frames=3)[0])
    yaw = Rotation.from_euler("y", 2.0)
    rotations = motion.rotations.copy()
    rotations[:, 0] = (yaw * Rotation.from_quat(rotations[:, 0])).as_quat()
    path = yaw.apply(motion.translation) + [3.0, 0.5, -2.0]
    elsewhere = Motion(motion.skeleton, rotations, path, motion.fps)
    axes = drawn(elsewhere, frames=3)[0]
    after = outlines(axes)
    assert len(before) == len(after)
    for one, other in zip(before, after):
        assert other == pytest.approx(one, abs=1e-3)
    colours = [matplotlib.colors.to_hex(patch.get_facecolor()) for patch in axes.patches]
    middles = np.array([shape[:, 0].mean() for shape in after])
    first = middles < 1 / 3
    left, right = (
        middles[first & (np.array(colours) == COLOURS[side])].mean() for side in (LEFT, RIGHT)
    )
    # The first one is drawn at a sixth of the second; its left is at our right.
    assert right < 1 / 6 < left and left - 1 / 6 == pytest.approx(1 / 6 - right, abs=0.02)
    # The head is on top, with a nose over it.
    tops = [shape[:, 1].max() for shape in after]
    assert COLOURS[MIDDLE] == colours[int(np.argmax(tops))]
    (nose,) = {colour for colour in colours if colour not in COLOURS.values()}
    assert colours.count(nose) == 3


def test_what_is_nearer_is_painted_over_what_is_farther(drawn, gesture):
    motion = gesture(0.5, 30.0)
    raised = motion.rotations.copy()
    for side in ("Left", "Right"):
        arm = motion.skeleton.index(f"{side}Arm")
        raised[:, arm] = Rotation.from_euler("y", -90 if side == "Left" else 90, True).as_quat()
    both = {}
    for name, turn in (("front", 0.0), ("back", np.pi)):
        rotations = raised.copy()
        head = motion.skeleton.index("Head")
        rotations[7, head] = Rotation.from_euler("y", turn).as_quat()
        both[name] = Motion(motion.skeleton, rotations, motion.translation, motion.fps)
    axes = drawn(both["front"], frames=1)[0]
    figure = Figure.of(both["front"])
    depths = figure.points[7] @ [np.sin(figure.front), 0, np.cos(figure.front)]
    orders = {
        tuple(np.round(patch.get_xy()[:-1].mean(axis=0), 4)): patch.get_zorder()
        for patch in axes.patches
    }
    assert len(set(orders.values())) == len(axes.patches)
    colours = [matplotlib.colors.to_hex(patch.get_facecolor()) for patch in axes.patches]
    order = [patch.get_zorder() for patch in axes.patches]
    hands = [k for k, colour in enumerate(colours) if colour in (COLOURS[LEFT], COLOURS[RIGHT])]
    trunk = [k for k, colour in enumerate(colours) if colour == COLOURS[MIDDLE]]
    hand = figure.hands[0]
    assert depths[hand] > depths[0] + 0.3, "the arms point at the viewer"
    assert max(order[k] for k in hands) > max(order[k] for k in trunk)
    assert {COLOURS[side] for side in COLOURS} < set(colours), "and a nose"
    assert set(colours_of(drawn(both["back"], frames=1)[0])) == set(COLOURS.values())


def test_hand_speed_is_shown_over_the_energy_of_speech(drawn):
    motion = a_swing(1.0)
    figure = Figure.of(motion)
    body, speed = drawn({"a": motion, "b": motion[:30]})[1:]
    (first, second), bodies = speed.lines, drawn.kept[-1].axes
    assert len(bodies) == 3 and bodies[0].get_title(loc="left").startswith("a: from the front")
    assert first.get_xdata() == pytest.approx(np.arange(90) / 30)
    assert first.get_ydata() == pytest.approx(figure.hand_speed)
    assert second.get_xdata() == pytest.approx(np.arange(30) / 30)
    top = max(1.08 * Figure.of(m).top_speed for m in (motion, motion[:30]))
    assert speed.get_ylim() == pytest.approx((0, max(top, 0.06 * figure.height)))
    assert speed.get_title(loc="left") == "mean speed of all joints, m/s"
    assert [text.get_text() for text in speed.get_legend().get_texts()] == ["a", "b"]
    assert first.get_color() != second.get_color() and len(speed.collections) == 2
    still = drawn(a_swing(0.0))[1]
    assert still.get_ylim() == pytest.approx((0, 0.06 * figure.height)) and not still.get_legend()

    # Quiet for 2 s, then loud for 2: a step of grey from none to the full height.
    samples = np.random.default_rng(0).normal(0, 1, 64_000).astype(np.float32)
    samples *= np.where(np.arange(64_000) < 32_000, 0.001, 0.2)
    speech, speed, body = drawn(motion, audio=Wave(samples.astype(np.float32), 16_000))
    assert {axes.get_xlim() for axes in (speech, speed, body)} == {(0, 4)}
    (grey,) = speed.collections
    outline = grey.get_paths()[0].vertices
    top = speed.get_ylim()[1]
    quiet, loud = (
        outline[(outline[:, 0] > start) & (outline[:, 0] < start + 1.5), 1].max()
        for start in (0.2, 2.2)
    )
    assert quiet < 0.1 * top and loud == pytest.approx(top, rel=0.01)
    assert outline[:, 0].min() == 0 and outline[:, 0].max() == pytest.approx(3.98)
    assert speed.get_title(loc="left") == (
        "mean speed of all joints, m/s (orange), over the energy of speech (grey)"
    )
    (image,) = speech.images
    assert tuple(image.get_extent()) == (0, 4, 0, 1) and image.get_array().shape[0] == 40
    # Low bands are below, and the loud half is brighter.
    values = np.asarray(image.get_array())
    assert values[:, -50:].mean() > values[:, :50].mean() + 1


def test_pictures_are_as_large_as_their_content(drawn):
    def size(*labels: str, **options) -> tuple[float, float]:
        axes = drawn({label: a_swing(0.5) for label in labels}, **options)
        return tuple(axes[0].figure.get_size_inches())

    assert size("a", frames=2)[0] == 6.0 and size("a")[0] == 13.0, "ten times by default"
    assert size("a", frames=8)[0] == pytest.approx(10.4)
    one, two = size("a")[1], size("a", "b")[1]
    sound = Wave(np.random.default_rng(0).normal(0, 0.1, 48_000).astype(np.float32), 16_000)
    assert 2 < two - one < 4 and 4.5 < one < 5.2
    assert 1 < size("a", audio=sound)[1] - one < 1.6
    image = matplotlib.image.imread(drawn.path)
    assert image.shape[1] == 1430, "110 pixels an inch"


def test_features_are_drawn_at_their_times(drawn, tmp_path):
    times = 0.01 + 0.02 * np.arange(100)
    rng = np.random.default_rng(0)
    voiced = np.where(np.arange(100) < 50, 0.9, 0.5)
    columns = {
        "mfcc_0": 5 + 300 * rng.normal(size=100),
        "mfcc_1": rng.normal(size=100),
        "f0": np.linspace(-3, 3, 100),
        "voicing": voiced,
        "mel_0": np.full(100, 1.0),
        "mel_1": np.full(100, 3.0),
    }
    values = np.stack(list(columns.values()), axis=1).astype(np.float32)
    track = FeatureTrack(values, times, names=tuple(columns))
    wave = Wave(rng.normal(0, 0.1, 32_000).astype(np.float32), 16_000)
    path = tmp_path / r"$\frac{a$.png"  # a name, and no formula
    draw_features(track, path, wave)
    assert path.stat().st_size > 1000
    assert drawn.kept[-1].get_suptitle() == r"$\frac{a$"
    titles = [axes.get_title(loc="left") for axes in drawn.kept[-1].axes]
    assert titles == [
        "the sound, log-mel",
        "mfcc, 2 columns, each against its own mean and spread",
        "f0, semitones from the median",
        "voicing",
        "mel, 2 columns",
    ]
    sound, cepstra, pitch, voicing, mel = drawn.kept[-1].axes
    spectrum = LogMel(n_mels=40).extract(wave).values.T
    assert np.asarray(sound.images[0].get_array()) == pytest.approx(spectrum)
    shown = np.asarray(cepstra.images[0].get_array())
    assert shown.mean(axis=1) == pytest.approx([0, 0], abs=1e-4)
    assert shown.std(axis=1) == pytest.approx([1, 1], abs=1e-4)
    assert cepstra.images[0].origin == "lower" and cepstra.get_aspect() == "auto"
    light, dark = (sum(cepstra.images[0].get_cmap()(end)[:3]) for end in (0.0, 1.0))
    assert dark < light - 1, "more is darker"
    # Frames of 20 ms about their times, one row a column.
    assert tuple(cepstra.images[0].get_extent()) == pytest.approx((0.0, 2.0, 0, 2))
    assert cepstra.images[0].get_clim() == pytest.approx(
        np.quantile(shown, [0.01, 0.995]), rel=1e-4
    )
    assert np.asarray(mel.images[0].get_array())[:, 0].tolist() == [1, 3]
    x, y = pitch.lines[0].get_data()
    assert x == pytest.approx(times) and np.isnan(y[50:]).all()
    assert y[:50] == pytest.approx(columns["f0"][:50], abs=1e-5)
    assert voicing.lines[0].get_ydata() == pytest.approx(voiced)
    assert {axes.get_xlim() for axes in drawn.kept[-1].axes} == {(0, 2)}
    size = voicing.figure.get_size_inches()
    assert size[0] == 8.0 and 6.1 < size[1] < 6.6
    heights = [axes.get_window_extent().height for axes in drawn.kept[-1].axes]
    assert heights[0] > 1.1 * heights[1] > 1.25 * heights[2]
    assert heights[2:4] == pytest.approx(heights[3:1:-1]) and heights[1] == heights[4]
    assert [len(axes.get_yticks()) for axes in (sound, cepstra, mel)] == [0, 0, 0]
    assert b"gesturekit" in path.read_bytes()


def test_features_of_a_long_silence_and_few_frames_are_drawn(drawn, tmp_path):
    """Two frames, 20 ms apart, last 40 ms; silence has one colour."""
    silence = Wave(np.zeros(16_000 * 20, np.float32), 16_000)
    values = np.array([[1.0, 1.0, 5.0], [1.0, 1.0, 7.0]], np.float32)
    times, names = np.array([0.01, 0.03]), ("a$x_0", "a$x_1", "f0")
    for frames, end in ((2, 0.04), (1, 0.02)):
        track = FeatureTrack(values[:frames], times[:frames], names=names)
        draw_features(track, tmp_path / "f.png", silence)
        sound, bands, pitch = drawn.kept[-1].axes
        assert drawn.kept[-1].get_size_inches()[0] == pytest.approx(14.0)
        assert bands.images[0].get_extent()[1] == pytest.approx(end)
        assert np.asarray(bands.images[0].get_array()).tolist() == [[0] * frames] * 2
        assert pitch.lines[0].get_ydata().tolist() == [5.0, 7.0][:frames]
        low, high = sound.images[0].get_clim()
        assert 0 < high - low < 1e-3


def test_lines_of_features_are_named_with_their_units(drawn, tmp_path):
    """A minute would be 42 inches wide; columns of one scale are shown as they are."""
    units = {"energy": "dB of active speech", "f0_range": "semitones", "voicing": None}
    names = (*units, "chroma_0", "chroma_1", "chroma_2", "chroma_10")
    values = np.arange(3)[:, None] + np.arange(len(names), dtype=np.float32)
    track = FeatureTrack(values, [0.0, 30.0, 60.0], names=names)
    draw_features(track, tmp_path / "f.png", Wave(np.zeros(240_000, np.float32), 4_000))
    rows = drawn.kept[-1].axes[1:]
    titles = [name if unit is None else f"{name}, {unit}" for name, unit in units.items()]
    assert [axes.get_title(loc="left") for axes in rows] == [*titles, "chroma, 4 columns"]
    assert drawn.kept[-1].get_size_inches()[0] == 40.0
    np.testing.assert_array_equal(rows[-1].images[0].get_array(), values[:, -4:].T)
    assert rows[1].lines[0].get_ydata().tolist() == [1, 2, 3]
