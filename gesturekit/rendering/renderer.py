"""Render many sounds in one call, for the API and the command line; preview what would be done.

`Renderer` brings one input through one model to its files, with the settings of `Output`.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

import audio_features as af
from gesturekit.corpus.manifest import Item
from gesturekit.errors import ConfigError, gesturekit_errors
from gesturekit.formats.registry import WRITABLE
from gesturekit.formats.smpl import Rig
from gesturekit.formats.sources import writer_options
from gesturekit.jobs.batch import Batch, Execution
from gesturekit.jobs.records import STATE, read_items
from gesturekit.jobs.result import Processor, Result, Task, digest_of, json_of, path_digest
from gesturekit.model import Model, control_entries
from gesturekit.motion.motion import Motion
from gesturekit.rendering.inputs import (
    SoundSource,
    find_tasks,
    length_of,
    task_transcript,
    task_wave,
    task_words,
)
from gesturekit.systems import bundled_speech, controls_type, drawing_options, load
from gesturekit.viewer.drawn_body import AVATARS, load_avatar
from gesturekit.viewer.video import require_encoder

log = logging.getLogger(__name__)
RENDERED = ("bvh", "npz", "glb", "html", "mp4", "png")
_DRAWINGS = {"html", "mp4", "png"}
_SHORT, _LONG = 0.5, 5.0  # seconds of sound whose cost is measured


@dataclass(frozen=True)
class Output:
    """Settings of the files that are written.

    Attributes:
        formats: of bvh, npz, glb, html (a player with sound), mp4 (a video with sound), png (a
            picture); `"bvh,html"` or `(".BVH", "html")` mean the same as `("bvh", "html")`.
        existing: treatment of existing files that were made with another model, settings or
            input: refuse, skip or replace. Files made with the same ones are kept.
        rig: skeleton to retarget to: a motion file with any joint names, size and rest pose, or
            smpl, smplh or smplx; see `gesturekit.formats.smpl`. None for the model's own.
        unit: unit of BVH files; None for cm.
        up: up axis of SMPL npz files, "y" or "z"; None for y.
        body: in glb files, pages, videos and pictures: "mannequin", "human", "skeleton" or the path
            of an avatar (.vrm, or .glb with Mixamo's names); None for mannequin, and for human in
            drawings of a bundled model without a rig.
        framing: of pages and videos, "whole", "waist" or "face"; None for whole.
        size: of videos, "720p" or "1080p"; None for 720p.

    Raises:
        FormatError: an avatar that is missing or cannot be read.
    """

    formats: str | Sequence[str] = ("bvh",)
    existing: str = "refuse"
    rig: str | os.PathLike[str] | Rig | None = None
    unit: str | None = None
    up: str | None = None
    body: str | None = None
    framing: str | None = None
    size: str | None = None

    def __post_init__(self) -> None:
        formats = self.formats.split(",") if isinstance(self.formats, str) else self.formats
        plain = (name.strip().lower().removeprefix(".") for name in formats)
        object.__setattr__(self, "formats", tuple(dict.fromkeys(filter(None, plain))))
        if self.body is not None and self.body.lower().endswith(AVATARS):
            load_avatar(self.body)  # refused here, before any work


@dataclass
class Renderer(Processor):
    """A model with all settings; it renders one task at a time, and can be pickled.

    Args:
        model: model from `gesturekit.load`.
        out: folder for the results.
        output: settings of the written files.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        controls: arguments of the model's `generate`; `item` is the id of each task.

    Attributes:
        settings: what all results depend on, as JSON values.
        written: settings of each format's files, as JSON values.

    Raises:
        ConfigError: an unknown format.
        ModelError: a control that this kind of model does not have.
        FormatError, MotionError: a rig cannot be read, or its body parts cannot be found; or no
            encoder of videos is installed.
    """

    model: Model
    out: Path
    output: Output
    channel: int | None
    controls: dict[str, Any]

    def __post_init__(self) -> None:
        output = self.output
        unknown = [name for name in output.formats if name not in RENDERED]
        if unknown or not output.formats:
            others = [name for name in unknown if name in WRITABLE]
            convert = f"; gesturekit convert x.npz x.{others[0]} writes it" if others else ""
            named = ", ".join(unknown) or "(none)"
            raise ConfigError(f"format {named}: known: {', '.join(RENDERED)}{convert}")
        if "mp4" in output.formats:
            require_encoder()
        if self.controls.get("face", "off") != "off" and output.formats == ("bvh",):
            log.warning("face: BVH holds no face; add npz, glb or html to --format")
        self.existing = output.existing
        self.samples = self.controls.get("samples", 1)
        self.controls = _without_defaults(self.model, self.controls)
        rig = output.rig
        self.body = rig if rig is None or isinstance(rig, Rig) else Rig.load(rig)
        options = {
            name: getattr(output, name) for name in ("unit", "up", "body", "framing", "size")
        }
        given = {name: value for name, value in options.items() if value is not None}
        self.written = writer_options(output.formats, given)
        if rig is None:
            for kind in _DRAWINGS & self.written.keys():
                self.written[kind] = drawing_options(self.model) | self.written[kind]
        self.settings = {"model": self.model.fingerprint(), "seed": 0} | json_of(
            {name: _without_models(value) for name, value in self.controls.items()}
        )
        if self.body is not None:
            self.settings["rig"] = json_of(self.body)
        self.about = {"model_folder": str(self.model.folder)} if self.model.folder else {}

    def stems(self, task: Task) -> list[str]:
        """Return the paths of the samples below the output folder, without suffix."""
        if self.samples == 1:
            return [task.id]
        return [f"{task.id}_s{number}" for number in range(1, self.samples + 1)]

    def input_of(self, task: Task, digest: str | None = None) -> dict[str, Any]:
        """Return what the motions of a task depend on beside `settings`.

        Args:
            task: the task.
            digest: SHA-256 of its sound, if it is known already.

        Raises:
            GestureKitError: a file of a manifest's item cannot be read.
        """
        about = super().input_of(task, digest)
        if self.channel is not None:
            about["channel"] = self.channel
        if task.path is not None and any(model.inputs.words for model in self._models):
            words = task_words(task)
            about["words"] = words and path_digest(words)
        if task.path is not None:
            files = (file.find(task.path) for m in self._models for file in m.inputs.files)
            digests = [path and path_digest(path) for path in files]
            about |= {"features": digests} if digests else {}
        if (text := self._transcript(task)) is not None:
            about["transcript"] = digest_of(text)
        if (item := task.more.get("item")) is None:
            return about | json_of(task.more)
        about |= {"start": item.audio_start, "duration": item.duration}
        about |= {"channel": item.channel} if item.channel is not None else {}
        about |= {"audible": json_of(item.audible)} if item.audible else {}
        return about | json_of(self._item_controls(item))

    def _item_controls(self, item: Item) -> dict[str, Any]:
        """Return the controls of a manifest's item that were not given for all inputs."""
        controls = item.controls(self.model)
        return {name: value for name, value in controls.items() if name not in self.controls}

    def _transcript(self, task: Task) -> str | None:
        """Return the transcript of a task for its face, if it is needed and known."""
        if self.controls.get("face") != "phones":
            return None
        given = task.more.get("transcript", self.controls.get("transcript"))
        return (task_transcript(task) if given is None else given) or None

    def make(self, result: Result) -> None:
        """Generate the motions of a task and write them."""
        task = result.task
        wave, motions = self._generate(task)
        # The player embeds the original file, unless only a part of it was used.
        sound = task.path if self.channel is None and not task.more else wave
        result.sound = motions[0].duration if wave is None else wave.duration
        for motion, name in zip(motions, self.stems(task), strict=True):
            motion = motion if self.body is None else self.body.put(motion)
            result.facts["fps"] = motion.fps
            for file in self.missing(result, name):
                options = dict(self.written[file.suffix[1:]])
                if self.body is not None:
                    options |= self.body.options.get(file.suffix, {})
                if file.suffix[1:] in _DRAWINGS and sound is not None:
                    options["audio"] = sound
                motion.save(file, **options)

    def _generate(self, task: Task) -> tuple[af.Wave | None, list[Motion]]:
        """Return the sound of a task, and its motions."""
        wave, item = task_wave(task, self.channel), task.more.get("item")
        if wave is not None and not wave.is_silent:  # the model warns of silence
            for fault in wave.faults():
                log.warning("%s: %s", task.source, fault)
        controls: dict[str, Any] = dict(self.controls)
        seconds: float | None = None
        takes_speech = any(model.inputs.speech for model in self._models)
        is_whole_sound = wave is not None and takes_speech
        if item is not None:
            controls = self._item_controls(item) | controls
            seconds = None if is_whole_sound else item.duration
        elif task.more:
            names = ("seed", "style", "speaker")
            controls |= {name: task.more[name] for name in names if name in task.more}
            if not is_whole_sound:
                seconds = task.more.get("seconds", wave and wave.duration)
        if (text := self._transcript(task)) is not None:
            controls["transcript"] = text
        speech = wave if seconds is None else None
        controls |= {"seconds": seconds, "item": task.id, "samples": self.samples}
        motions = self.model.generate(speech, **controls)
        return wave, motions if isinstance(motions, list) else [motions]

    @property
    def _models(self) -> list[Model]:
        return [self.model, *(expert[0] for expert in self.controls.get("experts", ()))]


def _without_defaults(model: Model, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Check arguments of `generate`, and return those that differ from their defaults.

    Raises:
        ModelError: a control, style or level that the model does not have.
    """
    controls = model.check_controls(**arguments)
    entries = control_entries(controls_type(model.kind))
    chosen = {n: value for n, value in controls.items() if not entries[n].is_default(value)}
    seed = arguments.get("seed", 0)
    return ({"seed": seed} if seed != 0 else {}) | chosen


def _without_models(value: Any) -> Any:
    """Return a setting with a fingerprint in place of each model in it."""
    if isinstance(value, Model):
        return f"model sha256:{value.fingerprint()}"
    if isinstance(value, list | tuple):
        return [_without_models(item) for item in value]
    return value


@gesturekit_errors()
def render(
    model: Model | str | Path,
    sources: SoundSource | Sequence[SoundSource] = (),
    out: str | Path = "rendered",
    *,
    seconds: float | None = None,
    channel: int | None = None,
    **options: Any,
) -> list[Result]:
    """Render sounds to motion files, and return one result for each input.

    A broken sound never stops the others: its result has an `error`. Files that an earlier call
    made with the same model, settings and input are kept.

    Args:
        model: a loaded model, the name of a bundled one, or a model folder.
        sources: a sound file, a folder of them, a glob, a list (`gesturekit.rendering.inputs`), an
            item of a manifest, or a sequence of these; without any, one motion of length `seconds`
            is generated.
        out: folder for the results.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        options: fields of `Output` (formats, existing, rig, unit, up)
            and of `gesturekit.jobs.batch.Execution` (workers, shard, deadline ...), and
            arguments of the model's `generate` (seed, samples, style, foot_lock, smooth ...).
            `formats` are of bvh, npz, glb, html, mp4 and png: `("bvh", "html")` or `"bvh,html"`.

    Raises:
        ModelError: no such model, or a control, style or level that it does not have.
        ConfigError: an unknown format, a folder without audio, two sources that would write the
            same file, an existing result with `existing="refuse"`, an output folder that cannot
            be written to, or in which another run works.
        OutputError: the disk became full; what is done is kept.
        FormatError, MotionError: a rig cannot be read, or its body parts cannot be found.

    Examples:
        Without sounds, one motion of a given length is made:

        >>> results = gk.render("demo", [], folder / "out", seconds=2, formats="npz")
        >>> [file.name for result in results for file in result.files]
        ['motion.npz']
    """
    model = load(model) if isinstance(model, str | os.PathLike) else model
    output, execution = (
        {f.name: options.pop(f.name) for f in fields(kind) if f.name in options}
        for kind in (Output, Execution)
    )
    options |= {"seconds": seconds, "channel": channel}
    work = render_batch(model, sources, out, Output(**output), Execution(**execution), **options)
    return list(work.run())


def render_batch(
    model: Model,
    sources: SoundSource | Sequence[SoundSource],
    out: str | Path,
    output: Output | None = None,
    execution: Execution | None = None,
    *,
    seconds: float | None = None,
    channel: int | None = None,
    **controls: Any,
) -> Batch:
    """Return the work of rendering: a motion for each input, as NAME.bvh (NAME_s1.bvh ... if many).

    NAME is the stem of a sound file, the path within its folder for one found in a folder, and
    the id of a manifest's item. Faults of a sound (`Wave.faults`) are logged as warnings, and it is
    rendered nevertheless. A hidden folder beside the results records what was done with which
    model, settings and input, so that an interrupted run can be continued.

    Args:
        model: model from `gesturekit.load`.
        sources: sound files; folders, for all sounds below them; globs; lists; items of a
            manifest. An item's sound is cut to its interval, and its style, speaker, path and
            events are used where the model has them as inputs and `controls` does not set them.
            Items without sound, or for a model without speech input, are as long as their
            duration. Without any source, one motion of length `seconds` is generated.
        out: folder for the results.
        output: settings of the written files.
        execution: how the work is done.
        seconds: length of the motion without sources.
        channel: channel of each file to use, counted from 1; None for the mean of all.
        controls: arguments of the model's `generate`: seed, samples, style, foot_lock, smooth ...

    Raises the errors of `render`.
    """
    renderer = Renderer(model, Path(out), output or Output(), channel, controls)
    if sources:
        tasks = find_tasks(sources, renderer.out)
    else:
        tasks = [Task("motion", more={} if seconds is None else {"seconds": seconds})]
    return Batch(renderer, tasks, execution or Execution())


def model_of_results(out: Path) -> Path | None:
    """Return the folder of the model that made the latest results in a folder, if it is known.

    Raises:
        FormatError: what is known of the run is damaged, or was written by a newer version.
    """
    folder = (read_items(out / STATE) or {}).get("model_folder")
    return Path(folder) if isinstance(folder, str) else None


def preview(batch: Batch) -> Iterator[tuple[Result, float | None]]:
    """Yield what would come of each task, and its seconds of sound; nothing is written.

    The status is "left" for a task to be done, "kept" if its files are up to date, and "failed" if
    it cannot be done, or was put aside. Only the first half second of a sound is read, so that
    damage further on is not found.
    """
    for task in batch.tasks:
        result, seconds = batch.known(task), length_of(task)
        if result.status == "left" and task.path is not None and seconds is None:
            try:
                af.Wave.load(task.path, duration=_SHORT)
            except (af.AudioError, OSError) as error:
                result = Result(task, "failed", error=str(error))
        yield result, seconds


def estimated_cost(batch: Batch, items: int, sound: float) -> tuple[float, float]:
    """Return seconds and bytes of items with so many seconds of sound, for one process.

    The cost of a short and a longer piece of speech is measured in a temporary folder; it is 0 if
    nothing can be made of speech with these settings.
    """
    costs, speech = [], af.Wave.load(bundled_speech())
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        processor = batch.processor.trial(Path(folder))
        for seconds in (_LONG, _SHORT, _LONG):  # the first includes compilation
            wav = Path(folder) / f"{seconds:g}.wav"
            piece = speech.slice(1.0, seconds)  # it begins with silence
            soundfile.write(wav, piece.samples, piece.sample_rate)
            result = processor(Result(Task(wav.stem, wav)))
            costs.append([result.seconds, sum(made["size"] for made in result.made.values())])
    if result.status != "done":
        return 0.0, 0.0
    # Samples cost the same each: one was measured.
    _, short, long = batch.processor.samples * np.array(costs)
    of_second = np.maximum(0.0, (long - short) / (_LONG - _SHORT))
    of_item = np.maximum(0.0, short - _SHORT * of_second)
    time, size = items * of_item + sound * of_second
    return float(time), float(size)
