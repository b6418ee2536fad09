"""Looking at a training now and then tells something and changes nothing."""

from __future__ import annotations

import json

import torch
from safetensors.torch import load_file

from gesturekit.multires.trainer import train


def lines(folder) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_evaluations_are_logged_and_the_weights_are_those_without_them(make_config, tmp_path):
    plain = train(make_config(out=str(tmp_path / "plain")))
    watched = train(make_config(out=str(tmp_path / "watched"), eval_every=3))
    one, other = (load_file(model / "model.safetensors") for model in (plain, watched))
    assert all(torch.equal(one[name], other[name]) for name in one)

    found = [line for line in lines(tmp_path / "watched") if line.get("kind") == "evaluation"]
    # Every third step, and the last of both pairs of levels (of 6 and 4 iterations).
    assert [line["step"] for line in found] == [3, 6, 9, 10]
    for figures in found:
        assert {"arm_speed_ratio", "jerk_ratio", "foot_skate", "hellinger"} <= figures.keys()
        assert not {"jerk_genea", "jerk_genea_ratio", "coverage"} & figures.keys()
    assert found[0]["arm_speed_ratio"] != found[1]["arm_speed_ratio"]

    losses = [line for line in lines(tmp_path / "watched") if "kind" not in line]
    without = lines(tmp_path / "plain")
    assert [{k: v for k, v in x.items() if "seconds" not in k} for x in losses] == [
        {k: v for k, v in x.items() if "seconds" not in k} for x in without
    ]
    # The model's README tells losses, not evaluations.
    assert "critic" in (watched / "README.md").read_text()


def test_a_run_may_be_resumed_with_or_without_evaluations(make_config, tmp_path):
    train(make_config(out=str(tmp_path / "run"), eval_every=5))
    train(make_config(out=str(tmp_path / "run"), eval_every=0), resume=True)
