"""Arrays on disk: the frames that are read, and files that are not whole."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gesturekit.corpus import Item
from gesturekit.errors import ConfigError, CorpusError, FormatError, OutputError
from gesturekit.training.arrays import ArrayFolder, stored_arrays

KEY = "3fab"
ROWS = np.arange(30.0).reshape(10, 3)


@pytest.fixture
def folder(tmp_path) -> ArrayFolder:
    """A folder with one array of ten frames of three numbers."""
    made = ArrayFolder(tmp_path)
    made.write(KEY, ROWS, {"id": "a"})
    return made


def test_the_frames_of_an_array_are_read_from_its_file(folder):
    array = folder.find(KEY)
    assert (array.shape, array.facts) == ((10, 3), {"id": "a"})
    np.testing.assert_array_equal(np.load(array.path), ROWS)
    for start, stop in ((0, 10), (2, 5), (9, 10), (8, 20), (10, 12), (14, 20)):
        rows = array.rows(start, stop)
        assert rows.dtype == np.float32 and rows.shape[1] == 3
        np.testing.assert_array_equal(rows, ROWS[start:stop])
    assert folder.find_all([KEY, KEY]) == [array, array]


class Maker:
    """Makes (3, 2) of a number, and writes down the items."""

    def __init__(self, value: float) -> None:
        self.value, self.made = value, []

    def origin(self, item: Item) -> dict[str, Any]:
        return {"value": self.value, "motion": item.motion, "id": item.id}

    def make(self, item: Item) -> tuple[np.ndarray, dict[str, Any]]:
        self.made.append(item.id)
        if item.id == "bad":
            raise FormatError("bad.bvh: no HIERARCHY")
        return np.full((3, 2), self.value), {"id": item.id}


def items(*names: str) -> list[Item]:
    return [Item(id=n, audio=None, motion=Path(f"/{n}.bvh"), duration=1.0) for n in names]


def test_arrays_of_each_maker_are_made_once_and_come_in_order(tmp_path, caplog):
    caplog.set_level("INFO")
    one, other = Maker(1.0), Maker(2.0)
    wanted = [(one, items("a", "b")), (other, items("b")), (Maker(3.0), [])]
    found = stored_arrays(tmp_path, wanted, 1)
    assert [[(x.facts["id"], *x.rows(2, 3)[0]) for x in arrays] for arrays in found] == [
        *([("a", 1.0, 1.0), ("b", 1.0, 1.0)], [("b", 2.0, 2.0)], [])
    ]
    assert "3 array" in caplog.text and str(tmp_path) in caplog.text
    caplog.clear()
    (again,) = stored_arrays(tmp_path, [(one, items("b", "c"))], 1)
    assert one.made == ["a", "b", "c"] and again[0] == found[0][1]
    assert "1 array " in caplog.text
    caplog.clear()
    stored_arrays(tmp_path, wanted, 1)
    assert one.made == ["a", "b", "c"] and not caplog.messages


def test_an_item_without_its_array_is_named_and_the_others_are_kept(tmp_path):
    maker = Maker(1.0)
    with pytest.raises(CorpusError, match=r"(?=.*item bad\b)(?=.*bad\.bvh)(?=.*HIERARCHY)"):
        stored_arrays(tmp_path, [(maker, items("a", "bad", "c"))], 1)
    assert maker.made == ["a", "bad"]
    stored_arrays(tmp_path, [(maker, items("a", "c"))], 1)
    assert maker.made == ["a", "bad", "c"]
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=f"(?=.*{tmp_path / 'file'})(?=.*arrays=)"):
        stored_arrays(tmp_path / "file", [(maker, items("a"))], 1)


def test_an_array_that_is_not_whole_is_missing(folder, tmp_path):
    file = (array := folder.find(KEY)).path
    content = file.read_bytes()
    for damaged in (content[:120], content[:-129], b""):
        file.write_bytes(damaged)
        assert folder.find(KEY) is None
        with pytest.raises(ConfigError, match=f"(?=.*{tmp_path})(?=.*arrays=)"):
            folder.find_all([KEY])
        with pytest.raises(ConfigError, match=rf"(?=.*{file})(?=.*\b10\b)(?=.*\b3\b)"):
            array.rows(0, 1)
    file.write_bytes(content + bytes(200))
    with pytest.raises(ConfigError, match=str(file)):
        array.rows(0, 1)
    file.unlink()
    assert folder.find(KEY) is None and folder.find("00") is None
    with pytest.raises(ConfigError, match=str(file)):
        array.rows(0, 1)
    file.write_bytes(content)
    assert folder.find(KEY) == array
    for facts in ("{", "[]", "{}", '{"shape": [10]}', '{"shape": "ab"}'):
        file.with_suffix(".json").write_text(facts)
        assert folder.find(KEY) is None
