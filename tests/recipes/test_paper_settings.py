"""Configurations that claim to be a paper's own, value by value against a literal table.

Beside each value stands where it comes from: a section, table or equation of the paper, `code` for
the authors' released code where the paper is silent, or `ours` where both are. A value of ours is
named in docs/papers.md too.
"""

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from gesturekit.diffusion import DiffusionConfig
from gesturekit.multires import MultiresConfig
from gesturekit.training.config import load_config

RECIPES = Path(__file__).resolve().parents[2] / "recipes"

# Settings that say where a run lies and how it reports; they do not change what is trained.
NOT_THE_PAPERS = {
    "system", "corpus", "out", "seed", "parts", "checkpoint_every", "log_every", "eval_every",
    "measure", "threads", "device", "notes", "in_memory", "arrays", "workers", "longer",
}  # fmt: skip

# Alexanderson, Nagy, Beskow and Henter 2023 ("Listen, Denoise, Action!").
ZEROEGGS = {
    "fps": (30.0, "4.1"),
    "joints": ("body", "A.1: no fingers"),
    "smooth": (None, "4.6: no foot stabilisation in any motion"),
    "clip_denoised": (True, "ours: the code has none"),
    "features.extractors": (({"kind": "mfcc", "n": 16},), "Table 1: 16 audio features"),
    "features.weights": (None, "no WavLM"),
    "features.align": ("mean", "ours"),
    "features.normalise": ("corpus", "A.1"),
    "features.components": (None, "none is mentioned"),
    "features.vad": (None, "ours: stretches without a voice are silence"),
    "path": (False, "4.1: root motion is an output"),
    "events": (False, "4.1"),
    "styles.handed": ((), "A.1: locomotion only"),
    "unpaired": (None, "4.3"),
    "start_from": (None, "A.1: trained from scratch"),
    "moves_like": (None, "A.1"),
    "network.blocks": (10, "A.1"),
    "network.layers": (4, "A.1"),
    "network.channels": (256, "A.1"),
    "network.heads": (8, "A.1"),
    "network.feedforward": (1024, "A.1"),
    "network.embedding": (512, "A.1"),
    "network.dilations": ((0, 1, 2), "A.1: cycle of length 3; code: 0, 1, 2"),
    "network.kernels": (21, "code"),
    "network.nearest_view": (5, "code"),
    "network.farthest_view": (75, "code"),
    "network.dropout": (0.1, "code"),
    "network.architecture": ("conformer", "3.2"),
    "network.step_angles": ("float64", "deviates: the code has float32"),
    "noise.steps": (100, "Table 1, A.1"),
    "noise.first_beta": (0.0074, "A.1"),
    "noise.last_beta": (0.78, "A.1"),
    "noise.predict": ("noise", "eq. 4"),
    "training.updates": (67_000, "Table 1"),
    "training.batch": (80, "4.1"),
    "training.window": (5.0, "4.1"),
    "training.learning_rate": (6e-4, "A.1"),
    "training.warm_up": (3000, "A.1"),
    "training.decay": (0.99995, "code; A.1 prints 1 - 0.5e-5"),
    "training.clip": (25.0, "code"),
    "training.ema": (0.0, "code"),
    "training.dropout_condition": (0.0, "4.1: a twin without style instead"),
    "training.dropout_style": (0.0, "4.1: a twin without style instead"),
    "training.dropout_state": (0.0, "eq. 4: no state"),
    "training.state": (0.0, "eq. 4"),
    "state": (False, "the paper gives the network no state of movement"),
    "training.min_snr": (None, "code: plain MSE"),
    "training.changes": (0.0, "eq. 4"),
    "training.foot_sliding": (0.0, "eq. 4"),
    "training.precision": ("float32", "code"),
    "augmentation.mirror": (True, "A.1"),
    "augmentation.stretch": (0.1, "A.1"),
    "augmentation.stretch_range": (0.1, "A.1"),
}
NO_STYLE = {"styles": (None, "Table 1")}
MUSIC_AND_MOVES = {
    "noise.steps": (150, "Table 1, A.1"),
    "noise.first_beta": (0.01, "A.1"),
    "noise.last_beta": (0.7, "A.1"),
}
TSG = ZEROEGGS | NO_STYLE | {
    "features.extractors": (({"kind": "mfcc", "n": 20},), "4.3.1, Table 1"),
    "training.updates": (112_000, "Table 1"),
}  # fmt: skip
DANCE = ZEROEGGS | MUSIC_AND_MOVES | {
    "features.extractors": (({"kind": "music", "n_chroma": 1},), "4.4: flux, chroma, downbeat"),
    "network.blocks": (20, "A.1"),
    "network.layers": (2, "A.1"),
    "training.updates": (180_000, "Table 1"),
    "augmentation.stretch": (0.2, "A.1"),
}  # fmt: skip
NO_AUDIO = {"features": (None, "Table 1: no audio features")}
DIFFUSION = {
    "config.yaml": ZEROEGGS,
    "unconditional.yaml": ZEROEGGS | NO_STYLE,
    "decay_paper.yaml": ZEROEGGS | {"training.decay": (0.999995, "A.1")},
    "tsg.yaml": TSG,
    "lda_dw.yaml": TSG | {
        "network.architecture": ("diffwave", "4.3.1"),
        "network.blocks": (30, "ours: DiffWave's"),
        "network.dilations": ((1, 2, 4, 8, 16, 32, 64, 128, 256, 512), "A.1: cycle of length 10"),
    },
    "dance.yaml": DANCE,
    "dance_unconditional.yaml": DANCE | NO_STYLE,
    "fighting.yaml": ZEROEGGS | MUSIC_AND_MOVES | NO_STYLE | NO_AUDIO | {
        "network.channels": (256, "ours: A.1 excepts this model"),
        "network.heads": (8, "ours: A.1 excepts this model"),
        "network.dilations": ((0, 1, 2), "ours: A.1 excepts this model"),
        "events": (True, "4.1: binary flags for a set of moves"),
        "network.feedforward": (512, "A.1"),
        "network.embedding": (256, "ours: A.1 says reduced"),
        "training.updates": (52_000, "Table 1"),
        "augmentation.stretch": (0.2, "A.1"),
    },
    "locomotion.yaml": ZEROEGGS | MUSIC_AND_MOVES | NO_AUDIO | {
        "path": (True, "4.1, 4.6: root motion is an input"),
        "styles.handed": (("100style",), "A.1 lists none: ours, by their names"),
        "training.updates": (292_000, "Table 1"),
    },
}  # fmt: skip

# Moreno-Villamarín, Hilsmann and Eisert 2024; "GANimator" is Li et al. 2022, whose architecture
# section 4.2 takes over, or its released code.
SPEECH = {
    "fps": (25.0, "5"),
    "start_from": (None, "3: no other model is mentioned"),
    "joints": ("body", "4.1: 23 joints and the root, no fingers"),
    "smooth": (None, "no post-processing of the upper body"),
    "normalise": (False, "GANimator: none"),
    "face_forward": (False, "GANimator: none"),
    "contact_threshold": (0.2, "ours: eq. 1 gives no value"),
    "z_star": ("shared", "3.2: shared along the channel axis"),
    "z_star_shuffle": (0, "3.2: noise is drawn anew"),
    "noise_levels": (10, "eq. 4: every level; GANimator samples with 1"),
    "features.extractors": (({"kind": "wavlm", "layer": "last"},), "5; layer ours"),
    "features.weights": (None, "given on the command line"),
    "features.align": ("linear", "5: interpolated to 25 fps"),
    "features.normalise": ("none", "5: none is mentioned"),
    "features.components": (None, "none is mentioned"),
    "features.vad": (False, "5: none is mentioned"),
    "features.residual": (True, "5"),
    "styles": (None, "5: speech only"),
    "network.levels": (10, "3.2"),
    "network.factor": (4 / 3, "3.2"),
    "network.channels": ((128, 256, 256), "GANimator"),
    "network.channels_per": ("layer", "GANimator: rounded up to a multiple of the blocks"),
    "network.kernel": (5, "GANimator"),
    "network.neighbour_distance": (2, "GANimator"),
    "network.contact_reach": ("foot", "GANimator"),
    "network.film": ("input", "eq. 10"),
    "network.embedding": (8, "4.2, the only width that is given"),
    "network.rectify_embedding": (False, "3.3: a fully connected layer"),
    "network.modulate": ("upper", "5"),
    "network.residual": (True, "eq. 7"),
    "losses.adversarial": (1.0, "4.2"),
    "losses.gradient_penalty": (1.0, "GANimator"),
    "losses.reconstruction": (50.0, "4.2"),
    "losses.contact": (5.0, "4.2"),
    "losses.smoothness": (5.0, "4.2"),
    "losses.smooth_levels": ("fine", "3.4"),
    "losses.arm_speed": (0.0, "eq. 11 has none"),
    "losses.arm_acceleration": (0.0, "eq. 11 has none"),
    "losses.detail": (0.0, "eq. 11 has none"),
    "losses.coarse": (0.0, "eq. 11 has none"),
    "losses.state": (0.0, "eq. 11 has none"),
    "state": (False, "the papers give the network speech and styles alone"),
    "retrieval": (False, "the papers generate all motion"),
    "losses.rec_input": ("real", "eq. 15"),
    "losses.contact_speed": ("squared", "eq. 14"),
    "losses.contact_time": ("frame", "GANimator: eq. 14 gives no unit"),
    "losses.contact_slope": (10.0, "eq. 14"),
    "losses.discriminator_scale": (1.0, "eq. 12"),
    "losses.penalty_on": ("printed", "eq. 13"),
    "training.first_stage": (15_000, "4.2, for labels; ours for speech"),
    "training.further_stages": (25_000, "4.2, for labels; ours for speech, and per pair"),
    "training.stage_levels": (2, "3.4"),
    "training.discriminator_steps": (5, "GANimator"),
    "training.generator_steps": (1, "GANimator"),
    "training.reconstruction_steps": (1, "GANimator"),
    "training.learning_rate": (1e-4, "4.2"),
    "training.betas": ((0.9, 0.999), "GANimator: Adam's own"),
    "training.decay_at": (1.0, "no decay is mentioned"),
    "training.batch": (1, "GANimator"),
    "training.window": (None, "GANimator: whole sequences"),
    "training.window_cache": (None, "3.2: fresh noise"),
    "training.renew_every": (50, "unused where bank is null"),
    "training.margins": (False, "not in the paper"),
    "training.silence": (0.0, "not in the paper"),
    "precision": ("float32", "GANimator"),
    "backend": ("auto", "implementation only"),
}
NO_SPEECH = {"features": (None, "4: labels only")}
LABELS = {name: SPEECH[name] for name in SPEECH if name != "styles"} | NO_SPEECH | {
    "fps": (25.0, "ours: 5; 4.3.1 has 30 frames a second"),
    "losses.arm_speed": (3.0, "unused without speech"),
    "training.silence": (0.1, "unused without speech"),
    "styles.mixing": (0.9, "4.2"),
    "styles.condition_discriminator": (False, "eq. 12: D sees the motion alone"),
    "network.levels": (8, "3.2"),
    "noise_levels": (8, "eq. 4: every level; GANimator samples with 1"),
    "network.modulate": ("all", "4"),
}  # fmt: skip
GANIMATOR = SPEECH | {
    "features": (None, "no condition"),
    "contact_threshold": (0.54, "code: 0.018 a frame at 30 fps"),
    "z_star": ("full", "code: of each channel, unscaled"),
    "noise_levels": (1, "code: sampling sets the amplitudes of finer levels to 0"),
    "network.levels": (7, "code: 7 at ratio 1/5"),
    "network.film": ("all", "unused without a condition"),
    "network.embedding": (64, "unused without a condition"),
    "network.rectify_embedding": (True, "unused without a condition"),
    "losses.arm_speed": (3.0, "unused without speech"),
    "losses.rec_input": ("generated", "code"),
    "losses.smoothness": (0.0, "code: none"),
    "losses.contact_speed": ("norm", "code"),
    "losses.contact_slope": (12.0, "code"),
    "losses.discriminator_scale": (0.5, "code"),
    "losses.penalty_on": ("frame", "code"),
    "training.further_stages": (15_000, "code"),
    "training.renew_every": (80, "unused where bank is null"),
    "training.silence": (0.1, "unused without speech"),
}
MULTIRES = {
    "multires_speech/config.yaml": SPEECH,
    "multires_labels/published.yaml": LABELS,
    "ganimator/published.yaml": GANIMATOR,
}


def settings(config: Any, prefix: str = "") -> dict[str, Any]:
    """Every setting by its dotted name, the defaults included."""
    found: dict[str, Any] = {}
    for field in fields(config):
        value = getattr(config, field.name)
        name = f"{prefix}{field.name}"
        found |= settings(value, f"{name}.") if is_dataclass(value) else {name: value}
    return {name: value for name, value in found.items() if name not in NOT_THE_PAPERS}


def without_sections_left_out(table: dict[str, tuple[Any, str]]) -> dict[str, Any]:
    """The table's values; a section that is None has no settings of its own."""
    gone = tuple(f"{name}." for name, (value, _) in table.items() if value is None)
    return {name: value for name, (value, _) in table.items() if not name.startswith(gone)}


@pytest.mark.parametrize("name", DIFFUSION)
def test_diffusion_settings_are_those_of_the_paper(name):
    path = RECIPES / "diffusion_speech" / name
    config = load_config(path, DiffusionConfig, ["corpus=corpus.jsonl"])
    assert settings(config) == without_sections_left_out(DIFFUSION[name])


@pytest.mark.parametrize("name", MULTIRES)
def test_multires_settings_are_those_of_the_paper(name):
    config = load_config(RECIPES / name, MultiresConfig, ["corpus=corpus.jsonl"])
    assert settings(config) == without_sections_left_out(MULTIRES[name])
