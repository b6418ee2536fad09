"""Reading of a corpus into the training data of a multires run, in memory or as arrays on disk.

A model to start from (`start_from`) is checked against the run.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.manifest import Item
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs, find_parts, is_upper_body, unidentified
from gesturekit.motion.root_path import heading
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.backend import requested_backend
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.networks import modulated_blocks
from gesturekit.multires.pyramid import Conditions
from gesturekit.multires.retrieval import PassiveChannels
from gesturekit.multires.training.data import (
    CorpusFrames,
    Cut,
    TrainingData,
    level_sigmas,
    paired_sequences,
    transposed,
)
from gesturekit.state.channels import StateChannels
from gesturekit.training.arrays import Array, ArrayInMemory, Maker, stored_arrays
from gesturekit.training.config import to_dict
from gesturekit.training.features import SpeechArrays, conditioner_values, feature_values
from gesturekit.training.origin import check_conditions, check_rig, check_settings, model_of
from gesturekit.training.recordings import Recordings, Rig, load_recordings, systematic_sample
from gesturekit.training.run_config import LEGLESS, UNIDENTIFIED
from gesturekit.wording import counted, roughly

log = logging.getLogger(__name__)


def load_training_data(
    config: MultiresConfig, device: str = "cpu", *, trial: bool = False
) -> TrainingData:
    """Read the corpus of a run, or in a trial an excerpt of it; extract features on a device, and
    normalise. The data of a long corpus stay on disk, and statistics are those of a sample.

    Raises:
        ConfigError: settings that the recordings do not allow, or other ones than those of a model
            in `start_from`.
        ModelError: such a model cannot be read.
        CorpusError: no training item with what the mode needs, rigs that differ, or a file that
            cannot be read.
    """
    requested_backend(config.backend)  # a wrong one is refused before the run folder is made
    # Wrong extractor settings are reported before any file is read.
    features, state, passive = config.features, None, PassiveChannels()
    speech = None if features is None else SpeechArrays.open(features, config.fps, device)
    start = load_start(config, speech)
    parts = config.parts if start is None else {**start.skeleton.parts, **config.parts}
    recordings = read_recordings(config, start, parts, trial=trial)
    motions = [motion.resample(config.fps) for motion in recordings.motions]
    representation = _representation(config, motions, start)
    if config.state:
        state = StateChannels.find(representation.skeleton, representation.joints)
        passive = PassiveChannels.find(motions, representation.joints)
    rig = recordings.rig(config, parts)
    maker = MotionArrays(rig, representation, passive, config.fps, config.face_forward)
    made = [maker.encode(*pair) for pair in zip(recordings.read, motions, strict=True)]
    normaliser = _normaliser(config, made, representation, start)
    if recordings.excerpts is not None:
        del motions, made[:]  # the sample is read again, from the arrays
    arrays = _arrays(config, recordings, maker, made, speech)
    sampled, clips = _sample(config, recordings, arrays)
    known = None if start is None else start.conditions.conditioner
    conditioner = None if speech is None else speech.fit(clips, known)
    frames = CorpusFrames.of(arrays, normaliser, conditioner)
    frames = frames.in_memory() if sampled is None else frames
    cuts = [frames.motion[i][:, start:stop][None] for i, start, stop in sampled or ()]
    sigmas = [level_sigmas(cut, config.network) for cut in cuts]
    sigma = torch.stack(sigmas).mean(dim=0) if sigmas else None
    labels = [
        {"name": item.id, "style": style, "speaker": item.speaker, "take": item.take}
        for item, style in zip(recordings.items, recordings.style_of, strict=True)
    ]
    return TrainingData(
        paired=paired_sequences(config, labels, frames, [sigma] * len(labels)),
        unpaired=tuple(frames.unpaired or frames.speech),
        silence=_silence(config, frames, conditioner),
        window=_window(config),
        representation=representation,
        conditions=Conditions(conditioner, tuple(recordings.styles), config.residual, state),
        normaliser=normaliser,
        speakers=recordings.speakers,
        sources=recordings.sources([array.facts["fps"] for array in arrays["motion"]]),
        recorded_fps=recordings.recorded_fps,
        passive=passive,
        start={} if start is None else start.network.state_dict(),
        spoken=(recordings.lengths[1], len(recordings.whole[1])),
        sampled=sampled,
    )


def read_recordings(
    config: MultiresConfig,
    start: MultiresModel | None = None,
    parts: Mapping[str, str] | None = None,
    *,
    trial: bool,
) -> Recordings:
    """Read the recordings; a model to start from has their styles, and maybe more.

    Raises:
        ConfigError: a style that this model does not know, or only one of them has styles.
    """

    def check_styles(styles: Sequence[str]) -> None:
        if start is not None and config.start_from is not None:
            known, wanted = {"styles": list(start.styles)}, {"styles": list(styles)}
            check_conditions(config.start_from, known, wanted)

    recordings = load_recordings(
        config,
        config.parts if parts is None else parts,
        speech=config.features is not None,
        styles=config.styles is not None,
        check_styles=check_styles,
        trial=trial,
    )
    if start is None:
        return recordings
    names = recordings.styles
    numbers = [start.styles.index(names[i]) if names else 0 for i in recordings.style_of]
    return replace(recordings, styles=start.styles, style_of=numbers)


def _representation(
    config: MultiresConfig, motions: Sequence[Motion], start: MultiresModel | None
) -> MultiresRepresentation:
    """Fit the motion representation; warn if speech has no upper body to modulate."""
    if start is not None:
        return representation_on_bones_of(start, config, motions)
    representation = MultiresRepresentation.fit(motions, config.joints, config.contact_threshold)
    if config.features is not None and config.network.modulate == "upper":
        try:
            find_parts(representation.skeleton)
        except MotionError as error:
            log.warning(
                "The upper body cannot be identified, so that speech modulates all joints, and the "
                "losses on arms are left out: %s",
                error,
            )
    return representation


def _normaliser(
    config: MultiresConfig,
    made: Sequence[np.ndarray],
    representation: MultiresRepresentation,
    start: MultiresModel | None,
) -> Normaliser:
    """Return the normaliser of a model to start from, or fit one if the run has one."""
    width = representation.n_features
    if start is not None:
        return start.normaliser
    if config.normalise:
        return Normaliser.fit([rows[:, :width] for rows in made], representation, config.fps)
    return Normaliser(torch.zeros(width), torch.ones(width))


@dataclass(frozen=True)
class MotionArrays:
    """Makes arrays (T, D + X): motion vectors, not normalised, and passive channels.

    Attributes:
        rig: of the corpus.
        representation: of motion.
        passive: joints and face channels that are not modelled.
        fps: frames per second.
        face_forward: see `MultiresConfig.face_forward`.
    """

    rig: Rig
    representation: MultiresRepresentation
    passive: PassiveChannels
    fps: float
    face_forward: bool

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the motion vectors of an item depend on."""
        known = self.representation
        return {
            **self.rig.origin(item),
            "joints": list(known.joints),
            "lengths": [known.scale, known.contact_speed],
            "passive": [list(self.passive.joints), list(self.passive.face)],
            "settings": [self.fps, self.face_forward],
        }

    def make(self, item: Item) -> tuple[np.ndarray, dict[str, Any]]:
        """Encode the motion of an item."""
        recorded = self.rig.load(item)
        rows = self.encode(item, recorded.resample(self.fps))
        return rows, {"id": item.id, "fps": recorded.fps}

    def encode(self, item: Item, motion: Motion) -> np.ndarray:
        """Return the rows (T, D + X) float64 of a motion at `fps`.

        Raises:
            CorpusError: the motion cannot be encoded.
        """
        turn = -heading(motion) if self.face_forward else 0.0
        try:
            vectors = self.representation.encode(motion, turn=turn)
        except ValueError as error:
            raise CorpusError(f"{self.rig.corpus}: item {item.id}: {error}") from None
        return np.concatenate([vectors, self.passive.encode(motion)], axis=1)


def _arrays(
    config: MultiresConfig,
    recordings: Recordings,
    maker: MotionArrays,
    made: Sequence[np.ndarray],
    speech: SpeechArrays | None,
) -> dict[str, Sequence[Array]]:
    """Return motion, speech and unpaired speech in memory, or of a long corpus on disk.

    Arrays that are missing on disk are made.
    """
    items, others = recordings.items, recordings.unpaired
    names = ("motion",) if speech is None else ("motion", "speech", "unpaired")
    if recordings.excerpts is None:
        pairs = zip(made, recordings.rates, strict=True)
        arrays: list[Sequence[Array]] = [[ArrayInMemory(rows, {"fps": fps}) for rows, fps in pairs]]
        if speech is not None:
            spoken = speech.in_memory([*items, *others])
            arrays += [spoken[: len(items)], spoken[len(items) :]]
    else:
        wanted: list[tuple[Maker, Sequence[Item]]] = [(maker, items)]
        wanted += [] if speech is None else [(speech, items), (speech, others)]
        arrays = [*stored_arrays(config.arrays_folder, wanted, config.workers)]
    return dict(zip(names, arrays, strict=True))


def _sample(
    config: MultiresConfig, recordings: Recordings, arrays: Mapping[str, Sequence[Array]]
) -> tuple[tuple[Cut, ...] | None, list[tuple[Array, int, int]]]:
    """Return the parts of a long corpus from which statistics are computed, None for all of it.

    The second value is the speech to which a conditioner is fitted: arrays, first frames and ends.
    """
    speech, unpaired = arrays.get("speech", ()), arrays.get("unpaired", ())
    if recordings.excerpts is None:
        return None, [(array, 0, array.shape[0]) for array in (*speech, *unpaired)]
    beside = speech or arrays["motion"]
    pairs = zip(arrays["motion"], beside, strict=True)
    lengths = [min(motion.shape[0], other.shape[0]) for motion, other in pairs]
    cuts = tuple(
        (excerpt.index, *excerpt.frames(config.fps, lengths[excerpt.index]))
        for excerpt in recordings.excerpts
    )
    clips = [(speech[i], start, stop) for i, start, stop in cuts] if speech else []
    for excerpt in systematic_sample(recordings.unpaired, 60 * config.in_memory) if speech else ():
        array = unpaired[excerpt.index]
        clips.append((array, *excerpt.frames(config.fps, array.shape[0])))
    return cuts, clips


def _window(config: MultiresConfig) -> int | None:
    """Return the frames of a training window; None for whole sequences."""
    window = config.training.window
    return None if window is None else max(config.network.levels, round(window * config.fps))


def _silence(
    config: MultiresConfig, frames: CorpusFrames, conditioner: SpeechConditioner | None
) -> Tensor:
    """Return the features (S, T) of silence as long as the longest motion of a step.

    Raises:
        ConfigError: the longest recording has too few frames.
    """
    longest = max(motion.shape[-1] for motion in frames.motion)
    if config.network.lengths(longest)[0] < 2:
        raise ConfigError(
            f"network.levels: {config.network.levels} levels leave one frame of the longest "
            f"recording ({longest / config.fps:.1f} s) at the coarsest; use fewer levels"
        )
    longest = max(longest, *(clip.shape[-1] for clip in frames.unpaired), 0)
    n_frames = (_window(config) or longest) + 2 * config.random_margin
    if conditioner is None:
        return torch.empty(0, n_frames)
    return transposed(conditioner.silence(n_frames))


def adapted(config: MultiresConfig, skeleton: Skeleton, *, quiet: bool) -> MultiresConfig:
    """Return the settings without losses on body parts that the rig lacks; log them."""
    missing = unidentified(skeleton)
    if is_upper_body(skeleton):
        if not quiet:
            log.info(LEGLESS)
        return replace(config, losses=replace(config.losses, contact=0.0))
    if not missing:
        return config
    losses = replace(config.losses, arm_speed=0.0, arm_acceleration=0.0)
    follows = []
    if config.uses_arm_speed:
        follows.append("no losses on the arms")
    if find_legs(skeleton) is None:
        losses = replace(losses, contact=0.0)
        follows += ["no contact labels or loss", "recordings keep their heading"]
    if config.joints == "body":
        follows.append("all joints are modelled")
    if follows and not quiet:
        log.info(UNIDENTIFIED, missing.capitalize(), ", ".join(follows))
    return replace(config, losses=losses)


def warn_of_speech(config: MultiresConfig, data: TrainingData) -> None:
    """Warn of a corpus without unpaired speech, and of clips that are shorter at level 1 than the
    patches of the discriminator."""
    if data.unpaired_is_paired:
        log.warning("The corpus has no unpaired speech: random steps take the paired speech.")
    network, least = config.network, config.network.n_frames_of_patch
    lengths = [clip.shape[-1] for clip in data.unpaired]
    short = [n for n in lengths if network.lengths(n)[0] < least]
    if data.own_lengths and short:
        log.warning(
            "%d of %d clips of unpaired speech have fewer than the %d frames of a discriminator's "
            "patch at level 1, which sees them reflected: of %d levels, clips of %.1f s or more "
            "have enough.",
            *(len(short), len(lengths), least, network.levels),
            math.ceil((least - 0.5) * network.factor ** (network.levels - 1)) / config.fps,
        )


def described(config: MultiresConfig, data: TrainingData) -> tuple[list[str], list[str]]:
    """Return the kind of a model in words, and descriptions of its training data."""
    conditioner, styles = data.conditions.conditioner, data.conditions.styles
    inputs = ["speech"] * bool(conditioner) + ["labels"] * bool(styles)
    mode = f"{' and '.join(inputs)} mode" if inputs else "no condition"
    contents = []
    if conditioner is not None:
        if not data.unpaired_is_paired:
            contents.append(f"{roughly(data.spoken[0])} of unpaired speech")
        contents.append(counted(conditioner.dim, "speech feature"))
    if styles:
        contents.append(counted(len(styles), "style"))
    return ["multires", mode, f"{config.network.levels} levels"], contents


def load_start(config: MultiresConfig, speech: SpeechArrays | None) -> MultiresModel | None:
    """Load the model of `start_from`; None for a run that starts from random weights.

    Args:
        config: settings of the run.
        speech: its speech features; None without speech input.

    Raises:
        ConfigError: the model has other settings or features.
        ModelError: the model cannot be read.
    """
    folder = config.start_from
    if folder is None:
        return None
    weights = None if config.features is None else config.features.encoder_places
    start = MultiresModel.load(model_of(folder), weights=weights)
    known: dict[str, Any] = {
        "fps": start.fps,
        "normalise": bool(start.normaliser.mean.any()),
        "contact_threshold": start.representation.contact_speed,
    }
    wanted = {name: getattr(config, name) for name in known}
    for settings, network in ((known, start.network_config), (wanted, config.network)):
        settings |= {f"network.{name}": value for name, value in to_dict(network).items()}
    check_settings("start_from", folder, known, wanted)
    conditions, given, asked = start.conditions, None, None
    conditioner, has_state = conditions.conditioner, conditions.state is not None
    if conditioner is not None:
        given = {**conditioner_values(conditioner), "residual": conditions.residual}
    if speech is not None:
        asked = {**feature_values(speech), "residual": config.residual}
    check_conditions(folder, {"features": given}, {"features": asked})
    # A model without a state may get one, unless the state hides columns of vocal effort from
    # the network, or the network has no layer for a condition.
    hides = conditioner is not None and bool(conditioner.effort)
    if hides or has_state or not conditions.width:
        check_settings("start_from", folder, {"state": has_state}, {"state": config.state})
    return start


def representation_on_bones_of(
    start: MultiresModel, config: MultiresConfig, motions: Sequence[Motion]
) -> MultiresRepresentation:
    """Return the model's motion vector, on the bones of the run's recordings.

    Raises:
        ConfigError: the recordings have another rig, or other parts of the body are identified.
    """
    folder, known = config.start_from, start.representation
    assert folder is not None
    check_rig("start_from", folder, known.skeleton, motions[0].skeleton, config.corpus)
    wanted = known.on_bones_of(motions)

    def parts(rig: MultiresRepresentation) -> dict[str, list[str]]:
        modulated = zip(rig.joints, modulated_blocks(rig, config.network), strict=False)
        upper = [name for name, chosen in modulated if chosen]
        return {"feet": [point.joint for point in rig.foot_points], "upper body": upper}

    now = parts(wanted)
    for what, before in parts(known).items():
        if before != now[what]:
            raise ConfigError(
                f"start_from: {folder} has {what} {before}, {config.corpus} {now[what]}; name the "
                "parts of the rig by hand (parts: {left_knee: JOINT, ...})"
            )
    return wanted
