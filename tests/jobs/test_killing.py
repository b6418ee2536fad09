"""SIGKILL at random moments: a rerun completes, and gives what an undisturbed run gives."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from small_runs import SMALL

KILLS = int(os.environ.get("GESTUREKIT_KILLS", "200"))
"""Number for each command; `make test` kills one command twice."""
SCRIPT = Path(__file__).with_name("killing.py")
MULTIRES = SMALL["multires"] | {
    "training": SMALL["multires"]["training"] | {"first_stage": 10, "further_stages": 10},
    "checkpoint_every": 4,
}
DIFFUSION = SMALL["diffusion"] | {
    "training": SMALL["diffusion"]["training"] | {"updates": 30},
    "checkpoint_every": 4,  # a multiple of log_every: losses of a line are not in checkpoints
}


def killed(kills: int, *command: object) -> int:
    """Run a command whole, and with so many kills; return the number of outputs with kills."""
    done = subprocess.run(
        [sys.executable, SCRIPT, str(kills), "0", json.dumps(list(map(str, command)))],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=3600,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return int(done.stdout.splitlines()[-1])


@pytest.fixture
def recordings(tmp_path, write_pair) -> Path:
    for number in range(8):
        write_pair(tmp_path / "in", f"{number}", 1.0 + number % 3, fps=25.0, seed=number)
    return tmp_path / "in"


def content(folder: Path) -> dict[str, bytes]:
    """Bytes of all visible files."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in files
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


def compare(folder: Path, count: int, of: Callable[[Path], object] = content) -> None:
    """Compare the outputs of killed commands with the undisturbed one."""
    whole = of(folder / "whole")
    assert whole
    assert [of(folder / str(number)) == whole for number in range(count)] == [True] * count


@pytest.mark.parametrize("kills", [2, pytest.param(KILLS, marks=pytest.mark.stress)])
def test_features(recordings, tmp_path, kills):
    command = ("features", *sorted(recordings.glob("*.wav")), "--no-cache", "--out")
    compare(tmp_path, killed(kills, *command, tmp_path / "{out}"))


@pytest.mark.stress
def test_convert(recordings, tmp_path):
    command = ("convert", recordings, tmp_path / "{out}", "--format", "npz,html")
    compare(tmp_path, killed(KILLS, *command))


@pytest.mark.stress
def test_prepare(recordings, tmp_path):
    command = ("prepare", recordings, "--out", recordings / "{out}.jsonl")
    count = killed(KILLS, *command)
    compare(recordings, count, lambda path: path.with_suffix(".jsonl").read_bytes())


@pytest.mark.stress
def test_render(recordings, tmp_path):
    command = ("render", recordings, "--model", "demo", "--format", "bvh,npz", "--out")
    compare(tmp_path, killed(KILLS, *command, tmp_path / "{out}"))
    assert len(content(tmp_path / "whole")) == 16


@pytest.mark.stress
def test_live(recordings, tmp_path):
    to = ("--to", f"record:{tmp_path / '{out}' / 'take.bvh'}", "--existing", "replace")
    compare(tmp_path, killed(KILLS, "live", "--from", recordings / "2.wav", "--fast", *to))


def trained(run: Path) -> dict[str, object]:
    """Model and losses of a run, without times and the name of the run."""
    weights = {path.name: path.read_bytes() for path in (run / "model").glob("[!.]*.safetensors")}
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    losses = [{k: v for k, v in line.items() if "seconds" not in k} for line in lines]
    names = sorted(path.name for path in run.rglob("*") if path.is_file())
    shown = [name for name in names if not name.startswith((".", "events."))]
    return {"weights": weights, "losses": losses, "names": shown}


@pytest.mark.stress
@pytest.mark.parametrize("system", ["multires", "diffusion"])
def test_train(corpus, tmp_path, system):
    config = tmp_path / "config.yaml"
    values = {"multires": MULTIRES, "diffusion": DIFFUSION}[system]
    config.write_text(yaml.safe_dump(values))
    settings = (f"corpus={corpus}", f"out={tmp_path / '{out}'}", "--resume")
    compare(tmp_path, killed(KILLS, "train", config, *settings), trained)


@pytest.mark.stress
def test_arrays(corpus, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(MULTIRES))
    settings = (
        "in_memory=0.05",
        f"corpus={corpus}",
        f"arrays={tmp_path / '{out}'}",
        f"out={tmp_path / 'run'}",
    )
    compare(tmp_path, killed(KILLS, "train", config, *settings, "--arrays"))
