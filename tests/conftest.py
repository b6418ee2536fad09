"""What every test may use: real recordings where they are, and small ones made on the spot."""

from __future__ import annotations

import gc
import io
import os
import re
import shutil
import socket
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import soundfile
from bodies import body_of_tubes
from chromium import Browser
from hypothesis import settings
from rigs import PERSON, QUADRUPED, rig_of
from scipy.spatial.transform import Rotation
from sounds import voiced

from gesturekit.motion import Motion, Skeleton

# Examples follow from the test alone: a run on another day finds no other failure.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")

NEVER_SKIPPED_IN_CI = ("Chromium", "smplx", "ffmpeg")


def pytest_configure(config: pytest.Config) -> None:
    """Hide GPUs from all tests but those marked `cuda`, so that the others are alike everywhere."""
    asked = config.option.markexpr
    if "cuda" not in asked or "not cuda" in asked:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""


def pytest_collection_finish(session: pytest.Session) -> None:
    """Keep what was imported out of garbage collection, which would visit it again and again."""
    gc.collect()
    gc.freeze()


def pytest_make_parametrize_id(val: object, argname: str) -> str | None:
    """Return the argument's name for the bytes of a file, which may hold the time of writing."""
    return argname if isinstance(val, bytes) and len(val) > 50 else None


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where continuous integration has a tool and its tests were skipped all the same."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if "GESTUREKIT_SKIP_IS_FAILURE" not in os.environ or reporter is None:
        return
    reasons = {report.longrepr[2] for report in reporter.stats.get("skipped", [])}
    wrong = [reason for reason in reasons if any(tool in reason for tool in NEVER_SKIPPED_IN_CI)]
    if wrong:
        reporter.write_line(f"Skipped, though it must run here: {'; '.join(wrong)}", red=True)
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings that lies beside a developer's checkout."""
    if not SHARED_DATA.is_dir():
        pytest.skip("real recordings not found at ../shared/data")
    return SHARED_DATA


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory) -> Iterator[None]:
    """Tests, and the processes they start, keep out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GESTUREKIT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_usual_encoding() -> Iterator[None]:
    """Text of ours is UTF-8, as on systems on which it is not the usual encoding."""
    usual, root = io.text_encoding, Path(__file__).resolve().parents[1]
    ours = (str(root / "gesturekit"), str(root / "audio_features"))

    def checked(encoding: str | None, stacklevel: int = 2) -> str:
        # Above this one: the function of pathlib, and who called it.
        caller = sys._getframe(2).f_code.co_filename
        assert encoding is not None or not caller.startswith(ours), f"{caller}: no encoding"
        return usual(encoding, stacklevel)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(io, "text_encoding", checked)
        yield


REAL_GPU = pytest.param("cuda", marks=pytest.mark.cuda)


def skip_without_gpu(name: str) -> None:
    """Skip a test on a real GPU where there is none."""
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU: torch.cuda.is_available() is false")


@pytest.fixture(params=["cpu", REAL_GPU])
def device(request) -> str:
    """The CPU, or a real GPU for tests that start processes of their own."""
    skip_without_gpu(request.param)
    return request.param


@pytest.fixture(params=["simulated", REAL_GPU])
def gpu(request) -> Iterator[str]:
    """A GPU, the device "cuda": "simulated" (see `SimulatedGPU`), so that every run of the tests
    takes the GPU's way through the code, or "cuda", a real one.
    """
    import torch
    from simulated_gpu import SimulatedGPU

    skip_without_gpu(request.param)
    is_real = request.param == "cuda"
    with pytest.MonkeyPatch.context() as patch:
        # What the first use of a GPU sets for good.
        patch.setenv("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        patch.setattr(torch.backends.cudnn, "allow_tf32", torch.backends.cudnn.allow_tf32)
        patch.setattr(torch.utils.deterministic, "fill_uninitialized_memory", True)
        if not is_real:  # torch refuses autocast for a GPU that it does not see
            real = torch.autocast
            patch.setattr(torch, "autocast", lambda _, *args, **kw: real("cpu", *args, **kw))
        with nullcontext() if is_real else SimulatedGPU():
            yield request.param
        torch.use_deterministic_algorithms(False)


@pytest.fixture
def wavlm_devices(monkeypatch) -> set[str]:
    """The kinds of devices on which WavLM has computed in this test."""
    import audio_features as af

    used, own = set(), af.WavLM.hidden_states

    def hidden_states(self, samples):
        used.add(self._device.type)
        return own(self, samples)

    monkeypatch.setattr(af.WavLM, "hidden_states", hidden_states)
    return used


class Done(NamedTuple):
    """Exit status and output of a command."""

    status: int
    out: str
    err: str

    def ok(self) -> Done:
        """Return the same, of a command that must have succeeded."""
        assert self.status == 0, self.err
        return self

    def fails(self, status: int, *says: str) -> Done:
        """Return the same, of a command that must have failed with these words."""
        assert self.status == status, self.err
        for text in says:
            assert text in self.err, self.err
        assert "Traceback" not in self.err
        return self


@pytest.fixture
def gesturekit(capsys) -> Callable[..., Done]:
    """gesturekit("render", path, ...): run a command here and say how it ended."""
    from gesturekit.cli import main

    def run(*arguments: object) -> Done:
        capsys.readouterr()
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments])
        return Done(left.value.code, *capsys.readouterr())

    return run


@pytest.fixture(scope="session")
def skeleton() -> Skeleton:
    return rig_of(
        PERSON,
        end_sites={
            "Head": (np.array([0.0, 0.15, 0.0]),),
            "LeftHand": (np.array([0.1, 0.0, 0.0]),),
            "RightHand": (np.array([-0.1, 0.0, 0.0]),),
            "LeftFoot": (np.array([0.0, -0.05, 0.15]),),
            "RightFoot": (np.array([0.0, -0.05, 0.15]),),
        },
        rotation_orders=("ZXY",) * len(PERSON),
    )


@pytest.fixture(scope="session")
def quadruped() -> Skeleton:
    return rig_of(QUADRUPED)


@pytest.fixture(scope="session")
def gesture(skeleton: Skeleton) -> Callable[..., Motion]:
    """gesture(seconds, fps=30, t_pose=0, seed=0): arms hang and swing, after a held T-pose."""

    def make(seconds: float, fps: float = 30.0, *, t_pose: int = 0, seed: int = 0) -> Motion:
        n = int(np.floor(seconds * fps + 0.5))
        time = np.arange(n) / fps
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (skeleton.n_joints, 3))
        angles = 0.15 * np.sin(2.0 * np.pi * 0.7 * time[:, None, None] + phase)
        angles[:, skeleton.index("LeftArm"), 2] -= 1.3
        angles[:, skeleton.index("RightArm"), 2] += 1.3
        angles[:t_pose] = 0.0
        rotations = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_quat()
        return Motion(
            skeleton,
            rotations.reshape(n, skeleton.n_joints, 4),
            np.tile([0.0, 0.9, 0.0], (n, 1)),
            fps,
        )

    return make


@pytest.fixture(scope="session")
def save_as_others() -> Callable[..., Path]:
    """save_as_others(motion, path, **options): a BVH without our mark, as other programs write."""

    def write(motion: Motion, path: Path, **options: Any) -> Path:
        motion.save(path, **options)
        text = path.read_text(encoding="utf-8")
        zeros = re.compile(r"(?<=OFFSET) 0[.0 ]+$", re.MULTILINE)
        path.write_text(zeros.sub(" 0 0 0", text, count=1), encoding="utf-8")
        return path

    return write


def named(path: Path) -> int:
    """Return 32 bits made of the name of a file and of its folder."""
    return zlib.crc32(f"{path.parent.name}/{path.name}".encode())


@pytest.fixture(scope="session")
def write_speech() -> Callable[..., Path]:
    """write_speech(path, seconds, rate=16000): a voice in syllables of a fifth of a second."""

    def write(path: Path, seconds: float, rate: int = 16000, *, level: float = 0.2) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        samples = level * voiced(seconds, rate)
        samples[:2] = (
            level * np.array(divmod(named(path) % 4096, 64)) / 256
        )  # no two files are copies
        soundfile.write(path, samples, rate)
        return path

    return write


@pytest.fixture(scope="session")
def write_pair(gesture, write_speech) -> Callable[..., tuple[Path, Path]]:
    """write_pair(folder, stem, seconds=4): STEM.wav and STEM.bvh that belong together."""

    def write(folder: Path, stem: str, seconds: float = 4.0, **options) -> tuple[Path, Path]:
        audio = write_speech(folder / f"{stem}.wav", seconds)
        motion = folder / f"{stem}.bvh"
        gesture(seconds, **options).save(motion)
        with motion.open("a") as file:  # no two files are copies
            file.write(f"{named(motion):032b}".translate({48: " ", 49: "\n"}))
        return audio, motion

    return write


@pytest.fixture(scope="session")
def corpus(tmp_path_factory, write_pair, write_speech) -> Path:
    """A manifest of two recordings of different lengths (4 and 2.5 s) and unpaired speech."""
    from gesturekit.corpus import prepare

    folder = tmp_path_factory.mktemp("corpus")
    write_pair(folder / "paired", "a", 4.0, seed=1)
    write_pair(folder / "paired", "b", 2.5, seed=2)
    write_speech(folder / "more" / "c.wav", 5.0, level=0.1)
    manifest = folder / "corpus.jsonl"
    prepare([folder / "paired"], manifest, unpaired=[folder / "more"], holdout=0.0)
    return manifest


@pytest.fixture(scope="session")
def quick_corpus(corpus, write_pair) -> Path:
    """The same with half a second held out, on which models are measured in no time."""
    from gesturekit.corpus import Item, Manifest

    audio, motion = write_pair(corpus.parent / "held_out", "d", 0.5, seed=3)
    held_out = Item(id="d", audio=audio, motion=motion, duration=0.5, split="test")
    manifest = corpus.with_name("quick.jsonl")
    Manifest([*Manifest.load(corpus), held_out]).save(manifest)
    return manifest


@pytest.fixture(scope="session")
def write_wavlm() -> Callable[..., Any]:
    """write_wavlm(folder, seed=0, norm="group"): a tiny WavLM of random weights."""
    from encoders import write_wavlm

    return write_wavlm


@pytest.fixture(scope="session")
def write_encoder() -> Callable[..., Any]:
    """write_encoder(folder, name, seed=0): a tiny speech encoder of random weights."""
    from encoders import write_encoder

    return write_encoder


@pytest.fixture(scope="session")
def write_text_encoder() -> Callable[..., Any]:
    """write_text_encoder(folder, name="bert", seed=0, head="Model"), with its tokeniser."""
    from encoders import write_text_encoder

    return write_text_encoder


@pytest.fixture
def no_network(monkeypatch) -> None:
    """Any attempt to reach the network fails the test."""

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("the network was reached for")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


@pytest.fixture(scope="session")
def capsule_body() -> Callable[[int], dict[str, Any]]:
    """capsule_body(24): arrays of a body model made of tubes, as SMPL's own files hold them."""
    from gesturekit.formats.smpl import model_pelvis, smpl_skeleton

    return lambda n_joints: body_of_tubes(smpl_skeleton(n_joints), model_pelvis(n_joints))


@pytest.fixture
def open_browser(tmp_path) -> Iterator[Callable[[], Browser]]:
    """open_browser(): a browser whose downloads lie in tmp_path."""
    if not shutil.which("chromium"):
        pytest.skip("Chromium is not installed")
    opened = []

    def start() -> Browser:
        opened.append(Browser(tmp_path))
        return opened[-1]

    yield start
    for browser in opened:
        browser.close()
