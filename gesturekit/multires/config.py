"""What a multires run can be told; the defaults are the light-feature speech mode.

With `features: null` nothing is heard: single-clip mode, or label mode where `styles` is given.
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
"""Frames of the first level that are made before a motion and after it."""


@dataclass(frozen=True)
class NetworkConfig:
    """The pyramid and its networks (section 3 of the paper)."""

    levels: int = 10
    """L; each level has 3/4 of the frames of the next."""
    channels: tuple[int, ...] = (6, 9, 9)
    """Hidden channels for every joint, layer by layer; one more layer than there are numbers."""
    kernel: int = 5
    neighbour_distance: int = 2
    """How many bones apart two joints may stand and still see one another."""
    film: Literal["input", "all"] = "all"
    """Modulate the input of each level (the paper), or every hidden layer as well."""
    embedding: int = 64
    """Width of y_i, the embedding of the condition (eq. 8)."""
    rectify_embedding: bool = True
    """Put y_i through a leaky rectifier; the paper's fully connected layer (eq. 8) has none."""
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
        """Frames made before a motion and after it, and cut off.

        At its ends a pyramid moves less: levels hold their end frames when they are upsampled,
        and convolutions see the motion mirrored. With a margin that happens outside of what is
        kept, and a motion of a single frame is no special case.
        """
        return round(_MARGIN_COARSE * (4 / 3) ** (self.levels - 1))


@dataclass(frozen=True)
class LossConfig:
    """Weights of eq. 11 and of what goes beyond it; 0 turns a loss off."""

    adversarial: float = 1.0
    gradient_penalty: float = 1.0
    reconstruction: float = 50.0
    contact: float = 5.0
    smoothness: float = 5.0
    arm_speed: float = 3.0
    """On random steps, L1 between the generated arm speed and the one that a ridge regression
    reads off the speech. Not in the paper, where it is 0."""
    arm_acceleration: float = 0.0
    """The same of the change of arm speed: at one speed, arms that swing and arms that shake."""
    detail: float = 0.0
    """On random steps, energy distance between how much detail a level has at each joint, what the
    level below cannot hold, and how much recordings of the level's style have. Not in the paper,
    where it is 0."""
    coarse: float = 0.0
    """On random steps, L1 between what a level was given and what it makes of it, at the frames of
    the level below: finer levels add detail and leave the rest. Not in the paper."""
    rec_input: Literal["generated", "real"] = "generated"
    """What reconstruction steps upsample: the chain from z*, or the real motion as in eq. 15."""
    contact_speed: Literal["squared", "norm"] = "squared"
    """Foot speed in the contact loss: squared (eq. 14), or as it is (GANimator)."""
    contact_slope: float = 10.0
    """Of the sigmoid over contact labels in eq. 14; 12 in GANimator."""
    discriminator_scale: float = 1.0
    """Of the critic's score in its own loss, before the penalty; 1/2 in GANimator."""
    penalty_on: Literal["window", "frame", "printed"] = "window"
    """Norm that the gradient penalty holds at 1: over a window, of the score's sum rather than its
    mean, so that it does not depend on the length; of each frame's gradient of the scores' sum
    (GANimator); or over a window of the mean score's gradient, as eq. 13 is printed."""

    def __post_init__(self) -> None:
        check_not_negative(**{k: v for k, v in vars(self).items() if isinstance(v, (int, float))})


@dataclass(frozen=True)
class TrainingConfig:
    """How long, how often and how fast. Two levels are trained at a time."""

    first_stage: int = 15000
    """Iterations for the stage of the two coarsest levels."""
    further_stages: int = 25000
    """Iterations for each further stage, two levels at a time."""
    discriminator_steps: int = 5
    generator_steps: int = 1
    reconstruction_steps: int = 1
    learning_rate: float = 1e-4
    betas: tuple[float, ...] = (0.9, 0.999)
    """Of Adam. Lower ones forget a freak gradient sooner: it moves the weights less far."""
    decay_at: float = 1.0
    """After this share of a pair's iterations the learning rate falls to a tenth."""
    batch: int = 4
    window: float | None = 10.0
    """Seconds of each training window; null takes whole sequences, one at a time."""
    window_cache: int | None = 64
    """Windows whose coarser levels are generated beforehand ...; null draws fresh noise and speech
    at every step, as both papers do."""
    renew_every: int = 50
    """... and renewed every so many iterations."""
    margins: bool = False
    """Random motions are made with the margins that `generate` cuts off, and judged without. Else
    what is judged is nearer to its mirrored ends than what is generated later, and stiller. Not in
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
            raise ConfigError("generator_steps and reconstruction_steps are both 0: nothing learns")
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"betas: {list(self.betas)} must be two numbers from 0 to below 1")
        if not 0 <= self.silence < 1:
            raise ConfigError(f"silence: {self.silence} must be at least 0 and below 1")


@dataclass(frozen=True)
class PyramidFeatureConfig(FeatureConfig):
    """What the model hears, and how levels share it."""

    residual: bool = True
    """Give finer levels only what the coarser ones lack (section 5 of the paper)."""


@dataclass(frozen=True)
class StyleConfig:
    """Label mode: each sequence is told by the `style` that the manifest gives it."""

    mixing: float = 0.9
    """Share of random motions that have one style up to a random level and another above it."""
    condition_discriminator: bool = True
    """Discriminators are told the style of a motion that has one, beside recordings of that style;
    in the paper they are not."""

    def __post_init__(self) -> None:
        if not 0 <= self.mixing <= 1:
            raise ConfigError(f"mixing: {self.mixing} must be between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class MultiresConfig(RunConfig):
    """A multires training run, in speech, label or single-clip mode, or by speech and label."""

    system: Literal["multires"]
    out: Path = field(default_factory=lambda: Path("runs/multires"))
    fps: float = 25.0
    normalise: bool = True
    """Bring motion to zero mean and comparable spread; GANimator does not."""
    face_forward: bool = True
    """Turn each recording about the vertical to face +Z on the whole; the papers do not."""
    contact_threshold: float = 0.2
    """m/s on a body of 1.7 m; a slower foot point stands (eq. 1). The paper gives none, GANimator
    0.54, which is 0.018 a frame at 30 fps."""
    z_star: Literal["shared", "full"] = "shared"
    """The noise of reconstructions: like all noise, or of each channel and unscaled (GANimator)."""
    z_star_shuffle: int = 0
    """Noise of random motions is put together from pieces of z* of so many coarsest frames at
    most, in chance order, those of the style asked for; 0 draws it anew (both papers)."""
    noise_levels: int = 1
    """How many of the coarsest levels are given noise when the model generates (GANimator: the
    first). In training all are (both papers), so that what finer ones make of it is left out."""
    features: PyramidFeatureConfig | None = field(default_factory=PyramidFeatureConfig)
    """What is heard; null for nothing."""
    styles: StyleConfig | None = None
    """How styles are learnt; null for none."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    losses: LossConfig = field(default_factory=LossConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    checkpoint_every: int = 250
    eval_every: int = 0
    """Iterations between cheap evaluations (`quick_metrics`) on the training speech, written to
    metrics.jsonl with `kind: evaluation`, each with a sample in samples/; 0 for none. The model of
    the last pair of levels that they find best is kept in best/. They change nothing in the
    training, and model/ is always what its last step left."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of convolutions in training; bfloat16 is for GPUs that are fast with it."""
    backend: BackendName = "auto"
    """Implementation of convolutions and discriminator gradients in training: plain torch, or numba
    (compiled for CPUs, float32). auto takes numba on a CPU where it can. The environment variable
    GESTUREKIT_BACKEND replaces this setting, and applies to generation too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_not_negative(z_star_shuffle=self.z_star_shuffle)
        check_positive(noise_levels=self.noise_levels, contact_threshold=self.contact_threshold)

    @property
    def uses_arm_speed(self) -> bool:
        """Whether random steps are told how the arms should move."""
        told = self.losses.arm_speed or self.losses.arm_acceleration
        return bool(self.features and told and self.training.generator_steps)

    @property
    def random_margin(self) -> int:
        """Frames that random motions of the training are made longer at either end."""
        return self.network.margin if self.training.margins else 0

    @property
    def residual(self) -> bool:
        """Whether finer levels hear only what the coarser ones lack."""
        return self.features is not None and self.features.residual
