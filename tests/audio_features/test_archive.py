"""Archives that are read, and files that are whole or absent."""

import io
import os
import stat
import zipfile

import numpy as np
import pytest

import audio_features as af
from audio_features.archive import check_directory, open_archive
from audio_features.atomic import atomic_write, write_text
from audio_features.errors import FeatureError


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
        (lambda a: a["none"], "'none'"),
        (lambda a: a["objects"], "pickle"),
        (lambda a: a["longer"], r"(?=.*\b24 bytes).*\b28"),
        (lambda a: a.numbers("text"), "(?=.*'text').*'speech'"),
        (lambda a: a.texts("texts"), r"(?=.*'texts').*\b3"),
    ],
)
def test_arrays_that_are_refused(archive, read, says):
    with pytest.raises(FeatureError, match=f"a.npz.*{says}"):
        read(archive)


def test_files_that_are_no_archives(tmp_path):
    (tmp_path / "text.npz").write_text("text")
    os.mkfifo(tmp_path / "pipe.npz")
    for name in ("none.npz", "text.npz", "pipe.npz", "."):
        path = tmp_path / name
        with pytest.raises(FeatureError, match=str(path)), open_archive(path, FeatureError):
            pass


def test_lists_of_members_that_would_take_gigabytes_are_refused(tmp_path):
    """The end record holds the list's length at byte 12; one for files over 4 GiB is before it."""
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros(3))
    whole = path.read_bytes()
    end = whole.rindex(b"PK\5\6")
    long = bytearray(whole)
    long[end + 12 : end + 16] = (2**20 + 1).to_bytes(4, "little")
    large = whole[:end] + b"PK\6\7" + bytes(16) + whole[end:]
    for content, says in ((long, "1048577 bytes"), (large, "4 GiB")):
        path.write_bytes(content)
        with pytest.raises(FeatureError, match=says), open_archive(path, FeatureError):
            pass
    with pytest.raises(ValueError, match="whole"):
        check_directory(path, zip64=True)


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
    with pytest.raises(OSError) as caught:
        write_text(path.with_name("file") / "b.json", "")
    assert str(path.with_name("file")) in str(caught.value.filename)


def test_one_path_for_several_encoders_is_refused(tmp_path):
    parts = [{"kind": "wavlm"}, {"kind": "hf"}]
    with pytest.raises(af.WeightsError, match="--weights hf="):
        af.extractor_from_spec({"kind": "stack", "parts": parts}, weights=tmp_path)
    with pytest.raises(af.WeightsError, match="(?=.*'mfcc').*wavlm"):
        af.extractor_from_spec({"kind": "wavlm"}, weights={"mfcc": tmp_path})


def zipped(path, *, stored: bytes = b"", **members: bytes):
    """Write an archive of deflated members, and one that is not."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
        file.writestr("stored.bin", stored, zipfile.ZIP_STORED)
    return path


@pytest.mark.parametrize(("stored", "is_read"), [(4 << 20, True), (1 << 10, False)])
def test_arrays_of_a_large_file_take_twenty_times_its_size(tmp_path, stored, is_read):
    """34 megabytes of zeros are too many for a file of some kilobytes alone."""
    noise = np.random.default_rng(0).bytes(stored)
    path = zipped(tmp_path / "a.npz", stored=noise, a=npy(np.zeros(34 << 20, np.int8)))
    with open_archive(path, FeatureError) as found:
        if is_read:
            assert len(found["a"]) == 34 << 20
        else:
            with pytest.raises(FeatureError, match=r"(?=.*'a').*\b34 MiB"):
                found["a"]
