"""Rendering a folder of 1,000 recordings, 50 of them broken: speed, faults, and equal bytes.

Recordings of 0.3 to 60 s (most are short), 8 to 48 kHz, mono and stereo, cut from the bundled one.
They are rendered by one process and by two, again, alone, in another order, by Slurm's local
launcher, and in 100 shards over 8 processes. Any difference in bytes ends the benchmark. "other" is
the duration of the sound, so that the ratio is the hours of sound in an hour; notes have the
processor time as well.
"""

from __future__ import annotations

import hashlib
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import soundfile
from harness import arguments, report
from scipy.signal import resample_poly

import audio_features as af
from gesturekit.systems import bundled_speech

RATES = (8_000, 11_025, 16_000, 22_050, 44_100, 48_000)
SHARDS, PROCESSES = 100, 8
BY_HAND = """
import sys, gesturekit as gk
model = gk.load("demo")
for number in map(int, sys.argv[3].split(",")):
    for _ in gk.render(model, sys.argv[1], sys.argv[2], shard=(number, {shards})):
        pass
"""


def write_sounds(folder: Path, count: int) -> float:
    """Write `count` files, every 20th broken, and return the seconds of the others."""
    rng = np.random.default_rng(0)
    spoken = af.Wave.load(bundled_speech())
    at_rate = {rate: resample_poly(spoken.samples, rate, spoken.sample_rate) for rate in RATES}
    total = 0.0
    for number in range(count):
        path = folder / f"day {number % 7}" / f"{number:04d}.wav"
        path.parent.mkdir(parents=True, exist_ok=True)
        rate = RATES[number % len(RATES)]
        frames = round(0.3 * 200 ** (rng.uniform() ** 6) * rate)  # 0.3 to 60 s, most are short
        sound = np.resize(np.roll(at_rate[rate], rng.integers(len(at_rate[rate]))), frames)
        sound *= 0.6 + 0.4 * np.sin(np.arange(frames) / rate * rng.uniform(0.5, 2))
        stereo = np.stack([sound, 0.8 * sound], axis=1) if number % 3 == 0 else sound
        soundfile.write(path, stereo, rate, subtype="PCM_16" if number % 4 else "FLOAT")
        if number % 20 == 19:
            break_file(path, number // 20 % 10)
        else:
            total += frames / rate
    return total


def break_file(path: Path, way: int) -> None:
    """Damage a recording in one of ten ways."""
    data = path.read_bytes()
    if way == 8:
        path.unlink()
        return path.symlink_to("nowhere.wav")
    if way == 9:
        return soundfile.write(path, np.full(8000, np.nan, "f4"), 8000, subtype="FLOAT")
    path.write_bytes(
        (
            b"",
            b"Dear diary,\n",
            data[:20],
            b"\xff\xd8\xff\xe0 a picture" + data,
            data[:20] + b"\x34\x12" + data[22:],  # a codec that nobody has
            data[:22] + bytes(2) + data[24:],  # no channels
            data[:24] + bytes(4) + data[28:],  # no sample rate
            b"\0" * len(data),
        )[way]
    )


def results(out: Path) -> dict[str, str]:
    """Hashes of all motion files; nothing else may be visible."""
    files = [p for p in out.rglob("*") if p.is_file() and ".gesturekit" not in p.parts]
    assert all(p.suffix == ".bvh" and p.name[0] != "." for p in files), files
    return {
        p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files
    }


def render(*arguments: object, code: int) -> tuple[float, float, str]:
    """Run the command, and return its wall-clock and processor seconds, and what it printed."""
    command = [sys.executable, "-m", "gesturekit", "render", "--model", "demo"]
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run([*command, *map(str, arguments)], capture_output=True, text=True)
    seconds, after = time.monotonic() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == code, done.stderr
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return seconds, spent, done.stdout + done.stderr


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    count = 60 if options.quick else 1000
    broken, figures = count // 20, {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sounds = folder / "speech"
        total = write_sounds(sounds, count)

        def note(name: str, seconds: float, spent: float, what: str) -> None:
            what = f"{what}; {spent:.0f} s of processor time"
            row = {"ours": seconds, "other": total, "ratio": total / seconds, "note": what}
            figures[name] = row
            report({name: row}, None)

        *cost, said = render(sounds, "--out", folder / "one", code=1)
        whole = results(folder / "one")
        reasons = [line for line in said.splitlines() if line.startswith("Failed: ")]
        assert (len(whole), len(reasons)) == (count - broken, broken), said[-3000:]
        print(f"{total:.0f} s of sound, {len(whole)} results and {len(reasons)} reasons, such as:")
        print("\n".join(line.replace(str(folder), "") for line in reasons[: min(10, broken)]))
        note("batch_one_worker", *cost, f"{count} files, {broken} broken, one process")

        *cost, said = render(sounds, "--out", folder / "one", code=1)
        records = (folder / "one" / ".gesturekit").glob("records/*/*.json")
        tried = sum(path.read_text().count('"failures": 2') for path in records)
        assert tried == broken, tried
        note("batch_again", *cost, f"the same command again: {broken} of {count} are tried")

        *cost, _ = render(sounds, "--workers", 2, "--out", folder / "two", code=1)
        assert results(folder / "two") == whole
        note("batch_two_workers", *cost, "--workers 2; same bytes")

        same_bytes(folder, sounds, whole)
    if options.json is not None:
        report(figures, options.json)


def same_bytes(folder: Path, sounds: Path, whole: dict[str, str]) -> None:
    """Compare an item alone, another order, Slurm's local launcher, and shards by hand."""
    rng = random.Random(0)
    listed = sounds / "listed.txt"  # a file of a list has its name in the folder, and its motion
    for name in rng.sample(sorted(whole), 3):
        shutil.rmtree(folder / "alone", ignore_errors=True)
        listed.write_text(str(Path(name).with_suffix(".wav")))
        render(listed, "--out", folder / "alone", code=0)
        assert results(folder / "alone") == {name: whole[name]}
    order = [str(path.relative_to(sounds)) for path in sounds.rglob("*.wav")]
    rng.shuffle(order)
    listed.write_text("\n".join(order))
    render(listed, "--out", folder / "shuffled", code=1)
    listed.unlink()
    assert results(folder / "shuffled") == whole
    print("same bytes: 3 items alone, and all in another order")
    slurm = ("--launcher", "slurm", "--jobs", 2, "--launcher-option", "cluster=local")
    render(sounds, *slurm, "--out", folder / "slurm", code=1)
    assert results(folder / "slurm") == whole
    print("same bytes: Slurm's local launcher, 2 jobs")

    numbers = rng.sample(range(1, SHARDS + 1), SHARDS)
    begin = time.monotonic()
    script = [sys.executable, "-c", BY_HAND.format(shards=SHARDS), sounds, folder / "shards"]
    parts = [",".join(map(str, numbers[start::PROCESSES])) for start in range(PROCESSES)]
    processes = [subprocess.Popen([*script, part]) for part in parts]
    assert [process.wait() for process in processes] == [0] * PROCESSES
    assert results(folder / "shards") == whole
    seconds = time.monotonic() - begin
    print(f"same bytes: {SHARDS} shards over {PROCESSES} processes, {seconds:.0f} s")


if __name__ == "__main__":
    main()
