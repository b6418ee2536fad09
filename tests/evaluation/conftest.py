"""Motions whose arm speed is known: a trunk with two arms that turn at a given speed."""

from collections.abc import Callable

import numpy as np
import pytest

from audio_features import Wave
from gesturekit.evaluation import Evaluation, write_report
from gesturekit.motion import Motion, Skeleton


@pytest.fixture(scope="session")
def turning(skeleton: Skeleton) -> Callable[..., Motion]:
    """turning({joint: (T,) rad/s from frame k to k + 1}, fps): joints turn about z."""

    def make(speeds: dict[str, np.ndarray], fps: float = 25.0) -> Motion:
        n = len(next(iter(speeds.values())))
        rotations = np.zeros((n, skeleton.n_joints, 4))
        rotations[..., 3] = 1.0
        for name, speed in speeds.items():
            angle = np.concatenate([[0.0], np.cumsum(speed[:-1])]) / fps
            rotations[:, skeleton.index(name), 2] = np.sin(angle / 2)
            rotations[:, skeleton.index(name), 3] = np.cos(angle / 2)
        return Motion(skeleton, rotations, np.tile([0.0, 0.9, 0.0], (n, 1)), fps)

    return make


@pytest.fixture
def page_of(tmp_path) -> Callable[[Evaluation], str]:
    """page_of(evaluation): the text of its report."""

    def write(evaluation: Evaluation) -> str:
        write_report(evaluation, tmp_path / "page.html")
        return (tmp_path / "page.html").read_text(encoding="utf-8")

    return write


@pytest.fixture(scope="session")
def curve() -> Callable[[int, int], np.ndarray]:
    """curve(n, seed): a slowly varying random curve between 0 and 1 that has no period."""

    def make(n: int, seed: int) -> np.ndarray:
        from scipy.ndimage import gaussian_filter1d

        smooth = gaussian_filter1d(np.random.default_rng(seed).standard_normal(n), 4, mode="wrap")
        return (smooth - smooth.min()) / np.ptp(smooth)

    return make


@pytest.fixture(scope="session")
def speaking() -> Callable[..., Wave]:
    """speaking((T,) loudness in nepers above -70 dB, fps): noise of that loudness."""

    def make(loudness: np.ndarray, fps: float = 25.0, rate: int = 16000) -> Wave:
        time = np.arange(round(len(loudness) / fps * rate)) / rate
        level = np.interp(time, np.arange(len(loudness)) / fps, loudness)
        noise = np.random.default_rng(1).standard_normal(len(time))
        return Wave((3e-4 * np.exp(level) * noise).astype(np.float32), rate)

    return make
