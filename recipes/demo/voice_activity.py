"""Measure voice activity detection, and the motion of a model, for noise, hum, music and speech.

    python recipes/demo/voice_activity.py SPEECH... [--model demo] [--moved 12]

SPEECH are recordings of speech, of which the first 20 s are used. Prints two tables in Markdown.
False voice is the share of a sound without speech that counts as voice; missed voice is the share
of active speech that counts as silence. Motion is the mean speed of all joints, for speech on
`--moved` of the recordings.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.signal import butter, lfilter, sosfilt

import audio_features as af
import gesturekit as gk

RATE = 16_000
SECONDS = 20.0
TAKES = 4
"""Sounds of each kind without speech."""
DBFS = -60.0
"""Level of sounds without speech."""

Generate = Callable[[float, np.random.Generator], np.ndarray]
"""Seconds and a random generator to samples (N,) at `RATE`."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("speech", type=Path, nargs="+", help="recordings of speech")
    parser.add_argument("--model", default="demo", help="a model folder or a bundled name (demo)")
    parser.add_argument("--moved", type=int, default=12, help="recordings with motion (12)")
    options = parser.parse_args(arguments)
    logging.disable(logging.WARNING)  # the model warns of every sound without voice
    speed = partial(mean_speed, gk.load(options.model))
    print(table_without_speech(speed))
    print()
    print(table_of_speech(options.speech, speed, options.moved))


def mean_speed(model: gk.Model, wave: af.Wave) -> float:
    """Return the mean speed of all joints in the motion generated for a sound, m/s."""
    motion = model.generate(wave, seed=0)
    steps = np.diff(motion.positions(), axis=0)
    return float(np.linalg.norm(steps, axis=2).mean() * motion.fps)


def table_without_speech(speed: Callable[[af.Wave], float]) -> str:
    """Return false voice and motion for each kind of sound without speech."""
    lines = ["| sound | false voice, % | motion, m/s: mean, highest |", "|---|---|---|"]
    for name, generate in WITHOUT_SPEECH.items():
        shares, speeds = [], []
        for seed in range(TAKES):
            rng = np.random.default_rng([seed, len(name)])
            wave = _wave(10 ** (DBFS / 20) * _unit(generate(SECONDS, rng)))
            shares.append(np.ptp(af.voice_activity(wave), axis=1).sum() / SECONDS)
            speeds.append(speed(wave))
        lines.append(
            f"| {name} | {100 * np.mean(shares):.1f} | {np.mean(speeds):.3f}, {max(speeds):.3f} |"
        )
    return "\n".join(lines)


def table_of_speech(files: Sequence[Path], speed: Callable[[af.Wave], float], n_moved: int) -> str:
    """Return missed voice and motion, as a multiple of clean speech's, for each disturbance."""
    missed: dict[str, list[float]] = {}
    moved: dict[str, list[float]] = {}
    for number, file in enumerate(files):
        speech = af.Wave.load(file).resample(RATE)
        speech = speech.slice(0.0, min(SECONDS, speech.duration))
        moves = number * n_moved // len(files) < (number + 1) * n_moved // len(files)
        clean = speed(speech) if moves else 0.0
        for name, wave, spoken in disturbed(speech, np.random.default_rng(number)):
            kept = np.zeros(len(spoken), bool)
            for start, stop in af.voice_activity(wave):
                kept[round(100 * start) : round(100 * stop)] = True
            missed.setdefault(name, []).append(1.0 - kept[spoken].mean())
            if moves:
                moved.setdefault(name, []).append(speed(wave) / clean)
    lines = [
        f"| speech | missed voice, %: mean, worst of {len(files)} recordings "
        f"| motion / clean speech's: mean, lowest of {len(moved['clean'])} |",
        "|---|---|---|",
    ]
    for name, shares in missed.items():
        lines.append(
            f"| {name} | {100 * np.mean(shares):.1f}, {100 * max(shares):.0f} "
            f"| {np.mean(moved[name]):.2f}, {min(moved[name]):.2f} |"
        )
    return "\n".join(lines)


def disturbed(
    speech: af.Wave, rng: np.random.Generator
) -> Iterator[tuple[str, af.Wave, np.ndarray]]:
    """Yield (name, sound, active frames of the speech at 100 Hz), the clean speech first."""
    active, samples = speech.active(), speech.samples
    level = 10 ** (speech.active_level() / 20)
    yield "clean", speech, active
    yield "20 dB quieter", _wave(0.1 * samples), active
    higher = af.Wave(samples, round(1.5 * RATE)).resample(RATE)
    yield "1.5 times as high and fast", higher, higher.active()
    telephone = butter(4, [300, 3400], "bandpass", fs=RATE, output="sos")
    yield "300 to 3,400 Hz", _wave(sosfilt(telephone, samples)), active
    for name in ("white noise", "pink noise", "brown noise", "blue noise", "hum, 50 Hz", "typing"):
        for ratio in (30, 20, 10, 0):
            noise = _unit(WITHOUT_SPEECH[name](speech.duration, rng))[: len(samples)]
            mixed = _wave(samples + level * 10 ** (-ratio / 20) * noise)
            yield f"{name}, {ratio} dB", mixed, active


def noise(seconds: float, rng: np.random.Generator, slope: float = 0.0) -> np.ndarray:
    """Return noise whose power is proportional to frequency^-slope above 20 Hz."""
    n = round(seconds * RATE)
    hertz = np.maximum(np.fft.rfftfreq(n, 1 / RATE), 20.0)
    return np.fft.irfft(np.fft.rfft(rng.standard_normal(n)) * hertz ** (-slope / 2), n)


def hum(seconds: float, rng: np.random.Generator, hertz: float = 50.0) -> np.ndarray:
    """Return 3 to 30 harmonics of a steady tone over a noise floor 26 dB below."""
    time = np.arange(round(seconds * RATE)) / RATE
    hertz *= rng.uniform(0.999, 1.001)
    harmonics = range(1, int(rng.integers(3, 31)))
    tones = sum(
        rng.uniform(0.3, 1.0) / k * np.sin(2 * np.pi * (k * hertz * time + rng.random()))
        for k in harmonics
    )
    return _unit(tones) + 0.05 * _unit(noise(seconds, rng, 1.0))


def typing(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Return keystrokes, about five a second: bursts of damped resonances, down and up."""
    n = round(seconds * RATE)
    samples, time = 0.003 * rng.standard_normal(n), np.arange(round(0.06 * RATE)) / RATE
    stroke = 0.0
    while (stroke := stroke + rng.gamma(2.0, 0.09) + 1.5 * (rng.random() < 0.05)) < seconds - 0.3:
        for delay, size in ((0.0, 1.0), (rng.uniform(0.06, 0.13), 0.5)):
            click = rng.standard_normal(len(time)) * np.exp(-time / 0.004)
            for _ in range(4):
                ringing = np.exp(-time / rng.uniform(0.002, 0.012))
                click += np.sin(2 * np.pi * rng.uniform(200.0, 5500.0) * time) * ringing
            first = round((stroke + delay) * RATE)
            samples[first : first + len(click)] += size * rng.uniform(0.5, 1.0) * click
    return samples


def breath(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Return breaths, one in 2 to 5 s: noise through three resonances, in and out."""
    time = np.arange(round(seconds * RATE)) / RATE
    samples = rng.standard_normal(len(time))
    for low, high in ((400.0, 700.0), (1300.0, 1800.0), (2500.0, 3000.0)):
        radius, angle = np.exp(-np.pi * 250.0 / RATE), 2 * np.pi * rng.uniform(low, high) / RATE
        resonance = lfilter([1.0], [1.0, -2 * radius * np.cos(angle), radius**2], samples)
        samples = 0.3 * samples + 0.7 * _unit(resonance)
    rate = rng.uniform(0.2, 0.5)
    swell = np.maximum(0.0, np.sin(2 * np.pi * rate * time)) ** 1.5
    return swell * samples + 0.01 * rng.standard_normal(len(time))


def music(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Return a track of recipes/diffusion_dance: clicks on the beats and a chord a bar."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "diffusion_dance"))
    from track import RATE as rate
    from track import TEMPOS, play

    track = play(seconds, rng.uniform(*TEMPOS), bool(rng.integers(2)), rng)
    samples = af.Wave(track.samples.astype(np.float32), rate).resample(RATE).samples
    return samples[: round(seconds * RATE)]


WITHOUT_SPEECH: dict[str, Generate] = {
    "white noise": noise,
    "pink noise": partial(noise, slope=1.0),
    "brown noise": partial(noise, slope=2.0),
    "blue noise": partial(noise, slope=-1.0),
    "hum, 50 Hz": hum,
    "hum, 60 Hz": partial(hum, hertz=60.0),
    "hum, 100 Hz": partial(hum, hertz=100.0),
    "typing": typing,
    "breath": breath,
    "music of `recipes/diffusion_dance`": music,
}
"""Sounds without speech, by name."""


def _unit(samples: np.ndarray) -> np.ndarray:
    return samples / np.sqrt(np.mean(np.square(samples)))


def _wave(samples: np.ndarray) -> af.Wave:
    return af.Wave(np.asarray(samples, dtype=np.float32), RATE)


if __name__ == "__main__":
    main()
