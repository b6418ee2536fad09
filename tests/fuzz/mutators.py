"""Seeded mutators: bytes in, bytes that are nearly the same and wrong out."""

import io
import json
import re
import struct
import warnings
import zipfile
from typing import Any

import numpy as np

NUMBERS = (
    *(b"nan", b"inf", b"-inf", b"1e308", b"-1e308", b"1e-400", b"-0", b"0x10", b"1_0", b"1,5"),
    *(b"", b"9" * 30, b"9" * 400, b"-1", b"1e5", b"0", b".", b"-", b"1e", b"\xd9\xa3", b"1.2.3"),
)
WORDS = (
    *(b"ROOT", b"JOINT", b"End Site", b"OFFSET", b"CHANNELS", b"MOTION", b"Frames:", b"{", b"}"),
    *(b"Frame Time:", b"HIERARCHY", b"Xposition", b"Zrotation", b"\0", b"\r", b"\x1a", b"\xff\xfe"),
)


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
            rows[one] *= min(int(rng.integers(2, 5000)), 1 + (1 << 16) // (1 + len(rows[one])))
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
            *(f"{{'descr': '<f8', 'fortran_order': False, 'shape': {s}, }}" for s in shapes),
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
    n = int(rng.choice([10**6, 4 * 10**6, 7 * 10**7], p=[0.5, 0.48, 0.02]))
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


TOKENS = (
    *(b"null", b"true", b"[]", b"{}", b'""', b'"\\ud800"', b"NaN", b"1e999", b"-1", b"1.5", b"0"),
    *(b"9" * 4000, b"0x" + b"f" * 5000, b"1" + b":30" * 900, b"9" * 5000, b"1e400", b"-Infinity"),
    *(b"../../../etc/passwd", b"/etc/passwd", b"C:\\\\x", b"\\u0000", b"a" * 7_000, b"2001-99-99"),
    *(b"*a", b"&a", b"<<: *a", b"!!python/object/apply:os.abort []", b"? [a, b]\n: c", b"---\n"),
    *(
        b"\t",
        b"\xe2\x80\xa8",
        b"\xef\xbb\xbf",
        b"\xed\xa0\x80",
        b"\0",
        b'"',
        b"'",
        b",",
        b":",
        b"|",
    ),
)


def tokens(data: bytearray, rng: np.random.Generator) -> bytes:
    """Some words, numbers or strings are replaced."""
    found = list(re.finditer(rb'"[^"\n]{0,80}"|[\w.+-]+|[][{}]', data[:20_000]))
    for at in sorted(rng.integers(0, len(found), int(rng.integers(1, 4))), reverse=True):
        new = TOKENS[rng.integers(len(TOKENS))]
        if rng.random() < 0.3:
            new = found[rng.integers(len(found))][0]
        data[found[at].start() : found[at].end()] = new
    return bytes(data)


def brackets(data: bytearray, rng: np.random.Generator) -> bytes:
    """Nesting that does not end."""
    at = int(rng.integers(0, len(data) + 1))
    depth = int(rng.choice([3, 90, 1100, 1100, 1100, 20_000]))
    one = [b"[", b"{", b'{"a":', b'[{"x":', b"- ", b"? ", b"((", b"{a: ["][rng.integers(8)]
    end = (b"]" if b"[" in one else b"}") * depth if rng.integers(2) else b""
    return bytes(data[:at] + one * depth + end + data[at:])


def tree(data: bytearray, rng: np.random.Generator) -> bytes:
    """One value somewhere in a JSON document, or in a line of a file of them, becomes another."""
    rows = [bytes(data)]
    if b"\n{" in data:
        rows = bytes(data).split(b"\n")
    at = int(rng.integers(0, len(rows)))
    try:
        document = [json.loads(rows[at])]
    except (ValueError, RecursionError):
        return tokens(data, rng)
    parent: Any = document
    key: Any = 0
    while isinstance(parent[key], dict | list) and parent[key] and rng.random() < 0.85:
        parent = parent[key]
        key = _any_key(parent, rng)
    change = rng.integers(8)
    if change == 0:
        del parent[key]
    elif change == 1:
        parent[key] = [parent[key]]
    elif change == 2 and isinstance(parent, dict):
        parent[str(rng.choice(["a", "", "__class__", "id", str(key) * 3]))] = parent.pop(key)
    elif change == 3 and isinstance(parent, list):
        parent[:] = parent * int(rng.integers(2, 40))
    else:
        parent[key] = VALUES[rng.integers(len(VALUES))]
    rows[at] = json.dumps(document[0] if document else None).encode()
    return b"\n".join(rows)


def _any_key(parent: Any, rng: np.random.Generator) -> Any:
    keys = list(parent) if isinstance(parent, dict) else range(len(parent))
    return keys[rng.integers(len(keys))]


VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 1.5, -0.0, 1e308, float("nan"), float("inf")),
    *(10**18, 10**400),
    *("", "x", "0", "1e5", "nan", "../../x", "/etc/passwd", "\0", "\ud800", "a" * 5000, "<b>&'\""),
    *([], {}, [[]], [None], [0, 1, 2], {"a": 1}, ["a", "b"], [[[[1]]]], {"": None}, [1e308] * 3),
)


def tensors(data: bytearray, rng: np.random.Generator) -> bytes:
    """The header of a safetensors file is made wrong, with a right length or a wrong one."""
    size = int.from_bytes(data[:8], "little")
    changed = [tree, tree, tokens, flip, shapes][rng.integers(5)]
    header = bytes(changed(bytearray(data[8 : 8 + size]), rng))
    size = len(header) if rng.random() < 0.8 else int(rng.choice([0, 1, 2**31, 2**62, size + 1]))
    return size.to_bytes(8, "little") + header + bytes(data[8 + len(header) :])


def shapes(data: bytearray, rng: np.random.Generator) -> bytes:
    """One tensor gets another shape or type; its bytes may still fit."""
    try:
        header = json.loads(bytes(data))
        name = sorted(key for key in header if key != "__metadata__")[rng.integers(len(header) - 1)]
        shape = header[name]["shape"]
        others = ([], [0], shape[::-1], [*shape, 1], [2**62], [-1], [2**32, 2**32], shape[:-1])
        header[name]["shape"] = others[rng.integers(len(others))]
        header[name]["dtype"] = ["F32", "I32", "F64", "BOOL", "BF16", "F8_E4M3"][rng.integers(6)]
    except (ValueError, KeyError, TypeError, IndexError, AttributeError):
        return tokens(data, rng)
    return json.dumps(header).encode()


def pickled(data: bytearray, rng: np.random.Generator) -> bytes:
    """The pickle in torch's archive is made wrong."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(bytes(data)))
        name = next(name for name in archive.namelist() if name.endswith("data.pkl"))
        pickle = bytearray(archive.read(name))
        if rng.random() < 0.3:
            globals_ = (b"cposix\nsystem\n", b"cbuiltins\neval\n", b"ctorch\nload\n", b"c\n\n")
            wrong = b"\x80\x02" + globals_[rng.integers(4)] + b"X\x04\0\0\0true\x85R."
        else:
            wrong = bytes((flip, cut, splice)[rng.integers(3)](pickle, rng))
        return rezipped(bytes(data), {name: wrong})
    except Exception:  # it is no archive any more
        return bytes(flip(data, rng))


ANY = (flip, cut, splice, noise)
BVH = (*ANY, numbers, numbers, counts, lines, lines, nest, recode)
NPZ = (*ANY, arrays, arrays, arrays, arrays, headers, headers, entries, bomb)
TEXT = (*ANY, tokens, tokens, tokens, numbers, lines, brackets, recode)
JSON = (*ANY, tree, tree, tree, tree, tokens, brackets, lines)
TENSORS = (flip, cut, tensors, tensors, tensors)
PICKLE = (*ANY, pickled, pickled, entries)


def mutate(data: bytes, mutators: tuple[Any, ...], seed: int) -> bytes:
    """Return `data` after one or two mutators, chosen by the seed; bytes that none fits as is."""
    rng = np.random.default_rng(seed)
    for _ in range(1 + (rng.random() < 0.25)):
        change = mutators[rng.integers(len(mutators))]
        try:
            data = bytes(change(bytearray(data or b" "), rng))
        except Exception:  # what a mutator needs is not there any more
            data = bytes(flip(bytearray(data or b" "), rng))
    return data
