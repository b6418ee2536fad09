"""The shape of each speaker's body: from a corpus, through training, into rendered files."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from published import write_smplx

import gesturekit as gk
from gesturekit.motion.body_model import FOOT_VERTICES
from gesturekit.motion.contacts import foot_points
from gesturekit.training.recipes import recipe_table

DEBUG = recipe_table()["debug"]
WITHOUT_SPEECH = {
    "multires": ("ganimator", *DEBUG["multires"], "network.levels=3"),
    "diffusion": ("diffusion_speech/small", *DEBUG["diffusion"], "features=null"),
}


@pytest.fixture(params=["multires", pytest.param("diffusion", marks=pytest.mark.stress)])
def train(request, gesturekit, tmp_path, monkeypatch) -> Callable[..., tuple[Path, str]]:
    """train(name, recordings, *options of prepare, start_from=None): model, and what was said."""
    monkeypatch.setenv("GESTUREKIT_BACKEND", "torch")  # nothing to compile

    def run(name: str, recordings: Path, *options: object, start_from: Path | None = None):
        corpus, out = tmp_path / f"{name}.jsonl", tmp_path / name
        prepare = ("prepare", "--unpaired-motion", recordings, "--out", corpus, "--holdout", 0)
        gesturekit(*prepare, *options).ok()
        settings = [f"corpus={corpus}", f"out={out}", "training.window=1"]
        settings += [] if start_from is None else [f"start_from={start_from}"]
        done = gesturekit("train", *WITHOUT_SPEECH[request.param], *settings).ok()
        return out / "model", done.err

    return run


@pytest.fixture(scope="module")
def body_models(tmp_path_factory, capsule_body) -> Path:
    """A folder of two body models with the number of vertices, and so the feet, of SMPL-X."""
    folder = tmp_path_factory.mktemp("models")
    (folder / "smplx").mkdir()
    arrays, (n_vertices,) = capsule_body(55), [n for n in FOOT_VERTICES if n > 10_000]
    own = len(arrays["v_template"])
    at = np.arange(own)  # place of each vertex in the larger mesh: feet where SMPL-X has them
    at[arrays["feet"]] = FOOT_VERTICES[n_vertices]

    def grown(values: np.ndarray) -> np.ndarray:
        larger = np.zeros((n_vertices, *values.shape[1:]), np.float32)
        larger[at] = values
        return larger

    weights = grown(arrays["weights"])
    weights[weights.sum(axis=1) == 0, 0] = 1.0
    body = {"weights": weights, "f": at[arrays["f"]], "kintree_table": arrays["kintree_table"]}
    body |= {"shapedirs": grown(arrays["shapedirs"])}
    body |= {"J_regressor": grown(arrays["J_regressor"].T).T}
    for name, size in (("SMPLX_FEMALE", 0.9), ("SMPLX_NEUTRAL_2020", 1.0)):
        skin = size * grown(arrays["v_template"])
        np.savez(folder / "smplx" / f"{name}.npz", v_template=skin, **body)
    return folder


@pytest.fixture
def recordings(tmp_path) -> Path:
    """Two of ann, female, with other betas in each, and one of abe, neutral."""
    trans = [0.0, 1.3, 0.0] + 0.01 * np.sin(np.arange(45)[:, None] / 9)
    for seed, (name, gender, betas) in enumerate(
        [
            ("ann/a", "female", [1.0, -0.5]),
            ("ann/b", "female", [2.0, -0.5, 1.0]),
            ("abe/c", "neutral", np.arange(1.0, 7.0) / 4),
        ]
    ):
        own = {"betas": np.array(betas, np.float32), "gender": gender, "trans": trans}
        write_smplx(tmp_path / "takes" / f"{name}.npz", 1.5, seed, **own)
    return tmp_path / "takes"


def check_body(file: dict, folder: Path, name: str, betas: np.ndarray) -> None:
    """Compare bones and foot points with those of Loper et al. 2015, eqs. 8 and 10."""
    with np.load(folder / "smplx" / f"{name}.npz") as model:
        skin = model["v_template"] + model["shapedirs"][..., : len(betas)] @ betas
        joints = model["J_regressor"] @ skin
    bones = joints[1:] - joints[file["parents"][1:]]
    np.testing.assert_allclose(file["offsets"][1:], bones, atol=1e-6)
    feet = joints[file["end_site_joints"]] + file["end_site_offsets"]
    np.testing.assert_allclose(feet, skin[list(FOOT_VERTICES[len(skin)])], atol=1e-6)
    # Readers pose the model at the pelvis' rest position, plus `trans`.
    np.testing.assert_allclose(file["trans"] + joints[0], file["translation"], atol=1e-6)


def test_each_speaker_keeps_the_recorded_body(train, gesturekit, recordings, body_models, tmp_path):
    options = ("--style-pattern", "(?P<speaker>ann|abe)/", "--body-model", body_models)
    trained, said = train("run", recordings, *options)
    (of_ann,) = (line for line in said.splitlines() if "betas" in line)
    assert re.search(r"(?=.*\bann\b)(?=.*\b2\b)", of_ann)
    assert len(foot_points(gk.load(trained).skeleton)) == 6
    rendered = {}
    for speaker in ("ann", "abe", None):
        out = tmp_path / f"of_{speaker}"
        chosen = [] if speaker is None else ["--speaker", speaker]
        model = ("--model", trained, "--seconds", 1, "--format", "npz")
        gesturekit("render", "--out", out, *model, *chosen).ok()
        (file,) = out.glob("*.npz")
        with np.load(file) as arrays:
            rendered[speaker] = dict(arrays)
    ann, abe = rendered["ann"], rendered["abe"]
    assert (str(ann["gender"]), str(abe["gender"])) == ("female", "neutral")
    np.testing.assert_allclose(ann["betas"], [1.5, -0.5, 0.5, *[0] * 297], atol=1e-7)
    np.testing.assert_array_equal(abe["betas"], [*np.arange(1.0, 7.0) / 4, *[0] * 294])
    check_body(ann, body_models, "SMPLX_FEMALE", ann["betas"][:10])
    check_body(abe, body_models, "SMPLX_NEUTRAL_2020", abe["betas"][:10])
    assert str(rendered[None]["gender"]) in ("female", "neutral")
    own = abe if str(rendered[None]["gender"]) == "neutral" else ann
    np.testing.assert_array_equal(rendered[None]["betas"], own["betas"])
    np.testing.assert_array_equal(rendered[None]["offsets"], own["offsets"])


def test_a_model_trained_further_on_another_speaker_gets_their_body(train, recordings):
    bodies, start = {}, None
    for speaker in ("ann", "abe"):
        trained, said = train(speaker, recordings / speaker, start_from=start)
        assert ("gesturekit prepare --speaker" in said) == (start is None)
        start = trained
        bodies[speaker] = gk.load(trained).generate(seconds=0.5).skeleton.body_shape
    assert bodies["ann"].betas == (1.5, -0.5, 0.5) and bodies["ann"].gender == "female"
    assert bodies["abe"].betas == (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
    assert bodies["abe"].gender == "neutral"


def test_convert_fits_npz_to_the_model_of_its_gender(gesturekit, recordings, body_models, tmp_path):
    convert = ("convert", recordings, tmp_path / "out", "--format", "npz")
    gesturekit(*convert, "--body-model", body_models).ok()
    for name, model in (("ann/b", "SMPLX_FEMALE"), ("abe/c", "SMPLX_NEUTRAL_2020")):
        with np.load(recordings / f"{name}.npz") as source:
            source = dict(source)
        with np.load(tmp_path / "out" / f"{name}.npz") as made:
            check_body(dict(made), body_models, model, source["betas"])
            np.testing.assert_allclose(made["trans"], source["trans"], atol=1e-9)
            np.testing.assert_array_equal(made["betas"][: len(source["betas"])], source["betas"])
            assert str(made["gender"]) == str(source["gender"])
    (body_models / "smplx" / "SMPLX_FEMALE.npz").rename(tmp_path / "moved.npz")
    target, one = tmp_path / "b.npz", recordings / "ann/a.npz"
    try:
        done = gesturekit("convert", one, target, "--body-model", body_models)
    finally:
        (tmp_path / "moved.npz").rename(body_models / "smplx" / "SMPLX_FEMALE.npz")
    assert done.status == 1 and "SMPLX_FEMALE.npz" in done.err
    assert not target.exists()
