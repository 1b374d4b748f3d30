"""docs/calibration.md: how well trials that do not fit their task are found."""

from __future__ import annotations

from experiments.table_text import load, markdown, percent

NAMES = {
    "drop_first": "block 1 falls in mid-carry, nothing after",
    "drop_first_go_on": "it falls, block 2 is moved",
    "drop_second": "block 2 falls early in its carry",
    "drop_and_retry": "block 1 falls, is gripped again and moved",
    "regrasp": "block 1 is moved twice",
    "regrasp_on_ground": "block 1 is let go and gripped again before its lift",
    "regrasp_placed": "block 1 is gripped again where it was put",
    "no_second_move": "cut between the moves",
    "idle_second_half": "fingers move on but never close",
    "only_free_motion": "no contact at all",
    "extra_move": "block 1 is moved once more at the end",
    "starts_in_carry": "begins in the first carry",
    "starts_in_grip": "begins with block 1 gripped",
    "stops_in_carry": "stops in the second carry",
    "stops_in_first_pickup": "stops before block 1 is lifted",
    "swapped": "block 2 before block 1",
}


def misfits() -> str | None:
    """False alarms on trials that follow their task, and shares found of those that do not."""
    found = load("misfits")
    if found is None:
        return None
    every = found["recordings"]
    rows = [
        ["recordings, each alone", f"{every['trials']}", f"{every['false_alarms']}"],
        ["recordings, pooled by case", f"{every['trials']}", f"{every['false_alarms_pooled']}"],
        *(
            [f"simulated: {n}", f"{r['trials']}", f"{r['false_alarms']}"]
            for n, r in found["simulated"].items()
        ),
    ]
    alarms = markdown(["trials that follow their task", "trials", "false alarms"], rows)
    rows = []
    for name, on in found["edits"].items():
        simulated = found["edits_simulated"][name]
        cells = [_share(group) for group in (on["alone"], on["pooled"], simulated["alone"])]
        rows.append([NAMES[name], f"{on['trials']}", *cells])
    head = ["edit", "recordings", "alone", "pooled", "simulated, alone"]
    between = "Trials that do not, by editing those that do: shares found, and found with the right subtask:"
    return f"{alarms}\n\n{between}\n\n{markdown(head, rows)}"


def by_world() -> str | None:
    """False alarms and what was found of misfits, by world."""
    found = load("misfit_worlds")
    if found is None:
        return None
    edits = [k for k in next(iter(found["rows"].values())) if k in NAMES]
    rows = [
        [name, f"{row['alarms']} of {row['trials']}",
         *(f"{row[e]['found']}, {row[e]['right']} of {row[e]['trials']}" for e in edits)]
        for name, row in found["rows"].items()
    ]  # fmt: skip
    every = list(found["rows"].values())
    alarms, trials = (sum(row[k] for row in every) for k in ("alarms", "trials"))
    of = {k: sum(row[e][k] for row in every for e in edits) for k in ("found", "right", "trials")}
    note = (
        f"In all: {alarms} of {trials} healthy trials are rejected; of {of['trials']} that do not fit "
        f"{of['found']} are found, {of['right']} at the subtask that fails.\nCommit {found['made_by']}, "
        f"trials from number {found['first']} on."
    )
    return f"{markdown(['world', 'false alarms', *(NAMES[e] for e in edits)], rows)}\n\n{note}"


def untidy() -> str | None:
    """Contact that is not tidy, by both simulators."""
    found = load("untidy_contacts")
    if found is None:
        return None
    rows = []
    for row in found["rows"]:
        simulator = {"own": "ours", "mujoco": "MuJoCo"}[row["simulator"]]
        cells = [f"{row['rate']:g} Hz", f"{len(row['misfits'])} of {row['trials']}"]
        cells += [
            f"{row['median']:.1f} ms", f"{row['percentile_95']:.1f} ms",
            f"{row['beyond_a_sample']} of {row['boundaries']}", percent(row["coverage_90"], 0),
        ] if "median" in row else [""] * 4  # fmt: skip
        rows.append([f"{row['kind']}, {simulator}", *cells])
    head = ["hands that are not tidy, simulator", "rate", "misfits", "median error", "95 % below",
            "off by more than a sample", "90 % cover"]  # fmt: skip
    note = f"Commit {found['made_by']}; trials from number {found['first']} on, seed {found['seed']}."
    return f"{markdown(head, rows)}\n\n{note}"


def _share(shares: dict | None) -> str:
    if shares is None:
        return ""
    return f"{percent(shares['detected'], 0)}, {percent(shares['right_subtask'], 0)}"
