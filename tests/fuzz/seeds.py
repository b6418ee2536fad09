"""Files of each format that are as they should be, as bytes."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
import torch
from avatars import avatar
from gltf_files import GltfFile, arm
from safetensors.numpy import save

import audio_features as af
from gesturekit.formats import write_bvh, write_npz
from gesturekit.formats.npz import frames_header
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.jobs.records import write_record
from gesturekit.jobs.result import Result, Task
from gesturekit.motion import Motion, Skeleton
from gesturekit.training.config import dump_yaml


def base_motions() -> list[Motion]:
    rng = np.random.default_rng(0)
    motions = []
    for n_joints, n_frames in ((1, 2), (19, 8), (60, 3)):
        parents = (-1, *(int(rng.integers(max(0, j - 3), j)) for j in range(1, n_joints)))
        skeleton = Skeleton(
            tuple(f"joint{j}" for j in range(n_joints)),
            parents,
            rng.normal(0, 0.2, (n_joints, 3)),
            end_sites={f"joint{n_joints - 1}": (np.array([0.0, 0.1, 0.0]),)},
        )
        rotations = rng.normal(size=(n_frames, n_joints, 4))
        moving = {"joint3": rng.normal(size=(n_frames, 3))} if n_joints > 3 else {}
        motions.append(Motion(skeleton, rotations, rng.normal(size=(n_frames, 3)), 30, moving))
    for n_joints in (24, 55):
        rotations = rng.normal(size=(6, n_joints, 4))
        motions.append(Motion(smpl_skeleton(n_joints), rotations, rng.normal(size=(6, 3)), 30))
    return motions


def base_files(folder: Path) -> dict[str, list[bytes]]:
    """Files of each format that are as they should be, as bytes."""
    files: dict[str, list[bytes]] = {"bvh": [], "npz": []}
    for number, motion in enumerate(base_motions()):
        write_bvh(motion, folder / "base.bvh", decimals=2 + number)
        write_npz(motion, folder / "base.npz")
        for suffix, contents in files.items():
            contents.append((folder / f"base.{suffix}").read_bytes())
    files["bvh"].append(files["bvh"][1].replace(b"\n", b"\r\n"))
    smpl = dict(np.load(io.BytesIO(files["npz"][-1])))
    foreign = {key: smpl[key] for key in ("poses", "trans", "betas", "gender", "mocap_framerate")}
    for write in (np.savez, np.savez_compressed):
        write(folder / "base.npz", **foreign)
        files["npz"].append((folder / "base.npz").read_bytes())
    return files


def frames(folder: Path) -> list[bytes]:
    return [frames_header(base_motions()[1]).strip()]


def body_model(folder: Path) -> list[bytes]:
    """A body model of eight vertices and the joints of SMPL."""
    rng = np.random.default_rng(0)
    regressor = np.zeros((24, 8))
    regressor[np.arange(24), np.arange(24) % 8] = 1
    arrays = {
        "v_template": rng.normal(size=(8, 3)),
        "f": np.array([[0, 1, 2], [2, 3, 4]], dtype=np.uint32),
        "weights": regressor.T / 3,
        "shapedirs": np.zeros((8, 3, 10)),
        "posedirs": np.zeros((8, 3, 207)),
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, *smpl_skeleton(24).parents[1:]], range(24)]),
    }
    return [npz(**arrays)]


def npz(**arrays: Any) -> bytes:
    with io.BytesIO() as out:
        np.savez(out, **arrays)
        return out.getvalue()


def features(folder: Path) -> list[bytes]:
    path = folder / "base.npz"
    track = af.FeatureTrack(np.ones((5, 3)), np.arange(5) / 5, {"kind": "mfcc"}, ("a", "b", "c"))
    track.save(path)
    return [path.read_bytes()]


def own_features(folder: Path) -> list[bytes]:
    out = io.BytesIO()
    np.save(out, np.ones((5, 3), np.float32))
    return [out.getvalue()]


def sounds(folder: Path) -> list[bytes]:
    rng = np.random.default_rng(0)
    mono = (0.2 * np.sin(np.arange(1600) / 5) + 0.02 * rng.standard_normal(1600)).astype("f4")
    stereo = np.stack([mono, mono / 2], axis=1)
    kinds = (
        *(("WAV", "PCM_16", mono), ("WAVEX", "PCM_24", stereo), ("WAV", "FLOAT", mono)),
        *(("RF64", "PCM_16", mono), ("FLAC", "PCM_16", mono), ("OGG", "VORBIS", stereo)),
        *(("OGG", "OPUS", mono), ("MP3", "MPEG_LAYER_III", mono), ("AIFF", "PCM_16", mono)),
        *(("AU", "PCM_16", mono), ("NIST", "PCM_16", mono), ("WAV", "ULAW", mono)),
    )
    made = []
    for container, subtype, sound in kinds:
        with io.BytesIO() as out:
            soundfile.write(out, sound, 16_000, subtype, format=container)
            made.append(out.getvalue())
    return made


def textgrid(folder: Path) -> list[bytes]:
    tier = (
        'class = "IntervalTier"\nname = "words"\nxmin = 0\nxmax = 2\nintervals: size = 2\n'
        'intervals [1]:\nxmin = 0\nxmax = 1\ntext = "hello"\n'
        'intervals [2]:\nxmin = 1\nxmax = 2\ntext = "say ""hi"""\n'
    )
    long = (
        'File type = "ooTextFile"\nObject class = "TextGrid"\n\nxmin = 0\nxmax = 2\n'
        f"tiers? <exists>\nsize = 2\nitem []:\nitem [1]:\n{tier}item [2]:\n"
        'class = "TextTier"\nname = "p"\nxmin = 0\nxmax = 2\npoints: size = 1\nnumber = 1\n'
        'mark = "x"\n'
    )
    short = '"ooTextFile"\n"TextGrid"\n0\n2\n<exists>\n1\n"IntervalTier"\n"w"\n0\n2\n1\n0\n2\n"a"\n'
    return [long.encode(), short.encode(), long.encode("utf-16")]


def captions(folder: Path) -> list[bytes]:
    srt = (
        "1\n00:00:01,000 --> 00:00:02,500\n<i>Hello</i> {b}there\n\n2\n00:01:00,0 --> 1:2,5\nx y\n"
    )
    return [srt.encode(), b"WEBVTT\n\n00:01.000 --> 00:02.000 align:start\nHello <v Bob>you\n"]


def word_json(folder: Path) -> list[bytes]:
    words = [{"word": "a", "start": 0.0, "end": 0.5}, {"text": "b", "start": 1, "end": 1.5}]
    segment = {"start": 0, "end": 2.0, "text": "hello you", "words": words}
    timed = {"metadata:transcript": [{"start": 0, "end": 2, "transcript": "hello you"}]}
    forms = (words, {"words": words}, {"word_segments": words}, {"segments": [segment]}, timed)
    return [json.dumps(form).encode() for form in forms]


def manifest(folder: Path) -> list[bytes]:
    item = {"id": "day/a", "audio": "a.wav", "motion": "../a.bvh", "audio_start": 0.0}
    item |= {"motion_start": 0.5, "duration": 2.0, "speaker": "x", "style": None, "split": "train"}
    item |= {"text": None, "mirror": False, "conditions": {"path": "a.csv"}, "channel": 1}
    item |= {"audible": [[0, 1.5]], "reading": {"unit": "cm", "fps": 30}}
    rows = [{"schema": 1}, item, {**item, "id": "b", "audio": None}]
    return [b"".join(json.dumps(row).encode() + b"\n" for row in rows)]


def configs(folder: Path) -> list[bytes]:
    common = {
        **{"corpus": "c.jsonl", "out": "run", "fps": 30.0, "seed": 3},
        "features": {"extractors": [{"kind": "mfcc"}]},
    }
    multires = {
        **{"system": "multires", **common},
        "network": {"levels": 4, "channels": [2, 2, 2]},
        "training": {"batch": 2, "window": 3.0, "learning_rate": 1e-3},
        "losses": {"smoothness": 5},
    }
    diffusion = {
        **{"system": "diffusion", **common},
        "network": {"blocks": 2, "layers": 1, "channels": 16},
        "training": {"updates": 6, "batch": 4, "window": 2.0},
    }
    anchored = "network: &n {levels: 4}\ncorpus: ~/x\nfps: 1e-3\nseed: 0x10\ndevice: 2001-01-01\n"
    return [dump_yaml(multires).encode(), dump_yaml(diffusion).encode(), anchored.encode()]


def checkpoint(folder: Path) -> list[bytes]:
    state = {"step": 3, "rng": torch.arange(8, dtype=torch.uint8), "net": {"w": torch.ones(2, 2)}}
    made = []
    for zipped in (True, False):
        with io.BytesIO() as out:
            torch.save(state, out, _use_new_zipfile_serialization=zipped)
            made.append(out.getvalue())
    return made


def weights(folder: Path) -> list[bytes]:
    tensors = {"encoder.w": np.ones((3, 2), np.float32), "b": np.zeros(3, np.float32)}
    return [save(tensors, {"format": "pt"}), *checkpoint(folder)]


def record(folder: Path) -> list[bytes]:
    made = {"a.bvh": {"sha256": "0" * 64, "size": 3, "mtime_ns": 5, "made_with": {"seed": 0}}}
    about = {"sound": 2.5, "seconds": 0.5, "key": "k", "input": {"input": "x"}, "made": made}
    write_record(folder, Result(Task("a"), "failed", error="a.wav: broken 3", **about))
    (path,) = folder.glob("records/*/*")
    return [path.read_bytes()]


def avatars(folder: Path) -> list[bytes]:
    return [avatar(version) for version in (0, 1)]


def splines() -> GltfFile:
    """Curves of all kinds, a face, and an array of zeros with a value elsewhere."""
    file = arm("CUBICSPLINE").animate([(1, "scale", [0, 1], [(1, 1, 1), (2, 2, 2)])], "STEP")
    zeros = file.array(np.zeros((3, 3)))
    places = {"bufferView": file.view(np.array([1], "<u2").tobytes()), "componentType": 5123}
    values = {"bufferView": file.view(np.ones(3, "<f4").tobytes())}
    file.json["accessors"][zeros]["sparse"] = {"count": 1, "indices": places, "values": values}
    file.animate([(1, "translation", [0, 1, 2], zeros)])
    file.json["nodes"] += [{"mesh": 0}, {"name": "aa"}]
    targets = {"primitives": [{"targets": [{}, {}]}], "extras": {"targetNames": ["jawOpen", "x"]}}
    file.json["meshes"] = [targets]
    expressions = {"preset": {"aa": {"node": 3}}, "custom": {"mine": {"node": 3}}}
    file.json["extensions"] = {"VRMC_vrm_animation": {"expressions": expressions}}
    x = (3, "translation", [0, 2], [(0, 0, 0), (1, 0, 0)])
    return file.animate([(2, "weights", [0, 1, 5], [0, 0, 1, 0.5, 0, 1]), x])


def animated(folder: Path) -> list[bytes]:
    files = [splines().glb()]
    for motion in base_motions()[:3]:
        motion.save(folder / "base.glb")
        files.append((folder / "base.glb").read_bytes())
    return files


def lists(folder: Path) -> list[bytes]:
    rows = [{"audio": "a.wav", "id": "d/a", "seed": 3, "style": "old", "start": 0.5, "seconds": 2}]
    rows += [{"id": "idle", "seconds": 3.5, "speaker": "x"}, {"audio": "b.wav", "channel": 2}]
    return [b"".join(json.dumps(row).encode() + b"\n" for row in rows)]


def people(folder: Path) -> list[bytes]:
    person = {"id": 0, "Rh": [[0, 0.1, 0]], "Th": [[0, 1, 0]], "poses": [[0.01] * 72]}
    person |= {"shapes": [[0.0] * 10], "expression": [[0.0] * 10]}
    hands = {**person, "id": 1, "poses": [0.0] * 87, "handl": []}
    return [json.dumps([person]).encode(), json.dumps({"annots": [person, hands]}).encode()]
