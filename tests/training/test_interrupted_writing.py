"""Folders whose writing was interrupted by a kill are whole and tidy after the next save."""

from __future__ import annotations

import errno
from contextlib import ExitStack

import pytest
import torch

from audio_features.atomic import atomic_write, remove_unfinished
from gesturekit.training.data.data_folder import save_data
from gesturekit.training.model_folder import save_model
from gesturekit.training.run.checkpoint import Checkpoints

WRITERS = {
    "model": lambda folder: save_model(folder, {"kind": "x", "fps": 1}, {}, {}, "text"),
    "data": lambda folder: save_data(folder, {"x": torch.zeros(1)}, {}),
    "checkpoints": lambda folder: Checkpoints(folder).save(5, {}),
}


@pytest.mark.parametrize("save", WRITERS.values(), ids=WRITERS)
def test_the_next_save_removes_temporary_files_of_a_killed_run(tmp_path, save):
    save(tmp_path)
    whole = sorted(path.name for path in tmp_path.iterdir())
    (tmp_path / ".mine-of_mine.txt").touch()
    with ExitStack() as unfinished:
        for name in whole:
            unfinished.enter_context(atomic_write(tmp_path / name)).write_text("half")
        assert len(list(tmp_path.iterdir())) == 2 * len(whole) + 1
        save(tmp_path)
        found = sorted(path.name for path in tmp_path.iterdir())
        unfinished.pop_all()
    assert found == [".mine-of_mine.txt", *whole]


def test_a_path_that_cannot_be_written_is_named_as_the_user_wrote_it(tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / ".a-x1.jsonl"))

    monkeypatch.setattr("tempfile.mkstemp", refuse)
    refused = pytest.raises(PermissionError, match="cannot be written: ")
    with refused as caught, atomic_write(tmp_path / "a.jsonl"):
        pass
    assert caught.value.filename == str(tmp_path / "a.jsonl")


@pytest.mark.parametrize("stem", [251 * "x", 83 * "本"])
def test_a_name_of_the_full_length_is_written_and_tidied(tmp_path, stem):
    with atomic_write(tmp_path / f"{stem}.npz") as temporary:
        temporary.write_text("text")
        assert temporary.suffix == ".npz"
    assert (tmp_path / f"{stem}.npz").read_text() == "text"
    with ExitStack() as unfinished:
        unfinished.enter_context(atomic_write(tmp_path / f"{stem}.npz"))
        remove_unfinished(tmp_path / f"{stem[1:]}y.npz")
        assert len(list(tmp_path.iterdir())) == 2, "another name of the same beginning or end"
        remove_unfinished(tmp_path / f"{stem}.npz")
        assert len(list(tmp_path.iterdir())) == 1
        unfinished.pop_all()
