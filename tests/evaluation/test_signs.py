"""What is done to a motion moves each metric the way it should, or not at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gesturekit.evaluation import (
    FeatureModel,
    coverage,
    div_g,
    div_k,
    fgd,
    fid_g,
    fid_k,
    global_diversity,
    inter_diversity,
    intra_diversity,
    local_diversity,
    patch_features,
    raw_fgd,
)
from gesturekit.motion import Motion
from gesturekit.motion.rotations import multiply_quaternions, quaternion_from_rotation_vector

CLIP = 4.0  # seconds of the clips of FID and Div


def jittery(motion: Motion, number: int) -> Motion:
    """Every joint shakes by 3 degrees, anew in each frame."""
    noise = np.random.default_rng(number).normal(size=(*motion.rotations.shape[:2], 3))
    shaken = multiply_quaternions(motion.rotations, quaternion_from_rotation_vector(0.05 * noise))
    return replace(motion, rotations=shaken)


def frozen(motion: Motion, number: int) -> Motion:
    """The first pose, held."""
    return replace(
        motion,
        rotations=np.tile(motion.rotations[:1], (motion.n_frames, 1, 1)),
        translation=np.tile(motion.translation[:1], (motion.n_frames, 1)),
        joint_translations={
            k: np.tile(v[:1], (motion.n_frames, 1)) for k, v in motion.joint_translations.items()
        },
    )


def shifted(motion: Motion, number: int) -> Motion:
    """A third of a second later."""
    return motion.slice(round(motion.fps / 3), motion.n_frames)


def sliding(motion: Motion, number: int) -> Motion:
    """The whole body glides sideways at 1 m/s."""
    glide = np.outer(motion.times, [1.0, 0.0, 0.0])
    return replace(motion, translation=motion.translation + glide)


DISTURBANCES = (jittery, frozen, shifted, sliding)

# What each metric does under the four disturbances above: "+" rises, "-" falls, "0" stays (within a
# fifth of what freezing does), "?" may do either. The contact labels among the features of the
# variant "ganimator" count a slide, and shaking feet, as much as a changed pose.
SIGNS = {
    "coverage": "--0-",
    "global diversity": "++0+",
    "local diversity": "++0+",
    "coverage, paper": "--00",
    "global diversity, paper": "++00",
    "local diversity, paper": "++00",
    "inter-diversity": "+?00",
    "inter-diversity, aligned": "+??0",
    "intra-diversity": "+-00",
    "FGD": "++00",
    "FGD, raw": "++00",
    "FID_k": "++0+",
    "FID_g": "++0+",
    "Div_k": "?-0?",
    "Div_g": "????",  # poses that are held differ from each other as much as movements do
}


def metrics(generated: list[Motion], reference: list[Motion], model: FeatureModel) -> dict:
    """Each metric of a set; patch metrics clip by clip, mean."""
    result = {}
    ours: list[np.ndarray] = []
    for variant, mark, near in (("ganimator", "", 0.3), ("paper", ", paper", 1.0)):
        ours = [patch_features(motion, variant) for motion in generated]
        theirs = [patch_features(motion, variant) for motion in reference]
        for name, metric, options in (
            ("coverage", coverage, {"threshold": near}),
            ("global diversity", global_diversity, {}),
            ("local diversity", local_diversity, {}),
        ):
            each = [metric(a, b, variant=variant, **options) for a, b in zip(ours, theirs)]
            result[name + mark] = np.mean(each)
    result["inter-diversity"] = inter_diversity(ours)
    result["inter-diversity, aligned"] = inter_diversity(ours, variant="aligned")
    result["intra-diversity"] = intra_diversity(ours)
    result["FGD"] = fgd(generated, reference, model, resamples=0).value
    result["FGD, raw"] = raw_fgd(generated, reference, model.windows).value
    result["FID_k"] = fid_k(generated, reference, seconds=CLIP, resamples=0).value
    result["FID_g"] = fid_g(generated, reference, seconds=CLIP, resamples=0).value
    result["Div_k"] = div_k(generated, reference, seconds=CLIP)
    result["Div_g"] = div_g(generated, reference, seconds=CLIP)
    return result


def synthetic(gesture) -> list[Motion]:
    """Arms that swing, each clip livelier than the one before."""
    clips = []
    for number in range(4):
        clip = gesture(12.0, seed=number)
        speed = np.array([0.6, 1.0, 1.5, 2.2])[number]
        clips.append(replace(clip, fps=clip.fps * speed).resample(30.0, 300))
    return clips


def recorded(shared_data) -> list[Motion]:
    motion = Motion.load(shared_data / "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh")
    return [motion.slice(start, start + 300) for start in range(300, 1500, 300)]


@pytest.fixture(scope="module", params=["synthetic", "recorded"])
def measured(request) -> dict[str, dict[str, float]]:
    """Metrics of the reference against itself, and of each disturbance of it."""
    fixture = "gesture" if request.param == "synthetic" else "shared_data"
    reference = globals()[request.param](request.getfixturevalue(fixture))
    model = FeatureModel.fit(reference, n_frames=30, steps=30)
    rows = {"itself": metrics(reference, reference, model)}
    for disturb in DISTURBANCES:
        generated = [disturb(motion, number) for number, motion in enumerate(reference)]
        rows[disturb.__name__] = metrics(generated, reference, model)
    return rows


def test_clips_that_hold_one_pose_do_not_differ(gesture):
    one = [frozen(gesture(9.0), 0)] * 2
    moving = [gesture(9.0, seed=1), gesture(9.0, seed=2)]
    assert div_k(one, moving, seconds=CLIP) == div_g(one, moving, seconds=CLIP) == 0.0


@pytest.mark.parametrize("name", SIGNS)
def test_each_moves_as_expected(measured, name):
    itself = measured["itself"][name]
    most = abs(measured["frozen"][name] - itself)
    for disturb, sign in zip(DISTURBANCES, SIGNS[name]):
        change = measured[disturb.__name__][name] - itself
        what = f"{name}, {disturb.__name__}: {itself:.4g} changes by {change:+.4g}"
        if sign == "0":
            assert abs(change) <= 0.2 * most, what
        elif sign != "?":
            assert change * (1 if sign == "+" else -1) > 0.02 * abs(itself), what
