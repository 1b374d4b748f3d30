"""Coverage of intervals for properties and boundaries in different worlds, a row each.

    python -m experiments.calibration_worlds [--rows NAME...] [--replicates 16] [--fresh]

Every replicate has blocks, an operator's hand and noise of its own, from seeds that nothing was chosen on;
worlds of one pace share performances, so that rows differ by their world alone. Resumable: a row that
stands in the results with as many replicates is kept. Writes experiments/results/calibration_worlds.json,
of which `experiments.write_tables` makes docs/tables/worlds.csv and docs/figures/calibration_worlds.png.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from experiments.saving import panels, save
from experiments.scoring import PROPERTIES, boundaries_covered, boundary_residuals
from experiments.table_text import markdown, milliseconds, percent
from experiments.worlds import WORLDS, Replicate, replicates
from hmmseg.segmentation.spans import Segmentation

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "calibration_worlds.json"
FIGURE = HERE.parent / "docs" / "figures" / "calibration_worlds.png"
HEAD = ("world", "trials (misfits)", *(f"{p} rms" for p in PROPERTIES), "68 % cover", "95 % cover", "needed",
        "boundaries, 90 % cover", "needed", "median")  # fmt: skip
FIRST, REPLICATES = 116_000, 32
LEVELS = (0.68, 0.95)
PANELS = (
    ("95", "properties, 95 %", (92, 97)), ("68", "properties, 68 %", (63, 73)),
    ("90", "boundaries, 90 %", (86, 94)),
)  # fmt: skip


def score(found: Replicate, seed: int = 0) -> dict[str, Any]:
    """One replicate: errors, sds and ranks of its properties; errors and intervals of its boundaries."""
    from estimation import identify

    began = time.process_time()
    said = identify(found.trials, found.task, found.rig, seed)
    known = [
        (f"{obj}.{prop}", said.of(obj, prop), getattr(block, prop))
        for obj, block in found.blocks.items() for prop in PROPERTIES if (obj, prop) in said.names
    ]  # fmt: skip
    for i, unknown in enumerate(said.combinations):
        true = sum(c * found.blocks[obj].height for obj, c in unknown.terms.items())
        known.append((".".join(unknown.name), said.combined[:, i], true))
    properties = [
        {"of": name, "share": float(draws.mean() / true - 1), "z": float((draws.mean() - true) / draws.std()),
         "rank": float((draws < true).mean())}
        for name, draws, true in known
    ]  # fmt: skip
    pairs = [(s, b) for s, b in zip(said.segmentations, found.boundaries, strict=True) if s.complete]
    residual = [r for s, b in pairs for r in boundary_residuals(s, b)]
    held = [r for s, b in pairs for r in boundaries_covered(s, b)]
    reach = [r for s, b in pairs for r in _reaches(s, b)]
    return {
        "properties": properties, "boundaries": [float(r) for r in residual], "held_90": held,
        "reach_90": reach,
        "misfits": sum(not s.complete for s in said.segmentations), "trials": len(found.trials),
        "seconds": time.process_time() - began,
    }  # fmt: skip


def _reaches(found: Segmentation, truth: np.ndarray) -> list[float]:
    """Distance of each true boundary from the one found, over that to the same end of its interval."""
    ends = [(s.start, *s.start_90) for s in found.spans[1:]]
    return [
        float((t - at) / max(high - at, 1e-9) if t > at else (at - t) / max(at - low, 1e-9))
        for (at, low, high), t in zip(ends, truth, strict=True)
    ]


def summary(scored: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A row of the table: coverages, each with its standard error over replicates, and rms of z."""
    out: dict[str, Any] = {
        "replicates": len(scored), "trials": sum(s["trials"] for s in scored),
        "misfits": sum(s["misfits"] for s in scored),
    }  # fmt: skip
    ranks = [np.array([p["rank"] for p in s["properties"]]) for s in scored]
    z = np.concatenate([[p["z"] for p in s["properties"]] for s in scored])
    out["properties"] = int(z.size)
    out["z_rms"] = float(np.sqrt(np.mean(z**2))) if z.size else None
    for level in LEVELS:
        inside = [np.abs(r - 0.5) < level / 2 for r in ranks]
        out[f"coverage_{100 * level:.0f}"], out[f"se_{100 * level:.0f}"] = clustered(inside)
    for prop in PROPERTIES:
        mine = [p for s in scored for p in s["properties"] if p["of"].endswith(prop)]
        if mine:
            out[prop] = {
                "rms": float(np.sqrt(np.mean([p["share"] ** 2 for p in mine]))),
                "z_rms": float(np.sqrt(np.mean([p["z"] ** 2 for p in mine]))),
                "coverage_95": float(np.mean([abs(p["rank"] - 0.5) < 0.475 for p in mine])),
            }
    # Factor by which intervals would have to widen to reach their nominal coverage.
    out["needed_95"] = float(np.quantile(np.abs(z), 0.95) / ndtri(0.975)) if z.size else None
    reach = np.concatenate([s["reach_90"] for s in scored])
    out["needed_90"] = float(np.quantile(reach, 0.9)) if reach.size else None
    out["coverage_90"], out["se_90"] = clustered([np.array(s["held_90"]) for s in scored])
    boundaries = np.concatenate([s["boundaries"] for s in scored])
    out["boundary_median"] = float(np.median(np.abs(boundaries))) if boundaries.size else None
    return out


def clustered(inside: Sequence[np.ndarray]) -> tuple[float | None, float | None]:
    """Share inside and its standard error, replicates as clusters; at least that of as many coin tosses."""
    rows = [np.asarray(r, float) for r in inside if len(r)]
    if not rows:
        return None, None
    every = np.concatenate(rows)
    share = float(every.mean())
    scores = np.array([(r - share).sum() for r in rows]) / np.mean([r.size for r in rows])
    spread = float(np.std(scores, ddof=1) / np.sqrt(len(rows))) if len(rows) > 1 else 0.0
    # Agresti and Coull's: if all are inside, a standard error of zero would be too confident.
    share_at_least = (every.sum() + 2) / (every.size + 4)
    return share, max(spread, float(np.sqrt(share_at_least * (1 - share_at_least) / (every.size + 4))))


def draw(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw a panel for each level and a line for each world; the goal is grey."""
    with panels(path, 1, 3, figsize=(10, 0.26 * len(rows) + 1.2), sharey=True) as axes:
        names = list(rows)
        for ax, (key, title, (low, high)) in zip(axes, PANELS, strict=True):
            ax.axvspan(low, high, color="0.88", lw=0)
            for y, name in enumerate(names):
                share, error = rows[name][f"coverage_{key}"], rows[name][f"se_{key}"]
                if share is None:
                    continue
                inside = low - 200 * error <= 100 * share <= high + 200 * error
                ax.errorbar(100 * share, y, xerr=100 * error, fmt="o", ms=3.5, lw=1,
                            color="C0" if inside else "C3")  # fmt: skip
            ax.set_title(title, fontsize=9)
            ax.set_xlim(30 if key == "68" else 55, 101)
            ax.tick_params(labelsize=8)
            ax.set_xlabel("true values inside [%]", fontsize=8)
            ax.grid(axis="x", lw=0.3)
        axes[0].set_yticks(range(len(names)), names)
        axes[0].invert_yaxis()


def _covered(row: dict[str, Any], level: str) -> str:
    share, error = row[f"coverage_{level}"], row[f"se_{level}"]
    return "" if share is None else f"{100 * share:.0f} ± {100 * error:.0f} %"


def cells(name: str, s: dict[str, Any]) -> list[str]:
    """A row of the table, under HEAD."""
    rms = [percent(s[p]["rms"], 2) if p in s else "" for p in PROPERTIES]
    needed = ["" if s[k] is None else f"x{s[k]:.2f}" for k in ("needed_95", "needed_90")]
    cover = [_covered(s, level) for level in ("68", "95", "90")]
    median = "" if s["boundary_median"] is None else milliseconds(s["boundary_median"])
    trials = f"{s['trials']} ({s['misfits']})"
    return [name, trials, *rms, *cover[:2], needed[0], cover[2], needed[1], median]


def table(found: dict) -> str:
    """docs/tables/worlds.csv and its figure; `needed`: the factor at which intervals hold as stated."""
    draw(found["rows"], FIGURE)
    return markdown(HEAD, [cells(name, s) for name, s in found["rows"].items()])


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="*", default=list(WORLDS), metavar="NAME")
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--fresh", action="store_true", help="score every row again")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    document: dict[str, Any] = {"first": FIRST, "rows": {}}
    if options.output.exists() and not options.fresh:
        document = json.loads(options.output.read_text(encoding="utf-8"))
    for name in options.rows:
        num = max(2, options.replicates // 2) if WORLDS[name].trials > 4 else options.replicates
        if document["rows"].get(name, {}).get("replicates", 0) < num:
            scored = [score(found) for found in replicates(WORLDS[name], range(FIRST, FIRST + num))]
            document["rows"][name] = summary(scored) | {"seconds": sum(s["seconds"] for s in scored)}
            document["rows"] = {n: document["rows"][n] for n in WORLDS if n in document["rows"]}
            save(options.output, document)
        print(" | ".join(cells(name, document["rows"][name])), flush=True)


if __name__ == "__main__":
    main()
