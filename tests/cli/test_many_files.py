"""features and convert on many files: the records, shards and launchers of render."""

from pathlib import Path

import pytest
from outputs import results
from threadpoolctl import threadpool_limits

from audio_features import FeatureTrack
from gesturekit.jobs.records import status_of

STEMS = ("a", "b", "day/c", "day/d", "day/night/e")


@pytest.fixture
def folder(tmp_path, write_pair) -> Path:
    """Five pairs of sound and motion, in folders."""
    for number, name in enumerate(STEMS):
        path = tmp_path / "in" / name
        write_pair(path.parent, path.name, 0.4 + 0.3 * number, fps=25.0, seed=number)
    return tmp_path / "in"


COMMANDS = {
    "features": lambda folder, out: ["features", folder, "--out", out],
    "convert": lambda folder, out: ["convert", folder, out, "--format", "npz,html"],
}
KINDS = {"features": ("npz",), "convert": ("npz", "html")}
INPUTS = {"features": "wav", "convert": "bvh"}


@pytest.fixture(params=COMMANDS)
def verb(request) -> str:
    return request.param


@pytest.fixture
def run(gesturekit, folder, tmp_path, verb):
    """run(out, *options): the command, into a folder of this name."""
    return lambda out, *options: gesturekit(*COMMANDS[verb](folder, tmp_path / out), *options)


def test_shards_in_any_order_give_the_same_files(run, tmp_path, verb):
    whole = run("whole")
    assert (whole.status, whole.err) == (0, "") and len(whole.out.splitlines()) >= 5
    made = results(tmp_path / "whole")
    assert set(made) == {f"{stem}.{kind}" for stem in STEMS for kind in KINDS[verb]}
    for shard in ("3/3", "1/3", "2/3"):
        assert run("out", "--shard", shard).status == 0
    assert results(tmp_path / "out") == made
    found = status_of(tmp_path / "out")
    assert (found.done, found.left, len(found.shards)) == (5, [], 3)
    again = run("out")
    assert again.status == 0 and again.out.count("skipped") == 5


@pytest.mark.parametrize("shard", ["0/8", "9/8", "1", "a/b", "1/100000"])
def test_shards_count_from_one(gesturekit, folder, tmp_path, shard):
    command = COMMANDS["features"](folder, tmp_path / "out")
    gesturekit(*command, "--shard", shard).fails(2, shard)


@pytest.mark.stress
def test_workers_and_launchers_give_the_same_files(run, tmp_path):
    run("whole")
    assert run("workers", "--workers", 2).status == 0
    assert results(tmp_path / "workers") == results(tmp_path / "whole")
    pytest.importorskip("submitit")
    run("slurm", "--launcher", "slurm", "--jobs", 2, "--launcher-option", "cluster=debug").ok()
    assert results(tmp_path / "slurm") == results(tmp_path / "whole")


def test_a_rerun_does_what_changed(run, folder, tmp_path, verb, write_pair):
    run("out").ok()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("[a-e].*")}
    kinds = KINDS[verb]
    (tmp_path / "out" / f"a.{kinds[-1]}").unlink()
    write_pair(folder, "b", 0.5, fps=25.0, seed=9)
    run("out").fails(2, "input", f"{len(kinds)} refused", "1 to make")
    run("out", "--existing", "replace").ok()
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("[a-e].*")}
    changed = {path.name for path in after if after[path] != before.get(path)}
    assert changed == {f"a.{kinds[-1]}", *(f"b.{kind}" for kind in kinds)}


def test_three_failures_put_an_item_aside(run, folder, tmp_path, verb):
    broken = folder / f"b.{INPUTS[verb]}"
    whole = broken.read_bytes()
    broken.write_text("Dear diary,\n")
    for _ in range(3):
        done = run("out")
        done.fails(1, str(broken))
        assert "--retry-failed" not in done.err
    run("out").fails(1, str(broken), "3 failures", "--retry-failed")
    assert status_of(tmp_path / "out").failed[0].is_aside
    assert "3 failures" not in run("out", "--retry-failed").err
    broken.write_bytes(whole)
    assert run("out").status == 0 and status_of(tmp_path / "out").done == 5


def test_a_dry_run_shows_what_it_would_do_and_writes_nothing(run, tmp_path, verb):
    done = run("out", "--dry-run")
    assert done.status == 0 and not (tmp_path / "out").exists()
    assert all(f"{stem}.{INPUTS[verb]}" in done.out for stem in STEMS)


def test_a_list_of_sounds_with_intervals(gesturekit, folder, tmp_path):
    part = '{"audio": "a.wav", "id": "part", "start": 0.1, "seconds": 0.2}'
    (folder / "night.jsonl").write_text(f'{part}\n{{"id": "idle", "seconds": 1}}')
    command = ("features", folder / "night.jsonl", "--fps", 50, "--picture")
    gesturekit(*command, "--out", tmp_path / "out").fails(1, "idle: ")
    assert len(FeatureTrack.load(tmp_path / "out" / "part.npz").values) == 10
    assert (tmp_path / "out" / "part.png").is_file()


def test_results_of_another_verb_are_never_replaced(gesturekit, folder, tmp_path):
    out = tmp_path / "out"
    assert gesturekit(*COMMANDS["convert"](folder, out)).status == 0
    gesturekit("features", folder, "--out", out).fails(2, "a.npz", "--existing")


def test_features_are_the_same_for_any_number_of_threads(gesturekit, write_speech, tmp_path):
    wav = write_speech(tmp_path / "a.wav", 3.0)
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            gesturekit("features", wav, "--no-cache", "--out", tmp_path / str(threads)).ok()
    assert results(tmp_path / "1") == results(tmp_path / "2")
