"""gesturekit doctor: check the installation."""

from __future__ import annotations

from pathlib import Path

import click

from gesturekit.cli.options import PATH

MARKS = {"ok": "ok", "note": "note", "broken": "BROKEN"}


@click.command(epilog="Example: gesturekit doctor --weights wavlm-base-plus/")
@click.option(
    "--weights",
    type=PATH,
    help="WavLM weights (folder or file) or Hugging Face speech encoder (folder) to read.",
)
def command(weights: Path | None) -> int:
    """Check torch, GPU, threads, torchaudio, transformers, ffmpeg, Blender, disk, cache, weights.

    The exit code is 0 if gesturekit is usable, and 1 if a requirement is broken. Include the
    output when you report a problem.
    """
    from gesturekit.diagnosis import diagnose, is_usable

    findings = []
    for finding in diagnose(weights):
        findings.append(finding)
        click.echo(f"{MARKS[finding.state]:<7}{finding.name:<13} {finding.text}")
        if finding.advice:
            click.echo(f"{'':<20} → {finding.advice}")
    return 0 if is_usable(findings) else 1
