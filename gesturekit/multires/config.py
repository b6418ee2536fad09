"""Settings of a multires training run; the defaults train a model with light speech features.

`features: null` trains without speech: single-clip mode, or label mode if `styles` is given.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import audio_features as af
from gesturekit.training.config import Limits, Positive, Settings, Share, ShareBelowOne
from gesturekit.training.features import FeatureConfig
from gesturekit.training.run_config import RunConfig

BackendName = Literal["auto", "torch", "numba"]

_MARGIN_COARSE = 2
"""Frames of the first level that are generated before and after a motion and then discarded. Fixed,
because a model must be sampled with the margin with which it was evaluated."""


@dataclass(frozen=True)
class NetworkConfig(Settings):
    """The pyramid of generators and discriminators (section 3 of the paper)."""

    levels: Annotated[int, Limits(64, is_above=True)] = 10
    """Number of levels L."""
    factor: Annotated[float, Limits(4)] = 4 / 3
    """Factor F (eq. 3): frames of a level over those of the next coarser one, from 1.1; other
    values than 4/3 are an ablation."""
    channels: tuple[int, ...] = (6, 9, 9)
    """Channels of each hidden layer, see `channels_per`; an output layer follows."""
    channels_per: Literal["block", "layer"] = "block"
    """Unit of `channels`: each block (joint, contact label, root displacement), or the whole layer,
    of which a block then has ceil(channels / blocks) channels (GANimator: 128, 256, 256)."""
    kernel: Annotated[int, Limits(255, is_above=True)] = 5
    """Kernel size of the convolutions over time, in frames; odd."""
    neighbour_distance: int = 2
    """A skeleton convolution connects joints that are at most this many bones apart."""
    contact_reach: Literal["near", "foot"] = "near"
    """Joints and contact labels that take a contact label as input: all within `neighbour_distance`
    of its foot joint, or those at the foot joint alone (GANimator). The root's displacement takes
    all labels."""
    film: Literal["input", "all", "concatenate"] = "all"
    """Layers that FiLM modulates: only the input of each level (the paper), or also all hidden
    layers. With `concatenate` there is no FiLM: y_i are further channels of the input, which the
    first convolution connects to the blocks of `modulate` (an ablation)."""
    embedding: Annotated[int, Limits(4096, is_above=True)] = 64
    """Dimension of y_i, the embedding of the condition (eq. 8)."""
    rectify_embedding: bool = True
    """Apply a leaky ReLU to y_i; the paper's fully connected layer (section 3.3) has none."""
    modulate: Literal["upper", "all"] | tuple[str, ...] = "upper"
    """Joints whose channels FiLM modulates: the upper body, all, or a list of joint names."""
    residual: bool = True
    """Add the coarser level's motion to the output of each generator (eq. 7); false is an
    ablation."""

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        if self.kernel % 2 == 0:
            yield f"kernel: {self.kernel} must be odd"
        if self.factor < 1.1:
            yield f"factor: {self.factor:g} must be 1.1 to 4"
        elif self.factor ** (self.levels - 1) > 1e8:
            yield f"levels: {self.levels} with factor {self.factor:g}: too many; use fewer levels"
        if not 0 < len(self.channels) <= 64 or not all(0 < n <= 4096 for n in self.channels):
            yield f"channels: {list(self.channels)} must be 1 to 64 numbers to 4096"

    def lengths(self, n_frames: int) -> list[int]:
        """Return the number of frames of every level, coarse to fine; the last is `n_frames`."""
        return af.level_lengths(n_frames, self.levels, self.factor)

    @property
    def n_frames_of_patch(self) -> int:
        """Return how many frames of a level one score of its discriminator depends on."""
        return 1 + (self.kernel - 1) * (len(self.channels) + 1)

    @property
    def margin(self) -> int:
        """Return how many frames are generated before and after a motion, and then removed.

        Generated motion moves less near its ends, because upsampling repeats the end frames and
        convolutions pad by reflection. The margin keeps this outside of the returned motion.
        """
        return round(_MARGIN_COARSE * self.factor ** (self.levels - 1))


@dataclass(frozen=True)
class LossConfig(Settings):
    """Weights of the losses (eq. 11) and their variants; a weight of 0 turns a loss off.

    Losses 'on random steps' apply to motion generated from random noise and unpaired speech.
    """

    adversarial: float = 1.0
    """Adversarial loss of the generators on random steps (eq. 12)."""
    gradient_penalty: float = 1.0
    """Gradient penalty of the discriminators (eq. 13)."""
    reconstruction: float = 50.0
    """L1 distance between a recording and its reconstruction from z* (eq. 15)."""
    contact: float = 5.0
    """Speed of feet that have a contact label, on random steps (eq. 14)."""
    smoothness: float = 5.0
    """Second difference of the joint positions on random steps, at levels with at least half the
    full frame rate (eq. 16)."""
    smooth_levels: Literal["fine", "all"] = "fine"
    """Levels of the smoothness loss: those with at least half the full frame rate, or all."""
    arm_speed: float = 3.0
    """L1 distance between the log arm speed of generated motion and its prediction from speech by
    ridge regression, on random steps. Not in the paper; 0 gives the paper's losses."""
    arm_acceleration: float = 0.0
    """The same for arm acceleration, which tells trembling arms from swinging arms of equal
    speed."""
    detail: float = 0.0
    """Energy distance between the distributions of detail in generated and recorded motion, at each
    joint, on random steps. Detail is movement too fast for the frame rate of the next coarser
    level. Not in the paper."""
    coarse: float = 0.0
    """L1 distance between a level's input and its output, resampled to the frame rate of the next
    coarser level, on random steps, so that finer levels only add detail. Not in the paper."""
    state: float = 0.0
    """L1 distance between the state of movement that a generated motion shows and the state that it
    was given, in standard deviations, on random steps; for models with `state`. Not in the
    paper."""
    rec_input: Literal["generated", "real"] = "generated"
    """Input of each level on reconstruction steps: the output of the next coarser level, generated
    from z*, or the recorded motion at the coarser level, as eq. 15 is printed."""
    contact_speed: Literal["squared", "norm"] = "squared"
    """Foot speed in the contact loss: squared (eq. 14), or plain (GANimator)."""
    contact_time: Literal["second", "frame"] = "second"
    """Foot speed in the contact loss: in m/s at every level, or in metres from one frame of the
    level to the next, without regard to the frame rate (GANimator)."""
    contact_slope: float = 10.0
    """Slope of the sigmoid of the contact labels in eq. 14; GANimator has 12."""
    discriminator_scale: float = 1.0
    """Factor on the Wasserstein terms (eq. 12) of the discriminators' loss, but not on the gradient
    penalty; GANimator has 1/2."""
    penalty_on: Literal["window", "frame", "printed"] = "window"
    """Definition of the gradient whose norm the gradient penalty pulls towards 1.

    - `window`: gradient of the mean score with respect to a whole window, times the square root of
      its number of frames, so that the penalty does not depend on the length of the window.
    - `frame`: gradient of the sum of scores with respect to each frame (GANimator).
    - `printed`: gradient of the mean score with respect to a whole window, as eq. 13 is printed.
    """


@dataclass(frozen=True)
class TrainingConfig(Settings):
    """Training stages, steps and batches. A stage trains two levels, the coarsest first."""

    first_stage: Positive[int] = 15000
    """Iterations of the first stage, which trains the two coarsest levels."""
    further_stages: Positive[int] = 25000
    """Iterations of each further stage."""
    stage_levels: Annotated[int, Limits(64, is_above=True)] = 2
    """Levels that a stage trains together; the first stage then trains this many too."""
    discriminator_steps: int = 5
    """Discriminator steps per iteration."""
    generator_steps: int = 1
    """Random-generation steps per iteration, with unpaired speech."""
    reconstruction_steps: int = 1
    """Reconstruction steps per iteration, with paired speech."""
    learning_rate: Positive[float] = 1e-4
    """Learning rate of Adam, for generators and discriminators."""
    betas: tuple[float, ...] = (0.9, 0.999)
    """Betas of Adam. Lower values limit how far a single large gradient moves the weights."""
    decay_at: float = 1.0
    """Fraction of a stage's iterations after which the learning rate drops to a tenth; 1 for
    never."""
    batch: Positive[int] = 4
    """Windows per step, over all processes; always 1 with `window: null`."""
    window: Positive[float | None] = 10.0
    """Length of the training windows in seconds; a window of unpaired speech that is longer than
    its clip continues with another clip. null trains on whole recordings and, in random steps,
    whole unpaired clips, one at a time; each is drawn equally often (the paper)."""
    window_cache: Positive[int | None] = 64
    """Number of windows for which the coarser levels are generated in advance and reused; null
    draws new noise and speech at every step, as both papers do."""
    renew_every: Positive[int] = 50
    """Iterations after which the window cache is regenerated."""
    margins: bool = False
    """Generate the motions of random steps with the margins that `generate` cuts off, and compute
    the losses without them. Otherwise motions in training move less near their ends than the
    model's output does. Not in the papers."""
    silence: ShareBelowOne = 0.1
    """Fraction of windows on random steps whose speech is replaced by silence."""

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        if not self.generator_steps and not self.reconstruction_steps:
            yield ("generator_steps and reconstruction_steps are both 0: nothing would be trained")
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            yield f"betas: {list(self.betas)} must be two numbers from 0 to below 1"


@dataclass(frozen=True)
class PyramidFeatureConfig(FeatureConfig):
    """Speech features of the model, and how each level receives them."""

    residual: bool = True
    """Condition each finer level on the residual of the features (what the coarser levels lack),
    instead of the features themselves (section 5 of the paper)."""


@dataclass(frozen=True)
class StyleConfig(Settings):
    """Label mode: the `style` of each manifest item is a condition."""

    mixing: Share = 0.9
    """Fraction of motions on random steps that have one style up to a random level and another
    style at the finer levels."""
    condition_discriminator: bool = True
    """Condition the discriminators on the style, with recordings of the same style as real samples;
    in the paper discriminators are unconditional."""


@dataclass(frozen=True, kw_only=True)
class MultiresConfig(RunConfig):
    """Settings of a multires training run, with or without speech and style conditions."""

    system: Literal["multires"]
    """Name of the system; always `multires` here."""
    out: Path = field(default_factory=lambda: Path("runs/multires"))
    """Run folder."""
    fps: Positive[float] = 25.0
    """Frame rate of the finest level; recordings are resampled to it."""
    normalise: bool = True
    """Normalise motion vectors to zero mean and comparable spread; GANimator does not."""
    face_forward: bool = True
    """Turn each recording about the vertical so that its mean heading is +Z; the papers do not."""
    contact_threshold: Positive[float] = 0.2
    """Speed below which a foot point is in contact (eq. 1), in m/s for a body of 1.7 m. The paper
    does not give its value; GANimator has 0.54 (0.018 m per frame at 30 fps)."""
    z_star: Literal["shared", "full"] = "shared"
    """Reconstruction noise z*: one sequence shared by all channels and scaled by sigma, like all
    other noise, or unscaled noise for each channel (GANimator)."""
    z_star_shuffle: int = 0
    """Longest patch of z*, in frames of level 1. Level-1 noise of random steps and of generation is
    then made of patches of z* in random order, taken from recordings of the requested style; 0
    draws new noise (both papers)."""
    noise_levels: Positive[int] = 1
    """Number of levels, from the coarsest, that get noise in generation (GANimator: only the
    first). In training all levels get noise (both papers)."""
    features: PyramidFeatureConfig | None = field(default_factory=PyramidFeatureConfig)
    """Speech features; null trains a model without speech input."""
    styles: StyleConfig | None = None
    """Style condition; null trains a model without styles."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Generators and discriminators."""
    state: bool = False
    """Condition every level on the state of movement: how much the hands, the trunk and the head
    move, where the hands are held, and when they move. It is measured in the recordings, and drawn
    in generation and for random steps. The noise of level 1 then runs in the time of the hands'
    movement, and finer levels get none. Not in the papers."""
    retrieval: bool = False
    """Play pieces of the recordings whose state is nearest to the drawn one, in place of the
    network's motion: a baseline, for comparison. It needs `state`, and the model folder contains
    the training motion. Not in the papers."""
    losses: LossConfig = field(default_factory=LossConfig)
    """Weights of the losses."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """Stages, steps and batches."""
    checkpoint_every: Positive[int] = 250
    """Iterations between checkpoints."""
    eval_every: int = 0
    """Iterations between cheap evaluations (`quick_metrics`) on the training speech, written to
    metrics.jsonl with `kind: evaluation`, each with a sample in samples/; 0 for none. The best
    model of the last stage by these metrics is kept in best/. Evaluations do not change the
    training, and model/ always has the weights of the last step."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of convolutions in training; bfloat16 is for GPUs that support it in hardware."""
    backend: BackendName = "auto"
    """Implementation of convolutions and discriminator gradients in training: plain torch, or numba
    (compiled for CPUs, float32). auto uses numba on a CPU if possible. The environment variable
    GESTUREKIT_BACKEND overrides this setting, and also applies to generation."""

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        yield from super().problems()
        if self.state and (self.z_star_shuffle or self.z_star != "shared"):
            yield "state: true cannot be combined with z_star_shuffle or z_star: full"
        if self.retrieval and not self.state:
            yield "retrieval: true needs state: true, by which pieces are chosen"
        if self.losses.state and not self.state:
            yield f"losses.state: {self.losses.state:g} needs state: true"
        kinds = {spec.get("kind") for spec in self.features.extractors} if self.features else ()
        if self.state and kinds == {"effort"}:
            yield (
                "features.extractors: effort alone; with state it is not an input of the network: "
                "add another kind, such as {kind: prosody}"
            )

    @property
    def windows_per_step(self) -> int:
        """Return the batch size over all processes."""
        # Whole sequences differ in length, so they go one at a time, as in the paper.
        return self.training.batch if self.training.window is not None else 1

    @property
    def uses_arm_speed(self) -> bool:
        """Return True if random steps have a loss on arm speed or acceleration."""
        weighted = self.losses.arm_speed or self.losses.arm_acceleration
        return bool(self.features and weighted and self.training.generator_steps)

    @property
    def random_margin(self) -> int:
        """Return the margin in frames at each end of the motions of random steps in training."""
        return self.network.margin if self.training.margins else 0

    @property
    def residual(self) -> bool:
        """Return True if finer levels get only the residual of the coarser features."""
        return self.features is not None and self.features.residual
