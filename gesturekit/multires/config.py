"""Settings of a multires training run; the defaults train a model with light speech features.

`features: null` trains without speech: single-clip mode, or label mode if `styles` is given.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from gesturekit.errors import ConfigError
from gesturekit.training.data.features import FeatureConfig
from gesturekit.training.run_config import RunConfig, check_not_negative, check_positive

BackendName = Literal["auto", "torch", "numba"]

_MARGIN_COARSE = 2
"""Frames of the first level that are generated before and after a motion. Fixed, because a trained
model must be sampled with the margin that it was measured with."""


@dataclass(frozen=True)
class NetworkConfig:
    """The pyramid and its networks (section 3 of the paper)."""

    levels: int = 10
    """L; each level has 3/4 of the frames of the next."""
    channels: tuple[int, ...] = (6, 9, 9)
    """Hidden channels per joint of each layer; the output layer follows."""
    kernel: int = 5
    """Kernel size of the convolutions over time, in frames; odd."""
    neighbour_distance: int = 2
    """Largest distance, in bones, between two joints that a convolution connects."""
    film: Literal["input", "all"] = "all"
    """Layers that FiLM modulates: the input of each level (the paper), or all hidden layers too."""
    embedding: int = 64
    """Dimension of y_i, the embedding of the condition (eq. 8)."""
    rectify_embedding: bool = True
    """Apply a leaky ReLU to y_i; the paper's fully connected layer (eq. 8) has none."""
    modulate: Literal["upper", "all"] | tuple[str, ...] = "upper"
    """Joints that the condition modulates: the upper body, all, or names."""

    def __post_init__(self) -> None:
        check_positive(levels=self.levels, embedding=self.embedding, kernel=self.kernel)
        check_not_negative(neighbour_distance=self.neighbour_distance)
        if self.kernel % 2 == 0:
            raise ConfigError(f"kernel: {self.kernel} must be odd")
        if not self.channels or min(self.channels) <= 0:
            raise ConfigError(f"channels: {list(self.channels)} must be numbers above 0")

    @property
    def margin(self) -> int:
        """Return how many frames are generated before and after a motion, and then removed.

        A generated motion moves less at its ends: upsampling repeats the end frames, and
        convolutions pad by reflection. With a margin this happens outside of the motion that is
        kept.
        """
        return round(_MARGIN_COARSE * (4 / 3) ** (self.levels - 1))


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses (eq. 11) and their variants; a weight of 0 turns a loss off.

    Losses on 'random steps' compare motion generated from random noise and unpaired speech.
    """

    adversarial: float = 1.0
    """Adversarial loss of the generators on random steps (eq. 12)."""
    gradient_penalty: float = 1.0
    """Gradient penalty of the discriminators (eq. 13)."""
    reconstruction: float = 50.0
    """L1 between a recording and its reconstruction from z* (eq. 15)."""
    contact: float = 5.0
    """Speed of feet with a contact label on random steps (eq. 14)."""
    smoothness: float = 5.0
    """Second difference of the joints' positions on random steps, at half the full rate or more
    (eq. 16)."""
    arm_speed: float = 3.0
    """L1 between the generated log arm speed and its prediction from speech by ridge regression,
    on random steps. Not in the paper, where it is 0."""
    arm_acceleration: float = 0.0
    """The same for arm acceleration, which distinguishes trembling from swinging at equal speed."""
    arm_floors: tuple[float, ...] = (1.0, 10.0)
    """Added to arm speed (rad/s) and acceleration (rad/s^2) before the logarithm in the losses on
    them. The higher, the less a pause counts."""
    detail: float = 0.0
    """Energy distance between generated and recorded amounts of detail at each joint, on random
    steps. Detail is what the frame rate of the level below cannot represent. Not in the paper."""
    coarse: float = 0.0
    """L1 between a level's input and its output resampled to the frames of the level below, on
    random steps: finer levels add detail and keep the rest. Not in the paper."""
    rec_input: Literal["generated", "real"] = "generated"
    """Input of each level on reconstruction steps: the output of the level below, from z* on, or
    the recorded motion as in eq. 15."""
    contact_speed: Literal["squared", "norm"] = "squared"
    """Foot speed in the contact loss: squared (eq. 14), or not (GANimator)."""
    contact_slope: float = 10.0
    """Slope of the sigmoid over contact labels in eq. 14; 12 in GANimator."""
    discriminator_scale: float = 1.0
    """Factor of eq. 12 in the discriminators' loss, beside the penalty; 1/2 in GANimator."""
    penalty_on: Literal["window", "frame", "printed"] = "window"
    """Gradient norm that the penalty draws to 1.

    - `window`: of the mean score by a whole window, times the square root of its frames, so that
      the penalty does not depend on the window's length.
    - `frame`: of the sum of scores by each frame (GANimator).
    - `printed`: of the mean score by a whole window, as eq. 13 is printed.
    """

    def __post_init__(self) -> None:
        check_not_negative(**{k: v for k, v in vars(self).items() if isinstance(v, (int, float))})
        if len(self.arm_floors) != 2 or min(self.arm_floors) <= 0:
            raise ConfigError(f"arm_floors: {list(self.arm_floors)} must be two numbers above 0")


@dataclass(frozen=True)
class TrainingConfig:
    """Training stages, steps and batches. A stage trains two levels, the coarsest first."""

    first_stage: int = 15000
    """Iterations of the first stage, which trains the two coarsest levels."""
    further_stages: int = 25000
    """Iterations of each further stage."""
    discriminator_steps: int = 5
    """Discriminator steps of an iteration."""
    generator_steps: int = 1
    """Random-generation steps of an iteration, from unpaired speech."""
    reconstruction_steps: int = 1
    """Reconstruction steps of an iteration."""
    learning_rate: float = 1e-4
    """Learning rate of Adam, for generators and discriminators."""
    betas: tuple[float, ...] = (0.9, 0.999)
    """Betas of Adam. With lower ones a single large gradient moves the weights less far."""
    decay_at: float = 1.0
    """Share of a stage's iterations after which the learning rate falls to a tenth."""
    batch: int = 4
    """Windows of a step, over all processes; 1 with `window: null`."""
    window: float | None = 10.0
    """Length of the training windows in seconds; null takes whole recordings, one at a time."""
    window_cache: int | None = 64
    """Number of windows whose coarser levels are generated ahead and reused; null draws new noise
    and speech at every step, as both papers do."""
    renew_every: int = 50
    """Iterations after which the window cache is filled anew."""
    margins: bool = False
    """Generate random motions with the margins that `generate` removes, and compute losses without
    them. Otherwise training motions move less at their ends than the model's output does. Not in
    the papers."""
    silence: float = 0.1
    """Share of random windows whose speech is replaced by silence."""

    def __post_init__(self) -> None:
        check_positive(
            learning_rate=self.learning_rate,
            batch=self.batch,
            renew_every=self.renew_every,
            first_stage=self.first_stage,
            further_stages=self.further_stages,
        )
        if self.window is not None:
            check_positive(window=self.window)
        if self.window_cache is not None:
            check_positive(window_cache=self.window_cache)
        steps = {
            "discriminator_steps": self.discriminator_steps,
            "generator_steps": self.generator_steps,
            "reconstruction_steps": self.reconstruction_steps,
        }
        check_not_negative(**steps, decay_at=self.decay_at)
        if not self.generator_steps and not self.reconstruction_steps:
            raise ConfigError(
                "generator_steps and reconstruction_steps are both 0: nothing would be trained"
            )
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"betas: {list(self.betas)} must be two numbers from 0 to below 1")
        if not 0 <= self.silence < 1:
            raise ConfigError(f"silence: {self.silence} must be at least 0 and below 1")

    @property
    def windows_per_step(self) -> int:
        """Return the batch size over all processes."""
        # Whole sequences differ in length, so they go one at a time, as in the paper.
        return self.batch if self.window is not None else 1


@dataclass(frozen=True)
class PyramidFeatureConfig(FeatureConfig):
    """Speech features of the model, and their distribution over levels."""

    residual: bool = True
    """Condition finer levels on the residual of the coarser features (section 5 of the paper)."""


@dataclass(frozen=True)
class StyleConfig:
    """Label mode: the `style` of each manifest item is a condition."""

    mixing: float = 0.9
    """Share of random motions with one style up to a random level and another above it."""
    condition_discriminator: bool = True
    """Condition discriminators on the style of a motion, and compare it with recordings of that
    style; in the paper they are unconditional."""

    def __post_init__(self) -> None:
        if not 0 <= self.mixing <= 1:
            raise ConfigError(f"mixing: {self.mixing} must be between 0 and 1")


def check_stretch(stretch: float) -> None:
    """Raise ConfigError for a `RecallConfig.stretch` out of range."""
    if stretch and not 0.05 <= stretch <= 0.5:
        raise ConfigError(f"stretch: {stretch} must be 0 or from 0.05 to 0.5")


@dataclass(frozen=True)
class RecallConfig:
    """Recall by speech: pieces of the training recordings, chosen by the speech, replace a level.

    Not in the papers.
    """

    level: int = 6
    """Level that is replaced, counted from 1 (coarsest); even, as levels are trained in pairs. The
    finest level gives recorded motion alone (retrieval)."""
    piece: float = 2.0
    """Length of a piece, seconds."""
    overlap: float = 0.4
    """Length of the cross-fade between two pieces, seconds; at most half of a piece."""
    parts: Literal["arms", "body"] = "arms"
    """Choose pieces for each arm and for the rest of the body separately, or for the whole body."""
    stretch: float = 0.0
    """Share by which the pieces of an arm are played faster or slower, so that they move when the
    speech asks for it; from 0.05 to 0.5, or 0 to play them as recorded."""
    own_movement: float = 0.9
    """Share of the recalled pieces' own arm movement in the targets of `losses.arm_speed` and
    `losses.arm_acceleration`; the rest is what the speech predicts."""

    def __post_init__(self) -> None:
        check_positive(level=self.level, piece=self.piece, overlap=self.overlap)
        if self.level % 2:
            raise ConfigError(f"level: {self.level} must be even: levels train in pairs")
        if self.overlap > self.piece / 2:
            raise ConfigError(
                f"overlap: {self.overlap} must be at most half of piece ({self.piece})"
            )
        check_stretch(self.stretch)
        if not 0 <= self.own_movement <= 1:
            raise ConfigError(f"own_movement: {self.own_movement} must be from 0 to 1")


@dataclass(frozen=True, kw_only=True)
class MultiresConfig(RunConfig):
    """Settings of a multires training run, with or without speech and style conditions."""

    system: Literal["multires"]
    """System that is trained; `multires` for these settings."""
    out: Path = field(default_factory=lambda: Path("runs/multires"))
    """Run folder."""
    fps: float = 25.0
    """Frame rate of the finest level; recordings are resampled to it."""
    normalise: bool = True
    """Normalise motion to zero mean and comparable spread; GANimator does not."""
    face_forward: bool = True
    """Turn each recording about the vertical so that its mean heading is +Z; the papers do not."""
    contact_threshold: float = 0.2
    """Speed below which a foot point is in contact (eq. 1), m/s on a body of 1.7 m. The paper gives
    none; GANimator has 0.54, which is 0.018 a frame at 30 fps."""
    z_star: Literal["shared", "full"] = "shared"
    """Noise of reconstructions: one channel scaled by sigma like all noise, or unscaled noise for
    each channel (GANimator)."""
    z_star_shuffle: int = 0
    """Longest patch, in coarsest frames, of z* from which level-1 noise of random motions is put
    together in random order, within the requested style; 0 draws new noise (both papers)."""
    noise_levels: int = 1
    """Number of coarsest levels that get noise in generation (GANimator: the first only). In
    training all levels get noise (both papers)."""
    features: PyramidFeatureConfig | None = field(default_factory=PyramidFeatureConfig)
    """Speech features; null trains a model without speech input."""
    styles: StyleConfig | None = None
    """Style conditions; null trains a model without."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Generators and discriminators."""
    recall: RecallConfig | None = None
    """Recall by speech; null generates all levels, as in the papers. The model folder then holds
    the training motion at that level."""
    losses: LossConfig = field(default_factory=LossConfig)
    """Weights of the losses."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """Stages, steps and batches."""
    checkpoint_every: int = 250
    """Iterations between checkpoints."""
    eval_every: int = 0
    """Iterations between cheap evaluations (`quick_metrics`) on the training speech, written to
    metrics.jsonl with `kind: evaluation`, each with a sample in samples/; 0 for none. The best
    model of the last stage by these metrics is kept in best/. They do not change the training, and
    model/ always has the weights of the last step."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of convolutions in training; bfloat16 is for GPUs that are fast with it."""
    backend: BackendName = "auto"
    """Implementation of convolutions and discriminator gradients in training: plain torch, or numba
    (compiled for CPUs, float32). auto takes numba on a CPU where it can. The environment variable
    GESTUREKIT_BACKEND replaces this setting, and applies to generation too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_not_negative(z_star_shuffle=self.z_star_shuffle)
        check_positive(noise_levels=self.noise_levels, contact_threshold=self.contact_threshold)
        if self.recall is not None and self.recall.level > self.network.levels:
            raise ConfigError(
                f"recall.level: {self.recall.level} is above network.levels {self.network.levels}"
            )

    @property
    def uses_arm_speed(self) -> bool:
        """Return True if random steps have a loss on arm speed or acceleration."""
        weighted = self.losses.arm_speed or self.losses.arm_acceleration
        return bool(self.features and weighted and self.training.generator_steps)

    @property
    def random_margin(self) -> int:
        """Return how many frames random motions are longer at either end in training."""
        return self.network.margin if self.training.margins else 0

    @property
    def residual(self) -> bool:
        """Return True if finer levels get only the residual of the coarser features."""
        return self.features is not None and self.features.residual
