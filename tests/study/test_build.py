"""Configuration, clips and balanced lists of a study."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

import gesturekit.study.build as build_module
from gesturekit.errors import ConfigError
from gesturekit.evaluation.statistics.answers import GENEA_COLUMNS
from gesturekit.study import build_study
from gesturekit.study.build import CODES, REASONS
from gesturekit.study.clips import Segment, find_clips
from gesturekit.study.config import StudyConfig, load_study_config
from gesturekit.study.lists import make_lists, mismatches
from gesturekit.viewer import html as player_module


def segments(n: int, style: str = "", folder: str = "") -> list[Segment]:
    return [Segment(f"{folder}s{k:02d}{style}", {}, None, style) for k in range(n)]


def config_of(n_systems: int, **options) -> StudyConfig:
    return StudyConfig("Title", {f"s{k}": "unused" for k in range(n_systems)}, **options)


@pytest.mark.parametrize(
    ("styles", "each", "seed"), [(("",), 36, 0), *(("abcd", 18, seed) for seed in range(4))]
)
def test_four_systems_give_the_designs_of_the_paper(styles, each, seed):
    """36 segments, or four styles of 18: 12 ordered pairs, seen equally often within each list."""
    of_style = {"design": "style", "styles": dict.fromkeys(styles, "x")} if styles[0] else {}
    config = config_of(4, lists=24, seed=seed, **of_style)
    lists = make_lists(config, [one for style in styles for one in segments(each, style)])
    over_all, over_styles = Counter(), Counter()
    for one in lists:
        pairs = Counter((c.left, c.right) for c in one)
        assert len(pairs) == 12 and set(pairs.values()) == {each * len(styles) / 12}
        assert len({c.segment.name for c in one}) == each * len(styles)
        within = Counter((c.segment.style, c.left, c.right) for c in one)
        assert max(within.values()) - min(within.values()) <= 1
        over_styles += within
        over_all.update((c.segment.name, c.left, c.right) for c in one)
    assert set(over_styles.values()) == {2 * each}
    # 24 lists and 12 ordered pairs: each pair of each segment twice, or nearly so where the 18 of
    # a style are no multiple of 12.
    uses = Counter(over_all.values())
    assert set(uses) == {2} if each == 36 else set(uses) <= {1, 2, 3} and uses[2] >= 850


def test_shorter_lists_use_all_segments_equally_often():
    lists = make_lists(config_of(3, lists=30, pairs=7), segments(20))
    assert {len(one) for one in lists} == {7}
    used = Counter(c.segment.name for one in lists for c in one)
    assert len(used) == 20 and max(used.values()) - min(used.values()) <= 1
    pairs = Counter((c.left, c.right) for one in lists for c in one)
    assert len(pairs) == 6 and max(pairs.values()) - min(pairs.values()) <= 1
    assert make_lists(config_of(3, lists=30, pairs=7, seed=1), segments(20)) != lists
    assert make_lists(config_of(3, lists=30, pairs=7, seed=0), segments(20)) == lists


def test_a_mismatched_segment_needs_another(tmp_path):
    config = video_study(tmp_path, {"a": ["x.mp4"]}, design="mismatch")
    with pytest.raises(ConfigError, match="needs at least two segments, found 1"):
        build_study(config, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    config = video_study(tmp_path, {"a": ["y.mp4"]}, design="mismatch")
    assert build_study(config, tmp_path / "out").trials == 2


def test_styles_come_in_the_order_of_the_configuration():
    styles = {"sad": "sad", "happy": "happy", "old": "an old person"}
    found = make_lists(
        config_of(2, design="style", styles=styles, lists=3, pairs=10),
        [segment for style in ("happy", "old", "sad") for segment in segments(8, style)],
    )
    for one in found:
        shown = [comparison.segment.style for comparison in one]
        assert list(dict.fromkeys(shown)) == ["sad", "happy", "old"]
        assert sorted(Counter(shown).values()) == [3, 3, 4]


def test_every_column_and_code_of_the_answers_is_documented():
    root = Path(__file__).parents[2]
    page = (root / "docs" / "study.md").read_text(encoding="utf-8")
    script = (root / "gesturekit" / "study" / "page" / "results.js").read_text(encoding="utf-8")
    columns = re.findall(r'"(\w+)"', script.partition("COLUMNS = [")[2].partition("]")[0])
    assert tuple(columns[: len(GENEA_COLUMNS)]) == GENEA_COLUMNS and len(columns) == 21
    codes = [*CODES, *(code for reasons in REASONS.values() for code in reasons)]
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert not [name for name in columns if f"`{name}`" not in "".join(rows)]
    assert not [code for code in codes if f"`{code}`" not in page]


def test_mismatched_motion_is_another_clip_of_the_same_folder():
    clips = [*segments(5, folder="anna/"), *segments(4, folder="ben/"), *segments(1, folder="eve/")]
    found = mismatches(clips, seed=0)
    assert set(found) == {s.name for s in clips}
    assert all(other.name != name for name, other in found.items())
    same = [name for name, other in found.items() if other.speaker == name.split("/")[0]]
    assert len(same) >= 8
    # Alone with others that are alone: among them; the only one alone: in a folder's circle.
    three = [segment for name in ("x/", "y/", "z/") for segment in segments(1, folder=name)]
    found = mismatches([*segments(3, folder="anna/"), *three], seed=1)
    assert sorted(o.speaker for n, o in found.items() if n[0] in "xyz") == ["x", "y", "z"]
    assert all(other.name != name for name, other in found.items())
    assert mismatches(three[:2], 0) == {"x/s00": three[1], "y/s00": three[0]}
    for seed in range(4):
        found = mismatches(clips, seed)
        assert sorted(other.name for other in found.values()) == sorted(found)
        assert {found["eve/s00"].speaker} < {"anna", "ben"}
    assert len({str(mismatches(clips, seed)) for seed in range(4)}) > 1
    pairs = {(c.left, c.right) for one in make_lists(config_of(1, design="mismatch"), clips)
             for c in one}  # fmt: skip
    assert pairs == {("s0", "s0_Mismatched"), ("s0_Mismatched", "s0")}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("titel: x", "titel"),
        ("systems: {a: x, b: y}", "title is missing"),
        ("title: x\nsystems: {a: x}", "needs 2 or more"),
        ("title: x\nsystems: {a: x, b_Mismatched: y}", "choose another name"),
        ("title: x\nsystems: {a: x, b: 3}", "expected NAME: FOLDER"),
        ("title: x\nsystems: {a: x, b: y}\ndesign: prefer", "'prefer' is not one of"),
        ("title: x\nsystems: {a: x, b: y}\ndesign: style", "needs styles"),
        ("title: x\nsystems: {a: x, b: y}\nanswers: [better, worse]", "five are expected"),
        (
            'title: x\nsystems: {a: x, b: y}\npost_url: "javascript:alert(1)"',
            "is not a web address",
        ),
        (
            'title: x\nsystems: {a: x, b: y}\npost_url: "https://h; script-src *"',
            "not a web address",
        ),
        ("title: x\nsystems: {a: x, b: y}\npairs: 0", "at least 1"),
        ("title: x\nsystems: {a: x, b: y}\nattention_check: 3", "attention_checks"),
    ],
)
def test_a_wrong_configuration_is_named(tmp_path, text, message):
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(ConfigError, match="study.yaml") as refused:
        load_study_config(tmp_path / "study.yaml")
    assert message in str(refused.value)


TITLE = "</script><script>alert(1)</script>{{setup}}"


def video_study(folder: Path, clips: dict[str, list[str]], **options) -> StudyConfig:
    for system, names in clips.items():
        for name in names:
            (folder / system / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / system / name).write_bytes(f"{system} {name}".encode())
    return StudyConfig(TITLE, {name: str(folder / name) for name in clips}, **options)


def test_clips_are_matched_by_path_then_by_name_and_others_are_named(tmp_path):
    config = video_study(tmp_path, {"a": ["d/x y.mp4", "d/é.mp4"], "b": ["d/x y.webm", "d/z.mp4"]})
    with pytest.warns(UserWarning, match=r"1 clip (a|b): left out.*d/(é|z)"):
        found = find_clips(config)
    assert [segment.name for segment in found.segments] == ["d/x y"] and found.videos
    flat = video_study(tmp_path / "2", {"a": ["one/x.mp4"], "b": ["x.mp4"]})
    assert [segment.name for segment in find_clips(flat).segments] == ["x"]


def test_names_that_a_folder_has_twice_are_left_out(tmp_path):
    names = {"a": ["one/x.mp4", "two/x.mp4", "two/y.mp4"], "b": ["x.mp4", "y.mp4"]}
    with pytest.warns(UserWarning) as seen:
        found = find_clips(video_study(tmp_path, names))
    assert [str(w.message) for w in seen] == ["1 clip b: left out, as other systems lack them: x"]
    (segment,) = found.segments
    assert segment.clips == {"a": tmp_path / "a" / "two" / "y.mp4", "b": tmp_path / "b" / "y.mp4"}


def test_styles_are_found_in_folders_and_file_names(tmp_path):
    names = ["happy/1.mp4", "067_Very_Old_2.mp4", "very happy-3.mp4", "unhappy.mp4"]
    styles = {"happy": "happy", "very happy": "very happy", "old": "an old person"}
    config = video_study(tmp_path, {"a": names, "b": names}, design="style", styles=styles)
    with pytest.warns(UserWarning, match="unhappy"):
        found = {segment.name: segment.style for segment in find_clips(config).segments}
    (tmp_path / "none").mkdir()
    with pytest.raises(ConfigError, match="no segment is left for the study"), pytest.warns():
        names = {"a": ["x.mp4"], "b": ["x.mp4"]}
        find_clips(video_study(tmp_path / "none", names, design="style", styles=styles))
    expected = {"happy/1": "happy", "067_Very_Old_2": "old", "very happy-3": "very happy"}
    assert found == expected


@pytest.mark.parametrize(
    ("clips", "message"),
    [
        ({"a": ["x.mp4"], "b": ["y.mp4"]}, "no clip of the same name"),
        ({"a": ["x.mp4"], "b": ["x.bvh"]}, r"of one kind.*\(a: videos, b: motions\)"),
        ({"a": ["x.bvh"], "b": ["x.mp4"]}, r"of one kind.*\(a: motions, b: videos\)"),
        ({"a": ["x.mp4"], "b": ["x.txt"]}, "has no mp4, webm, bvh or npz"),
    ],
)
def test_folders_that_do_not_fit_are_refused(tmp_path, clips, message):
    with pytest.raises(ConfigError, match=message):
        find_clips(video_study(tmp_path, clips))
    with pytest.raises(ConfigError, match="systems: a: .*absent is not a folder"):
        find_clips(StudyConfig("T", {"a": str(tmp_path / "absent"), "b": str(tmp_path / "b")}))


def test_a_body_is_of_the_package_or_an_avatar_beside_the_file_and_for_motions(tmp_path):
    with pytest.raises(ConfigError, match=r"body: 'robot'; expected mannequin, .*\.vrm"):
        config_of(2, body="robot")
    (tmp_path / "study.yaml").write_text("title: T\nbody: me.vrm\nsystems: {a: a, b: b}\n")
    assert load_study_config(tmp_path / "study.yaml").body == str(tmp_path / "me.vrm")
    config = video_study(tmp_path, {"a": ["x.mp4"], "b": ["x.mp4"]}, body="human")
    with pytest.raises(ConfigError, match="body: human is for motions; the clips are videos"):
        build_study(config, tmp_path / "out")


def test_a_body_of_the_package_is_no_path(tmp_path):
    (tmp_path / "study.yaml").write_text("title: T\nbody: human\nsystems: {a: a, b: ../b}\n")
    config = load_study_config(tmp_path / "study.yaml", ("title=U", "seed=3"))
    assert (config.title, config.body, config.seed) == ("U", "human", 3)
    assert Path(config.systems["a"]) == tmp_path / "a"
    assert Path(config.systems["b"]).resolve() == (tmp_path.parent / "b").resolve()


def setup_of(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'id="setup">(.*?)</script>', text, re.S)[1])


def test_clip_names_do_not_reveal_the_system(tmp_path):
    names = [f"speaker/clip {k}.mp4" for k in range(4)]
    config = video_study(tmp_path, {"ours": names, "baseline": names})
    built = build_study(config, tmp_path / "out")
    files = sorted(path.name for path in (tmp_path / "out" / "clips").iterdir())
    assert len(files) == 8 and all(re.fullmatch(r"c\d{4}\.mp4", name) for name in files)
    assert (built.segments, built.clips, built.trials) == (4, 8, 4)
    for trial in (t for one in setup_of(built.page)["lists"] for t in one):
        for system, side in zip(trial["systems"], trial["sides"], strict=True):
            content = (tmp_path / "out" / "clips" / side["video"]).read_bytes()
            assert content == f"{system} {trial['clip']}.mp4".encode()
    text = built.page.read_text(encoding="utf-8")
    assert "<script>alert" not in text and built.page_bytes < 2_000_000
    assert setup_of(built.page)["title"] == TITLE
    assert "connect-src &#x27;none&#x27;" in text or "connect-src 'none'" in text


def test_the_page_has_every_setting_of_a_study(tmp_path):
    answers = ("1", "2", "3", "4", "5")
    config = video_study(
        tmp_path, {"a": ["x.mp4", "y.MP4"], "b": ["x.mp4", "y.mp4"]}, lists=1, pairs=1,
        question="Which *one*?", answers=answers, reasons="speech", introduction="Hello.",
        consent="I agree.", attention_checks=3, post_url="https://h/a?b=1", seed=5,
        completion_url="https://h/end",
    )  # fmt: skip
    built = build_study(config, tmp_path / "my study é!")
    found = setup_of(built.page)
    ((trial,),) = found.pop("lists")
    assert found == {
        "format": 1, "name": "my_study_é_", "title": TITLE, "introduction": "Hello.",
        "consent": "I agree.", "question": "Which *one*?", "styles": [],
        "answers": [{"code": c, "text": t} for c, t in zip(CODES, answers, strict=True)],
        "reasons": [{"code": c, "text": t} for c, t in REASONS["speech"].items()],
        "checks": 3, "post": "https://h/a?b=1", "completion": "https://h/end", "seed": 5,
    }  # fmt: skip
    assert (built.segments, built.clips, built.trials) == (2, 2, 1), "only clips that are shown"
    assert built.page_bytes == built.page.stat().st_size
    assert set(trial) == {"clip", "systems", "sides"}, "no style"
    assert [side["silent"] for side in trial["sides"]] == [False, False]
    text = built.page.read_text(encoding="utf-8")
    assert "connect-src https://h/a?b=1" in text and "default-src &#x27;none&#x27;" in text
    assert sorted({side["video"] for side in trial["sides"]}) == ["c0001.mp4", "c0002.mp4"]


@pytest.mark.parametrize(
    ("options", "question", "first"),
    [
        ({}, "matches the speech rhythm", "Clear preference for left"),
        (
            {"sound": "music"},
            "Which character's dancing motion do you prefer, taking into account both how "
            "natural-looking the motion is and how well it matches the music?",
            "Clear preference for left",
        ),
        ({"design": "mismatch"}, "movements match the speech better", "Clear preference for left"),
        (
            {"design": "mismatch", "sound": "music"},
            "movements match the music better",
            "Clear preference for left",
        ),
        (
            {"design": "style", "styles": {"x": "a cat"}},
            "looks most like *{style}*",
            "Clearly the left one",
        ),
    ],
)
def test_the_usual_questions_and_answers(tmp_path, options, question, first):
    clips = {"a": ["x 1.mp4", "x 2.mp4"], "b": ["x 1.mp4", "x 2.mp4"]}
    found = setup_of(build_study(video_study(tmp_path, clips, **options), tmp_path / "out").page)
    assert question in found["question"] and found["answers"][0]["text"] == first
    silent = options.get("design") == "style"
    assert ("headphones" in found["introduction"]) != silent
    assert ("The clips have no sound" in found["introduction"]) == silent
    assert (found["consent"], found["post"], found["completion"]) == ("", "", "")
    assert found["reasons"] == [] and found["checks"] == 2
    sides = [side for one in found["lists"] for trial in one for side in trial["sides"]]
    assert {side["silent"] for side in sides} == {silent}
    styles = {trial.get("style") for one in found["lists"] for trial in one}
    if silent:
        assert styles == {"x"}
        (style,) = found["styles"]
        assert style["name"] == "x" and "looks most like *a cat*" in style["question"]
    else:
        assert styles == {None} and found["styles"] == []


def clip_of(path: Path) -> tuple[str, dict]:
    """Return the name and the value that the script of a clip gives to the page."""
    text = re.fullmatch(r'gesturekitClip\("(\w+)",(.*)\);\n', path.read_text(encoding="utf-8"))
    return text[1], json.loads(text[2])


@pytest.mark.skipif(
    not (build_module._BUNDLE.is_file() and player_module._BUNDLE.is_file()),
    reason="the pages are not bundled: run `make setup`",
)
@pytest.mark.parametrize("spoken", [True, False])
def test_motions_are_shown_as_long_as_they_and_their_sound_last(
    tmp_path, gesture, write_speech, spoken
):
    for system, seconds in (("a", 0.6), ("b", 0.3)):
        gesture(seconds, 20.0).save(tmp_path / system / "x.npz")
    write_speech(tmp_path / "sound" / "x.wav", 0.4501)
    systems = {name: str(tmp_path / name) for name in "ab"}
    config = StudyConfig("T", systems, audio=tmp_path / "sound" if spoken else None, lists=2)
    built = build_study(config, tmp_path / "out")
    found = setup_of(built.page)
    assert ("taking into account both" in found["question"]) == spoken
    assert ("headphones" in found["introduction"]) == spoken
    for (trial,) in found["lists"]:
        seconds = {
            name: side["seconds"]
            for name, side in zip(trial["systems"], trial["sides"], strict=True)
        }
        assert seconds == {"a": 0.45 if spoken else 0.6, "b": 0.3}
    files = sorted((tmp_path / "out" / "clips").iterdir())
    assert [path.name for path in files] == ["c0001.js", "c0002.js"] and built.clips == 2
    for path in files:
        name, clip = clip_of(path)
        assert name == path.stem and ("audio" in str(sorted(clip))) == spoken


@pytest.mark.parametrize("checks", [0, 1])
def test_the_introduction_tells_of_attention_checks_only_if_there_are_some(tmp_path, checks):
    clips = {name: ["1.mp4", "2.mp4"] for name in ("a", "b")}
    config = video_study(tmp_path, clips, attention_checks=checks)
    text = setup_of(build_study(config, tmp_path / "out").page)["introduction"]
    assert ("Some pairs ask you" in text) == bool(checks) and "headphones" in text


def test_more_pairs_than_segments_are_named(tmp_path):
    names = [f"clip{k}.mp4" for k in range(3)]
    config = video_study(tmp_path, {"ours": names, "baseline": names}, pairs=36)
    with pytest.warns(UserWarning, match="pairs: 36, .*3 segments: 3 comparisons a rater"):
        assert build_study(config, tmp_path / "out").trials == 3


def test_mismatched_videos_keep_the_sound_of_the_segment(tmp_path):
    names = [f"clip{k}.mp4" for k in range(3)]
    config = video_study(tmp_path, {"ours": names}, design="mismatch")
    built = build_study(config, tmp_path / "out")
    clips = tmp_path / "out" / "clips"
    for trial in (t for one in setup_of(built.page)["lists"] for t in one):
        own = f"ours {trial['clip']}.mp4".encode()
        for system, side in zip(trial["systems"], trial["sides"], strict=True):
            shown = (clips / side["video"]).read_bytes()
            assert (shown == own) == (not system.endswith("_Mismatched"))
            if shown != own:
                assert (clips / side["sound"]).read_bytes() == own


def test_speech_of_motions_is_found_by_path_then_by_name(tmp_path, gesture, write_speech):
    for system in ("a", "b"):
        for name in ("d/x", "d/y", "z"):
            gesture(0.2).save(tmp_path / system / f"{name}.npz")
    systems = {name: str(tmp_path / name) for name in ("a", "b")}
    for name in ("d/x", "y"):
        write_speech(tmp_path / "sound" / f"{name}.wav", 0.3)
    config = StudyConfig("T", systems, audio=tmp_path / "sound")
    with pytest.warns(UserWarning, match="1 clip left out, as .* has no sound of them: z"):
        found = find_clips(config)
    sounds = {segment.name: segment.sound for segment in found.segments}
    sound = tmp_path / "sound"
    assert sounds == {"d/x": sound / "d" / "x.wav", "d/y": sound / "y.wav"} and not found.videos
    write_speech(tmp_path / "other" / "w.wav", 0.3)
    with pytest.raises(ConfigError, match="has no sound named like the clips, such as d/x.wav"):
        find_clips(StudyConfig("T", systems, audio=tmp_path / "other"))
    styles = {"d": "dancing", "z": "sleeping"}
    config = StudyConfig("T", systems, "style", audio=tmp_path / "sound", styles=styles)
    silent = find_clips(config).segments
    assert [(s.name, s.sound, s.style) for s in silent] == [
        ("d/x", None, "d"), ("d/y", None, "d"), ("z", None, "z")
    ]  # fmt: skip
    silent = find_clips(StudyConfig("T", systems)).segments
    assert [segment.sound for segment in silent] == [None] * 3
    with pytest.raises(ConfigError, match="the design mismatch needs a folder of speech"):
        find_clips(StudyConfig("T", {"a": systems["a"]}, design="mismatch"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lists": 0}, "lists: 0 is below 1"),
        ({"lists": 1001}, "lists: 1001 is more than 1000"),
        ({"attention_checks": -1}, "attention_checks: -1 is below 0"),
        ({"seed": -1}, "seed: -1 is below 0"),
        ({"answers": ("a", "b", "c", "d", "e", "f")}, "answers: 6 given"),
        ({"completion_url": "ftp://host/x"}, "completion_url: 'ftp://host/x' is not a web address"),
        ({"post_url": "https:///x"}, "is not a web address"),
        ({"post_url": "https://host/a b"}, "is not a web address"),
        ({"post_url": "https://[host"}, "is not a web address"),
        ({"styles": {"happy": "happy"}}, "design preference has no styles"),
        ({"design": "style", "styles": {"happy": 3}}, "'happy': 3; expected NAME: WORDS"),
        ({"design": "style", "styles": {3: "happy"}}, "3: 'happy'; expected NAME: WORDS"),
        ({"title": " "}, "title is empty"),
        ({"systems": {"a": "x", 2: "y"}}, "systems: 2: 'y'; expected NAME: FOLDER"),
        ({"systems": {"a": "x", " ": "y"}}, "systems: ' ': 'y'; expected NAME: FOLDER"),
    ],
)
def test_settings_out_of_range_are_refused(options, message):
    with pytest.raises(ConfigError) as refused:
        replace(config_of(2), **options)
    assert message in str(refused.value)


def test_settings_at_the_ends_of_their_ranges_are_accepted():
    config_of(2, lists=1, attention_checks=0, seed=0, pairs=1, post_url="http://host:1/x?y=1")
    config_of(1, design="mismatch", lists=1000, answers=tuple("abcde"))
    for few in (1, 0):
        with pytest.raises(ConfigError, match=f"systems: {few} given; .* needs {few + 1} or more"):
            config_of(few, design="preference" if few else "mismatch")
