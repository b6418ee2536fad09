"""Listings of public corpora, made of empty files that have the published names."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from published import INFO

from gesturekit.corpus.layouts import read_layout
from gesturekit.corpus.layouts.listing import Listing
from gesturekit.corpus.layouts.zeggs import read_zeggs
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


def ids(listing: Listing) -> list[str]:
    return [one.id for one in listing.recordings]


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


def test_files_that_beat2_lacks_are_errors_and_words_that_it_lacks_are_not(tmp_path, touch):
    rows = "1_ann_0_1_1,train\nodd,train\n1_ann_0_5_5,additional\n1_ann_0_2_2,test\n"
    touch("train_test_split.csv", f"id,type\n{rows}1_ann_0_3_3,test\n1_ann_0_4_4,val\n")
    touch("smplxflame_30/1_ann_0_3_3.npz smplxflame_30/1_ann_0_4_4.npz smplxflame_30/z.npz")
    touch("smplxflame_30/1_ann_0_5_5.npz wave16k/b.wav wave16k/1_ann_0_1_1.wav")
    touch("wave16k/1_ann_0_2_2.wav wave16k/1_ann_0_4_4.wav sem/1_ann_0_4_4.txt")
    touch("textgrid/1_ann_0_2_2.TextGrid")
    found = read_layout("beat2", tmp_path)
    # Sound of the test split is enough, of the others it is not.
    assert [(one.id, one.split, one.motion and one.motion.stem) for one in found.recordings] == [
        ("1_ann_0_2_2", "test", None),
        ("1_ann_0_4_4", "valid", "1_ann_0_4_4"),
    ]
    assert [set(one.conditions) for one in found.recordings] == [{"words"}, {"semantics"}]
    index = "train_test_split.csv"
    odd, *rest = problems(found)
    assert odd[:2] == ("error", index) and "line 3: id 'odd' is no SPEAKER_NAME" in odd[2]
    lost = "1_ann_0_1_1.{0}, 1_ann_0_{1}.{0}"
    assert rest == [
        ("error", index, f"not there: 2 npz files: {lost.format('npz', '2_2')}"),
        ("error", index, "not there: 1 wav file: 1_ann_0_3_3.wav"),
        ("note", index, f"not there: 3 TextGrids: {lost.format('TextGrid', '3_3')}, "
                        "1_ann_0_4_4.TextGrid"),
        ("note", index, f"not there: 3 sem files: {lost.format('txt', '2_2')}, 1_ann_0_3_3.txt"),
        ("note", index, "of type additional, in no split and left out: 1: 1_ann_0_5_5"),
    ]  # fmt: skip
    assert names(found.left_over) == ["z.npz", "b.wav"]


def test_tables_of_genea_may_have_fewer_columns_or_be_absent(tmp_path, touch):
    main = "main-agent/{0}/{1}_main-agent.{0}"
    for split, stems in {"trn": "abc", "tst": "de"}.items():
        for stem in stems:
            touch(f"{split}/{main.format('wav', stem)}")
    touch(f"trn/{main.format('bvh', 'a')} trn/{main.format('bvh', 'b')}")
    touch(f"trn/{main.format('bvh', 'x')} trn/{main.format('tsv', 'b')}")
    touch(f"tst/{main.format('bvh', 'e')} tst/interloctr/bvh/d_interloctr.bvh")
    touch("trn/metadata.csv", "NAME,Who,Fingers\na,7,finger_incl\nb,8,none\nz,9,finger_incl\n")
    found = read_layout("genea2023", tmp_path)
    about = [(one.id, one.split, one.speaker, one.motion and one.motion.stem, set(one.conditions))
             for one in found.recordings]  # fmt: skip
    assert about == [
        ("trn/a_main-agent", "train", "7", "a_main-agent", set()),
        ("trn/b_main-agent", "train", "8", "b_main-agent", {"words"}),
        ("tst/d_main-agent", "test", None, None, {"partner_motion"}),
        ("tst/e_main-agent", "test", None, "e_main-agent", set()),
    ]
    assert problems(found) == [
        ("error", "wav", "not there: 2 wav files: x_main-agent.wav, z_main-agent.wav"),
        ("error", "bvh", "not there: 1 bvh file: c_main-agent.bvh"),
        ("note", "tsv", "not there: 1 tsv file: a_main-agent.tsv"),
        ("note", "trn", "fingers were not recorded (metadata.csv): 1: b_main-agent"),
        ("warning", "tst", "not there: 1 table: metadata.csv"),
        ("note", "tsv", "not there: 2 tsv files: d_main-agent.tsv, e_main-agent.tsv"),
        ("note", tmp_path.name, "not there: 1 split: val"),
    ]
    assert found.fps == 30
    touch("trn/metadata.csv", "name,who\na,7\n")
    fingers = [text for *_, text in problems(read_layout("genea2023", tmp_path)) if "fing" in text]
    assert fingers == ["fingers were not recorded (metadata.csv): 1: a_main-agent"]


def test_dances_with_every_form_of_the_released_names_are_read(tmp_path, touch):
    forms = {
        "kthjazz_gCH_sFM_cAll_d02_mCH_ch01_royalgardenblues_002": ("gCH", "d02"),
        "kthjazz_gTP_sFM_sngl_d02_015": ("gTP", "d02"),
        "kthmisc_gTP_sFM_sngl_d07_012": ("gTP", "d07"),
        "kthmisc_gCA_sFM_cAll_d01_mCA_ch24": ("gCA", "d01"),
        "kthstreet_gKR_sFM_cAll_d01_mKR1_ch01": ("gKR", "d01"),
        "kthstreet_gLH_sFM_cAll_d01_mLH_ch01_danstrams": ("gLH", "d01"),
    }
    touch(" ".join(f"{name}.bvh" for name in forms))
    found = read_layout("motorica", tmp_path)
    assert {one.id: (one.style, one.speaker) for one in found.recordings} == forms
    assert not found.left_over


def test_dances_that_have_no_name_of_motorica_are_left_over(tmp_path, touch):
    name = "kthmisc_gCH_sFM_cAll_d{}_mCH_ch{}_x"
    touch(f"a/{name.format('02', 1)}.bvh {name.format('11', 2)}.bvh z.bvh b/{name.format('02', 1)}")
    touch(f"wav/{name.format('02', 1)}.wav wav/other.wav")
    found = read_layout("motorica", tmp_path)
    about = {(one.id, one.style, one.speaker, bool(one.audio)) for one in found.recordings}
    assert about == {
        (name.format("02", 1), "gCH", "d02", True), (name.format("11", 2), "gCH", "d11", False)
    }  # fmt: skip
    assert names(found.left_over) == ["z.bvh", "other.wav"] and found.fps == 120
    (silent,) = problems(found)
    assert silent[0] == "note" and f"1 wav file (motion alone): {name.format('11', 2)}" in silent[2]


GAITS = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")


def cuts(*rows: tuple[str, str, str]) -> str:
    """Return a table with the same two cells for each gait."""
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
    files = ", ".join(f"Old_{gait}.bvh" for gait in GAITS[:-1])
    assert absent == ("error", "Frame_Cuts.csv", f"not there: 9 bvh files: {files}")
    text = "without a cut in Frame_Cuts.csv, left out: 2: Sad_ID.bvh, Shy_BR.bvh"
    assert uncut == ("note", tmp_path.name, text)
    for start, stop in (("3", "3"), ("-1", "5"), ("3", ""), ("x", "5"), ("nan", "5")):
        touch("Frame_Cuts.csv", cuts(("Old", start, stop)))
        with pytest.raises(CorpusError, match="line 2: BR_START, BR_STOP are .*two frames"):
            read_layout("100style", tmp_path)


def test_trinity_may_be_its_inner_folder_and_names_what_is_left(tmp_path, touch):
    touch("bvh/Recording_001.bvh bvh/Recording_008.bvh bvh/x.bvh bvh/Recording_002.bvh")
    touch("audio/Recording_001.wav audio/Recording_008.wav audio/y.wav")
    found = read_layout("trinity", tmp_path)
    about = [(one.id, one.split, one.speaker) for one in found.recordings]
    assert about == [
        ("Recording_001", "train", "trinity"), ("Recording_008", "test", "trinity")
    ]  # fmt: skip
    assert names(found.left_over) == ["x.bvh", "y.wav"] and found.fps == 60
    assert problems(found) == [("error", "audio", "not there: 1 wav file: Recording_002.wav")]
    for name in ("001", "008"):
        (tmp_path / "audio" / f"Recording_{name}.wav").unlink()
    with pytest.raises(CorpusError, match=r"no recording of Trinity; .* bvh/Recording_001\.bvh"):
        read_layout("trinity", tmp_path)


def marked(tmp_path: Path, name: str, valid: Sequence[bool] | None) -> None:
    """Write the marks of a motion of Seamless Interaction, and its sound."""
    path = tmp_path / "naturalistic" / "test" / f"{name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **({} if valid is None else {"smplh:is_valid": np.array(valid)[:, None]}))
    path.with_suffix(".wav").touch()


def test_runs_of_valid_frames_of_a_second_are_recordings_of_their_own(tmp_path, touch):
    session = "V00_S0809_I00000582"
    marked(tmp_path, f"{session}_P1", [False] + [True] * 30 + [False] * 2 + [True] * 29 + [False])
    marked(tmp_path, f"{session}_P2", [True] * 29 + [False])
    marked(tmp_path, f"{session}_P3", [True] * 45)
    marked(tmp_path, "V00_S0810_I00000001_P1", None)
    touch("naturalistic/test/V00_S0811_I1_P1.npz naturalistic/test/V00_S0811_I1_P1.wav", "no npz")
    touch("naturalistic/test/V00_S0812_I1_P1.wav naturalistic/test/x.npz naturalistic/test/x.wav")
    touch(f"naturalistic/test/{session}_P1.json naturalistic/train/V00_S0812_I2_P1.npz")
    found = read_layout("seamless", tmp_path)
    at = "naturalistic/test/"
    one, other, alone, broken = found.recordings
    assert (one.id, one.limits) == (f"{at}{session}_P1@0.03-1.03", (1 / 30, 31 / 30))
    assert (one.take, one.speaker, one.style) == ("V00_S0809", "P1", "naturalistic")
    assert {one.split for one in found.recordings} == {"test"}
    assert {name: file.name for name, file in one.conditions.items()} == {
        "words": f"{session}_P1.json",
        "partner_motion": f"{session}_P2.npz",
        "partner_audio": f"{session}_P2.wav",
    }
    assert (other.id, other.limits) == (f"{at}{session}_P3", (0.0, float("inf")))
    partner = {"partner_motion", "partner_audio", "partner_words"}
    assert set(other.conditions) == partner and not alone.conditions
    assert (alone.take, broken.take) == ("V00_S0810", "V00_S0811")
    text = "{} of {} frames are marked invalid and left out"
    assert problems(found) == [
        ("error", "train", "not there: 1 wav file: V00_S0812_I2_P1.wav"),
        ("note", f"{session}_P1.npz", text.format(4, 63)),
        ("error", f"{session}_P2.npz", text.format(1, 30)),
        ("error", "test", "not there: 1 npz file: V00_S0812_I1_P1.npz"),
    ]
    assert names(found.left_over) == ["x.npz"] and found.fps == 30


def test_cleaned_files_of_zeggs_come_before_the_original_ones(tmp_path, touch):
    touch("z/clean/001_Sad_0_x_1_0.bvh z/clean/001_Sad_0_x_1_0.wav z/original/002_Sad_1.bvh")
    touch("z/clean/001_Sad_0_mirror_x_1_0.bvh z/clean/001_Sad_0_mirror_x_1_0.wav z/clean/z.bvh")
    touch("z/clean/001_Sad_0_x_1_1.bvh z/clean/003_Old_0_x_1_0.bvh z/clean/y.wav")
    rows = "".join(
        f"a,0:0:0:0,0:0:0:0,{style},0:0:0:0,0:0:1:0,{take}.bvh,{valid}\n"
        for take, style, valid in (("001_Sad_0", "Grief", "true"), ("004_Old_1", "Old", "False"),
                                   ("005_Old_1_mirror", "Old", "False"))
    )  # fmt: skip
    touch("z/info.csv", INFO + rows)
    # The folder that holds it, its own, and the one below the table.
    for folder in (tmp_path, tmp_path / "z", tmp_path / "z" / "clean"):
        found = read_layout("zeggs", folder)
        (one,) = found.recordings
        assert (one.id, one.style, one.split) == ("001_Sad_0_x_1_0", "Grief", "valid")
        assert (one.audio_offset, one.audible, one.speaker) == (0.0, (), "zeggs")
        assert problems(found) == [
            ("note", "clean", "mirrored or of another tempo, left out: 2: "
                              "001_Sad_0_mirror_x_1_0.bvh, 001_Sad_0_x_1_1.bvh"),
            ("error", "clean", "not there: 1 wav file: 003_Old_0_x_1_0.wav"),
            ("error", "info.csv", "not there: 1 take of info.csv: 004_Old_1"),
        ]  # fmt: skip
        assert names(found.left_over) == ["z.bvh", "y.wav"] and found.fps == 60
    (tmp_path / "z" / "info.csv").unlink()
    found = read_zeggs(tmp_path)
    assert (found.recordings[0].style, found.recordings[0].split) == ("Sad", None)
    assert problems(found)[-1][0] == "note" and "no published split" in problems(found)[-1][2]


def test_twenty_files_are_named_and_the_rest_is_counted(tmp_path):
    listing = Listing(30.0)
    for count in (0, 20, 21):
        listing.missing("file", (f"{k:02}" for k in range(count)), tmp_path, "error")
    listing.note("odd", ("b", "a"), tmp_path)
    listing.note("odd", (), tmp_path)
    twenty, more, odd = (text for *_, text in problems(listing))
    assert twenty.endswith(", 18, 19") and more.endswith(", 18, 19 and 1 more")
    assert more.startswith("not there: 21 files: 00, 01") and odd == "odd: 2: a, b"
