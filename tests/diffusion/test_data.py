"""What a run trains on: recordings, their variants, and the windows drawn from them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import prefixed

from gesturekit.corpus import Manifest, prepare
from gesturekit.diffusion import DiffusionModel, train
from gesturekit.diffusion.conditions import smooth_path
from gesturekit.diffusion.training.batches import Batches
from gesturekit.diffusion.training.data import TrainingData
from gesturekit.diffusion.training.loading import load_training_data
from gesturekit.errors import ConfigError, CorpusError

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
    assert [r.n_frames for r in data.recordings] == [120, 75]
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


def test_a_row_depends_on_neither_its_neighbours_nor_what_was_drawn_before(loaded):
    whole, batches = (loaded()[1] for _ in range(2))
    whole = whole.draw(5, slice(0, 4))
    parts = [batches.draw(update, rows) for update, rows in ((9, slice(0, 4)), (5, slice(2, 4)))]
    for name, value in vars(parts[1]).items():
        assert torch.equal(value, getattr(whole, name)[2:])
    assert len({float(noise[0, 0]) for noise in [*whole.noise, *parts[0].noise]}) == 8


def test_mirrored_recordings_turn_the_other_way_and_handed_styles_have_none(loaded, styled):
    data, _ = loaded(corpus=styled, styles={"handed": ["left"]})
    assert [r.name[0] for r in data.recordings] == ["a", "b", "a"]
    steps = data.representation.root_columns
    one, other = data.recordings[0].motion[:, steps], data.recordings[2].motion[:, steps]
    assert np.abs(one).max() > 1e-3
    assert np.allclose(one * [-1, 1, -1], other, atol=1e-6)
    assert np.array_equal(data.recordings[0].condition, data.recordings[2].condition)
    with pytest.raises(ConfigError, match="(?=.*styles.handed)(?=.*right)"):
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
    assert data.seconds == pytest.approx(6.5) and data.unpaired_seconds == pytest.approx(3.0)
    # The arms hang and swing as they did on the other rig.
    arm = np.arange(3) + 3 * data.representation.joints.index("LeftArm")
    paired = data.recordings[0].motion[:, arm]
    assert np.abs(alone.motion[:, arm].mean(0) - paired.mean(0)).max() < 0.1
    height = data.representation.height_column
    paired = data.recordings[0].motion[:, height]
    assert abs(alone.motion[:, height].mean() - paired.mean()) < 0.02
    untold = ~batches.draw(0, slice(0, 200)).condition.flatten(1).any(1)
    assert 30 < untold.sum() < 70
    with pytest.raises(CorpusError, match=r"(?=.*quick\.jsonl)(?=.*unpaired\.corpus)"):
        loaded(unpaired={})


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


def test_events_keep_their_frames_however_windows_are_stretched(loaded, recorded):
    table = "time,name\n" + "".join(f"{k / 30:.4f},kick\n" for k in range(0, 120, 10))
    corpus, changes = recorded(4.0, events=table), {"augmentation": {"stretch": 1.0}}
    data, batches = loaded(corpus=corpus, events=True, **changes, training={"batch": 20})
    assert data.conditions.events == ("kick",)
    flags = batches.draw(0, slice(0, 20)).condition[..., -1]
    assert set(flags.unique().tolist()) == {0.0, 1.0}
    # A kick every ten frames, give or take a tenth, whatever the speed.
    assert (flags.sum(1) >= 5).all() and (flags.sum(1) <= 8).all()
    with pytest.raises(CorpusError, match=r"(?=.*quick\.jsonl)(?=.*events)"):
        loaded(events=True)


def test_a_run_goes_on_from_a_model_with_its_rig_and_normalisation(make_config, idle, tmp_path):
    short, before = {"training": {"updates": 1}}, str(tmp_path / "before")
    model = train(make_config(unpaired={"corpus": idle}, out=before, **short))
    config = make_config(start_from=str(model), training={"updates": 1, "learning_rate": 1e-9})
    data = load_training_data(config)
    start = DiffusionModel.load(model)
    assert start.droppable == ("all",), "unpaired motion has no condition"
    assert torch.equal(data.normaliser.mean, start.normaliser.mean)
    assert np.array_equal(data.conditions.conditioner.centre, start.conditions.conditioner.centre)
    after = DiffusionModel.load(train(config)).network.state_dict()
    for name, value in start.network.state_dict().items():
        assert torch.allclose(value, after[name], atol=1e-6)
    for wrong, told in (
        ({"features": None}, "(?=.*features)(?=.*None)"),
        ({"network": {"channels": 8}}, r"(?=.*network.channels)(?=.*\b16\b)(?=.*\b8\b)"),
        ({"fps": 25.0}, r"(?=.*fps)(?=.*\b30\b)(?=.*\b25\b)"),
    ):
        with pytest.raises(ConfigError, match=told):
            load_training_data(make_config(start_from=str(model), **wrong))
