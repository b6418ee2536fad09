"""Extractors of installed packages, found by their entry points."""

import json

import numpy as np
import pytest
from packages import CODE, install

import audio_features as af

SPEC = {"kind": "loudness", "gain": 2.0}


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """installed(version="1.2", code=CODE): (re)install the package own-features."""
    from audio_features.kinds import digest_of_sources

    def make(**options):
        digest_of_sources.cache_clear()  # as in another process
        install(tmp_path / "site", monkeypatch, **options)

    return make


def test_an_installed_extractor_is_one_more_kind(installed, speech):
    installed()
    extractor = af.extractor_from_spec(SPEC)
    assert isinstance(extractor, af.Extractor) and extractor.dim == 2
    assert extractor.names == ("loudness.rms", "loudness.clock")
    stack = af.Stack([extractor, af.Prosody()])
    assert stack.centred == (True, False, True, True, True, True)
    values = stack.extract(speech).at([0.1, 2.0]).values
    np.testing.assert_allclose(values[:, 1], [0.1, 2.0], atol=1e-6)
    expected = 2.0 * np.log(speech.rms(np.array([2.0])) + 1e-3)
    np.testing.assert_allclose(values[1, 0], expected[0], rtol=1e-5)
    assert extractor.spec["package"].startswith("own-features 1.2")
    again = af.extractor_from_spec(json.loads(json.dumps(extractor.spec)))
    assert again.spec == extractor.spec


def test_the_cache_keeps_its_features_until_the_package_changes(installed, speech, tmp_path):
    installed()
    cache = af.FeatureCache(tmp_path / "cache")
    first = cache.extract(af.extractor_from_spec(SPEC), speech)
    same = cache.extract(af.extractor_from_spec(SPEC), speech)
    np.testing.assert_array_equal(same.values, first.values)
    assert cache.contents().entries == 1
    for change in ({"version": "1.3"}, {"code": CODE.replace("1e-3", "1e-2")}):
        installed(**change)
        cache.extract(af.extractor_from_spec(SPEC), speech)
    assert cache.contents().entries == 3
    installed(code=CODE + "    worth_caching = False\n")
    cache.extract(af.extractor_from_spec(SPEC), speech)
    assert cache.contents().entries == 3


def test_another_version_than_that_of_training_is_warned_about(installed, caplog):
    installed()
    spec = af.extractor_from_spec(SPEC).spec
    assert not caplog.text
    installed(version="2.0")
    af.extractor_from_spec(spec)
    assert "own-features 2.0" in caplog.text and "own-features 1.2" in caplog.text


@pytest.mark.parametrize(
    "code, complaint",
    [
        ("import nothing_of_this_name", "nothing_of_this_name"),
        (CODE.replace('clock"), (True', 'clock", "x"), (True'), r"(?=.*\b3 names).*\b2\b"),
        (CODE.replace("np.log", "np.nan * np.log"), "finite"),
        (CODE.replace('"bad" in', '"speech" in'), "(?=.*RuntimeError).*CALL"),
    ],
)
def test_a_fault_of_a_package_is_one_error_that_names_it(installed, speech, code, complaint):
    installed(code=code)
    with pytest.raises(af.FeatureError, match=f"(?=.*'loudness')(?=.*own-features).*{complaint}"):
        af.extractor_from_spec(SPEC).extract(speech)


def test_a_missing_package_is_named_and_no_kind_of_ours_can_be_replaced(tmp_path, monkeypatch):
    spec = {**SPEC, "package": "own-features 1.2 (0a1b2c3d)"}
    with pytest.raises(af.FeatureError, match="'loudness' is not here: install 'own-features 1.2"):
        af.extractor_from_spec(spec)
    with pytest.raises(af.FeatureError, match="(?=.*'loudness').*logmel"):
        af.extractor_from_spec(SPEC)
    install(tmp_path, monkeypatch)
    entry = tmp_path / "own_features.dist-info" / "entry_points.txt"
    entry.write_text("[gesturekit.extractors]\nprosody = own_features:Loudness\n")
    assert isinstance(af.extractor_from_spec({"kind": "prosody"}), af.Prosody)
