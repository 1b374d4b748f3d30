"""Rows of docs/tables/diagnosis_special_cases.csv: python -m experiments.ablation_table OUT FOLDER,... FLAG ...

OUT is the folder that `experiments.ablate` filled. Each flag is compared with `base` on the cases that have both;
where there is no `base`, that of `experiments.gap_drawn` counts, in build/gap_fresh or build/gap_labs.
"""

import json
import sys
from pathlib import Path

from experiments.gap_drawn import is_right, row


def main(out: Path, flags: list[str]) -> None:
    cases = []
    for folder in sorted(out.iterdir()):
        where = next(f for f in FOLDERS if f.name == folder.name)
        for label in json.loads((where / "labels.json").read_text()):
            file = folder / f"{label['case']}.json"
            if file.exists():
                d = json.loads(file.read_text())
                for old in ("gap_fresh", "gap_labs"):
                    was = Path("build") / old / folder.name / file.name
                    if "base" not in d and was.exists():
                        d["base"] = json.loads(was.read_text())
                cases.append((folder.name, label, d))
    every = list(dict.fromkeys(k for *_, d in cases for k in d))
    for flag in flags or every:
        both = [(f, label, d) for f, label, d in cases if flag in d and "base" in d]
        now, old = ([row(label, d[k]) for _, label, d in both] for k in (flag, "base"))

        def said(r, f):
            return (
                f"{f[-3:]}/{r['case'][-3:]} {'+'.join(r['effects'])}: {r['outcome']} {'+'.join(r['causes'])}"
            )

        names = [f for f, *_ in both]
        lost = [
            f"{said(o, f)} -> {said(r, f)}"
            for r, o, f in zip(now, old, names)
            if is_right(o) and not is_right(r)
        ]
        won = [
            f"{said(o, f)} -> {said(r, f)}"
            for r, o, f in zip(now, old, names)
            if is_right(r) and not is_right(o)
        ]
        else_ = [
            f"{said(o, f)} -> {said(r, f)}"
            for r, o, f in zip(now, old, names)
            if is_right(r) == is_right(o) and (r["outcome"], r["causes"]) != (o["outcome"], o["causes"])
        ]
        hold = [[x for r in rows for x in r["covered"]] for rows in (now, old)]
        tiers = {t: sum(r["tier"] == t for r in now) for t in ("healthy", "single", "pair", "outside")}
        alarms = sum(r["outcome"] == "false alarm" for r in now)
        print(
            f"{flag}: {len(both)} {tiers} lost {len(lost)} won {len(won)} alarms {alarms}",
            f"hold {sum(hold[0])} of {len(hold[0])} ({sum(hold[1])} of {len(hold[1])})",
            f"right {sum(map(is_right, now))} ({sum(map(is_right, old))})",
            f"seconds {sum(r['seconds'] for r in now):.0f} ({sum(r['seconds'] for r in old):.0f})",
        )
        for name, lines in (("lost", lost), ("won", won), ("else", else_)):
            for line in lines:
                print("   ", name, line)


FOLDERS = [Path(p) for p in sys.argv[2].split(",")]
main(Path(sys.argv[1]), sys.argv[3:])
