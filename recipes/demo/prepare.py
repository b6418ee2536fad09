"""Make the demo corpus: synthetic speech and a rule-based talker's gestures.

    python recipes/demo/prepare.py OUT_DIR [--minutes 6] [--seed 0]

Writes, the same bytes for the same seed:

    OUT_DIR/paired/{calm,lively}_NN.wav, .bvh   speech with motion, `--minutes` in all
    OUT_DIR/paired/calm_00.wav, .bvh            near-silence with idle motion
    OUT_DIR/unpaired/NN.wav                     speech of other voices, two thirds as much
    OUT_DIR/demo.wav                            sentences that are in neither

The style is the first part of a file's name.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile
import soxr
from scipy.signal import lfilter
from talker import talk
from texts import DEMO, ENGLISH, OTHER_LANGUAGES
from voice import Voice, speak

import audio_features as af
from audio_features.atomic import atomic_write

# espeak variants that sound like people. Those with `breath` or `klatt` draw noise.
PAIRED_VOICES = (
    "en-us+m3",
    "en+f4",
    "en-gb-x-rp+m1",
    "en-us+f1",
    "en-gb-scotland+m7",
    "en-us+Annie",
    "en-us+m4",
    "en-gb-x-rp+f4",
)
UNPAIRED_VOICES = (
    "en-us+linda",
    "en-us-nyc+m5",
    "de+f4",
    "en-gb-scotland+f1",
    "fr+m2",
    "en-029+m8",
    "it+belinda",
    "en+Gene",
    "pt-br+m6",
    "en-us+steph",
)
DEMO_VOICE = Voice("en-us+m2", rate=180, pitch=55, pitch_range=90)
DEMO_RATE = 16000  # Hz; the packaged audio is small
SILENCE_SECONDS = 15.0
ITEM_SECONDS = 30.0


@dataclass(frozen=True)
class Style:
    """Ranges from which an item's voice is drawn; see `voice.Voice` for their units."""

    rate: tuple[int, int]
    pitch: tuple[int, int]
    pitch_range: tuple[int, int]
    pause: tuple[float, float]
    stresses_words: bool


STYLES = {
    "calm": Style((130, 155), (38, 52), (4, 28), (0.5, 2.0), stresses_words=False),
    "lively": Style((155, 185), (48, 66), (78, 99), (0.3, 1.3), stresses_words=True),
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description="Make the demo corpus: synthetic speech and a rule-based talker's gestures."
    )
    parser.add_argument("out", type=Path, metavar="OUT_DIR")
    parser.add_argument("--minutes", type=float, default=6.0, help="of paired speech (6)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if not 0.2 <= options.minutes <= 600:
        parser.error(f"--minutes {options.minutes}: from 0.2 to 600")
    prepare(options.out, options.minutes, options.seed)


def prepare(out: Path, minutes: float, seed: int) -> None:
    """Write the corpus to `out`."""
    paired = make_paired(out / "paired", 60 * minutes, seed)
    unpaired = make_unpaired(out / "unpaired", 40 * minutes, seed)
    rng = np.random.default_rng([seed, 3])
    samples, rate = perform(list(DEMO), DEMO_VOICE, (0.35, 0.6), rng)
    write_wav(out / "demo.wav", soxr.resample(samples, rate, DEMO_RATE), DEMO_RATE)
    print(
        f"{paired / 60:.1f} minutes of speech with motion, {unpaired / 60:.1f} without, in {out}\n"
        f"Next:\n"
        f"  gesturekit prepare {out}/paired --unpaired {out}/unpaired --out {out}/corpus.jsonl \\\n"
        f"      --style-pattern '(?P<style>calm|lively)_'\n"
        f"  gesturekit train recipes/demo/config.yaml corpus={out}/corpus.jsonl out=runs/demo"
    )


def make_paired(folder: Path, seconds: float, seed: int) -> float:
    """Speech with motion, calm and lively in turn, and one item of near-silence."""
    silence = min(SILENCE_SECONDS, 0.15 * seconds)
    n_items = 2 * max(1, round((seconds - silence) / ITEM_SECONDS / 2))
    texts = shuffled(ENGLISH, np.random.default_rng([seed, 0]))

    rng = np.random.default_rng([seed, 1])
    noise = 10 ** (-85 / 20) * rng.standard_normal(round(silence * 22050))
    total = write_pair(folder / "calm_00", noise, 22050, seed)
    for k in range(n_items):
        rng = np.random.default_rng([seed, 1, k])
        name = ("calm", "lively")[k % 2]
        # Every voice speaks in both styles, so that a voice does not give the style away.
        voice = PAIRED_VOICES[k // 2 % len(PAIRED_VOICES)]
        length = (seconds - silence) / n_items
        samples, rate = monologue(texts, voice, STYLES[name], length, rng)
        total += write_pair(folder / f"{name}_{k // 2 + 1:02d}", samples, rate, seed + k + 1)
    return total


def make_unpaired(folder: Path, seconds: float, seed: int) -> float:
    """Speech of other voices, in several languages, without motion."""
    n_items = max(1, round(seconds / ITEM_SECONDS * 1.2))
    english = shuffled(ENGLISH, np.random.default_rng([seed, 4]))
    total = 0.0
    for k in range(n_items):
        rng = np.random.default_rng([seed, 2, k])
        voice = UNPAIRED_VOICES[k % len(UNPAIRED_VOICES)]
        language = voice.split("+")[0]
        texts = shuffled(OTHER_LANGUAGES[language], rng) if language in OTHER_LANGUAGES else english
        style = STYLES[("lively", "calm")[k % 2]]
        samples, rate = monologue(texts, voice, style, seconds / n_items, rng)
        total += write_wav(folder / f"{k + 1:02d}.wav", samples, rate)
    return total


def shuffled(sentences: Sequence[str], rng: np.random.Generator) -> Iterator[str]:
    """The sentences without end, in a new order each time round."""
    while True:
        for k in rng.permutation(len(sentences)):
            yield sentences[k]


def monologue(
    texts: Iterator[str], voice: str, style: Style, seconds: float, rng: np.random.Generator
) -> tuple[np.ndarray, int]:
    """About `seconds` of one voice: samples (N,) in [-1, 1] and their rate."""
    # How long a sentence takes is guessed from its letters and the pauses around it.
    rate = int(rng.integers(*style.rate))
    sentences, guess = [], 0.0
    while guess < seconds - 1.0:
        sentence = next(texts)
        sentences.append(sentence if style.stresses_words else sentence.replace("*", ""))
        guess += len(sentence) / 6.0 * 60 / rate + np.mean(style.pause)
    spoken = Voice(
        voice, rate, int(rng.integers(*style.pitch)), int(rng.integers(*style.pitch_range))
    )
    samples, sample_rate = perform(sentences, spoken, style.pause, rng)
    samples = recorded(samples, rng)
    return samples, sample_rate


def perform(
    sentences: list[str], voice: Voice, pause: tuple[float, float], rng: np.random.Generator
) -> tuple[np.ndarray, int]:
    """The sentences with pauses between them, each a little louder or softer."""
    spoken, rate = speak(sentences, voice)
    pieces = [np.zeros(round(rate * rng.uniform(0.2, 0.7)))]
    for samples in spoken:
        pieces.append(_trimmed(samples) * 10 ** (rng.uniform(-4, 0) / 20))
        pieces.append(np.zeros(round(rate * rng.uniform(*pause))))
    return 0.8 * np.concatenate(pieces), rate


def _trimmed(samples: np.ndarray) -> np.ndarray:
    """Without espeak's own silence at the ends: the pauses here are meant to be exact."""
    loud = np.flatnonzero(np.abs(samples) > 1e-3)
    return samples[loud[0] : loud[-1] + 1]


def recorded(samples: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same through another throat, microphone and room."""
    # A longer or shorter vocal tract: played faster or slower by up to 9 %.
    samples = soxr.resample(samples, 1.0, 1.0 / rng.uniform(0.92, 1.09))
    tilt = rng.uniform(-0.5, 0.4)  # darker below zero, brighter above
    samples = lfilter([1.0, -max(tilt, 0.0)], [1.0, min(tilt, 0.0)], samples)
    samples *= 10 ** (rng.uniform(-18, -4) / 20) / np.abs(samples).max()
    if rng.random() < 0.5:
        samples = samples + 10 ** (-60 / 20) * rng.standard_normal(len(samples))
    return samples


def write_pair(stem: Path, samples: np.ndarray, rate: int, seed: int) -> float:
    """Speech, and the motion that the talker makes of the file as it was written."""
    seconds = write_wav(stem.with_suffix(".wav"), samples, rate)
    talk(af.Wave.load(stem.with_suffix(".wav")), seed).save(stem.with_suffix(".bvh"))
    return seconds


def write_wav(path: Path, samples: np.ndarray, rate: int) -> float:
    """Write 16-bit samples; returns seconds."""
    with atomic_write(path) as temporary:
        soundfile.write(temporary, samples, rate, subtype="PCM_16")
    print(f"{path}: {len(samples) / rate:.1f} s")
    return len(samples) / rate


if __name__ == "__main__":
    main()
