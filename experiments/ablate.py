"""Switch mechanisms of the diagnosis of blocks off: python -m experiments.ablate OUT CASES FLAGS ...

CASES is a file of lines FOLDER CASE, or FOLDER CASE FLAGS .... FLAGS are names of simgap/abl.py joined by +, `base` for none; those of
the attribution alone share one search. Diagnoses go to OUT/FOLDER/CASE.json by flags; what is there stays.
"""

import json
import sys
import time
import traceback
from pathlib import Path

import simgap.gap.diagnose as D
import simgap.gap.search as S
from experiments.blind_check.diagnose import excluded, read_folder
from hmmseg.jaxconfig import double_precision
from simgap.abl import ON

# flags of the attribution: the search of a case is shared
LATE = {"pred_max", "response", "shown", "small_alike", "chi2", "between", "one_start", "alone", "singles",
        "after_first", "together", "refined", "scat_needed"}  # fmt: skip


def document(found, seconds):
    t = time.process_time()
    gap, verdict = D.attributed(found)
    body = D.body(found, verdict, D._causes(found, gap, verdict), None, 0)
    late = time.process_time() - t
    body.pop("where"), body["remainder"].pop("where")
    return {**body, "late": round(late, 2), "seconds": round(seconds + late, 2)}


@double_precision
def run(folder, flags, have):
    ON.clear()
    aligned, actual = read_folder(folder)
    out, usual, identified = {}, None, {}
    plain = S.identify_aligned

    def known(one):
        if "it" not in identified:
            t = time.process_time()
            identified["it"], identified["s"] = plain(one), time.process_time() - t
        return identified["it"]

    S.identify_aligned = known
    for flag in flags:
        if flag in have:
            continue
        names = {*flag.split("+")} - {"base"}
        try:
            ON.clear()
            if names <= LATE:
                if usual is None:
                    t = time.process_time()
                    usual = S.search(aligned, actual, excluded(folder)), time.process_time() - t
                ON.update(names)
                out[flag] = document(*usual)
            else:
                ON.update(names)
                t = time.process_time()
                found = S.search(aligned, actual, excluded(folder))
                out[flag] = document(found, time.process_time() - t)
        except Exception as error:
            traceback.print_exc()
            out[flag] = {"error": repr(error), "seconds": 0.0, "verdict": "error", "causes": []}
    S.identify_aligned = plain
    ON.clear()
    return out


def main():
    out, cases, flags = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]
    for line in cases.read_text().split("\n"):
        if not line.strip():
            continue
        folder, case, *own = line.split()
        file = out / Path(folder).name / f"{case}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        old = json.loads(file.read_text()) if file.exists() else {}
        t = time.process_time()
        new = run(Path(folder) / case, own or flags, old)
        if new:
            file.write_text(json.dumps(old | new))
            said = [
                f"{k}={'+'.join(v['causes']) or v['verdict']}({v['detection']['p_value'] if 'detection' in v else ''})"
                for k, v in new.items()
            ]
            print(file.parent.name, case, round(time.process_time() - t, 1), *said, flush=True)


main()
