"""The table of `ablate_robots`: a row for every special case.

    python -m experiments.ablation_robots_table OUT.csv LOG.jsonl...
"""
import csv, json, sys
from collections import defaultdict
rows = [json.loads(line) for f in sys.argv[2:] for line in open(f)]
rows = [r for r in rows if not r["flag"].startswith("A")]
base = {r["case"]: r for r in rows if r["flag"] == "base"}
by = defaultdict(dict)
for r in rows:
    if r["flag"] != "base" and r["case"] in base:
        by[r["flag"]][r["case"]] = r
AFTER = (  # the search is shared
    "small cause where little is left", "least share of a cause", "absurd values", "share left makes unknown", "alternatives by held-out logs",
    "none outweighs the best", "small effects stand in for none", "small gap is none", "jackknife of intervals", "other sets in intervals",
    "intervals without bounds",
)
def holds(every):
    return f"{sum(sum(r['holds']) for r in every)} of {sum(len(r['holds']) for r in every)}"
out = []
for name, cases in by.items():
    mine, own = [*cases.values()], [base[c] for c in cases]
    lost = [c for c, r in cases.items() if base[c]["right"] and not r["right"]]
    won = [c for c, r in cases.items() if base[c]["right"] is False and r["right"]]
    if len(cases) < 3 and not lost and not won: continue
    seconds = [sum(r["seconds"] for r in q) for q in (own if name in AFTER else mine, own)]
    what = "changes: " if all(c.startswith("sts") for c in cases) else ""
    out.append([what + name.removeprefix("old:").removeprefix("cal:"), len(cases), len(lost), ", ".join(lost), len(won), ", ".join(won),
                f"{holds(mine)} ({holds(own)})",
                "" if all(c.startswith("sts") for c in cases) else f"{seconds[0]:.0f} ({seconds[1]:.0f})"])  # a base run of sts calibrates, too
with open(sys.argv[1], "w", newline="") as f:
    w = csv.writer(f, lineterminator="\n")
    w.writerow(["without", "cases", "right verdicts lost", "which", "gained", "which", "90 % intervals that hold (with it)", "processor seconds (with it)"])
    w.writerows(out)
