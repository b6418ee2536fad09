"""gesturekit recipes: list the recipes that come with gesturekit, or copy one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from gesturekit.cli.options import PATH

if TYPE_CHECKING:
    from gesturekit.training.recipes import Recipe


@click.command(
    epilog="Example: gesturekit recipes ls\n\nExample: gesturekit recipes ls own_corpus\n\n"
    "Example: gesturekit recipes cp own_corpus my_recipe"
)
@click.argument("action", type=click.Choice(["ls", "cp"]), default="ls")
@click.argument("name", required=False)
@click.argument("destination", required=False, type=PATH, metavar="[DEST]")
def command(action: str, name: str | None, destination: Path | None) -> None:
    """List the recipes (ls, the default), the configurations of one (ls NAME), or copy one to the
    folder DEST, by default ./NAME (cp NAME DEST).

    `gesturekit train NAME` trains a recipe as it is, `gesturekit train NAME/VARIANT` another of its
    configurations, `gesturekit train DEST` an edited copy.
    """
    from gesturekit.training.recipes import copy_recipe, recipe, recipes

    if action == "ls" and destination is not None:
        raise click.UsageError("ls takes one recipe at most")
    if action == "ls" and name is None:
        known = recipes()
        width = max(map(len, known))
        for row in known.values():
            click.echo(f"{row.name:<{width}}  {row.about}")
        return
    if name is None:
        raise click.UsageError("cp: name the recipe to copy; gesturekit recipes ls lists them")
    if action == "ls":
        _describe(recipe(name))
        return
    made = copy_recipe(name, destination or Path(name))
    click.echo(f"{made}: read README.md, edit config.yaml, then gesturekit train {made} ...")


def _describe(known: Recipe) -> None:
    """Print a recipe's page and its configurations, each with the first sentence of its head."""
    click.echo(f"{known.name}: {known.about}\nREADME: {known.folder / 'README.md'}")
    for path in known.configs:
        variant = "" if path.stem == "config" else f"/{path.stem}"
        click.echo(f"\ngesturekit train {known.name}{variant} corpus=corpus.jsonl out=runs/mine")
        for line in path.read_text(encoding="utf-8").splitlines():
            if not line.startswith("#"):
                break
            if not line.startswith("# gesturekit "):
                click.echo(f"    {line.removeprefix('# ')}")
