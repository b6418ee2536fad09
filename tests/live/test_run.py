"""Whole runs on a model that moves by loudness: recordings, sinks, stalls, and how a run ends."""

from __future__ import annotations

import http.client
import io
import json
import os
import queue
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
from loud import LoudModel
from pages import bundled
from websockets.sync.client import connect

from audio_features import Wave
from gesturekit import systems
from gesturekit.live import runner, sources
from gesturekit.live import session as session_module
from gesturekit.live.recording import Recording
from gesturekit.live.runner import Report, Step, run
from gesturekit.live.session import Session
from gesturekit.live.sources import FileSource, PipeSource
from gesturekit.live.timeline import Block
from gesturekit.motion import Motion
from gesturekit.viewer.human.body import is_baked

MAIN = """
import sys, loud, gesturekit.systems
gesturekit.systems.load = lambda *_, **__: loud.LoudModel()
from gesturekit.cli import main
main(sys.argv[1:])
"""


@pytest.fixture
def live(gesturekit, monkeypatch):
    """live("--from", path, ...): run `gesturekit live` on the model that moves by loudness."""
    monkeypatch.setattr(systems, "load", lambda **_: LoudModel())
    return lambda *arguments: gesturekit("live", *arguments)


def start(source, sinks, stream=None) -> Report:
    """Run a source through the stream in this process."""
    report, warnings = Report(begun=time.perf_counter()), []
    stream = stream or LoudModel().stream(source.rate)
    run(stream, source, sinks, report=report, stopped=threading.Event(), warn=warnings.append)
    return report


class Kept:
    """A sink that keeps what it gets."""

    def __init__(self) -> None:
        self.steps, self.times = [], []

    def put(self, step) -> None:
        self.steps.append(step)
        self.times.append(time.monotonic())

    def close(self) -> None:
        pass

    @property
    def angles(self) -> np.ndarray:
        return np.concatenate([s.motion.rotations[:, :, 2].sum(1) for s in self.steps if s.motion])


def test_a_file_and_standard_input_give_the_same_bytes(live, write_speech, tmp_path, monkeypatch):
    speech = write_speech(tmp_path / "a.wav", 2.03)
    wave = Wave.load(speech)
    both = f"record:{tmp_path / 'file.bvh'},record:{tmp_path / 'file.npz'}"
    live("--from", speech, "--fast", "--to", both).ok()
    data = (wave.samples * 32768).astype("<i2").tobytes()
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(data)))
    done = live("--from", "-", "--fast", "--to", f"record:{tmp_path / 'pipe.bvh'}").ok()
    assert "2.0 s, 61 frames" in done.err  # 2.03 s * 30 + 1/2
    assert (tmp_path / "file.bvh").read_bytes() == (tmp_path / "pipe.bvh").read_bytes()
    for name in ("file.bvh", "file.npz"):
        assert Motion.load(tmp_path / name).n_frames == wave.n_frames(30)
    # Piped sound may be nowhere else, a file is.
    piped, _ = soundfile.read(tmp_path / "pipe.wav", dtype="int16")
    assert piped.tobytes() == data
    assert not (tmp_path / "file.wav").exists() and len(list(tmp_path.iterdir())) == 5


def test_a_file_in_real_time_moves_as_it_does_at_once(write_speech, tmp_path):
    speech, kept = write_speech(tmp_path / "a.wav", 0.7), {}
    for fast in (False, True):
        kept[fast] = Kept()
        report = start(FileSource(speech, 0.04, fast), [kept[fast]])
        timed = [step.lag is not None for step in kept[fast].steps]
        assert timed == [step.motion is not None and not fast for step in kept[fast].steps]
        if any(report.sound.values()):
            pytest.skip("this machine is too busy for real time")
    np.testing.assert_array_equal(kept[False].angles, kept[True].angles)
    # In real time, each frame comes when the sound .2 s beyond it is known, a block at a time.
    taken = [(step, at) for step, at in zip(kept[False].steps, kept[False].times) if step.motion]
    assert [s.time for s, _ in taken] == pytest.approx(
        np.cumsum([0, *(s.motion.n_frames / 30 for s, _ in taken[:-1])])
    )
    assert all(0.2 <= s.lag < 0.2 + 0.04 + 0.4 for s, _ in taken[:-1])
    assert taken[-2][1] - taken[0][1] == pytest.approx(taken[-2][0].time, abs=0.3)


class Blocked(Kept):
    def __init__(self) -> None:
        super().__init__()
        self.freed = threading.Event()

    def put(self, step) -> None:
        self.freed.wait(20)


class Failing(Kept):
    def put(self, step) -> None:
        raise OSError(28, "No space left on device")


def test_sinks_that_block_or_fail_slow_nobody(write_speech, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "_PATIENCE", 0.1)
    monkeypatch.setattr(runner, "_SINK_STEPS", 5)
    speech, kept, blocked = write_speech(tmp_path / "a.wav", 0.6), Kept(), Blocked()
    recording = Recording(tmp_path / "take.npz")
    report = start(FileSource(speech, 0.04, False), [blocked, Failing(), kept, recording])
    blocked.freed.set()
    if any(report.sound.values()):
        pytest.skip("this machine is too busy for real time")
    assert report.frames == 18 == Motion.load(tmp_path / "take.npz").n_frames
    assert sum(step.motion.n_frames for step in kept.steps if step.motion) == 18
    assert max(report.lags) < 1 and report.missed >= 9
    assert [line.split(":")[0] for line in report.failures] == ["Blocked", "Failing"]
    assert "No space left" in report.failures[1]


class Stalling:
    """Half a second of sound, nothing for as long, and the rest at its time."""

    rate, block, fast, tolerance, is_live, overflows = 16_000, 0.04, False, 0.02, True, 0

    def run(self, put, stopped) -> None:
        start = time.monotonic()
        for k in [*range(5), *range(30, 35)]:
            time.sleep(max(start + 0.04 * (k + 1) - time.monotonic(), 0))
            put(Block(np.full(640, 0.1, np.float32), start + 0.04 * k))


def test_the_stream_goes_on_while_its_source_stalls():
    kept = Kept()
    report = start(Stalling(), [kept])
    assert report.seconds == pytest.approx(1.4, abs=0.06)
    assert report.frames == pytest.approx(42, abs=2)
    assert report.sound["bridged"] >= 0.19 and 0.6 < report.sound["silent"] < 0.9
    frames = [at for step, at in zip(kept.steps, kept.times) if step.motion]
    assert np.diff(frames).max() < 0.4
    angles = kept.angles
    assert angles[6] < -0.15 and abs(angles[24]) < 1e-6 and angles[-2] < -0.1


class Pipe:
    """Seconds of sound, each block of .04 s to be had at its time after the start.

    Args:
        times: of each block, seconds.
    """

    def __init__(self, times: list[float]) -> None:
        self.times, self.start = times[::-1], time.monotonic()

    def read(self, size: int) -> bytes:
        if not self.times:
            return b""
        time.sleep(max(self.start + self.times.pop() - time.monotonic(), 0))
        return np.full(size // 2, 3000, "<i2").tobytes()


class Clock:
    """Stands in for the module `time`: nothing takes time but sleep."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.mark.parametrize("fast", [False, True])
def test_a_pipe_may_be_a_quarter_of_a_second_ahead_unless_it_is_fast(monkeypatch, fast):
    """Blocks of 40 ms, all there at once: from the seventh on, each waits for its time."""
    monkeypatch.setattr(sources, "time", clock := Clock())
    data, taken = np.arange(-3200, 3200, dtype="<i2").tobytes(), []
    pipe = PipeSource(io.BytesIO(data + b"odd"), 16_000, 0.04, fast)
    pipe.run(lambda block: taken.append((clock.now, block)), threading.Event())
    sound = np.concatenate([block.samples for _, block in taken])
    np.testing.assert_array_equal(sound[:-1] * 32768, np.arange(-3200, 3200))
    times = np.array([at for at, _ in taken])
    expected = (
        np.zeros(11) if fast else np.maximum([*np.arange(0.04, 0.41, 0.04), 0.4], 0.25) - 0.25
    )
    np.testing.assert_allclose(times, expected, atol=1e-3)
    begun = [block.time for _, block in taken]
    if fast:
        assert begun == [None] * 11
    else:
        np.testing.assert_allclose(begun[:10], times[:10] - 0.04)


def test_a_pipe_is_read_at_the_speed_of_speech_and_its_backlog_is_dropped():
    at_once = [0.0] * 15
    begun = time.monotonic()
    report = start(PipeSource(Pipe(at_once), 16_000, 0.04, False), [])
    assert time.monotonic() - begun > 0.6 - 0.25 - 0.05
    assert report.seconds == pytest.approx(0.6) and not any(report.sound.values())
    # It stalls for .7 s, and what was said meanwhile comes in one burst.
    stalled = [0.04, 0.08, *[0.8] * 18, *np.arange(0.84, 1.1, 0.04).tolist()]
    begun = time.monotonic()
    report = start(PipeSource(Pipe(stalled), 16_000, 0.04, False), [])
    assert report.sound["bridged"] > 0.1 and report.sound["dropped"] > 0.3
    assert report.seconds < time.monotonic() - begun + 0.25 + 0.1


def test_a_model_that_is_too_slow_drops_sound_and_stays_near_the_present(
    write_speech, tmp_path, monkeypatch
):
    """But it makes every frame of a file."""
    monkeypatch.setattr(sources, "QUEUE_SECONDS", 0.32)

    def slow(source, sinks) -> Report:
        stream = LoudModel().stream(16_000)
        step = stream.step
        stream.step = lambda samples: (time.sleep(2 * len(samples) / 16_000), step(samples))[1]
        return start(source, sinks, stream)

    report = slow(PipeSource(Pipe(np.arange(0.04, 1.21, 0.04).tolist()), 16_000, 0.04, False), [])
    assert report.sound["dropped"] > 0.2
    assert f"{report.sound['dropped']:.2f} s of sound dropped" in report.line()
    # The look-ahead, and what waits, at half the speed; all sound would be 1.4 s late at the end.
    assert max(report.lags) < 0.2 + 2 * 0.32 + 0.3
    recording = Recording(tmp_path / "take.npz")
    report = slow(FileSource(write_speech(tmp_path / "a.wav", 1.2), 0.04, False), [recording])
    assert not any(report.sound.values()) and "dropped" not in report.line()
    assert report.frames == 36 == Motion.load(tmp_path / "take.npz").n_frames


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGKILL])
def test_ctrl_c_leaves_a_whole_recording_and_a_kill_a_partial_one(gesturekit, tmp_path, ended_by):
    out = tmp_path / "out.bvh"
    arguments = ["live", "--from", "-", "--to", f"record:{out}", "--seed", "3"]
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, *arguments],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    sound = np.full(1600, 3000, "<i2").tobytes()
    deadline = time.monotonic() + 30
    while not any(file.stat().st_size > 20_000 for file in tmp_path.glob("out_bvh_partial.wav")):
        assert time.monotonic() < deadline and process.poll() is None, process.stderr.read()
        process.stdin.write(sound)
        process.stdin.flush()
        time.sleep(0.02)
    process.send_signal(ended_by)
    _, said = process.communicate(timeout=30)
    if ended_by == signal.SIGKILL:
        partial = tmp_path / "out_bvh_partial.frames"
        assert {file.name for file in tmp_path.iterdir()} == {partial.name, "out_bvh_partial.wav"}
        gesturekit("live", *arguments[1:]).fails(2, "out_bvh_partial.frames exists already")
        gesturekit("convert", partial, out).ok()
        seconds = Wave.load(tmp_path / "out_bvh_partial.wav").duration
        assert Motion.load(out).duration == pytest.approx(seconds - 0.2, abs=0.2)
        return
    assert process.returncode == 130, said
    wave = Wave.load(tmp_path / "out.wav")
    assert Motion.load(out).n_frames == wave.n_frames(30) > 15
    assert f"{wave.n_frames(30)} frames" in said.decode() and b"Traceback" not in said
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out.bvh", "out.wav"]


def test_a_full_disk_ends_the_run_and_leaves_what_came_until_then(gesturekit, tmp_path):
    """A limit on the size of files fails as a full disk does; the sound goes on for ever."""
    out = tmp_path / "take.npz"
    arguments = ["live", "--from", "-", "--fast", "--to", f"record:{out}"]
    with Path("/dev/zero").open("rb") as silence:
        done = subprocess.run(
            [sys.executable, "-c", MAIN, *arguments],
            stdin=silence,
            capture_output=True,
            text=True,
            timeout=60,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000)),
        )
    partial, sound = tmp_path / "take_npz_partial.frames", tmp_path / "take_npz_partial.wav"
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert f"take.npz: File too large; {partial} and {sound} hold" in done.stderr
    assert {file.name for file in tmp_path.iterdir()} == {partial.name, sound.name}
    gesturekit("convert", partial, out).ok()
    motion = Motion.load(out)
    assert 290_000 < motion.n_frames * 8 * (3 + 4 * motion.skeleton.n_joints) < 300_000
    assert Wave.load(sound).duration == pytest.approx(motion.duration + 0.2, abs=0.1)


def test_figures_of_a_run_are_a_table_and_json(live, write_speech, tmp_path):
    speech, figures = write_speech(tmp_path / "a.wav", 0.6), tmp_path / "f.json"
    done = live("--measure", "--from", speech, "--json", figures, "--look-ahead", "0.1").ok()
    found = json.loads(figures.read_text())
    assert found["algorithmic_latency"] == pytest.approx(0.1 + 0.04)
    # At 30 fps; on a busy machine a part of the sound may be late.
    assert found["sound"] == pytest.approx(0.6, abs=0.1)
    assert found["frames"] == pytest.approx(30 * found["sound"], abs=1)
    assert 0 < found["step_p50"] <= found["step_p95"] <= found["step_max"] < 0.6
    assert 0 < found["real_time_factor"] < 1 and 0.1 < found["load_to_first_pose"] < 3
    assert 0.1 <= found["lag_p50"] <= found["lag_max"] and 0 < found["arrival_jitter"] < 0.2
    for name in found:
        assert name.replace("_", " ") in done.out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--from", "no_such.wav"], "no_such.wav"),
        (["--from", "{wav}", "--to", "wall"], "--to wall: no such sink; expected page, vmc:"),
        (["--from", "{wav}", "--to", "vmc:here"], "--to vmc:here: expected vmc:HOST:PORT"),
        (["--from", "{wav}", "--to", "vmc:1.2.3.4:99999"], "expected vmc:HOST:PORT"),
        (["--from", "{wav}", "--to", "record:a.xyz"], "a.xyz: cannot write motion as .xyz"),
        (["--from", "{wav}", "--to", "record:a.fbx"], "a.fbx: FBX needs Blender"),
        (["{wav}", "record:a.bvh"], "sound is given by --from, and outputs by --to"),
        (
            ["--from", "{wav}", "--to", "record:{wav}.bvh", "--block", "9"],
            "9.0 is not in the range",
        ),
        (
            ["--from", "{wav}", "--to", "page", "--host", "192.0.2.1"],
            "give a token",
        ),
        (
            ["--from", "-", "--to", "record:{wav}.bvh,vmc:no.such.host.invalid:39539"],
            "no.such.host",
        ),
        (["--fast"], "--fast is for files and pipes"),
    ],
)
def test_wrong_arguments_are_one_clear_error(
    live, write_speech, tmp_path, monkeypatch, arguments, says
):
    monkeypatch.setenv("PATH", "")  # no Blender
    wav = write_speech(tmp_path / "a.wav", 0.1)
    done = live(*(str(each).replace("{wav}", str(wav)) for each in arguments))
    done.fails(2, says)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.wav"]


def test_a_recording_that_exists_is_not_overwritten(live, write_speech, tmp_path):
    wav, out = write_speech(tmp_path / "a.wav", 0.1), tmp_path / "b.bvh"
    out.write_text("mine")
    live("--from", wav, "--to", f"record:{out}").fails(2, "b.bvh exists already")
    assert out.read_text() == "mine"


@pytest.mark.parametrize(("signals", "says"), [(1, "0.0 s, 0 frames"), (2, "0.0 s"), (3, "")])
def test_the_third_ctrl_c_ends_at_once(
    gesturekit, monkeypatch, write_speech, tmp_path, signals, says
):
    def load(**_) -> LoudModel:
        for _ in range(signals):
            signal.raise_signal(signal.SIGTERM)
        return LoudModel()

    monkeypatch.setattr(systems, "load", load)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    wav = write_speech(tmp_path / "a.wav", 0.5)
    done = gesturekit("live", "--from", wav, "--to", f"record:{tmp_path / 'a.bvh'}")
    assert done.status == 130 and ("Interrupted" in done.err) == (signals == 3)
    assert says in done.err
    after = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert after == before


def test_a_pipe_without_sound_records_nothing(live, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO()))
    done = live("--from", "-", "--fast", "--to", f"record:{tmp_path / 'a.bvh'}")
    done.fails(1, "a.bvh: nothing to record, as no sound came", "0.0 s, 0 frames")
    assert not list(Path(tmp_path).iterdir())


def test_a_recording_keeps_joints_that_move_on_their_own(skeleton, tmp_path):
    """Rigs such as Bandai-Namco's carry the body by a joint below a still root."""
    rng = np.random.default_rng(0)
    turns = rng.standard_normal((7, skeleton.n_joints, 4))
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    moving = {name: rng.standard_normal((7, 3)) for name in skeleton.names[1:3]}
    whole = Motion(skeleton, turns, rng.standard_normal((7, 3)), 30.0, moving)
    recording = Recording(tmp_path / "take.npz")
    for first, last in ((0, 2), (2, 3), (3, 7)):
        recording.put(Step(np.zeros(0, np.float32), whole[first:last], first / 30, None))
    recording.put(Step(np.zeros(9, np.float32), None, 7 / 30, None))
    recording.close()
    found = Motion.load(tmp_path / "take.npz")
    np.testing.assert_allclose(found.positions(), whole.positions(), atol=1e-6)
    assert found.joint_translations.keys() == moving.keys()


def test_figures_of_a_run_of_days_take_no_more_memory():
    report = Report(begun=0.0)
    for _ in range(200_000):
        report.timed(lambda: None)
        report.arrived(0.0)
    assert len(report.steps) == len(report.lags) < 200_000


def test_the_figures_of_a_run_are_those_of_its_steps(monkeypatch):
    """Steps take 1, 2, 3, 4 and 5 s; the first makes no frame."""
    clock = SimpleNamespace(now=10.0)
    clock.perf_counter = clock.monotonic = lambda: clock.now
    monkeypatch.setattr(runner, "time", clock)
    report = Report(begun=8.0)
    assert report.figures()["step_p50"] is None and report.figures()["arrival_jitter"] is None
    assert report.figures()["real_time_factor"] is None and report.line() == "0.0 s, 0 frames"
    motion = LoudModel().generate(seconds=0.1)

    def work(seconds: float, result: Motion | None) -> Motion | None:
        clock.now += seconds
        return result

    for seconds in (1.0, 2.0, 3.0, 4.0, 5.0):
        result = None if seconds == 1 else motion
        assert report.timed(lambda: work(seconds, result)) is result  # noqa: B023
    assert report.arrived(None) is None and not report.lags
    assert [report.arrived(clock.now - lag) for lag in (0.5, 0.25, 1.25)] == [0.5, 0.25, 1.25]
    report.seconds, report.latency, report.overflows, report.missed = 7.5, 0.25, 1, 2
    report.sound = {"bridged": 0.005, "silent": 0.004, "dropped": 1.5, "skipped": 0.0}
    assert report.figures() == pytest.approx(
        {
            **{"sound": 7.5, "frames": 12, "algorithmic_latency": 0.25, "load_to_first_pose": 5.0},
            **{"real_time_factor": 2.0, "step_p50": 3.0, "step_p95": 4.8, "step_max": 5.0},
            **{"lag_p50": 0.5, "lag_p95": 1.175, "lag_max": 1.25, "arrival_jitter": 1.175 - 0.275},
            **{"bridged": 0.005, "silent": 0.004, "dropped": 1.5, "skipped": 0.0},
            **{"overflows": 1, "steps_missed_by_sinks": 2},
        }
    )
    assert report.line() == (
        "7.5 s, 12 frames, worst lag 1.25 s, 0.01 s of sound bridged, "
        "1.50 s of sound dropped, 1 overflow, "
        "2 steps missed by a sink"
    )


def test_a_sink_that_cannot_end_is_a_failure_and_the_others_end(write_speech, tmp_path):
    class Unending(Kept):
        def close(self) -> None:
            raise OSError(28, "No space left on device")

    class Closed(Kept):
        is_closed = False

        def close(self) -> None:
            self.is_closed = True

    closed, failing = Closed(), Failing()
    speech = write_speech(tmp_path / "a.wav", 0.5)
    report = start(FileSource(speech, 0.04, True), [Unending(), failing, closed])
    assert report.failures == [
        "Unending: [Errno 28] No space left on device",
        "Failing: [Errno 28] No space left on device",
    ]
    assert closed.is_closed and report.missed == 0 and not report.lags
    assert sum(len(step.samples) for step in closed.steps) == 8000


def test_a_run_that_is_stopped_ends_with_the_sound_that_it_got(write_speech, tmp_path):
    stopped, report = threading.Event(), Report(begun=0.0)
    source = FileSource(write_speech(tmp_path / "a.wav", 2.0), 0.04, False)

    class Stopping(Kept):
        def put(self, step) -> None:
            super().put(step)
            stopped.set()

    kept = Stopping()
    stream = LoudModel().stream(source.rate)
    run(stream, source, [kept], report=report, stopped=stopped, warn=print)
    assert 0.04 <= report.seconds < 1 and report.frames == round(report.seconds * 30 + 1e-6)
    assert not kept.steps[-1].samples.size and kept.steps[-1].motion is not None


def test_an_error_of_the_source_ends_the_run_and_its_recording(tmp_path):
    class Unplugged(Stalling):
        def run(self, put, stopped) -> None:
            for _ in range(10):
                put(Block(np.zeros(640, np.float32), None))
            raise OSError("unplugged")

    source = Unplugged()
    source.fast = True
    recording = Recording(tmp_path / "new" / "take.npz", 16_000)
    with pytest.raises(OSError, match="unplugged"):
        start(source, [recording])
    assert Motion.load(tmp_path / "new" / "take.npz").n_frames == 7  # 0.4 s, 0.2 s ahead
    assert soundfile.info(tmp_path / "new" / "take.wav").frames == 6400


def test_frames_of_a_recording_lie_beside_it_until_its_end(tmp_path, monkeypatch):
    """The folder for temporary files may be in memory, which hours of motion would fill."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    recording = Recording(tmp_path / "take.npz")
    motion = LoudModel().generate(seconds=0.1)
    recording.put(Step(np.zeros(0, np.float32), motion, 0.0, None))
    recording.close()
    assert Motion.load(tmp_path / "take.npz").n_frames == 3
    assert [path.name for path in tmp_path.iterdir()] == ["take.npz"]


@pytest.mark.skipif(not is_baked(), reason="the human body is not baked: `make setup`")
def test_a_program_beside_gets_the_frames_of_a_file(live, write_speech, tmp_path):
    wav = write_speech(tmp_path / "a.wav", 0.5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(5)
        port = reader.getsockname()[1]
        live("--from", wav, "--fast", "--to", f"vmc:127.0.0.1:{port}").ok()
        assert all(reader.recv(1 << 16).startswith(b"#bundle") for _ in range(15))
    for place in (":39539", "h:0", "h:65536", "h:x", "::"):
        done = live("--from", wav, "--to", f"vmc:{place}")
        done.fails(2, f"--to vmc:{place}: expected vmc:HOST:PORT")


@bundled
@pytest.mark.skipif(not is_baked(), reason="the human body is not baked: `make setup`")
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_page_is_served_while_sound_comes(host, tmp_path):
    """On an address of this machine only it is only reached by names of this machine."""
    token = tmp_path / "token"
    token.write_text("0123456789abcdef")
    said, stopped = queue.Queue(), threading.Event()
    read, write = os.pipe()
    about = {"look_ahead": 0.2, "seed": 0, "fast": True, "block": 0.04, "rate": 16_000}
    about |= {"host": host, "port": 0, "body": "mannequin", "framing": "waist"}
    about |= {"token_file": None if host == "127.0.0.1" else token}
    session = Session(source="-", sinks=("page",), say=said.put, **about)
    report = Report(begun=0.0)

    def serve() -> None:
        with os.fdopen(read, "rb") as pipe, pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "stdin", SimpleNamespace(buffer=pipe))
            session.run(LoudModel, report, stopped)

    thread = threading.Thread(target=serve)
    thread.start()
    place = re.fullmatch(
        rf"Page at http://{re.escape(host)}:(\d+)/ \(end with Ctrl-C\)(; asks for the token.*)?",
        said.get(timeout=20),
    )
    assert (place[2] is None) == (host == "127.0.0.1")
    for name, status in (("localhost", 200), ("else.where", 400 if host == "127.0.0.1" else 200)):
        asked = http.client.HTTPConnection("127.0.0.1", int(place[1]), timeout=5)
        asked.request("GET", "/?token=0123456789abcdef", headers={"Host": name})
        answer = asked.getresponse()
        assert answer.status == status
        text = answer.read().decode()
        asked.close()
        if name == "localhost":
            page = json.loads(re.search(r'json" id="motion">(.*?)</script>', text, re.S)[1])
            assert page["live"]["n_joints"] == LoudModel().skeleton.n_joints
            assert page["below"] > 0.5  # metres of the legs, which are not shown
            assert "audio" not in page, "a microphone would hear itself"
            assert answer.getheader("X-Content-Type-Options") == "nosniff"
    os.close(write)
    thread.join(20)
    assert not thread.is_alive() and report.latency == pytest.approx(0.24)


@bundled
@pytest.mark.parametrize("is_opened", [True, False])
def test_a_file_starts_when_its_page_is_open_or_after_a_while(
    write_speech, tmp_path, monkeypatch, is_opened
):
    speech, said = write_speech(tmp_path / "a.wav", 0.5), queue.Queue()
    monkeypatch.setattr(session_module, "_PAGE_SECONDS", 30 if is_opened else 1)
    about = {"look_ahead": 0.2, "seed": 0, "fast": False, "block": 0.04, "rate": 16_000}
    about |= {"host": "127.0.0.1", "port": 0, "body": "mannequin", "say": said.put}
    session = Session(source=str(speech), sinks=("page",), **about)
    report = Report(begun=0.0)
    thread = threading.Thread(target=session.run, args=(LoudModel, report, threading.Event()))
    thread.start()
    port = re.search(r":(\d+)/ .*starts when it is open", said.get(timeout=20))[1]
    time.sleep(0.4)
    assert report.frames == 0
    if is_opened:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            assert '"audio":' in answer.read().decode()
        with connect(f"ws://127.0.0.1:{port}/stream") as client:
            times = [np.frombuffer(message[:8])[0] for message in client]
        np.testing.assert_allclose(times, np.arange(15) / 30, atol=1e-9)
    thread.join(20)
    assert not thread.is_alive() and report.frames == 15
