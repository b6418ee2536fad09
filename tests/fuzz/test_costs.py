"""Hostile files and requests: memory and time stay in proportion to the size of the file."""

import http.client
import io
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import soundfile
from avatars import avatar, avatar_json, packed
from gltf_files import GltfFile
from PIL import Image

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
READER = """
import json, sys, time, warnings
from audio_features import AudioFeaturesError, Wave
from audio_features.words import load_words
from gesturekit import load
from gesturekit.corpus import Manifest
from gesturekit.errors import GestureKitError
from gesturekit.inspection import inspect
from gesturekit.motion import Motion
from gesturekit.viewer.drawn_body import load_avatar
way, *files, out = sys.argv[1:]

def memory(key):
    return int(open("/proc/self/status").read().split(key)[1].split()[0]) << 10

def write(path):
    Motion.load(files[0]).save(out, body=path)

ways = {"view": load_avatar, "read": Motion.load, "write": write, "words": load_words}
ways |= {"sound": Wave.load, "inspect": inspect, "model": load, "manifest": Manifest.load}
warnings.simplefilter("ignore")
for path in files:  # the first is harmless, and imports what is needed
    open("/proc/self/clear_refs", "w").write("5")  # forget the peak so far
    before, begun, error = memory("VmRSS:"), time.process_time(), ""
    try:
        ways[way](path)
    except (GestureKitError, AudioFeaturesError) as refused:
        error = str(refused)
print(json.dumps([memory("VmHWM:") - before, time.process_time() - begun, error]))
"""
DEMO = Path(__file__).parents[2] / "gesturekit" / "models" / "demo"


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


def textgrid(n):
    tier = f'class = "IntervalTier"\nname = "words"\nxmin = 0\nxmax = {n}\nintervals: size = {n}\n'
    head = 'File type = "ooTextFile"\nObject class = "TextGrid"\n'
    head += f"xmin = 0\nxmax = {n}\ntiers? <exists>\nsize = 1\nitem []:\nitem [1]:\n{tier}"
    rows = (f'intervals [{k + 1}]:\nxmin = {k}\nxmax = {k + 1}\ntext = "a"\n' for k in range(n))
    return (head + "".join(rows)).encode()


def captions(n, between="\n", head=""):
    return (head + f"00:00:00,000 --> 00:00:01,000\nhello\n{between}" * n).encode()


def flac(n, rate=655_350):
    soundfile.write(out := io.BytesIO(), np.zeros(n, np.int16), rate, format="FLAC")
    return out.getvalue()


def wav(rate, seconds=0, samples=1000):
    data = bytes(2 * (samples + seconds * rate))
    form = struct.pack("<HHIIHH", 1, 1, rate, min(2 * rate, 2**32 - 1), 2, 16)
    body = (
        b"WAVEfmt " + struct.pack("<I", 16) + form + b"data" + struct.pack("<I", len(data)) + data
    )
    return b"RIFF" + struct.pack("<I", len(body)) + body


def bvh(n_joints, n_ends=0, deep=False):
    channels, end = "CHANNELS 3 Zrotation Xrotation Yrotation", "End Site\n{\nOFFSET 0 5 0\n}\n"
    heads = [f"JOINT j{k}\n{{\nOFFSET 0 5 0\n{channels}\n" for k in range(n_joints)]
    middle = "".join(heads) + end + "}\n" * n_joints if deep else (end + "}\n").join([*heads, ""])
    root = f"HIERARCHY\nROOT a\n{{\nOFFSET 0 90 0\n{channels}\n{middle}{end * n_ends}}}\n"
    row = " ".join(["0"] * 3 * (n_joints + 1))
    return f"{root}MOTION\nFrames: 2\nFrame Time: 0.04\n{row}\n{row}\n".encode()


def model(change):
    """Return a function that makes the bundled model, changed by `change(folder)`."""

    def make(folder):
        shutil.copytree(DEMO, folder)
        change(folder)

    return make


def setting(old, new):
    def change(folder):
        text = (folder / "config.yaml").read_text()
        assert old in text
        (folder / "config.yaml").write_text(text.replace(old, new))

    return model(change)


def empty_tensors(folder, n=1_000_000):
    empty = '{"dtype":"F32","shape":[0],"data_offsets":[0,0]}'
    text = "{" + ",".join(f'"{k}":{empty}' for k in range(n)) + "}"
    (folder / "model.safetensors").write_bytes(struct.pack("<Q", len(text)) + text.encode())


def pipe(name):
    def change(folder):
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return model(change)


POST = b"POST /motion HTTP/1.1\r\nHost: localhost\r\n"
LONG = (
    b"POST /motion?format=html&fps=1000 HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n%s"
)
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
    "TextGrid": ("words", lambda: textgrid(500_000), ".TextGrid"),
    "srt": ("words", lambda: captions(800_000), ".srt"),
    "vtt": ("words", lambda: captions(800_000, head="WEBVTT\n\n"), ".vtt"),
    "captions in one": ("words", lambda: captions(105_000, ""), ".srt"),
    "flac": ("sound", lambda: flac(200 << 20), ".flac"),
    "rate of a wav": ("sound", lambda: wav(4_000_000_000), ".wav"),
    "star": ("inspect", lambda: bvh(990), ".bvh"),
    "star of 3,000": ("inspect", lambda: animated(3000, 2, seconds=1)),
    "children": ("inspect", lambda: named([*map(str, range(4000))])),
    "chain": ("inspect", lambda: bvh(900, deep=True), ".bvh"),
    "ends of a bvh": ("inspect", lambda: bvh(20, 1900), ".bvh"),
    "levels": ("model", setting("levels: 8", "levels: 1000000000"), ""),
    "smooth": ("model", setting("smooth: 0.083", "smooth: 1e9"), ""),
    "empty tensors": ("model", model(empty_tensors), ""),
    "pipe of tensors": ("model", pipe("model.safetensors"), ""),
    "pipe of a skeleton": ("model", pipe("skeleton.json"), ""),
    "pipe of a manifest": ("manifest", os.mkfifo, ".jsonl"),
    "1000 fps": ("serve", lambda: [LONG % (len(sound := wav(8000, 599)), sound)], ""),
    "slow headers": ("serve", lambda: [POST] * 99, ""),
    "idle": ("serve", lambda: [b""] * 99, ""),
    "files": ("write", lambda: changed(lambda found, _: found["images"].extend([BESIDE] * 500))),
}


def cost(folder, attack, timeout=120):
    """Return the size of the file, memory over that before (MB), seconds, and the error."""
    way, make, *suffix = ATTACKS[attack]
    if way == "serve":
        return cost_of_requests(make(), timeout)
    harmless = {"words": captions(3), "sound": wav(8000), "inspect": bvh(9), "manifest": b"{}"}
    ending = suffix[0] if suffix else ".glb"
    first, path = folder / f"harmless{ending}", folder / f"a{ending}"
    if ending == ".glb":
        harmless[way] = (avatar(1) if way in ("view", "write") else animated(4, 4)) + bytes(5 << 20)
    first.write_bytes(harmless.get(way, b""))
    given = DEMO if way == "model" else first
    content = make(path) if way in ("model", "manifest") else make()
    if content is not None:
        path.write_bytes(content)
    command = [sys.executable, "-c", READER, way, given, path, folder / "out.glb"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, env=environment)
    assert done.returncode == 0, done.stderr
    memory, seconds, error = json.loads(done.stdout)
    size = sum(file.stat().st_size for file in (path, *path.glob("*")))
    return size / 1e6, memory / 1e6, seconds, error


def cost_of_requests(requests, timeout):
    """Return what requests of one client cost a server until another client has an answer."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "gesturekit", "serve", "--model", "demo", "--port", str(port)]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    status = Path(f"/proc/{server.pid}/status")

    def memory(key):
        return int(status.read_text().split(key)[1].split()[0]) / 1e3

    def ask(client):
        asked = http.client.HTTPConnection("127.0.0.1", port, timeout, (client, 0))
        asked.request("POST", "/motion?format=npz", wav(8000, 1))
        return asked.getresponse().status

    try:
        assert "Serving" in server.stderr.readline() and ask("127.0.0.3") == 200
        status.with_name("clear_refs").write_text("5")
        before, begun = memory("VmRSS:"), time.monotonic()
        held = [socket.create_connection(("127.0.0.1", port), timeout) for _ in requests]
        for line, request in zip(held, requests, strict=True):
            line.sendall(request)
        if requests[0].startswith(LONG[:20]):
            held[0].recv(1)
        time.sleep(0.2)
        answer, seconds = ask("127.0.0.2"), time.monotonic() - begun
        return sum(map(len, requests)) / 1e6, memory("VmHWM:") - before, seconds, str(answer)
    finally:
        server.kill()
        server.communicate()


@pytest.mark.stress
@pytest.mark.parametrize("attack", ATTACKS)
def test_hostile_files_cost_no_more_than_their_size_allows(tmp_path, attack):
    size, memory, seconds, error = cost(tmp_path, attack)
    print(f"| {attack} | {size:.1f} MB | {memory:.0f} MB | {seconds:.1f} s | {error[-70:]} |")
    beside = 5.3 if attack == "files" else 0
    assert memory < 300 + 20 * (size + beside) and seconds < 5 + size
    assert ATTACKS[attack][0] != "serve" or error == "200", "another client is served"


def test_what_is_shared_is_decoded_once(tmp_path):
    """Decoded for each user of it, the file would be over the limits, and refused."""
    _, memory, seconds, error = cost(tmp_path, "skins")
    assert not error and memory < 100 and seconds < 10
