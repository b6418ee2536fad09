"""Live generation: sound from a microphone, file or pipe in, poses out while it goes on."""

from gesturekit.live.recording import Recording
from gesturekit.live.runner import MotionStream, Report, Sink, Step, run
from gesturekit.live.sources import FileSource, Microphone, PipeSource, Source
from gesturekit.live.timeline import Block

__all__ = [
    "Block",
    "FileSource",
    "Microphone",
    "MotionStream",
    "PipeSource",
    "Recording",
    "Report",
    "Sink",
    "Source",
    "Step",
    "run",
]
