"""Stream of sound in, stream of motion out.

Speech features are normalised by what has been said so far, the state of movement is drawn on and
on, the levels of the network are prepared once for a whole stream, and feet are locked without
knowledge of the future.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

import audio_features as af
from audio_features.acoustic import FRAME_RATE
from audio_features.acoustic.streaming import REACH, SpectrumStream, check_streams
from audio_features.track import FeatureTrack
from gesturekit.corpus.speech import SpeechConditioner, parts_of
from gesturekit.errors import ModelError
from gesturekit.model import control_entries
from gesturekit.motion.concatenation import stacked
from gesturekit.motion.ik import two_bone_ik
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs, leg_length
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions
from gesturekit.motion.skeleton import Skeleton, forward_kinematics, global_rotations
from gesturekit.multires.backend import choose_backend
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.keyframes import moved
from gesturekit.multires.networks import SLOPE
from gesturekit.multires.pyramid import (
    LevelConditions,
    finite,
    halo,
    mixed_carriers,
    requested_styles,
)
from gesturekit.multires.resampling import resample
from gesturekit.multires.retrieval import PieceSequence, Resumable
from gesturekit.postprocess.foot_lock import find_feet
from gesturekit.state.channels import averaged
from gesturekit.state.prediction import AVERAGED_SECONDS, AheadPrediction, FeatureWindow
from gesturekit.state.process import Group, StateProcess, mood_seed
from gesturekit.training.seeds import checked_draw, rng_for

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_BEFORE_SECONDS = 3.0
"""Sound before a window of features, for the extractors that smooth over seconds."""
_CENTRE_SECONDS = 60.0
"""Seconds of speech after which it counts 1/e in the centre of a voice."""


class SpeechStream(Resumable):
    """Speech features on motion frames, normalised by what has been said so far.

    Row k belongs to motion frame k. It is complete as soon as its frame has ended and the sound
    that its last pitch depends on has arrived.

    Args:
        conditioner: of the model; its extractors work on streams (`check_streams`).
        sample_rate: of the sound, Hz.
        rows: W, of the window of features.
        every: yield features with one row in so many.

    Attributes:
        n_rows: complete rows so far.
    """

    kept = ("n_rows", "_total", "_count", "_averages", "_sound")

    def __init__(
        self, conditioner: SpeechConditioner, sample_rate: int, rows: int, every: int = 1
    ) -> None:
        self._conditioner, self._rows, self._fps = conditioner, rows, conditioner.fps
        self._every = every
        self._seconds = _BEFORE_SECONDS + rows / conditioner.fps
        self._sound = SpectrumStream(sample_rate, self._seconds)
        self._silence = conditioner.silence(1)
        self.n_rows = 0
        self._total, self._count = np.zeros(conditioner.extractor.dim), 0.0
        self._averages = np.repeat(self._silence.astype(float), len(AVERAGED_SECONDS), axis=0)

    @property
    def reach(self) -> float:
        """Seconds of sound after a motion frame until its row is complete, at most."""
        return 0.5 / self._fps + REACH + self._sound.delay

    def rows_ahead(self, look_ahead: float) -> int:
        """Return the rows after a motion frame that are complete `look_ahead` seconds after it."""
        return math.floor((look_ahead - self.reach) * self._fps + 1e-6)

    def push(self, samples: np.ndarray) -> Iterator[FeatureWindow]:
        """Take samples (N,) float32; yield what is known with each row that they complete.

        Rows before the stream are silent.
        """
        for _ in self._sound.push(samples, self._needed):
            while self._sound.n_frames >= self._needed():
                self.n_rows += 1
                if self.n_rows % self._every == 0:
                    yield self._window()

    def _needed(self) -> int:
        """Return the number of frames of sound that complete the next row."""
        return math.ceil((self.n_rows + 0.5) / self._fps * FRAME_RATE)

    def _window(self) -> FeatureWindow:
        spectrum, active = self._sound.window(self._seconds)
        parts = parts_of(self._conditioner.extractor)
        columns = [extractor.from_spectrum(spectrum).values for extractor in parts]
        count = min(self._rows, self.n_rows)
        # Times count from the first row of the window.
        times = spectrum.times - (self.n_rows - count) / self._fps
        track = FeatureTrack(np.concatenate(columns, axis=1), times, {})
        values = track.to_rate(self._fps, count, self._conditioner.align).values
        now = (count - 1) / self._fps
        if active[np.abs(times - now).argmin()]:
            kept = math.exp(-self._every / (_CENTRE_SECONDS * self._fps))
            self._total = kept * self._total + self._every * values[-1]
            self._count = kept * self._count + self._every
        centre = self._conditioner.clip_centre(self._total, self._count)
        rows = self._conditioner.scaled(values, centre)
        for average, seconds in zip(self._averages, AVERAGED_SECONDS, strict=True):
            new = rows[-self._every :].mean(axis=0)
            average += (new - average) * min(1.0, self._every / (seconds * self._fps))
        before = np.repeat(self._silence, self._rows - count, axis=0)
        return FeatureWindow(np.concatenate([before, rows]), self._averages.copy())


@dataclass(frozen=True, eq=False)
class Forecast:
    """Predicted movement.

    Attributes:
        seconds: (H,) from now, ascending from 0.
        fast: (H,) fast movement at these times, log m/s.
        shares: (H,) how much is known of what the whole sound tells.
        slow: slow movement, in standard deviations.
    """

    seconds: np.ndarray
    fast: np.ndarray
    shares: np.ndarray
    slow: float


class LiveState(Resumable):
    """Drawn state of movement of a window around the current frame.

    What was drawn for a frame when it was the current one stays. The frames to come have the same
    noise at each step, as it depends on time alone, and what is known of the speech so far.

    Args:
        process: from which it is drawn.
        around: frames of the window before the current one, and from it on.
        seeds: of the noise and of the carriers.
        group: speaker and style whose movement to draw.
        liveliness: factor on the hand speed that is drawn.
    """

    kept = ("_frame", "_noise", "_values", "_clocks")

    def __init__(
        self,
        process: StateProcess,
        around: int,
        seeds: tuple[int, int],
        group: Group = (None, None),
        liveliness: float = 1.0,
    ) -> None:
        self._process, self._around = process, around
        self._noise_seed, self._carriers_seed = seeds
        self._group, self._liveliness = group, liveliness
        self._frame = -1
        self._noise = np.empty((len(process.mean), 0))
        self._values = np.empty((len(process.mean), 2 * around))
        self._clocks = np.zeros((len(process.channels.of_hands), 2 * around))

    def advance(self, speech: np.ndarray, forecast: Forecast | None) -> np.ndarray:
        """Go on by a motion frame and return the condition (C + H + 4 H, T) of the window.

        Args:
            speech: (T, S) features of the window, as far as they are known.
            forecast: of movement; None without prediction.
        """
        self._frame += 1
        process, around, begun = self._process, self._around, self._frame > 0
        last = self._frame + around
        missing = 2 * around - self._noise.shape[1] + begun
        new = process.noise(self._noise_seed, np.arange(last - missing, last))
        self._noise = np.concatenate([self._noise[:, begun:], new], axis=1)
        # Before the first frame all is drawn as if nothing had been said.
        kept = around if begun else 0
        self._values = np.roll(self._values, -1, axis=1)
        self._values[:, kept:] = self._drawn(speech, forecast)[:, kept:]
        clocks = np.roll(self._clocks, -1, axis=1)
        steps = process.clocks(self._values)[:, kept:]
        clocks[:, kept:] = np.cumsum(steps, axis=1) + (clocks[:, [kept - 1]] if begun else 0.0)
        self._clocks = clocks
        return process.condition(self._carriers_seed, self._values, clocks)

    @property
    def coming(self) -> np.ndarray:
        """(C, T / 2) the channels of the current frame, and of those to come."""
        return self._values[:, self._around :]

    def _drawn(self, speech: np.ndarray, forecast: Forecast | None) -> np.ndarray:
        """Return the channels (C, T) of the window; arguments as for `advance`."""
        predicted, known = None, np.zeros(2 * self._around)
        if forecast is not None:
            seconds = np.maximum(np.arange(-self._around, self._around) / self._process.fps, 0.0)
            shares = forecast.shares
            known = np.interp(seconds, forecast.seconds, shares, right=0.0)
            fast = np.interp(seconds, forecast.seconds, forecast.fast / np.maximum(shares, 1e-6))
            predicted = fast, np.full(len(known), forecast.slow)
        return self._process.values(
            self._noise,
            self._process.voices(speech.T),
            predicted,
            group=self._group,
            liveliness=self._liveliness,
            known=known,
        )


class WindowLevels:
    """All levels of a model with a state of movement, for part of a window.

    The result is that of `pyramid.sample`, but for rounding. It takes a third of the
    time: frames on which the part does not depend are not computed, resampling is a product with a
    matrix, and all gains and shifts of a level are one product.

    Args:
        model: with speech input and a state of movement.
        lengths: T_i, frames of each level in the window.
        styles: (1, K, T_i) for each level, or empty.
        part: frames of the finest level that are wanted.
    """

    def __init__(
        self, model: MultiresModel, lengths: Sequence[int], styles: Sequence[Tensor], part: range
    ) -> None:
        self._backend = choose_backend("auto", *model.network.levels)
        self._columns, self._n_carriers = model.conditions.columns, model.conditions.n_carriers
        self._sigma = model.noise.sigma.mean(dim=0)[0]
        self._is_residual = model.network_config.residual
        self._levels = list[_Level]()
        for i in reversed(range(len(lengths))):
            level = _Level(model, i, lengths, styles, part)
            self._levels.insert(0, level)
            part = level.coarser

    def __call__(self, speech: np.ndarray, state: np.ndarray) -> Tensor:
        """Return the normalised motion vectors (D, len(part)).

        Args:
            speech: (T, S) features of the window.
            state: (C + H + 4 H, T) of the window, see `StateProcess.condition`.
        """
        features = torch.from_numpy(speech[:, self._columns].T.astype(np.float32))
        stated = torch.from_numpy(state)
        channels, carriers = stated.split([len(stated) - self._n_carriers, self._n_carriers])
        motion: Tensor | None = None
        with torch.inference_mode(), self._backend.threads():
            for level in self._levels:
                clocked = carriers @ level.plain
                given = torch.cat([features @ level.features, channels @ level.means, clocked])
                if motion is None:
                    noise = self._sigma * mixed_carriers(clocked[None])[0]
                    x = up = noise.expand(level.layers[-1].shape[0], -1)
                else:
                    x = up = motion @ level.up
                y = level.embedding @ given + level.offset
                y = F.leaky_relu(y, SLOPE) if level.rectified else y
                x = torch.cat([x, y]) if level.concatenates else x
                films = torch.addmm(level.shifts, level.gains, y)
                for i, layer in enumerate(level.layers):
                    if len(films):
                        gain, shift, films = films.split([len(x), len(x), len(films) - 2 * len(x)])
                        x = torch.addcmul(shift, x, gain)
                    slope = 1.0 if i == len(level.layers) - 1 else SLOPE
                    x = self._backend.convolve([layer], x[None], slope, slope)[0]
                is_residual = self._is_residual and motion is not None
                motion = (x + up if is_residual else x)[:, level.kept]
        assert motion is not None
        return motion


class _Level:
    """One level, for the frames that the next one depends on.

    Attributes:
        layers: convolutions.
        kept: frames that are not only context.
        coarser: frames of the coarser level that are needed.
        up: (T of the coarser level, T) upsampling; empty at the first level.
        features: (T of the features, T) their resampling.
        means: (T of the features, T) averages, for the channels of the state of movement.
        plain: (T of the features, T) interpolation, for its carriers.
        embedding: (E, S + C + H + 4 H) weights of the speech features and of the state.
        offset: (E, T) the rest of the embedding: its bias, and a style.
        rectified: False for a linear embedding.
        concatenates: True if the embedding is a part of the input.
        gains: (2 C of the modulated layers, E) weights of gains and shifts.
        shifts: (2 C of the modulated layers, 1) their biases.
    """

    @torch.no_grad()
    def __init__(
        self,
        model: MultiresModel,
        number: int,
        lengths: Sequence[int],
        styles: Sequence[Tensor],
        part: range,
    ) -> None:
        level, n_frames = model.network.levels[number], lengths[number]
        begin, end = max(0, part.start - halo(level)), min(n_frames, part.stop + halo(level))
        self.layers, self.rectified = level.layers, level.rectify_embedding
        self.concatenates = level.concatenates
        self.kept = slice(part.start - begin, part.stop - begin)
        self.coarser, self.up = range(begin, end), torch.empty(0)
        if number:
            weights = resample(torch.eye(lengths[number - 1]), n_frames, begin, end)
            used = np.flatnonzero(weights.any(dim=1).numpy())
            self.coarser = range(int(used[0]), int(used[-1]) + 1)
            self.up = weights[self.coarser.start : self.coarser.stop]
        identity = np.eye(lengths[-1], dtype=np.float32)
        self.features, self.plain = (
            LevelConditions([identity] * len(lengths), lengths, residual)(number, begin, end)[0]
            for residual in (model.conditions.residual, False)
        )
        self.means = torch.from_numpy(averaged(identity, n_frames, begin, end))
        assert level.embed is not None and level.embed.bias is not None
        style = styles[number][0, :, begin:end] if styles else torch.empty(0, end - begin)
        weight, n_features = level.embed.weight[..., 0], len(model.conditions.columns)
        n_state = weight.shape[1] - n_features - len(style)
        of_speech, of_style, of_state = weight.split([n_features, len(style), n_state], dim=1)
        self.embedding = torch.cat([of_speech, of_state], dim=1)
        self.offset = level.embed.bias[:, None] + of_style @ style
        gains, shifts = [torch.empty(0, len(self.offset))], [torch.empty(0)]
        for film in level.films:
            for conv, usual in ((film.gain, 1.0), (film.shift, 0.0)):
                # Channels that are not modulated have a gain of 1 and a shift of 0.
                weight, bias = conv.parameters()
                gains.append(F.pad(weight[..., 0], (0, 0, 1, 0))[film.index])
                shifts.append(F.pad(bias, (1, 0))[film.index] + usual)
        self.gains, self.shifts = torch.cat(gains), torch.cat(shifts)[:, None]


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
            self._joints, self._legs, self._feet = find_feet(skeleton)
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
        ankles = positions[0, [foot.limb[2] for foot in self._feet]]
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
        for *_, ankle in limbs:
            back = invert_quaternions(reached[:, legs.parents[ankle]])
            rotations[:, ankle] = multiply_quaternions(back, world[:, ankle])
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
    kept += ("_speech", "_state", "_pieces", "_feet")

    def __init__(
        self,
        model: MultiresModel,
        sample_rate: int,
        look_ahead: float,
        seed: int,
        item: str,
        controls: MultiresControls,
    ) -> None:
        seed, item = checked_draw(seed, item)
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
        if self._pieces is not None and self._pieces.next_frame <= self._steps - 1:
            known = self._process.with_voice(self._state.coming, speech[self._around :].T)
            self._pieces.choose(known)
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
