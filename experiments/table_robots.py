"""Tables of docs/robots_results.md."""

from __future__ import annotations

from typing import Any

from experiments.table_text import markdown

GOALS = {
    "false_alarms": ("false alarms on healthy robots", "2 %"),
    "named_right": ("named right, all", "90 %"),
    "single": ("one fault", ""),
    "pair": ("two", ""),
    "dense": ("four", ""),
    "outside_held_back": ("faults of no known kind held back", "85 %"),
    "intervals_cover": ("intervals that hold the fault", "87 to 93 %"),
}


def _share(one: dict[str, Any]) -> list[str]:
    """Two cells of a proportion: its count, and its percentage with the 90 % interval."""
    low, high = (100 * v for v in one["interval_90"])
    return [
        f"{one['hits']} of {one['of']}",
        f"{100 * one['hits'] / one['of']:.0f} % ({low:.0f} to {high:.0f})",
    ]


def minute(found: dict) -> str:
    """How long a minute of an arm takes."""
    whole = found["whole"]
    rows = [["in one go", f"{whole['processor']:.0f} s", f"{whole['wall']:.0f} s"]]
    note = (
        f"A log of {found['seconds']:.0f} s at {found['rate']:.0f} Hz of six joints; {found['cores']} cores, "
        f"{found['load'][1]:.0f} processes on average. Planted: {' and '.join(found['planted'])}. Verdict: "
        f"{found['found']['verdict']}, {' + '.join(found['found']['causes']) or 'no cause'}"
        f"{''.join(f' or {n}' for n in found['found']['indistinguishable'])}."
    )
    return f"{markdown(['', 'processor', 'time'], rows)}\n\n{note}"


def check(found: dict) -> str:
    """Seeded faults in robots by others."""
    shares: dict[str, Any] = {**found, **found["named_right_by_kind"]}
    rows = []
    for key, (label, goal) in GOALS.items():
        one = shares[key]
        if not one["of"]:
            continue
        rows.append([label, *_share(one), goal])
    seconds = ", ".join(f"{robot} {s:.0f} s" for robot, s in found["processor_seconds"].items())
    cases = [c["robot"] for c in found["each"]]
    counts = ", ".join(f"{robot} {cases.count(robot)}" for robot in found["robots"])
    note = (
        f"{found['cases']} cases ({counts}; {found['below_the_floor']} of {found['faults']} faults show less "
        f"than the floor of {found['floor']:g} nats and do not count); in brackets 90 % intervals. "
        f"Processor time a case: {seconds}. "
        f"Code of {found['made_by']}."
    )
    return f"{markdown(['', 'of', 'share', 'goal'], rows)}\n\n{note}"


def changed(found: dict) -> str:
    """What changed of a servo."""
    rows = [[one["figure"], *_share(one), one["goal"]] for one in found["figures"]]
    seconds = sorted(c["seconds"] for c in found["cases"])
    note = (
        f"{len(found['cases'])} cases, {found['drawn']} of a kind at most, of part `{found['part']}` of the "
        f"configurations, seed {found['seed']}; in brackets 90 % intervals. Processor time a case: "
        f"{seconds[len(seconds) // 2]:.0f} s. Code of {found['made_by']}."
    )
    return f"{markdown(['', 'of', 'share', 'goal'], rows)}\n\n{note}"


def bam(found: dict) -> str:
    """Whole logs of what was left out, of three models."""
    rows = []
    for by, words in (("kp", "one gain of three"), ("mass", "one mass of two")):
        one = found.get(by, {"compared": []})
        for pair in one["compared"]:
            low, high = (1e3 * v for v in pair["interval_95"])
            ours, other = (1e3 * one["rms"][pair[n]] for n in ("one", "other"))
            less = f"{1e3 * pair['less']:.1f} ({low:.1f} to {high:.1f})"
            rows.append([words, pair["other"], f"{ours:.1f}", f"{other:.1f}", less])
    head = ["left out in turn", "rival", "ours [mrad]", "rival [mrad]", "difference"]
    note = f"In brackets 95 % intervals by a paired bootstrap. Code of {found['made_by']}."
    return f"{markdown(head, rows)}\n\n{note}"


def given(found: dict) -> str:
    """Faulty robots of another generator, case by case."""
    rows = []
    for name, one in found.items():
        if not isinstance(one, dict):
            continue
        causes = ", ".join(f"{cause} {value:.4g}" for cause, value in one["causes"].items()) or "none"
        others = f"; or {', '.join(one['indistinguishable'])}" if one["indistinguishable"] else ""
        rows.append([name, one["verdict"], causes + others, "yes" if one["right"] else "no",
                     f"{one['over_noise']:.2f}", f"{one['seconds']:.0f} s"])  # fmt: skip
    head = ["case", "verdict", "causes, with their parameters", "as the answer", "left, over noise",
            "processor"]  # fmt: skip
    return markdown(head, rows)
