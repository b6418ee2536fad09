"""gesturekit serve: an HTTP service that turns sounds into motion."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import click

from gesturekit.cli.options import model_option, weights_option
from gesturekit.errors import ConfigError

TOKEN = "GESTUREKIT_TOKEN"


@click.command("serve", epilog="Example: gesturekit serve --model demo")
@model_option
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Address to listen on. Addresses other than this machine require a token.",
)
@click.option("--port", type=click.IntRange(0, 65535), default=8000, show_default=True)
@click.option(
    "--name",
    "names",
    multiple=True,
    metavar="NAME",
    help="Additional host name of the service, such as that of a proxy. May be repeated.",
)
@click.option(
    "--token-file",
    type=click.Path(path_type=Path, dir_okay=False, exists=True),
    help=f"File with the token that requests must send.  [default: ${TOKEN}]",
)
@click.option("--max-mb", default=64.0, show_default=True, help="Largest sound file, in MB.")
@click.option("--max-seconds", default=600.0, show_default=True, help="Longest sound, in seconds.")
@click.option(
    "--per-minute", default=60.0, show_default=True, help="Most requests per client and minute."
)
@click.option(
    "--queue", default=16, show_default=True, help="Most requests that may wait; more are refused."
)
@click.option(
    "--workers",
    type=click.IntRange(1, 64),
    default=1,
    show_default=True,
    help="Number of motions that are generated in parallel.",
)
@weights_option
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda, cuda:1, or auto.")
def command(
    model: str,
    host: str,
    port: int,
    names: tuple[str, ...],
    token_file: Path | None,
    weights: Path | dict[str, Path] | None,
    device: str,
    **limits: float,
) -> None:
    """Serve a model over HTTP: POST a sound, get BVH, npz or a page that plays the motion.

    The address itself has a page for browsers, /docs describes the API, /health gives the state,
    and /metrics has metrics for Prometheus.
    """
    try:
        import uvicorn

        from gesturekit.serving.address import LOOPBACK, address_of, listening_socket
        from gesturekit.serving.app import create_app
    except ImportError as error:
        raise ConfigError(
            f"{error.name} is not installed; run: pip install 'gesturekit[serve]'"
        ) from None
    from gesturekit.serving.requests import Limits
    from gesturekit.systems import load

    renamed = {"max_mb": "megabytes", "max_seconds": "seconds"}
    bounds = Limits(**{renamed.get(name, name): value for name, value in limits.items()})
    token = _token(token_file)
    is_local = host in LOOPBACK
    if not is_local and token is None:
        raise ConfigError(
            f"--host {host} is reached from other machines: give a token by --token-file or "
            f"${TOKEN}"
        )
    # An address of all interfaces has many names; there the token protects.
    hosts = ("*",) if not is_local and not names else (*LOOPBACK, host, *names)
    listening = listening_socket(host, port)
    app = create_app(load(model, weights=weights, device=device), bounds, token=token, hosts=hosts)
    click.echo(f"Serving {model} at {address_of(listening, host)} (end with Ctrl-C)", err=True)
    connections = 4 * (bounds.workers + bounds.queue) + 32
    config = uvicorn.Config(
        app,
        log_level="warning",
        limit_concurrency=connections,
        timeout_keep_alive=5,
        timeout_graceful_shutdown=10,
        server_header=False,
        proxy_headers=False,
    )
    with contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listening])


def _token(file: Path | None) -> str | None:
    """Return the token of a file, or of the environment; None without one.

    Raises:
        ConfigError: it is short, or more than one line.
    """
    if file is None and TOKEN not in os.environ:
        return None
    token = os.environ[TOKEN] if file is None else file.read_text(encoding="utf-8").strip()
    if len(token) < 16 or not token.isascii() or not token.isprintable() or " " in token:
        raise ConfigError(
            "the token must be at least 16 printable ASCII characters without spaces, such as "
            "those of: openssl rand -hex 16"
        )
    return token
