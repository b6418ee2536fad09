"""A rule-based talker: speech in, plausible gestures out.

It stands in for a motion-capture recording in the demo corpus. It knows the sound alone, and a
seed. The rules follow what is known of gestures (McNeill 1992; Kendon 2004):

- Speech falls into phrases, split where it pauses. The talker's liveliness in a phrase is read
  off the range of its pitch: a lively one gestures more often, faster and wider than a calm one.
- A phrase's prominent accents get a gesture each: a *preparation* that brings the hands to where
  the stroke begins, the *stroke* itself on the accent, and a *hold* until the next gesture. Which
  gesture it is comes from a deck of `STROKES` for that prominence: small beats, medium gestures
  of one or both hands, large ones up beside the head or wide apart. In long pauses the hands go
  back to rest, a *retraction*: at the sides, or together before the belly.
- On all other syllables raised hands beat a little, and hands lead the sound slightly.
- The trunk turns and leans with the hands and dips on accents, the weight shifts from foot to
  foot over feet that stand still, and the knees give. The head looks away before a phrase, at
  one of several listeners in it, and nods on accents.
- Arms move as arms do: wrists draw arcs and loops, elbows swing out as the hand rises, shoulders
  rise with it, the hand trails its wrist; nothing reaches into the trunk.
- A hand takes its shape in the preparation and the stroke, and relaxes with the retraction.

Paths are sums of overlapping minimum-jerk movements (Flash & Henis 1991), so that every angle
is twice continuously differentiable however the strokes fall.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from rig import ELBOW_POLE, HAND_SHAPES, SHOULDER, STANDING_HEIGHT, Arm, pose
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation

import audio_features as af
from gesturekit.motion.motion import Motion

FPS = 30.0
LEAD = 0.05
"""Seconds by which the middle of a movement goes before its syllable's loudest moment."""
_HOP = 0.01  # seconds between frames of prosody
_SHORT_PAUSE = 0.28  # seconds; a shorter silence is part of a word or of a phrase
_REST_PAUSE = 1.2  # seconds; in a longer one the hands go back to rest
_LIVELINESS = (0.5, 1.7)  # pitch range (`af.ProsodicRange`, semitones) of a calm, a lively talker
_MOOD_RANGE = (-0.9, 1.15)  # limits of the liveliness to which a mood was added
_HIPS = STANDING_HEIGHT - 0.012  # m; soft knees leave room for the weight to shift
_TRUNK = np.array([0.185, 0.165])  # m; half axes of the ellipse that wrists stay out of
_HANDS_APART = 0.26  # m between the wrists: hands that point inwards just do not touch
_LISTENERS = (-0.38, 0.0, 0.0, 0.34)  # rad; where they stand

# Seconds by which x, y, z and twist run late: unequal, so that the hand draws loops.
_DELAYS = np.array([0.06, 0.0, 0.03, 0.05])
# The same of a hand shape: the little finger closes and opens last.
_FINGER_DELAYS = np.array([0.0, 0.0, 0.0, 0.01, 0.02, 0.03, 0.02])
# What a raised hand does on a syllable without a gesture, for a lively talker.
_BEAT = np.array([0.010, -0.026, 0.014, 0.10])

# Places of a hand: x, y, z of the wrist in the chest's frame (m, as of a left arm) and twist of
# the forearm (rad; 0 is a palm that faces the other hand, negative turns it up).
CENTRE = np.array([0.20, -0.13, 0.27, 0.1])
"""The middle of the gesture space, in front of the belly."""
REST_AT_SIDES = np.array([0.235, -0.375, 0.10, 0.05])


@dataclass(frozen=True)
class Rest:
    """A rest pose: the places of both hands."""

    left: np.ndarray
    right: np.ndarray


@dataclass(frozen=True)
class Stroke:
    """The shape of a gesture: where its stroke begins and where it ends.

    hands: `one` is made by one hand, which the other may echo; `both` by two; `any` by either.
    arc: height in m by which the stroke's path bulges; shrug: rad of the shoulders.
    """

    name: str
    begin: tuple[float, float, float, float]
    end: tuple[float, float, float, float]
    hands: Literal["one", "both", "any"] = "any"
    arc: float = 0.0
    shrug: float = 0.0


_BELLY = np.array([0.115, -0.215, 0.235, 0.35])
RESTS = (
    Rest(REST_AT_SIDES, REST_AT_SIDES),
    Rest(_BELLY, _BELLY + [0.0, -0.03, 0.03, 0.1]),
    Rest(REST_AT_SIDES, REST_AT_SIDES + [0.01, 0.0, -0.02, 0.1]),
    Rest(_BELLY + [0.02, 0.0, 0.0, 0.0], REST_AT_SIDES),
    Rest(REST_AT_SIDES, _BELLY + [0.02, 0.0, 0.0, 0.0]),
)
STROKES = {
    "small": (
        Stroke("beat", (0.21, -0.02, 0.26, 0.3), (0.20, -0.19, 0.32, 0.3)),
        Stroke("beat aside", (0.16, -0.06, 0.27, 0.2), (0.30, -0.17, 0.30, 0.0)),
        Stroke("tilt", (0.17, -0.14, 0.27, 0.7), (0.26, -0.13, 0.31, -0.8), arc=0.03),
    ),
    "medium": (
        Stroke("offer", (0.13, -0.15, 0.24, 0.5), (0.31, -0.12, 0.38, -1.1), arc=0.06),
        Stroke("chop", (0.22, 0.14, 0.24, 0.0), (0.17, -0.16, 0.38, 0.0)),
        Stroke("point", (0.25, 0.00, 0.20, 0.2), (0.19, 0.09, 0.45, 0.8), "one"),
        Stroke("to oneself", (0.32, -0.10, 0.30, -0.4), (0.13, 0.01, 0.23, 0.3), "one"),
        Stroke("shrug", (0.20, -0.20, 0.26, 0.2), (0.38, -0.17, 0.22, -1.2), "both", shrug=0.16),
        Stroke("hold a box", (0.30, 0.02, 0.26, 0.1), (0.17, -0.12, 0.36, 0.0), "both"),
    ),
    "large": (
        Stroke("raise", (0.20, -0.19, 0.26, 0.2), (0.28, 0.36, 0.24, -0.2), "one", arc=0.02),
        Stroke("spread", (0.15, -0.05, 0.28, 0.5), (0.45, 0.03, 0.26, -0.7), "both", arc=0.09),
        Stroke("sweep", (0.06, -0.04, 0.31, 0.6), (0.47, 0.06, 0.20, -0.4), "one", arc=0.07),
        Stroke("toss", (0.18, -0.23, 0.24, 0.0), (0.38, 0.26, 0.27, -1.1), arc=0.03),
        Stroke("bring down", (0.27, 0.34, 0.20, 0.2), (0.22, -0.16, 0.38, 0.2), "one"),
    ),
}
"""Gestures by how prominent an accent they go with."""
_OPENING = ("relaxed", "open")
_SHAPES = {
    "beat": ("precision", "precision"),
    "beat aside": ("precision", "open"),
    "tilt": ("precision", "open"),
    "chop": ("open", "open"),
    "point": ("fist", "pointing"),
    "hold a box": ("open", "open"),
    "raise": ("pointing", "pointing"),
    "spread": ("precision", "open"),
    "sweep": ("fist", "open"),
    "toss": ("fist", "open"),
    "bring down": ("fist", "fist"),
}
"""Hand shapes as a stroke begins and as it ends; `_OPENING` for all other gestures."""


@dataclass(frozen=True)
class Step:
    """One movement: its middle and its length in s, where it ends, its arc in m, and the shape
    that the hand takes."""

    centre: float
    duration: float
    target: np.ndarray
    arc: float = 0.0
    shape: str = "relaxed"


@dataclass(frozen=True)
class Gesture:
    """A stroke in time: its middle and its length in s, its size, what each hand does of it, and
    the middle of the gesture space."""

    form: Stroke
    time: float
    size: float
    duration: float
    shares: tuple[float, float]
    centre: np.ndarray


class _Deck:
    """Endless draws from a few cards, each once before any comes again, none twice in a row."""

    def __init__(self, rng: np.random.Generator, cards: Sequence, first: object = None) -> None:
        self.rng, self.cards, self.last = rng, cards, None
        self.pile: list = [] if first is None else [first]

    def __next__(self):
        if not self.pile:
            order = [self.cards[k] for k in self.rng.permutation(len(self.cards))]
            self.pile = order[::-1] if order[-1] is self.last else order
        self.last = self.pile.pop()
        return self.last


@dataclass(frozen=True)
class Syllable:
    """A syllable's loudest moment: time in s, prominence about 0..1.2, pitch in semitones
    over the clip's median, and whether it is accented: more prominent than those around it."""

    time: float
    prominence: float
    pitch: float
    accent: bool = False


@dataclass(frozen=True)
class Mood:
    """Behaviour of the talker that its speech does not show.

    liveliness: added to a phrase's liveliness; height: m, added to the height of gestures and
    rest places; width: factor of the size of gestures; left: probability that the left hand leads.
    """

    liveliness: float = 0.0
    height: float = 0.0
    width: float = 1.0
    left: float = 0.5


Moods = Callable[[float], Mood]
"""The mood at a time in s."""


@dataclass(frozen=True)
class Phrase:
    """Speech between two pauses; start, stop and the pause after it in s.

    liveliness: 0..1, read off the speech; `_MOOD_RANGE` where a mood was added.
    """

    start: float
    stop: float
    pause: float
    syllables: tuple[Syllable, ...]
    liveliness: float
    mood: Mood | None = None

    @property
    def accents(self) -> list[Syllable]:
        """The accented syllables; all of them where the accents lie in neighbouring phrases."""
        return [s for s in self.syllables if s.accent] or list(self.syllables)


def talk(wave: af.Wave, seed: int = 0, moods: Moods | None = None) -> Motion:
    """The motion of a standing speaker who says `wave`, at 30 fps, as long as the wave.

    moods: the talker's mood at each phrase's middle. A calm talker leaves out gestures and rests.
    """
    n_frames = wave.n_frames(FPS)
    rng = np.random.default_rng(seed)
    spoken = phrases(wave)
    if moods is not None:
        spoken = [_in_mood(phrase, moods(0.5 * (phrase.start + phrase.stop))) for phrase in spoken]
    return _Talker(n_frames, rng).move(spoken)


def _in_mood(phrase: Phrase, mood: Mood) -> Phrase:
    liveliness = float(np.clip(phrase.liveliness + mood.liveliness, *_MOOD_RANGE))
    return replace(phrase, liveliness=liveliness, mood=mood)


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
    low, high = _LIVELINESS
    liveliness = np.clip((af.ProsodicRange().extract(wave).values[:, 0] - low) / (high - low), 0, 1)
    return _group(speaking, liveliness, _accented(syllables))


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


def _group(speaking: np.ndarray, liveliness: np.ndarray, syllables: list[Syllable]) -> list[Phrase]:
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
            lively = liveliness[round(start / _HOP) : round(stop / _HOP) + 1].mean()
            result.append(Phrase(start, stop, after - stop, inside, float(lively)))
    return result


class _Talker:
    """Plans one clip. Every plan is a curve on the frames, a sum of movements."""

    def __init__(self, n_frames: int, rng: np.random.Generator) -> None:
        self.times = np.arange(n_frames) / FPS
        # With draws of their own, fingers leave the rest of the body as it is without them.
        self.rng, (self.finger_rng,) = rng, rng.spawn(1)
        self.leading = int(rng.integers(2))  # the hand that gestures alone: 0 left, 1 right
        self.decks = {rank: _Deck(rng, strokes) for rank, strokes in STROKES.items()}
        self.rests = _Deck(rng, RESTS, first=RESTS[0])
        # Where this talker gestures: wider, higher or farther from the body than others.
        self.space = np.array([*rng.normal(0, [0.025, 0.025, 0.015]), rng.normal(0, 0.1)])

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
        for step in steps:
            for d, delay in enumerate(delays):
                rise = self.movement(step.centre + delay, step.duration)
                curve[:, d] += (step.target[d] - here[d]) * rise
                if d == 1 and step.arc:
                    curve[:, d] += step.arc * (4 * rise * (1 - rise)) ** 2
            here = step.target
        return curve

    def drift(self, size: float, low: float = 0.05, high: float = 0.3) -> np.ndarray:
        """Slow aimless change (T,) with standard deviation `size`: five sines, low..high Hz."""
        frequency = self.rng.uniform(low, high, 5)
        phase = self.rng.uniform(0, 2 * np.pi, 5)
        waves = np.sin(2 * np.pi * frequency * self.times[:, None] + phase)
        return size * np.sqrt(2 / 5) * waves.sum(axis=1)

    # -- the body ----------------------------------------------------------------------------

    def move(self, spoken: list[Phrase]) -> Motion:
        """The whole body: hands first, then the trunk that follows them, then the head."""
        breath = np.sin(
            2 * np.pi * self.times / self.rng.uniform(3.4, 4.2) + self.rng.uniform(0, 6)
        )
        hands, shapes, shrug = self.hands(spoken)
        left, right = (
            self.arm(path, shape, breath, shrug) for path, shape in zip(hands, shapes, strict=True)
        )
        # The trunk turns to the side on which the hands are, and follows them with its mass.
        aside = gaussian_filter1d(hands[0][:, 0] - hands[1][:, 0], 0.25 * FPS)
        raised = [path[:, 1] - REST_AT_SIDES[1] for path in hands]
        turn = aside + 0.35 * gaussian_filter1d(raised[0] - raised[1], 0.25 * FPS)
        effort = gaussian_filter1d(raised[0] + raised[1], 0.2 * FPS)
        reach = gaussian_filter1d(hands[0][:, 2] + hands[1][:, 2], 0.25 * FPS) - 0.25
        pulse = self.pulses(spoken)
        faced = self.rng.choice(_LISTENERS, len(spoken)) + self.rng.normal(0, 0.06, len(spoken))
        stance = self.stance(spoken, faced)

        shift = self.weight_shift(spoken)
        sway = np.stack([self.drift(0.008), self.drift(0.02), self.drift(0.004)], axis=1)
        pelvis_yaw = sway[:, 1] + 0.25 * turn + 1.5 * shift + 0.6 * stance[:, 1]
        pelvis_roll = sway[:, 2] + 0.9 * shift
        pelvis_pitch = 0.02 + sway[:, 0] + 0.08 * reach + 0.4 * stance[:, 0]
        pelvis = Rotation.from_euler("YXZ", np.stack([pelvis_yaw, pelvis_pitch, pelvis_roll], 1))
        hips = np.stack(
            [
                shift + self.drift(0.003),
                _HIPS + 0.0015 * breath - 1.5 * shift**2 - 0.012 * pulse,
                0.01 + 0.02 * reach + 0.12 * stance[:, 0] + self.drift(0.006),
            ],
            axis=1,
        )
        spine = np.stack(
            [
                0.02 + 0.011 * breath + 0.25 * reach - 0.09 * effort + 0.11 * pulse,
                0.55 * turn + 0.4 * stance[:, 1] + self.drift(0.015),
                -1.1 * pelvis_roll - 0.18 * aside + stance[:, 2] + self.drift(0.01),
            ],
            axis=1,
        )
        spine[:, 0] += 0.6 * stance[:, 0] + self.drift(0.012)
        head = self.head(spoken, faced)
        # The face stays with the listener while the body turns under it.
        head[:, 0] -= 0.7 * (spine[:, 0] + pelvis_pitch - 0.04)
        head[:, 1] -= 0.8 * (spine[:, 1] + pelvis_yaw)
        head[:, 2] -= 0.5 * (spine[:, 2] + pelvis_roll)
        return pose(FPS, hips, pelvis, spine, head, left, right)

    def pulses(self, spoken: list[Phrase]) -> np.ndarray:
        """A small dip of the trunk (T,) on every accent, 0 to about 1."""
        curve = np.zeros(len(self.times))
        for accent in (a for phrase in spoken for a in phrase.accents):
            dip = self.movement(accent.time - 0.1, 0.4) - self.movement(accent.time + 0.25, 0.6)
            curve += accent.prominence * dip
        return curve

    def stance(self, spoken: list[Phrase], faced: np.ndarray) -> np.ndarray:
        """Pitch, yaw and roll (T, 3) rad that the trunk takes up anew in every phrase: half way
        to the listener faced, leaning in or back."""
        steps = []
        for phrase, listener in zip(spoken, faced, strict=True):
            size = 0.5 + 0.5 * phrase.liveliness
            target = size * np.array(
                [self.rng.normal(0.02, 0.06), 0.6 * listener, self.rng.normal(0, 0.05)]
            )
            centre = phrase.start + self.rng.uniform(0.0, 0.4)
            steps.append(Step(centre, self.rng.uniform(0.9, 1.4), target))
        return self.path(np.zeros(3), steps)

    def weight_shift(self, spoken: list[Phrase]) -> np.ndarray:
        """Sideways position of the hips (T,) m: to another foot as a phrase begins, or in time."""
        steps, side = [], self.rng.choice([-1.0, 1.0])
        start = np.array([self.rng.uniform(0.01, 0.035) * side])
        begins = [phrase.start for phrase in spoken]
        time = self.rng.uniform(1.0, 5.0)
        while time < self.times[-1] + 2:
            near = [begin for begin in begins if abs(begin - time) < 1.2]
            centre = near[0] + 0.1 if near else time
            side = -side
            target = np.array([side * self.rng.uniform(0.012, 0.042)])
            steps.append(Step(centre, self.rng.uniform(1.3, 2.2), target))
            time = centre + self.rng.uniform(3.0, 8.0)
        return self.path(start, steps)[:, 0]

    # -- the hands ---------------------------------------------------------------------------

    def hands(
        self, spoken: list[Phrase]
    ) -> tuple[tuple[np.ndarray, np.ndarray], list[np.ndarray], np.ndarray]:
        """Paths of the left and the right wrist and palm (T, 4), both as a left arm's, the shapes
        of both hands (T, 7), and how far the shoulders shrug (T,) rad."""
        steps: tuple[list[Step], list[Step]] = ([], [])
        shrugs: list[Step] = []
        resting = next(self.rests)
        starts = resting.left, resting.right
        raised = [False, False]
        free = 0.0  # when the hands have finished their last stroke
        for phrase in spoken:
            slow = 1.25 - 0.3 * phrase.liveliness
            free = max(free, phrase.start - 0.12)
            gestures = self.gestures(phrase, early=0.45 if any(raised) else 0.8)
            if phrase.mood:
                starts = self.rests_in(phrase.mood, resting)
                if not gestures:  # too calm to gesture
                    for arm in (0, 1):
                        if raised[arm]:
                            middle = max(phrase.start + 0.3, free + 0.5)
                            steps[arm].append(self.retraction(middle, starts[arm], slow))
                    raised = [False, False]
            for gesture in gestures:
                for arm, share in enumerate(gesture.shares):
                    if share > 0.0:
                        steps[arm].extend(self.stroke(gesture, share, free, raised[arm], slow))
                        raised[arm] = True
                    elif raised[arm]:  # the other hand takes over
                        steps[arm].append(self.retraction(gesture.time, starts[arm], slow))
                        raised[arm] = False
                if gesture.form.shrug:
                    up, down = gesture.time - 0.1, gesture.time + 0.9
                    shrugs.append(Step(up, 0.5, np.array([gesture.form.shrug * gesture.size])))
                    shrugs.append(Step(down, 0.9, np.zeros(1)))
                free = gesture.time + 0.5 * gesture.duration
            if phrase.pause > _REST_PAUSE:
                resting = next(self.rests)
                starts = self.rests_in(phrase.mood, resting)
                for arm in (0, 1):
                    middle = max(phrase.stop + 0.15, free + 0.5) + self.rng.uniform(0.0, 0.15)
                    steps[arm].append(self.retraction(middle, starts[arm], slow))
                raised = [False, False]
            elif phrase.pause > 0.5:  # held hands relax towards the middle
                for arm in (0, 1):
                    if raised[arm]:
                        last = steps[arm][-1].target
                        middle = max(phrase.stop, free) + self.rng.uniform(0.1, 0.3)
                        relaxed = last + 0.45 * (self.centre(phrase.mood) - last)
                        steps[arm].append(Step(middle, 1.0 * slow, relaxed))
        first = RESTS[0]
        paths = []
        for arm, start in enumerate((first.left, first.right)):
            path = self.path(start, steps[arm], _DELAYS)
            height = np.clip((path[:, 1] - start[1]) / 0.15, 0, 1)
            up = gaussian_filter1d(height, 0.1 * FPS)[:, None]
            path += up * self.beats(spoken, arm)
            path += np.stack([self.drift(s) for s in (0.002, 0.002, 0.003, 0.015)], axis=1)
            paths.append(path)
        shapes = [self.shape(each) for each in steps]
        return apart(*paths), shapes, self.path(np.zeros(1), shrugs)[:, 0]

    def shape(self, steps: list[Step]) -> np.ndarray:
        """The shape of a hand (T, 7), see `HAND_SHAPES`: more or less clear in each movement."""
        relaxed, shaped = np.array(HAND_SHAPES["relaxed"]), []
        for step in steps:
            clear = np.clip(self.finger_rng.normal(0.85, 0.15), 0.5, 1.0)
            target = relaxed + clear * (np.array(HAND_SHAPES[step.shape]) - relaxed)
            target += self.finger_rng.normal(0, 0.03, len(target))
            shaped.append(replace(step, target=target, arc=0.0))
        return self.path(relaxed, shaped, _FINGER_DELAYS)

    def centre(self, mood: Mood | None) -> np.ndarray:
        """The middle of this talker's gesture space, raised by the mood."""
        if mood is None:
            return CENTRE + self.space
        return CENTRE + np.array([0.0, mood.height, 0.0, 0.0])

    def rests_in(self, mood: Mood | None, rest: Rest) -> tuple[np.ndarray, np.ndarray]:
        """The places of both hands at rest, raised by the mood; hands at the sides hang."""
        places = rest.left, rest.right
        if mood is None:
            return places
        hangs = [place[1] < REST_AT_SIDES[1] + 0.05 for place in places]
        return tuple(
            place + np.array([0.0, (0.25 if hang else 1.0) * mood.height, 0.0, 0.0])
            for place, hang in zip(places, hangs, strict=True)
        )

    def gestures(self, phrase: Phrase, early: float) -> list[Gesture]:
        """One gesture for each of the phrase's chosen accents, larger for a more prominent one.

        Hands begin to move with the phrase, not before it: accents in its first `early` seconds
        get none. A liveliness below 0, which only a mood gives, leaves out gestures.
        """
        chosen: list[Syllable] = []
        apart = 1.15 - 0.5 * phrase.liveliness
        late = [a for a in phrase.accents if a.time > phrase.start + early]
        accents = late or phrase.accents[-1:]
        for accent in sorted(accents, key=lambda s: -s.prominence):
            if all(abs(accent.time - other.time) >= apart for other in chosen):
                chosen.append(accent)
        if phrase.mood:
            left_out = np.clip(0.25 - 0.7 * phrase.liveliness, 0.0, 0.85)
            chosen = [accent for accent in chosen if self.rng.random() >= left_out]
        result = []
        for accent in sorted(chosen, key=lambda s: s.time):
            force = accent.prominence
            # How large a gesture is follows from the accent; which one is drawn from a deck.
            usual = 0.34 + 0.16 * phrase.liveliness
            if phrase.mood:  # a calm mood makes smaller gestures of the same accents
                usual -= 0.3 * phrase.mood.liveliness
            rank = "small" if force < 0.4 * usual else "medium" if force < usual else "large"
            if rank != "large" and self.rng.random() < 0.22:
                rank = "large" if rank == "medium" else "medium"
            form = next(self.decks[rank])
            size = float(np.clip(0.65 + 0.32 * phrase.liveliness + 0.3 * force, 0.76, 1.15))
            if phrase.mood:
                size *= phrase.mood.width * (1.0 + 0.35 * min(phrase.liveliness, 0.0))
                size = min(size, 1.25)  # arms do not stretch farther
            duration = (0.34 + 0.14 * (rank == "large")) * (1.45 - 0.45 * phrase.liveliness)
            shares = self.shares(form, phrase)
            centre = self.centre(phrase.mood)
            result.append(Gesture(form, accent.time, size, duration, shares, centre))
        return result

    def shares(self, form: Stroke, phrase: Phrase) -> tuple[float, float]:
        """Draw the share of left and right hand: both, one with a smaller echo, or one alone."""
        if form.hands == "both":
            other = self.rng.uniform(0.85, 1.0)
        else:
            draw = self.rng.random()
            mirrors = form.hands == "any" and draw < 0.35
            echoes = draw < 0.65 + 0.3 * phrase.liveliness
            other = 1.0 if mirrors else self.rng.uniform(0.45, 0.7) if echoes else 0.0
        draw = self.rng.random()
        if phrase.mood:
            leads = 0 if draw < phrase.mood.left else 1
        else:
            leads = self.leading if draw < 0.7 else 1 - self.leading
        return (1.0, other) if leads == 0 else (other, 1.0)

    def stroke(
        self, gesture: Gesture, share: float, free: float, raised: bool, slow: float
    ) -> list[Step]:
        """Preparation and stroke of one hand; what follows until the next step is the hold."""
        late = 0.0 if share == 1.0 else self.rng.uniform(0.0, 0.07)
        begin, end = (
            self.place(place, gesture.size, share, gesture.centre)
            for place in (gesture.form.begin, gesture.form.end)
        )
        centre = gesture.time - LEAD + late
        starts = centre - 0.5 * gesture.duration
        own = _SHAPES.get(gesture.form.name, _OPENING)
        shapes = own if share > 0.8 else ("relaxed", "relaxed")  # an echo has none
        steps = []
        duration = min(starts - free, 0.8 * slow)
        if duration > 0.22 or not raised:  # else there is no time for a preparation
            duration = max(duration, 0.4 if raised else 0.62 * slow)
            steps.append(Step(starts - 0.42 * duration, duration, begin, 0.0, shapes[0]))
        arc = gesture.form.arc * gesture.size * share
        steps.append(Step(centre, gesture.duration, end, arc, shapes[1]))
        return steps

    def retraction(self, centre: float, rest: np.ndarray, slow: float) -> Step:
        return Step(centre, self.rng.uniform(1.1, 1.4) * slow, rest)

    def place(self, place: np.ndarray, size: float, share: float, centre: np.ndarray) -> np.ndarray:
        """Return the place of a hand, nearer to the centre for a smaller gesture."""
        away = (np.asarray(place) - CENTRE) * self.rng.normal(1.0, 0.08, 4)
        if share < 1.0:
            centre = centre - np.array([0.0, 0.07 * (1 - share), 0.02, 0.0])
            away = np.maximum(away, [-0.06, -np.inf, -np.inf, -np.inf])
        return centre + size * share * away

    def beats(self, spoken: list[Phrase], arm: int) -> np.ndarray:
        """Small movements (T, 4) of a raised hand on every syllable, to and fro."""
        steps, side = [], 1.0
        for phrase in spoken:
            size = 0.8 + 0.65 * phrase.liveliness
            for syllable in phrase.syllables:
                side = -side  # twice to the same side would be no movement
                force = size * self.rng.uniform(0.6, 1.3) * (0.7 + 0.6 * syllable.prominence)
                steps.append(Step(syllable.time - LEAD, 0.34, side * force * _BEAT))
            steps.append(Step(phrase.stop + 0.1, 0.5, np.zeros(4)))
        return self.path(np.zeros(4), steps, _DELAYS + 0.015 * arm)

    def arm(
        self, path: np.ndarray, shape: np.ndarray, breath: np.ndarray, shrug: np.ndarray
    ) -> Arm:
        """An arm whose wrist follows `path` within reach and clear of the trunk."""
        wrist, twist = clear_of_trunk(within_reach(path[:, :3])), path[:, 3]
        velocity = np.gradient(wrist, axis=0) * FPS
        # The hand trails its wrist: it drops on the way up and lifts on the way down.
        falling = gaussian_filter1d(-velocity[:, 1] * np.cos(twist), 0.05 * FPS)
        height = wrist[:, 1] - REST_AT_SIDES[1]
        raised = 0.5 + 0.5 * np.tanh((wrist[:, 1] + 0.02) / 0.14)[:, None]
        # Elbows hang by a low hand and swing out to the side for a high one; they are carried
        # along by a hand that moves outward.
        outward = gaussian_filter1d(velocity[:, 0], 0.12 * FPS)
        pole = (1 - raised) * ELBOW_POLE + raised * np.array([0.60, -0.77, -0.20])
        pole[:, 0] += 0.12 * np.tanh(outward)
        extension = 0.12 * np.tanh(height / 0.1) + 0.55 * np.tanh(falling / 1.1)
        # Tendons that pass the wrist close the fingers of a hand that is lifted (tenodesis).
        closed = 0.12 * extension[:, None] * [0, 1, 1, 1, 1, 1, 0]
        return Arm(
            wrist=wrist,
            twist=np.clip(twist, -1.4, 1.3),
            extension=extension,
            lift=0.01 + 0.006 * breath + 0.17 * height + shrug,
            pole=pole,
            fingers=shape + closed,
        )

    # -- the head ----------------------------------------------------------------------------

    def head(self, spoken: list[Phrase], faced: np.ndarray) -> np.ndarray:
        """Pitch, yaw and roll of neck and head together (T, 3) rad."""
        steps = []
        for phrase, listener in zip(spoken, faced, strict=True):
            # Away while the thought is formed, then to the listener.
            away = self.rng.normal(0, [0.09, 0.24, 0.05])
            gaze = np.array([self.rng.normal(0, 0.03), listener, self.rng.normal(0, 0.04)])
            if phrase.stop - phrase.start > 1.5 and self.rng.random() < 0.6:
                steps.append(Step(phrase.start - 0.15, self.rng.uniform(0.45, 0.7), away))
                steps.append(Step(phrase.start + self.rng.uniform(0.6, 1.0), 0.55, gaze))
            else:
                steps.append(Step(phrase.start - 0.05, self.rng.uniform(0.5, 0.8), gaze))
            if phrase.pause > _REST_PAUSE:
                steps.append(Step(phrase.stop + 0.35, 1.0, 0.4 * away))
        angles = self.path(np.zeros(3), steps)
        angles += np.stack([self.drift(0.015), self.drift(0.035), self.drift(0.015)], axis=1)
        for phrase in spoken:
            for accent in phrase.accents:
                depth = (0.03 + 0.16 * accent.prominence) * (0.6 + 0.6 * phrase.liveliness)
                middle = accent.time - LEAD
                nod = self.movement(middle - 0.08, 0.3) - self.movement(middle + 0.22, 0.42)
                angles[:, 0] += depth * nod
                angles[:, 2] += self.rng.normal(0, 0.3) * depth * nod
        return angles


def within_reach(wrist: np.ndarray) -> np.ndarray:
    """Wrist positions (T, 3) of a left arm, moved smoothly where they would stretch or fold it."""
    away = wrist - SHOULDER
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    over = np.maximum(distance - 0.45, 0.0)
    shorter = distance - over + 0.07 * np.tanh(over / 0.07)
    folded = 0.015 * np.logaddexp(0.0, (0.17 - distance) / 0.015)
    return SHOULDER + away * (shorter + folded) / distance


def apart(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Paths (T, 4) of both hands, moved smoothly aside where one would reach into the other."""
    height, depth = left[:, 1] - right[:, 1], left[:, 2] - right[:, 2]
    gap = np.sqrt((left[:, 0] + right[:, 0]) ** 2 + 4 * height**2 + depth**2)
    aside = np.logaddexp(0.0, (_HANDS_APART - gap) / 0.03)[:, None] * [0.015, 0, 0, 0]
    return left + aside, right + aside


def clear_of_trunk(wrist: np.ndarray) -> np.ndarray:
    """Wrist positions (T, 3), pushed smoothly out of an elliptic cylinder round the trunk."""
    flat = wrist[:, [0, 2]] / _TRUNK
    distance = np.linalg.norm(flat, axis=1, keepdims=True)
    outside = 1.0 + np.logaddexp(0.0, (distance - 1.0) / 0.05) * 0.05
    below = 0.5 - 0.5 * np.tanh((wrist[:, 1:2] - 0.22) / 0.04)  # above the shoulders there is room
    clear = wrist.copy()
    clear[:, [0, 2]] *= 1.0 + below * (outside / distance - 1.0)
    return clear
