"""Stream of sound in, stream of motion out, with feet locked without knowledge of the future."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

import audio_features as af
from audio_features.acoustic.streaming import check_streams
from gesturekit.errors import ModelError
from gesturekit.model import control_entries
from gesturekit.motion.concatenation import stacked
from gesturekit.motion.ik import two_bone_ik
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs, leg_length
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions
from gesturekit.motion.skeleton import Skeleton, forward_kinematics, global_rotations
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.keyframes import moved
from gesturekit.multires.pyramid import finite, requested_styles
from gesturekit.multires.retrieval import PieceSequence, Resumable
from gesturekit.multires.stream_window import (
    Forecast,
    LiveState,
    SpeechStream,
    WindowLevels,
)
from gesturekit.postprocess.feet import feet_of_legs
from gesturekit.state.files import mood_seed
from gesturekit.state.live import AheadPrediction, FeatureWindow
from gesturekit.training.seeds import checked_item, checked_seed, rng_for

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_FURTHEST = 0.1
"""A standing foot is kept within this share of the leg length from where it would be."""
_RELEASE_SECONDS = 0.12
"""Time constant with which a lifted foot returns to its own path."""
_FOLLOW_SECONDS = 0.5
"""Time constant with which the body follows standing feet."""


class FootHold(Resumable):
    """Standing feet that are kept in place.

    A foot stays where it came to stand, by inverse kinematics of the leg. What both feet have in
    common moves the body instead: their slow slide.

    Args:
        skeleton: of the stream; one without two identifiable legs does not change.
        fps: frames per second.
    """

    kept = ("_shift", "_moved", "_anchors")

    def __init__(self, skeleton: Skeleton, fps: float) -> None:
        self._fps, self._feet = fps, None
        if find_legs(skeleton) is not None:
            # Only the legs and the joints above them are computed.
            self._joints, self._feet = feet_of_legs(skeleton)
            index = {joint: k for k, joint in enumerate(self._joints)}
            self._legs = Skeleton(
                tuple(skeleton.names[joint] for joint in self._joints),
                tuple(index.get(skeleton.parents[joint], -1) for joint in self._joints),
                skeleton.offsets[self._joints],
            )
            self._reach = _FURTHEST * leg_length(skeleton)
        self._shift = np.zeros(3)
        self._moved = np.zeros((2, 3))
        self._anchors = np.full((2, 3), np.nan)

    def __call__(
        self,
        motion: Motion,
        contacts: np.ndarray,
        displaced: Callable[[Motion, np.ndarray], Motion],
    ) -> Motion:
        """Return the next frame with standing feet in place.

        Args:
            motion: one frame.
            contacts: (F,) labels of `gesturekit.motion.contacts.foot_points`, above 0.5 if a point
                stands.
            displaced: returns a motion with its root displaced by (2,) metres of x and z.
        """
        if self._feet is None:
            return motion
        legs, rotations = self._legs, motion.rotations[:, self._joints]
        moving = {n: v for n, v in motion.joint_translations.items() if n in legs.names}
        positions = forward_kinematics(rotations, motion.translation, legs, moving)
        world = global_rotations(rotations, legs)
        ankles = positions[0, [foot.ankle for foot in self._feet]]
        columns = [[k for anchor in foot.anchors for k in anchor.columns] for foot in self._feet]
        self._follow(ankles, np.array([(contacts[points] > 0.5).any() for points in columns]))
        limbs = np.array([foot.limb for foot in self._feet])
        bones, joints = limbs[:, :2], positions[0, limbs] + self._shift
        rotations[0, bones] = two_bone_ik(
            joints,
            ankles + self._shift + self._moved,
            rotations[0, bones],
            world[0, np.array(legs.parents)[bones]],
            pole=joints[:, 1] - joints[:, 0],
        )
        reached = global_rotations(rotations, legs)
        for foot in self._feet:
            back = invert_quaternions(reached[:, legs.parents[foot.ankle]])
            rotations[:, foot.ankle] = multiply_quaternions(back, world[:, foot.ankle])
        whole = motion.rotations.copy()
        whole[:, self._joints] = rotations
        return replace(displaced(motion, self._shift[[0, 2]]), rotations=whole)

    def _follow(self, ankles: np.ndarray, stands: np.ndarray) -> None:
        """Update the corrections for a frame with ankles (2, 3), two of which may stand."""
        shifted = ankles + self._shift
        new = stands & np.isnan(self._anchors[:, 0])
        self._anchors[new] = (shifted + self._moved)[new]
        self._anchors[~stands] = np.nan
        self._moved[~stands] *= math.exp(-1 / (_RELEASE_SECONDS * self._fps))
        away = (self._anchors - shifted)[stands] * [1.0, 0.0, 1.0]
        length = np.linalg.norm(away, axis=1, keepdims=True)
        away *= np.minimum(1.0, self._reach / np.maximum(length, 1e-9))
        self._moved[stands] = away
        self._anchors[stands] = (shifted[stands] + away) * [1.0, 0.0, 1.0]
        if stands.any():
            common = away.mean(axis=0) * (1 - math.exp(-1 / (_FOLLOW_SECONDS * self._fps)))
            self._shift += common
            self._moved[stands] -= common


_AROUND_SECONDS = 1.6
"""Seconds before and after a frame that its finer levels are computed from."""
_HELD_SECONDS = 0.5
"""Features of the unknown future are their mean over this time."""
_SMOOTHED_SECONDS = 0.03
"""Standard deviation of the low-pass of models that smooth their motion: 6 Hz, above which gestures
have almost no energy."""
_HOME_SECONDS = 30.0
"""Time constant with which the body returns to its place: a stream may last for hours."""
_BLEND, _LATER = 8, 2
"""Windows of which a frame is the mean, and by how many steps the last of them comes later than its
own."""
_STEADY_SECONDS = 5.0
"""Weight of a mean of 0 in the running mean of the slow prediction, in seconds of sound."""
_CONTROLS = ("style", "speaker", "liveliness", "mood_seed", "foot_lock", "smooth")
"""Controls that a stream takes."""


class MultiresStream(Resumable):
    """Motion that is generated while sound comes in.

    Frame k of the stream belongs to k / fps seconds of the sound. It depends on the sound up to
    `look_ahead` seconds and two frames later. Motion does not depend on the size of blocks, so a
    stream equals its replay. Memory is bounded.

    Each frame is computed from a window around it: the drawn state of movement, and the features,
    which are unknown from the look-ahead on. So there are no seams.

    Args:
        model: with speech input, a state of movement, and predictions for live speech.
        sample_rate: of the sound, Hz.
        look_ahead: seconds of sound that a frame waits for; the next smaller one of those that the
            model has predictions for is used.
        seed: of the random numbers.
        item: name of the stream; streams of other names are other draws.
        controls: style, speaker, liveliness, mood_seed, foot_lock and smooth.

    Attributes:
        n_frames: frames returned so far.

    Raises:
        ModelError: a model that cannot stream, or a control that a stream does not take.
        AudioError: a sample rate out of range.
    """

    kept = ("n_frames", "_steps", "_samples", "_place", "_slow", "_recent")

    def __init__(
        self,
        model: MultiresModel,
        sample_rate: int,
        look_ahead: float,
        seed: int,
        item: str,
        controls: MultiresControls,
    ) -> None:
        seed, item = checked_seed(seed), checked_item(item)
        predictions = _predictions(model, look_ahead, controls)
        self.model, self.sample_rate, self.fps = model, sample_rate, model.fps
        self._around = round(_AROUND_SECONDS * model.fps)
        most = self._around + 1 + math.ceil(predictions[0].look_ahead * model.fps)
        assert model.conditions.conditioner is not None
        self._speech = SpeechStream(model.conditions.conditioner, sample_rate, most)
        ahead = [self._speech.rows_ahead(prediction.look_ahead) for prediction in predictions]
        self._predictions, self._ahead = predictions, ahead[0]
        self._horizons = (ahead[0] - np.array(ahead)) / model.fps
        n = 2 * self._around
        lengths = model.network_config.lengths(n)
        styles, style = _styles(model, controls, lengths, seed, item)
        impulse = np.zeros(2 * self._around + 1, np.float32)
        impulse[self._around] = 1.0
        if model.smooth if controls["smooth"] is None else controls["smooth"]:
            impulse = gaussian_filter1d(impulse, _SMOOTHED_SECONDS * model.fps)
        self._kernel = torch.from_numpy(impulse[np.flatnonzero(impulse)])
        # Frames of the window that are made, and the others from which they are smoothed.
        reach = len(self._kernel) // 2
        used = np.arange(-_LATER - reach, _BLEND - _LATER + reach) + self._around
        self._levels = WindowLevels(model, lengths, styles, range(used[0], used[-1] + 1))
        assert model.state_process is not None
        self._process = model.state_process
        seeds = (
            rng_for(mood_seed(seed, controls), item, "live", "mood").initial_seed() >> 1,
            rng_for(seed, item, "live", "carriers").initial_seed() >> 1,
        )
        group = controls["speaker"], style
        self._state = LiveState(self._process, self._around, seeds, group, controls["liveliness"])
        self._pieces = None
        if model.library is not None:
            self._pieces = PieceSequence(
                model.library,
                lambda piece: rng_for(seed, item, "live", "piece", piece),
                controls["speaker"],
                None if style is None else lambda _: style,
            )
        self._slow = np.zeros(2)  # sum and count of slow predictions
        body = None if controls["speaker"] is None else model.speakers[controls["speaker"]]
        self._body = body
        self.skeleton: Skeleton = model.skeleton if body is None else body
        self._feet = FootHold(self.skeleton, model.fps) if controls["foot_lock"] else None
        self._place = np.zeros(2)
        self._recent = list[np.ndarray]()
        self.n_frames, self._steps, self._samples = 0, 0, 0

    @property
    def latency(self) -> float:
        """Seconds from a sound to the return of the frame that belongs to it, at most.

        The length of the blocks comes on top of it, and the time to compute.
        """
        return max(0.0, (self._ahead + _LATER) / self.fps + self._speech.reach)

    def state(self) -> dict[str, Any]:
        """Return everything that `restore` needs, as numbers and arrays."""
        parts = {name: getattr(self, name) for name in _PARTS}
        return copy.deepcopy(
            super().state()
            | {name: part.state() for name, part in parts.items() if part is not None}
        )

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of a stream with the same arguments."""
        state = copy.deepcopy(dict(state))
        super().restore(state)
        for name in _PARTS:
            if (part := getattr(self, name)) is not None:
                part.restore(state[name])

    def step(self, samples: np.ndarray) -> Motion | None:
        """Take the next samples and return the frames that they complete; None without any.

        Args:
            samples: (N,) float32 at `sample_rate`, full scale 1; N may be 0.

        Raises:
            ModelError: samples of another shape, or that are not finite.
        """
        samples = np.asarray(samples, np.float32)
        if samples.ndim != 1 or not np.isfinite(samples).all():
            raise ModelError(
                f"samples of shape {samples.shape}: a stream takes finite samples (N,), one channel"
            )
        self._samples += len(samples)
        return self._step(samples, math.inf)

    def finish(self) -> Motion | None:
        """Return the remaining frames, as if silence followed: floor(duration · fps + ½) in all.

        With a look-ahead of 0 frames come up to 8 ms before their sound, so that there may be one
        more.
        """
        total = math.floor(self._samples * self.fps / self.sample_rate + 0.5)
        silence = math.ceil((self.latency + 2 / self.fps) * self.sample_rate)
        return self._step(np.zeros(max(silence, 0), np.float32), total)

    def _step(self, samples: np.ndarray, most: float) -> Motion | None:
        frames = []
        for window in self._speech.push(samples):
            while self.n_frames < most and self._steps < self._speech.n_rows - self._ahead:
                self._steps += 1
                self._recent = [self._vectors(window), *self._recent][:_BLEND]
                if self._steps <= _LATER:
                    continue
                frame = self._placed(self._blended())
                if self._pieces is not None:
                    frame = self._pieces.with_passive(frame, self.n_frames)
                frames.append(frame)
                self.n_frames += 1
        return stacked(frames) if frames else None

    def _vectors(self, window: FeatureWindow) -> np.ndarray:
        """Return the motion vectors (D, N) of the frames that are made with the current one."""
        speech = self._features(window)
        state = self._state.advance(speech, self._predicted(window))
        self._choose_pieces(speech)
        made = self._levels(speech, state)
        around = made.unfold(1, len(self._kernel), 1)
        vectors = around[..., len(self._kernel) // 2].clone()
        columns = self.model.representation.layout.rotations
        vectors[columns] = around[columns] @ self._kernel
        return vectors.numpy()

    def _blended(self) -> np.ndarray:
        """Return the vector (D,) of the next frame: the mean of those made of it so far.

        As coarse frames lie elsewhere in each window, one alone would tremble.
        """
        weights = np.hanning(_BLEND + 2)[1 : len(self._recent) + 1]
        made = [vectors[:, i] for i, vectors in enumerate(self._recent)]
        mean = torch.from_numpy(np.average(made, axis=0, weights=weights).astype(np.float32))
        return finite(self.model.normaliser.to_values(mean[None, :, None])[0])

    def _choose_pieces(self, speech: np.ndarray) -> None:
        """Choose what is played next if it is due, by features (2 around, S) around now."""
        if self._pieces is not None and self._pieces.next_frame <= self._steps - 1:
            known = self._process.with_voice(self._state.coming, speech[self._around :].T)
            self._pieces.choose(known)

    def _predicted(self, window: FeatureWindow) -> Forecast | None:
        """Return predictions of fast and slow movement; None without."""
        if (wanted := self._process.wanted) is None:
            return None
        predictions = [prediction(window, wanted) for prediction in self._predictions]
        fast = np.array([fast for fast, _ in predictions])
        shares = np.array([prediction.share(wanted) for prediction in self._predictions])
        slow = predictions[0][1]
        # The mean so far counts less, as in `WantedMovement`.
        self._slow = self._slow + (slow, 1.0)
        mean = self._slow[0] / (self._slow[1] + _STEADY_SECONDS * self.fps)
        slow -= (1 - wanted.mean_counts) * mean
        return Forecast(self._horizons, fast, shares, slow)

    def _features(self, window: FeatureWindow) -> np.ndarray:
        """Return the speech features (2 around, S) around the current frame."""
        known = window.rows[-(self._around + 1 + self._ahead) :]
        held = window.rows[-round(_HELD_SECONDS * self.fps) :].mean(axis=0, keepdims=True)
        features = np.repeat(held, 2 * self._around, axis=0)
        features[: len(known)] = known
        return features

    def _placed(self, vector: np.ndarray) -> Motion:
        """Return the frame of a motion vector (D,), which goes on where the last one ended."""
        representation = self.model.representation
        layout = representation.layout
        if self.n_frames:
            stays = 1 - 1 / (_HOME_SECONDS * self.fps)
            self._place = stays * self._place + vector[layout.root_xz]
        motion = representation.decode(vector[None], self.fps, skeleton=self._body)
        size = representation.scale * representation.size_of(self._body)
        motion = moved(representation, motion, size * self._place)
        if self._feet is None:
            return motion
        return self._feet(motion, vector[layout.contacts], partial(moved, representation))


def _predictions(
    model: MultiresModel, look_ahead: float, controls: MultiresControls
) -> list[AheadPrediction]:
    """Return the predictions of this look-ahead and all smaller ones, the largest first.

    Raises:
        ModelError: the model cannot stream, or does not take a control or the look-ahead.
    """
    if problem := next(_problems(model, controls), None):
        raise ModelError(problem)
    usable = [each for each in model.ahead if each.look_ahead <= look_ahead + 1e-9]
    if not (math.isfinite(look_ahead) and usable):
        raise ModelError(f"look_ahead={look_ahead}: seconds from 0, such as 0.2")
    return sorted(usable, key=lambda each: -each.look_ahead)


def _problems(model: MultiresModel, controls: MultiresControls) -> Iterator[str]:
    """Yield why a model cannot stream, or does not take a control."""
    conditioner = model.conditions.conditioner
    if conditioner is None or model.state_process is None:
        missing = "speech input" if conditioner is None else "a state of movement"
        yield f"a model without {missing} cannot stream: train own_corpus for one"
        return
    if model.retrieves:
        yield "a model that plays recordings cannot stream: train own_corpus for one"
    try:
        check_streams(conditioner.extractor)
    except af.FeatureError as error:
        yield f"the model cannot stream: {error}"
    entries = control_entries(MultiresControls)
    for name, value in controls.items():
        if name not in _CONTROLS and not entries[name].is_default(value):
            yield f"{name}: a stream takes {', '.join(_CONTROLS[:-1])} and {_CONTROLS[-1]} only"
    if not model.ahead:
        yield (
            "the model has no predictions for live speech: gesturekit live --fit corpus.jsonl "
            f"--model {model.folder or 'MODEL'} adds them"
        )


def _styles(
    model: MultiresModel, controls: MultiresControls, lengths: Sequence[int], seed: int, item: str
) -> tuple[list[Tensor], int | None]:
    """Return the styles (1, K, T_i) of each level, and the number of the first one."""
    if not model.styles:
        return [], None
    rng = rng_for(seed, item, "live", "style")
    styles = requested_styles(model.styles, controls, lengths, fps=model.fps, rng=rng)
    if any((track != track[..., :1]).any() for track in styles):
        raise ModelError(f"style={controls['style']!r}: a stream takes one style, without times")
    return styles, int(styles[0][0, :, 0].argmax())


_PARTS = ("_speech", "_state", "_pieces", "_feet")
