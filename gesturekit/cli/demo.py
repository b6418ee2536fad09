"""gesturekit demo: render the bundled speech with the bundled model."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import click

from gesturekit.cli.options import FOLDER, existing_option, is_left, resumable, seed_option


@click.command("demo", epilog="Example: gesturekit demo --out gesturekit-demo")
@click.option(
    *("-o", "--out"),
    type=FOLDER,
    default=Path("gesturekit-demo"),
    help="Output folder.",
)
@seed_option
@existing_option("refuse")
@click.pass_context
def command(ctx: click.Context, out: Path, seed: int, existing: str) -> None:
    """Render the bundled speech with the bundled model to BVH, npz, HTML and PNG.

    The face is made by rules (docs/face.md). The speech is copied to the same folder.
    """
    click.echo("Loading the demo model ...", err=True)
    from audio_features.atomic import atomic_write
    from gesturekit.rendering.renderer import Output, render_batch
    from gesturekit.rendering.summary import faces_in_words
    from gesturekit.systems import bundled_speech, load

    speech = bundled_speech()
    formats = ("bvh", "npz", "html", "png")
    output = Output(formats, existing=existing, body="human", framing="waist")
    # For playing it with the motion in Blender.
    wav = out / speech.name
    is_there = wav.is_file() and wav.read_bytes() == speech.read_bytes()
    if not is_there and not is_left([wav], existing):
        with atomic_write(wav) as temporary:
            temporary.write_bytes(speech.read_bytes())
    model, face = load("demo"), "phones" if find_spec("pocketsphinx") else "energy"
    click.echo(f"Rendering its speech into {out} ...", err=True)
    with resumable(lambda: "The same command continues."):
        (result,) = render_batch(model, [speech], out, output, seed=seed, face=face).run()
    if result.error is not None:
        click.echo(f"Failed: {result.error}", err=True)
        ctx.exit(1)
    click.echo(faces_in_words([result]), err=True)
    uses = {
        ".wav": "the speech; Blender: Add > Sound in the Video Sequencer",
        ".bvh": "Blender: File > Import > Motion Capture (.bvh); Scale 0.01, Forward -Z, Up Y,\n"
        "      tick Update Scene FPS and Update Scene Duration",
        ".npz": 'Python: gesturekit.Motion.load("...") or numpy.load',
        ".html": "any browser: double-click; it plays with the sound",
        ".png": "any image viewer: poses, hand speed and speech over time",
    }
    for path in (wav, *result.kept, *result.files):
        click.echo(f"{path}\n      {uses[path.suffix]}")
