"""Live generation: sound from a microphone, file or pipe in, poses out while it goes on."""

from gesturekit.live.session import Report, run
from gesturekit.live.sinks import Recording, Sink, Step
from gesturekit.live.sources import FileSource

__all__ = ["FileSource", "Recording", "Report", "Sink", "Step", "run"]
