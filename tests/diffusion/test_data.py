"""What a run trains on: recordings, their variants, and the windows drawn from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rigs import nameless, prefixed
from scipy.spatial.transform import Rotation

from gesturekit.corpus import Manifest, prepare
from gesturekit.diffusion.conditions import smooth_path
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import Normaliser
from gesturekit.diffusion.training.batches import Batches
from gesturekit.diffusion.training.corpus import UnpairedRig
from gesturekit.diffusion.training.data import TrainingData, TrainingSequence
from gesturekit.diffusion.training.loading import load_training_data
from gesturekit.diffusion.training.trainer import Trainer, train
from gesturekit.errors import ConfigError, CorpusError
from gesturekit.evaluation.metrics.physical import foot_skate
from gesturekit.formats.tables.root_path import load_root_path
from gesturekit.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.training.run.session import session

PLAIN = {"mirror": False, "stretch": 0.0}


@pytest.fixture
def loaded(make_config):
    """loaded(path=True, ...): the data of a run with these changes, and batches of it."""

    def load(**changes) -> tuple[TrainingData, Batches]:
        config = make_config(**changes)
        data = load_training_data(config)
        return data, Batches(data, config)

    return load


@pytest.fixture
def recorded(tmp_path, write_pair):
    """recorded(4.0, events="time,name..."): a manifest of one recording with tables beside it."""

    def write(seconds: float, fps: float = 30.0, **tables: str) -> str:
        write_pair(tmp_path / "in", "a", seconds, fps=fps)
        for kind, table in tables.items():
            (tmp_path / "in" / f"a.{kind}.csv").write_text(table)
        prepare([tmp_path / "in"], tmp_path / "c.jsonl", holdout=0.0)
        return str(tmp_path / "c.jsonl")

    return write


@pytest.fixture
def styled(corpus, tmp_path):
    """The corpus with a style for each recording."""
    pairs = zip(Manifest.load(corpus).paired(), ("calm", "left"), strict=True)
    Manifest([replace(item, style=style) for item, style in pairs]).save(tmp_path / "styled.jsonl")
    return str(tmp_path / "styled.jsonl")


@pytest.fixture
def idle(tmp_path, gesture):
    """A manifest of motion on a rig with other names, at another frame rate, on another floor."""
    motion = gesture(3.0, 24.0, seed=5)
    rig = replace(motion.skeleton, offsets=1.1 * motion.skeleton.offsets)
    (tmp_path / "idle").mkdir()
    motion = replace(motion, skeleton=rig, translation=motion.translation - [0.0, 0.7, 0.0])
    prefixed(motion).save(tmp_path / "idle" / "i.bvh")
    prepare([], tmp_path / "idle.jsonl", unpaired_motion=[tmp_path / "idle"], holdout=0.0)
    return str(tmp_path / "idle.jsonl")


def test_rows_are_windows_of_recordings_with_their_conditions(loaded):
    data, batches = loaded(augmentation=PLAIN)
    assert [r.n_frames for r in data.recordings] == [180, 75]
    batch = batches.draw(3, slice(0, 4))
    assert batch.clean.shape == batch.noise.shape == (4, 60, data.representation.n_features)
    motion = data.normaliser.inverse(batch.clean).numpy()
    for row in range(4):
        found = [
            (recording, start)
            for recording in data.recordings
            for start in range(recording.n_frames - 59)
            if np.allclose(recording.motion[start : start + 60], motion[row], atol=1e-5)
        ]
        ((recording, start),) = found
        assert np.array_equal(recording.condition[start : start + 60], batch.condition[row])


def flat(name: str, n_frames: int, data: TrainingData, is_paired: bool = True) -> TrainingSequence:
    """A recording whose every number is its length."""
    made = np.full((n_frames, data.representation.n_features), float(n_frames), np.float32)
    condition = np.zeros((n_frames, data.conditions.width), np.float32)
    return TrainingSequence(name, made, condition, is_paired)


@pytest.mark.parametrize(
    ("n_frames", "window"), [(61, 60), (60, 60), (59, 48), (48, 48), (47, 38), (2, 2)]
)
def test_short_recordings_have_windows_shortened_by_a_fifth(loaded, make_config, n_frames, window):
    """They are 48, 38, 30, 24, 19, 15, 12, 9, 7, 5, 4, 3 and 2 frames of 60, however stretched."""
    changes = {"augmentation": {"mirror": False, "stretch": 1.0, "stretch_range": 0.5}}
    data, _ = loaded(**changes)
    data = replace(data, recordings=(flat("a", n_frames, data),))
    batch = Batches(data, make_config(**changes)).draw(0, slice(0, 4))
    assert batch.clean.shape[:2] == batch.condition.shape[:2] == (4, window)


def test_all_frames_are_drawn_alike_and_motion_alone_for_its_share(loaded, make_config, idle):
    """A quarter of the windows are without speech; of the others, as many as there are frames.

    Recordings of 180, 60 and 40 frames, the last in windows of its own: 9/28, 3/28 and 2/28 times
    3/2.
    """
    changes = {"unpaired": {"corpus": idle, "share": 0.25}, "augmentation": PLAIN}
    data, _ = loaded(**changes)
    lengths = {180: True, 60: True, 40: True, 90: False}
    recordings = tuple(flat(f"r{n}", n, data, paired) for n, paired in lengths.items())
    normaliser = Normaliser(torch.zeros(1), torch.ones(1))
    data = replace(data, recordings=recordings, normaliser=normaliser)
    batches = Batches(data, make_config(**changes))
    drawn = [batches.draw(update, slice(0, 2)).clean for update in range(600)]
    found = np.array([[float(row[0, 0]) for row in clean] for clean in drawn])
    shares = [float(np.mean(found == n)) for n in lengths]
    wanted = [0.75 * n / 280 for n in (180, 60, 40)] + [0.25]
    assert shares == pytest.approx(wanted, abs=0.04)
    assert {clean.shape[1] for clean in drawn} == {60, 38}
    assert all(len(set(row)) == 1 for row in found if 40 in row), "a batch has one length"


def test_a_row_depends_on_neither_its_neighbours_nor_what_was_drawn_before(loaded):
    whole, batches = (loaded()[1] for _ in range(2))
    whole = whole.draw(5, slice(0, 4))
    parts = [batches.draw(update, rows) for update, rows in ((9, slice(0, 4)), (5, slice(2, 4)))]
    for name, value in vars(parts[1]).items():
        assert torch.equal(value, getattr(whole, name)[2:])
    assert len({float(noise[0, 0]) for noise in [*whole.noise, *parts[0].noise]}) == 8


def test_motion_is_normalised_and_comes_back(loaded, corpus):
    data, _ = loaded(augmentation=PLAIN)
    every = torch.cat([torch.from_numpy(r.motion) for r in data.recordings])
    every = data.normaliser.forward(every)
    assert every.mean(0).abs().max() < 1e-3 and every.std(0).max() < 1.01
    back = data.decode(data.recordings[0].motion, data.recordings[0].condition, 30.0)
    recorded = Manifest.load(corpus).paired()[0].load_motion()
    # It begins above the origin and faces +Z, wherever it was recorded.
    places = (motion.positions() for motion in (back, recorded))
    assert np.allclose(*(np.linalg.norm(p[:, 1:] - p[:, :1], axis=-1) for p in places), atol=1e-4)


@pytest.mark.parametrize("fps", [20.0, 60.0])
def test_a_root_that_stands_is_scaled_by_the_same_speed_at_any_rate(loaded, fps):
    made, _ = loaded(fps=fps, augmentation=PLAIN)
    given, _ = loaded(fps=fps, augmentation=PLAIN, path=True, features=None)
    own = made.normaliser.scale[made.representation.root_columns][1:].numpy()
    for forward, lateral in (own, given.conditions.path_scale[1:]):
        assert (forward * fps, lateral * fps) == pytest.approx((0.015, 0.015))


@pytest.mark.parametrize("path", [False, True])
def test_a_body_that_keeps_still_is_scaled_by_small_movement(loaded, gesture, tmp_path, path):
    """0.01 rad, 2 mm, and 0.03 rad and 15 mm a second."""
    still = gesture(2.0)
    still.rotations[:], still.translation[:] = still.rotations[:1], still.translation[:1]
    (tmp_path / "in").mkdir()
    still.save(tmp_path / "in" / "still.bvh")
    prepare([], tmp_path / "c.jsonl", unpaired_motion=[tmp_path / "in"], holdout=0.0)
    changes = {"corpus": str(tmp_path / "c.jsonl"), "features": None, "path": path}
    data, _ = loaded(**changes, augmentation=PLAIN)
    steps = np.array([0.03, 0.015, 0.015]) / 30
    scale, made = data.normaliser.scale.numpy(), data.representation
    own = np.concatenate([np.full(made.height_column, 0.01), [0.002], () if path else steps])
    assert scale == pytest.approx(own)
    assert data.conditions.path_scale == pytest.approx(steps if path else [1.0, 1.0, 1.0])


def test_changes_are_root_mean_squares_and_at_least_a_tenth_of_their_median(loaded):
    data, _ = loaded(augmentation=PLAIN)
    # In units of 2: 1.5 and 2, 0.5 and 0.5, 1 and 1; the rest is below a tenth of 0.5.
    motion = np.array([[9, 0, 0, 5, 0], [12, 1, 2, 5, 0.01], [16, 2, 4, 5, 0.02]], np.float32)
    normaliser = Normaliser(torch.ones(5), torch.full((5,), 2.0))
    recordings = (TrainingSequence("a", motion, motion), TrainingSequence("b", 9 - motion, motion))
    data = replace(data, recordings=recordings, normaliser=normaliser)
    expected = [np.sqrt((1.5**2 + 2**2) / 2), 0.5, 1.0, 0.05, 0.05]
    assert data.changes().tolist() == pytest.approx(expected)
    expected[0] = 2.0
    assert replace(data, sampled=((1, 1, 3),)).changes().tolist() == pytest.approx(expected)
    still = replace(data, recordings=(TrainingSequence("a", 0 * motion, motion),))
    assert still.changes().tolist() == pytest.approx([1e-6] * 5)


def test_the_log_names_inputs_recordings_and_variants(make_config, styled, idle, caplog):
    caplog.set_level("INFO")
    styled = {"corpus": styled, "styles": {"handed": ["left"]}, "unpaired": {"corpus": idle}}
    bare = {"features": None, "augmentation": PLAIN}
    for number, changes in enumerate((styled, bare, {**bare, "path": True})):
        config = make_config(**changes)
        config = replace(config, out=config.out / str(number))
        with session(config, resume=False) as (run, device, processes):
            Trainer(config, run, device, processes, resume=False)
    said = [line for line in caplog.messages if not line.startswith("Measured")]
    assert [line.partition("run/")[2] or line for line in said] == [
        "0: diffusion, from speech and styles, 6 updates (longer=1).",
        "Training on 2 recordings, 8 s at 30 fps, 3 s of unpaired motion, 5 sequences with their "
        "variants, 28 features, 2 styles, 19 of 19 joints modelled.",
        "1: diffusion, no condition, 6 updates (longer=1).",
        "Training on 2 recordings, 8 s at 30 fps, 19 of 19 joints modelled.",
        "2: diffusion, from path, 6 updates (longer=1).",
        said[3],
    ]


def test_one_line_says_what_a_rig_without_known_parts_costs(make_config, gesture, tmp_path, caplog):
    caplog.set_level("INFO")
    (tmp_path / "in").mkdir()
    nameless(gesture(3.0))[0].save(tmp_path / "in" / "a.bvh")
    prepare([], tmp_path / "c.jsonl", unpaired_motion=[tmp_path / "in"], holdout=0.0)
    common = {"corpus": str(tmp_path / "c.jsonl"), "features": None}
    sliding = {"noise": {"predict": "clean"}, "training": {"foot_sliding": 0.5}}
    for number, (changes, follows) in enumerate(
        [
            (sliding, "no mirrored recordings, no loss on foot sliding, all joints are modelled"),
            ({"joints": "all"}, "no mirrored recordings"),
            ({"augmentation": PLAIN, "joints": "all"}, None),
        ]
    ):
        caplog.clear()
        config = make_config(**common, **changes, out=str(tmp_path / str(number)))
        with session(config, resume=False) as (run, device, processes):
            Trainer(config, run, device, processes, resume=False)
        lines = [text for text in caplog.messages if "cannot be identified" in text]
        assert len(lines) == (follows is not None)
        assert not lines or f" of the rig cannot be identified: {follows}. If it" in lines[0]
        assert not lines or lines[0][0].isupper()


def test_mirrored_recordings_turn_the_other_way_and_handed_styles_have_none(loaded, styled):
    data, _ = loaded(corpus=styled, styles={"handed": ["left"]})
    assert [r.name for r in data.recordings] == ["a", "b", "a (mirrored)"]
    steps = data.representation.root_columns
    one, other = data.recordings[0].motion[:, steps], data.recordings[2].motion[:, steps]
    assert np.abs(one).max() > 1e-3
    assert np.allclose(one * [-1, 1, -1], other, atol=1e-6)
    assert np.array_equal(data.recordings[0].condition, data.recordings[2].condition)
    with pytest.raises(ConfigError, match="styles.handed: 'right' is not a style"):
        loaded(corpus=styled, styles={"handed": ["right"]})


def test_dropped_conditions_are_zero(loaded, styled):
    told = []
    for share in ({}, {"dropout_style": 1.0}, {"dropout_condition": 1.0}, {"dropout_style": 0.5}):
        data, batches = loaded(corpus=styled, styles={}, training={**share, "batch": 64})
        told.append(batches.draw(0, slice(0, 64)).condition)
    styles, speech = data.conditions.columns["styles"], data.conditions.columns["speech"]
    assert (told[0][..., styles].sum(-1) == 1).all()
    assert not told[1][..., styles].any() and told[1][..., speech].any()
    assert not told[2].any()
    kept = told[3][:, 0, styles].sum(-1)
    assert 16 < kept.sum() < 48


def test_unpaired_motion_on_another_rig_is_retargeted(loaded, idle):
    unpaired = {"corpus": idle, "share": 0.25}
    data, batches = loaded(unpaired=unpaired, augmentation=PLAIN, training={"batch": 200})
    (alone,) = [r for r in data.recordings if not r.is_paired]
    assert alone.n_frames == 90 and not alone.condition.any()
    assert data.seconds == (pytest.approx(8.5), pytest.approx(3.0))
    # The arms hang and swing as they did on the other rig.
    arm = data.representation.joint_columns("LeftArm")
    paired = data.recordings[0].motion[:, arm]
    assert np.abs(alone.motion[:, arm].mean(0) - paired.mean(0)).max() < 0.1
    height = data.representation.height_column
    paired = data.recordings[0].motion[:, height]
    assert abs(alone.motion[:, height].mean() - paired.mean()) < 0.02
    untold = ~batches.draw(0, slice(0, 200)).condition.flatten(1).any(1)
    assert 30 < untold.sum() < 70
    with pytest.raises(CorpusError, match=r"no item .* is motion alone; name a manifest"):
        loaded(unpaired={})


def test_arrays_of_unpaired_motion_depend_on_the_recording_whose_rig_they_are_on(
    tmp_path, gesture, idle
):
    (item,) = Manifest.load(idle)
    usual = gesture(1.0)
    rig = UnpairedRig(tmp_path / "c.jsonl", Path(idle), {}, usual)
    taller = replace(usual.skeleton, offsets=1.1 * usual.skeleton.offsets)
    for changed in (
        replace(usual, skeleton=taller),
        replace(usual, translation=usual.translation + [0.0, 0.1, 0.0]),
        gesture(1.0, seed=9),
    ):
        assert replace(rig, usual=changed).origin(item) != rig.origin(item)
    assert replace(rig, usual=gesture(1.0)).origin(item) == rig.origin(item)
    assert rig.origin(replace(item, motion_start=0.5)) != rig.origin(item)


def test_a_path_is_a_condition_and_is_followed(loaded, recorded):
    corpus = recorded(4.0, path="time,x,z,heading\n0,0,0,0\n2,1,2,90\n4,3,2,90\n")
    data, _ = loaded(corpus=corpus, path=True, features=None)
    assert data.conditions.width == 3 and not data.representation.makes_root
    path = smooth_path(Manifest.load(corpus).items[0].load_path(30.0, 120), 30.0, 120)
    for recording, side in zip(data.recordings, (1, -1), strict=True):
        motion = data.decode(recording.motion, recording.condition, 30.0)
        root = motion.positions()[:, 0]
        steps = np.diff(path.positions, axis=0) * [side, 1]
        turned = np.linalg.norm(np.diff(root[:, [0, 2]], axis=0), axis=-1)
        assert np.allclose(turned, np.linalg.norm(steps, axis=-1), atol=1e-6)
    # Turn and lateral change sign, each about what zero was normalised to.
    zero = -data.conditions.path_mean / data.conditions.path_scale
    one, other = (recording.condition - zero for recording in data.recordings)
    assert np.abs(one).max() > 0.5 and np.allclose(one * [-1, 1, -1], other, atol=1e-4)


def test_stretched_windows_of_a_straight_path_stay_straight(loaded, tmp_path, gesture):
    """Only speed changes, by up to a tenth; so it does for a path that turns at a constant rate."""
    time = np.arange(180) / 30
    ways = {"straight": 0.0 * time, "turning": 0.5 * time}  # headings, radians
    (tmp_path / "in").mkdir()
    for name, heading in ways.items():
        walk = gesture(6.0)
        steps = 0.03 * np.stack([np.sin(heading), np.cos(heading)], axis=1)
        walk.translation[:, [0, 2]] = np.cumsum(steps, axis=0)
        walk.rotations[:, 0] = Rotation.from_euler("y", heading[:, None]).as_quat()
        walk.save(tmp_path / "in" / f"{name}.bvh")
    prepare([], tmp_path / "c.jsonl", unpaired_motion=[tmp_path / "in"], holdout=0.0)
    told = {"path": True, "features": None, "augmentation": {"mirror": False, "stretch": 1.0}}
    data, batches = loaded(corpus=str(tmp_path / "c.jsonl"), **told, training={"batch": 40})
    conditions = batches.draw(0, slice(0, 40)).condition[:, 10:-10].numpy()
    conditions = conditions * data.conditions.path_scale + data.conditions.path_mean
    turn, forward, lateral = np.moveaxis(conditions, -1, 0)
    straight = np.abs(turn).max(axis=1) < 0.008
    assert 5 < straight.sum() < 35
    assert np.abs(turn[straight]).max() < 1e-4 and np.abs(lateral[straight]).max() < 1e-4
    rates = {"forward": forward[straight] / 0.03, "turn": turn[~straight] / (0.5 / 30)}
    for rate in rates.values():
        assert 0.85 < rate.min() < 0.95 and 1.05 < rate.max() < 1.15


def test_events_keep_their_frames_however_windows_are_stretched(loaded, recorded):
    table = "time,name\n" + "".join(f"{k / 30:.4f},kick\n" for k in range(0, 120, 10))
    corpus, changes = recorded(4.0, events=table), {"augmentation": {"stretch": 1.0}}
    data, batches = loaded(corpus=corpus, events=True, **changes, training={"batch": 20})
    assert data.conditions.events == ("kick",)
    flags = batches.draw(0, slice(0, 20)).condition[..., -1]
    assert set(flags.unique().tolist()) == {0.0, 1.0}
    # A kick every ten frames, give or take a tenth, whatever the speed.
    assert (flags.sum(1) >= 5).all() and (flags.sum(1) <= 8).all()
    with pytest.raises(CorpusError, match="no training item has events"):
        loaded(events=True)


def test_both_halves_of_a_recording_at_twice_the_frame_rate(loaded, recorded):
    one, other = loaded(corpus=recorded(3.0, fps=60.0), augmentation=PLAIN)[0].recordings
    assert (one.name, other.name) == ("a", "a (phase 2)")
    # Between two frames of the one lies a frame of the other, with the speech of its own time.
    between = (one.motion[:-1, :-3] + one.motion[1:, :-3]) / 2
    assert np.abs(between[: len(other.motion)] - other.motion[: len(between), :-3]).max() < 0.01
    n = min(one.n_frames, other.n_frames)
    assert not np.array_equal(one.condition[:n], other.condition[:n])
    assert np.corrcoef(one.condition[:n].ravel(), other.condition[:n].ravel())[0, 1] > 0.8


def test_a_resumed_run_reads_the_same_data(make_config, styled, tmp_path):
    config = make_config(corpus=styled, styles={}, path=True)
    data = load_training_data(config)
    data.save(tmp_path / "data")
    back = TrainingData.load(tmp_path / "data", config)
    one, other = (Batches(d, config).draw(0, slice(0, 4)) for d in (data, back))
    assert all(torch.equal(value, getattr(other, name)) for name, value in vars(one).items())
    assert back.seconds == data.seconds and back.conditions.width == data.conditions.width
    (tmp_path / "data" / "data.safetensors").write_bytes(b"none")
    with pytest.raises(ConfigError, match="training data cannot be read"):
        TrainingData.load(tmp_path / "data", config)


def test_a_run_goes_on_from_a_model_with_its_rig_and_normalisation(make_config, idle, tmp_path):
    model = train(make_config(unpaired={"corpus": idle}, out=str(tmp_path / "before")))
    config = make_config(start_from=str(model), training={"updates": 1, "learning_rate": 1e-9})
    data = load_training_data(config)
    start = DiffusionModel.load(model)
    assert torch.equal(data.normaliser.mean, start.normaliser.mean)
    assert np.array_equal(data.conditions.conditioner.centre, start.conditions.conditioner.centre)
    after = DiffusionModel.load(train(config)).network.state_dict()
    for name, value in start.network.state_dict().items():
        assert torch.allclose(value, after[name], atol=1e-6)
    for wrong, told in (
        ({"features": None}, "has features .* this run None"),
        ({"network": {"channels": 8}}, "has network.channels 16, this run 8"),
        ({"fps": 25.0}, "has fps 30.0, this run 25.0"),
    ):
        with pytest.raises(ConfigError, match=told):
            load_training_data(make_config(start_from=str(model), **wrong))


def test_a_run_stopped_before_a_checkpoint_starts_there_again(make_config, tmp_path, monkeypatch):
    model = train(make_config(out=str(tmp_path / "before"), training={"updates": 1}))
    training = {"updates": 1, "learning_rate": 1e-9}
    config = make_config(start_from=str(model), training=training, seed=1)

    def stop(*_):
        raise RuntimeError("power failure")

    with monkeypatch.context() as patch:
        patch.setattr(Batches, "draw", stop)
        with pytest.raises(RuntimeError, match="power failure"):
            train(config)
    (model / "config.yaml").rename(tmp_path / "gone.yaml")
    after = DiffusionModel.load(train(config, resume=True)).network.state_dict()
    (tmp_path / "gone.yaml").rename(model / "config.yaml")
    for name, value in DiffusionModel.load(model).network.state_dict().items():
        assert torch.allclose(value, after[name], atol=1e-6), name


@pytest.fixture
def on_path(loaded, tmp_path):
    """on_path(...): the data of a run that follows the paths of the folder's motions."""

    def load(**changes) -> TrainingData:
        prepare([], tmp_path / "c.jsonl", unpaired_motion=[tmp_path], holdout=0.0)
        changes = {"features": None, "path": True, **changes}
        return loaded(corpus=str(tmp_path / "c.jsonl"), **changes)[0]

    return load


def table(path: RootPath) -> str:
    rows = zip(np.arange(path.n_frames) / path.fps, *path.positions.T, path.headings, strict=True)
    lines = (f"{t:.6f},{x:.6f},{z:.6f},{np.degrees(angle):.6f}" for t, x, z, angle in rows)
    return "\n".join(["time,x,z,heading", *lines])


@pytest.mark.parametrize("has_table", [False, True])
def test_feet_do_not_slide_on_a_smooth_path_nor_on_one_with_its_own_origin(
    shared_data, on_path, tmp_path, has_table
):
    walk = Motion.load(shared_data / "motion/bandai/dataset-1_bow_angry_001.bvh")
    walk.save(tmp_path / "a.bvh")
    if has_table:
        path = RootPath.of(walk)
        moved = RootPath(path.positions + [3.0, -2.0], path.headings, path.fps)
        (tmp_path / "a.path.csv").write_text(table(moved))
    data = on_path()
    assert [r.name for r in data.recordings] == ["a", "a (mirrored)"]
    for recording in data.recordings:
        motion = data.decode(recording.motion, recording.condition, 30.0)
        assert foot_skate(motion) < 1.25 * foot_skate(walk)


def test_every_phase_of_a_fast_recording_is_on_the_path_of_its_own_time(on_path, tmp_path, gesture):
    gesture(4.0, 60.0).save(tmp_path / "a.bvh")
    at = np.arange(240) / 60
    swing = RootPath(np.outer(at**2, [0.2, 0.1]), 0.3 * at**2, 60.0)
    (tmp_path / "a.path.csv").write_text(table(swing))
    assert load_root_path(tmp_path / "a.path.csv").fps == 60
    data = on_path(augmentation={"mirror": False})
    assert [r.name for r in data.recordings] == ["a", "a (phase 2)"]
    for phase, recording in enumerate(data.recordings):
        told = data.decode(recording.motion, recording.condition, 30.0)
        own = RootPath.of(told, side=data.representation.side)
        frames = np.arange(20, 80)
        speed = np.linalg.norm([0.2, 0.1]) * 2 * ((frames + 0.5) / 30 + phase / 60)
        assert own.speeds[20:80] == pytest.approx(speed, abs=2e-4)
