"""Live generation: sound from a microphone, file or pipe in, poses out while it goes on."""

from gesturekit.live.recording import Recording
from gesturekit.live.runner import Report, Sink, Step, run
from gesturekit.live.sources import FileSource, Microphone, PipeSource
from gesturekit.live.timeline import Block, Timeline

__all__ = [
    "Block",
    "FileSource",
    "Microphone",
    "PipeSource",
    "Recording",
    "Report",
    "Sink",
    "Step",
    "Timeline",
    "run",
]
