"""`gesturekit fit-features`: a feature extractor for the Fréchet gesture distance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gesturekit.cli.options import (
    FILE,
    PATH,
    comma_separated,
    existing_option,
    is_left,
    output_folder_option,
    seed_option,
)

if TYPE_CHECKING:
    from gesturekit.evaluation.measuring.clips import MotionSample


@click.command(
    "fit-features", epilog="Example: gesturekit fit-features recordings/ --out features --seed 0"
)
@click.argument("reference", nargs=-1, required=True, type=PATH, metavar="REFERENCE...")
@output_folder_option
@click.option(
    "--variant",
    type=click.Choice(["genea", "yoon"]),
    default="genea",
    help="genea: joint positions, 60 frames at 30 fps; yoon: upper-body bones, 34 at 15 fps.",
)
@click.option("--frames", type=int, help="Frames per window.  [default: the variant's]")
@click.option("--joints", metavar="LIST", help="body, upper, or names.  [default: the variant's]")
@click.option("--steps", type=click.IntRange(1), default=2300, help="Training steps.")
@click.option(
    "--weights",
    type=FILE,
    metavar="FILE",
    help="Take published weights of this layout (GENEA's model_checkpoint_60.bin, Yoon's gen_dict) "
    "instead of training; --joints names the joints that they were trained on.",
)
@seed_option
@existing_option("refuse")
def command(
    reference: tuple[Path, ...], out: Path, joints: str | None, existing: str, **options: Any
) -> int:
    """Train the autoencoder of the Fréchet gesture distance on your own recordings.

    REFERENCE are motion files (bvh, npz) of one rig, or folders of them. Writes
    feature_model.safetensors to the output folder, and prints a fingerprint:
    only distances with the same fingerprint can be compared. Takes minutes on a CPU. Of more than
    300 MB of rotations (70 minutes at 30 fps with 75 joints), a random sample is used.

    Exit codes: 0 all files were used; 1 some could not be read; 2 none could.
    """
    import logging

    from gesturekit.evaluation import FeatureModel
    from gesturekit.progress import Progress

    logging.basicConfig(format="%(message)s")
    if is_left([out / "feature_model.safetensors"], existing):
        return 0
    if options["weights"] is not None and options["frames"] is not None:
        raise click.UsageError("--weights has windows of its own: leave --frames out")
    sample, is_complete = _read(reference, options["seed"])
    names: str | list[str] | None = joints
    if joints is not None and joints not in ("body", "upper"):
        names = comma_separated(joints)
    if options["weights"] is not None:
        model = FeatureModel.of_weights(sample.motions, options["weights"], joints=names)
    else:
        with Progress(total=options["steps"], desc="Fitting", unit="step") as bar:
            model = FeatureModel.fit(
                sample.motions,
                options["variant"],
                n_frames=options["frames"],
                joints=names,
                steps=options["steps"],
                seed=options["seed"],
                progress=lambda step, loss: bar.update(),
            )
    model.save(out)
    if not sample.is_whole:
        used = sum(motion.duration for motion in sample.motions)
        click.echo(f"Fitted on a random {used / 60:.0f} of {sample.seconds / 60:.0f} minutes.")
    windows, record = model.windows, model.training
    click.echo(
        f"{out}: {windows.variant}, {windows.n_frames} frames at {windows.fps:g} fps, "
        f"{len(windows.bones)} bones, {record['windows']} windows; "
        f"{100 * (1 - record['unexplained']):.0f} % reconstructed"
    )
    click.echo(f"Fingerprint: {model.fingerprint}")
    return 0 if is_complete else 1


def _read(paths: tuple[Path, ...], seed: int) -> tuple[MotionSample, bool]:
    """Return motions of files and folders, and whether all could be read; print what is wrong."""
    from gesturekit.corpus.pairing import scan
    from gesturekit.errors import EvaluationError, GestureKitError
    from gesturekit.evaluation.measuring.clips import MotionSample
    from gesturekit.motion import Motion

    files: list[Path] = []
    is_complete = True
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        media, problems = scan(path)
        is_complete &= not problems
        for problem in problems:
            click.echo(f"Error: {problem}", err=True)
        files += [file.path for file in media if not file.is_speech]
    sample = MotionSample(seed)
    for file in files:
        try:
            sample.add(Motion.load(file))
        except (GestureKitError, OSError) as error:
            is_complete = False
            click.echo(f"Error: {error}", err=True)
    if not sample.count:
        raise EvaluationError(f"no motion could be read from {', '.join(map(str, paths))}")
    return sample, is_complete
