"""Results as values, their JSON, and the clips that a report shows."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.comparison import EvaluationOptions
from gesturekit.evaluation.measuring.alike import keep_common_recordings, mark_unlike
from gesturekit.evaluation.measuring.clip_metrics import quick_metrics
from gesturekit.evaluation.measuring.clips import forget_files
from gesturekit.evaluation.measuring.content import Store, digest_of
from gesturekit.evaluation.measuring.rigs import RETARGETED
from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.metrics.physical import acceleration, jerk
from gesturekit.evaluation.pairs import Excluded, Pair, Pairs
from gesturekit.evaluation.report.page import without_folders, write_report
from gesturekit.evaluation.report.showcase import best_and_worst
from gesturekit.evaluation.results import (
    Agreement,
    ClipResult,
    Evaluation,
    Finding,
    Interval,
    Level,
    MetricResult,
    ModelResult,
    QuestionAgreement,
)


@pytest.mark.parametrize(
    ("interval", "count", "method"),
    [
        (Interval(1, None, None, 6, 1, "takes"), "1 take, 6 clips", "over takes, without an int"),
        (Interval(1, 0, 2, 1, 2, "takes", 2), "2 takes of 2 speakers, 1 clip", "by Student's t"),
        (Interval(1, 0, 2, 5, 5, "samples"), "5 clips", "mean over samples"),
        (Interval(1, None, None, 9, 1, "the whole set"), "n = 9", "one value of the whole set"),
    ],
)
def test_an_interval_says_what_it_is_over(interval, count, method):
    assert interval.count == count and method in interval.method


def result_of(name: str, stem: str, seconds: float, metrics=None, **more) -> ClipResult:
    pair = Pair(name, stem, more.pop("window", None), Path("a"), Path("b"))
    return ClipResult(pair, seconds, metrics or {}, {}, {}, **more)


def evaluation(*models: ModelResult, **more) -> Evaluation:
    settings = {"variants": {}, "seed": 0}
    return Evaluation([*models], Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0),
                      **more)  # fmt: skip


def test_verdicts_are_named_where_there_are_several_models():
    one, other = ModelResult("a", Path("a"), "Good."), ModelResult("b", Path("b"))
    assert evaluation(one).verdicts() == ["Good."] and evaluation(one, other).verdicts() == [
        "a: Good."
    ]
    one.clips = [result_of("x_s1", "x", 1.4), result_of("x_s2", "x", 1.2)]
    assert evaluation(one, other).basis == "Computed over 1 take (2 clips, 3 s) at 25 fps."
    one.excluded.append(Excluded("x", "no feet", "foot_skate"))
    assert evaluation(one).is_complete
    other.excluded.append(Excluded("y", "damaged"))
    assert not evaluation(one, other).is_complete
    assert replace(one, marks=["longer", "odd"]).heading == "a (longer, odd)"


def test_all_of_a_result_is_in_its_json_and_comes_back(tmp_path):
    interval, own = Interval(0.5, 0.4, 0.6, 6, 5, "takes"), Interval(0.7, 0.6, 0.8, 6, 6, "takes")
    ceiling, floor = Level("own", 0.9, 0.1, 4), Level("other", 0.2, None, 1, True)
    sync = MetricResult("sync", interval, 0.7, 0.1, 0.2, "note", own, False, ceiling, (floor,))
    assert MetricResult.from_json(json.loads(json.dumps(asdict(sync)))) == sync
    plain = MetricResult("reach", Interval(1.0, None, None, 3, 1, "the whole set"))
    assert MetricResult.from_json(json.loads(json.dumps(asdict(plain)))) == plain
    clip = ClipResult(Pair("x_w002", "x", 2, Path("a"), Path("b")), 1.23456789, {"sync": 0.5},
                      {"sync": 0.7}, {"sync": 0.1}, ("odd",))  # fmt: skip
    model = ModelResult(
        "é", Path("a"), "Good.", [Finding("Q?", "sync", "yes", "Yes.")],
        {"sync": sync, "reach": plain}, {"x": {"coverage": own}}, [clip],
        [Excluded("y", "why")], ["n"], ["m"],
    )  # fmt: skip
    found = evaluation(model, versions={"numpy": "1"})
    found.write_json(tmp_path / "x.json")
    text = (tmp_path / "x.json").read_text(encoding="utf-8")
    assert "é" in text and text.endswith("}\n") and '\n "format": 1,\n' in text
    values = json.loads(text)
    (saved,) = values.pop("models")
    assert set(values.pop("definitions")) == {"sync", "reach"}
    assert values == {
        "format": 1, "reference": "r", "fps": 25.0, "protocol": "", "versions": {"numpy": "1"},
        "basis": "Computed over 1 take (1 clip, 1 s) at 25 fps.", "agreement": None,
        "settings": {"variants": {}, "seed": 0},
    }  # fmt: skip
    figures = saved.pop("figures")
    assert figures["sync"] == {
        **asdict(interval), "unit": "", "takes": 5, "method": interval.method, "recording": 0.7,
        "chance": 0.1, "recording_low": 0.6, "recording_high": 0.8, "informative": False,
        "mismatched": 0.2, "note": "note", "ceiling": asdict(ceiling), "floors": [asdict(floor)],
    }  # fmt: skip
    reach = figures["reach"]
    assert (reach["takes"], reach["ceiling"], reach["recording_low"]) == (None, None, None)
    assert saved == {
        "label": "é", "path": "a", "verdict": "Good.",
        "answers": [{"question": "Q?", "key": "sync", "state": "yes", "sentence": "Yes."}],
        "by_recording": {"x": {"coverage": asdict(own)}},
        "clips": [{"name": "x_w002", "recording": "x", "window": 2, "seconds": 1.2346,
                   "figures": {"sync": 0.5}, "recording_figures": {"sync": 0.7},
                   "mismatched": {"sync": 0.1}, "notes": ["odd"]}],
        "excluded": [{"name": "y", "reason": "why", "what": "clip"}],
        "notes": ["n"], "marks": ["m"],
    }  # fmt: skip


def test_options_out_of_range_are_refused():
    with pytest.raises(EvaluationError, match="'x'; expected one of multires, lda"):
        EvaluationOptions(protocol="x")
    with pytest.raises(EvaluationError, match="seed is -1"):
        EvaluationOptions(seed=-1)
    found = EvaluationOptions(seed=0, audio=Path("a"), semantic="s", baselines=("mean_pose",))
    assert found.to_json() == {
        "seed": 0, "baselines": ["mean_pose"], "audio": "a", "semantic": "s", "features": None
    }  # fmt: skip
    assert EvaluationOptions().to_json()["audio"] is None


def clips_of(*names: str | tuple[str, int]) -> Pairs:
    pairs = [name if isinstance(name, tuple) else (name, None) for name in names]
    return Pairs([Pair(stem, stem, window, Path("a"), Path("b")) for stem, window in pairs])


def test_clips_without_counterparts_are_set_apart_with_who_lacks_them():
    found = {"one": clips_of("a", "b", "c", ("d", 1)), "two": clips_of("a", "c", ("d", 2)),
             "three": clips_of("a", "c")}  # fmt: skip
    keep_common_recordings(found)
    assert [[p.stem for p in pairs.pairs] for pairs in found.values()] == [["a", "c"]] * 3
    assert [(e.name, e.reason) for e in found["one"].excluded] == [
        ("b", "set apart: two, three has no clip of this recording"),
        ("d", "set apart: two, three has no clip of this recording"),
    ]
    assert found["one"].notes == [
        "all models are compared on the 2 recordings that they share; 2 clips of one set apart"
    ]
    assert found["three"].notes == [] == found["three"].excluded
    with pytest.raises(EvaluationError) as refused:
        keep_common_recordings({"one": clips_of("a", "b", "e"), "two": clips_of(("a", 3))})
    assert "(one: a, b and 1 more; two: a, window 3)" in str(refused.value)


@pytest.mark.parametrize(
    ("lengths", "marked"),
    [
        ((2.0, 2.0, 2.0), False),
        ((2.19, 2.19, 2.19), False),
        ((2.21, 2.3, 2.0), True),
        ((2.21, 2.0, 2.0), False),
        ((1.7, 1.5, 1.6), True),
    ],
)
def test_models_of_another_length_are_marked(lengths, marked):
    first = ModelResult("one", Path(), clips=[result_of(s, s, 2.0) for s in "abc"])
    other = ModelResult(
        "two", Path(), clips=[result_of(s, s, n) for s, n in zip("abc", lengths, strict=True)]
    )
    other.clips.append(result_of("z", "z", 99.0))
    mark_unlike([first, other])
    assert first.marks == [] and other.marks == (["other length"] if marked else [])
    if marked:
        odd = np.median([n for n in lengths if abs(n - 2) > 0.2])
        assert other.notes[0].startswith(f"clips of {odd:.3g} s where those of one have 2 s:")


def test_lengths_are_means_over_samples_and_half_of_the_recordings_may_differ():
    first = ModelResult("one", Path(), clips=[result_of(s, s, 2.0) for s in "ab"])
    samples = [result_of(f"a_s{k}", "a", n) for k, n in enumerate((1.0, 3.0))]
    other = ModelResult("two", Path(), clips=[*samples, result_of("b", "b", 3.0)])
    mark_unlike([first, other])
    assert other.marks == []
    other.clips += [result_of("a_s3", "a", 9.0, notes=(RETARGETED,))]
    mark_unlike([first, other])
    assert other.marks == ["retargeted", "other length"]
    assert other.notes[0].startswith("1 of 4 clips are on another rig")


def test_quick_metrics_are_values_or_ratios_to_the_recordings(gesture):
    made, own = [gesture(2.0, 25.0, seed=k) for k in (0, 1)], [gesture(2.0, 25.0, seed=k)
                                                              for k in (2, 3)]  # fmt: skip
    made = [replace(motion, fps=50.0).resample(25.0) for motion in made]
    found = quick_metrics(made, own)
    for key, measure in (("acceleration", acceleration), ("jerk", jerk)):
        for name, cutoff in ((key, 6.0), (f"{key}_genea", None)):
            if f"{name}_ratio" in found:
                ratios = [measure(a, cutoff=cutoff) / measure(b, cutoff=cutoff)
                          for a, b in zip(made, own, strict=True)]  # fmt: skip
                assert found[f"{name}_ratio"] == pytest.approx(np.mean(ratios))
    assert "foot_skate" in found and found["arm_speed_ratio"] == pytest.approx(2.0, rel=0.3)
    same = quick_metrics(own, own)
    assert {round(v, 9) for k, v in same.items() if k.endswith("_ratio")} == {1.0}
    with pytest.raises(ValueError, match="zip"):
        quick_metrics(made, own[:1])


def test_measurements_are_read_as_they_were_written(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path))
    store, key = Store(), digest_of({"b": 1, "a": Path("x")})
    assert key == digest_of({"a": Path("x"), "b": 1}) != digest_of({"a": Path("y"), "b": 1})
    assert store.read(key) is None and store.read(None) is None
    store.write(None, {"a": 1})
    store.write(key, {"a": [1.5, None]})
    assert Store().read(key) == {"a": [1.5, None]} and not caplog.text
    (path,) = tmp_path.rglob("*.json")
    for text in ("[", "{}", "[]", path.read_text().replace("1.5", "1.6")):
        path.write_text(text)
        caplog.clear()
        assert store.read(key) is None
        assert f"{path}: damaged" in caplog.text and "measuring again" in caplog.text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("/a/b/c.wav", "c.wav"),
        ("see /a/b/, or x/y", "see , or x/y"),
        ("10 m/s and 1/2", "10 m/s and 1/2"),
        ("https://host/a/b", "https://host/a/b"),
        ("~/a/b and ../c/d", "~/a/b and ../c/d"),
        ("'/a/b c'", "'b c'"),
        ("--out=/a/b/c", "--out=c"),
    ],
)
def test_folders_of_absolute_paths_are_left_out(text, shown):
    assert without_folders(text) == shown
    assert without_folders(f"{Path.cwd()}/x {Path.home()}/y z/w") == "x y z/w"


@pytest.fixture
def shown(tmp_path, gesture, write_speech):
    """shown(values, **options): clips that are shown of a model with these values of a metric."""

    def make(values: list[float], key: str = "sync", seconds: float = 1.0, **more):
        forget_files()
        models = []
        for label in ("first", "other"):
            clips = []
            for k, value in enumerate(values):
                files = [tmp_path / folder / f"c{k}.npz" for folder in (label, "recorded")]
                for path in files:
                    gesture(seconds, 10.0, seed=k).save(path)
                pair = Pair(f"c{k}", f"c{k}", None, *files)
                clips.append(ClipResult(pair, seconds, {key: value}, {}, {}))
            models.append(ModelResult(label, Path(label), clips=clips))
        models[1].clips = models[1].clips[1:]
        for change in more.values():
            change(models)
        return best_and_worst(replace(evaluation(*models), fps=10.0))

    return make


def test_the_best_and_the_worst_clips_are_shown(shown):
    def labels(values: list[float], **more) -> dict[str, str]:
        return {one.label: one.title.partition(": ")[2] for one in shown(values, **more)}

    assert labels([0.1, 0.5, 0.3, 0.9]) == {
        "Best": "c3", "Best, 2": "c1", "Worst": "c0", "Worst, 2": "c2"
    }  # fmt: skip
    assert labels([0.1, 0.5, 0.3, 0.9, 0.2, 0.4])["Best, 2"] == "c1"
    assert labels([0.1, 0.5, 0.3]) == {"Best": "c1", "Worst": "c0"}
    assert labels([0.1, 0.5]) == {"Best": "c1", "Worst": "c0"} and labels([0.1]) == {"Best": "c0"}
    assert labels([0.1, 0.5], key="reach") == {}

    def lost(models) -> None:
        models[0].clips[1].pair.generated.unlink()

    assert labels([0.1, 0.5], lost=lost) == {"Worst": "c0"}


def test_a_clip_is_shown_for_twenty_seconds_beside_other_models_and_the_recording(
    shown, write_speech, tmp_path
):
    def spoken(models) -> None:
        sound = write_speech(tmp_path / "s.wav", 30.0)
        for k, seconds in ((0, 25.0), (1, 12.0)):
            pair = replace(models[0].clips[k].pair, audio=sound)
            models[0].clips[k] = replace(models[0].clips[k], pair=pair, seconds=seconds)

    best, worst = shown([0.9, 0.123], seconds=25.0, spoken=spoken)
    assert best.detail == "c0: sync 0.90" and worst.detail == "c1: sync 0.12"
    assert (best.ranked_by, best.title, worst.title) == ("Sync", "Best: c0", "Worst: c1")
    values = [json.loads(one.motion) for one in (best, worst)]
    names = [[figure["label"] for figure in one["figures"]] for one in values]
    assert names == [["first", "recording"], ["first", "other", "recording"]]
    assert {figure["n_frames"] for one in values for figure in one["figures"]} == {200}
    for one, seconds in zip(values, (20.0, 12.0), strict=True):
        sound, _ = soundfile.read(io.BytesIO(base64.b64decode(one["audio"]["data"])))
        assert len(sound) / 16000 == pytest.approx(seconds, abs=0.01)


def test_the_page_has_its_facts_its_warnings_and_the_study(tmp_path):
    """Two models of one name in two folders, without any metric."""
    clips = [result_of(f"x_s{k}", "x", 1.4) for k in range(2)]
    lost = [Excluded("y", "damaged"), Excluded("z", "no feet", "foot_skate")]
    models = [
        ModelResult("/runs/one/ours", Path("a"), clips=clips, excluded=lost, notes=["odd", "late"]),
        ModelResult("/runs/two/ours", Path("b"), clips=clips[:1], notes=["odd"]),
    ]
    asked = QuestionAgreement("like?", {"a": 1.0}, 3, 2, 6, ())
    found = replace(
        evaluation(*models, versions={"numpy": "1", "scipy": "2"}),
        protocol="lda", reference=Path("recorded"),
        agreement=Agreement((asked,), ("left out <b>",)),
    )  # fmt: skip

    def shown(**options) -> str:
        write_report(found, tmp_path / "page.html", **options)
        text = (tmp_path / "page.html").read_text(encoding="utf-8")
        return re.sub(r"<(style|script).*?</\1>", "", text, flags=re.S)

    text = shown()
    assert "<title>ours (1), ours (2) against recorded<" in text
    facts = ("protocol lda", "1 recording", found.basis.rstrip("."), "seed 0")
    assert "".join(f"<span>{fact}</span>" for fact in facts) in text
    warnings = re.findall('<p class="warning">(.*?)</p>', text)
    assert warnings[-3:] == [
        "ours (1): left out: 1 clip; the reasons are below.",
        "ours (1), ours (2): odd.",
        "ours (1): late.",
    ]
    assert "numpy 1, scipy 2" in text and "Made by" not in text and "/runs" not in text
    assert "left out &lt;b&gt;." in text and "<pre>Agreement with people on like?: 3 rat" in text
    assert "Best and worst clips" not in text
    found = replace(found, models=found.models[:1], protocol="", agreement=None)
    text = shown(title="<T> /a/b/c", command="gesturekit evaluate <x>")
    assert "<title>&lt;T&gt; c<" in text and "<span>protocol" not in text
    assert "Made by <code>gesturekit evaluate &lt;x&gt;</code>" in text
    assert '<p class="warning">odd.</p><p class="warning">late.</p>' in text
    assert "Agreement" not in text and "ours" in text and "ours (1)" not in text
