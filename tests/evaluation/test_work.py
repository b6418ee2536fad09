"""What is measured, in which portions, and what is read from earlier evaluations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import audio_features
from gesturekit.corpus import Item
from gesturekit.evaluation.definitions import FRECHET, GROUPS, POOLED, Variants
from gesturekit.evaluation.measuring import measurer as module
from gesturekit.evaluation.measuring import work
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.content import content_of, metric_version
from gesturekit.evaluation.measuring.inputs import ReferenceStatistics
from gesturekit.evaluation.measuring.measurer import ClipGroup, Measurer, SetPart
from gesturekit.evaluation.measuring.work import measure_all
from gesturekit.evaluation.metrics.frechet.frechet import raw_fgd
from gesturekit.evaluation.pairs import ItemInterval, Pair
from gesturekit.motion.parts import body_joints


class Stand:
    """Stands for a measurer: the result of a clip or of a set is its name; some are stored."""

    def __init__(self, pairs: dict[str, list[Pair]], stored: set[str], local: tuple[str, ...]):
        self.pairs, self.local, self.done = pairs, frozenset(local), []
        read = {name: {"stored": name} for name in stored}
        self.store = SimpleNamespace(read=read.get)

    def clip_key(self, label: str, index: int) -> str:
        return f"{label} {self.pairs[label][index].name}"

    def set_key(self, part: SetPart) -> str:
        return f"{part.label} {part.part}"

    def is_portable(self, portion) -> bool:
        labels = portion.clips if isinstance(portion, ClipGroup) else [one.label for one in portion]
        return self.local.isdisjoint(labels)

    def __call__(self, portion) -> list:
        self.done.append(portion)
        if isinstance(portion, ClipGroup):
            return [(k, i, {"made": self.clip_key(k, i)}) for k, at in portion.clips.items()
                    for i in at]  # fmt: skip
        return [{"made": self.set_key(one)} for one in portion]


def pair(name: str, window: int | None = None) -> Pair:
    return Pair(name, name.partition("_")[0], window, Path("a"), Path("b"))


def measured(stored: set[str], local: tuple[str, ...] = (), workers: int = 1):
    pairs = {
        "one": [pair("b_s1"), pair("b_s2"), pair("a"), pair("c_w1", 1), pair("c_w0", 0)],
        "two": [pair("b"), pair("c_w1", 1)],
    }
    stand, seen = Stand(pairs, stored, local), []

    def progress(portions, total, label):
        seen.append((total, label))
        yield from portions

    return measure_all(stand, workers, progress), stand.done, seen


def test_clips_of_a_recording_are_a_portion_and_sets_come_last():
    found, done, seen = measured(set())
    assert [dict(portion.clips) for portion in done[:4]] == [
        {"one": [2]}, {"one": [0, 1], "two": [0]}, {"one": [4]}, {"one": [3], "two": [1]}
    ]  # fmt: skip
    sets = [SetPart(label, part) for label in ("one", "two") for part in ("frechet", "pooled")]
    assert done[4:] == [(one,) for one in sets] and seen == [(8, "measuring")]
    names = ["b_s1", "b_s2", "a", "c_w1", "c_w0"]
    assert found.clips["one"] == [{"made": f"one {name}"} for name in names]
    assert found.clips["two"] == [{"made": "two b"}, {"made": "two c_w1"}]
    assert found.sets["two"] == {
        "frechet": {"made": "two frechet"}, "pooled": {"made": "two pooled"}
    }  # fmt: skip


def test_what_is_stored_is_read_and_not_measured():
    stored = {"one b_s1", "one a", "two b", "one pooled", "two frechet", "two pooled"}
    found, done, seen = measured(stored)
    assert [dict(portion.clips) for portion in done[:-1]] == [
        {"one": [1]}, {"one": [4]}, {"one": [3], "two": [1]}
    ]  # fmt: skip
    assert done[-1] == (SetPart("one", "frechet"),) and seen == [(4, "measuring")]
    assert found.clips["one"][:2] == [{"stored": "one b_s1"}, {"made": "one b_s2"}]
    assert found.sets["one"] == {
        "pooled": {"stored": "one pooled"}, "frechet": {"made": "one frechet"}
    }  # fmt: skip
    every = stored | {f"one {n}" for n in ("b_s2", "c_w1", "c_w0", "frechet")} | {"two c_w1"}
    found, done, seen = measured(every)
    assert done == seen == [] and found.clips["two"][1] == {"stored": "two c_w1"}


def test_motion_made_in_memory_is_measured_here_after_all_else():
    found, done, _ = measured(set(), local=("one",))
    labels = [list(p.clips) if isinstance(p, ClipGroup) else [one.label for one in p] for p in done]
    assert labels[:4] == [["two"], ["two"], ["two"], ["two"]]
    assert all(one == ["one"] for one in labels[4:]) and len(labels) == 4 + 4 + 2
    assert found.clips["one"][2] == {"made": "one a"}


def test_what_two_processes_take_is_what_is_left_after_some_seconds(monkeypatch):
    """Sets are in one chain for two workers, and come before clips there; none are lost."""
    handed = []

    class Pool:
        def __init__(self, measurer, workers: int) -> None:
            self.measurer = measurer

        def map(self, portions, _):
            for portion in portions:
                handed.append(portion)
                yield portion, self.measurer(portion)

    monkeypatch.setattr(work, "Pool", Pool)
    monkeypatch.setattr(work, "IN_PROCESS_SECONDS", 0.0)
    monkeypatch.setattr(Stand, "portable", lambda self: self, raising=False)
    found, _, seen = measured(set(), workers=2)
    assert [len(chain) for chain in handed[:1]] == [4] and len(handed) == 5
    assert seen == [(5, "measuring")] and found.sets["one"]["pooled"] == {"made": "one pooled"}
    handed.clear()
    measured(set(), workers=4)
    assert [len(chain) for chain in handed[:2]] == [2, 2]
    handed.clear()
    monkeypatch.setattr(work, "IN_PROCESS_SECONDS", 60.0)
    found, done, _ = measured(set(), workers=2)
    assert handed == [] and len(done) == 5


@pytest.fixture
def measurer(tmp_path, gesture):
    """measurer(**fields): three clips of three recordings, with their sounds; files of any kind."""
    for k, name in enumerate("abc"):
        for folder in ("made", "recorded"):
            gesture(0.4 + 0.1 * k, 10.0, seed=k).save(tmp_path / folder / f"{name}.npz")
        (tmp_path / f"{name}.wav").write_text(f"sound {name}")
    recorded = {name: tmp_path / "recorded" / f"{name}.npz" for name in "abc"}
    pairs = [
        Pair(name, name, None, tmp_path / "made" / path.name, path, path.parents[1] / f"{name}.wav")
        for name, path in recorded.items()
    ]
    measure = ClipMetrics(ReferenceStatistics(), GROUPS, Variants())
    usual = {"measure": measure, "pairs": {"ours": pairs}, "recordings": recorded, "fps": 10.0}
    usual |= {"reference": tmp_path / "recorded", "length": 1.0, "features": None, "seed": 0}
    return lambda **fields: Measurer(**usual | fields)


def keys_of(one: Measurer, label: str = "ours") -> list[str | None]:
    """Return the keys of all clips, and of both parts of the set."""
    clips = [one.clip_key(label, k) for k in range(len(one.pairs[label]))]
    return clips + [one.set_key(SetPart(label, part)) for part in ("frechet", "pooled")]


def test_measurements_are_kept_by_all_that_they_depend_on(measurer):
    usual = keys_of(measurer())
    assert None not in usual and len(set(usual)) == 5 and keys_of(measurer()) == usual
    measure = measurer().measure
    known = ReferenceStatistics(mean_speed={"head": 1.0})
    seen = [usual]
    for change in (
        {"fps": 11.0}, {"length": 2.0}, {"without": frozenset({"neck"})},
        {"measure": replace(measure, groups=GROUPS[1:])}, {"measure": replace(measure, cheap=True)},
        {"measure": replace(measure, variants=Variants("paper"))},
        {"measure": replace(measure, statistics=known)},
    ):  # fmt: skip
        seen.append(keys_of(measurer(**change)))
    assert len({key for keys in seen for key in keys}) == 5 * len(seen)
    # A seed, and an extractor of features, matter to sets alone; a name to nothing.
    for change in ({"seed": 1}, {"features": SimpleNamespace(fingerprint="x")}):
        keys = keys_of(measurer(**change))
        assert keys[:3] == usual[:3] and not set(keys[3:]) & set(usual)
    pairs = measurer().pairs["ours"]
    named = [replace(one, name=f"{one.name}_s1", stem=f"x{one.stem}", take=one.take)
             for one in pairs]  # fmt: skip
    recorded = {f"x{name}": path for name, path in measurer().recordings.items()}
    assert keys_of(measurer(pairs={"other": named}, recordings=recorded), "other") == usual


def test_a_change_of_a_file_changes_what_is_measured_with_it(measurer, tmp_path, gesture):
    usual = keys_of(measurer())

    def changed() -> str:
        """Return a digit for each key: 1 for one that is another now, ? for none."""
        keys = keys_of(measurer())
        return "".join("?" if k is None else str(int(k != u)) for k, u in zip(keys, usual))

    for path, digits in (
        ("made/a.npz", "10011"),  # its clip, and the sets
        ("recorded/a.npz", "10111"),  # and the clip that it is the next recording of
        ("a.wav", "11111"),  # all clips are measured with the sounds of the others
    ):
        before = (tmp_path / path).read_bytes()
        gesture(0.5, 10.0, seed=9).save(tmp_path / "new.npz")
        (tmp_path / path).write_bytes((tmp_path / "new.npz").read_bytes())
        assert changed() == digits, path
        (tmp_path / path).unlink()
        assert changed() == digits.replace("1", "?"), path
        (tmp_path / path).write_bytes(before)
    assert changed() == "00000"


def test_windows_sounds_and_the_order_of_clips_are_parts_of_a_key(measurer):
    usual, (a, b, c) = keys_of(measurer()), measurer().pairs["ours"]
    for other in (replace(a, window=0), replace(a, audio=None), replace(a, semantic=a.audio)):
        keys = keys_of(measurer(pairs={"ours": [other, b, c]}))
        assert keys[0] != usual[0] and not set(keys[3:]) & set(usual[3:])
    # A take of two clips, and clips of two recordings instead of one, are other sets.
    same = keys_of(measurer(pairs={"ours": [a, replace(b, take=a.take), c]}))
    assert same[:3] == usual[:3] and not set(same[3:]) & set(usual[3:])
    assert not set(keys_of(measurer(pairs={"ours": [b, a, c]}))[3:]) & set(usual[3:])


def test_the_content_of_an_item_is_that_of_its_files_and_how_they_are_read(tmp_path):
    for name in ("a.wav", "a.bvh", "b.bvh"):
        (tmp_path / name).write_text(name)
    item = Item(id="a", take="t", audio=tmp_path / "a.wav", motion=tmp_path / "a.bvh", duration=1.0)

    def content(**changes) -> str | None:
        return content_of(ItemInterval(replace(item, **changes)))

    usual = content()
    labels = {"id": "b", "speaker": "ann", "style": "sad", "split": "test", "text": "so"}
    assert content(**labels) == usual is not None
    others = [
        content(**change)
        for change in (
            {"duration": 2.0}, {"motion_start": 1.0}, {"audio_start": 1.0}, {"mirror": True},
            {"channel": 1}, {"reading": {"height": 1.7}}, {"audible": ((0.0, 1.0),)},
            {"conditions": {"words": tmp_path / "w"}}, {"audio": None}, {"motion": None},
            {"motion": tmp_path / "b.bvh"},
        )
    ]  # fmt: skip
    assert None not in others and len({usual, *others}) == len(others) + 1
    assert content(motion=tmp_path / "none.bvh") is None
    assert content_of(tmp_path / "none.bvh") is None
    assert content_of(ItemInterval(_Made())) is None, "motion that is made in memory"
    assert content_of(tmp_path / "a.bvh") != content_of(tmp_path / "b.bvh")
    (tmp_path / "b.bvh").write_text("a.bvh")
    assert content_of(tmp_path / "a.bvh") == content_of(tmp_path / "b.bvh")
    (tmp_path / "a.wav").write_text("another sound")
    assert content() not in (usual, None)


@dataclass(frozen=True)
class _Made:
    id: str = "a"
    audio: Path | None = None
    motion: Path | None = None
    load_motion: Callable[[], None] = print


def test_recordings_have_a_distance_to_all_of_them_where_some_have_no_clip(
    tmp_path, gesture, monkeypatch
):
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    made, recorded = ([gesture(3.0, 30.0, seed=10 * k + s) for k in range(3)] for s in (0, 5))
    paths = {}
    for name, one, own in zip("abc", made, recorded, strict=True):
        one.save(tmp_path / "made" / f"{name}.npz")
        own.save(tmp_path / "recorded" / f"{name}.npz")
        paths[name] = tmp_path / "recorded" / f"{name}.npz"
    pairs = [Pair(name, name, None, tmp_path / "made" / path.name, path)
             for name, path in paths.items()]  # fmt: skip
    measure = ClipMetrics(ReferenceStatistics(), (FRECHET,), Variants())

    def measured(pairs: list[Pair], part: str) -> dict:
        one = Measurer(measure, {"ours": pairs}, paths, tmp_path / "recorded", 30.0, 1.0, None, 0)
        return one.set(SetPart("ours", part))

    whole = measured(pairs, "frechet")
    distance = whole["metrics"]["raw_fgd"]
    assert distance["recording"] is None
    assert distance["interval"]["value"] == pytest.approx(raw_fgd(made, recorded).value)
    some = measured([replace(pairs[0], name="a_s2"), *pairs[:2]], "frechet")["metrics"]["raw_fgd"]
    assert some["recording"] == pytest.approx(raw_fgd(recorded[:2], recorded).value)
    ours = raw_fgd([made[0], *made[:2]], recorded).value
    assert some["interval"]["value"] == pytest.approx(ours)
    # Clips of less than ten seconds have no features; each has 89 speeds of a joint.
    assert {key for key, _ in whole["problems"]} == {"fid_k", "fid_g", "div_k", "div_g"}
    n_joints = len(body_joints(made[0].skeleton))
    for name in ("speeds", "recorded_speeds"):
        assert sum(whole[name]["counts"]) + whole[name]["beyond"] == 3 * 89 * n_joints, name
    assert whole["by_clip"] == whole["training_excluded"] == []
    nothing = measured(pairs, "pooled")
    assert nothing["metrics"] == {} and nothing["by_clip"] == [] and nothing["wrists"] == []
    lost = measured([replace(pairs[0], generated=tmp_path / "none.npz")], "frechet")
    assert lost["metrics"] == {} and lost["problems"] == []


def test_a_clip_is_measured_beside_its_recording_and_with_sounds_and_motion_of_others(
    measurer, tmp_path, monkeypatch
):
    """Recordings of 4, 5 and 6 frames, of which the sounds are known by their names."""
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "load_sound", lambda path, window: f"{path.stem} {window}")
    measured = []

    def recording(clip) -> tuple[dict[str, float], list]:
        measured.append(clip.pair.name)
        return {"reach": 2.0}, []

    def mismatched_sound(clip, sounds: list[str]) -> dict[str, float]:
        return {"in_time": float(clip.generated is clip.recording), **dict.fromkeys(sounds, 0.5)}

    measure = SimpleNamespace(
        groups=GROUPS, cheap=False, variants=Variants(), statistics=ReferenceStatistics(),
        generated=lambda clip: ({"reach": 1.0}, [("sync", "why")]), recording=recording,
        mismatched_sound=mismatched_sound,
        mismatched_motion=lambda clip, other: {"frames": other.n_frames},
    )  # fmt: skip
    a, b, c = measurer().pairs["ours"]
    pairs = [a, replace(a, name="a_s2"), b, c, replace(b, name="b_s2", audio=None),
             replace(c, name="lost", generated=tmp_path / "none.npz")]  # fmt: skip
    one = measurer(measure=measure, length=2.0, pairs={"ours": pairs})
    first, _, _, third, silent, lost = (one.clip("ours", k) for k in range(6))
    assert first == {
        "seconds": 0.4,
        "metrics": {"reach": 1.0},
        "recording": {"reach": 2.0, "in_time_mismatched": 1.0},
        "mismatched": {"in_time": 0.0, "b None": 0.5, "c None": 0.5, "frames": 5},
        "notes": ["0.40 s shorter than 2 times its recording"],
        "problems": [("sync", "why")],
    }
    assert measured == ["a", "b", "c"], "each recording once"
    assert third["mismatched"] == {"in_time": 0.0, "a None": 0.5, "b None": 0.5, "frames": 4}
    assert silent["mismatched"] == {"frames": 6}
    assert lost.keys() == {"reason"} and "none.npz" in lost["reason"]
    stored = one.store.read(one.clip_key("ours", 0))
    assert stored == first | {"problems": [["sync", "why"]]}
    # Without metrics of speech no sound is needed; clips of one recording are a portion.
    one = measurer(measure=replace_in(measure, groups=(POOLED,)), pairs={"ours": pairs})
    measured.clear()
    found = one(ClipGroup({"ours": [1, 0]}))
    assert [(label, index) for label, index, _ in found] == [("ours", 1), ("ours", 0)]
    assert found[0][2]["mismatched"] == {"frames": 5} and measured == ["a_s2"]
    assert found[0][2]["recording"] == {"reach": 2.0}
    one(ClipGroup({"ours": [0]}))
    assert measured == ["a_s2", "a"], "a portion keeps nothing of the one before"


def replace_in(values: SimpleNamespace, **changes) -> SimpleNamespace:
    return SimpleNamespace(**vars(values) | changes)


def test_other_code_and_other_libraries_measure_anew(tmp_path, monkeypatch):
    usual = metric_version()
    assert metric_version() == usual and usual["versions"]["numpy"] == np.__version__
    (tmp_path / "wave.py").write_text("RATE = 1\n")
    with monkeypatch.context() as patch:
        patch.setattr(audio_features, "__file__", str(tmp_path / "__init__.py"))
        assert metric_version() != usual
    assert metric_version() == usual
