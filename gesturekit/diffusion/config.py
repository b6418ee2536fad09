"""Settings of a diffusion training run; the defaults are those of the paper's gesture models."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from gesturekit.training.config import Limits, Positive, Settings, Share, ShareBelowOne
from gesturekit.training.features import FeatureConfig
from gesturekit.training.run_config import RunConfig


@dataclass(frozen=True)
class NetworkConfig(Settings):
    """The denoising network (section 3.2 and appendix A.1 of the paper)."""

    blocks: Annotated[int, Limits(1000, is_above=True)] = 10
    """Residual blocks."""
    layers: Annotated[int, Limits(1000, is_above=True)] = 4
    """Conformer layers in each block; the architecture `diffwave` has one convolution instead."""
    channels: Annotated[int, Limits(16384, is_above=True)] = 256
    """Width of the residual blocks and Conformer layers."""
    heads: Positive[int] = 8
    """Attention heads in each layer."""
    feedforward: Annotated[int, Limits(16384, is_above=True)] = 1024
    """Hidden channels of the convolutional feed-forward part of a Conformer layer."""
    embedding: Annotated[int, Limits(16384, is_above=True)] = 512
    """Width of the embedding of the diffusion step."""
    dilations: tuple[int, ...] = (0, 1, 2)
    """Dilations of the convolutions in frames; blocks cycle through this list. 0 replaces the
    convolutions of kernel size 3 by a plain feed-forward part."""
    kernels: Annotated[int, Limits(1000, is_above=True)] = 21
    """Number of learnt sigmoids in the position bias of each attention head."""
    nearest_view: Positive[int] = 5
    """Receptive field, in frames, of the attention head with the narrowest view. At half this
    distance, the position bias has lowered the attention weight to 1e-8."""
    farthest_view: Positive[int] = 75
    """Receptive field, in frames, of the attention head with the widest view."""
    dropout: ShareBelowOne = 0.1
    """Dropout of attention weights, of the feed-forward part and of each residual branch."""
    architecture: Literal["conformer", "diffwave"] = "conformer"
    """`diffwave` is the paper's ablation LDA-DW: one dilated convolution instead of the Conformer
    stack. It has no dilation 0; the paper's cycle is 1, 2, 4 ... 512."""
    step_angles: Literal["float64", "float32"] = "float64"
    """Precision of the angles of the step embedding, which reach 1e6 radians: in float32, as in the
    released code and its checkpoints, their sines are off by up to 0.08."""

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        if self.channels % self.heads:
            yield f"heads: {self.heads} must divide channels, which is {self.channels}"
        if self.farthest_view < self.nearest_view:
            nearest = f"nearest_view, which is {self.nearest_view}"
            yield f"farthest_view: {self.farthest_view} must be at least {nearest}"
        lowest = 1 if self.architecture == "diffwave" else 0
        if not self.dilations or min(self.dilations) < lowest:
            least = f"at least {lowest} for architecture {self.architecture}"
            yield f"dilations: {list(self.dilations)} must be numbers of {least}"


@dataclass(frozen=True)
class NoiseConfig(Settings):
    """The noise schedule and the prediction target."""

    steps: Annotated[int, Limits(10_000, is_above=True)] = 100
    """Number of diffusion steps N; the paper has 150 for dance, locomotion and fighting."""
    first_beta: Annotated[float, Limits(1, is_above=True, is_below=True)] = 0.0074
    """beta_1 of the linear noise schedule; the paper has 0.01 for dance, locomotion and
    fighting."""
    last_beta: Annotated[float, Limits(1, is_above=True, is_below=True)] = 0.78
    """beta_N of the linear noise schedule; the paper has 0.7 for dance, locomotion and fighting."""
    predict: Literal["noise", "velocity", "clean"] = "noise"
    """Prediction target: the noise (as in the paper), the velocity of Salimans and Ho, or the clean
    motion. Clean motion is smooth and low-dimensional, so a small network learns to predict it in a
    fraction of the time."""

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        if self.last_beta < self.first_beta:
            first = f"first_beta, which is {self.first_beta}"
            yield f"last_beta: {self.last_beta} must be at least {first}"


@dataclass(frozen=True)
class TrainingConfig(Settings):
    """Optimisation (section 4.1 and appendix A.1)."""

    updates: Positive[int] = 67_000
    """Number of updates. The default suits the 135 minutes of ZeroEGGS; the paper has 112,000 for
    244 minutes of speech, 180,000 for 373 minutes of dance, 52,000 for 60 minutes of fighting, and
    292,000 for 1125 minutes of locomotion."""
    batch: Positive[int] = 80
    """Windows per update, over all processes."""
    window: Positive[float] = 5.0
    """Length of a training window in seconds."""
    learning_rate: Positive[float] = 6e-4
    """Learning rate of Adam at the end of the warm-up, its peak."""
    warm_up: int = 3000
    """Number of updates of linear learning-rate warm-up."""
    decay: Annotated[float, Limits(1, is_above=True)] = 0.99995
    """Factor applied to the learning rate every ten updates after the warm-up, as in the released
    code; the paper has 1 - 0.5e-5. After 67,000 updates, the learning rate has fallen to 0.73
    (paper: 0.97) of its peak."""
    clip: float = 25.0
    """Maximum gradient norm; 0 for no clipping."""
    ema: ShareBelowOne = 0.0
    """Decay of the exponential moving average of the weights, which is saved as the model; the
    decay is lower in the first updates. 0, as in the paper, saves the weights themselves."""
    dropout_condition: Share = 0.0
    """Fraction of windows trained without any condition but the state (condition dropout), for
    guidance and for products of experts."""
    dropout_style: Share = 0.0
    """Fraction of the other windows trained without their style (style dropout), for guidance."""
    dropout_state: Share = 0.0
    """Fraction of all windows trained without the state of movement, for guidance on it."""
    min_snr: Positive[float | None] = None
    """Gamma of the min-SNR loss weights (Hang et al. 2023); null, as in the paper, gives all
    diffusion steps the same weight."""
    changes: float = 0.0
    """Weight of the squared error of frame-to-frame changes, in units of their standard deviation
    in the recordings. It reduces the jitter of networks that predict clean motion, and requires
    that prediction target; the paper has no such loss."""
    foot_sliding: float = 0.0
    """Weight of a loss on the speed of feet that are planted in the recording, in units of 0.1 m/s,
    after Tevet et al. 2023. For networks that predict clean motion; the paper has no such loss. It
    is off for rigs without legs."""
    state: float = 0.0
    """Weight of the distance of the state of movement that a prediction shows from that of the
    recording, in standard deviations, times the signal's share of the variance at the step. For
    models with `state` that predict clean motion; not in the paper."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of matrix products in training; weights and sums stay float32."""


@dataclass(frozen=True)
class AugmentationConfig(Settings):
    """Data augmentation (appendix A.1)."""

    mirror: bool = True
    """Train on mirrored recordings too, except for the styles in `styles.handed`."""
    stretch: Share = 0.1
    """Fraction of windows that are time-stretched; the paper has 0.2 for dance and fighting."""
    stretch_range: Annotated[float, Limits(0.5)] = 0.1
    """Range r of time stretching: the factor is between 1 - r and 1 + r."""


@dataclass(frozen=True)
class StyleConfig:
    """Style condition: the `style` of each recording in the manifest."""

    handed: tuple[str, ...] = ()
    """Styles that distinguish left from right; their recordings are not mirrored. `100style` stands
    for those of that corpus, and may name styles that the recordings lack."""


@dataclass(frozen=True)
class UnpairedConfig(Settings):
    """Unpaired motion: extra training windows without any condition."""

    corpus: Path | None = None
    """Manifest of motion on any human rig, which is retargeted to the rig of the corpus. Null uses
    the unpaired motion of the run's own corpus."""
    share: Share = 0.5
    """Fraction of windows taken from unpaired motion."""


@dataclass(frozen=True, kw_only=True)
class DiffusionConfig(RunConfig):
    """A diffusion training run, with any combination of speech, path, events and styles."""

    noun = "update"
    system: Literal["diffusion"]
    """Name of the system; always `diffusion` here."""
    out: Path = field(default_factory=lambda: Path("runs/diffusion"))
    fps: Positive[float] = 30.0
    """Frame rate of the network, in frames per second; recordings are resampled to it. Dilations
    and receptive fields of `network` are in frames: at another frame rate than the paper's 30,
    their lengths in seconds differ."""
    features: FeatureConfig | None = field(default_factory=FeatureConfig)
    """Features of speech or music; null for a model without sound input."""
    path: bool = False
    """Condition on the path of the root: each item's `path` table, or else the path of its own
    motion."""
    events: bool = False
    """Condition on binary event flags, from each item's `events` table."""
    styles: StyleConfig | None = None
    """Style condition; null for none, as in an unconditional model for guidance."""
    state: bool = False
    """Condition on the state of movement: how much hands, trunk and head move, where the
    hands are held, and when they move. It is measured in the recordings, and drawn in generation.
    Not in the paper."""
    unpaired: UnpairedConfig | None = None
    """Unpaired motion; null for none."""
    moves_like: Path | None = None
    """Model folder whose rig, joints and normalisation are used, but not its weights. The two
    models can then be combined in a product of experts, even if their conditions differ."""
    clip_denoised: bool = True
    """Clip the predicted clean motion to 10 standard deviations (Ho et al. 2020), and skip the
    network at steps with less than 1e-8 of the motion. False, as in the paper's released code, does
    neither: a network that was trained too little then diverges. Applied in generation, and stored
    with the model; it does not affect training."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    checkpoint_every: Positive[int] = 1000
    """Updates between checkpoints."""

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the settings, beside numbers out of their limits."""
        yield from super().problems()
        if self.moves_like is not None and self.start_from is not None:
            yield "moves_like: start_from implies it; leave out one of them"
        for name in ("changes", "foot_sliding", "state"):
            if (weight := getattr(self.training, name)) and self.noise.predict != "clean":
                needed = f"noise.predict: clean, not {self.noise.predict}"
                yield f"training.{name}: {weight} needs a network with {needed}"
        for name in ("dropout_state", "state"):
            if (value := getattr(self.training, name)) and not self.state:
                yield f"training.{name}: {value} needs state: true"
        if (weight := self.training.foot_sliding) and self.path:
            how = "is for models that move the root themselves; with path: true, set it to 0"
            yield f"training.foot_sliding: {weight} {how}"

    @property
    def updates(self) -> int:
        """Return the number of updates."""
        return self.lengthened(self.training.updates)

    @property
    def windows_per_step(self) -> int:
        """Return the batch size over all processes."""
        return self.training.batch
