"""Install the lowest versions that pyproject.toml allows, together, and run tests with them.

    python tests/floors.py .venv/floors [TEST ...]

Run by `make floors`. torch has its lowest version only where PyTorch's index of CPU builds answers,
because PyPI's wheels for Linux bring gigabytes of CUDA; else it has the version of constraints.txt.
"""

import os
import re
import subprocess
import sys
import tomllib
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CPU_INDEX = "https://download.pytorch.org/whl/cpu"
LEFT_OUT = {"docs", "ray"}
"""Extras that are not installed: a site, and a cluster."""
TESTS = ["tests/test_first_steps.py", "tests/motion", "tests/formats/test_bvh.py"]
TESTS += [f"tests/audio_features/test_{name}.py" for name in ("acoustic", "wavlm", "huggingface")]
TESTS += [f"tests/evaluation/test_{name}.py" for name in ("frechet", "physical", "plots")]
TESTS += ["tests/study/test_statistics.py", "tests/serving/test_app.py", "tests/live/test_vmc.py"]
TESTS += ["tests/multires/test_trainer.py", "tests/diffusion/test_render.py"]
"""Some that reach each dependency: a training, too."""


def lowest_versions() -> list[str]:
    """Return `name==lowest` of each requirement in pyproject.toml, without those of `LEFT_OUT`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    lists = [project["dependencies"], *(extras[name] for name in extras if name not in LEFT_OUT)]
    found = {r.replace(">=", "==") for requirements in lists for r in requirements if ">=" in r}
    return sorted(found)


def torch_options(lowest: str) -> list[str]:
    """Return pip's arguments for torch: `lowest` from the CPU index, or the tested version."""
    try:
        urllib.request.urlopen(f"{CPU_INDEX}/torch/", timeout=10).close()
    except OSError as error:
        tested = re.search(r"^torch==\S+", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
        print(f"{CPU_INDEX}: {error}; {tested[0]} is used instead of {lowest}", flush=True)
        return [tested[0]]
    return [f"{lowest}+cpu", "--extra-index-url", CPU_INDEX]


def main() -> int:
    """Make the environment, run the tests, and return pytest's exit code."""
    folder, tests = Path(sys.argv[1]).absolute(), sys.argv[2:] or TESTS
    subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    versions = lowest_versions()
    torch = next(version for version in versions if version.startswith("torch=="))
    versions.remove(torch)
    environment = {k: v for k, v in os.environ.items() if k != "PIP_CONSTRAINT"}
    pip = [python, "-m", "pip", "install", "-q", *versions, *torch_options(torch), "-e", ROOT]
    subprocess.run(pip, env=environment, check=True)
    pytest = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
    return subprocess.run(pytest, cwd=ROOT, env=environment | {"PYTHONPATH": str(ROOT)}).returncode


if __name__ == "__main__":
    sys.exit(main())
