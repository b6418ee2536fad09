"""Preparation, training and rendering on any rig: without legs, arms or meaningful names."""

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import Bones, rig_of
from scipy.spatial.transform import Rotation
from small_runs import small_values
from sounds import voiced

import gesturekit as gk
from gesturekit.corpus import Item, Manifest, prepare
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import unidentified
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import rotation_angles

SYSTEMS = ("multires", "diffusion")
SECONDS = {  # a training of seconds
    "multires": {"training": {"window": 1.0, "first_stage": 2, "further_stages": 2}},
    "diffusion": {"training": {"window": 1.0, "updates": 2, "batch": 2}},
}


def chain(names: list[str], parent: str | None, *offsets: tuple[float, float, float]) -> Bones:
    bones: Bones = {}
    for number, name in enumerate(names):
        bones[name] = (parent, offsets[min(number, len(offsets) - 1)])
        parent = name
    return bones


def quadruped() -> Bones:
    bones = chain(["Root", "Back", "Withers", "Skull"], None, (0, 0, 0), (0, 0, 0.4), (0, 0.1, 0.3))
    for side, x in (("L", 0.15), ("R", -0.15)):
        for end, above in (("Fore", "Withers"), ("Hind", "Root")):
            names = [f"{side}_{end}{part}" for part in ("Upper", "Lower", "Paw")]
            bones |= chain(names, above, (x, -0.1, 0.0), (0, -0.3, 0.05))
    return bones


def crab() -> Bones:
    bones: Bones = {"Shell": (None, (0, 0, 0))}
    for number in range(10):
        angle = np.pi * number / 5
        out = (np.cos(angle), 0.0, np.sin(angle))
        bones |= chain([f"Claw{number}_{k}" for k in range(3)], "Shell", out, (0.3, -0.2, 0.0))
    return bones


def person(skeleton: Skeleton, *without: str) -> Bones:
    names = [name for name in skeleton.names if not name.startswith(without)]
    parents = [skeleton.parents[skeleton.index(name)] for name in names]
    return {
        name: (
            None if parent < 0 else skeleton.names[parent],
            tuple(skeleton.offsets[skeleton.index(name)]),
        )
        for name, parent in zip(names, parents)
    }


RIGS: dict[str, Callable[[Skeleton], Bones]] = {
    "quadruped": lambda _: quadruped(),
    "crab": lambda _: crab(),
    "snake": lambda _: chain([f"Link{k}" for k in range(12)], None, (0.0, 0.0, 0.2)),
    "one arm": lambda person_: person(person_, "RightShoulder", "RightArm", "RightFore", "RightH"),
    "no head": lambda person_: person(person_, "Neck", "Head"),
    "no legs": lambda person_: person(
        person_, *(side + bone for side in ("Left", "Right") for bone in ("UpLeg", "Leg", "Foot"))
    ),
    "Chinese": lambda _: chain(["根", "脊椎", "头"], None, (0, 0.4, 0)),
    "300 joints": lambda _: (
        {"hub": (None, (0.0, 0.0, 0.0))}
        | {
            name: bone
            for k in range(23)
            for name, bone in chain([f"{k}.{n}" for n in range(13)], "hub", (0.1, 0, 0.1)).items()
        }
    ),
}


def moving(bones: Bones, seconds: float = 2.0, fps: float = 30.0, seed: int = 0) -> Motion:
    rig = rig_of(bones)
    n_frames = round(seconds * fps)
    time = np.arange(n_frames)[:, None, None] / fps
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (rig.n_joints, 3))
    turns = Rotation.from_euler("xyz", (0.2 * np.sin(4 * time + phase)).reshape(-1, 3))
    place = [0.1, 0.02, 0.1] * np.sin(3 * time[:, 0] + phase[0]) + [0.0, 0.9, 0.0]
    return Motion(rig, turns.as_quat().reshape(n_frames, rig.n_joints, 4), place, fps)


def prepared(folder: Path, motions: dict[str, Motion], suffix: str = "bvh") -> Path:
    """Prepare motions and return their manifest; each motion's name is also its style."""
    for name, motion in motions.items():
        motion.save(folder / "clips" / f"{name}.{suffix}")
    out = folder / "corpus.jsonl"
    report = prepare(
        [], out, unpaired_motion=[folder / "clips"], holdout=0.0, style_pattern="(?P<style>.+)"
    )
    assert len(report.manifest) == len(motions), report.problems
    return out


def trained(system: str, corpus: Path, out: Path, **changes) -> Path:
    settings = {"features": None, "fps": 30.0, **changes}
    values = small_values(system, corpus, out, SECONDS[system], settings)
    config = out.with_suffix(".yaml")
    config.write_text(json.dumps(values), encoding="utf-8")
    return Path(gk.train(config))


def check_all(
    folder: Path, bones: Bones, system: str, labels: bool, formats: tuple[str, ...], watch: int = 0
):
    """Prepare, train and render; return the model."""
    motions = {f"s{seed}": moving(bones, seed=seed) for seed in range(2)}
    corpus = prepared(folder, motions)
    styles = {"styles": {}} if labels else {}
    model = gk.load(trained(system, corpus, folder / "run", eval_every=watch, **styles))
    assert sorted(model.skeleton.names) == sorted(bones)
    controls = {"style": "s1"} if labels else {}
    made = gk.render(model, (), folder / "out", seconds=1.0, formats=formats, **controls)
    assert [outcome.error for outcome in made] == [None]
    for file in made[0].files:
        assert file.stat().st_size > 0
    again = Motion.load(folder / "out" / "motion.bvh")
    assert again.n_frames == 30 and len(again.skeleton.names) == len(bones)
    return model


@pytest.mark.parametrize(("name", "system"), [("crab", "multires"), ("one arm", "diffusion")])
def test_a_rig_without_some_parts_can_be_trained_and_rendered(
    name, system, skeleton, tmp_path, caplog
):
    with caplog.at_level(logging.INFO):
        model = check_all(tmp_path, RIGS[name](skeleton), system, name == "crab", ("bvh",))
    assert unidentified(model.skeleton)
    assert caplog.text.count("parts:") == 1
    assert ("feet" in caplog.text) == (name == "crab")


@pytest.mark.stress
@pytest.mark.parametrize("labels", [False, True], ids=["free", "styles"])
@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("name", RIGS)
def test_every_rig_trains_in_every_mode_and_is_drawn(name, system, labels, skeleton, tmp_path):
    bones = RIGS[name](skeleton)
    check_all(tmp_path, bones, system, labels, ("bvh", "npz", "html", "png"), watch=2)


RATES = [(10.0, "multires"), (240.0, "multires"), (240.0, "diffusion")]


@pytest.mark.parametrize(
    ("fps", "system"),
    [(10.0, "diffusion"), *(pytest.param(*case, marks=pytest.mark.stress) for case in RATES)],
)
def test_recordings_of_any_rate_train(fps, system, gesture, tmp_path):
    corpus = prepared(tmp_path, {"one": gesture(3.0, fps)})
    model = gk.load(trained(system, corpus, tmp_path / "run", fps=fps))
    made = model.generate(seconds=0.5)
    assert (made.fps, made.n_frames) == (fps, fps / 2)


@pytest.mark.parametrize("system", ["diffusion"])
def test_repeated_joint_names_and_names_with_spaces_train(system, gesture, tmp_path):
    file = tmp_path / "clips" / "twins.bvh"
    gesture(2.0).save(file)
    text = file.read_text().replace("RightForeArm", "LeftForeArm").replace("Head", "the  head ")
    file.write_text(text)
    prepare([], tmp_path / "c.jsonl", unpaired_motion=[tmp_path / "clips"], holdout=0.0)
    model = gk.load(trained(system, tmp_path / "c.jsonl", tmp_path / "run"))
    assert {"LeftForeArm", "LeftForeArm_2"} <= set(model.skeleton.names)
    assert model.generate(seconds=0.5).n_frames == 15


def test_speech_modulates_all_joints_of_a_rig_without_an_identified_upper_body(
    write_speech, tmp_path, caplog
):
    moving(crab(), 2.0).save(tmp_path / "a.bvh")
    write_speech(tmp_path / "a.wav", 2.0)
    corpus = tmp_path / "corpus.jsonl"
    report = prepare([tmp_path], corpus, holdout=0.0)
    notes = " ".join(str(problem) for problem in report.problems)
    assert "speech" in notes and "--part" in notes
    model = gk.load(trained("multires", corpus, tmp_path / "run", features={}))
    assert "--part" in caplog.text, "which names what the rig has"
    said, silent = (model.generate((sound, 16_000)) for sound in (voiced(1.0), np.zeros(16_000)))
    assert (rotation_angles(said.rotations, silent.rotations).max(axis=0) > 0).all()


def manifest_of(folder: Path, motions: dict[str, Motion]) -> Path:
    """Write a manifest without `prepare`, whose checks would refuse odd sizes."""
    items = []
    for name, motion in motions.items():
        path = folder / f"{name}.npz"
        motion.save(path)
        items.append(Item(id=name, audio=None, motion=path, duration=motion.duration, style=name))
    Manifest(items).save(folder / "corpus.jsonl")
    return folder / "corpus.jsonl"


def losses(run: Path) -> list[dict[str, float]]:
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [
        {key: value for key, value in row.items() if "seconds" not in key and key != "time"}
        for row in rows
        if "kind" not in row  # metrics on held-out data at the end of training
    ]


EVERY_LOSS = {"losses": {"detail": 1.0, "coarse": 1.0}}
WAYS = {
    "multires": ("multires", EVERY_LOSS),
    "multires by style": ("multires", {"styles": {}, **EVERY_LOSS}),
    "diffusion": ("diffusion", {}),
    "diffusion on a path": ("diffusion", {"path": True}),
}


def at_scale(factor: float, motions: dict[str, Motion], way: str, folder: Path):
    """Train two steps on scaled motions; return the losses, the model and a generated motion."""
    system, changes = WAYS[way]
    bodies = {name: motion.scaled(factor) for name, motion in motions.items()}
    corpus = manifest_of(folder, bodies)
    model = gk.load(trained(system, corpus, folder / "run", log_every=1, **changes))
    places = factor * np.linspace([0.0, 0.0], [0.4, 1.0], 60)
    told = {"path": RootPath.looking_ahead(places, 30.0, factor), "seconds": 2.0}
    if way == "diffusion":
        del told["path"]
    if "styles" in changes:
        told["style"] = "a"
    return losses(folder / "run"), model, model.generate(**told, foot_lock=False)


def check_scale(factor: float, motions: dict[str, Motion], way: str, folder: Path) -> None:
    usual, model, made = at_scale(1.0, motions, way, folder / "1")
    rows, other, larger = at_scale(factor, motions, way, folder / "c")
    assert other.representation.scale == pytest.approx(factor * model.representation.scale)
    assert len(rows) == len(usual) > 1
    for row, expected in zip(rows, usual):
        assert row == pytest.approx(expected, rel=1e-4, abs=1e-6)
    weights = model.network.state_dict()
    for name, values in other.network.state_dict().items():
        torch.testing.assert_close(values, weights[name], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(larger.positions() / factor, made.positions(), atol=1e-3)


SLOW = [(0.1, way) for way in WAYS if way != "diffusion"] + [(10.0, way) for way in WAYS]


@pytest.mark.parametrize(
    ("factor", "way"),
    [(0.1, "diffusion"), *(pytest.param(*case, marks=pytest.mark.stress) for case in SLOW)],
)
def test_training_does_not_depend_on_the_size_of_the_rig(factor, way, gesture, tmp_path):
    check_scale(factor, {"a": swaying(gesture, 1), "b": swaying(gesture, 2)}, way, tmp_path)


def swaying(gesture, seed: int) -> Motion:
    motion = gesture(2.0, seed=seed)
    way = [0.1, 0.02, 0.1] * np.sin(3 * motion.times[:, None] + [0.0, 1.0, 2.0])
    return replace(motion, translation=motion.translation + way)
