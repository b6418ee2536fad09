"""A rule-based talker: speech in, plausible gestures out.

It stands in for a motion-capture recording in the demo corpus. The rules, after what is known
of beat gestures (McNeill 1992; Kendon 2004; and, for the lead over the sound, the recordings
of real speakers):

- Speech falls into phrases, split where it pauses. In a phrase the hands are up, in a long
  pause they sink back to rest, and in silence there is only breath, sway and a slow gaze.
- Every syllable moves a raised hand: an accented one by a stroke, the one before it by the
  stroke's preparation, the others by a small rebound. The size grows with the syllable's
  prominence (loudness over the clip's median, pitch over its surroundings), so that a lively
  voice moves more than a flat one. The hands lead the sound: measured over a clip, arm speed
  comes about 80 ms before the energy of the speech.
- High pitch lifts the hands, accents spread them, and strong accents may open the palms. The
  side, the kind of beat and small differences are drawn from a seeded generator.
- The head nods on accents and turns at the start of phrases; the spine turns a little to the
  hand that moves; the weight shifts slowly over feet that stand still.

Paths are sums of overlapping minimum-jerk movements (Flash & Henis 1991), so that every angle
is twice continuously differentiable however the beats fall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rig import STANDING_HEIGHT, Arm, pose
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation

import audio_features as af
from gesturekit.motion.motion import Motion

FPS = 30.0
LEAD = 0.03
"""Seconds by which the middle of a movement goes before its syllable's loudest moment."""
_HOP = 0.01  # seconds between frames of prosody
_SHORT_PAUSE = 0.28  # seconds; a shorter silence is part of a word or of a phrase
_LONG_PAUSE = 1.2  # seconds; the hands sink to rest only in a longer one

# Wrist in the chest's frame (m, left side) and twist of the forearm (rad, negative = palm up).
_REST = np.array([0.232, -0.372, 0.115, 0.05])
_HOME = np.array([0.195, -0.22, 0.255, -0.05])
# What the hand does on a syllable, for a size of 1: metres in the chest's frame, rad of twist.
_PREPARATION = np.array([-0.25, 0.65, 0.00, 0.0])
_STROKE = np.array([0.25, -0.45, 0.20, 1.2])
_OPEN = np.array([0.85, -0.15, 0.45, -4.0])  # out and forward, the palm turning up
_REBOUND = np.array([0.15, 0.40, 0.15, -0.8])
# How much of the way up a hand goes on the first and the last syllables out of and into rest.
_RISING = (0.45, 0.75, 0.92)
_SINKING = (0.8, 0.62, 0.45)
# Seconds by which x, y, z and twist run late: unequal, so that the hand draws loops.
_DELAYS = np.array([0.09, 0.0, 0.03, 0.07])

Step = tuple[float, float, np.ndarray]
"""One movement: its middle and its length in s, and where it ends."""


@dataclass(frozen=True)
class Syllable:
    """A syllable's loudest moment: time in s, prominence about 0..1.2, pitch in semitones
    over the clip's median, and whether it is accented: more prominent than those around it."""

    time: float
    prominence: float
    pitch: float
    accent: bool = False


@dataclass(frozen=True)
class Phrase:
    """Speech between two pauses; start, stop and the pause after it in s."""

    start: float
    stop: float
    pause: float
    syllables: tuple[Syllable, ...]

    @property
    def accents(self) -> list[Syllable]:
        """The accented syllables; all of them where the accents lie in neighbouring phrases."""
        return [s for s in self.syllables if s.accent] or list(self.syllables)


def talk(wave: af.Wave, seed: int = 0) -> Motion:
    """The motion of a standing speaker who says `wave`, at 30 fps, as long as the wave."""
    n_frames = wave.n_frames(FPS)
    rng = np.random.default_rng(seed)
    return _Talker(n_frames, rng).move(phrases(wave))


def phrases(wave: af.Wave) -> list[Phrase]:
    """Find the phrases of a wave and their accents; none in silence."""
    if wave.is_silent:
        return []
    pitch, voicing, energy, _ = af.Prosody().extract(wave).values.T.astype(np.float64)
    loud = gaussian_filter1d(energy, 0.03 / _HOP)
    peaks, _ = find_peaks(loud, prominence=1.5, distance=round(0.12 / _HOP))
    if len(peaks) == 0:  # a sound without syllables: hum, steady noise
        return []
    speaking = loud > np.percentile(loud[peaks], 75) - 25
    peaks = peaks[speaking[peaks]]
    # The voice's height near each syllable over its surroundings; unvoiced frames say nothing.
    voiced = np.where(voicing > 0.5, 1.0, 1e-6)
    near = _weighted_mean(pitch, voiced, 0.06)
    around = _weighted_mean(pitch, voiced, 0.8)
    louder = (loud[peaks] - np.median(loud[peaks])) / 6
    higher = (near[peaks] - around[peaks]) / 4
    prominence = 0.12 + 0.26 * np.clip(louder, -1, 1) + 0.8 * np.clip(higher, 0, 1.2)
    syllables = [
        Syllable(k * _HOP, float(max(p, 0.0)), float(near[k]))
        for k, p in zip(peaks, prominence, strict=True)
    ]
    return _group(speaking, _accented(syllables))


def _weighted_mean(values: np.ndarray, weights: np.ndarray, sigma: float) -> np.ndarray:
    return gaussian_filter1d(values * weights, sigma / _HOP) / gaussian_filter1d(
        weights, sigma / _HOP
    )


def _accented(syllables: list[Syllable], apart: float = 0.4) -> list[Syllable]:
    """Mark the most prominent syllables, no two closer than `apart` seconds."""
    chosen: list[Syllable] = []
    for syllable in sorted(syllables, key=lambda s: -s.prominence):
        if all(abs(syllable.time - other.time) >= apart for other in chosen):
            chosen.append(syllable)
    return [replace(s, accent=s in chosen) for s in syllables]


def _group(speaking: np.ndarray, syllables: list[Syllable]) -> list[Phrase]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], speaking.astype(int), [0]])))
    spans = [[a * _HOP, b * _HOP] for a, b in edges.reshape(-1, 2)]
    joined = spans[:1]
    for start, stop in spans[1:]:
        if start - joined[-1][1] < _SHORT_PAUSE:
            joined[-1][1] = stop
        else:
            joined.append([start, stop])
    result = []
    for k, (start, stop) in enumerate(joined):
        inside = tuple(s for s in syllables if start <= s.time <= stop)
        after = joined[k + 1][0] if k + 1 < len(joined) else len(speaking) * _HOP + 10.0
        if inside:
            result.append(Phrase(start, stop, after - stop, inside))
    return result


class _Talker:
    """Plans one clip. Every plan is a curve on the frames, a sum of movements."""

    def __init__(self, n_frames: int, rng: np.random.Generator) -> None:
        self.times = np.arange(n_frames) / FPS
        self.rng = rng

    # -- curves ------------------------------------------------------------------------------

    def movement(self, centre: float, duration: float) -> np.ndarray:
        """A minimum-jerk rise from 0 to 1 about `centre` (T,) (Hogan 1984)."""
        s = np.clip((self.times - centre) / duration + 0.5, 0.0, 1.0)
        return s**3 * (10 - 15 * s + 6 * s**2)

    def path(
        self, start: np.ndarray, steps: list[Step], delays: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """A curve (T, D) from `start` through the targets of `steps`.

        delays: seconds by which each of the D numbers runs late. Where they differ, the way
        there and the way back differ too: the hand draws loops instead of going to and fro.
        """
        here = np.asarray(start, float)
        delays = np.broadcast_to(delays, here.shape)
        curve = np.tile(here, (len(self.times), 1))
        for centre, duration, target in steps:
            for d, delay in enumerate(delays):
                curve[:, d] += (target[d] - here[d]) * self.movement(centre + delay, duration)
            here = target
        return curve

    def drift(self, size: float, low: float = 0.05, high: float = 0.3) -> np.ndarray:
        """Slow aimless change (T,) with standard deviation `size`: five sines, low..high Hz."""
        frequency = self.rng.uniform(low, high, 5)
        phase = self.rng.uniform(0, 2 * np.pi, 5)
        waves = np.sin(2 * np.pi * frequency * self.times[:, None] + phase)
        return size * np.sqrt(2 / 5) * waves.sum(axis=1)

    # -- the body ----------------------------------------------------------------------------

    def move(self, spoken: list[Phrase]) -> Motion:
        breath = np.sin(
            2 * np.pi * self.times / self.rng.uniform(3.4, 4.2) + self.rng.uniform(0, 6)
        )
        hands = self.hands(spoken)
        left, right = (self.arm(path, breath) for path in hands)
        raised = [np.linalg.norm(path[:, :3] - _REST[:3], axis=1) for path in hands]
        turn = gaussian_filter1d(raised[0] - raised[1], 0.3 * FPS)
        effort = gaussian_filter1d(raised[0] + raised[1], 0.3 * FPS)

        shift = self.weight_shift()
        hips = np.stack(
            [
                shift + self.drift(0.003),
                STANDING_HEIGHT - 1.5 * shift**2 + 0.0015 * breath,
                0.01 + self.drift(0.005),
            ],
            axis=1,
        )
        sway = np.stack([self.drift(0.008), self.drift(0.02), self.drift(0.004)], axis=1)
        pelvis_yaw = sway[:, 1] + 0.10 * turn
        pelvis_roll = sway[:, 2] + 0.7 * shift
        pelvis = Rotation.from_euler(
            "YXZ", np.stack([pelvis_yaw, 0.02 + sway[:, 0], pelvis_roll], axis=1)
        )
        spine = np.stack(
            [
                0.02 + 0.011 * breath + 0.07 * effort + self.drift(0.008),
                0.28 * turn + self.drift(0.012),
                -0.9 * pelvis_roll + self.drift(0.006),
            ],
            axis=1,
        )
        head = self.head(spoken)
        # The face stays with the listener while the body turns under it.
        head[:, 0] -= 0.7 * (spine[:, 0] - 0.02)
        head[:, 1] -= 0.7 * (spine[:, 1] + pelvis_yaw)
        return pose(FPS, hips, pelvis, spine, head, left, right)

    def weight_shift(self) -> np.ndarray:
        """Sideways position of the hips (T,) m: from foot to foot every few seconds."""
        steps, time, side = [], self.rng.uniform(1.0, 4.0), self.rng.choice([-1.0, 1.0])
        start = np.array([0.02 * side])
        while time < self.times[-1] + 2:
            side = -side
            target = np.array([side * self.rng.uniform(0.012, 0.034)])
            steps.append((time, self.rng.uniform(2.0, 3.0), target))
            time += self.rng.uniform(3.5, 8.0)
        return self.path(start, steps)[:, 0]

    # -- the hands ---------------------------------------------------------------------------

    def hands(self, spoken: list[Phrase]) -> tuple[np.ndarray, np.ndarray]:
        """Paths of the left and the right wrist and palm (T, 4), both as a left arm's."""
        steps: tuple[list[Step], list[Step]] = ([], [])
        raised = [False, False]
        for phrase in spoken:
            sinks = phrase.pause > _LONG_PAUSE
            plan = self.plan(phrase)
            for arm, share in enumerate(self.shares()):
                if share > 0.0:
                    home = self.home(phrase, share)
                    rises = not raised[arm]
                    steps[arm].extend(self.beats(phrase, plan, home, share, rises, sinks))
                elif raised[arm]:  # the other hand takes over
                    steps[arm].append((phrase.start + 0.3, 1.2, _REST))
                raised[arm] = share > 0.0 and not sinks
        return tuple(
            self.path(_REST, steps[arm], _DELAYS)
            + np.stack([self.drift(s) for s in (0.0015, 0.001, 0.002, 0.006)], axis=1)
            for arm in (0, 1)
        )

    def plan(self, phrase: Phrase) -> list[tuple[Syllable, np.ndarray]]:
        """What both hands do on each syllable: an offset (4,) m and rad for a size of 1 m.

        Accents get a stroke and the syllable before an accent its preparation; the others let
        the hand rebound a little.
        """
        result: list[tuple[Syllable, np.ndarray]] = []
        side, syllables = 1.0, phrase.syllables
        for k, syllable in enumerate(syllables):
            if syllable.accent:
                opens = syllable.prominence > 0.5 and self.rng.random() < 0.6
                offset = _OPEN if opens else _STROKE
                if k > 0 and syllables[k - 1].accent:  # no syllable between to prepare on
                    between = (syllables[k - 1].time + syllable.time) / 2
                    result.append((replace(syllable, time=between, accent=False), _PREPARATION))
            elif k + 1 < len(syllables) and syllables[k + 1].accent:
                offset = _PREPARATION
            else:
                side = -side  # twice to the same side would be no movement
                offset = side * _REBOUND
            result.append((syllable, offset * self.rng.uniform(0.85, 1.15)))
        return result

    def beats(
        self,
        phrase: Phrase,
        plan: list[tuple[Syllable, np.ndarray]],
        home: np.ndarray,
        share: float,
        rises: bool,
        sinks: bool,
    ) -> list[Step]:
        """The movements of one hand in one phrase that it starts from or ends in rest, or not."""
        steps = []
        for k, (syllable, offset) in enumerate(plan):
            nearest = syllable
            if not syllable.accent and k + 1 < len(plan):  # a preparation serves its stroke
                nearest = max(syllable, plan[k + 1][0], key=lambda s: s.prominence)
            size = 0.15 * nearest.prominence * (0.3 + 0.7 * share)
            target = home + offset * size
            slow = rises and k < len(_RISING)
            if slow:
                target = _REST + _RISING[k] * (target - _REST)
            if sinks and k >= len(plan) - len(_SINKING):
                target = _REST + _SINKING[k - len(plan)] * (target - _REST)
            duration = 0.55 if slow else 0.36
            steps.append((syllable.time - LEAD, duration, target))
        if sinks:
            steps.append((phrase.stop - 0.05, self.rng.uniform(0.9, 1.1), _REST))
        return steps

    def shares(self) -> tuple[float, float]:
        """How much the left and the right hand do in a phrase; a hand alone does more."""
        draw = self.rng.random()
        weaker = self.rng.uniform(0.4, 0.75)
        if draw < 0.30:
            return (weaker, 0.85)
        if draw < 0.55:
            return (0.85, weaker)
        return (0.0, 1.6) if draw < 0.8 else (1.6, 0.0)

    def home(self, phrase: Phrase, share: float) -> np.ndarray:
        """Where the hand beats in this phrase: higher for a high voice, wider for a loud one."""
        pitch = np.mean([a.pitch for a in phrase.accents])
        force = np.mean([a.prominence for a in phrase.accents])
        target = _HOME + np.array(
            [
                0.15 * (force - 0.3) + self.rng.normal(0, 0.015),
                0.01 * np.clip(pitch, -3, 6) + 0.25 * (force - 0.3) + self.rng.normal(0, 0.025),
                self.rng.normal(0, 0.012),
                self.rng.normal(0, 0.10),
            ]
        )
        raise_by = np.clip(0.45 + 1.2 * force, 0.7, 1.1) * (0.4 + 0.6 * min(share, 1.1))
        return _REST + raise_by * (target - _REST)

    def arm(self, path: np.ndarray, breath: np.ndarray) -> Arm:
        wrist, twist = path[:, :3], path[:, 3]
        # The hand trails its wrist: it drops on the way up and lifts on the way down.
        falling = gaussian_filter1d(-np.gradient(wrist[:, 1]) * FPS, 0.06 * FPS)
        height = wrist[:, 1] - _REST[1]
        return Arm(
            wrist=wrist,
            twist=twist,
            extension=0.08 * np.tanh(height / 0.1) + 0.45 * np.tanh(falling / 0.9),
            lift=0.01 + 0.006 * breath + 0.16 * height,
        )

    # -- the head ----------------------------------------------------------------------------

    def head(self, spoken: list[Phrase]) -> np.ndarray:
        """Pitch, yaw and roll of neck and head together (T, 3) rad."""
        steps = []
        for phrase in spoken:
            gaze = self.rng.normal(0, [0.025, 0.14, 0.03])
            steps.append((phrase.start - 0.05, self.rng.uniform(0.6, 0.9), gaze))
            if phrase.pause > _LONG_PAUSE:
                steps.append((phrase.stop + 0.35, 1.1, 0.4 * gaze))
        angles = self.path(np.zeros(3), steps)
        angles += np.stack([self.drift(0.012), self.drift(0.03), self.drift(0.01)], axis=1)
        for phrase in spoken:
            for accent in phrase.accents:
                depth = 0.02 + 0.14 * accent.prominence
                middle = accent.time - LEAD
                nod = self.movement(middle - 0.08, 0.3) - self.movement(middle + 0.22, 0.42)
                angles[:, 0] += depth * nod
                angles[:, 2] += self.rng.normal(0, 0.25) * depth * nod
        return angles
