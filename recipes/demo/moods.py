"""Make a corpus of one speaker whose moods are known: many talks, calm and lively.

    python recipes/demo/moods.py OUT_DIR [--talks 30] [--seconds 100] [--seed 0] [--workers 1]

Writes, the same bytes for the same seed:

    OUT_DIR/talk_NN.wav, .bvh   speech with motion
    OUT_DIR/moods.csv           the mood of every talk, once a second (see `truth`)
    OUT_DIR/speaker.json        the speaker's habits: spreads, time constant, trace in the voice

The seed is the speaker. Each dimension of a mood is a random process: a Gaussian mean for each
talk plus a smooth Gaussian process within the talk. The voice follows the mood with the
correlation `Speaker.audible`; the rest of the mood cannot be predicted from the speech.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from prepare import PAIRED_VOICES, recorded, shuffled, write_wav
from scipy.ndimage import gaussian_filter1d
from talker import Mood, talk
from texts import ENGLISH
from voice import Voice, speak

import audio_features as af
from audio_features.atomic import atomic_write
from gesturekit.evaluation import hand_movement
from gesturekit.evaluation.metrics.hands import hand_level
from gesturekit.motion.motion import Motion

VOICES = tuple(name for name in PAIRED_VOICES if not name.endswith(("Annie", "m7")))
"""The two that are left out have a wide pitch range whatever is asked of them."""
CLIP_SECONDS = 10.0
_STEP = 0.1  # seconds between samples of a random process
_LEAD_SPREAD = 0.8  # of the log odds of the leading hand


@dataclass(frozen=True)
class Spread:
    """Standard deviations of the talks' means, and of the process within a talk."""

    between: float
    within: float


@dataclass(frozen=True)
class Speaker:
    """The habits of a speaker.

    voice: espeak voice; pitch: its height, 0-99.
    mood, height (m), width (ln), lead (log odds that the left hand leads): spreads.
    seconds: time constant of the processes within a talk (`process`).
    audible: correlation of mood and voice.
    usual_height (m), usual_width (ln), usual_lead (log odds): the means.
    """

    voice: str
    pitch: int
    mood: Spread
    height: Spread
    width: Spread
    lead: Spread
    seconds: float
    audible: float
    usual_mood: float
    usual_height: float
    usual_width: float
    usual_lead: float

    @classmethod
    def draw(cls, seed: int) -> Speaker:
        rng = np.random.default_rng([seed, 10])
        return cls(
            voice=VOICES[rng.integers(len(VOICES))],
            pitch=int(rng.integers(42, 59)),
            mood=Spread(rng.uniform(0.2, 0.4), rng.uniform(0.25, 0.5)),
            height=Spread(rng.uniform(0.02, 0.05), rng.uniform(0.01, 0.03)),
            width=Spread(rng.uniform(0.06, 0.14), rng.uniform(0.04, 0.1)),
            lead=Spread(_LEAD_SPREAD * rng.uniform(0.5, 1.5), _LEAD_SPREAD * rng.uniform(0.5, 1.5)),
            seconds=float(np.exp(rng.uniform(np.log(5), np.log(25)))),
            audible=rng.uniform(0.0, 0.7),
            usual_mood=rng.uniform(-0.05, 0.2),
            usual_height=rng.normal(0, 0.025),
            usual_width=rng.normal(0, 0.06),
            usual_lead=float(rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1.6)),
        )


@dataclass(frozen=True)
class Course:
    """The moods of one talk at `times` (s): columns of `values` are those of `NAMES`."""

    times: np.ndarray
    values: np.ndarray

    NAMES = ("mood", "height", "width", "left")

    def at(self, times: np.ndarray | float) -> np.ndarray:
        """Moods (..., 4) at times in s."""
        columns = [np.interp(times, self.times, column) for column in self.values.T]
        return np.stack(columns, axis=-1)

    def __call__(self, time: float) -> Mood:
        return Mood(*map(float, self.at(time)))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description="Make a corpus of one speaker whose moods are known."
    )
    parser.add_argument("out", type=Path, metavar="OUT_DIR")
    parser.add_argument("--talks", type=int, default=30, help="(30)")
    parser.add_argument("--seconds", type=float, default=100.0, help="length of a talk (100)")
    parser.add_argument("--seed", type=int, default=0, help="of the speaker (0)")
    parser.add_argument("--workers", type=int, default=1, help="processes (1)")
    options = parser.parse_args(arguments)
    if not 1 <= options.talks <= 999:
        parser.error(f"--talks {options.talks}: from 1 to 999")
    if not 5 <= options.seconds <= 3600:
        parser.error(f"--seconds {options.seconds}: from 5 to 3600")
    if options.seed < 0:
        parser.error(f"--seed {options.seed}: at least 0")
    if options.workers < 1:
        parser.error(f"--workers {options.workers}: at least 1")
    make(options.out, options.talks, options.seconds, options.seed, options.workers)


def make(out: Path, talks: int, seconds: float, seed: int, workers: int = 1) -> None:
    """Write the corpus to `out` and print its statistics."""
    one = partial(make_talk, out, seconds, seed)
    numbers = range(1, talks + 1)
    if workers == 1:
        made = [one(number) for number in numbers]
    else:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            made = list(pool.map(one, numbers))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["talk", "time", *Course.NAMES])
    for truth, _ in made:
        table.writerows(truth)
    with atomic_write(out / "moods.csv") as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")
    speaker = Speaker.draw(seed)
    with atomic_write(out / "speaker.json") as temporary:
        temporary.write_text(json.dumps(asdict(speaker), indent=1) + "\n", encoding="utf-8")
    print(f"{speaker}\n{statistics([clips for _, clips in made])}")


def make_talk(out: Path, seconds: float, seed: int, number: int) -> tuple[list[list], Measures]:
    """Write one talk.

    Returns its rows of `moods.csv` and its `Measures`.
    """
    stem = out / f"talk_{number:02d}"
    samples, rate, course = speech(Speaker.draw(seed), seconds, seed, number)
    write_wav(stem.with_suffix(".wav"), samples, rate)
    wave = af.Wave.load(stem.with_suffix(".wav"))
    motion = talk(wave, 1000 * seed + number, course)
    motion.save(stem.with_suffix(".bvh"))
    return truth(stem.name, course, wave.duration), measure(wave, motion)


def truth(name: str, course: Course, seconds: float) -> list[list]:
    """Rows of `moods.csv`: talk, time (s), and the columns of a course.

    mood: what is added to the liveliness (0..1) read off the speech; height: m; width: factor;
    left: probability that the left hand leads.
    """
    times = np.arange(0.0, seconds, 1.0)
    return [
        [name, f"{time:g}", *(f"{value:.4f}" for value in row)]
        for time, row in zip(times, course.at(times), strict=True)
    ]


def process(rng: np.random.Generator, n: int, spread: Spread, seconds: float) -> np.ndarray:
    """Draw a talk's mean plus a smooth Gaussian process (N,), every `_STEP` s.

    The process is an Ornstein-Uhlenbeck process smoothed by a Gaussian of a quarter of its time
    constant, scaled to the standard deviation `spread.within`. Its autocorrelation falls to 0.5
    after `seconds`.
    """
    decay = np.exp(-_STEP / seconds)
    # The variance of the smoothed process: from its autocovariance exp(-|t| / seconds).
    lags = np.arange(-round(20 * seconds / _STEP), round(20 * seconds / _STEP) + 1)
    smooth = partial(gaussian_filter1d, sigma=0.25 * seconds / _STEP, mode="nearest")
    variance = smooth(smooth(decay ** np.abs(lags)))[len(lags) // 2]
    margin = round(2 * seconds / _STEP)
    noise = np.sqrt(1 - decay**2) * rng.standard_normal(n + 2 * margin)
    values = np.empty(len(noise))
    last = rng.standard_normal()
    for k, each in enumerate(noise):
        values[k] = last = decay * last + each
    smoothed = smooth(values)[margin : margin + n] / np.sqrt(variance)
    return spread.between * rng.standard_normal() + spread.within * smoothed


def speech(
    speaker: Speaker, seconds: float, seed: int, number: int
) -> tuple[np.ndarray, int, Course]:
    """One talk of about `seconds`: samples (N,) in [-1, 1], their rate, and its moods."""
    rng = np.random.default_rng([seed, 11, number])
    n = round(2 * seconds / _STEP) + 100
    times = np.arange(n) * _STEP
    mood = process(rng, n, speaker.mood, speaker.seconds)
    own = process(rng, n, speaker.mood, speaker.seconds)  # of the voice alone
    scale = np.hypot(speaker.mood.between, speaker.mood.within)
    effort = (speaker.audible * mood + np.sqrt(1 - speaker.audible**2) * own) / scale
    height = speaker.usual_height + process(rng, n, speaker.height, speaker.seconds)
    width = speaker.usual_width + process(rng, n, speaker.width, speaker.seconds)
    lead = speaker.usual_lead + process(rng, n, speaker.lead, speaker.seconds)
    columns = (speaker.usual_mood + mood, height, np.exp(width), 1 / (1 + np.exp(-lead)))

    texts = shuffled(ENGLISH, rng)
    time, sentences, voices, begins, gains, pauses = 0.4, [], [], [], [], []
    while time < seconds - 1.0:
        here = float(np.interp(time, times, effort))
        sentence = next(texts)
        sentences.append(sentence if here > 0 else sentence.replace("*", ""))
        voices.append(
            Voice(
                speaker.voice,
                rate=int(np.clip(round(158 + 10 * here), 130, 188)),
                pitch=int(np.clip(round(speaker.pitch + 3 * here), 20, 80)),
                pitch_range=int(np.clip(round(38 + 5 * here), 4, 99)),
            )
        )
        begins.append(time)
        gains.append(2.0 * here + rng.uniform(-1.5, 1.5))
        pauses.append(rng.uniform(0.3, 1.6) * np.exp(-0.15 * here))
        time += len(sentence) / 6.6 * 60 / voices[-1].rate + pauses[-1]
    begins.append(time)
    samples, rate, starts = _performed(sentences, voices, gains, pauses)
    # The same throat, microphone and room in all talks of a speaker.
    played = recorded(samples, np.random.default_rng([seed, 12]))
    starts = starts * len(played) / len(samples)
    # Moods were drawn on planned times; they are moved to when the sentences were said.
    planned = np.array([0.0, *begins])
    said = np.interp(times, planned, [0.0, *starts])
    inside = times <= planned[-1]
    return played, rate, Course(said[inside], np.stack(columns, axis=1)[inside])


def _performed(
    sentences: list[str], voices: list[Voice], gains: list[float], pauses: list[float]
) -> tuple[np.ndarray, int, np.ndarray]:
    """The sentences with pauses (s) after them and gains (dB); samples, rate, and the S + 1
    times at which a sentence or the end begins."""
    spoken, rate = speak(sentences, voices)
    pieces, starts = [np.zeros(round(0.4 * rate))], []
    for samples, gain, pause in zip(spoken, gains, pauses, strict=True):
        starts.append(sum(map(len, pieces)) / rate)
        loud = np.flatnonzero(np.abs(samples) > 1e-3)
        pieces.append(samples[loud[0] : loud[-1] + 1] * 10 ** (gain / 20))
        pieces.append(np.zeros(round(pause * rate)))
    samples = np.concatenate(pieces)
    starts.append(len(samples) / rate)
    return samples, rate, np.array(starts)


@dataclass(frozen=True)
class Measures:
    """A talk measured: median hand speed (m/s), and level and mean pitch range (semitones) of
    its C clips of 10 s, (C,)."""

    median: float
    levels: np.ndarray
    pitch_ranges: np.ndarray


def measure(wave: af.Wave, motion: Motion) -> Measures:
    """Measure a talk and its clips of 10 s."""
    levels, ranges = [], []
    pitch = af.ProsodicRange().extract(wave)
    size = round(CLIP_SECONDS * motion.fps)
    for start in range(0, motion.n_frames - size + 1, size):
        clip = motion[start : start + size]
        first = start / motion.fps
        here = (pitch.times >= first) & (pitch.times < first + CLIP_SECONDS)
        levels.append(hand_level(clip))
        ranges.append(pitch.values[here, 0].mean())
    return Measures(hand_movement(motion).q50, np.array(levels), np.array(ranges))


def statistics(talks: Sequence[Measures]) -> str:
    """Describe how the levels of clips of 10 s vary between talks and within them."""
    talks = [talk for talk in talks if len(talk.levels) > 1]
    if len(talks) < 2:
        return "statistics need two talks of 20 s"
    levels = [talk.levels for talk in talks]
    means = np.array([level.mean() for level in levels])
    within = np.sqrt(np.mean([level.var(ddof=1) for level in levels]))
    lengths = np.mean([len(level) for level in levels])
    between = np.sqrt(max(means.var(ddof=1) - within**2 / lengths, 0.0))
    now = np.concatenate([level[:-1] - level.mean() for level in levels])
    then = np.concatenate([level[1:] - level.mean() for level in levels])
    lag = np.mean(now * then) / np.mean(np.concatenate([now, then]) ** 2)
    ranges = [talk.pitch_ranges for talk in talks]
    r = np.corrcoef(np.concatenate(levels), np.concatenate(ranges))[0, 1]
    r_talks = np.corrcoef(means, [each.mean() for each in ranges])[0, 1]
    medians = np.array([talk.median for talk in talks])
    return (
        f"level of {sum(map(len, levels))} clips of 10 s: sd between talks {between:.2f} "
        f"(of the talks' means {means.std(ddof=1):.2f}), within talks {within:.2f}\n"
        f"successive clips within a talk: r {lag:.2f} about the talk's mean\n"
        f"level with pitch range: r {r:.2f} of clips, {r_talks:.2f} of talks\n"
        f"median hand speed of a talk: {medians.min():.3f} to {medians.max():.3f} m/s, "
        f"ratio {medians.max() / medians.min():.1f}"
    )


if __name__ == "__main__":
    main()
