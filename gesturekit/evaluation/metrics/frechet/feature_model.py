"""Feature extractors of the Fréchet gesture distance: fitted on a reference set, or published.

- `FeatureModel`: the autoencoder of Yoon et al. 2020, whose bottleneck gives the features, trained
  on a reference set. It takes the weights of GENEA and of Yoon et al. (`model_checkpoint_60.bin`,
  `gen_dict`) too, with poses normalised by the reference set: the files do not hold the
  normalisation of their own rig.
- `SkeletonEncoder`: that of BEAT2 (EMAGE, Liu et al. 2024; `AESKConv_240_100.bin` of its evaluation
  tools), for motion on the SMPL-X rig. Values are those of the papers.

Two values can be compared if the `fingerprint` of their extractors is the same.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor, nn
from torch.nn import functional as F

from audio_features import AudioFeaturesError
from audio_features.atomic import write_tensors
from audio_features.weight_files import add_tensors, plain_tensors, read_file
from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.frechet.poses import PoseWindows
from gesturekit.evaluation.metrics.inputs import at_rate, motion_name
from gesturekit.motion import Motion
from gesturekit.motion.rotations import matrix_from_quaternion

log = logging.getLogger(__name__)

FORMAT = 1
STEPS = 2300
"""Optimiser steps, as many as in GENEA's 10 epochs over the four hours of Trinity."""
ENOUGH_MINUTES = 10.0
_RATE, _BETAS = 5e-4, (0.5, 0.999)
_BATCH = {"genea": 64, "yoon": 128}
FILE = "feature_model.safetensors"
_SETTINGS = "feature_model"  # key of the metadata
N_FEATURES = 32

_FPS = 30.0
_FRAMES = 32  # a multiple of which BEAT2's evaluation encodes
_JOINTS = 55
_GROUPS = 10


class PoseAutoencoder(nn.Module):
    """Temporal convolutions with a bottleneck of 32 features (Yoon et al. 2020, `embedding_net`).

    Tensors have the names of the published files. GENEA's variant lacks the last linear layer of
    the encoder (`fc_mu`) and takes windows of other lengths than 34 frames.

    Args:
        n_inputs: numbers a frame.
        n_frames: frames of a window, from 12.
        mean_layer: True to add the last linear layer of Yoon et al.
    """

    def __init__(self, n_inputs: int, n_frames: int, mean_layer: bool) -> None:
        super().__init__()
        self.n_inputs, self.n_frames, self.mean_layer = n_inputs, n_frames, mean_layer
        n_left = (n_frames - 4 - 4) // 2 + 1 - 2
        encoder = OrderedDict(
            net=nn.Sequential(
                nn.Sequential(*_convolved(nn.Conv1d(n_inputs, 32, 3))),
                nn.Sequential(*_convolved(nn.Conv1d(32, 64, 3))),
                nn.Sequential(*_convolved(nn.Conv1d(64, 64, 4, stride=2))),
                nn.Conv1d(64, 32, 3),
            ),
            flat=nn.Flatten(),
            out_net=nn.Sequential(
                *_linear(32 * n_left, 256), *_linear(256, 128), nn.Linear(128, N_FEATURES)
            ),
        )
        if mean_layer:
            encoder["fc_mu"] = nn.Linear(N_FEATURES, N_FEATURES)
        decoder = OrderedDict(
            pre_net=nn.Sequential(*_linear(N_FEATURES, 64), nn.Linear(64, 4 * n_frames)),
            channels=nn.Unflatten(1, (4, n_frames)),
            net=nn.Sequential(
                *_convolved(nn.ConvTranspose1d(4, 32, 3)),
                *_convolved(nn.ConvTranspose1d(32, 32, 3)),
                nn.Conv1d(32, 32, 3),
                nn.Conv1d(32, n_inputs, 3),
            ),
        )
        self.pose_encoder, self.decoder = nn.Sequential(encoder), nn.Sequential(decoder)

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (B, 32) and the reconstruction of windows (B, n_frames, n_inputs)."""
        features = self.pose_encoder(windows.transpose(1, 2))
        return features, self.decoder(features).transpose(1, 2)


def reconstruction_loss(made: Tensor, windows: Tensor) -> Tensor:
    """Return L1 plus L1 of frame differences of (B, T, D): means over a window, summed over B."""
    error = (made - windows).abs().mean(dim=(1, 2))
    steps = (torch.diff(made, dim=1) - torch.diff(windows, dim=1)).abs().mean(dim=(1, 2))
    return (error + steps).sum()


def _convolved(layer: nn.Conv1d | nn.ConvTranspose1d) -> tuple[nn.Module, ...]:
    return layer, nn.BatchNorm1d(layer.out_channels), nn.LeakyReLU(0.2)


def _linear(n_inputs: int, n_outputs: int) -> tuple[nn.Module, ...]:
    # The released activation is `LeakyReLU(True)`: a slope of 1.
    return nn.Linear(n_inputs, n_outputs), nn.BatchNorm1d(n_outputs), nn.Identity()


@dataclass(eq=False)
class FeatureModel:
    """Maps each window of poses of a motion to 32 features.

    Attributes:
        windows: cuts motions into windows of normalised poses.
        network: the autoencoder.
        training: seed, steps, motions and seconds of the fit, and `unexplained`, the fraction of
            the reference's mean absolute deviation that the network cannot reconstruct.

    Examples:
        A model that was saved is the same model:

        >>> model = FeatureModel.fit([gk.load("demo").generate(seconds=5)], steps=1)
        >>> model.save(folder / "features")
        >>> FeatureModel.load(folder / "features").fingerprint == model.fingerprint
        True
    """

    windows: PoseWindows
    network: PoseAutoencoder
    training: dict[str, Any]

    @classmethod
    def fit(
        cls,
        motions: Sequence[Motion],
        variant: str = "genea",
        *,
        n_frames: int | None = None,
        joints: str | Sequence[str] | None = None,
        steps: int = STEPS,
        seed: int = 0,
        progress: Callable[[int, float], None] | None = None,
    ) -> FeatureModel:
        """Train the autoencoder on windows drawn from a reference set, on the CPU.

        Adam (5e-4, betas 0.5 and 0.999) on L1 and L1 of frame differences, batches of 64 ("genea")
        or 128 ("yoon"), as published, without the joint noise of Yoon et al. The same seed gives
        the same weights on one machine with the same number of threads.

        Args:
            motions: the reference set, of one rig.
            variant: "genea" or "yoon"; see `PoseWindows.fit`.
            n_frames: see `PoseWindows.fit`.
            joints: see `PoseWindows.fit`.
            steps: optimiser steps.
            seed: of weights and batches.
            progress: called after each step with its number, from 1, and the loss of a window.

        Raises:
            EvaluationError: see `PoseWindows.fit`; or fewer than two windows.
        """
        if steps < 1:
            raise EvaluationError(f"steps is {steps!r}; expected a number from 1")
        windows = PoseWindows.fit(motions, variant, n_frames=n_frames, joints=joints)
        frames, starts = _training_windows(windows, motions)
        network = _network(windows, seed)
        rng = torch.Generator().manual_seed(seed)
        optimiser = torch.optim.Adam(network.parameters(), lr=_RATE, betas=_BETAS)
        size = min(_BATCH[variant], len(starts))
        for step in range(1, steps + 1):
            drawn = starts[torch.randint(0, len(starts), (size,), generator=rng)]
            batch = frames[drawn[:, None] + torch.arange(windows.n_frames)]
            loss = reconstruction_loss(network(batch)[1], batch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            if progress is not None:
                progress(step, loss.item() / size)
        record = {"seed": seed, "steps": steps, "windows": len(starts)}
        return cls(windows, network.eval(), record)._described(motions)

    @classmethod
    def of_weights(
        cls,
        motions: Sequence[Motion],
        weights: str | Path,
        *,
        joints: str | Sequence[str] | None = None,
    ) -> FeatureModel:
        """Take the published weights of GENEA's or Yoon's autoencoder instead of training.

        Poses are normalised by the reference set: the files do not hold the mean and scale of their
        own rig. Values are comparable with one another, not with those of papers.

        Args:
            motions: the reference set, of one rig.
            weights: safetensors file or torch state dict; see `pose_autoencoder`.
            joints: names of the joints that the weights were trained on, see `PoseWindows.fit`.

        Raises:
            EvaluationError: weights of another layout, or for another number of joints.
        """
        network = pose_autoencoder(Path(weights))
        variant = "yoon" if network.mean_layer else "genea"
        windows = PoseWindows.fit(motions, variant, n_frames=network.n_frames, joints=joints)
        if windows.n_features != network.n_inputs:
            raise EvaluationError(
                f"{weights}: takes {network.n_inputs / 3:g} joints, and {len(windows.bones)} are "
                "chosen of the recordings: name those of the weights (joints)"
            )
        record = {"weights": str(weights), "windows": sum(map(len, windows.cut(motions)))}
        return cls(windows, network.eval(), record)._described(motions)

    def _described(self, motions: Sequence[Motion]) -> FeatureModel:
        """Add the reference set to the record of the training."""
        self.training |= {
            "motions": len(motions),
            "seconds": round(sum(motion.duration for motion in motions), 3),
            "unexplained": round(self._unexplained(motions), 4),
        }
        return self

    @torch.no_grad()
    def encode(self, motions: Sequence[Motion]) -> list[np.ndarray]:
        """Return (W_i, 32) features of each motion's windows; skip motions shorter than a window.

        Raises:
            EvaluationError: a motion lacks joints, or none is as long as a window.
        """
        features = []
        for clip in self.windows.cut(motions):
            parts = [self.network.pose_encoder(part.transpose(1, 2)) for part in _parts(clip)]
            features.append(torch.cat(parts).double().numpy())
        return features

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the window settings and all tensors; equal ones give comparable values."""
        digest = hashlib.sha256(json.dumps(self.windows.to_json(), sort_keys=True).encode())
        add_tensors(digest, self._tensors())
        return digest.hexdigest()

    def save(self, folder: str | Path) -> None:
        """Write feature_model.safetensors into a folder, with the settings in its metadata."""
        values = {
            "format": FORMAT,
            "windows": self.windows.to_json(),
            "training": self.training,
            "fingerprint": self.fingerprint,
        }
        write_tensors(Path(folder) / FILE, self._tensors(), {_SETTINGS: json.dumps(values)})

    @classmethod
    def load(cls, folder: str | Path) -> FeatureModel:
        """Read a feature model from the folder that `save` wrote.

        Raises:
            EvaluationError: the file is missing, damaged or of a newer format.
        """
        path = Path(folder) / FILE
        try:
            with safe_open(path, "pt") as file:
                values = json.loads((file.metadata() or {})[_SETTINGS])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if values["format"] != FORMAT:
                raise ValueError(
                    f"format {values['format']!r}; this gesturekit reads format {FORMAT}, a newer "
                    "one needs a newer gesturekit"
                )
            form = values["windows"]
            windows = PoseWindows(
                variant=form["variant"],
                bones=tuple((str(start), str(end)) for start, end in form["bones"]),
                fps=float(form["fps"]),
                n_frames=int(form["n_frames"]),
                stride=int(form["stride"]),
                mean=tensors.pop("windows.mean").numpy(),
                scale=tensors.pop("windows.scale").numpy(),
            )
            network = _network(windows)
            network.load_state_dict({k.removeprefix("network."): v for k, v in tensors.items()})
            model = cls(windows, network.eval(), dict(values["training"]))
            if model.fingerprint != values.get("fingerprint"):
                raise ValueError("changed since it was fitted; fit the model again")
        except Exception as error:  # safetensors has an error class of its own
            text = f"no feature model, or damaged ({_reason(error)})"
            if isinstance(error, FileNotFoundError):
                text = "no such file; a feature model is a folder made by gesturekit fit-features"
            raise EvaluationError(f"{path}: {text}") from None
        return model

    def _tensors(self) -> dict[str, Tensor]:
        tensors = {f"network.{k}": v.contiguous() for k, v in self.network.state_dict().items()}
        tensors["windows.mean"] = torch.from_numpy(self.windows.mean)
        tensors["windows.scale"] = torch.from_numpy(self.windows.scale)
        return tensors

    @torch.no_grad()
    def _unexplained(self, motions: Sequence[Motion]) -> float:
        left = total = 0.0
        for clip in self.windows.cut(motions):
            for part in _parts(clip):
                left += float((self.network(part)[1] - part).abs().sum())
                total += float(part.abs().sum())
        return left / total if total else 0.0


def _network(windows: PoseWindows, seed: int = 0) -> PoseAutoencoder:
    """Return a new autoencoder of these windows; torch's own generator is left as it is."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PoseAutoencoder(windows.n_features, windows.n_frames, windows.variant == "yoon")


def _reason(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def _training_windows(windows: PoseWindows, motions: Sequence[Motion]) -> tuple[Tensor, Tensor]:
    """Return the frames (N, 3 B) of all motions and the first frames (W,) of all windows.

    Warns if there is too little motion.

    Raises:
        EvaluationError: fewer than two windows.
    """
    if (minutes := sum(motion.duration for motion in motions) / 60) < ENOUGH_MINUTES:
        log.warning(
            "The feature model is fitted on %.3g minutes of motion; below %.3g its figures "
            "depend on the seed.",
            minutes,
            ENOUGH_MINUTES,
        )
    clips = [windows.frames(motion).astype(np.float32) for motion in motions]
    first = np.cumsum([0, *map(len, clips)])
    starts = np.concatenate([  # windows lie within one motion
        np.arange(at, max(at, end - windows.n_frames + 1)) for at, end in zip(first, first[1:])
    ])  # fmt: skip
    if len(starts) < 2:
        raise EvaluationError(
            f"{len(starts)} windows of {windows.n_frames / windows.fps:.3g} s in "
            f"{len(motions)} motions; give longer motions"
        )
    return torch.from_numpy(np.concatenate(clips)), torch.from_numpy(starts)


def _parts(clip: np.ndarray) -> tuple[Tensor, ...]:
    return torch.from_numpy(np.ascontiguousarray(clip, dtype=np.float32)).split(512)


def read_weights(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a safetensors file or of a torch state dict; no code in it is run.

    Raises:
        EvaluationError: it cannot be read, or holds no table of tensors.
    """
    try:
        content = read_file(path)
        for name in ("model_state", "gen_dict", "state_dict"):
            if isinstance(content, Mapping) and isinstance(content.get(name), Mapping):
                content = content[name]
        tensors = plain_tensors(path, content)
    except (AudioFeaturesError, OSError) as error:
        raise EvaluationError(str(error)) from None
    return {name.removeprefix("module."): tensor for name, tensor in tensors.items()}


def pose_autoencoder(path: Path) -> PoseAutoencoder:
    """Return the autoencoder of GENEA's or Yoon's weight file; GENEA's lacks `fc_mu`.

    Raises:
        EvaluationError: it cannot be read, or has other tensors.
    """
    tensors = read_weights(path)
    try:
        n_inputs = tensors["pose_encoder.net.0.0.weight"].shape[1]
        n_frames = len(tensors["decoder.pre_net.3.weight"]) // 4
        with torch.device("meta"):  # shapes alone: they may be those of no tensor in the file
            network = PoseAutoencoder(n_inputs, n_frames, "pose_encoder.fc_mu.weight" in tensors)
        known = {name: tensors[name] for name in network.state_dict()}
        network.load_state_dict(known, assign=True)
    except (KeyError, IndexError, RuntimeError) as error:
        raise EvaluationError(
            f"{path}: not GENEA's or Yoon's pose autoencoder ({_reason(error)}); it has "
            f"{', '.join(list(tensors)[:4]) or 'no tensors'}"
        ) from None
    return network.float()


class SkeletonEncoder:
    """BEAT2's encoder of SMPL-X poses, for the FGD of its papers.

    Poses are the first two rows of the local rotation matrices of 55 joints, at 30 fps. Layers are
    tanh(pool(GroupNorm(conv(x)) + shortcut(x))): a convolution and a shortcut with stride 2, both
    masked to neighbouring joints, ten groups, and a mean over joints where there is a pool.
    As in the published evaluation, a motion is encoded whole, cut to a multiple of 32 frames: the
    normalisation is over time, so that features depend on the length of clips.
    """

    windows = None  # `raw_fgd` fits its own

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self._tensors = {name: tensor.float() for name, tensor in tensors.items()}

    @classmethod
    def load(cls, path: Path) -> SkeletonEncoder:
        """Read BEAT2's weights; the decoder is left out.

        Raises:
            EvaluationError: it cannot be read, or has other tensors.
        """
        tensors = read_weights(path)
        start = "encoder.layers."
        encoder = cls({k.removeprefix(start): t for k, t in tensors.items() if k.startswith(start)})
        try:
            encoder._features(torch.zeros(1, 6 * _JOINTS, _FRAMES))
        except (KeyError, RuntimeError, IndexError) as error:
            raise EvaluationError(
                f"{path}: not BEAT2's skeleton encoder of {_JOINTS} joints "
                f"({_reason(error)}); weights of GENEA's layout need "
                "recordings: gesturekit fit-features RECORDINGS --weights FILE"
            ) from None
        return encoder

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the tensors; values of equal ones can be compared."""
        digest = hashlib.sha256(b"BEAT2")
        add_tensors(digest, self._tensors)
        return digest.hexdigest()

    @torch.no_grad()
    def encode(self, motions: Sequence[Motion]) -> list[np.ndarray]:
        """Return (T / 16, D) features of each motion at 30 fps; skip motions below 32 frames.

        Raises:
            EvaluationError: a motion is not on the SMPL-X rig, or none has 32 frames.
        """
        features = []
        for motion in motions:
            if motion.skeleton.n_joints != _JOINTS or "jaw" not in motion.skeleton.names:
                raise EvaluationError(
                    f"{motion_name(motion)}: BEAT2's extractor takes the {_JOINTS} joints of SMPL-X"
                )
            motion = at_rate(motion, _FPS)
            n = motion.n_frames - motion.n_frames % _FRAMES
            if n:
                rows = matrix_from_quaternion(motion.rotations[:n])[..., :2, :].reshape(1, n, -1)
                poses = torch.from_numpy(rows.astype(np.float32)).transpose(1, 2)
                features.append(self._features(poses)[0].T.double().numpy())
        if not features:
            raise EvaluationError(f"none of {len(motions)} motions has {_FRAMES} frames at 30 fps")
        return features

    def _features(self, poses: Tensor) -> Tensor:
        """Return features (B, D, T / 16) of poses (B, 330, T)."""
        for layer in range(4):
            w = {n[4:]: t for n, t in self._tensors.items() if n.startswith(f"{layer}.0.")}
            kernel = w["residual.0.weight"] * w["residual.0.mask"]
            padded = F.pad(poses, ((kernel.shape[2] - 1) // 2,) * 2)
            made = F.conv1d(padded, kernel, w["residual.0.bias"], stride=2)
            made = F.group_norm(made, _GROUPS, w["residual.1.weight"], w["residual.1.bias"])
            direct = w["shortcut.weight"] * w["shortcut.mask"]
            made = made + F.conv1d(poses, direct, w["shortcut.bias"], stride=2)
            if "common.0.weight" in w:
                made = w["common.0.weight"] @ made
            poses = torch.tanh(made)
        return poses


Extractor = FeatureModel | SkeletonEncoder
"""Feature extractors of the Fréchet gesture distance."""


def load_extractor(path: str | Path) -> Extractor:
    """Read a feature extractor for `fgd`.

    Args:
        path: the folder of a `FeatureModel`, or the weight file of BEAT2's extractor.

    Raises:
        EvaluationError: it cannot be read, or is neither.

    Examples:
        >>> FeatureModel.fit([gk.load("demo").generate(seconds=5)], steps=1).save(folder / "own")
        >>> load_extractor(folder / "own").windows.n_frames
        60
    """
    path = Path(path)
    return SkeletonEncoder.load(path) if path.is_file() else FeatureModel.load(path)
