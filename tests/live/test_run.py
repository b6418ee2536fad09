"""Whole runs on a model that moves by loudness: recordings, sinks, stalls, and how a run ends."""

import io
import json
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
from loud import LoudModel
from pages import bundled
from websockets.sync.client import connect

from audio_features import Wave
from gesturekit import systems
from gesturekit.face import EnergyFace
from gesturekit.live import FileSource, Recording, Report, Step, run
from gesturekit.live.session import Session
from gesturekit.live.sources import Block, PipeSource
from gesturekit.motion import Motion
from gesturekit.viewer.human import load_human

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
    assert "61 frames" in done.err  # 2.03 s * 30 + 1/2
    assert (tmp_path / "file.bvh").read_bytes() == (tmp_path / "pipe.bvh").read_bytes()
    for name in ("file.bvh", "file.npz"):
        assert Motion.load(tmp_path / name).n_frames == wave.n_frames(30)
    # Piped sound may be nowhere else, a file is.
    piped, _ = soundfile.read(tmp_path / "pipe.wav", dtype="int16")
    assert piped.tobytes() == data
    assert not (tmp_path / "file.wav").exists() and len(list(tmp_path.iterdir())) == 5


class Failing(Kept):
    """A sink that fails while it gets frames, or at its end."""

    def __init__(self, at_its_end: bool) -> None:
        super().__init__()
        self.at_its_end = at_its_end

    def put(self, step) -> None:
        self._fail(not self.at_its_end)

    def close(self) -> None:
        self._fail(self.at_its_end)

    def _fail(self, is_now: bool) -> None:
        if is_now:
            raise OSError(28, "No space left on device")


class Blocked(Kept):
    def put(self, step) -> None:
        time.sleep(0.2)


def test_sinks_that_block_or_fail_slow_nobody(write_speech, tmp_path):
    speech, kept = write_speech(tmp_path / "a.wav", 0.3), Kept()
    recording = Recording(tmp_path / "take.npz")
    sinks = [Blocked(), Failing(False), Failing(True), kept, recording]
    report = start(FileSource(speech, 0.04, False), sinks)
    assert kept.times[-1] - kept.times[0] < 1
    assert sum(step.motion.n_frames for step in kept.steps if step.motion) == report.frames
    assert report.frames == Motion.load(tmp_path / "take.npz").n_frames >= 8
    failed = [line for line in report.failures if "Failing" in line]
    assert len(failed) == 2 and all("No space left" in line for line in failed)


def test_a_model_that_is_too_slow_drops_sound_but_makes_every_frame_of_a_file(
    write_speech, tmp_path
):
    def slow(source, sinks) -> Report:
        stream = LoudModel().stream(16_000)
        step = stream.step
        stream.step = lambda samples: (time.sleep(3 * len(samples) / 16_000), step(samples))[1]
        return start(source, sinks, stream)

    report = slow(PipeSource(Pipe(np.arange(0.04, 1.05, 0.04).tolist()), 16_000, 0.04, False), [])
    assert report.sound["dropped"] > 0.1
    said = [float(number) for number in re.findall(r"\d+\.\d+", report.line())]
    assert any(number == pytest.approx(report.sound["dropped"], abs=0.06) for number in said)
    recording = Recording(tmp_path / "take.npz")
    report = slow(FileSource(write_speech(tmp_path / "a.wav", 0.2), 0.04, False), [recording])
    assert not any(report.sound.values())
    assert report.frames == 6 == Motion.load(tmp_path / "take.npz").n_frames


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--from", "no_such.wav"], "no_such.wav"),
        (["--from", "{wav}", "--to", "wall"], "--to wall"),
        (["--from", "{wav}", "--to", "vmc:1.2.3.4:99999"], "vmc:HOST:PORT"),
        (["--from", "{wav}", "--to", "vmc:h:x"], "vmc:HOST:PORT"),
        (["--from", "{wav}", "--to", "record:a.xyz"], ".xyz"),
        (["{wav}", "record:a.bvh"], "--from"),
        (["--from", "{wav}", "--to", "page", "--host", "192.0.2.1"], "token"),
        (["--from", "-", "--to", "vmc:no.such.host.invalid:39539"], "no.such.host"),
        (["--from", "{wav}", "--to", "record:{wav}"], "a.wav"),
        (["--fast"], "--fast"),
    ],
)
def test_wrong_arguments_are_one_clear_error(live, write_speech, tmp_path, arguments, says):
    wav = write_speech(tmp_path / "a.wav", 0.1)
    before = wav.read_bytes()
    done = live(*(str(each).replace("{wav}", str(wav)) for each in arguments))
    done.fails(2, says)
    assert [file.name for file in tmp_path.iterdir()] == ["a.wav"] and wav.read_bytes() == before


def test_a_recording_is_neither_overwritten_nor_made_of_nothing(live, write_speech, tmp_path):
    wav, out = write_speech(tmp_path / "a.wav", 0.1), tmp_path / "b.bvh"
    out.write_text("mine")
    live("--from", wav, "--to", f"record:{out}").fails(2, "b.bvh")
    assert out.read_text() == "mine"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO()))
        done = live("--from", "-", "--fast", "--to", f"record:{tmp_path / 'c.bvh'}")
    done.fails(1, "c.bvh")
    assert not (tmp_path / "c.bvh").exists()


@pytest.mark.parametrize("signals", [1, 3])
def test_the_third_ctrl_c_ends_at_once(gesturekit, monkeypatch, write_speech, tmp_path, signals):
    def load(**_) -> LoudModel:
        for _ in range(signals):
            signal.raise_signal(signal.SIGTERM)
        return LoudModel()

    monkeypatch.setattr(systems, "load", load)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    wav = write_speech(tmp_path / "a.wav", 0.5)
    done = gesturekit("live", "--from", wav, "--to", f"record:{tmp_path / 'a.bvh'}")
    assert done.status == 130 and ("Interrupted" in done.err) == (signals == 3)
    after = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    assert after == before


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


@pytest.mark.parametrize(
    "ended_by", [pytest.param(signal.SIGINT, marks=pytest.mark.stress), signal.SIGKILL]
)
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
        gesturekit("live", *arguments[1:]).fails(2, "out_bvh_partial.frames")
        gesturekit("convert", partial, out).ok()
        seconds = Wave.load(tmp_path / "out_bvh_partial.wav").duration
        assert Motion.load(out).duration == pytest.approx(seconds - 0.2, abs=0.2)
        return
    assert process.returncode == 130, said
    wave = Wave.load(tmp_path / "out.wav")
    assert Motion.load(out).n_frames == wave.n_frames(30) > 15
    assert f"{wave.n_frames(30)} frames" in said.decode() and b"Traceback" not in said
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out.bvh", "out.wav"]


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
    assert "latency" in done.out and "lag" in done.out


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


def test_an_error_of_the_source_ends_the_run_and_its_recording(tmp_path):
    class Unplugged(Stalling):
        def run(self, put, stopped) -> None:
            for _ in range(10):
                put(Block(np.zeros(640, np.float32), None))
            raise OSError("unplugged")

    source = Unplugged()
    source.fast = True
    recording = Recording(tmp_path / "new" / "deep" / "take.npz", 16_000)
    with pytest.raises(OSError, match="unplugged"):
        start(source, [recording])
    assert Motion.load(tmp_path / "new" / "deep" / "take.npz").n_frames == 7  # 0.4 s, 0.2 s ahead
    assert soundfile.info(tmp_path / "new" / "deep" / "take.wav").frames == 6400


def test_a_program_beside_gets_the_frames_of_a_file(live, write_speech, tmp_path):
    wav = write_speech(tmp_path / "a.wav", 0.5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(5)
        port = reader.getsockname()[1]
        live("--from", wav, "--fast", "--to", f"vmc:127.0.0.1:{port}").ok()
        assert all(reader.recv(1 << 16).startswith(b"#bundle") for _ in range(15))


@bundled
@pytest.mark.parametrize("face", ["energy", "off"])
def test_a_file_starts_when_its_page_is_open(write_speech, tmp_path, face):
    speech, said = write_speech(tmp_path / "a.wav", 0.5), queue.Queue()
    about = {"look_ahead": 0.2, "seed": 0, "fast": False, "block": 0.04, "rate": 16_000}
    about |= {"host": "127.0.0.1", "port": 0, "face": face, "say": said.put}
    session = Session(source=str(speech), sinks=("page",), **about)
    report = Report(begun=0.0)
    thread = threading.Thread(target=session.run, args=(LoudModel, report, threading.Event()))
    thread.start()
    port = re.search(r":(\d+)/", said.get(timeout=20))[1]
    time.sleep(0.2)
    assert report.frames == 0
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
        page = answer.read().decode()
    assert '"audio":' in page and '"n_joints":' in page
    assert answer.getheader("X-Content-Type-Options") == "nosniff"
    with connect(f"ws://127.0.0.1:{port}/stream") as client:
        messages = list(client)
    times = [np.frombuffer(message[:8])[0] for message in messages]
    # A frame has its time and lag, a position, rotations and the face's channels.
    n_channels = (len(messages[0]) - 16) // 4 - 3 - 4 * load_human()[0].n_joints
    assert n_channels == (len(EnergyFace.names) if face == "energy" else 0)
    np.testing.assert_allclose(times, np.arange(15) / 30, atol=1e-9)
    thread.join(20)
    assert not thread.is_alive() and report.frames == 15
