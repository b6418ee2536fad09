"""Broken and hostile npz files: one error of ours, quickly, in little memory.

GESTUREKIT_MUTATIONS=10000 python -m pytest -s tests/formats/test_hostile_npz.py makes that many and
prints the slowest and the largest.
"""

from __future__ import annotations

import io
import os
import struct
import time
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from rigs import at_rest

from gesturekit.errors import FormatError
from gesturekit.formats import read_npz, write_npz
from gesturekit.formats.smpl.skeleton import smpl_skeleton
from gesturekit.motion.body_model.model import BodyModel

N_MUTATIONS = int(os.environ.get("GESTUREKIT_MUTATIONS", "300"))
MEGABYTE = 1 << 20


def npy(array) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, np.asarray(array), allow_pickle=True)
    return out.getvalue()


def header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def promise(shape: str, dtype: str = "<f8") -> bytes:
    """The header of an array without the array."""
    return header(f"{{'descr':'{dtype}','fortran_order':False,'shape':{shape}}}\n")


def pack(path, members, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def amass_members(n_frames=5):
    return {
        "poses": npy(np.full((n_frames, 72), 0.1)),
        "trans": npy(np.zeros((n_frames, 3))),
        "betas": npy(np.ones(10)),
        "gender": npy("neutral"),
        "mocap_framerate": npy(30.0),
    }


def native_members(tmp_path):
    write_npz(at_rest(smpl_skeleton(24), 5), tmp_path / "native.npz")
    with zipfile.ZipFile(tmp_path / "native.npz") as archive:
        return {info.filename[:-4]: archive.read(info) for info in archive.infolist()}


def peak_of(path, read=read_npz):
    """Error, peak of memory in bytes and seconds of a reading that must fail or succeed cleanly."""
    tracemalloc.start()
    begin = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
        error = None
    except FormatError as caught:
        error = str(caught)
        assert str(path) in error
    seconds = time.perf_counter() - begin
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 500 * MEGABYTE, (error, peak)
    return error, peak, seconds


def zeros(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    """An array of zeros without having it: its header, and as many bytes as it declares."""
    return promise(repr(shape), dtype) + bytes(int(np.prod(shape)) * np.dtype(dtype).itemsize)


def test_bombs_are_not_unpacked(tmp_path):
    bomb = zeros((60_000, 165))  # 76 MiB, deflated to a thousandth
    path = pack(tmp_path / "a.npz", amass_members() | {"poses": bomb}, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < MEGABYTE
    error, peak, _ = peak_of(path)
    assert "'poses' unpacks to 76 MiB" in error
    assert peak < 10 * MEGABYTE


def test_members_within_the_limit_need_bounded_memory(tmp_path):
    poses = zeros((20_000, 165))  # 25 MiB
    members = amass_members() | {"poses": poses, "trans": zeros((20_000, 3))}
    path = pack(tmp_path / "a.npz", members, zipfile.ZIP_DEFLATED)
    assert peak_of(path)[0] is None
    path = pack(tmp_path / "a.npz", members | {"expressions": poses}, zipfile.ZIP_DEFLATED)
    assert "'expressions' unpacks to" in peak_of(path)[0]


@pytest.mark.parametrize(
    ("key", "content", "says"),
    [
        ("poses", promise("(10**9,72)"), "'poses'"),
        ("poses", promise("(9999999999,72)"), "72)"),
        ("poses", promise("(-5,72)"), "'poses'"),
        ("poses", promise("(99999999999,)", "<U0"), "poses"),
        ("poses", header("(" * 5000 + "\n"), "'poses' cannot be read"),
        ("poses", header("[" * 9000 + "]" * 900 + "\n"), "'poses' cannot be read"),
        ("poses", promise("(1,)", "|O") + b"c", "pickled"),
        ("poses", b"\x93NUMPY\x09\x00", "'poses' cannot be read"),
        ("poses", b"", "'poses' cannot be read"),
        ("poses", zeros((0, 72)), "'trans' has shape"),
        ("betas", zeros((500_000,)), "'betas' has shape"),
        ("mocap_framerate", zeros((2,)), "'mocap_framerate' has shape"),
        ("trans", npy(np.array([2**31], "<u4").view("<U1")), "characters that do not exist"),
    ],
)
def test_headers_that_promise_too_much(tmp_path, key, content, says):
    path = pack(tmp_path / "a.npz", amass_members() | {key: content})
    error, peak, _ = peak_of(path)
    assert says in error
    assert peak < 50 * MEGABYTE


@pytest.mark.parametrize(
    ("key", "content", "says"),
    [
        ("names", zeros((100_000,), "<U8"), "100000 texts, too many"),
        ("names", npy(np.full(24, 2**31, "<u4").view("<U1")), "characters that do not exist"),
        ("end_site_joints", zeros((1_000_000,), "<i8"), "'end_site_joints' has shape"),
        ("parents", zeros((2_000_000,), "<i8"), "'parents' has shape"),
        ("parents", npy(np.full(24, 2**62)), "'parents' holds a joint index outside -1 to 23"),
        ("gk_version", npy(10**9), "'gk_version' is 1000000000"),
        ("gk_version", npy([1, 1]), "'gk_version' is an array of shape (2,)"),
        ("body_pelvis", npy([0.1, 0.2]), "'body_pelvis' has shape (2,)"),
        ("body_pelvis", npy([0.1, 0.2, np.nan]), "'body_pelvis' has shape (3,)"),
        ("end_site_joints", npy([24]), "'end_site_joints' holds a joint index outside 0 to 23"),
        ("moving_joints", npy([-1, 3]), "'moving_joints' holds a joint index outside 0 to 23"),
        ("moving_joints", npy([3, 3, 3]), "has 0 entries, but 'moving_joints' has 3"),
        ("joint_translations", npy(0.5), "has one number, but 'moving_joints' has 0"),
        ("end_site_joints", npy([-1]), "'end_site_joints' holds a joint index"),
        ("parents", npy(np.linspace(0, 1, 24)), "'parents' has shape (24,) of float64"),
        ("rotations", npy(np.full((5, 24, 4), np.nan)), "frame 0"),
        ("fps", npy(np.nan), "'fps': fps is nan; expected 1e-05 to 100000"),
        ("fps", npy(1e-300), "'fps': fps is 1e-300"),
    ],
)
def test_native_files_that_promise_too_much(tmp_path, key, content, says):
    path = pack(tmp_path / "a.npz", native_members(tmp_path) | {key: content})
    error, _, _ = peak_of(path)
    assert says in error


def test_lists_of_members_that_are_no_list_of_arrays(tmp_path):
    path = tmp_path / "many.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for n in range(25_000):
            archive.writestr(f"{n}.npy", b"")
    error, peak, _ = peak_of(path)
    assert "list of members" in error and peak < 10 * MEGABYTE
    # The same behind the end record of larger archives, which zipfile would follow.
    end = path.read_bytes()[-22:]
    locator = b"PK\6\7" + bytes(16)
    path.write_bytes(path.read_bytes()[:-22] + locator + end[:12] + bytes(4) + end[16:])
    assert "4 GiB" in peak_of(path)[0]
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        assert "numpy never does" in peak_of(pack(path, amass_members(), method))[0]


def test_hostile_body_models(tmp_path, capsule_body):
    members = {key: npy(value) for key, value in capsule_body(24).items()}
    assert BodyModel.load(pack(tmp_path / "a.npz", members)).n_joints == 24
    for key, content in (
        ("shapedirs", zeros((60_000, 3, 50))),
        ("v_template", zeros((500_000, 3))),
        ("weights", zeros((300, 2_000))),
        ("f", npy(np.array([[{}]], dtype=object))),
        ("posedirs", promise("(10**9,3)")),
    ):
        path = pack(tmp_path / "a.npz", members | {key: content}, zipfile.ZIP_DEFLATED)
        assert peak_of(path, BodyModel.load)[0]


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(content)
    kind = rng.integers(5)
    if kind == 0:
        for at in rng.integers(0, len(data), rng.integers(1, 20)):
            data[at] ^= 1 << rng.integers(8)
    elif kind == 1:
        del data[rng.integers(0, len(data)) :]
    elif kind == 2:
        at = rng.integers(0, len(data))
        data[at : at + rng.integers(1, 64)] = rng.bytes(rng.integers(0, 64))
    elif kind == 3:  # numbers of the header grow
        for digit in b"123456789":
            if rng.random() < 0.3:
                data = data.replace(bytes([digit]), b"9" * int(rng.integers(1, 12)), 1)
    else:
        word = [b"\xff" * 8, b"\x00\x00\x00\x00\x00\x00\xf8\x7f", b"\x7f" * 8][rng.integers(3)]
        at = rng.integers(0, max(1, len(data) - 8))
        data[at : at + 8] = word
    return bytes(data)


def test_mutated_files(tmp_path):
    rng = np.random.default_rng(0)
    kinds = [amass_members(), native_members(tmp_path)]
    worst = {"seconds": (0.0, None), "peak": (0, None)}
    read = 0
    for n in range(N_MUTATIONS):
        members = dict(kinds[n % 2])
        method = zipfile.ZIP_DEFLATED if n % 3 == 0 else zipfile.ZIP_STORED
        path = tmp_path / "a.npz"
        if n % 4 < 2:  # within an array, the archive around it sound
            for key in rng.choice(list(members), rng.integers(1, 4)):
                members[key] = mutated(members[key], rng)
            pack(path, members, method)
        else:
            pack(path, members, method)
            path.write_bytes(mutated(path.read_bytes(), rng))
        error, peak, seconds = peak_of(path)
        read += error is None
        for key, value in (("seconds", seconds), ("peak", peak)):
            if value > worst[key][0]:
                worst[key] = (value, n)
    print(f"{N_MUTATIONS} files, {read} of them still readable; worst {worst}")
    assert 0 < read < N_MUTATIONS
