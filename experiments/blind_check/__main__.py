"""The blind check of `hmmseg diagnose` on a second simulator's recordings.

    python -m experiments.blind_check generate --cases 300 --seed S --out DIR [--outside FILE.py]
    python -m experiments.blind_check open --cases 40 --seed S --out DIR [--tiers healthy single ...]
    python -m experiments.blind_check diagnose --cases DIR/cases --out RESULTS
    python -m experiments.blind_check score --sealed DIR --results RESULTS [--json FILE]

generate prints the seal's hash; diagnose reads user folders only and may be stopped and started again;
open writes cases with their answers next to them, as other folders of recordings have them; score opens the
seal, checks the hash and writes all figures. docs/blind_check.md has the protocol.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.blind_check.cases import TIERS
from experiments.blind_check.sealing import code_digest
from experiments.blind_check.tables import everything
from experiments.saving import save

RESULTS = Path(__file__).resolve().parents[1] / "results" / "blind_check.json"


def main(args: Sequence[str] | None = None) -> int:
    """Run one step of the protocol."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    steps = parser.add_subparsers(required=True)
    make, plain = steps.add_parser("generate"), steps.add_parser("open")
    for drawn, cases, step in ((make, 300, _generate), (plain, 40, _open)):
        drawn.set_defaults(step=step)
        drawn.add_argument("--cases", type=int, default=cases)
        drawn.add_argument("--seed", type=int, required=True)
        drawn.add_argument("--out", type=Path, required=True)
        drawn.add_argument("--fastest", type=float, default=float("inf"), help="no world samples faster [Hz]")
    make.add_argument("--outside", type=Path, help="kinds of effects kept apart until they are scored")
    plain.add_argument("--tiers", nargs="+", default=["healthy"], choices=sorted(TIERS))
    run = steps.add_parser("diagnose")
    run.set_defaults(step=_diagnose)
    run.add_argument("--cases", type=Path, required=True)
    run.add_argument("--out", type=Path, required=True)
    run.add_argument("--seconds", type=float, default=float("inf"), help="begin no case after so long")
    judge = steps.add_parser("score")
    judge.set_defaults(step=_score)
    judge.add_argument("--sealed", type=Path, required=True)
    judge.add_argument("--results", type=Path, required=True)
    judge.add_argument("--json", type=Path, default=RESULTS)
    judge.add_argument("--only", nargs="+", default=[], help="cases FROM:TO only: a run that was cut short")
    given = parser.parse_args(args)
    given.step(given)
    return 0


def _tell(done: int, of: int, text: str = "") -> None:
    print(f"{done}/{of} {text}", file=sys.stderr, flush=True)


def _generate(given: argparse.Namespace) -> None:
    from experiments.blind_check.generate import generate, outside_of

    kinds = outside_of(given.outside)
    print(generate(given.cases, given.seed, given.out, _tell, kinds, fastest=given.fastest))


def _open(given: argparse.Namespace) -> None:
    from experiments.blind_check.generate import write_open

    shares = {tier: TIERS[tier] for tier in given.tiers}
    write_open(given.out, given.cases, given.seed, shares, given.fastest, _tell)


def _diagnose(given: argparse.Namespace) -> None:
    from experiments.blind_check.diagnose import diagnose_cases

    done = diagnose_cases(given.cases, given.out, _tell, given.seconds)
    print(f"the first {done} cases are diagnosed")


def _score(given: argparse.Namespace) -> None:
    from experiments.blind_check.score import score

    ranges = [(int(a), int(b)) for a, b in (r.split(":") for r in given.only)]
    found = score(given.sealed, given.results, ranges)
    save(given.json, found)
    print(everything(found))
    print(f"\nSeal {found['seal']['sha256'][:12]} holds; diagnosed by code {found['code'][:12]}.")
    print(_published())


def _published() -> str:
    """Whether the committed figures are still those of the code at hand."""
    if not RESULTS.exists():
        return "No published figures yet."
    there, now = json.loads(RESULTS.read_text(encoding="utf-8")), code_digest()
    what = f"Published figures: set {there['seal']['sha256'][:12]}, code {there['code'][:12]}"
    return f"{what}: {'of this code.' if there['code'] == now else 'spent, the code has changed since.'}"


if __name__ == "__main__":
    sys.exit(main())
