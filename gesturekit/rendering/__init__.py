"""Rendering speech to motion files."""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "Output": "renderer",
        "Renderer": "renderer",
        "SamplingOptions": "samples",
        "find_tasks": "inputs",
        "item_of": "inputs",
        "iter_render": "batch",
        "measured": "inputs",
        "measured_cost": "batch",
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
