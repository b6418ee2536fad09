"""Folders whose writing was interrupted by a kill are whole and tidy after the next save."""

from contextlib import ExitStack

import pytest
import torch

from audio_features.atomic import atomic_write
from gesturekit.training.model_folder import save_data, save_model
from gesturekit.training.run_folder import Checkpoints

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


@pytest.mark.parametrize("stem", [251 * "x", 83 * "本"])
def test_a_name_of_the_full_length_is_written_and_tidied(tmp_path, stem):
    file = tmp_path / f"{stem}.npz"
    with ExitStack() as unfinished:
        unfinished.enter_context(atomic_write(file)).write_text("half")
        with atomic_write(file) as temporary:
            temporary.write_text("text")
        assert file.read_text() == "text" and temporary.suffix == ".npz"
        unfinished.pop_all()
