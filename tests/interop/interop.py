"""Files we wrote, opened in Blender and three.js: do the joints stand where we put them?

    make interop                           # and FILES="a.glb b.gltf" for files of others

makes an environment for Blender's module `bpy` (1.6 GB, some minutes the first time) and runs
this. BVH, glb and FBX files go through the importers of Blender and three.js and through our own
readers, glb files through Khronos' validator too; BVH and npz with their sound go through our
add-on, onto a new armature and onto one with other bone axes, scale and place. FILES are compared
between our reader and three.js. Exits 1 where a joint is more than 0.1 mm away, the frame rate is
another, the sound is not in its place, a channel of the face has other values, or the validator
finds an error.
"""

import json
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import soundfile
from scipy.spatial.transform import Rotation

import gesturekit as gk
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.vrm import read_avatar
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.face import ARKIT
from gesturekit.motion.skeleton import ROTATION_ORDERS
from gesturekit.viewer.drawn_body import DrawnBody

ROOT = Path(__file__).resolve().parents[2]
PLAYER = ROOT / "gesturekit" / "viewer" / "player"
SHARED_DATA = ROOT.parent / "shared" / "data"
RECORDINGS = (
    "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh",
    "motion/aitviewer/sample.bvh",
    "motion/reactidle/012_genuine.bvh",
    "motion/bandai/dataset-2_wave-both-hands_normal_001.bvh",
)
N_FRAMES = 110
TOLERANCE = 0.1  # mm
FACE_TOLERANCE = 1e-4
VALIDATOR = "gltf-validator@2.0.0-dev.3.10"


def motions() -> Iterator[tuple[str, Motion]]:
    """Of the bundled model, of a rig with everything odd, and of recordings where they are."""
    yield "demo", gk.load("demo").generate(ROOT / "gesturekit/models/demo/speech.wav", seed=0)
    yield "odd", odd_motion()
    for name in RECORDINGS:
        if (SHARED_DATA / name).exists():
            yield Path(name).parent.name, Motion.load(SHARED_DATA / name)


def odd_motion() -> Motion:
    """Every rotation order, joints that move, a frame rate that is not a whole number."""
    rng = np.random.default_rng(0)
    n = 40
    skeleton = Skeleton(
        names=tuple(f"ns:bone {j}.L" if j % 7 == 3 else f"bone{j}" for j in range(n)),
        parents=(-1, *(int(rng.integers(max(0, j - 4), j)) for j in range(1, n))),
        offsets=rng.normal(0, 0.15, (n, 3)),
        end_sites={"bone39": (np.array([0.0, 0.05, 0.0]),)},
        rotation_orders=tuple(ROTATION_ORDERS[j % 6] for j in range(n)),
    )
    turns = Rotation.random(N_FRAMES * n, random_state=0).as_quat().reshape(N_FRAMES, n, 4)
    places = rng.normal(0, 0.2, (3, N_FRAMES, 3))
    moving = {skeleton.names[4]: places[1], skeleton.names[20]: places[2]}
    return Motion(skeleton, turns, places[0] + [0, 1, 0], 30000 / 1001, moving)


def main(bpy_python: str, others: list[Path]) -> None:
    sys.path.append(str(ROOT / "tests" / "fuzz"))
    from avatars import avatar

    os.environ["GESTUREKIT_BLENDER"] = bpy_python
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        takes, written = {}, {}
        for stem, motion in motions():
            motion = with_face(replace(motion[:N_FRAMES], info={}))
            takes[folder / f"{stem}.bvh"] = motion
            for suffix in ("bvh", "npz", "glb", "fbx"):
                # Blender's importers of these take fractional rates for others.
                rounded = replace(motion, fps=30) if suffix in ("glb", "fbx") else motion
                written[folder / f"{stem}.{suffix}"] = rounded, {}
        (folder / "me.vrm").write_bytes(avatar(0))
        motion = next(iter(takes.values()))
        for body in ("human", str(folder / "me.vrm")):
            path = folder / f"on_{Path(body).stem}.glb"
            written[path] = with_names(DrawnBody.of(motion, body).motion, body), {"body": body}
            motion.save(path, body=body)
        for path, (motion, options) in written.items():
            if not options:
                motion.save(path)
        bad = through_addon(bpy_python, Path(__file__).parent, takes)
        bad |= not valid(
            Path(bpy_python).parents[1], [path for path in written if path.suffix == ".glb"]
        )
        bad |= table(bpy_python, {path: motion for path, (motion, _) in written.items()})
    bad |= between_three_and_us(others)
    if bad:
        sys.exit("Joints are over 0.1 mm away, rates or faces differ, or a file is not valid.")


def with_face(motion: Motion) -> Motion:
    """The motion with a face that moves: ARKit's channels, and one of nobody's."""
    values = np.random.default_rng(0).uniform(0, 1, (motion.n_frames, 53))
    return replace(motion, face=gk.FaceTrack((*ARKIT, "mine"), values))


def other_face(motion: Motion, path: Path, tool: str) -> bool:
    """Print the largest difference of a face in another program; return whether it is large."""
    found = json.loads(path.with_name(f"{path.name}.{tool}.json").read_text())["face"]
    if missing := [name for name in motion.face.names if name not in found]:
        print(f"{path.name:24} {tool:8} no face channels {missing}")
        return True
    apart = max(np.abs(motion.face.channel(name) - found[name]).max() for name in motion.face.names)
    print(f"{path.name:24} {tool:8} {len(found)} face channels, {apart:.1e} apart at most")
    return apart > FACE_TOLERANCE


def with_names(motion: Motion, body: str) -> Motion:
    """The motion with the names that the joints of an avatar have in its file."""
    if body == "human":
        return motion
    found, _ = read_avatar(body)
    names = [found.gltf.json["nodes"][node]["name"] for node in found.nodes]
    rig = Skeleton(names, motion.skeleton.parents, motion.skeleton.offsets)
    return replace(motion, skeleton=rig)


def table(bpy_python: str, written: dict[Path, Motion]) -> bool:
    """Print the largest error of each file in each program; return whether any is too large."""
    here, bad = Path(__file__).parent, False
    read = {path: motion for path, motion in written.items() if path.suffix != ".npz"}
    run(bpy_python, here / "blender_positions.py", *read)
    in_three = [path for path in read if path.suffix != ".fbx"]
    for path in in_three:
        times(path, written[path].times, face=True)
    run(node(), here / "three_positions.mjs", PLAYER / "node_modules" / "three", *in_three)
    print(
        "| file | reader | joints | frames | largest error, mm | fps |\n|---|---|---|---|---|---|"
    )
    for path, motion in written.items():
        rows = [("gesturekit", *ours(path))]
        for tool in ("blender", "three"):
            if (said := path.with_name(f"{path.name}.{tool}.json")).exists():
                rows.append((tool, *theirs(path, tool, said)))
        for tool, names, frames, fps in rows:
            apart = worst(motion, path, names, frames)
            bad |= apart > TOLERANCE or not (fps is None or abs(fps / motion.fps - 1) < 1e-6)
            if tool != "gesturekit" and path.suffix in (".glb", ".fbx"):
                bad |= other_face(motion, path, tool)
            rate = "" if fps is None else f"{fps:.6g}"
            size = f"{motion.skeleton.n_joints} | {motion.n_frames}"
            print(f"| {path.name} | {tool} | {size} | {apart:.1e} | {rate} |")
    return bad


def ours(path: Path) -> tuple[list[str], np.ndarray, float]:
    """Names, positions in metres and rate, by our own reader."""
    motion = Motion.load(path)
    return list(motion.skeleton.names), motion.positions(), motion.fps


def theirs(path: Path, tool: str, said: Path) -> tuple[list[str], np.ndarray, float | None]:
    """Names, positions in metres and rate, by another program."""
    found = json.loads(said.read_text())
    frames = np.array(found["frames"], float) * (0.01 if path.suffix == ".bvh" else 1)
    names = found.get("names") or list(Motion.load(path).skeleton.names)
    return names, frames, found.get("fps")


def times(path: Path, seconds: np.ndarray, animation: int = 0, *, face: bool = False) -> None:
    """Write what three_positions.mjs is to read of a glTF file."""
    asked = {"animation": animation, "times": seconds.tolist(), "face": face}
    path.with_name(path.name + ".times.json").write_text(json.dumps(asked))


def valid(folder: Path, files: list[Path]) -> bool:
    """Print what Khronos' validator says of glTF files; return whether it finds no error."""
    validator = folder / "node_modules" / "gltf-validator"
    if not validator.exists():
        run(*find_node()[1], "install", "--prefix", folder, "--no-audit", "--no-fund", VALIDATOR)
    done = run(node(), Path(__file__).parent / "validate.mjs", validator, *files)
    found = [json.loads(line) for line in done.splitlines()]
    for one in found:
        print(
            f"{Path(one['file']).name:24} validator: {one['errors']} errors, "
            f"{one['warnings']} warnings {', '.join(one['said'][:3])}"
        )
    return not any(one["errors"] for one in found)


def between_three_and_us(files: list[Path]) -> bool:
    """Print the largest distance between our joints and those of three.js; return if too large."""
    motions, bad = {path: Motion.load(path) for path in files}, False
    for path, motion in motions.items():
        named = [one.get("name", "") for one in Gltf(path).json.get("animations", [])]
        start, called = motion.info["start"], motion.info["animation"]
        times(path, start + motion.times, named.index(called) if called in named else 0)
    script = Path(__file__).parent / "three_positions.mjs"
    run(node(), script, PLAYER / "node_modules" / "three", *files)
    for path, motion in motions.items():
        said = path.with_name(path.name + ".three.json")
        found = json.loads(said.read_text())
        for made in (said, path.with_name(path.name + ".times.json")):
            made.unlink()
        frames, apart = np.array(found["frames"], float), 0.0
        for place, name in zip(np.moveaxis(motion.positions(), 1, 0), motion.skeleton.names):
            # Several nodes may have a name.
            called = motion.info["renamed"].get(name, name)
            alike = [k for k, other in enumerate(found["names"]) if other == called]
            apart = max(
                apart, min(np.linalg.norm(frames[:, k] - place, axis=1).max() for k in alike)
            )
        size = f"{motion.skeleton.n_joints} | {motion.n_frames}"
        print(f"| {path.name} | three | {size} | {1000 * apart:.1e} | {motion.fps:.6g} |")
        bad |= 1000 * apart > TOLERANCE
    return bad


def through_addon(bpy_python: str, here: Path, written: dict[Path, Motion]) -> bool:
    """Import BVH and npz files with their sound by the add-on; return whether any is wrong."""
    addon = ROOT / "build" / "gesturekit_motion.zip"
    files = {}
    for path, motion in written.items():
        rate = 16_000
        silence = np.zeros(round(rate * motion.n_frames / motion.fps))
        soundfile.write(path.with_suffix(".wav"), silence, rate)
        motion.save(path.with_suffix(".npz"))
        files |= {path: motion, path.with_suffix(".npz"): motion}
    os.environ["BLENDER_USER_RESOURCES"] = str(next(iter(files)).parent / "blender")
    run(bpy_python, here / "blender_addon.py", addon, *files)
    bad = False
    for path, motion in files.items():
        known = {name.replace(" ", "_"): name for name in motion.skeleton.names}
        for kind in ("addon", "rig"):
            found = json.loads(path.with_name(f"{path.name}.{kind}.json").read_text())
            names = [known[name.replace(" ", "_")] for name in found["names"]]
            apart = worst(motion, path, names, np.array(found["frames"]))
            wav = [path.with_suffix(".wav").name, 1.0]
            silent = found["sound"] is None
            same_rate = abs(found["fps"] / motion.fps - 1) < 1e-6
            bad |= apart > TOLERANCE or not same_rate or not (silent or [wav] == found["sound"])
            sound = "not tested, Blender's module has none" if silent else found["sound"]
            print(
                f"{path.name:24} {kind:8} {apart:.1e} mm apart at most, "
                f"{found['fps']:.6f} fps, sound {sound}"
            )
    return bad


def worst(motion: Motion, path: Path, names: list[str], frames: np.ndarray) -> float:
    """The largest distance between our joints and theirs, mm; all of our joints must be there."""
    found = {plain(name): k for k, name in enumerate(names)}
    chosen = [found[plain(name)] for name in motion.skeleton.names]
    positions = motion.positions()
    if frames[:, chosen].shape != positions.shape:
        sys.exit(f"{path}: frames, joints and axes are {frames.shape}, not {positions.shape}")
    return 1000 * float(np.linalg.norm(frames[:, chosen] - positions, axis=-1).max())


def plain(name: str) -> str:
    """A joint's name without what Blender changes."""
    return name.replace(" ", "_")


def find_node() -> tuple[str, list[str]]:
    """Node.js, and the command of its npm."""
    bundle = runpy.run_path(str(PLAYER / "bundle.py"))
    return bundle["find_node"]() or sys.exit(f"No Node.js {bundle['OLDEST_NODE']} or newer found.")


def node() -> str:
    """Node.js, with three.js in the player's folder."""
    found, npm = find_node()
    if not (PLAYER / "node_modules" / "three").exists():
        run(*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", cwd=PLAYER)
    return found


def run(*command: object, cwd: Path | None = None) -> str:
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{command[0]} {command[1]} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.stdout


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: interop.py PYTHON-THAT-HAS-BPY [FILE ...]   (or: make interop)")
    main(sys.argv[1], [Path(name) for name in sys.argv[2:]])
