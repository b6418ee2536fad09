"""Checkpoints of the released code: read without running them, and moving as they do."""

import datetime
import os
import zipfile
from pathlib import Path

import numpy as np
import pandas
import pytest
import released
import torch
from numpy.testing import assert_allclose
from released import FEATURES, STYLES, dance
from scipy.spatial.transform import Rotation

import audio_features as af
import gesturekit as gk
from gesturekit.diffusion.config import NetworkConfig
from gesturekit.diffusion.noise_schedule import sample
from gesturekit.diffusion.released import DANCE_COLUMNS, ReleasedVector, convert_checkpoint

AXES = ("alpha", "beta", "gamma")


def published_vector(motion):
    """Return the 61 numbers (T, 61) of a motion in centimetres, as the corpus has them."""
    names, columns = motion.skeleton.names, {}
    turns = {name: Rotation.from_quat(motion.rotations[:, j]) for j, name in enumerate(names)}
    side = turns["Hips"].apply([1.0, 0.0, 0.0])
    facing = np.arctan2(-side[:, 2], side[:, 0])
    heading = Rotation.from_rotvec(facing[:, None] * [0.0, 1.0, 0.0])
    turns["Hips"] = heading.inv() * turns["Hips"]
    for name, turn in turns.items():
        for axis, values in zip(AXES, turn.as_rotvec().T, strict=True):
            columns[f"{name}_{axis}"] = values
    places = 100 * motion.translation
    steps = heading[1:].inv().apply(np.diff(places, axis=0))
    columns["Hips_Yposition"] = places[:, 1]
    columns["reference_dXposition"] = steps[[0, *range(len(steps))], 0]
    columns["reference_dZposition"] = steps[[0, *range(len(steps))], 2]
    turn = np.diff(np.unwrap(facing))
    columns["reference_dYrotation"] = turn[[0, *range(len(turn))]]
    return np.stack([columns[name] for name in DANCE_COLUMNS], axis=1)


@pytest.fixture
def lists(tmp_path):
    """Write the lists of names and a rig; return the arguments of the command."""
    (tmp_path / "styles.txt").write_text("\n".join(STYLES))
    (tmp_path / "features.txt").write_text("\n".join(FEATURES) + "\n")
    dance().save(tmp_path / "rig.bvh")
    given = ("--rig", tmp_path / "rig.bvh", "--styles", tmp_path / "styles.txt")
    return (*given, "--features", tmp_path / "features.txt", "--out", tmp_path / "model")


def features(n_frames=90, seed=1):
    rng = np.random.default_rng(seed)
    return (rng.gamma(2.0, [40.0, 120.0, 0.02], (n_frames, 3))).astype(np.float32)


def features_of_the_corpus(folder, name, values):
    """Write features as the corpus has them, and run the README's lines that make csv and npz."""
    times = pandas.to_timedelta(np.arange(len(values)) / 30, unit="s")
    table = pandas.DataFrame(values, index=times, columns=FEATURES)
    table.insert(1, "MFCC_0", 1.0)
    table.to_pickle(folder / f"{name}.audio29_30fps.pkl")
    text = (Path(__file__).parents[2] / "recipes/dance_motorica/README.md").read_text()
    lines = [line.strip() for line in text.splitlines() if line.startswith(("    d", "    numpy"))]
    assert len(lines) == 3
    given = {"pandas": pandas, "numpy": np}
    exec("\n".join(lines).replace("NAME", str(folder / name)), given)


def test_the_released_motion_vector_of_a_dance():
    motion = dance(120)
    vector = ReleasedVector.on(motion)
    theirs = published_vector(motion)
    ours = vector.representation.encode(motion)
    assert vector.representation.joints[0] == "Hips" and ours.shape == (120, 61)
    assert_allclose(ours / vector.units, theirs[:, vector.order], rtol=0, atol=1e-5)
    # Back again: all joints that are modelled, from a start at the origin that faces +Z.
    back = vector.representation.decode(theirs[:, vector.order] * vector.units, 30.0)
    for name in vector.representation.joints[1:]:
        j = motion.skeleton.index(name)
        apart = Rotation.from_quat(back.rotations[:, j]).inv()
        apart = (apart * Rotation.from_quat(motion.rotations[:, j])).magnitude()
        assert apart.max() < 1e-5
    again = published_vector(back)
    assert_allclose(again[1:], theirs[1:], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("has_features", "styles", "convolves", "steps"),
    [(True, True, False, 150), (True, False, False, 8), (False, False, False, 8)]
    + [(True, True, True, 8)],
)
def test_each_step_is_that_of_the_released_sampler(
    tmp_path, has_features, styles, convolves, steps
):
    motion, rows = dance(), features() if has_features else None
    path = tmp_path / "x.ckpt"
    state = released.write_checkpoint(
        path, published_vector(motion), rows, styles=styles, steps=steps, convolves=convolves
    )
    names = (STYLES if styles else (), FEATURES if has_features else ())
    model = convert_checkpoint(path, motion, *names)
    sizes = {"blocks": 3, "channels": 32, "embedding": 24, "step_angles": "float32"}
    attention = {"heads": 4, "feedforward": 48, "kernels": 21, "farthest_view": 75}
    attention |= {"layers": 2, "dilations": (0, 1, 2), "dropout": 0.15}
    convolutions = {"architecture": "diffwave", "dilations": (1, 2)}
    assert model.network.config == NetworkConfig(
        **sizes, **(convolutions if convolves else attention)
    )
    rng, n_frames = torch.Generator().manual_seed(5), 40
    condition = torch.randn((1, n_frames, model.conditions.width), generator=rng)
    noise = [torch.randn((1, n_frames, 61), generator=rng) for _ in range(steps)]
    # The released sampler: ancestral, variance of the posterior, no clipping (eqs. 2 and 3).
    beta = np.linspace(0.01, 0.7, steps).astype(np.float32).astype(np.float64)
    alpha, kept = 1 - beta, np.cumprod(1 - beta)
    states = [noise[0]]
    for k, n in enumerate(range(steps - 1, -1, -1)):
        found = released.noise_of(state, states[-1], condition, n)
        x = (states[-1] - beta[n] / (1 - kept[n]) ** 0.5 * found) / alpha[n] ** 0.5
        if n:
            x = x + (beta[n] * (1 - kept[n - 1]) / (1 - kept[n])) ** 0.5 * noise[k + 1]
        states.append(x)
    order = ReleasedVector.on(motion).order
    network = model.network.for_condition(condition, range(steps))
    worst = 0.0

    def compared(ours, step):
        """Compare the state before a step, and go on from the released one."""
        nonlocal worst
        theirs = states[steps - 1 - step][..., order]
        worst = max(worst, float((ours - theirs).norm() / theirs.norm()))
        ours.copy_(theirs)
        return network(ours, step)

    last = sample(compared, lambda k: noise[k][..., order], model.schedule)
    theirs = states[-1][..., order]
    assert max(worst, float((last - theirs).norm() / theirs.norm())) < 1e-5


def test_the_command_makes_a_model_that_dances_to_features(gesturekit, tmp_path, lists):
    motion, rows = dance(), features()
    released.write_checkpoint(tmp_path / "lda.ckpt", published_vector(motion), rows)
    done = gesturekit("convert-checkpoint", tmp_path / "lda.ckpt", *lists).ok()
    card = (tmp_path / "model" / "README.md").read_text()
    assert "academic use only" in done.out and "academic use only" in card
    assert "Chroma_0, Spectralflux_0, Beatactivation_0" in card
    model = gk.load(tmp_path / "model")
    assert model.styles == STYLES and model.fps == 30.0 and not model.clip_denoised
    # The folder has the released definition of the root's steps, the last three columns.
    read, vector = gk.Motion.load(tmp_path / "rig.bvh"), ReleasedVector.on(motion)
    theirs = published_vector(read)[:, vector.order] * vector.units
    assert_allclose(model.representation.encode(read)[:, -3:], theirs[:, -3:], rtol=0, atol=1e-5)
    # Numbers that the released code gives its network: standardised by the training's scaler.
    test = features(60, seed=2)
    features_of_the_corpus(tmp_path, "song", test)
    song = af.Wave(np.zeros(32000, np.float32), 16000, source=str(tmp_path / "song.wav"))
    scaled = (test - rows.mean(axis=0)) / rows.std(axis=0)
    assert_allclose(model.conditions.conditioner(song, 60), scaled, rtol=1e-4, atol=1e-4)
    # The features enter without the sound too, in Python and on the command line.
    controls = {"style": "gLO", "foot_lock": False, "clip_denoised": True, "seed": 1}
    of_sound = model.generate(song, **controls)
    for suffix in (".npz", ".csv"):
        alone = model.generate((tmp_path / "song").with_suffix(suffix), **controls)
        assert alone.n_frames == 60
        assert_allclose(alone.rotations, of_sound.rotations, atol=1e-6)
    asked = ("render", tmp_path / "song.csv", "--model", tmp_path / "model", "--style", "gLO")
    gesturekit(*asked, "--steps", 2, "--clip-denoised", "--out", tmp_path / "made").ok()
    assert gk.Motion.load(tmp_path / "made" / "song.bvh").n_frames == 60
    demo = ("render", tmp_path / "song.csv", "--model", "demo", "--out", tmp_path / "none")
    gesturekit(*demo).fails(1, "give the sound")
    moved = model.generate(song, style="gLO", foot_lock=False, clip_denoised=True)
    assert moved.n_frames == 60 and set(moved.skeleton.names) == set(motion.skeleton.names)
    gesturekit("convert-checkpoint", tmp_path / "lda.ckpt", *lists).fails(2, "exists")


class Runs:
    """A pickle that creates a file when it is read."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def test_no_code_of_a_checkpoint_is_run(gesturekit, tmp_path, lists):
    vectors, marker = published_vector(dance()), tmp_path / "ran"
    bad = tmp_path / "bad.ckpt"
    released.write_checkpoint(bad, vectors, features(), loops=Runs(marker))
    gesturekit("convert-checkpoint", bad, *lists).fails(2, "posix.system", "nothing was read")
    released.write_checkpoint(bad, vectors, features(), loops=datetime.date(2023, 9, 20))
    done = gesturekit("convert-checkpoint", bad, *lists).fails(2, "datetime.date")
    released.write_checkpoint(bad, vectors, features(), loops=bytearray(3))
    gesturekit("convert-checkpoint", bad, *lists).fails(2, "bytearray")
    bad.rename(tmp_path / "data_pipe.sav")
    gesturekit("convert-checkpoint", tmp_path / "data_pipe.sav", *lists).fails(2, "never read")
    assert done.err.count("\n") == 1
    assert not marker.exists() and not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        # The shape of a scaler's mean, and the size of a tensor: 2^31 - 1 numbers.
        (b"K=\x85r", b"J\xff\xff\xff\x7f\x85r", "has 61 numbers"),
        (b"K tr", b"J\xff\xff\xff\x7ftr", "does not match"),
        (b"residual_layersr", b"residual_layerXr", "residual_layers"),
        (b"u.", b"b.", "it is damaged"),
    ],
)
def test_a_checkpoint_that_claims_more_than_it_has(
    gesturekit, tmp_path, lists, before, after, says
):
    released.write_checkpoint(tmp_path / "x.ckpt", published_vector(dance()), features())
    with (
        zipfile.ZipFile(tmp_path / "x.ckpt") as good,
        zipfile.ZipFile(tmp_path / "y.ckpt", "w") as bad,
    ):
        for name in good.namelist():
            content = good.read(name)
            if name.endswith("data.pkl"):
                assert before in content
                content = content.replace(before, after)
            bad.writestr(name, content)
    done = gesturekit("convert-checkpoint", tmp_path / "y.ckpt", *lists).fails(2, "y.ckpt", says)
    assert done.err.count("\n") == 1 and not (tmp_path / "model").exists()


def test_a_zip_that_claims_more_than_it_has_and_other_pickles(gesturekit, tmp_path, lists):
    path = tmp_path / "x.ckpt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x/data.pkl", b"}.")
        archive.filelist[0].file_size = archive.filelist[0].compress_size = 1 << 40
    gesturekit("convert-checkpoint", path, *lists).fails(2, "claim more bytes than the file has")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x/data.pkl", b"}.")
        archive.writestr("y/data.pkl", b"}.")
    gesturekit("convert-checkpoint", path, *lists).fails(2, "not one data.pkl")
    torch.save({"when": datetime.date(2023, 9, 20)}, path, pickle_protocol=4)
    gesturekit("convert-checkpoint", path, *lists).fails(2, "newer protocol than torch writes")


def test_other_files_and_wrong_lists(gesturekit, tmp_path, lists):
    path = tmp_path / "x.ckpt"
    gesturekit("convert-checkpoint", path, *lists).fails(2, "no such file")
    path.write_bytes(b"HIERARCHY")
    gesturekit("convert-checkpoint", path, *lists).fails(2, "not a zip")
    torch.save({"weight": torch.ones(2)}, path)
    gesturekit("convert-checkpoint", path, *lists).fails(2, "no checkpoint of Listen")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x/data.pkl", bytes(10000))
    gesturekit("convert-checkpoint", path, *lists).fails(2, "compressed")
    released.write_checkpoint(path, published_vector(dance()), features())
    (tmp_path / "styles.txt").write_text("\n".join(STYLES[1:]))
    gesturekit("convert-checkpoint", path, *lists).fails(2, "8 styles; 7 names")
    state = torch.load(path, weights_only=False)
    (tmp_path / "styles.txt").write_text("\n".join(STYLES))
    state["state_dict"]["diffusion_model.more.weight"] = torch.ones(1)
    torch.save(state, path)
    gesturekit("convert-checkpoint", path, *lists).fails(2, "unknown tensors, such as more.weight")
    del state["state_dict"]["diffusion_model.more.weight"]
    name = next(name for name in state["state_dict"] if name.endswith("position_scorer.amplitudes"))
    right = state["state_dict"][name]
    state["state_dict"][name] = torch.ones(3)
    torch.save(state, path)
    gesturekit("convert-checkpoint", path, *lists).fails(2, "tensors that do not fit")
    state["state_dict"][name] = right
    scaler = state["hyper_parameters"]["Data"]["scalers"]["out_scaler"]
    for values, wrong, right in ((scaler.scale_, 0.0, 1.0), (scaler.mean_, np.nan, 0.0)):
        values[3] = wrong
        torch.save(state, path)
        gesturekit("convert-checkpoint", path, *lists).fails(2, "finite numbers, scale above 0")
        values[3] = right
    network = state["hyper_parameters"]["Diffusion"]["args"]["tisa"]
    for name, value, says in (("use_preln", True, "use_preln is True"), ("seq_len", 120, "slopes")):
        own = network | {name: value}
        state["hyper_parameters"]["Diffusion"]["args"]["tisa"] = own
        torch.save(state, path)
        gesturekit("convert-checkpoint", path, *lists).fails(2, says)
    (tmp_path / "columns.txt").write_text("\n".join(("Knee_Yposition", *DANCE_COLUMNS[:-1])))
    columns = ("--columns", tmp_path / "columns.txt")
    done = gesturekit("convert-checkpoint", path, *lists, *columns)
    done.fails(2, "Knee_Yposition, reference_dYrotation: expected")


def test_the_frame_rate_is_in_the_name_of_the_training_data(tmp_path):
    path = tmp_path / "x.ckpt"
    released.write_checkpoint(path, published_vector(dance()), None, styles=False, steps=8)
    state = torch.load(path, weights_only=False)
    for name, fps in (("expmap_20fps", 20.0), ("expmap_100fps", 100.0), ("expmap", 30.0)):
        state["hyper_parameters"]["Data"]["output_modality"] = name
        torch.save(state, path)
        assert convert_checkpoint(path, dance()).fps == fps
