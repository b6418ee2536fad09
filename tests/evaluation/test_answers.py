"""Votes of user studies, as they are read."""

import csv
import re
from pathlib import Path

import pytest

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import GENEA_COLUMNS, read_answers, read_ratings

# Lines as in battles_elo.csv and battles_mismatch.csv of GENEA's public analysis.
GENEA = (
    ",".join(GENEA_COLUMNS) + "\n"
    '56b7,10_kieks_0_73,Seamless,BEAT2,model_a,True,"[""MotionSmoothness""]",\n'
    "56b7,13_lu_0_95,BEAT2,Seamless,tie,,{},\n"
    '5c04,13_lu_0_81,SemanticGesticulator,Seamless,model_b,False,"[""MotionOther"",'
    '""RecognisableGestures""]","""Right has a glitch, but\nis better."""\n'
    "5c04,6_carla,RAG-Gesture,AMUSE,tie,False,[],\n"
    '6741,11_nidal,BEAT_Mismatched,BEAT,model_b,False,"[""FitRhythmTiming""]",\n'
)
HEAD = ",".join(GENEA_COLUMNS) + "\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_the_public_format_of_genea_is_read(tmp_path):
    found = read_answers([write(tmp_path / "battles.csv", GENEA)])
    assert [a.score for a in found.kept] == [2, 0, -1, 0, -1]
    assert [a.matched for a in found.kept] == [None] * 4 + ["BEAT"]
    assert found.kept[0].reasons == ("MotionSmoothness",)
    assert found.kept[2].reasons == ("MotionOther", "RecognisableGestures")
    assert found.kept[1].user == "56b7" and found.kept[1].clip == "13_lu_0_95"
    assert not found.has_checks and not found.excluded and not found.notes


def test_tables_saved_by_a_spreadsheet_are_read(tmp_path):
    path = tmp_path / "é ä.csv"
    path.write_bytes(b"\xef\xbb\xbf" + GENEA.replace("\n", "\r\n").encode())
    assert len(read_answers([path]).kept) == 5
    path.write_text(",".join(GENEA_COLUMNS).replace(",", ";") + "\nu;c;a;b;model_b;True;{};\n")
    assert [answer.score for answer in read_answers([path]).kept] == [-2]
    path.write_text("\t".join(GENEA_COLUMNS) + "\nu\tc, d\ta\tb\tmodel_a\tTrue\t{}\t\n")
    assert [(a.clip, a.score) for a in read_answers([path]).kept] == [("c, d", 2)]


def test_a_rater_who_took_part_twice_is_named(tmp_path):
    head = HEAD.replace("\n", ",study,finished\n")
    for day, winner in enumerate(("model_a", "tie", "tie")):
        line = f"p{day // 2},c,x,y,{winner},False,{{}},,study,2026-01-0{day}T10:00:00Z\n"
        write(tmp_path / f"{day}.csv", head + line + line.replace(",c,", ",d,"))
    found = read_answers([tmp_path])
    assert len(found.kept) == 6
    assert any(re.search(r"\b1\b", note) and "p0" in note for note in found.notes)


def ours(path: Path, user: str, failed: int, winner: str = "model_a") -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*GENEA_COLUMNS, "checks", "checks_failed", "style"])
        writer.writeheader()
        for clip in "pq":
            writer.writerow(
                {"user": user, "input_code": clip, "model_a": "x", "model_b": "y",
                 "winner": winner, "is_strong": "False", "checks": 2, "checks_failed": failed}
            )  # fmt: skip
    return path


def test_raters_who_failed_attention_checks_are_excluded_and_named(tmp_path):
    for user, failed in (("good", 0), ("half", 1), ("bad", 2)):
        ours(tmp_path / f"{user}.csv", user, failed)
    by_default = read_answers([tmp_path])
    assert {a.user for a in by_default.kept} == {"good"}
    reasons = by_default.excluded
    assert "1 of 2" in reasons["half"] and "2 of 2" in reasons["bad"] and "good" not in reasons
    assert by_default.has_checks
    as_in_the_paper = read_answers([tmp_path], failed_checks=2)
    assert {a.user for a in as_in_the_paper.kept} == {"good", "half"}
    assert len(read_answers([tmp_path], failed_checks=None).kept) == 6


def test_a_file_read_twice_counts_once(tmp_path):
    one = ours(tmp_path / "one.csv", "u", 0)
    copy = write(tmp_path / "copy (1).csv", one.read_text())
    found = read_answers([one, copy, one])
    assert len(found.kept) == 2
    assert any(re.search(r"\b2\b", note) for note in found.notes)


def test_a_table_made_by_hand_may_name_the_winner(tmp_path):
    text = HEAD + "u,c,Mine,x,Mine,strong,,\nu,d,Mine,x,x,no,,\nu,e,Mine,x,Draw,,,\n"
    found = read_answers([write(tmp_path / "x.csv", text)])
    assert [a.score for a in found.kept] == [2, -1, 0]


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("", ["user", "input_code", "this one has nothing"]),
        ("user,input_code,model_A,model_b,winner,is_strong\n", ["model_A"]),
        (HEAD, ["answer"]),
        (HEAD + "u,c,a,b,left,True,,\n", ["line 2", "winner", "left", "model_a"]),
        (HEAD + "u,c,a,b,model_a,perhaps,,\n", ["line 2", "is_strong", "perhaps"]),
        (HEAD + "u,c,a,b,model_a,True,,\nu,c,a\n", ["line 3", " 3 ", "8"]),
        (HEAD.strip() + ",checks,checks_failed\nu,c,a,b,tie,,,,2,x\n", ["checks_failed", "'x'"]),
        (HEAD + 'u,c,a,b,model_a,True,"open', ["UTF-8"]),
    ],
)
def test_invalid_tables_of_answers_are_refused_with_their_place(tmp_path, text, facts):
    with pytest.raises(EvaluationError) as refused:
        read_answers([write(tmp_path / "x.csv", text)])
    said = str(refused.value).replace(str(tmp_path), "")
    assert all(fact in said for fact in ("x.csv", *facts))


def test_missing_files_empty_folders_and_other_encodings_are_refused(tmp_path):
    with pytest.raises(EvaluationError, match="absent.csv"):
        read_answers([tmp_path / "absent.csv"])
    with pytest.raises(EvaluationError, match=r"\.csv"):
        read_answers([tmp_path])
    (tmp_path / "x.csv").write_bytes("é".encode("latin-1"))
    with pytest.raises(EvaluationError, match="x.csv.*UTF-8"):
        read_answers([tmp_path])


def test_deeply_nested_json_reasons_are_ignored(tmp_path):
    text = HEAD + f"u,c,a,b,model_a,True,{'[' * 100_000},\n"
    assert read_answers([write(tmp_path / "x.csv", text)]).kept[0].reasons == ()


def test_empty_lines_spaces_and_files_named_twice_do_not_matter(tmp_path):
    text = " user ," + HEAD[5:] + "\n u , c ,a,b, MODEL_A ,TRUE,,\n ,,,\n"
    path = write(tmp_path / "x.csv", text)
    (answer,) = read_answers([path, tmp_path, tmp_path / ".." / tmp_path.name / "x.csv"]).kept
    assert (answer.user, answer.clip, answer.score) == ("u", "c", 2)
    with pytest.raises(EvaluationError, match="CSV"):
        read_answers([])
    with (tmp_path / "large.csv").open("wb") as file:
        file.truncate((200 << 20) + 1)
    with pytest.raises(EvaluationError, match="large.csv.*200 MiB"):
        read_answers([tmp_path / "large.csv"])


def test_votes_are_read_as_ratings_of_both_systems(tmp_path):
    text = HEAD + "u,c,a,b,model_a,True,,\nu,d,a,b,tie,,,\nv,c,b,a,model_a,False,,\n"
    found = read_ratings([write(tmp_path / "x.csv", text)])
    shown = [(found.systems[s], value) for s, value in zip(found.system, found.value)]
    assert shown == [("a", 1.0), ("b", 0.0), ("a", 0.5), ("b", 0.5), ("b", 1.0), ("a", 0.0)]
    assert found.paired and found.raters == ("u", "v") and found.clips == ("c", "d")
