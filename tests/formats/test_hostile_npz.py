"""Hostile npz files: one error of ours, in little memory."""

import io
import re
import struct
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from rigs import at_rest

from gesturekit.errors import FormatError
from gesturekit.formats import read_npz, write_npz
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion.body_model import BodyModel

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
    with zipfile.ZipFile(path, "w", method, compresslevel=1) as archive:
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
    """Error and peak of memory in bytes of a reading that must fail or succeed cleanly."""
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
        error = None
    except FormatError as caught:
        error = str(caught)
        assert str(path) in error
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 500 * MEGABYTE, (error, peak)
    return error, peak


def zeros(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    """An array of zeros without having it: its header, and as many bytes as it declares."""
    return promise(repr(shape), dtype) + bytes(int(np.prod(shape)) * np.dtype(dtype).itemsize)


def test_bombs_are_not_unpacked(tmp_path):
    bomb = zeros((60_000, 165))  # 76 MiB, deflated to a thousandth
    path = pack(tmp_path / "a.npz", amass_members() | {"poses": bomb}, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < MEGABYTE
    error, peak = peak_of(path)
    assert "'poses'" in error and "76 MiB" in error
    assert peak < 10 * MEGABYTE


def test_members_within_the_limit_are_read_until_their_sum_is_beyond_it(tmp_path):
    members = amass_members() | {"poses": zeros((11_000, 165)), "trans": zeros((11_000, 3))}
    path = pack(tmp_path / "a.npz", members, zipfile.ZIP_DEFLATED)
    assert peak_of(path)[0] is None
    more = {"expressions": zeros((16_000, 165))}  # 20 MiB after 14 MiB
    path = pack(tmp_path / "a.npz", members | more, zipfile.ZIP_DEFLATED)
    assert "'expressions'" in peak_of(path)[0]


@pytest.mark.parametrize(
    ("key", "content", "says"),
    [
        ("poses", promise("(1000000000,72)"), "'poses'"),
        ("poses", promise("(99999999999,)", "<U0"), "poses"),
        ("poses", header("(" * 1000 + "\n"), "'poses'"),
        ("poses", promise("(1,)", "|O") + b"c", "pickled"),
        ("poses", zeros((0, 72)), "'trans'"),
        ("trans", npy(np.array([2**31], "<u4").view("<U1")), "characters"),
    ],
)
def test_headers_that_promise_too_much(tmp_path, key, content, says):
    path = pack(tmp_path / "a.npz", amass_members() | {key: content})
    error, peak = peak_of(path)
    assert says in error
    assert peak < 50 * MEGABYTE


@pytest.mark.parametrize(
    ("key", "content", "says"),
    [
        ("gk_version", npy(2), r"(?=.*'gk_version').*\b2"),
        ("names", zeros((100_000,), "<U8"), "100000"),
        ("names", npy(np.full(24, 2**31, "<u4").view("<U1")), "characters"),
        ("parents", zeros((2_000_000,), "<i8"), "(?=.*'parents').*shape"),
        ("parents", npy(np.full(24, 2**62)), r"(?=.*'parents').*\b23\b"),
        ("parents", npy(np.full(24, -2)), "(?=.*'parents').*-1 to 23"),
        ("parents", npy(np.zeros((24, 1), int)), r"\(24, 1\)"),
        ("parents", npy(np.zeros(24)), "float64"),
        ("end_site_joints", npy([-1]), "(?=.*'end_site_joints').*0 to 23"),
        ("body_pelvis", npy([0.1, 0.2, np.nan]), r"(?=.*'body_pelvis').*\(3,\)"),
        ("end_site_joints", npy([24]), r"(?=.*'end_site_joints').*\b23\b"),
        ("moving_joints", npy([99]), "'moving_joints'"),
        ("rotations", npy(np.zeros((5, 23, 4))), "'rotations'"),
        ("rotations", npy(np.full((5, 24, 4), np.nan)), "frame 0"),
        ("fps", npy(np.nan), "(?=.*'fps')(?=.*nan).*100000"),
    ],
)
def test_native_files_that_promise_too_much_or_contradict_themselves(tmp_path, key, content, says):
    path = pack(tmp_path / "a.npz", native_members(tmp_path) | {key: content})
    error, _ = peak_of(path)
    assert re.search(says, error)


def test_hostile_body_models(tmp_path, capsule_body):
    members = {key: npy(value) for key, value in capsule_body(24).items()}
    assert BodyModel.load(pack(tmp_path / "a.npz", members)).n_joints == 24
    del members["posedirs"]
    for key, content in (
        ("shapedirs", zeros((30_000, 3, 50))),
        ("v_template", zeros((500_000, 3))),
        ("weights", zeros((300, 2_000))),
        ("f", npy(np.array([[{}]], dtype=object))),
        ("posedirs", promise("(1000000000,3)")),
    ):
        path = pack(tmp_path / "a.npz", members | {key: content}, zipfile.ZIP_DEFLATED)
        error, peak = peak_of(path, BodyModel.load)
        assert key in error and peak < 100 * MEGABYTE
