"""Published results on the recordings included, pinned: written to small files, or compared with them.

    python -m experiments.golden compare|write [KIND ...] [--exact] [--cases NAME ...]

`identified`: boundaries and properties of four trials of every folder of recordings/; `diagnosed`: verdicts,
probabilities, shares and parameters there, with properties measured apart; `ensembles`: the same of made-up
ensembles, one of each planted effect. `compare` prints what is off and ends with 1 if anything is; `--exact`
wants the same digits, for a step that only moves code. Numbers agree within a share of their own standard
deviation where they have one.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
GOLDEN = ROOT / "tests" / "data" / "golden"
TRIALS = 4
SD = 0.25  # chosen: of a standard deviation, by which a mean may move and count as the same
RELATIVE = 0.2  # chosen: share by which a standard deviation may change
SHARE = 0.05  # chosen: by which a share or a probability may move
PLACE = 1e-3  # chosen: s; by which a boundary may move
EXACT = 1e-9  # numerics: relative; digits that a step which only moves code may change

Json = Any  # what the json module reads and writes


def rounded(value: Json, digits: int = 10) -> Json:
    """The value with floats rounded to `digits` significant digits."""
    if isinstance(value, dict):
        return {key: rounded(each, digits) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(each, digits) for each in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def identified(name: str) -> Json:
    """Boundaries [s] with 90 % intervals and properties identified in a folder of recordings/."""
    from estimation import identify
    from experiments.recordings import read_case

    case = read_case(ROOT / "recordings" / name)
    found = identify(case.trials[:TRIALS], case.task, case.rig)
    spans = [[[s.start, *s.start_90] for s in each.spans[1:]] for each in found.segmentations]
    properties = {
        f"{block}.{key}": [entry["mean"], entry["sd"]]
        for block, mine in found.to_json()["properties"].items()
        for key, entry in mine.items()
        if entry is not None and entry.get("mean") is not None and "sd" in entry
    }
    return {"boundaries": spans, "properties": properties}


def diagnosed(name: str) -> Json:
    """Diagnosis of a folder of recordings/, given its measured properties."""
    from estimation.report import read_actual
    from experiments.recordings import read_case
    from hmmseg.segmentation.align import align
    from simgap.gap.diagnose import diagnose

    folder = ROOT / "recordings" / name
    case = read_case(folder)
    aligned = align(case.trials[:TRIALS], case.task, case.rig)
    actual = read_actual(folder / "actual.toml", case.task.objects)
    return summary(diagnose(aligned, actual).body)


def ensembles(effect: str) -> Json:
    """Diagnosis of synthetic ensembles with one planted effect."""
    from experiments.generic_ensembles import PLANTED, made
    from simgap.generic.diagnose import diagnose as diagnose_ensembles

    effects = None if effect == "none" else {effect: PLANTED[effect]}
    return summary(diagnose_ensembles(made(7, effects, False)).body)


def summary(body: Json) -> Json:
    """Verdict, probabilities, shares and parameters of the causes in a diagnosis."""
    causes = body["causes"]
    parameters = {
        f"{name}.{key}": [p["mean"], (p["interval_90"][1] - p["interval_90"][0]) / 3.29]
        for name, entry in body["effects"].items()
        if name in causes
        for key, p in entry["parameters"].items()
    }
    return {
        "verdict": body["verdict"], "causes": causes, "partners": body["indistinguishable"],
        "p_value": body["detection"]["p_value"], "probabilities": body["probabilities"],
        "shares": {n: e["share"] for n, e in body["attribution"].items() if n in causes},
        "remainder": body["remainder"]["share"], "parameters": parameters,
        "shrinkage": None if body["shrinkage"] is None else body["shrinkage"]["fraction"],
    }  # fmt: skip


def folders() -> list[str]:
    """Names of the folders of recordings/."""
    return sorted(path.parent.name for path in (ROOT / "recordings").glob("*/task.toml"))


def planted() -> list[str]:
    """Names of the effects planted in ensembles, and "none"."""
    from experiments.generic_ensembles import PLANTED

    return ["none", *PLANTED]


KINDS: dict[str, tuple[Callable[[], list[str]], Callable[[str], Json]]] = {
    "identified": (folders, identified),
    "diagnosed": (folders, diagnosed),
    "ensembles": (planted, ensembles),
}


def read(kind: str) -> dict[str, Json]:
    """Pinned results of a kind, by case."""
    return json.loads((GOLDEN / f"{kind}.json").read_text(encoding="utf-8"))


def write(kind: str, rows: dict[str, Json]) -> None:
    """Pin these results."""
    lines = [f" {json.dumps(name)}: {json.dumps(rounded(row))}" for name, row in rows.items()]
    GOLDEN.mkdir(parents=True, exist_ok=True)
    (GOLDEN / f"{kind}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def differences(old: Json, new: Json, exact: bool = False, where: str = "") -> Iterator[str]:
    """One line for each place where two results differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            at = f"{where}.{key}" if where else key
            small = 0.0 if where.endswith("probabilities") and not exact else None
            yield from differences(old.get(key, small), new.get(key, small), exact, at)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        of_parameter = len(old) == 2 and any(part in where for part in ("properties.", "parameters."))
        if of_parameter and not exact:
            if abs(new[0] - old[0]) > SD * old[1] or abs(new[1] / old[1] - 1) > RELATIVE:
                yield f"{where}: {new[0]:.6g} ± {new[1]:.3g}, pinned {old[0]:.6g} ± {old[1]:.3g}"
            return
        for k, pair in enumerate(zip(old, new, strict=True)):
            yield from differences(*pair, exact, f"{where}[{k}]")
    elif isinstance(old, int | float) and isinstance(new, int | float) and not isinstance(old, bool):
        if not np.isclose(new, old, rtol=EXACT if exact else 0.0, atol=0.0 if exact else _within(where, old)):
            yield f"{where}: {new:.6g}, pinned {old:.6g}"
    elif old != new:
        yield f"{where}: {new}, pinned {old}"


def _within(where: str, old: float) -> float:
    """Tolerance of a number at this place."""
    if where.endswith("p_value"):  # the verdict shows on which side of an alarm it is
        return max(0.5 * abs(old), 0.1)
    return PLACE if "boundaries" in where else SHARE


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of this experiment; 1 where something is not as it was."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("action", choices=("compare", "write"))
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}; all by default")
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--cases", nargs="+")
    options = parser.parse_args(arguments)
    unknown = [kind for kind in options.kinds if kind not in KINDS]
    if unknown:
        parser.error(f"no kind {unknown[0]!r}; expected {', '.join(KINDS)}")
    off = 0
    for kind in options.kinds or KINDS:
        names, make = KINDS[kind]
        rows: dict[str, Json] = {}
        for name in names():
            if options.cases and name not in options.cases:
                continue
            rows[name] = rounded(make(name))
            if options.action == "compare":
                found = list(differences(read(kind).get(name), rows[name], options.exact))
                print(f"{kind} {name}: {'; '.join(found) or 'same'}", flush=True)
                off += bool(found)
        if options.action == "write":
            old = read(kind) if options.cases else {}
            write(kind, old | rows)
    return int(off > 0)


if __name__ == "__main__":
    sys.exit(main())
