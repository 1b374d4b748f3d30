"""Properties of recorded cases against what is true of them: errors, z-scores, intervals.

    python -m experiments.identified FOLDER... [--rig rig_pads.toml] [--pooled 1] [--keep]

A case's trials are estimated in groups of `--pooled` (all of them by default). Prints a row for each
property, then z and coverage, also of boundaries, by folder, healthy cases and others apart; --keep writes
these summaries to experiments/results/identified.json, which docs/calibration.md shows.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.recordings import list_cases, read_case
from experiments.saving import save
from experiments.scoring import PROPERTIES, boundaries_covered, boundary_residuals

Row = dict[str, Any]
RESULTS = Path(__file__).parent / "results" / "identified.json"


def rows_of(folder: Path, rig: str, pooled: int | None, seed: int = 0) -> Iterator[Row]:
    """A row for each estimate of a case; one with `property` None for each group that fits no task."""
    from estimation import identify
    from hmmseg.io.rig import read_rig

    case = read_case(folder)
    hand = read_rig(folder / rig)
    size = pooled or len(case.trials)
    label = "+".join(case.effects or ("unlabelled",))
    for start in range(0, len(case.trials) - size + 1, size):
        group = slice(start, start + size)
        found = identify(list(case.trials[group]), case.task, hand, seed)
        same = {
            "case": case.name, "effect": label, "start": start, "trials": size,
            "warnings": list(found.warnings), **_boundaries(found.segmentations, case.truth[group]),
        }  # fmt: skip
        for obj, known in case.blocks.items():
            for prop in PROPERTIES:
                if prop not in known:
                    continue
                row = same | {"object": obj, "property": prop, "true": known[prop][0], "mean": None}
                if (obj, prop) in found.names:
                    draws = found.of(obj, prop)
                    rank = float((draws < known[prop][0]).mean())
                    row |= {"mean": float(draws.mean()), "sd": float(draws.std()), "rank": rank}
                else:
                    row["reason"] = found.reasons.get(f"{obj}.{prop}")
                yield row


def _boundaries(segmentations, truth) -> Row:
    pairs = [(s, t) for s, t in zip(segmentations, truth, strict=True) if t is not None]
    pairs = [(s, t) for s, t in pairs if s.complete and len(s.spans) == len(t) + 1]
    if not pairs:
        return {"complete": sum(s.complete for s in segmentations), "boundaries": []}
    return {
        "complete": sum(s.complete for s in segmentations),
        "boundaries": np.concatenate([boundary_residuals(*p) for p in pairs]).round(6).tolist(),
        "held_90": np.concatenate([boundaries_covered(*p) for p in pairs]).tolist(),
    }


def line(row: Row) -> str:
    """A row for people."""
    head = f"{row['case']:24} {row['start']:2} {row['effect'][:20]:20} {row['object']:8}{row['property']:7}"
    if row["mean"] is None:
        return f"{head} null: {row['reason']}"
    unit = 1.0 if row["property"] == "weight" else 1e6
    z, error = (row["mean"] - row["true"]) / row["sd"], row["mean"] - row["true"]
    share = 100 * error / row["true"]
    return f"{head} {error * unit:+10.4f} +- {row['sd'] * unit:8.4f}  {share:+8.3f} %  z {z:+6.2f}"


def summary(rows: Sequence[Row]) -> dict[str, Row]:
    """By property: number, nulls, rms relative error, rms z, shares inside 68 and 95 % intervals."""
    out = {}
    for prop in (*PROPERTIES, "all"):
        mine = [r for r in rows if prop in ("all", r["property"])]
        there = [r for r in mine if r["mean"] is not None]
        if not there:
            continue
        z = np.array([(r["mean"] - r["true"]) / r["sd"] for r in there])
        rank = np.array([r["rank"] for r in there])
        share = np.array([r["mean"] / r["true"] - 1 for r in there])
        out[prop] = {
            "count": len(there), "null": len(mine) - len(there), "rms": float(np.sqrt(np.mean(share**2))),
            "median": float(np.median(np.abs(share))),
            "z_rms": float(np.sqrt(np.mean(z**2))), "z_largest": float(np.abs(z).max()),
            "coverage_68": float(np.mean(np.abs(rank - 0.5) < 0.34)),
            "coverage_95": float(np.mean(np.abs(rank - 0.5) < 0.475)),
        }  # fmt: skip
    return out


def boundaries(rows: Sequence[Row]) -> Row | None:
    """Boundaries of all groups of trials that fit: number, median and 95 % of errors [s], 90 % coverage."""
    groups = {(r["case"], r["start"]): r for r in rows}.values()
    error = np.abs(np.concatenate([[], *(r["boundaries"] for r in groups)]))
    held = np.concatenate([[], *(r.get("held_90", []) for r in groups)])
    if not error.size:
        return None
    return {
        "count": int(error.size), "misfits": int(sum(r["trials"] - r["complete"] for r in groups)),
        "median": float(np.median(error)), "percentile_95": float(np.percentile(error, 95)),
        "coverage_90": float(held.mean()),
    }  # fmt: skip


def summary_lines(name: str, found: dict[str, Row]) -> Iterator[str]:
    """A summary for people."""
    for prop, s in found.items():
        yield (
            f"{name:32} {prop:7} {s['count']:4} null {s['null']:2}  rms {100 * s['rms']:8.3f} %  "
            f"median {100 * s['median']:7.3f} %  z rms {s['z_rms']:5.2f} max {s['z_largest']:6.1f}  "
            f"68 % {100 * s['coverage_68']:5.1f}  95 % {100 * s['coverage_95']:5.1f}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--rig", default="rig.toml", help="the rig file of each case to believe")
    parser.add_argument("--pooled", type=int)
    parser.add_argument("--only", nargs="*", help="cases to take")
    parser.add_argument("--json", type=Path, help="every row, for a closer look")
    parser.add_argument("--keep", action="store_true", help=f"put the summaries into {RESULTS.name}")
    options = parser.parse_args(arguments)
    every: dict[str, list[Row]] = {}
    for folder in options.folders:
        rows = every.setdefault(folder.name, [])
        for path in list_cases(folder):
            chosen = not options.only or path.name in options.only
            if not chosen or not (path / options.rig).exists():
                continue
            for row in rows_of(path, options.rig, options.pooled):
                rows.append(row)
                print(line(row), flush=True)
        kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
        for kind in ("healthy", "unlabelled", "other"):
            mine = [r for r in rows if _kind(r) == kind]
            found = summary(mine)
            size = "all trials" if options.pooled is None else f"{options.pooled} a time"
            name = f"{folder.name}, {kind}, {options.rig.removesuffix('.toml')}, {size}"
            if found:
                print(*summary_lines(name, found), sep="\n", flush=True)
                seen = boundaries(mine)
                kept[name] = found | ({} if seen is None else {"boundaries": seen})
                print(f"{name:32} boundaries {seen}", flush=True)
        if options.keep:
            save(RESULTS, kept)
    if options.json is not None:
        save(options.json, every)


def _kind(row: Row) -> str:
    return {"none": "healthy", "unlabelled": "unlabelled"}.get(row["effect"], "other")


if __name__ == "__main__":
    main()
