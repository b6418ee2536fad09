"""Arrays on disk: the frames that are read, and files that are not whole."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gesturekit.errors import ConfigError
from gesturekit.training.data.arrays import ArrayFolder, StoredFrames

KEY = "3fab"
ROWS = np.arange(30.0).reshape(10, 3)


@pytest.fixture
def folder(tmp_path) -> ArrayFolder:
    """A folder with one array of ten frames of three numbers."""
    made = ArrayFolder(tmp_path)
    made.write(KEY, ROWS, {"id": "a"})
    return made


def test_the_frames_of_an_array_are_read_from_its_file(folder, tmp_path):
    array = folder.find(KEY)
    assert (array.shape, array.facts) == ((10, 3), {"id": "a"})
    np.testing.assert_array_equal(np.load(tmp_path / "3f" / f"{KEY}.npy"), ROWS)
    for start, stop in ((0, 10), (2, 5), (9, 10), (8, 20), (10, 12), (14, 20)):
        rows = array.rows(start, stop)
        assert rows.dtype == np.float32 and rows.shape[1] == 3
        np.testing.assert_array_equal(rows, ROWS[start:stop])
    assert folder.find_all([KEY, KEY]) == [array, array]


def test_channels_of_frames_are_converted_as_they_are_read(folder):
    frames = StoredFrames(folder.find(KEY), (3, 10), lambda rows: -torch.from_numpy(rows.T))
    np.testing.assert_array_equal(frames[:, 4:6], -ROWS[4:6].T)
    np.testing.assert_array_equal(frames[1:, -2:], -ROWS[-2:, 1:].T)
    few = frames.first(4)
    assert few.shape == (3, 4)
    np.testing.assert_array_equal(few[:, :], -ROWS[:4].T)
    np.testing.assert_array_equal(few[:, 2:9], -ROWS[2:4].T)


def test_an_array_that_is_not_whole_is_missing(folder, tmp_path):
    file = tmp_path / "3f" / f"{KEY}.npy"
    array, content = folder.find(KEY), file.read_bytes()
    for damaged in (content[:120], content[:-129], b""):
        file.write_bytes(damaged)
        assert folder.find(KEY) is None
        with pytest.raises(ConfigError, match="arrays of this run are missing"):
            folder.find_all([KEY])
        with pytest.raises(ConfigError, match=r"cannot be read \(not 10 frames of 3 numbers\)"):
            array.rows(0, 1)
    file.write_bytes(content + bytes(200))
    with pytest.raises(ConfigError, match="remove it, and start again"):
        array.rows(0, 1)
    file.unlink()
    assert folder.find(KEY) is None and folder.find("00") is None
    with pytest.raises(ConfigError, match="cannot be read"):
        array.rows(0, 1)
    file.write_bytes(content)
    assert folder.find(KEY) == array
    for facts in ("{", "[]", "{}", '{"shape": [10]}', '{"shape": "ab"}'):
        file.with_suffix(".json").write_text(facts)
        assert folder.find(KEY) is None
