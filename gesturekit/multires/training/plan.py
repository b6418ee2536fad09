"""Plan of a multires training: its estimated duration, and the arrays of a long corpus."""

from __future__ import annotations

import math
import time
from functools import partial

from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.targets import MOST_WINDOWS
from gesturekit.multires.training.trainer import Trainer
from gesturekit.training.recordings import load_recordings
from gesturekit.training.run.plan import Estimate, log_arrays, log_plan, quickest
from gesturekit.training.run.session import prepare_device


class Trial(Trainer):
    """A training of a few iterations, whose duration is measured."""

    def estimate(self) -> Estimate:
        """Estimate the cost of the training from a few iterations of each stage.

        They change the networks: for a run that is not kept.
        """
        data, config = self.data, self.config
        whole = data.seconds * config.fps
        frames = sum(sequence.n_frames for sequence in data.paired)
        # Whole recordings differ in length, and each iteration takes one of them.
        longer = 1.0
        if config.training.window is None:
            longer = whole / len(data.sources) / (frames / len(data.paired))
        sampled = min(whole, 60 * config.in_memory * config.fps)
        seconds = quickest(lambda: self.state, 1) * sampled / frames
        for first, iterations in self.stages():
            began = time.monotonic()
            stage = self.stage(first, iterations)
            begin = time.monotonic() - began
            seconds += begin * min(sampled, MOST_WINDOWS) / min(frames, MOST_WINDOWS)
            renewals = math.ceil(iterations / config.training.renew_every)
            seconds += renewals * quickest(partial(stage.batches.renew, 0), 2)
            # The first iteration compiles too.
            seconds += iterations * longer * quickest(partial(stage.iterate, 1), 4)
        speech = 0.0
        if data.conditioner is not None:
            speech = 4 * config.fps * (data.conditioner.extractor.dim + 1)
        motion = data.representation.n_features + data.paired[0].passive.shape[0]
        rates = (4 * config.fps * motion + speech, speech)
        return Estimate(seconds, self.held_out.seconds, rates)


def plan_training(config: MultiresConfig) -> None:
    """Log the plan of `train` and its estimated duration; see `training.run.plan`."""
    device = str(prepare_device(config.device, config.threads))
    speech, styles = config.features is not None, config.styles is not None
    read = partial(load_training_data, config, device, trial=True)
    recordings = partial(
        load_recordings, config, config.parts, speech=speech, styles=styles, trial=True
    )
    log_plan(config, read, recordings, Trial)


def make_arrays(config: MultiresConfig) -> None:
    """Make the arrays of a corpus that is not held in memory; see `gesturekit.systems`."""
    data = load_training_data(config, str(prepare_device(config.device, config.threads)))
    log_arrays(config, data.is_stored)
