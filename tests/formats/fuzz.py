"""Mutated motion files through the readers, each case timed and its memory bounded.

Run by test_fuzz.py with a few hundred cases, and by hand with many:

    python tests/formats/fuzz.py --cases 10000

Prints one JSON object: how many were read and refused, the slowest case and the most memory
taken, and every case that broke the promise. Case n is the same on every run.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import resource
import struct
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np

from gesturekit.errors import GestureKitError
from gesturekit.formats import write_bvh, write_npz
from gesturekit.formats.smpl.skeleton import smpl_skeleton
from gesturekit.motion import Motion, Skeleton

MOST_BYTES = 500 << 20
MOST_SECONDS = 1.0
NUMBERS = (
    *(b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-400", b"-0", b"0x10", b"1_0", b"1,5"),
    *(b"", b"9" * 30, b"9" * 400, b"-1", b"1e5", b"0", b".", b"-", b"1e", b"\xd9\xa3", b"1.2.3"),
)
NAMED = r"\bkeys? '\w*'|: not a readable npz file|list of members|rates differ, '|more than 4 GiB"
"""A message names a key of the archive, unless it is no archive at all."""
WORDS = (
    *(b"ROOT", b"JOINT", b"End Site", b"OFFSET", b"CHANNELS", b"MOTION", b"Frames:", b"{", b"}"),
    *(b"Frame Time:", b"HIERARCHY", b"Xposition", b"Zrotation", b"\0", b"\r", b"\x1a", b"\xff\xfe"),
)


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
    for save in (np.savez, np.savez_compressed):
        save(folder / "base.npz", **foreign)
        files["npz"].append((folder / "base.npz").read_bytes())
    return files


# Any bytes


def flip(data: bytearray, rng: np.random.Generator) -> bytearray:
    for at in rng.integers(0, len(data), int(rng.choice([1, 1, 2, 5, 20]))):
        data[at] = rng.choice([data[at] ^ (1 << int(rng.integers(8))), int(rng.integers(256))])
    return data


def cut(data: bytearray, rng: np.random.Generator) -> bytearray:
    return data[: int(rng.integers(0, len(data)))]


def splice(data: bytearray, rng: np.random.Generator) -> bytearray:
    start, stop, to = sorted(rng.integers(0, len(data), 2)) + [int(rng.integers(0, len(data)))]
    piece = bytes(data[start:stop]) * int(rng.integers(0, 4))
    return data[:to] + piece + data[to + int(rng.integers(0, 50)) :]


def noise(data: bytearray, rng: np.random.Generator) -> bytearray:
    at = int(rng.integers(0, len(data)))
    return data[:at] + rng.bytes(int(rng.integers(1, 3000))) + data[at:]


# BVH


def numbers(data: bytearray, rng: np.random.Generator) -> bytes:
    found = list(re.finditer(rb"-?\d+(\.\d+)?", data))
    for match in sorted(rng.choice(len(found), 3), reverse=True) if found else ():
        number = NUMBERS[rng.integers(len(NUMBERS))]
        data[found[match].start() : found[match].end()] = number
    return data


def counts(data: bytearray, rng: np.random.Generator) -> bytes:
    many = rng.choice([b"0", b"-1", b"7", b"4294967295", b"9" * 18, b"9" * 19, b"9" * 5000])
    key = rng.choice([rb"(Frames:)\s*\S+", rb"(CHANNELS)\s*\S+", rb"(Frame Time:)\s*\S+"])
    return re.sub(key, rb"\1 " + many, data, count=int(rng.integers(0, 3)))


def lines(data: bytearray, rng: np.random.Generator) -> bytes:
    rows = data.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        one, two = (int(at) for at in rng.integers(0, len(rows), 2))
        change = rng.integers(5)
        if change == 0:
            rows[one], rows[two] = rows[two], rows[one]
        elif change == 1:
            del rows[one : one + 1 + int(rng.integers(3))]
        elif change == 2:
            rows[one:one] = rows[min(one, two) : max(one, two)]
        elif change == 3:
            rows[one] = rows[one] * int(rng.integers(2, 5000))
        else:
            rows.insert(one, WORDS[rng.integers(len(WORDS))])
        rows = rows or [b""]
    return b"\n".join(rows)


def nest(data: bytearray, rng: np.random.Generator) -> bytes:
    """Very deep, very wide, or very many names that are the same."""
    depth = int(rng.choice([3, 300, 2000, 5000, 20_000]))
    channels = rng.choice([b"3 Zrotation Xrotation Yrotation", b"0"])
    name = rng.choice([b"a", b"joint1", b"Left" * 30, b""])
    block = b"JOINT " + name + b"\n{\nOFFSET 0 1 0\nCHANNELS " + channels + b"\n"
    whole = block * depth + b"}" * depth if rng.integers(2) else (block + b"}\n") * depth
    at = data.find(b"JOINT")
    return data[:at] + whole + data[at:]


def recode(data: bytearray, rng: np.random.Generator) -> bytes:
    text = bytes(data).decode("latin-1")
    return text.encode(rng.choice(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp037"]))


# npz


def arrays(data: bytearray, rng: np.random.Generator) -> bytes:
    """One array of the archive is made wrong."""
    values = dict(np.load(io.BytesIO(data)))
    key = str(rng.choice(sorted(values)))
    value = values[key]
    n = value.size
    wrong = {
        "object": lambda: np.array([{"a": 1}, None], dtype=object),
        "nan": lambda: np.where(rng.random(value.shape) < 0.1, np.nan, 1.0),
        "inf": lambda: np.full(value.shape, np.inf),
        "big": lambda: np.full(value.shape, 1e308),
        "zero": lambda: np.zeros(value.shape),
        "negative": lambda: -np.ones(value.shape, dtype=int) * int(rng.integers(1, 99)),
        "huge": lambda: np.full(value.shape, 2**62),
        "text": lambda: np.array("x" * int(rng.integers(0, 50))),
        "texts": lambda: np.full(value.shape, "joint"),
        "bytes": lambda: np.frombuffer(rng.bytes(8 * n), dtype="S8"),
        "complex": lambda: np.ones(value.shape, complex),
        "bool": lambda: np.ones(value.shape, bool),
        "date": lambda: np.zeros(value.shape, "datetime64[s]"),
        "fields": lambda: np.zeros(value.shape, [("a", float), ("b", "O")])["a"],
        "record": lambda: np.zeros(value.shape, [("a", float), ("b", int)]),
        "big-endian": lambda: np.ones(value.shape, ">f4"),
        "half": lambda: np.ones(value.shape, "f2"),
        "fortran": lambda: np.asfortranarray(np.ones(value.shape)),
        "flat": lambda: value.ravel(),
        "deeper": lambda: value[None],
        "longer": lambda: np.concatenate([value.ravel(), value.ravel()]),
        "shorter": lambda: value[:-1] if value.ndim else np.array([]),
        "empty": lambda: np.zeros((0, *value.shape[1:])),
        "number": lambda: np.array(rng.normal()),
        "deep": lambda: np.ones((1,) * 60),
    }
    values[key] = wrong[str(rng.choice(sorted(wrong)))]()
    if rng.random() < 0.15:
        del values[key]
    with io.BytesIO() as out:
        np.savez(out, **values)
        return out.getvalue()


def headers(data: bytearray, rng: np.random.Generator) -> bytes:
    """One array claims a shape or type that its bytes do not bear out."""
    shapes = ("(1000000000, 3)", "(4294967296, 4294967296, 4)", "(-1,)", "(2, 9999999)", "()")
    header = rng.choice(
        [
            *(
                f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}"
                for shape in shapes
            ),
            "{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
            "{'descr': '<U999999999', 'fortran_order': False, 'shape': (3,), }",
            "{'descr': '|V4000000000', 'fortran_order': False, 'shape': (9,), }",
            "(" * 4000,
            "[" * 90 + "]" * 90,
            "{'descr': " + "[('a', " * 50 + "'<f8'" + ")]" * 50 + ", 'shape': (1,)}",
            "__import__('os').abort()",
            "{}",
            "",
        ]
    )
    header += "\n"
    magic = b"\x93NUMPY" + bytes([int(rng.choice([1, 2, 3, 9])), 0])
    size = struct.pack("<H" if magic[6] == 1 else "<I", len(header))
    names = zipfile.ZipFile(io.BytesIO(data)).namelist()
    wrong = magic + size + header.encode() + rng.bytes(int(rng.integers(0, 200)))
    return rezipped(data, {str(rng.choice(names)): wrong})


def bomb(data: bytearray, rng: np.random.Generator) -> bytes:
    """A few bytes that unpack to many megabytes."""
    n = int(rng.choice([10**6, 4 * 10**6, 7 * 10**7], p=[0.4, 0.4, 0.2]))
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({n}, 1), }}\n".encode()
    key = str(rng.choice(["poses", "rotations", "trans", "extra"]))
    with io.BytesIO() as out:
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            old = zipfile.ZipFile(io.BytesIO(data))
            for name in old.namelist():
                if name != f"{key}.npy":
                    archive.writestr(name, old.read(name))
            with archive.open(f"{key}.npy", "w", force_zip64=True) as entry:
                entry.write(b"\x93NUMPY\x01\0" + struct.pack("<H", len(head)) + head)
                zeros = bytes(1 << 22)
                for _ in range(n * 8 // len(zeros)):
                    entry.write(zeros)
                entry.write(zeros[: n * 8 % len(zeros)])
        return out.getvalue()


def entries(data: bytearray, rng: np.random.Generator) -> bytes:
    """Names, methods and flags of the archive's entries."""
    old = zipfile.ZipFile(io.BytesIO(data))
    methods = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    with io.BytesIO() as out:
        with zipfile.ZipFile(out, "w") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # duplicate names are meant
            for name in old.namelist():
                as_name = name if rng.random() < 0.7 else str(rng.choice(ENTRY_NAMES))
                archive.writestr(as_name, old.read(name), compress_type=int(rng.choice(methods)))
        raw = bytearray(out.getvalue())
    # Flags (encrypted, ...), method and sizes in the central directory.
    for at in (match.start() for match in re.finditer(b"PK\x01\x02", raw)):
        if rng.random() < 0.1 and at + 28 < len(raw):
            raw[at + int(rng.integers(6, 28))] = int(rng.integers(256))
    return bytes(raw)


ENTRY_NAMES = ("../../up.npy", "/etc/passwd", "rotations", "poses.npy", "a/b.npy", ".npy", "é.npy")


def rezipped(data: bytes, changed: dict[str, bytes]) -> bytes:
    old = zipfile.ZipFile(io.BytesIO(data))
    with io.BytesIO() as out:
        with zipfile.ZipFile(out, "w") as archive:
            for name in old.namelist():
                archive.writestr(name, changed.get(name, old.read(name)))
        return out.getvalue()


ANY = (flip, cut, splice, noise)
MUTATIONS = {
    "bvh": (*ANY, numbers, numbers, counts, lines, lines, nest, recode),
    "npz": (*ANY, arrays, arrays, arrays, arrays, headers, headers, entries, bomb),
}


def mutated(files: dict[str, list[bytes]], number: int) -> tuple[str, str, bytes]:
    """Format, name of the mutation, and contents of case `number`."""
    rng = np.random.default_rng(number)
    suffix = ("bvh", "npz")[number % 2]
    change = MUTATIONS[suffix][rng.integers(len(MUTATIONS[suffix]))]
    base = files[suffix][rng.integers(len(files[suffix]))]
    data = bytes(change(bytearray(base), rng))
    if suffix == "bvh" and data and rng.random() < 0.2:
        data = bytes(flip(bytearray(data), rng))
    return suffix, change.__name__, data


def what_went_wrong(path: Path) -> tuple[str, str]:
    """ "read", "refused" or "broken", and why."""
    try:
        motion = Motion.load(path)
        assert np.isfinite(motion.positions()).all(), "positions that are not finite"
        return "read", ""
    except GestureKitError as error:
        message, cause = str(error), error
        while cause is not None:
            if isinstance(cause, MemoryError):
                return "broken", f"over {MOST_BYTES >> 20} MB: {message}"
            cause = cause.__context__
        if str(path) not in message or len(message) > 1000:
            return "broken", f"no file named, or too much said: {message[:500]}"
        if path.suffix == ".bvh" and not re.search(rf"{re.escape(str(path))}:\d+: ", message):
            return "broken", f"no line named: {message}"
        if path.suffix == ".npz" and not re.search(NAMED, message):
            return "broken", f"no key named: {message}"
        return "refused", message.split(str(path))[-1]
    except BaseException:
        return "broken", traceback.format_exc(limit=-4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--show", action="store_true", help="print what was said of each case")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(name)
        files = base_files(folder)
        for suffix in files:
            (folder / f"case.{suffix}").write_bytes(files[suffix][0])
            Motion.load(folder / f"case.{suffix}")  # everything is imported
        summary = run(options, folder, files)
    print(json.dumps(summary, indent=1))


def run(options: argparse.Namespace, folder: Path, files: dict[str, list[bytes]]) -> dict:
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    results: Counter[str] = Counter()
    broken, slowest, largest = [], (0.0, ""), (0, "")
    for number in range(options.first, options.first + options.cases):
        suffix, change, data = mutated(files, number)
        path = folder / f"case.{suffix}"
        path.write_bytes(data)
        what = f"{number} ({change} of {suffix})"
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.process_time()
        resource.setrlimit(resource.RLIMIT_AS, (size + MOST_BYTES, resource.RLIM_INFINITY))
        result, why = what_went_wrong(path)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        seconds = time.process_time() - start
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10
        slowest = max(slowest, (round(seconds, 3), what))
        largest = max(largest, (grown, what))
        results[f"{suffix} {result}"] += 1
        if seconds > MOST_SECONDS:
            broken.append(f"{what}: {seconds:.2f} s ({result})")
        if result == "broken":
            broken.append(f"{what}: {why}")
        if options.show:
            print(f"{what}: {result} {why}")
    return {
        "cases": options.cases,
        "results": dict(sorted(results.items())),
        "slowest": slowest,
        "largest_growth_mb": largest,
        "broken": broken,
    }


if __name__ == "__main__":
    main()
