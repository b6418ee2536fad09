"""What every test may use: real recordings where they are, and small ones made on the spot."""

from __future__ import annotations

import os
import re
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from chromium import Browser
from hypothesis import settings
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


JOINTS = {
    "Hips": (None, (0.0, 0.0, 0.0)),
    "Spine": ("Hips", (0.0, 0.1, 0.0)),
    "Chest": ("Spine", (0.0, 0.2, 0.0)),
    "Neck": ("Chest", (0.0, 0.2, 0.0)),
    "Head": ("Neck", (0.0, 0.1, 0.0)),
    "LeftShoulder": ("Chest", (0.05, 0.15, 0.0)),
    "LeftArm": ("LeftShoulder", (0.12, 0.0, 0.0)),
    "LeftForeArm": ("LeftArm", (0.28, 0.0, 0.0)),
    "LeftHand": ("LeftForeArm", (0.25, 0.0, 0.0)),
    "RightShoulder": ("Chest", (-0.05, 0.15, 0.0)),
    "RightArm": ("RightShoulder", (-0.12, 0.0, 0.0)),
    "RightForeArm": ("RightArm", (-0.28, 0.0, 0.0)),
    "RightHand": ("RightForeArm", (-0.25, 0.0, 0.0)),
    "LeftUpLeg": ("Hips", (0.1, -0.05, 0.0)),
    "LeftLeg": ("LeftUpLeg", (0.0, -0.42, 0.0)),
    "LeftFoot": ("LeftLeg", (0.0, -0.42, 0.0)),
    "RightUpLeg": ("Hips", (-0.1, -0.05, 0.0)),
    "RightLeg": ("RightUpLeg", (0.0, -0.42, 0.0)),
    "RightFoot": ("RightLeg", (0.0, -0.42, 0.0)),
}


@pytest.fixture(scope="session")
def skeleton() -> Skeleton:
    names = tuple(JOINTS)
    return Skeleton(
        names=names,
        parents=tuple(
            -1 if parent is None else names.index(parent) for parent, _ in JOINTS.values()
        ),
        offsets=np.array([offset for _, offset in JOINTS.values()]),
        end_sites={
            "Head": (np.array([0.0, 0.15, 0.0]),),
            "LeftHand": (np.array([0.1, 0.0, 0.0]),),
            "RightHand": (np.array([-0.1, 0.0, 0.0]),),
            "LeftFoot": (np.array([0.0, -0.05, 0.15]),),
            "RightFoot": (np.array([0.0, -0.05, 0.15]),),
        },
        rotation_orders=("ZXY",) * len(names),
    )


# Faces +Z: its spine is level, its head in front, its tail behind.
QUADRUPED = {
    "Pelvis": (None, (0.0, 0.0, 0.0)),
    "Spine": ("Pelvis", (0.0, 0.02, 0.3)),
    "Chest": ("Spine", (0.0, -0.02, 0.3)),
    "Neck": ("Chest", (0.0, 0.2, 0.15)),
    "Head": ("Neck", (0.0, 0.2, 0.15)),
    "Tail1": ("Pelvis", (0.0, 0.05, -0.2)),
    "Tail2": ("Tail1", (0.0, -0.2, -0.1)),
    **{
        f"{side}{joint}": (parent.format(side), offset)
        for side, x in (("Left", 0.15), ("Right", -0.15))
        for joint, parent, offset in (
            ("UpperArm", "Chest", (x, -0.1, 0.0)),
            ("ForeArm", "{}UpperArm", (0.0, -0.35, 0.0)),
            ("Hand", "{}ForeArm", (0.0, -0.3, 0.02)),
            ("UpLeg", "Pelvis", (x, -0.08, 0.0)),
            ("Leg", "{}UpLeg", (0.0, -0.37, 0.0)),
            ("Foot", "{}Leg", (0.0, -0.3, 0.02)),
        )
    },
}


@pytest.fixture(scope="session")
def quadruped() -> Skeleton:
    names = tuple(QUADRUPED)
    parents = (-1 if parent is None else names.index(parent) for parent, _ in QUADRUPED.values())
    return Skeleton(names, tuple(parents), np.array([offset for _, offset in QUADRUPED.values()]))


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


@pytest.fixture(scope="session")
def write_speech() -> Callable[..., Path]:
    """write_speech(path, seconds, rate=16000): a voice in syllables of a fifth of a second."""

    def write(path: Path, seconds: float, rate: int = 16000, *, level: float = 0.2) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(path, level * voiced(seconds, rate), rate)
        return path

    return write


@pytest.fixture(scope="session")
def write_pair(gesture, write_speech) -> Callable[..., tuple[Path, Path]]:
    """write_pair(folder, stem, seconds=4): STEM.wav and STEM.bvh that belong together."""

    def write(folder: Path, stem: str, seconds: float = 4.0, **options) -> tuple[Path, Path]:
        audio = write_speech(folder / f"{stem}.wav", seconds)
        motion = folder / f"{stem}.bvh"
        gesture(seconds, **options).save(motion)
        return audio, motion

    return write


@pytest.fixture(scope="session")
def corpus(tmp_path_factory, write_pair, write_speech) -> Path:
    """A manifest of two recordings of different lengths (6 and 2.5 s) and unpaired speech."""
    from gesturekit.corpus import prepare

    folder = tmp_path_factory.mktemp("corpus")
    write_pair(folder / "paired", "a", 6.0, seed=1)
    write_pair(folder / "paired", "b", 2.5, seed=2)
    write_speech(folder / "more" / "c.wav", 5.0, level=0.1)
    manifest = folder / "corpus.jsonl"
    prepare([folder / "paired"], manifest, unpaired=[folder / "more"], holdout=0.0)
    return manifest


@pytest.fixture(scope="session")
def write_wavlm() -> Callable[..., Any]:
    """write_wavlm(folder, seed=0, norm="group"): a tiny WavLM of random weights, as Hugging Face
    saves them; norm "layer" is the front end of the Large models. Returns the model."""
    import torch
    import transformers

    def write(folder: Path, seed: int = 0, norm: str = "group") -> Any:
        torch.manual_seed(seed)
        config = transformers.WavLMConfig(
            hidden_size=32,
            num_hidden_layers=3,
            num_attention_heads=4,
            intermediate_size=64,
            conv_dim=[16] * 7,
            num_conv_pos_embeddings=16,
            num_conv_pos_embedding_groups=4,
            feat_extract_norm=norm,
            do_stable_layer_norm=norm == "layer",
        )
        model = transformers.WavLMModel(config).eval()
        model.save_pretrained(folder)
        return model

    return write


_TRANSFORMER = {
    "hidden_size": 32,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
    "intermediate_size": 64,
}
_CONVOLUTIONS = {
    **_TRANSFORMER,
    "conv_dim": [16] * 7,
    "num_conv_pos_embeddings": 16,
    "num_conv_pos_embedding_groups": 4,
}
_DATA2VEC = {"num_conv_pos_embeddings": 2, "conv_pos_kernel_size": 5}
_WHISPER = {
    "d_model": 32,
    "encoder_layers": 3,
    "encoder_attention_heads": 4,
    "encoder_ffn_dim": 64,
    "decoder_layers": 1,
    "decoder_attention_heads": 4,
    "decoder_ffn_dim": 32,
    "vocab_size": 60,
    "max_source_positions": 150,
    "num_mel_bins": 80,
    **{f"{name}_token_id": 1 for name in ("pad", "bos", "eos", "decoder_start")},
}
# Classes of transformers and settings, by name; "-layer" is the front end of Large models.
ENCODERS = {
    "hubert": ("Hubert", "Model", _CONVOLUTIONS),
    "wav2vec2": ("Wav2Vec2", "ForCTC", {**_CONVOLUTIONS, "vocab_size": 8}),
    "data2vec-audio": ("Data2VecAudio", "Model", {**_CONVOLUTIONS, **_DATA2VEC}),
    "wavlm": (
        "WavLM",
        "Model",
        {**_CONVOLUTIONS, "feat_extract_norm": "layer", "do_stable_layer_norm": True},
    ),
    "wav2vec2-bert": ("Wav2Vec2Bert", "Model", _TRANSFORMER),
    "whisper": ("Whisper", "Model", _WHISPER),
}


def save_encoder(folder: Path, stem: str, head: str, settings: dict[str, Any]) -> Any:
    """Save a tiny encoder of random weights in which every tensor counts, and return it."""
    import torch
    import transformers

    config = getattr(transformers, f"{stem}Config")(**settings)
    model = getattr(transformers, f"{stem}{head}")(config).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    model.save_pretrained(folder)
    return model


@pytest.fixture(scope="session")
def write_encoder() -> Callable[..., Any]:
    """write_encoder(folder, name, seed=0): a tiny speech encoder of random weights in which every
    tensor counts, as Hugging Face saves it. Returns transformers' model."""
    import torch

    def write(folder: Path, name: str, seed: int = 0) -> Any:
        stem, head, settings = ENCODERS[name]
        torch.manual_seed(seed)
        return save_encoder(folder, stem, head, settings)

    return write


_VOCABULARY = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "so", "hand", "##s", "wave"]
_SIZES = {
    "vocab_size": len(_VOCABULARY),
    "hidden_size": 16,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "intermediate_size": 24,
    "max_position_embeddings": 40,
    "pad_token_id": 0,
}
_STEMS = {
    "bert": "Bert",
    "roberta": "Roberta",
    "xlm-roberta": "XLMRoberta",
    "distilbert": "DistilBert",
    "mpnet": "MPNet",
    "electra": "Electra",
}


@pytest.fixture(scope="session")
def write_text_encoder() -> Callable[..., Any]:
    """write_text_encoder(folder, name="bert", seed=0, head="Model"): a tiny text encoder of random
    weights with its tokeniser, as Hugging Face saves it. Returns transformers' model."""
    import torch
    import transformers

    def write(folder: Path, name: str = "bert", seed: int = 0, head: str = "Model") -> Any:
        torch.manual_seed(seed)
        sizes = dict(_SIZES)
        if name == "distilbert":
            sizes = {"vocab_size": 9, "dim": 16, "n_layers": 2, "n_heads": 2, "hidden_dim": 24}
        if name == "electra":
            sizes["embedding_size"] = 8
        model = save_encoder(folder, _STEMS[name], head, sizes)
        (folder / "vocab.txt").write_text("\n".join(_VOCABULARY), encoding="utf-8")
        transformers.BertTokenizerFast(str(folder / "vocab.txt")).save_pretrained(folder)
        return model

    return write


@pytest.fixture
def no_network(monkeypatch) -> None:
    """Any attempt to reach the network fails the test."""

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("the network was reached for")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


RING = 8  # vertices around a bone


def _capsule_body(rig: Skeleton, pelvis: np.ndarray) -> dict[str, Any]:
    """The arrays of an SMPL-like model: a tube around each bone, and a box for each foot."""
    joints = np.zeros((rig.n_joints, 3))
    joints[0] = pelvis
    for j, parent in enumerate(rig.parents[1:], start=1):
        joints[j] = joints[parent] + rig.offsets[j]
    vertices, weights, faces, centred = [], [], [], {0: []}

    def add(place: np.ndarray, **shares: float) -> int:
        vertices.append(place)
        row = np.zeros(rig.n_joints)
        for joint, share in shares.items():
            row[int(joint[1:])] += share
        weights.append(row)
        return len(vertices) - 1

    def ring(centre: np.ndarray, axis: np.ndarray, radius: float, **shares: float) -> list[int]:
        side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(axis, side)
        turn = 2 * np.pi * np.arange(RING) / RING
        spokes = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
        return [add(centre + radius * spoke, **shares) for spoke in spokes]

    for j, parent in enumerate(rig.parents[1:], start=1):
        bone = joints[j] - joints[parent]
        length = np.linalg.norm(bone)
        axis = bone / length
        radius = 0.008 if length < 0.05 else 0.32 * length if length < 0.2 else 0.065
        rings = []
        for at, thick, own in ((0.0, 0.8, 0.0), (0.3, 1.0, 0.0), (0.7, 0.9, 0.1), (1.0, 0.7, 0.5)):
            shares = {f"j{parent}": 1 - own, f"j{j}": own}
            rings.append(ring(joints[parent] + at * bone, axis, thick * radius, **shares))
        centred.setdefault(j, rings[-1])
        centred[0] = centred[0] or rings[0]
        for low, high in zip(rings, rings[1:]):
            for k in range(RING):
                a, b, c, d = low[k], low[(k + 1) % RING], high[k], high[(k + 1) % RING]
                faces += [(a, b, c), (b, d, c)]
        for end, flip in ((rings[0], True), (rings[-1], False)):
            for k in range(1, RING - 1):
                corner = (end[0], end[k], end[k + 1])
                faces.append(corner[::-1] if flip else corner)
    feet = []
    for side, out in (("left", 1), ("right", -1)):
        ankle, foot = rig.index(f"{side}_ankle"), rig.index(f"{side}_foot")
        floor = joints[foot, 1] - 0.02
        corners = []
        for height in (0.0, 0.05):
            for x, z, joint in ((-0.03, 0.09, foot), (0.05, 0.06, foot), (0.0, -0.06, ankle)):
                base = joints[foot] if joint == foot else joints[ankle]
                place = np.array([base[0] + out * x, floor + height, base[2] + z])
                corners.append(add(place, **{f"j{joint}": 1.0}))
        feet += corners[:3]  # big toe, small toe, heel
        a, b, c, d, e, f = corners
        box = [
            (a, b, c),
            (d, f, e),
            (a, d, e),
            (a, e, b),
            (b, e, f),
            (b, f, c),
            (c, f, d),
            (c, d, a),
        ]
        faces += [face if out < 0 else face[::-1] for face in box]
    skin = np.array(vertices)
    regressor = np.zeros((rig.n_joints, len(skin)))
    for j, around in centred.items():
        regressor[j, around] = 1 / len(around)
    rng = np.random.default_rng(0)
    shapes = rng.normal(0, 0.002, (len(skin), 3, 20))
    shapes[..., 0] = 0.05 * (skin - pelvis)  # the first coefficient makes the body larger
    return {
        "v_template": skin,
        "f": np.array(faces, dtype=np.uint32),
        "weights": np.array(weights),
        "shapedirs": shapes,
        "posedirs": rng.normal(0, 0.0003, (len(skin), 3, 9 * (rig.n_joints - 1))),
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, *rig.parents[1:]], range(rig.n_joints)]),
        "feet": np.array(feet),
    }


@pytest.fixture(scope="session")
def capsule_body() -> Callable[[int], dict[str, Any]]:
    """capsule_body(24): arrays of a body model made of tubes, as SMPL's own files hold them."""
    from gesturekit.formats.smpl.skeleton import model_pelvis, smpl_skeleton

    return lambda n_joints: _capsule_body(smpl_skeleton(n_joints), model_pelvis(n_joints))


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
