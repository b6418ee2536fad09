"""Loaders under test: how each is called with a file that may be anything."""

import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import avatars
import mutators
import numpy as np
import seeds

import audio_features as af
import gesturekit as gk
from audio_features import words as word_lists
from audio_features.weight_files import read_file, read_json
from gesturekit.corpus import Manifest
from gesturekit.diffusion import DiffusionConfig
from gesturekit.evaluation import read_answers
from gesturekit.formats.easymocap import read_easymocap
from gesturekit.formats.gltf.vrm import read_avatar
from gesturekit.formats.live_link import read_live_link
from gesturekit.formats.npz import frames_rows
from gesturekit.formats.tables import load_events, load_root_path, load_semantics
from gesturekit.inspection import inspect
from gesturekit.jobs.records import (
    STATE,
    read_record,
    running,
    status_of,
    write_items,
    write_record,
)
from gesturekit.jobs.result import Result, Task
from gesturekit.motion import Motion
from gesturekit.motion.body_model import BodyModel
from gesturekit.multires import MultiresConfig
from gesturekit.rendering.inputs import read_list
from gesturekit.study import Votes
from gesturekit.systems import model_folder
from gesturekit.training.config import load_config
from gesturekit.training.run_folder import Checkpoints

Seeds = Callable[[Path], list[bytes]]


@dataclass(frozen=True)
class Target:
    """A loader under test.

    Attributes:
        name: its name on the command line.
        file: path of the mutated file in the folder of the case.
        seeds: valid contents, given a folder to work in.
        read: reads the file; given the folder and the path of the file.
        mutators: see `mutators`.
        setup: writes the other files of the folder.
        says: pattern that messages have, with PATH for the path of the file.
        wrap: makes the content of the file from the mutated bytes.
        is_slow: true if it loads a model; short runs execute a tenth of it.
    """

    name: str
    file: str
    seeds: Seeds
    read: Callable[[Path, Path], Any]
    mutators: tuple[Any, ...] = mutators.TEXT
    setup: Callable[[Path], None] = lambda folder: None
    says: str = "FOLDER"
    wrap: Callable[[bytes], bytes] = bytes
    is_slow: bool = False


def motion(folder: Path, file: Path) -> None:
    read = Motion.load(file)
    assert np.isfinite(read.positions()).all(), "positions that are not finite"
    assert read.face is None or np.isfinite(read.face.values).all(), "a face that is not finite"


def own_features(folder: Path, file: Path) -> None:
    sound = af.Wave(np.zeros(16_000), 16_000, source=str(file.with_suffix(".wav")))
    af.Files(3, rate=5).extract(sound)


def config(schema: type, folder: Path, file: Path) -> None:
    load_config(file, schema)


def checkpoint(folder: Path, file: Path) -> None:
    Checkpoints(file.parent).latest()


def jobs(folder: Path, file: Path) -> None:
    state = folder / STATE
    read_record(state, Task("a"))
    running(state)
    status_of(folder).reasons()


def write_run(folder: Path) -> None:
    """A run over two items, and the lock of a process that works on them."""
    write_items(folder / STATE, ["a", "b"], 2, {})
    write_record(folder / STATE, Result(Task("b"), "done", sound=2.5, seconds=1.0))
    (folder / STATE / "running").mkdir()


_RECORD = f"{STATE}/records/ca/978112ca1bbdcafac231b39a23dc4d.json"
"""Record of the item "a"."""


class Slow:
    """An extractor whose features are worth caching, and whose weights are none."""

    spec = {"kind": "slow"}  # noqa: RUF012
    names = ("a", "b")
    dim = 2

    def extract(self, wave: af.Wave) -> af.FeatureTrack:
        return af.FeatureTrack(np.ones((5, 2)), np.arange(5) / 50, self.spec, self.names)


@cache
def wave() -> af.Wave:
    return af.Wave.from_array(np.sin(np.arange(1600) / 5).astype("f4"), 16_000)


def cached(folder: Path, file: Path) -> None:
    (entry,) = (folder / "cache").glob("*/*/*")
    shutil.copyfile(file, entry)
    track = af.FeatureCache(folder / "cache").extract(Slow(), wave())
    assert track.values.shape == (5, 2), "a damaged entry was taken"


def cache_entry(folder: Path) -> list[bytes]:
    af.FeatureCache(folder / "cache").extract(Slow(), wave())
    (entry,) = (folder / "cache").glob("*/*/*")
    return [entry.read_bytes()]


DEMO = model_folder("demo")


def copy_demo(folder: Path) -> None:
    for path in DEMO.iterdir():
        (folder / path.name).symlink_to(path)


def demo(folder: Path, file: Path) -> None:
    model = gk.load(folder)
    made = model.generate(wave(), foot_lock=False)
    assert np.isfinite(made.positions()).all(), "positions that are not finite"


def demo_part(name: str) -> Seeds:
    return lambda folder: [(DEMO / name).read_bytes()]


@cache
def payload() -> tuple[bytes, bytes]:
    """Header, with its length, and values of the demo model's tensors."""
    data = (DEMO / "model.safetensors").read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    return data[:end], data[end:]


def run_folder(folder: Path) -> None:
    (folder / "config.yaml").write_bytes(seeds.configs(folder)[0])
    (folder / "metrics.jsonl").write_text('{"step": 3, "loss": 0.5}\n')


@cache
def avatar_parts() -> tuple[bytes, bytes]:
    """JSON and arrays of an avatar."""
    found, data = avatars.avatar_json(1)
    return json.dumps(found).encode(), data


@cache
def animated_parts() -> tuple[bytes, bytes]:
    """JSON and arrays of a skeleton with curves of all kinds."""
    file = seeds.splines()
    return json.dumps(file.json | {"buffers": [{"byteLength": len(file.data)}]}).encode(), file.data


def words(name: str, suffix: str, seeds_: Seeds, how: tuple[Any, ...] = mutators.TEXT) -> Target:
    return Target(
        f"words_{name}", f"a{suffix}", seeds_, lambda _, file: word_lists.load_words(file), how
    )


@cache
def service() -> Any:
    """A client of the service, for the life of this process."""
    from starlette.testclient import TestClient

    from gesturekit.serving import Limits, create_app

    app = create_app(gk.load("demo"), Limits(seconds=5, megabytes=1))
    return TestClient(app, base_url="http://localhost").__enter__()


def http(folder: Path, file: Path) -> None:
    """The first line is the query, the second a header's value, the rest the body."""
    query, header, body = (*file.read_bytes().split(b"\n", 2), b"", b"")[:3]
    url = "/motion?" + quote(query, safe="=&%+")
    answer = service().post(url, content=body, headers={"X": header.hex(), "Range": header})
    assert answer.status_code in (200, 400, 413, 422), answer.status_code
    assert tempfile.gettempdir() not in answer.text, "a path of the server"


@cache
def live_model() -> Any:
    return gk.load("demo")


def live(folder: Path, file: Path) -> None:
    """Samples of 16 bits of a pipe, in blocks of the sizes that the first bytes give."""
    data = file.read_bytes()
    sizes, samples = data[:8], np.frombuffer(data[8 : len(data) // 2 * 2], "<i2") / 32768
    stream = live_model().stream(16_000, foot_lock=False)
    for size in sizes:
        block, samples = samples[: 40 * size], samples[40 * size :]
        if (made := stream.step(block)) is not None:
            assert np.isfinite(made.positions()).all(), "positions that are not finite"


def bodies(folder: Path) -> list[bytes]:
    sounds = seeds.sounds(folder)
    return [b"format=bvh&seed=3\nbytes=0-1\n" + sounds[0], b"format=html\n\n" + sounds[4]]


def text(*rows: str) -> Seeds:
    return lambda folder: ["\n".join(rows).encode() + b"\n"]


def tensors_of_demo() -> Target:
    return Target(
        "model_tensors",
        "model.safetensors",
        lambda folder: [payload()[0]],
        demo,
        mutators.TENSORS,
        copy_demo,
        wrap=lambda data: data + payload()[1],
    )


def bvh_and_npz(suffix: str) -> Seeds:
    return lambda folder: seeds.base_files(folder)[suffix]


LINE = r"PATH:\d+: "
TARGETS = {
    target.name: target
    for target in (
        Target(
            *("bvh", "a.bvh", bvh_and_npz("bvh"), motion, mutators.BVH),
            says=LINE + "|PATH: the file is empty",
        ),
        Target(
            *("npz", "a.npz", bvh_and_npz("npz"), motion, mutators.NPZ),
            says=r"PATH.*(\bkeys? '\w*'|: not a readable npz file|list of members|rates differ, '"
            r"|more than 4 GiB)",
        ),
        Target(
            *("frames", "a.frames", seeds.frames, motion, mutators.JSON),
            says="PATH",
            wrap=lambda header: header + b"\n" + frames_rows(seeds.base_motions()[1]),
        ),
        Target(
            *("body_model", "a.npz", seeds.body_model),
            *(lambda _, file: BodyModel.load(file), mutators.NPZ),
        ),
        Target("gltf", "a.glb", seeds.animated, motion, mutators.ANY, says="PATH: "),
        Target(
            *("gltf_json", "a.glb", lambda _: [animated_parts()[0]], motion, mutators.JSON),
            says="PATH: ",
            wrap=lambda text: avatars.glb(text, animated_parts()[1]),
        ),
        Target(
            *("gltf_text", "a.gltf", lambda _: [seeds.splines().gltf()], motion, mutators.JSON),
            says="PATH: ",
        ),
        Target("avatar", "a.vrm", seeds.avatars, lambda _, f: read_avatar(f), mutators.ANY),
        Target(
            *("avatar_json", "a.vrm", lambda _: [avatar_parts()[0]]),
            *(lambda _, file: read_avatar(file), mutators.JSON),
            wrap=lambda text: avatars.glb(text, avatar_parts()[1]),
        ),
        Target(
            *("features", "a.npz", seeds.features),
            *(lambda _, file: af.FeatureTrack.load(file), mutators.NPZ),
        ),
        Target("own_features", "a.npy", seeds.own_features, own_features, mutators.TEXT),
        Target("sound", "a.wav", seeds.sounds, lambda _, f: af.Wave.load(f), mutators.ANY),
        words("textgrid", ".TextGrid", seeds.textgrid),
        words("ctm", ".ctm", text(";; x", "a 1 0.5 0.25 hello", "a 1 1.5 0.5 you 0.9")),
        words("srt", ".srt", seeds.captions),
        words("tsv", ".tsv", text("0.5\t1.0\thello", "1\t2\t#laughter")),
        words("json", ".json", seeds.word_json, mutators.JSON),
        Target(
            *("manifest", "a.jsonl", seeds.manifest, lambda _, file: Manifest.load(file)),
            mutators.JSON,
            says=LINE + "|PATH: empty",
        ),
        Target("config_multires", "a.yaml", seeds.configs, partial(config, MultiresConfig)),
        Target("config_diffusion", "a.yaml", seeds.configs, partial(config, DiffusionConfig)),
        Target("model_config", "config.yaml", demo_part("config.yaml"), demo, setup=copy_demo),
        Target(
            *("model_skeleton", "skeleton.json", demo_part("skeleton.json"), demo),
            *(mutators.JSON, copy_demo),
        ),
        tensors_of_demo(),
        Target(
            *("checkpoint", "step_00000003.pt", seeds.checkpoint, checkpoint, mutators.PICKLE),
            says="",
        ),
        Target(
            *("weights", "model.bin", seeds.weights, lambda _, file: read_file(file)),
            (*mutators.PICKLE, *mutators.TENSORS),
        ),
        Target(
            *("weights_config", "config.json", text('{"hidden_size": 32, "a": [1, null]}')),
            *(lambda _, file: read_json(file), mutators.JSON),
        ),
        Target("cache_entry", "entry", cache_entry, cached, mutators.TENSORS),
        Target("record", _RECORD, seeds.record, jobs, mutators.JSON, write_run),
        Target(
            *("items", f"{STATE}/items.json"),
            text('{"format": 1, "shards": 2, "items": ["a", "d/b"], "model_folder": "m"}'),
            *(jobs, mutators.JSON, write_run),
        ),
        Target(
            *("running", f"{STATE}/running/1 of 2.json"),
            text('{"host": "h", "pid": 3, "since": 1.5, "run": "x"}'),
            *(jobs, mutators.JSON, write_run),
        ),
        Target("list_jsonl", "a.jsonl", seeds.lists, lambda _, f: [*read_list(f)], mutators.JSON),
        Target("list_scp", "wav.scp", text("a a.wav", "b d/b.wav"), lambda _, f: [*read_list(f)]),
        Target("list_txt", "a.txt", text("a.wav", "d/b c.wav"), lambda _, f: [*read_list(f)]),
        Target(
            *("easymocap", "000000.json", seeds.people),
            *(lambda _, file: read_easymocap(file, person=0), mutators.JSON),
        ),
        Target(
            *("path", "a.csv", text("time,x,z,heading", "0,0,0,0", "0.5,1,0.5,90", "1,2,1,90")),
            lambda _, file: load_root_path(file),
        ),
        Target(
            *("events", "a.csv", text("time,name,duration", "0.5,nod,", "1,wave,0.5")),
            lambda _, file: load_events(file),
        ),
        Target(
            *("live_link", "a.csv"),
            text("Timecode,Count,JawOpen", "23:59:59:58.5,61,0.5", "0:0:0:1,61,1", "0:0:1;1,0,"),
            lambda _, file: read_live_link(file, 30.0, 100),
        ),
        Target(
            *("semantics", "a.txt"),
            text("beat_align\t0.5\t1.0\t0.5\t0.8\thand", "a\t1\t2\t1\t1\tx"),
            lambda _, file: load_semantics(file),
        ),
        Target(
            *("answers", "a.csv"),
            text(
                "user,input_code,model_a,model_b,winner,is_strong,juiceOptions,juiceOtherReason",
                'r1,c1,A,B,A,true,"[1]",',
                "r2,c1,B,A,tie,,,",
            ),
            lambda _, file: Votes.of(read_answers([file]).kept),
            says="PATH|columns",
        ),
        Target("live", "sound", lambda _: [bytes(range(8)) + bytes(9000)], live, mutators.ANY),
        Target("http", "request", bodies, http, (*mutators.ANY, mutators.tokens)),
        Target(
            *("metrics", "metrics.jsonl", text('{"step": 3, "loss": 0.5}', '{"step": 4}')),
            *(lambda folder, _: inspect(folder), mutators.JSON, run_folder),
        ),
        Target(
            *("versions", "versions.json", text('{"python": "3.11", "torch": "2.4"}')),
            *(lambda folder, _: inspect(folder), mutators.JSON, run_folder),
        ),
    )
}
for _name in [name for name in TARGETS if name.startswith(("model_", "config_", "http", "live"))]:
    TARGETS[_name] = replace(TARGETS[_name], is_slow=True)
