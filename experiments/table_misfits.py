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


def _share(shares: dict | None) -> str:
    if shares is None:
        return ""
    return f"{percent(shares['detected'], 0)}, {percent(shares['right_subtask'], 0)}"
