"""What a diffusion run can be told; the defaults are the gesture models of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from gesturekit.errors import ConfigError
from gesturekit.training.data.features import FeatureConfig
from gesturekit.training.run_config import RunConfig, check_positive, check_share


@dataclass(frozen=True)
class NetworkConfig:
    """The denoising network (section 3.2 and appendix A.1 of the paper)."""

    blocks: int = 10
    """Residual blocks."""
    layers: int = 4
    """Conformer layers in each block; `diffwave` has one convolution instead."""
    channels: int = 256
    heads: int = 8
    feedforward: int = 1024
    """Hidden channels of the convolutional part of a Conformer layer."""
    embedding: int = 512
    """Width of the embedding of the diffusion step."""
    dilations: tuple[int, ...] = (0, 1, 2)
    """In frames, in turn over the blocks; 0 is a plain feed-forward part instead of convolutions
    of three frames."""
    kernels: int = 21
    """Sigmoids in the position bias of each head."""
    nearest_view: int = 5
    """Frames that the nearest-sighted head sees: 1e-8 of the weight is left at half of them ..."""
    farthest_view: int = 75
    """... and that the farthest-sighted head sees."""
    dropout: float = 0.1
    """On attention weights, in the feed-forward part and on what a layer adds."""
    architecture: Literal["conformer", "diffwave"] = "conformer"
    """`diffwave` is the paper's ablation LDA-DW: one dilated convolution in place of the stack.
    It has no dilation 0; the paper's cycle is 1, 2, 4 ... 512."""

    def __post_init__(self) -> None:
        check_positive(
            blocks=self.blocks,
            layers=self.layers,
            channels=self.channels,
            heads=self.heads,
            feedforward=self.feedforward,
            embedding=self.embedding,
            kernels=self.kernels,
            nearest_view=self.nearest_view,
        )
        if self.channels % self.heads:
            raise ConfigError(f"heads: {self.heads} must divide channels, which is {self.channels}")
        if self.farthest_view < self.nearest_view:
            raise ConfigError(
                f"farthest_view: {self.farthest_view} must be at least nearest_view, which is "
                f"{self.nearest_view}"
            )
        lowest = 1 if self.architecture == "diffwave" else 0
        if not self.dilations or min(self.dilations) < lowest:
            raise ConfigError(
                f"dilations: {list(self.dilations)} must be numbers of at least {lowest} for "
                f"architecture {self.architecture}"
            )
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"dropout: {self.dropout} must be at least 0 and below 1")


@dataclass(frozen=True)
class NoiseConfig:
    """How noise is added, step by step, and what the network tells about it."""

    steps: int = 100
    """N; dance, locomotion and fighting: 150."""
    first_beta: float = 0.0074
    """beta_1, rising on a straight line ...; dance, locomotion and fighting: 0.01."""
    last_beta: float = 0.78
    """... to beta_N; the others 0.7."""
    predict: Literal["noise", "velocity", "clean"] = "noise"
    """What the network predicts: the noise (the paper), the velocity of Salimans and Ho, or the
    clean motion, which is smooth and of few dimensions where noise is neither: a small network
    learns it in a fraction of the time."""

    def __post_init__(self) -> None:
        check_positive(steps=self.steps)
        for name in ("first_beta", "last_beta"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigError(f"{name}: {getattr(self, name)!r} must be between 0 and 1")
        if self.last_beta < self.first_beta:
            raise ConfigError(
                f"last_beta: {self.last_beta} must be at least first_beta, which is "
                f"{self.first_beta}"
            )


@dataclass(frozen=True)
class TrainingConfig:
    """How long, how fast and on how much at a time (section 4.1 and appendix A.1)."""

    updates: int = 67_000
    """ZeroEGGS' 135 minutes; the paper has 112,000 for 244 minutes of speech, 180,000 for 373 of
    dance, 52,000 for 60 of fighting, 292,000 for 1125 of locomotion."""
    batch: int = 80
    """Windows an update; over several processes, of all of them together."""
    window: float = 5.0
    """Seconds."""
    learning_rate: float = 6e-4
    """Of Adam, after warming up."""
    warm_up: int = 3000
    """Updates in which the learning rate rises to it on a straight line."""
    decay: float = 0.99995
    """Every ten updates the learning rate is multiplied by this. So the released code has it; the
    paper has 1 - 0.5e-5. After 67,000 updates 0.72 and 0.97 are left."""
    clip: float = 25.0
    """Largest norm of a gradient; 0 for any."""
    ema: float = 0.0
    """The model is the exponential moving average of the weights, this much of it kept at every
    update (less in the first ones); 0, as in the paper, takes the weights as they are."""
    dropout_condition: float = 0.0
    """Share of windows that are told nothing, so that one model serves guidance and as a prior."""
    dropout_style: float = 0.0
    """Share of the others that are not told their style."""
    min_snr: float | None = None
    """Gamma of min-SNR loss weights; null, as in the paper, weighs all steps alike."""
    changes: float = 0.0
    """Weight of the error in how the motion changes from frame to frame, in units of how much each
    number changes in the recordings. For networks that predict the clean motion, whose own errors
    are small and tremble; the paper has none."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the network's products in training; weights and sums stay float32."""

    def __post_init__(self) -> None:
        check_positive(
            updates=self.updates,
            batch=self.batch,
            window=self.window,
            learning_rate=self.learning_rate,
            decay=self.decay,
        )
        check_share(
            dropout_condition=self.dropout_condition,
            dropout_style=self.dropout_style,
            decay=self.decay,
        )
        for name in ("warm_up", "clip", "changes"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"{name}: {getattr(self, name)!r} must be at least 0")
        if not 0 <= self.ema < 1:
            raise ConfigError(f"ema: {self.ema} must be at least 0 and below 1")
        if self.min_snr is not None:
            check_positive(min_snr=self.min_snr)


@dataclass(frozen=True)
class AugmentationConfig:
    """What else the recordings could have been (appendix A.1)."""

    mirror: bool = True
    """Learn from the mirrored recordings too, but for the styles that `styles.handed` names."""
    stretch: float = 0.1
    """Share of windows that are played faster or slower; dance and fighting: 0.2."""
    stretch_range: float = 0.1
    """By a factor between 1 minus this and 1 plus this."""

    def __post_init__(self) -> None:
        check_share(stretch=self.stretch)
        if not 0 <= self.stretch_range <= 0.5:
            raise ConfigError(f"stretch_range: {self.stretch_range} must be between 0 and 0.5")


@dataclass(frozen=True)
class StyleConfig:
    """The model is told the `style` that the manifest gives each recording."""

    handed: tuple[str, ...] = ()
    """Styles that tell left from right; their recordings are not mirrored."""


@dataclass(frozen=True)
class UnpairedConfig:
    """Motion without speech, learnt from as windows that are told nothing."""

    corpus: Path | None = None
    """A manifest of motion, of any rig with a body: another rig's is put onto the paired one.
    Null for the motion alone that the run's own corpus has."""
    share: float = 0.5
    """Of the windows."""

    def __post_init__(self) -> None:
        check_share(share=self.share)


@dataclass(frozen=True, kw_only=True)
class DiffusionConfig(RunConfig):
    """A diffusion training run: gestures, dance, a path or events to follow, or motion alone."""

    system: Literal["diffusion"]
    out: Path = field(default_factory=lambda: Path("runs/diffusion"))
    fps: float = 30.0
    features: FeatureConfig | None = field(default_factory=FeatureConfig)
    """What is heard, speech or music; null for nothing."""
    path: bool = False
    """The root follows a path that is given: each item's `path`, or the way it went itself."""
    events: bool = False
    """Binary flags tell what happens: each item's `events`."""
    styles: StyleConfig | None = None
    """How styles are learnt; null for none, as in the twin that guidance leads away from."""
    unpaired: UnpairedConfig | None = None
    """Motion that goes without speech; null for none."""
    start_from: Path | None = None
    """A model folder to go on from: its weights, rig, features and standardisation are kept."""
    moves_like: Path | None = None
    """A model folder whose rig, joints and standardisation are kept, with weights of its own: the
    two can be multiplied, whatever each is told."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    checkpoint_every: int = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.moves_like is not None and self.start_from is not None:
            raise ConfigError("moves_like: start_from keeps all of a model; leave out one of them")
        if self.training.changes and self.noise.predict != "clean":
            raise ConfigError(
                f"training.changes: {self.training.changes} is for networks that predict the clean "
                f"motion; noise.predict is {self.noise.predict}"
            )

    @property
    def window_frames(self) -> int:
        """Frames of a training window."""
        return max(2, round(self.training.window * self.fps))
