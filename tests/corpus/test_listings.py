"""Listings of public corpora, made of empty files that have the published names."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from published import INFO

from gesturekit.corpus.layouts import read_layout
from gesturekit.corpus.layouts.listing import Listing
from gesturekit.errors import CorpusError


@pytest.fixture
def touch(tmp_path) -> Callable[..., None]:
    """touch("a/b.wav c.bvh", text=""): files below the temporary folder."""

    def make(names: str, text: str = "") -> None:
        for name in names.split():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text, encoding="utf-8")

    return make


def problems(listing: Listing) -> list[tuple[str, str, str]]:
    """Return severity, name of the file or folder, and message of each problem."""
    return [(one.severity, one.file.name, one.message) for one in listing.problems]


def names(files: Sequence[Path]) -> list[str]:
    return [file.name for file in files]


def test_emotions_of_beat2_follow_the_number_of_the_first_sentence(tmp_path, touch):
    firsts = (1, 64, 65, 72, 73, 80, 81, 86, 87, 94, 95, 102, 103, 110, 111, 118, 119)
    stems = [f"2_scott_0_{n}_{n}" for n in firsts]
    rows = "".join(f"{stem},train\n" for stem in stems)
    touch("train_test_split.csv", f"id,type\n{rows}")
    touch(" ".join(f"smplxflame_30/{stem}.npz wave16k/{stem}.wav" for stem in stems))
    found = read_layout("beat2", tmp_path)
    assert [one.style for one in found.recordings] == [
        *("neutral", "neutral", "happiness", "happiness", "anger", "anger", "sadness", "sadness"),
        *("contempt", "contempt", "surprise", "surprise", "fear", "fear", "disgust", "disgust"),
        "neutral",
    ]
    assert {one.speaker for one in found.recordings} == {"scott"} and found.fps == 30


GAITS = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")


def cuts(*rows: tuple[str, str, str]) -> str:
    head = ",".join(f"{gait}_{end}" for gait in GAITS for end in ("START", "STOP"))
    lines = [f"{style},{','.join([start, stop] * len(GAITS))},note" for style, start, stop in rows]
    return "\n".join([f"STYLE_NAME,{head},MORE", *lines])


def test_cuts_of_100style_are_frames_at_sixty_a_second(tmp_path, touch):
    touch("Frame_Cuts.csv", cuts(("Old", "0", "90"), ("Sad", "N/A", "nan"), ("Shy", "", "")))
    touch("Old/Old_TR3.bvh Sad/Sad_ID.bvh Shy/Shy_BR.bvh Old/Old_XX.bvh New/New_BR.bvh")
    found = read_layout("100style", tmp_path)
    (one,) = found.recordings
    assert (one.id, one.style, one.limits, one.audio) == ("Old/Old_TR3", "Old", (0.0, 1.5), None)
    assert names(found.left_over) == ["New_BR.bvh", "Old_XX.bvh"] and found.fps == 60
    absent, uncut = problems(found)
    assert absent[:2] == ("error", "Frame_Cuts.csv") and "9 " in absent[2]
    assert all(f"Old_{gait}.bvh" in absent[2] for gait in GAITS[:-1])
    assert uncut[:2] == ("note", tmp_path.name) and "Sad_ID.bvh" in uncut[2]
    for start, stop in (("3", "3"), ("-1", "5"), ("3", ""), ("x", "5"), ("nan", "5")):
        touch("Frame_Cuts.csv", cuts(("Old", start, stop)))
        with pytest.raises(CorpusError, match="(?=.*line 2).*BR_START"):
            read_layout("100style", tmp_path)


def test_cleaned_files_of_zeggs_come_before_the_original_ones(tmp_path, touch):
    touch("z/clean/001_Sad_0_x_1_0.bvh z/clean/001_Sad_0_x_1_0.wav z/original/002_Sad_1.bvh")
    row = "a,0:0:0:0,0:0:0:0,Grief,0:0:0:0,0:0:1:0,001_Sad_0.bvh,true\n"
    touch("z/info.csv", INFO + row)
    # The folder that holds it, its own, and the one below the table.
    for folder in (tmp_path, tmp_path / "z", tmp_path / "z" / "clean"):
        (one,) = read_layout("zeggs", folder).recordings
        assert (one.id, one.style, one.split) == ("001_Sad_0_x_1_0", "Grief", "valid")
    (tmp_path / "z" / "info.csv").unlink()
    found = read_layout("zeggs", tmp_path)
    assert (found.recordings[0].style, found.recordings[0].split) == ("Sad", None)
    assert any(severity == "note" and "split" in text for severity, _, text in problems(found))


@pytest.mark.parametrize(
    ("times", "turns", "offset", "limits", "audible"),
    [
        (
            "01:02:03:15 01:02:04:45 01:02:05:00 01:03:04:30",
            "R1,01:02.250,01:03.5\nM,00:01.0,00:02.0",
            *(4.75 - 3.5, (0.25, 59.75), ((62.25, 63.5),)),
        ),
        ("00:59:59:00 01:00:00:00 01:00:00:00 01:00:01:00", "", 1.0, (0.0, 1.0), ()),
        ("0:0:0:0 0:0:1:0 0:0:0:59 0:0:2:0", "", "-0.02", None, None),
        ("0:0:0:0 0:0:1 0:0:2:0 0:0:3:0", "", "'0:0:1'", None, None),
        ("0:0:0:0 0:0:1:0 0:0:1:0 0:0:2:0", "R,00:02.0,soon", "'soon'", None, None),
    ],
)
def test_time_codes_of_zeggs_have_hours_and_frames(
    tmp_path, touch, times, turns, offset, limits, audible
):
    """Sound counts 30 frames a second, motion and acting 60."""
    touch("original/001_Neutral_0.bvh original/001_Neutral_0.wav")
    touch("original/001_Neutral_0.csv", f"#,Start,End\n{turns}\n")
    audio, anim, acting, end = times.split()
    row = f"001_Neutral_0.wav,{audio},{anim},Neutral,{acting},{end},001_Neutral_0.bvh,FALSE\n"
    touch("info.csv", INFO + row)
    found = read_layout("zeggs", tmp_path)
    if limits is None:
        assert found.recordings == [] and offset in str(problems(found))
        return
    (one,) = found.recordings
    assert one.audio_offset == pytest.approx(offset) and one.limits == pytest.approx(limits)
    assert one.audible == audible
