"""Hatch's build hook: bundles the scripts of HTML pages, adds the recipes."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PackageHook(BuildHookInterface):
    """Bundles the scripts of HTML pages where they are missing or out of date.

    For wheels, it also adds `recipes/` and Blender's script for FBX files below `gesturekit/`.
    """

    def dependencies(self) -> list[str]:
        """Ask for Node.js from PyPI only where a bundle is needed and no Node.js is found."""
        bundle = self._bundle_module()
        return [] if not bundle.outdated() or bundle.find_node() else [bundle.NODE_FROM_PYPI]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Bundle the scripts; an editable installation uses the recipes of the checkout."""
        self._bundle_module().main()
        if self.target_name == "wheel" and version != "editable":
            build_data["force_include"]["recipes"] = "gesturekit/recipes"
            build_data["force_include"]["blender/fbx.py"] = "gesturekit/blender/fbx.py"

    def _bundle_module(self) -> ModuleType:
        # Loaded by path: importing gesturekit would need what is only being installed.
        path = Path(self.root) / "gesturekit" / "viewer" / "player" / "bundle.py"
        spec = importlib.util.spec_from_file_location("player_bundle", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module
