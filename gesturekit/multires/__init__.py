"""System 1: small GANs over a pyramid of frame rates, conditioned by FiLM.

Moreno-Villamarin, Hilsmann and Eisert: Multi-Resolution Generative Modeling of Human Motion from
Limited Data, CVMP 2024. It builds on GANimator (Li et al., SIGGRAPH 2022).
"""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "LevelDiscriminator": "networks",
        "LossConfig": "config",
        "MultiresConfig": "config",
        "MultiresControls": "controls",
        "MultiresGenerator": "networks",
        "MultiresModel": "model",
        "MultiresRepresentation": "motion_vector",
        "NetworkConfig": "config",
        "Normaliser": "motion_vector",
        "TrainingConfig": "config",
        "TrainingData": "training.data",
        "VectorKinematics": "kinematics",
        "choose_backend": "backend",
        "load_training_data": "training.loading",
        "resample": "resampling",
        "train": "training.trainer",
    },
)
