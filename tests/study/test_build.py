"""Configuration, clips and balanced lists of a study."""

import json
import re
from collections import Counter
from pathlib import Path

import pytest
from pages import bundled

from gesturekit.errors import ConfigError
from gesturekit.study import CODES, StudyConfig, build_study
from gesturekit.study.clips import Segment, find_clips
from gesturekit.study.config import load_study_config
from gesturekit.study.lists import make_lists, mismatches


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
        pairs = Counter(systems for _, systems in one)
        assert len(pairs) == 12 and set(pairs.values()) == {each * len(styles) / 12}
        assert len({segment.name for segment, _ in one}) == each * len(styles)
        within = Counter((segment.style, *systems) for segment, systems in one)
        assert max(within.values()) - min(within.values()) <= 1
        over_styles += within
        over_all.update((segment.name, *systems) for segment, systems in one)
    assert set(over_styles.values()) == {2 * each}
    # 24 lists and 12 ordered pairs: each pair of each segment twice, or nearly always where the 18
    # of a style are no multiple of 12.
    uses = Counter(over_all.values())
    assert uses[2] == uses.total() if each == 36 else uses[2] > 0.9 * uses.total()


SYSTEMS = "title: x\nsystems: {a: x, b: y}\n"


@pytest.mark.parametrize(
    ("text", "facts"),
    [
        ("titel: x", ["titel"]),
        ("systems: {a: x, b: y}", ["title", "missing"]),
        ("title: x\nsystems: {a: x}", ["systems", "1", "2"]),
        ("title: x\nsystems: {a: x, b_Mismatched: y}", ["b_Mismatched"]),
        ("title: x\nsystems: {a: x, b: 3}", ["b", "3"]),
        (SYSTEMS + "design: mismatch\nsound: none", ["sound", "mismatch"]),
        (SYSTEMS + "design: rating\nreasons: speech", ["reasons", "rating"]),
        (
            f"title: x\ndesign: rating\nsystems: {{{', '.join(f's{k}: x' for k in range(13))}}}",
            ["13", "12"],
        ),
        (SYSTEMS + "design: prefer", ["design", "prefer"]),
        (SYSTEMS + "design: style", ["style", "styles"]),
        (SYSTEMS + "answers: [better, worse]", ["answers", "2"]),
        (SYSTEMS + 'post_url: "javascript:alert(1)"', ["post_url", "alert"]),
        (SYSTEMS + 'post_url: "https://h; script-src *"', ["post_url", "script"]),
        (SYSTEMS + "pairs: 0", ["pairs", "0", "above 0"]),
        (SYSTEMS + "lists: 1001", ["lists", "1001"]),
        (SYSTEMS + "attention_checks: -1", ["attention_checks", "1"]),
        (SYSTEMS + "styles: {x: happy}", ["preference", "styles"]),
        ('title: " "\nsystems: {a: x, b: y}', ["title", "empty"]),
    ],
)
def test_a_wrong_configuration_is_named(tmp_path, text, facts):
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"study\.yaml") as refused:
        load_study_config(tmp_path / "study.yaml")
    said = str(refused.value).replace(str(tmp_path), "")
    assert all(re.search(rf"\b{fact}\b", said) for fact in facts)


TITLE = "</script><script>alert(1)</script>{{setup}}"


def video_study(folder: Path, clips: dict[str, list[str]], **options) -> StudyConfig:
    for system, names in clips.items():
        for name in names:
            (folder / system / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / system / name).write_bytes(f"{system} {name}".encode())
    return StudyConfig(TITLE, {name: str(folder / name) for name in clips}, **options)


def test_clips_are_matched_by_path_then_by_name_and_others_are_named(tmp_path):
    config = video_study(tmp_path, {"a": ["d/x y.mp4", "d/é.mp4"], "b": ["d/x y.webm", "d/z.mp4"]})
    with pytest.warns(UserWarning, match=r"(?=.*\b1 clip\b).*d/(é|z)"):
        found = find_clips(config)
    assert [segment.name for segment in found] == ["d/x y"] and found[0].is_video
    flat = video_study(tmp_path / "2", {"a": ["one/x.mp4"], "b": ["x.mp4"]})
    assert [segment.name for segment in find_clips(flat)] == ["x"]


def test_styles_are_found_in_folders_and_file_names(tmp_path):
    names = ["happy/1.mp4", "067_Very_Old_2.mp4", "very happy-3.mp4", "unhappy.mp4"]
    styles = {"happy": "happy", "very happy": "very happy", "old": "an old person"}
    config = video_study(tmp_path, {"a": names, "b": names}, design="style", styles=styles)
    with pytest.warns(UserWarning, match="unhappy"):
        found = {segment.name: segment.style for segment in find_clips(config)}
    (tmp_path / "none").mkdir()
    with pytest.raises(ConfigError, match="segment"), pytest.warns(UserWarning, match="x"):
        names = {"a": ["x.mp4"], "b": ["x.mp4"]}
        find_clips(video_study(tmp_path / "none", names, design="style", styles=styles))
    expected = {"happy/1": "happy", "067_Very_Old_2": "old", "very happy-3": "very happy"}
    assert found == expected


@pytest.mark.parametrize(
    ("clips", "message"),
    [
        ({"a": ["x.mp4"], "b": ["y.mp4"]}, r"(?=.*\bx\b).*\by\b"),
        ({"a": ["x.mp4"], "b": ["x.bvh"]}, r"(?=.*\ba\W+videos).*\bb\W+motions"),
        ({"a": ["x.bvh"], "b": ["x.mp4"]}, r"(?=.*\ba\W+motions).*\bb\W+videos"),
        ({"a": ["x.mp4"], "b": ["x.txt"]}, r"(?=.*\bb\b)(?=.*webm).*bvh"),
    ],
)
def test_folders_that_do_not_fit_are_refused(tmp_path, clips, message):
    with pytest.raises(ConfigError, match=message):
        find_clips(video_study(tmp_path, clips))
    with pytest.raises(ConfigError, match="absent"):
        find_clips(StudyConfig("T", {"a": str(tmp_path / "absent"), "b": str(tmp_path / "b")}))


def test_a_body_is_of_the_package_or_an_avatar_beside_the_file_and_for_motions(tmp_path):
    with pytest.raises(ConfigError, match=r"(?=.*robot)(?=.*mannequin).*\.vrm"):
        config_of(2, body="robot")
    (tmp_path / "study.yaml").write_text("title: T\nbody: me.vrm\nsystems: {a: a, b: b}\n")
    assert load_study_config(tmp_path / "study.yaml").body == str(tmp_path / "me.vrm")
    config = video_study(tmp_path, {"a": ["x.mp4"], "b": ["x.mp4"]}, body="human")
    with pytest.raises(ConfigError, match="(?=.*human).*videos"):
        build_study(config, tmp_path / "out")


def setup_of(page: Path) -> dict:
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'id="setup">(.*?)</script>', text, re.S)[1])


def test_clip_names_do_not_reveal_the_system(tmp_path):
    names = [f"speaker/clip {k}.mp4" for k in range(4)]
    config = video_study(tmp_path, {"ours": names, "baseline": names})
    built = build_study(config, tmp_path / "out")
    files = sorted(path.name for path in (tmp_path / "out" / "clips").iterdir())
    assert len(files) == 8
    assert not any(word in name for name in files for word in ("ours", "baseline", "speaker"))
    assert (built.segments, built.clips, built.trials) == (4, 8, 4)
    for trial in (t for one in setup_of(built.page)["lists"] for t in one):
        for system, side in zip(trial["systems"], trial["sides"], strict=True):
            content = (tmp_path / "out" / "clips" / side["video"]).read_bytes()
            assert content == f"{system} {trial['clip']}.mp4".encode()
    text = built.page.read_text(encoding="utf-8")
    assert "<script>alert" not in text and built.page_bytes < 2_000_000
    assert setup_of(built.page)["title"] == TITLE
    assert re.search("connect-src (&#x27;|')none", text)


def test_the_page_has_the_settings_of_a_study(tmp_path):
    answers = ("1", "2", "3", "4", "5")
    names = ["x 1.mp4", "x 2.mp4"]
    config = video_study(
        tmp_path, {"a": names, "b": names}, design="style", styles={"x": "a cat"}, lists=1,
        pairs=1, answers=answers, consent="I agree.", attention_checks=0,
        post_url="https://h/a?b=1", completion_url="https://h/end", seed=5,
    )  # fmt: skip
    built = build_study(config, tmp_path / "my study é!")
    found = setup_of(built.page)
    assert [(a["code"], a["text"]) for a in found["answers"]] == [*zip(CODES, answers)]
    assert (found["name"], found["consent"], found["seed"]) == ("my_study_é_", "I agree.", 5)
    assert "*a cat*" in found["styles"][0]["question"]
    ((trial,),) = found["lists"]
    assert trial["style"] == "x" and all(side["silent"] for side in trial["sides"])
    assert (built.segments, built.clips, built.trials) == (2, 2, 1), "only clips that are shown"
    assert "connect-src https://h/a?b=1" in built.page.read_text(encoding="utf-8")


@bundled
def test_motions_are_shown_with_speech_of_their_name_as_long_as_they_last(
    tmp_path, gesture, write_speech
):
    for system, seconds in (("a", 0.6), ("b", 0.3)):
        for name in ("d/x", "d/y", "z"):
            gesture(seconds, 20.0).save(tmp_path / system / f"{name}.npz")
    for name in ("d/x", "y"):
        write_speech(tmp_path / "sound" / f"{name}.wav", 0.4501)
    systems = {name: str(tmp_path / name) for name in "ab"}
    with pytest.warns(UserWarning, match="sound.*: z"):
        built = build_study(StudyConfig("T", systems, audio=tmp_path / "sound"), tmp_path / "out")
    found = setup_of(built.page)
    trials = [trial for one in found["lists"] for trial in one]
    assert {trial["clip"] for trial in trials} == {"d/x", "d/y"}
    for trial in trials:
        seconds = {n: side["seconds"] for n, side in zip(trial["systems"], trial["sides"])}
        assert seconds == {"a": 0.45, "b": 0.3}
    for path in (tmp_path / "out" / "clips").iterdir():
        sound = json.loads(re.search(r"\{.*\}", path.read_text(encoding="utf-8"))[0])["audio"]
        assert sound["type"] == "audio/mpeg", "compressed, and played by every browser"
    write_speech(tmp_path / "other" / "w.wav", 0.3)
    with pytest.raises(ConfigError, match="(?=.*other).*d/x.wav"):
        build_study(StudyConfig("T", systems, audio=tmp_path / "other"), tmp_path / "x")
    config = video_study(tmp_path, {"one": ["x.mp4"]}, design="mismatch")
    with pytest.raises(ConfigError, match=r"(?=.*mismatch).*\b1\b"):
        build_study(config, tmp_path / "x")
    with pytest.raises(ConfigError, match="(?=.*mismatch).*speech"):
        build_study(StudyConfig("T", {"a": systems["a"]}, design="mismatch"), tmp_path / "x")
    smallest = {"design": "mismatch", "lists": 1, "attention_checks": 0}
    config = video_study(tmp_path / "two", {"one": ["x.mp4", "y.mp4"]}, **smallest)
    assert build_study(config, tmp_path / "y").page.is_file()


def test_twelve_systems_are_the_most_on_one_page_of_sliders():
    assert len(make_lists(config_of(12, design="rating", lists=1), segments(3))[0]) == 3


def test_each_list_rates_all_systems_of_its_segments():
    lists = make_lists(config_of(5, design="rating", pairs=6, lists=4), segments(8))
    assert {systems for one in lists for _, systems in one} == {("s0", "s1", "s2", "s3", "s4")}
    assert all(len({segment.name for segment, _ in one}) == 6 for one in lists)
    assert set(Counter(segment.name for one in lists for segment, _ in one).values()) == {3}


def test_mismatched_motion_is_another_clip_of_the_same_folder():
    clips = [*segments(5, folder="anna/"), *segments(4, folder="ben/"), *segments(1, folder="eve/")]
    seen = set()
    for seed in range(4):
        found = mismatches(clips, seed)
        assert set(found) == {s.name for s in clips} == {other.name for other in found.values()}
        assert all(other.name != name for name, other in found.items())
        same = [name for name, other in found.items() if other.speaker == name.split("/")[0]]
        assert len(same) >= 8, "the only clip of a folder is among those of another"
        seen.add(str(found))
    assert len(seen) > 1
    lists = make_lists(config_of(1, design="mismatch"), clips)
    pairs = {systems for one in lists for _, systems in one}
    assert pairs == {("s0", "s0_Mismatched"), ("s0_Mismatched", "s0")}


def test_more_comparisons_than_segments_are_warned_of(tmp_path):
    names = ["x.mp4", "y.mp4"]
    config = video_study(tmp_path, {"one": names, "two": names}, pairs=5, lists=1)
    with pytest.warns(UserWarning, match=r"5.*2 segments.*2 comparisons"):
        assert build_study(config, tmp_path / "out").trials == 2


def test_single_clips_of_two_folders_are_exchanged():
    a, b = segments(1, folder="anna/")[0], segments(1, folder="ben/")[0]
    found = mismatches([a, b], seed=0)
    assert found == {a.name: b, b.name: a}
