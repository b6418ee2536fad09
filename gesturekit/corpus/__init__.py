"""Corpus: the manifest, its preparation, and the loading of its items."""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "Item": "item",
        "Manifest": "manifest",
        "Problem": "checks",
        "Report": "report",
        "prepare": "preparation",
    },
    {
        "Correlation": "alignment",
        "HoldOut": "splits",
        "LEAD": "alignment",
        "Listing": "layouts.listing",
        "Recording": "recording",
        "SpeechConditioner": "speech",
        "arm_speed": "alignment",
        "as_speech": "speech",
        "check_id": "item",
        "choose_held_out": "splits",
        "corrections": "alignment",
        "correlate": "alignment",
        "cut": "splits",
        "detects_voice": "speech",
        "examine": "recording",
        "extract": "speech",
        "file_fingerprint": "item",
        "first_difference": "checks",
        "muted": "item",
        "one_blas_thread": "speech",
        "parse_intervals": "splits",
        "pooled": "alignment",
        "reference_pose": "checks",
        "root_with": "layouts.listing",
        "speech_features": "speech",
        "split_items": "splits",
        "usual_skeleton": "checks",
    },
)
