"""Faces on the human body: in pictures, videos and pages."""

import base64
import zlib
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
from pages import bundled, data_of, opened, unpacked
from rigs import PERSON, at_rest, rig_of

from gesturekit.motion import FaceTrack, Motion
from gesturekit.viewer import human, write_html, write_picture, write_video

BLINK = {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}


def with_face(*frames: dict[str, float]) -> Motion:
    """Return a person who stands still, with channels of each frame; one that is missing is 0."""
    names = tuple(sorted({name for frame in frames for name in frame}))
    values = [[frame.get(name, 0.0) for name in names] for frame in frames]
    face = FaceTrack(names, values) if names else None
    return replace(at_rest(rig_of(PERSON), len(frames), (0, 1.0, 0)), face=face)


def picture(folder: Path, *frames: dict[str, float]) -> np.ndarray:
    """Return the middle of a picture of the body in one frame, (H, W, 3) from 0 to 1."""
    path = folder / "still.png"
    write_picture(with_face(*frames), path, body="human", frames=1)
    image = matplotlib.image.imread(path)[..., :3]
    quarter = image.shape[1] // 4
    return image[:, quarter : 3 * quarter]


def body_rows(image: np.ndarray) -> tuple[int, float]:
    """Return the row of the crown, and the rows that the body takes."""
    drawn = np.flatnonzero((image.min(axis=2) < 0.8).sum(axis=1) > 5)
    last = drawn[np.flatnonzero(np.diff(drawn) > 1)[0]]
    return drawn[0], last - drawn[0]


def test_an_open_jaw_changes_the_picture_at_the_mouth_alone(tmp_path) -> None:
    closed, opened = picture(tmp_path, {}), picture(tmp_path, {"jawOpen": 1.0})
    crown, height = body_rows(closed)
    rows, columns = np.nonzero(np.abs(closed - opened).max(axis=2) > 0.02)
    # Of 1.66 m, the nose ends 14 cm and the open chin 25 cm below the crown.
    assert crown + 0.06 * height < rows.min() and rows.max() < crown + 0.16 * height
    assert np.ptp(columns) < 0.14 * height
    red, green, _ = np.moveaxis(opened[rows, columns], -1, 0)
    assert ((red > 1.8 * green) & (red < 0.45)).sum() > 10  # the inside of the mouth


def test_closed_lids_cover_the_eyes(tmp_path, read_video) -> None:
    motion = with_face({}, {"eyeBlinkLeft": 1.0}, BLINK)
    write_video(motion, path := tmp_path / "a.mp4", body="human", framing="face", size="1080p")
    opened, left, both = read_video(path)[0].astype(int)[:, :900]  # above the time
    rows, columns = np.nonzero(np.abs(opened - both).max(axis=2) > 60)
    area = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    # Grey pixels are those of the eyeballs, white or dark; skin is redder.
    grey = [(np.ptp(image[area], axis=2) < 20).sum() for image in (opened, left, both)]
    assert grey[0] > 1000 and 0.2 < grey[1] / grey[0] < 0.8 and grey[2] == 0
    # The left eye is the person's own, on the right of a picture from the front.
    changed = np.nonzero(np.abs(opened - left).max(axis=2) > 60)[1]
    assert changed.min() > columns.mean()


def test_channels_move_the_skin_as_they_are_named() -> None:
    skin = human.load_human()[1][0]
    iris = skin.regions == list(human.COLOURS).index("iris")
    is_left = skin.vertices[:, 0] > 0

    def moves(channel: str) -> np.ndarray:
        out = np.zeros(skin.vertices.shape)
        out[skin.morphs[channel].vertices] = skin.morphs[channel].offsets
        return out

    for channel, axis, sign in (("Out", 0, 1), ("In", 0, -1), ("Up", 1, 1), ("Down", 1, -1)):
        moved = moves(f"eyeLook{channel}Left")[iris]
        assert (sign * moved[is_left[iris], axis] > 0.002).all()
        assert not moved[~is_left[iris]].any()
    assert -0.045 < moves("jawOpen")[:, 1].min() < -0.025
    together = moves("jawOpen") + moves("mouthClose")
    lips = skin.regions == list(human.COLOURS).index("lips")
    assert np.abs(together[lips]).max() < 0.01
    for channel in skin.morphs:
        assert not np.isin(
            skin.morphs[channel].vertices, np.flatnonzero(skin.vertices[:, 1] < 1.3)
        ).any()


def test_a_video_shows_the_face_of_each_frame_from_near(tmp_path, read_video) -> None:
    motion = with_face({}, {"jawOpen": 1.0}, {})
    for framing in ("waist", "face"):
        write_video(motion, tmp_path / f"{framing}.mp4", body="human", framing=framing)
    (waist, _), (near, _) = (read_video(tmp_path / f"{name}.mp4") for name in ("waist", "face"))
    dark = [((f[..., 0] > 1.6 * f[..., 1]) & (f[..., 0] < 120)).sum() for f in near.astype(int)]
    assert dark[1] > 100 and max(dark[0], dark[2]) < 0.2 * dark[1]
    skin = [(f[0][..., 0] > f[0][..., 2] + 30).sum() for f in (waist.astype(int), near.astype(int))]
    assert skin[1] > 2 * skin[0]


def test_a_page_carries_the_channels_that_move_the_body(tmp_path) -> None:
    plain, path = tmp_path / "plain.html", tmp_path / "face.html"
    frames = [{"jawOpen": 0.5, "cheekPuff": 1.0}, {"eyeBlinkLeft": 1.0, "jawOpen": 0.25}]
    write_html({"a": with_face(*frames), "b": with_face({}, {})}, path, body="human")
    write_html({"a": with_face({}, {}), "b": with_face({}, {})}, plain, body="human")
    page = data_of(path)
    first, second = (figure["skin"] for figure in page["figures"])
    morphs = {each["channel"]: each for each in page["skin"]["levels"][0]["morphs"]}
    assert list(morphs) == ["jawOpen", "eyeBlinkLeft"]
    values = np.frombuffer(zlib.decompress(base64.b64decode(first["face"])), np.uint8)
    assert values.tolist() == [128, 0, 64, 255]
    assert "face" not in second
    jaw, skin = morphs["jawOpen"], human.load_human()[1][0]
    steps = unpacked(jaw["offsets"], jaw["n_vertices"]).astype(np.int16)
    np.testing.assert_allclose(jaw["step"] * steps, skin.morphs["jawOpen"].offsets, atol=2e-6)
    assert unpacked(jaw["vertices"], jaw["n_vertices"])[:, 0].tolist() == (
        skin.morphs["jawOpen"].vertices.tolist()
    )
    without = data_of(plain)
    assert "morphs" not in without["skin"]["levels"][0]
    assert "face" not in without["figures"][0]["skin"]


def test_all_channels_take_little_room(tmp_path) -> None:
    names = human.load_human()[1][0].morphs
    sizes = []
    for frame in ({}, dict.fromkeys(names, 1.0)):
        write_html(with_face(*[frame] * 30), path := tmp_path / "a.html", body="human")
        sizes.append(path.stat().st_size)
    assert sizes[1] - sizes[0] < 180_000
    assert human.FILE.stat().st_size < 400_000


@bundled
def test_the_player_moves_the_face(tmp_path, open_browser) -> None:
    write_html(with_face({}, {"jawOpen": 1.0}), tmp_path / "a.html", body="human", framing="face")
    browser, shots = opened(open_browser, tmp_path / "a.html", "t=0"), []
    for frame in range(2):
        browser.run(f"player.seek({frame} / 30)")
        browser.wait(f"document.getElementById('time').textContent.includes('frame {frame}')")
        browser.run(
            "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )
        browser.screenshot(tmp_path / "page.png")
        shots.append(matplotlib.image.imread(tmp_path / "page.png")[..., :3])
    assert browser.lines == []
    red, green, _ = np.moveaxis(shots[1], -1, 0)
    mouth = (red > 2 * green) & (red < 0.45)
    assert mouth.sum() > 200
    red, green, _ = np.moveaxis(shots[0][mouth], -1, 0)
    assert ((red > 2 * green) & (red < 0.45)).mean() < 0.2
