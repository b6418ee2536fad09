"""Models that are told different things, trained so that their motions can be multiplied."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gesturekit.corpus import prepare
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.training.trainer import train
from gesturekit.errors import ConfigError, ModelError


@pytest.fixture
def fights(tmp_path, gesture) -> str:
    """Motion alone in which kicks happen; its mean and its spread are not those of the corpus."""
    (tmp_path / "in").mkdir()
    gesture(4.0, seed=9).save(tmp_path / "in" / "f.bvh")
    (tmp_path / "in" / "f.events.csv").write_text("time,name\n1,kick\n2.5,kick\n")
    prepare([], tmp_path / "f.jsonl", unpaired_motion=[tmp_path / "in"], holdout=0.0)
    return str(tmp_path / "f.jsonl")


def test_experts_with_speech_and_events_can_be_combined(make_config, fights, tmp_path):
    heard = train(make_config())
    told = {"corpus": fights, "features": None, "events": True}
    apart = DiffusionModel.load(train(make_config(out=str(tmp_path / "apart"), **told)))
    config = make_config(out=str(tmp_path / "like"), moves_like=str(heard), **told)
    like, leader = DiffusionModel.load(train(config)), DiffusionModel.load(heard)
    with pytest.raises(ModelError, match="train one with moves_like"):
        leader.generate(seconds=1.0, events="kick@0.5", experts=[(apart, 0.5)])
    assert like.conditions.events == ("kick",) and like.conditions.conditioner is None
    assert torch.equal(like.normaliser.scale, leader.normaliser.scale)
    motion = leader.generate(seconds=1.0, events="kick@0.5", experts=[(like, 0.5)], steps=3)
    alone = leader.generate(seconds=1.0, steps=3)
    assert motion.n_frames == 30 and np.abs(motion.rotations - alone.rotations).max() > 1e-3


def test_an_incompatible_moves_like_is_refused(make_config):
    model = str(train(make_config()))
    for wrong, told in (
        ({"fps": 25.0}, "moves_like: .* has fps 30.0, this run 25.0"),
        ({"path": True}, "moves_like: this run follows a path and .* does not"),
        ({"start_from": model}, "leave out one of them"),
    ):
        with pytest.raises(ConfigError, match=told):
            train(make_config(out=model + "-next", moves_like=model, **wrong))
