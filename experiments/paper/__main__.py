"""Compute every published result of the paper's reproduction.

python -m experiments.paper [NAME...]
"""

from __future__ import annotations

import argparse
import importlib
import time

from rich.console import Console

SCRIPTS = ("tables", "recording", "estimates", "rigid", "slip", "virtual_block", "alike", "paper_gap")


def main() -> None:
    """Run the scripts named, all by default, one after another in one process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scripts", nargs="*", metavar="NAME", help=", ".join(SCRIPTS))
    names = parser.parse_args().scripts or SCRIPTS
    console = Console(stderr=True)
    for name in names:
        if name not in SCRIPTS:
            parser.error(f"{name!r} is none of {', '.join(SCRIPTS)}")
        start = time.perf_counter()
        importlib.import_module(f"experiments.paper.{name}").main()
        console.print(f"{name}: {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
