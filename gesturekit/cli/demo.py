"""gesturekit demo: the bundled model on the bundled speech."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("demo", epilog="Example: gesturekit demo --out gesturekit-demo")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("gesturekit-demo"),
    show_default=True,
    help="Folder to fill.",
)
@click.option("--seed", default=0, show_default=True, help="Another seed, another gesture.")
@click.pass_context
def command(ctx: click.Context, out: Path, seed: int) -> None:
    """Render the bundled speech with the bundled model to BVH, npz, HTML and PNG."""
    from gesturekit.rendering.render import render
    from gesturekit.systems import bundled_speech, load

    (outcome,) = render(
        load("demo"), [bundled_speech()], out, formats=("bvh", "npz", "html", "png"), seed=seed
    )
    if outcome.error is not None:
        click.echo(f"Failed: {outcome.error}", err=True)
        ctx.exit(1)
    uses = {
        ".bvh": "Blender: File > Import > Motion Capture (.bvh); Scale 0.01, Forward -Z, Up Y,\n"
        "      tick Update Scene FPS and Update Scene Duration",
        ".npz": 'Python: gesturekit.Motion.load("...") or numpy.load',
        ".html": "any browser: double click; it plays with the sound",
        ".png": "any picture viewer: poses, hand speed and speech side by side",
    }
    for path in outcome.files:
        click.echo(f"{path}\n      {uses[path.suffix]}")
