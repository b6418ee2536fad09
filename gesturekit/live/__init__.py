"""Live generation: sound from a microphone, file or pipe in, poses out while it goes on."""

from gesturekit.lazy import attach
from gesturekit.live.recording import Recording
from gesturekit.live.runner import Report, Sink, Step, run
from gesturekit.live.sources import FileSource

__all__ = ["FileSource", "Recording", "Report", "Sink", "Step", "run"]

__getattr__ = attach(
    __name__,
    {},
    {
        "Block": "timeline",
        "Microphone": "sources",
        "PipeSource": "sources",
        "Timeline": "timeline",
    },
)[1]
