"""gesturekit serve: an HTTP service that turns sounds into motion."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import click

from gesturekit.cli.options import device_option, model_option, service_options, weights_option
from gesturekit.errors import ConfigError


@click.command("serve", epilog="Example: gesturekit serve --model demo")
@model_option
@service_options(8000)
@click.option("--max-mb", "megabytes", default=64.0, help="Largest sound file, in MB.")
@click.option("--max-seconds", "seconds", default=600.0, help="Longest sound, in seconds.")
@click.option("--max-frames", "frames", default=36_000.0, help="Longest motion: seconds times fps.")
@click.option("--queue", default=16, help="Requests that may wait; more are refused.")
@click.option("--workers", type=click.IntRange(1, 64), default=1, help="Motions made in parallel.")
@weights_option
@device_option
def command(
    model: str,
    host: str,
    port: int,
    names: tuple[str, ...],
    token_file: Path | None,
    weights: Path | dict[str, Path] | None,
    device: str,
    **limits: Any,
) -> None:
    """Serve a model over HTTP: POST a sound, get BVH, npz or a page that plays the motion.

    The address itself has a page for browsers, /docs describes the API, /health gives the state,
    and /metrics has metrics for Prometheus.
    """
    try:
        import uvicorn

        from gesturekit.serving.access import listen
        from gesturekit.serving.app import Limits, create_app
    except ImportError as error:
        how = "pip install 'gesturekit[serve]'"
        raise ConfigError(f"{error.name} is not installed; run: {how}") from None
    from gesturekit.systems import load

    bounds = Limits(**limits)
    listening, url, hosts, token = listen(host, port, names, token_file)
    loaded = load(model, weights=weights, device=device)
    app = create_app(loaded, bounds, token=token, hosts=hosts)
    click.echo(f"Serving {model} at {url} (end with Ctrl-C)", err=True)
    config = uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=10)
    with contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])
