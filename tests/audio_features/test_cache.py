import os
import time
from pathlib import Path

import numpy as np
import pytest

import audio_features as af
from audio_features.cache import KINDS, DiskCache, size_limit


class Slow:
    """Stands for a network: counts how often it is asked, and gives awkward numbers."""

    names = ("a", "b", "c")
    centred = (True,) * 3
    dim = 3

    def __init__(self, **settings: object) -> None:
        self.spec = {"kind": "slow", **settings}
        self.asked = 0

    def extract(self, wave: af.Wave) -> af.FeatureTrack:
        self.asked += 1
        values = np.random.default_rng(len(wave.samples)).standard_normal((50, 3)) ** 7 * 1e-3
        values[0] = [-0.0, 1e-42, np.pi]
        return af.FeatureTrack(values, 0.0125 + 0.02 * np.arange(50), self.spec, self.names)


def entries(folder: Path) -> set[Path]:
    return set(folder.glob("*/*/*"))


@pytest.fixture
def wave() -> af.Wave:
    return af.Wave(np.random.default_rng(0).uniform(-0.5, 0.5, 16_000), 16_000)


def test_cached_features_equal_extracted_ones_bit_for_bit(tmp_path, wave):
    slow, cache = Slow(), af.FeatureCache(tmp_path)
    first = cache.extract(slow, wave)
    again = af.FeatureCache(tmp_path).extract(slow, wave)
    assert slow.asked == 1
    for track in (first, again):
        assert track.values.tobytes() == Slow().extract(wave).values.tobytes()
        assert track.times.tobytes() == first.times.tobytes()
        assert (track.spec, track.names) == (slow.spec, slow.names)


def test_another_sound_setting_or_rate_is_another_entry(tmp_path, wave):
    cache = af.FeatureCache(tmp_path)
    changed = wave.samples.copy()
    changed[-1] += 1e-6
    slow = Slow()
    for sound in (wave, af.Wave(changed, 16_000), af.Wave(wave.samples, 16_001)):
        cache.extract(slow, sound)
        cache.extract(slow, sound)
    assert slow.asked == 3
    for other in (Slow(layer=3), Slow(fingerprint="b")):
        cache.extract(other, wave)
        assert other.asked == 1
    assert cache.contents().entries == 5
    same, again = Slow(a=1, b={"c": 2, "d": 3}), Slow(b={"d": 3, "c": 2}, a=1)
    cache.extract(same, wave)
    cache.extract(again, wave)
    assert (same.asked, again.asked) == (1, 0), "the order of settings means nothing"


def test_parts_of_a_stack_are_kept_alone_and_light_ones_not_at_all(tmp_path, wave):
    slow, cache = Slow(), af.FeatureCache(tmp_path)
    stack = af.Stack([slow, af.Prosody()])
    first = cache.extract(stack, wave)
    np.testing.assert_array_equal(first.values, stack.extract(wave).values)
    cache.extract(af.Stack([af.LogMel(), slow]), wave)
    cache.extract(af.Prosody(), wave)
    assert slow.asked == 2  # once by the cache, once by the stack without it
    assert cache.contents().entries == 1


@pytest.mark.parametrize("fault", ["flip", "cut", "empty", "text", "folder"])
def test_a_damaged_entry_is_made_again(tmp_path, wave, fault, caplog):
    slow, cache = Slow(), af.FeatureCache(tmp_path)
    whole = cache.extract(slow, wave)
    (entry,) = entries(tmp_path)
    data = bytearray(entry.read_bytes())
    if fault == "flip":
        data[-100] ^= 1
        entry.write_bytes(data)
    elif fault == "folder":
        entry.unlink()
        entry.mkdir()
    else:
        entry.write_bytes({"cut": data[:-8], "empty": b"", "text": b"text" * 100}[fault])
    again = cache.extract(slow, wave)
    assert slow.asked == 2 and "damaged" in caplog.text
    np.testing.assert_array_equal(again.values, whole.values)
    if fault != "folder":
        cache.extract(slow, wave)
        assert slow.asked == 2


def test_the_least_recently_used_entries_are_removed_first(tmp_path):
    waves = [af.Wave(np.full(16_000 + i, 0.1), 16_000) for i in range(6)]
    slow, cache = Slow(), af.FeatureCache(tmp_path)
    for age, wave in enumerate(waves[:4]):
        before = entries(tmp_path)
        cache.extract(slow, wave)
        (entry,) = entries(tmp_path) - before
        os.utime(entry, (age, age))
    size = cache.contents().size // 4
    cache = af.FeatureCache(tmp_path, max_bytes=4 * size + size // 2)
    cache.extract(slow, waves[0])  # used again: no longer the oldest
    for wave in waves[4:]:
        cache.extract(slow, wave)
        assert cache.contents().entries <= 4
    asked = slow.asked
    for index in (0, 3, 4, 5):
        cache.extract(slow, waves[index])
    assert slow.asked == asked
    nothing = af.FeatureCache(tmp_path / "none", max_bytes=0)
    nothing.extract(slow, waves[0])
    assert nothing.contents().entries == 0


@pytest.mark.parametrize(("age", "stays"), [(1800, True), (7200, False)])
def test_what_a_killed_run_left_is_removed_after_an_hour(tmp_path, age, stays):
    left = tmp_path / KINDS[0] / "ab" / ".x.part"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"half")
    os.utime(left, (time.time() - age,) * 2)
    cache = DiskCache(tmp_path)
    assert (cache.contents().entries, cache.contents().oldest) == (0, None)
    cache.write(KINDS[0], "cd", bytes(10))
    assert left.exists() == stays


@pytest.mark.parametrize("size", ["20 GB", "-1", "nan", "inf"])
def test_a_size_of_the_cache_that_is_none_is_named(monkeypatch, size):
    monkeypatch.setenv("GESTUREKIT_CACHE_GB", size)
    with pytest.raises(af.AudioFeaturesError, match=f"GESTUREKIT_CACHE_GB='{size}'"):
        size_limit()


def test_clearing_removes_entries_and_nothing_else(tmp_path, wave):
    cache = af.FeatureCache(tmp_path)
    cache.extract(Slow(), wave)
    (tmp_path / "mine.txt").write_text("mine")
    left = next(iter(entries(tmp_path))).with_name(".x.part")
    left.write_bytes(b"what a killed run left")
    removed = cache.clear()
    assert removed.entries == 1 and removed.size > 0
    assert [path.name for path in tmp_path.rglob("*")] == ["mine.txt"]
    assert cache.contents().entries == 0 and cache.clear().entries == 0
