"""Hostile glTF files: memory and processor time stay in proportion to the size of the file."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from avatars import avatar, avatar_json, packed
from gltf_files import GltfFile
from PIL import Image

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
READER = """
import json, sys, time, warnings
from gesturekit.errors import GestureKitError
from gesturekit.motion import Motion
from gesturekit.viewer.avatars import load_avatar
way, *files, out = sys.argv[1:]

def memory(key):
    return int(open("/proc/self/status").read().split(key)[1].split()[0]) << 10

warnings.simplefilter("ignore")
for path in files:  # the first is harmless, and imports what is needed
    open("/proc/self/clear_refs", "w").write("5")  # forget the peak so far
    before, begun, error = memory("VmRSS:"), time.process_time(), ""
    try:
        if way == "view":
            load_avatar(path)
        elif way == "read":
            Motion.load(path)
        else:
            Motion.load(files[0]).save(out, body=path)
    except GestureKitError as refused:
        error = str(refused)
print(json.dumps([memory("VmHWM:") - before, time.process_time() - begun, error]))
"""


def animated(n_joints, n_keys, n_animations=1, dtype="<f4", shared=True, seconds=400, deep=False):
    """Joints that stand still, with keys in the same accessors or each in its own."""
    nodes = [{"name": f"j{k}", "translation": [0, 0.1, 0]} for k in range(n_joints)]
    for k in range(n_joints - 1):
        nodes[k if deep else 0].setdefault("children", []).append(k + 1)
    file = GltfFile(nodes, [[*range(n_joints)[-2 if deep else 0 :]]])
    turns = np.tile([0, 0, 0, 1 if dtype == "<f4" else 127], (n_keys, 1))
    turn = file.array(turns, dtype, normalized=dtype != "<f4")
    times = file.array(np.linspace(0, seconds, n_keys))
    joints, accessors = range(n_joints)[-2 if deep else 0 :], file.json["accessors"]
    for _ in range(n_animations):
        outputs = [turn] * n_joints if shared else range(len(accessors), len(accessors) + n_joints)
        accessors += [accessors[turn]] * (0 if shared else n_joints)
        samplers = [{"input": times, "output": output} for output in outputs]
        targets = [{"node": joint, "path": "rotation"} for joint in joints]
        channels = [{"sampler": k, "target": target} for k, target in enumerate(targets)]
        file.json["animations"].append({"samplers": samplers, "channels": channels})
    return file.glb()


def named(names, **more):
    nodes = [{"name": "a", "children": [*range(1, len(names) + 1)]}]
    return GltfFile([*nodes, *({"name": name, **more} for name in names)], [[0, 1]]).glb()


def changed(change, *arguments, **more):
    """A VRM avatar, changed by a function that adds bytes and arrays with add(values)."""
    found, data = avatar_json(1)

    def add(values, kind="", component=0):
        nonlocal data
        content = values if isinstance(values, bytes) else values.tobytes()
        view = {"buffer": 0, "byteOffset": len(data), "byteLength": len(content)}
        found["bufferViews"].append(view)
        data += content + bytes(-len(content) % 4)
        at = {"bufferView": len(found["bufferViews"]) - 1, "count": len(values)}
        found["accessors"].append(at | {"type": kind, "componentType": component})
        return len(found["accessors"]) - 1

    change(found, add, *arguments, **more)
    found["buffers"] = [{"byteLength": len(data)}]
    return packed(found, data)


def meshes(found, add, nodes=1, pieces=300, alpha=1, **mode):
    """Pieces of mesh that share 5,000 triangles."""
    material = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, alpha]}}
    found["materials"].append(material | {"alphaMode": "BLEND"})
    rng = np.random.default_rng(1)
    places = add(rng.random((5000, 3)).astype("<f4"), "VEC3", 5126)
    corners = add(rng.integers(0, 5000, 15_000).astype("<u2"), "SCALAR", 5123)
    piece = {"attributes": {"POSITION": places}, "indices": corners, "material": 1, **mode}
    found["meshes"].append({"primitives": [piece] * pieces})
    found["nodes"] += [{"mesh": 1, "translation": [20 * k, 0, 0]} for k in range(nodes)]


def skins(found, add):
    found["skins"] = [{"joints": [0] * 20_000}]
    found["meshes"][0]["primitives"] *= 4000
    found["accessors"][4]["count"] = 3


def images(found, add, n=20, side=8000, mode="RGBA"):
    Image.new(mode, (side, side)).save(out := io.BytesIO(), "PNG")
    view = found["accessors"][add(out.getvalue())]["bufferView"]
    found["images"] = [{"bufferView": view}] * n
    found["textures"] = [{"source": k} for k in range(n)]
    surfaces = [{"baseColorTexture": {"index": k}} for k in range(n)]
    found["materials"] = [{"pbrMetallicRoughness": surface} for surface in surfaces]
    piece = found["meshes"][0]["primitives"][0]
    found["meshes"][0]["primitives"] = [piece | {"material": k} for k in range(n)]


BESIDE = {"uri": "harmless.glb"}
ENDS = {"gesturekit_end_site": 1}
ATTACKS = {
    "shared keys": ("read", lambda: animated(2000, 20_000)),
    "accessors": ("read", lambda: animated(19_990, 2, shared=False, seconds=1)),
    "animations": ("read", lambda: animated(490, 2, 40, shared=False, seconds=1)),
    "normalised": ("read", lambda: animated(20, 7 << 20, dtype="i1", seconds=100)),
    "frames": ("read", lambda: animated(10, 2, seconds=6000) + bytes(9 << 20)),
    "deep": ("read", lambda: animated(1000, 2, seconds=10_000, deep=True)),
    "nodes": ("read", lambda: animated(20_000, 2, seconds=1.3)),
    "end sites": ("read", lambda: named([*map(str, range(19_999))], extras=ENDS)),
    "long name": ("view", lambda: named(["x" * 200_000] * 2)),
    "invisible": ("view", lambda: changed(meshes, 200, alpha=0)),
    "lines": ("view", lambda: changed(meshes, 15_000, 20_000, mode=1)),
    "skins": ("view", lambda: changed(skins)),
    "scattered": ("view", lambda: changed(meshes, nodes=38, pieces=1)),
    "images": ("view", lambda: changed(images)),
    "small images": ("view", lambda: changed(images, 4000, 512, "L")),
    "files": ("write", lambda: changed(lambda found, _: found["images"].extend([BESIDE] * 500))),
}


def cost(folder, attack):
    """Return the size of the file, memory over that before (MB), seconds, and the error."""
    way, make = ATTACKS[attack]
    harmless, path = folder / "harmless.glb", folder / "a.glb"
    harmless.write_bytes((animated(4, 4) if way == "read" else avatar(1)) + bytes(5 << 20))
    path.write_bytes(make())
    command = [sys.executable, "-c", READER, way, harmless, path, folder / "out.glb"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)
    assert done.returncode == 0, done.stderr
    memory, seconds, error = json.loads(done.stdout)
    return path.stat().st_size / 1e6, memory / 1e6, seconds, error


@pytest.mark.stress
@pytest.mark.parametrize("attack", ATTACKS)
def test_hostile_files_cost_no_more_than_their_size_allows(tmp_path, attack):
    size, memory, seconds, _ = cost(tmp_path, attack)
    beside = 5.3 if attack == "files" else 0
    assert memory < 300 + 20 * (size + beside) and seconds < 5 + size


@pytest.mark.parametrize("attack", ["shared keys", "skins"])
def test_what_is_shared_is_decoded_once(tmp_path, attack):
    size, memory, seconds, error = cost(tmp_path, attack)
    assert memory < 100 and seconds < 2 and ("a.glb: " in error or not error)
