"""Build sdist and wheel, install the wheel in an empty environment, and use it outside this repository.

    python .ci/check_wheel.py [--python PYTHON]

In an environment that holds nothing but the wheel and the newest versions of what it declares, the three
imports of the README, the version beside another project's commands.py, shell completion and the demo must
work; JAX must stay as it was. With the newest versions of its extras, so must the file formats.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"hmmseg", "estimation", "simgap", "hmmseg_cli"}
FORMATS = ("-q", "-W", "default", "-p", "no:cacheprovider", "tests/hmmseg/test_formats.py")
IMPORTS = """
import jax
before = dict(jax.config.values)
from hmmseg import Task, Rig, Trial, align, segment
from estimation import identify, Identification
from simgap import VirtualModel, simulate, diagnose, Diagnosis, effects
assert dict(jax.config.values) == before, "importing changed JAX"
assert jax.numpy.ones(1).dtype == "float32"
"""


def run(*command: str | Path, cwd: Path, **settings: str) -> str:
    """Standard output of a command that must succeed, without this repository on the path."""
    hidden = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "JAX_"))}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=hidden | settings, capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
    return done.stdout


def build(folder: Path) -> Path:
    """The wheel, built from the sdist, whose top level holds our packages and nothing else."""
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        top = {name.split("/")[0] for name in names}
    extra = {name for name in top - PACKAGES if not name.endswith(".dist-info")}
    assert top >= PACKAGES and not extra, f"the wheel's top level holds {sorted(top)}"
    assert all(f"{package}/py.typed" in names for package in PACKAGES), "a package is not marked as typed"
    with tarfile.open(sdist) as file:
        assert not any("/tests/" in name or "/recordings/" in name for name in file.getnames())
    return wheel


def check(wheel: Path, folder: Path, python: str) -> None:
    """Everything a stranger does first, in an environment of its own."""
    home, uv = folder / "environment", Path(sys.executable).with_name("uv")
    run(uv, "venv", "--quiet", "--python", python, home, cwd=ROOT)
    binaries = home / ("Scripts" if os.name == "nt" else "bin")
    python, hmmseg = binaries / "python", binaries / "hmmseg"
    install = uv, "pip", "install", "--quiet", "--upgrade", "--python", python
    run(*install, wheel, cwd=folder)
    away = folder / "away"
    away.mkdir()
    (away / "commands.py").write_text("raise ImportError('a commands.py of another project')\n")
    print("hmmseg", run(hmmseg, "--version", cwd=away, PYTHONPATH=str(away)).strip())
    run(python, "-c", IMPORTS, cwd=away)
    said = run(hmmseg, cwd=away, _HMMSEG_COMPLETE="complete_bash", COMP_WORDS="hmmseg ide", COMP_CWORD="1")
    assert said.split() == ["identify"], said
    run(hmmseg, "demo", "--quiet", "--json", "demo.json", cwd=away)
    found = json.loads((away / "demo.json").read_text())
    weights = [entry["weight"]["mean"] for entry in found["properties"].values()]
    shown = ", ".join(f"{weight:.3f} N" for weight in weights)
    print(f"demo: weights {shown}; verdict {found['diagnosis']['verdict']}")
    run(*install, f"{wheel}[mujoco,files]", "pytest>=8", cwd=folder)
    print(run(hmmseg, "doctor", cwd=away))
    print(run(python, "-m", "pytest", *FORMATS, cwd=ROOT))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", default=sys.executable, help="of the environment")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        check(build(Path(folder)), Path(folder), args.python)
    print("the wheel works outside the repository")


if __name__ == "__main__":
    main()
