"""Training of both systems: data, runs and model folders."""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "ArrayFolder": "data.arrays",
        "Checkpoints": "run.checkpoint",
        "HeldOutMetrics": "run.held_out",
        "ModelParts": "model_folder",
        "Processes": "run.processes",
        "Run": "run.folder",
        "TrainedSegment": "data.sources",
        "array_key": "data.arrays",
        "build": "config",
        "dump_yaml": "config",
        "has_no_run": "run.folder",
        "is_trained_on": "data.sources",
        "load_config": "config",
        "load_model": "model_folder",
        "load_sources": "data.sources",
        "model_digest": "model_folder",
        "read_chain": "config",
        "read_yaml": "config",
        "rng_for": "seeds",
        "save_model": "model_folder",
        "save_sources": "data.sources",
        "seeded": "seeds",
        "session": "run.session",
        "stored_arrays": "data.arrays",
        "to_dict": "config",
        "unused_labels": "data.sources",
    },
)[1]
