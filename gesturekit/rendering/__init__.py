"""Rendering speech to motion files."""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "estimated_cost": "batch",
        "Output": "renderer",
        "Renderer": "renderer",
        "SamplingOptions": "samples",
        "find_tasks": "inputs",
        "length_of": "inputs",
        "model_of_results": "batch",
        "other_sounds": "samples",
        "preview": "batch",
        "read_list": "inputs",
        "render_baseline": "samples",
        "render_batch": "batch",
        "sample_lda": "samples",
        "sample_multires": "samples",
        "sounds_of": "samples",
        "split_sounds": "samples",
        "task_wave": "inputs",
    },
)[1]
