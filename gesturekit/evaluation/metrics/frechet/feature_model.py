"""A feature extractor for the Fréchet gesture distance, fitted on a reference set.

Published extractors only work for their own rigs (`published`) or were never released. Two values
of this one can be compared if `fingerprint` is the same. It is the autoencoder of Yoon et al. 2020,
whose bottleneck gives the features.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open

from audio_features.atomic import write_tensors
from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.frechet.autoencoder import (
    PoseAutoencoder,
    reconstruction_loss,
)
from gesturekit.evaluation.metrics.frechet.poses import PoseWindows
from gesturekit.evaluation.metrics.frechet.published import SkeletonEncoder, pose_autoencoder
from gesturekit.motion import Motion

log = logging.getLogger(__name__)

FORMAT = 1
STEPS = 2300
"""Optimiser steps, as many as in GENEA's 10 epochs over the four hours of Trinity."""
ENOUGH_SECONDS = 600.0
_RATE, _BETAS = 5e-4, (0.5, 0.999)
_BATCH = {"genea": 64, "yoon": 128}
FILE = "feature_model.safetensors"
_SETTINGS = "feature_model"  # key of the metadata


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

    def __init__(
        self, windows: PoseWindows, network: PoseAutoencoder, training: dict[str, Any]
    ) -> None:
        self.windows = windows
        self.network = network.eval()
        self.training = training

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
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = PoseAutoencoder(windows.n_features, windows.n_frames, variant == "yoon")
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
        return cls(windows, network, record)._described(motions)

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
            weights: safetensors file or torch state dict; see `published.pose_autoencoder`.
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
        n = sum(len(clip) for clip in windows.cut(motions))
        return cls(windows, network, {"weights": str(weights), "windows": n})._described(motions)

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
        return [
            torch.cat([self.network.encoder(part.transpose(1, 2)) for part in _parts(clip)])
            .double()
            .numpy()
            for clip in self.windows.cut(motions)
        ]

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the window settings and all tensors; equal ones give comparable values."""
        digest = hashlib.sha256(json.dumps(self.windows.to_json(), sort_keys=True).encode())
        for name, tensor in sorted(self._tensors().items()):
            digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
            digest.update(tensor.numpy().tobytes())
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
            with torch.random.fork_rng(devices=[]):
                network = PoseAutoencoder(
                    windows.n_features, windows.n_frames, windows.variant == "yoon"
                )
            network.load_state_dict({k.removeprefix("network."): v for k, v in tensors.items()})
            model = cls(windows, network, dict(values["training"]))
        except FileNotFoundError:
            raise EvaluationError(
                f"{path}: no such file; a feature model is a folder made by gesturekit fit-features"
            ) from None
        except Exception as error:  # safetensors has an error class of its own
            text = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            raise EvaluationError(f"{path}: no feature model, or damaged ({text})") from None
        if model.fingerprint != values.get("fingerprint"):
            raise EvaluationError(f"{path}: changed since it was fitted; fit the model again")
        return model

    def _tensors(self) -> dict[str, torch.Tensor]:
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


def _training_windows(
    windows: PoseWindows, motions: Sequence[Motion]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the frames (N, 3 B) of all motions and the first frames (W,) of all windows.

    Warns if there is too little motion.

    Raises:
        EvaluationError: fewer than two windows.
    """
    minutes = sum(motion.duration for motion in motions) / 60
    if minutes < ENOUGH_SECONDS / 60:
        log.warning(
            "The feature model is fitted on %.3g minutes of motion; below %.3g its figures "
            "depend on the seed.",
            minutes,
            ENOUGH_SECONDS / 60,
        )
    clips = [windows.frames(motion).astype(np.float32) for motion in motions]
    lengths = np.array([len(clip) for clip in clips])
    starts = [  # windows lie within one motion
        first + np.arange(max(0, length - windows.n_frames + 1))
        for first, length in zip(np.cumsum(lengths) - lengths, lengths)
    ]
    n_windows = sum(map(len, starts))
    if n_windows < 2:
        raise EvaluationError(
            f"{n_windows} windows of {windows.n_frames / windows.fps:.3g} s in "
            f"{len(motions)} motions; give longer motions"
        )
    return torch.from_numpy(np.concatenate(clips)), torch.from_numpy(np.concatenate(starts))


def _parts(clip: np.ndarray) -> tuple[torch.Tensor, ...]:
    return torch.from_numpy(np.ascontiguousarray(clip, dtype=np.float32)).split(512)


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
