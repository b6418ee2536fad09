"""Archives that are read, and files that are whole or absent."""

from __future__ import annotations

import io
import os
import stat
import zipfile

import numpy as np
import pytest

import audio_features as af
from audio_features.archive import open_archive
from audio_features.atomic import atomic_write, remove_unfinished, write_text
from audio_features.errors import FeatureError
from audio_features.extractor import folder_in_spec, needs_of, needs_weights


def npy(array: np.ndarray, version: tuple[int, int] | None = None) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, np.asarray(array), version=version, allow_pickle=True)
    return out.getvalue()


@pytest.fixture
def archive(tmp_path):
    """An archive with an array of each kind, one of which is packed by bzip2."""
    odd = np.array(["ab"])
    odd.view(np.uint32)[0] = 0x110000
    arrays = {
        "floats": np.array([1.5, 2.5], np.float32),
        "whole": np.array([3], np.int8),
        "flags": np.array([True, False]),
        "text": np.array("speech"),
        "texts": np.array(["a", "b", "c"]),
        "bytes": np.array([b"a", b"\xff"]),
        "odd": odd,
        "objects": np.array([{}], object),
        "nothing": np.zeros((0, 3)),
    }
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file:
        for name, array in arrays.items():
            file.writestr(f"{name}.npy", npy(array))
        file.writestr("packed.npy", npy(np.zeros(3)), zipfile.ZIP_BZIP2)
        file.writestr("deflated.npy", npy(np.arange(3), (2, 0)), zipfile.ZIP_DEFLATED)
        file.writestr("new.npy", npy(np.zeros(3), (3, 0)))
        file.writestr("longer.npy", npy(np.zeros(3)) + b"more")
        file.writestr("shorter.npy", npy(np.zeros(3))[:-1])
        file.writestr("notes.txt", "text")
    with open_archive(path, FeatureError) as opened:
        yield opened


def test_arrays_of_an_archive(archive):
    assert {"floats", "text"} <= set(archive) and "notes" not in set(archive)
    assert "floats" in archive and "notes" not in archive and "floats.npy" not in archive
    np.testing.assert_array_equal(archive["deflated"], [0, 1, 2])
    assert archive["nothing"].shape == (0, 3)
    floats = archive.numbers("floats")
    assert floats.dtype == np.float64 and floats.tolist() == [1.5, 2.5]
    assert archive.numbers("whole", np.float32).dtype == np.float32
    assert archive.texts("text") == ["speech"] and archive.texts("floats", 2) == []
    assert archive.texts("texts", 3) == ["a", "b", "c"]
    assert archive.texts("bytes", 2) == ["a", "\ufffd"]


@pytest.mark.parametrize(
    ("read", "says"),
    [
        (lambda a: a["none"], "no key 'none'"),
        (lambda a: a["packed"], "packed in a way that numpy never does"),
        (lambda a: a["objects"], "a pickled Python object"),
        (lambda a: a["new"], "cannot be read: version"),
        (lambda a: a["longer"], "24 bytes, and holds 28"),
        (lambda a: a["shorter"], "24 bytes, and holds 23"),
        (lambda a: a.numbers("text"), "holds 'speech', not numbers"),
        (lambda a: a.numbers("flags"), "holds bool, not numbers"),
        (lambda a: a.texts("texts"), "holds 3 texts, too many"),
        (lambda a: a.texts("odd"), "characters that do not exist"),
    ],
)
def test_arrays_that_are_refused(archive, read, says):
    with pytest.raises(FeatureError, match=f"a.npz: .*{says}"):
        read(archive)


def test_an_archive_may_end_with_a_comment(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("whole.npy", npy(np.array([3])))
        file.comment = b"x" * 65_535
    with open_archive(tmp_path / "a.npz", FeatureError) as found:
        assert found.numbers("whole").tolist() == [3]


def test_files_that_are_no_archives(tmp_path):
    (tmp_path / "text.npz").write_text("text")
    os.mkfifo(tmp_path / "pipe.npz")
    for name, says in (
        ("none.npz", "no such file"),
        ("text.npz", "not a zip archive, or is truncated"),
        ("pipe.npz", "not a regular file"),
        (".", "not a regular file"),
    ):
        with pytest.raises(FeatureError, match=says), open_archive(tmp_path / name, FeatureError):
            pass


def test_a_file_is_whole_or_as_it_was(tmp_path):
    path = tmp_path / "new" / "a.json"
    before = os.umask(0o027)
    try:
        write_text(path, "é")
    finally:
        os.umask(before)
    assert path.read_bytes() == "é".encode() and stat.S_IMODE(path.stat().st_mode) == 0o640
    with pytest.raises(RuntimeError), atomic_write(path) as temporary:
        assert temporary.parent == path.parent and temporary.suffix == ".json"
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text(encoding="utf-8") == "é"
    assert [one.name for one in path.parent.iterdir()] == ["a.json"]
    with atomic_write(path, suffix=".part") as temporary:
        assert temporary.suffix == ".part"
    path.with_name("file").write_text("")
    with pytest.raises(OSError, match="cannot be written|Not a directory|exists"):
        write_text(path.with_name("file") / "b.json", "")


@pytest.mark.parametrize("letter", ["a", "é"])
def test_the_longest_name_that_a_disk_takes_is_written(tmp_path, letter):
    name = letter * (250 // len(letter.encode())) + ".json"
    write_text(tmp_path / name, "whole")
    assert [one.name for one in tmp_path.iterdir()] == [name]


def test_unfinished_files_of_others_are_left(tmp_path):
    path = tmp_path / "a[1].json"
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as temporary:
        left = temporary.with_name(temporary.name)
        raise KeyboardInterrupt
    other = tmp_path / left.name.replace("a[1]", "b[1]")
    for name in (left, other, path):
        name.write_text("")
    remove_unfinished(path)
    assert sorted(tmp_path.iterdir()) == sorted([other, path])


@pytest.mark.parametrize(
    ("spec", "needs"),
    [
        (None, []),
        ({"kind": "mfcc"}, []),
        ({"kind": "wavlm"}, ["the weights of the encoder: --weights wavlm=PATH"]),
        (
            {"kind": "words"},
            ["a list of words with times beside each sound, such as STEM.TextGrid"],
        ),
        (
            {"kind": "mine", "package": "p"},
            ["the extractor mine of the package p, which is not ins"],
        ),
    ],
)
def test_what_an_extractor_needs_beside_the_sound(spec, needs):
    found = needs_of(spec)
    assert len(found) == len(needs)
    assert all(text.startswith(need) for text, need in zip(found, needs, strict=True))
    stack = {"kind": "stack", "parts": [spec, {"kind": "words", "path": "bert"}]}
    assert needs_of(stack)[len(needs) :] == [
        "the weights of the encoder: --weights words=PATH",
        "a list of words with times beside each sound, such as STEM.TextGrid",
    ]
    assert needs_of({"kind": "stack", "parts": "wavlm"}) == []
    assert needs_weights(spec) == (spec == {"kind": "wavlm"})
    assert folder_in_spec({"kind": "mfcc"}) is None
    assert folder_in_spec({"kind": "files", "folder": "own"}) == "own"


def test_one_path_for_several_encoders_is_refused(tmp_path):
    parts = [{"kind": "wavlm"}, {"kind": "hf"}]
    with pytest.raises(af.WeightsError, match=r"need 2 encoders.*wavlm=PATH --weights hf=PATH"):
        af.extractor_from_spec({"kind": "stack", "parts": parts}, weights=tmp_path)
    with pytest.raises(
        af.WeightsError, match="'mfcc' has no weights or files; expected words, wavlm"
    ):
        af.extractor_from_spec({"kind": "wavlm"}, weights={"mfcc": tmp_path})
    with pytest.raises(FeatureError, match="a stack has 'parts', a list of specs"):
        af.extractor_from_spec({"kind": "stack", "parts": [{"kind": "mfcc"}], "n": 3})
    with pytest.raises(FeatureError, match="its package, 'p', if you trust it"):
        af.extractor_from_spec({"kind": "mine", "package": "p"})


def zipped(path, *, stored: bytes = b"", **members: bytes):
    """Write an archive of deflated members, and one that is not."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
        file.writestr("stored.bin", stored, zipfile.ZIP_STORED)
    return path


def zeros(n_bytes: int) -> bytes:
    return npy(np.zeros(n_bytes, np.int8))


@pytest.mark.parametrize(("n_bytes", "is_read"), [(32 << 20, True), ((32 << 20) + 1, False)])
def test_arrays_of_a_small_file_take_32_mib(tmp_path, n_bytes, is_read):
    parts = {"a": zeros(n_bytes - (1 << 20)), "b": zeros(1 << 20)}
    with open_archive(zipped(tmp_path / "a.npz", **parts), FeatureError) as found:
        assert len(found["a"]) == n_bytes - (1 << 20)
        if is_read:
            assert len(found["b"]) == 1 << 20
        else:
            with pytest.raises(FeatureError, match="'b' unpacks to 1 MiB, far more than its file"):
                found["b"]


@pytest.mark.parametrize(("share", "is_read"), [(19.9, True), (20.1, False)])
def test_arrays_of_a_large_file_take_twenty_times_its_size(tmp_path, share, is_read):
    noise = np.random.default_rng(0).bytes(2 << 20)
    part = zeros(round(share * ((2 << 20) + 45_000)))
    path = zipped(tmp_path / "a.npz", stored=noise, a=part)
    assert path.stat().st_size == pytest.approx((2 << 20) + 41_500, abs=2_000)
    with open_archive(path, FeatureError) as found:
        if is_read:
            assert not found["a"].any()
        else:
            with pytest.raises(FeatureError, match="'a' unpacks to 41 MiB"):
                found["a"]


@pytest.mark.parametrize(("members", "is_read"), [(17, True), (18, False)])
def test_the_list_of_members_takes_a_mib(tmp_path, members, is_read):
    """An entry of it has 46 bytes, a name and a comment; 2^20 bytes are 17.5 of these."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        for k in range(members):
            info = zipfile.ZipInfo(f"{k:02d}.npy")
            info.comment = bytes(59_948)
            file.writestr(info, npy(np.array([k])))
    if is_read:
        with open_archive(tmp_path / "a.npz", FeatureError) as found:
            assert found["16"].tolist() == [16]
        return
    says = "its list of members takes 1080000 bytes"
    with pytest.raises(FeatureError, match=says), open_archive(tmp_path / "a.npz", FeatureError):
        pass


def test_archives_of_over_four_gigabytes_are_named(tmp_path):
    """A second end record stands before the usual one, and 20 bytes that lead to it."""
    path = zipped(tmp_path / "a.npz", a=npy(np.array([1])))
    content = path.read_bytes()
    at = content.rindex(b"PK\5\6")
    path.write_bytes(content[:at] + b"PK\6\7" + bytes(16) + content[at:])
    says = "an archive of more than 4 GiB; cut the recording"
    with pytest.raises(FeatureError, match=says), open_archive(path, FeatureError):
        pass
    path.write_bytes(content[: at + 21])
    with pytest.raises(FeatureError, match="is truncated"), open_archive(path, FeatureError):
        pass


@pytest.mark.parametrize("descr", ["|S0", "<U0"])
def test_values_of_no_bytes_are_at_most_one(tmp_path, descr):
    """A header of a few bytes would declare any number of them."""

    def member(shape: tuple[int, ...]) -> bytes:
        out = io.BytesIO()
        header = {"descr": descr, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(out, header)
        return out.getvalue()

    path = zipped(tmp_path / "a.npz", one=member(()), two=member((2,)), large=member((10**12,)))
    with open_archive(path, FeatureError) as found:
        assert found["one"].shape == () and found.texts("one") in ([], [""])
        for name in ("two", "large"):
            with pytest.raises(FeatureError, match=f"'{name}' declares shape"):
                found[name]
