"""The report, as a person who opens the file meets it."""

import base64
import html
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from markupsafe import escape
from pages import bundled

from gesturekit.evaluation import evaluate, write_report
from gesturekit.evaluation.report.text import number
from gesturekit.viewer import player_shell
from gesturekit.viewer.pages import script_json

pytestmark = bundled

HOSTILE = '<script>alert(1)</script>"&'


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory, gesture, write_speech):
    """Two models, two samples each of two recordings with sound; one name is hostile."""
    root = tmp_path_factory.mktemp("set")
    for i in range(2):
        gesture(2.0, 25.0, seed=i).save(root / "recordings" / f"clip{i}.npz")
        write_speech(root / "sound" / f"clip{i}.wav", 2.0)
        for k in (1, 2):
            for folder in ("model", HOSTILE.replace("/", "")):
                gesture(2.0, 25.0, seed=7 * i + k).save(root / folder / f"clip{i}_s{k}.npz")
    gesture(2.0, 25.0).save(root / "model" / "stranger.npz")
    models = {"model": root / "model", HOSTILE: root / HOSTILE.replace("/", "")}
    return evaluate(models, root / "recordings", audio=root / "sound")


@pytest.fixture(scope="module")
def page(evaluation, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_report(evaluation, path, command="gesturekit evaluate model recordings")
    return path


def clips_of(page: Path) -> list[dict]:
    """Return the clips to look at: title, and data of the player."""
    text = page.read_text(encoding="utf-8")
    clips = json.loads(re.search(r'id="clips">(.*?)</script>', text, re.S)[1])
    return [clip | {"motion": json.loads(clip["motion"])} for clip in clips]


def test_clips_to_look_at_are_whole(page):
    """Two seconds at 25 fps, of both models and the recording."""
    clips = clips_of(page)
    figures = [figure for clip in clips for figure in clip["motion"]["figures"]]
    assert len(figures) == 3 * len(clips) and {one["n_frames"] for one in figures} == {50}


def markup(page: Path) -> str:
    return re.sub(r"<script.*?</script>", "", page.read_text(encoding="utf-8"), flags=re.S)


def test_it_says_all_that_is_needed_to_read_a_figure(page, evaluation):
    text = html.unescape(re.sub(r"<[^>]+>", " ", markup(page)))
    for definition in evaluation.definitions():
        assert definition.name in text and definition.variant in text
        assert definition.text in text and definition.source in text
    text = re.sub(r"\s+", " ", text)
    value = number(evaluation.models[0].metrics["arm_speed"].interval.value)
    for fact in (value, "2 takes", "4 clips", "30 frames", "stranger", "left out", "1 clip"):
        assert re.search(rf"\b{fact}\b", text), fact
    assert "gesturekit evaluate model recordings" in text


def test_it_needs_nothing_from_outside(page):
    text = markup(page)
    assert "default-src 'none'" in text
    sources = re.findall(r"""(?:src|href)\s*=\s*["']([^"']{0,30})""", text)
    assert sources and all(source.startswith("data:") for source in sources)
    assert "@import" not in text and "{{" not in text


def test_names_cannot_become_code(page):
    text = page.read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text and "<script>alert" not in text
    assert str(escape(HOSTILE)) in text


def test_it_plays_the_best_and_the_worst_beside_their_recordings(page, evaluation):
    clips = clips_of(page)
    sync = {clip.pair.name: clip.metrics["sync"] for clip in evaluation.models[0].clips}
    best, worst = (
        [v for c in clips for name, v in sync.items() if name in c["title"] and word in c["title"]]
        for word in ("Best", "Worst")
    )
    assert sorted(best) + sorted(worst) == [*sorted(sync.values())[2:], *sorted(sync.values())[:2]]
    assert best[0] == max(sync.values()) and worst[0] == min(sync.values())
    labels = [figure["label"] for figure in clips[0]["motion"]["figures"]]
    assert labels == ["model", HOSTILE, "recording"]
    assert all("audio" in clip["motion"] for clip in clips)
    assert script_json(player_shell()) in page.read_text(encoding="utf-8")


def test_a_clip_of_a_later_window_is_played_with_the_sound_of_that_window(tmp_path, gesture):
    """Twenty seconds of sound, of which the second ten hum."""
    time = np.arange(20 * 16000) / 16000
    hum = np.where(time < 10, 0.0, 0.3 * np.sin(2 * np.pi * 150 * time))
    (tmp_path / "sound").mkdir()
    soundfile.write(tmp_path / "sound" / "a.wav", hum, 16000)
    gesture(20.0, 25.0).save(tmp_path / "recordings" / "a.npz")
    gesture(10.0, 25.0, seed=1).save(tmp_path / "made" / "a_w001.npz")
    found = evaluate(tmp_path / "made", tmp_path / "recordings", audio=tmp_path / "sound")
    write_report(found, path := tmp_path / "report.html")
    data = clips_of(path)[0]["motion"]["audio"]["data"]
    played, rate = soundfile.read(io.BytesIO(base64.b64decode(data)))
    assert len(played) / rate == pytest.approx(10.0) and np.std(played[:rate]) > 0.1


def test_the_same_evaluation_gives_the_same_page(page, evaluation, tmp_path):
    write_report(evaluation, tmp_path / "r.html", command="gesturekit evaluate model recordings")
    assert (tmp_path / "r.html").read_bytes() == page.read_bytes()


@pytest.fixture(scope="module")
def private_page(evaluation, tmp_path_factory) -> Path:
    """A report on files in folders that nobody is to know, with the human body."""
    first, *others = evaluation.models
    named = replace(
        first,
        label="/data/secret/anna/runs/best",
        verdict="Like /data/secret/anna/speaker.npz.",
        notes=["samples of /data/secret/anna/model"],
        answers=[replace(a, sentence="See /data/secret/anna/x.") for a in first.answers],
    )
    settings = evaluation.settings | {"audio": f"{Path.cwd()}/a b/c.wav"}
    changed = replace(evaluation, models=[named, *others], settings=settings)
    path = tmp_path_factory.mktemp("private") / "r.html"
    command = f"gesturekit evaluate {Path.home()}/my models/best"
    write_report(changed, path, command=command, body="human")
    return path


def test_a_report_contains_no_absolute_paths(private_page):
    text, shown = private_page.read_text(encoding="utf-8"), markup(private_page)
    assert "/data/" not in text and "secret" not in text and "anna" not in text
    assert str(Path.cwd()) not in text and f"{Path.home()}/my" not in text
    for named in ("best", "Like speaker.npz.", "samples of model", "See x.", "rad/s"):
        assert named in shown, named


def test_the_human_body_has_the_colours_of_the_models(private_page):
    figures = clips_of(private_page)[0]["motion"]["figures"]
    assert len(figures) == 3
    assert all(figure["ink"] in figure["skin"]["palette"] for figure in figures)


@pytest.mark.stress
def test_it_opens_in_a_browser_without_a_word_in_the_console(page, open_browser):
    browser = open_browser()
    browser.open(page.as_uri(), width=800, height=600)
    browser.wait("document.querySelector('[data-player=ready]')")
    assert browser.run("document.querySelectorAll('[aria-pressed=true]').length") == 1
    assert browser.lines == []
