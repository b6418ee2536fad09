"""Trainings in processes of their own: killed and resumed to the same weights, or two as one."""

import re
import signal
import time

import pytest
import yaml
from runs import apart, ended, launch, logged, same_weights

from gesturekit.multires import train
from gesturekit.training.config import to_dict

TRAIN = ("-m", "gesturekit", "train")


def steps(run) -> list[int]:
    try:
        return [line["step"] for line in logged(run)]
    except (FileNotFoundError, ValueError):
        return []


@pytest.mark.stress
def test_killed_and_with_a_damaged_checkpoint_it_resumes_bitwise(make_config, tmp_path):
    stages = {"first_stage": 40, "further_stages": 40, "renew_every": 14, "window": 2.0}
    config = make_config(training=stages, checkpoint_every=20, log_every=2)
    config_file = tmp_path / "config.yaml"
    config_file.write_text(yaml.safe_dump(to_dict(config)))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    runs = {out: launch(*TRAIN, config_file, f"out={out}") for out in (whole, killed)}
    deadline = time.monotonic() + 240
    while not any(48 <= step <= 72 for step in steps(killed)):
        assert runs[killed].poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    runs[killed].send_signal(signal.SIGKILL)
    runs[killed].communicate()
    assert 48 <= steps(killed)[-1] < 80
    *_, before, last = sorted((killed / "checkpoints").glob("step_*.pt"))
    last.write_bytes(last.read_bytes()[:1000])
    said = ended(launch(*TRAIN, config_file, f"out={killed}", "--resume"))
    assert last.name in said and re.search(rf"(?i)step\W+{int(before.stem[5:])}\b", said)
    ended(runs[whole])
    assert same_weights(whole / "model", killed / "model")
    assert logged(whole) == logged(killed), "the log has no gap and nothing twice"


STEPS = {"first_stage": 2, "further_stages": 2, "discriminator_steps": 2}


@pytest.mark.stress
def test_two_processes_train_the_same_model_as_one(make_config, tmp_path, device):
    config = make_config(training=STEPS, out=str(tmp_path / "two"), device=device)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(to_dict(config)))
    ended(launch(*TRAIN, tmp_path / "config.yaml", processes=2))
    one = train(make_config(training=STEPS, out=str(tmp_path / "one"), device=device))
    # Adam makes whole steps of what rounding leaves of a gradient that is nearly zero.
    assert max(apart(config.out / "model", one)) < 2e-3
