"""gesturekit render with diffusion models: each option reaches the model, or is refused by name."""

from pathlib import Path

import numpy as np
import pytest

from gesturekit import Motion
from gesturekit.corpus import Item, Manifest

STYLED = {"styles": ("old", "angry"), "events": ("kick",), "droppable": ("styles",)}


@pytest.fixture
def render(tmp_path, gesturekit):
    """render(model, options...): exit code, the motion if there is one, and what was told."""

    def run(model: Path | str, *options: object) -> tuple[int, Motion | None, str]:
        made = tmp_path / "out" / "motion.npz"
        made.unlink(missing_ok=True)
        asked = ("--model", model, "--out", made.parent, "--format", "npz", *options)
        done = gesturekit("render", *asked)
        return done.status, Motion.load(made) if made.exists() else None, done.err

    return run


@pytest.fixture(scope="module")
def folders(untrained, tmp_path_factory) -> dict[str, Path]:
    """Models on disk: with styles and events, without, and one that follows a path."""
    models = {
        "styled": untrained(**STYLED),
        "plain": untrained(seed=1),
        "walker": untrained(path=True),
    }
    root = tmp_path_factory.mktemp("models")
    for name, model in models.items():
        model.save(root / name)
    return {name: root / name for name in models}


def test_options_reach_the_model(render, folders, untrained):
    options = ["--seconds", 1, "--style", "old:0.25,angry:0.75", "--guidance", 1.5]
    options += ["--events", "kick@0.5:0.2", "--steps", 3, "--solver", "ddim"]
    options += ["--expert", f"{folders['plain']}:0.25", "--expert", f"{folders['styled']}:0.1:old"]
    status, motion, _ = render(folders["styled"], *options)
    assert status == 0
    model = untrained(**STYLED)
    asked = {"style": "old:0.25,angry:0.75", "guidance": 1.5, "events": "kick@0.5:0.2"}
    experts = [(untrained(seed=1), 0.25), (model, 0.1, "old")]
    asked |= {"steps": 3, "solver": "ddim", "experts": experts, "item": "motion"}
    expected = model.generate(seconds=1.0, **asked)
    np.testing.assert_array_equal(motion.rotations, expected.rotations)
    short = ("--seconds", 1, "--steps", 2, "--no-foot-lock")
    options = ("--guidance", 0, "--unconditional", folders["plain"])
    status, motion, _ = render(folders["styled"], *short, *options)
    expected = untrained(seed=1).generate(seconds=1.0, steps=2, foot_lock=False, item="motion")
    np.testing.assert_array_equal(motion.rotations, expected.rotations)
    _, motion, _ = render(folders["plain"], *short, "--dtype", "bf16")
    assert not np.array_equal(motion.rotations, expected.rotations)


def test_a_motion_to_begin_from(render, folders, untrained, gesture, tmp_path):
    gesture(1.5).save(tmp_path / "given.npz")
    options = ["--like", tmp_path / "given.npz", "--style", "old", "--steps", 3]
    model = untrained(**STYLED)
    asked = {"like": gesture(1.5), "style": "old", "steps": 3}
    for change, told in ((0.5, []), (0.1, ["--change", 0.1])):
        _, motion, _ = render(folders["styled"], *options, *told)
        expected = model.generate(**asked, change=change, item="motion")
        np.testing.assert_allclose(motion.rotations, expected.rotations, atol=1e-6)
    status, motion, err = render(folders["styled"], "--change", 0.1, "--seconds", 1)
    assert status == 2 and motion is None and "--change" in err and "--like" in err


def test_events_of_a_manifest_keep_their_durations(render, folders, untrained, gesture, tmp_path):
    """An event that starts before the item, and one that the model does not know, are left out."""
    gesture(3.0).save(tmp_path / "motion.bvh")
    table = "time,name,duration\n0.2,kick,0.1\n1.5,kick,0.3\n2.0,kick,\n2.2,jump,0.5\n"
    (tmp_path / "motion.events.csv").write_text(table)
    about = {"id": "motion", "audio": None, "motion": tmp_path / "motion.bvh", "style": "old"}
    at = {"motion_start": 1.0, "duration": 2.0, "split": "test"}
    item = Item(**about, **at, conditions={"events": tmp_path / "motion.events.csv"})
    Manifest([item]).save(tmp_path / "c.jsonl")
    status, motion, _ = render(folders["styled"], "--corpus", tmp_path / "c.jsonl", "--steps", 3)
    asked = {"seconds": 2.0, "style": "old", "events": "kick@0.5:0.3,kick@1.0", "steps": 3}
    expected = untrained(**STYLED).generate(**asked, item="motion")
    assert status == 0
    np.testing.assert_allclose(motion.rotations, expected.rotations, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "options", "told"),
    [
        ("plain", ["--levels", "2"], "levels"),
        ("styled", ["--expert", "{plain}:0.5@4"], "0.5@4"),
        ("plain", ["--device", "tpu"], "'tpu'"),
        ("demo", ["--expert", "{plain}"], "experts"),
    ],
)
@pytest.mark.parametrize("count", [0, 2])
def test_what_a_model_cannot_do_is_one_line_for_any_number_of_sounds(
    render, folders, write_speech, tmp_path, name, options, told, count
):
    sounds = [write_speech(tmp_path / "in" / f"{k}.wav", 1.0) for k in range(count)]
    options = [option.format(**folders) for option in options]
    options += [] if sounds else ["--seconds", 1]
    status, motion, err = render(folders.get(name, name), *sounds, *options)
    assert status == 2 and motion is None and told in err
    assert "Traceback" not in err and len(err.splitlines()) == 1
