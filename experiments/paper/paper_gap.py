"""The paper's own gap as a worked case: its blocks read with rigid fingertips.

    python -m experiments.paper.paper_gap

What `hmmseg diagnose` finds where rig.toml says `normal_stiffness = inf`: whether pad compliance is named and
slip is not, and how widths and heights move.
"""

from __future__ import annotations

from typing import Any

from experiments.paper.sources import PRINTED, recorded, save
from experiments.recordings import Case
from hmmseg.io.rig import Rig
from hmmseg.segmentation.align import AlignedTrials, align
from simgap.gap.diagnose import Diagnosis, diagnose

TRIALS = 4
SLIP = "grip_slip"


def rigid(rig: Rig, shear: bool = False) -> Rig:
    """The rig with rigid fingertips, as the paper has them; sideways too where `shear`."""
    pads: dict[str, float] = {"normal_stiffness": float("inf")}
    if shear:
        pads["shear_stiffness"] = float("inf")
    return rig.model_copy(update={"fingertip": rig.fingertip.model_copy(update=pads)})


def entry(found: Diagnosis, case: Case) -> dict[str, Any]:
    """Verdict, parameters, shrinkage, every property before and after, with the true and the printed one."""
    body = found.body
    best = "+".join(body["causes"]) if body["causes"] else next(iter(body["effects"]))
    shifts = {}
    for name, shift in body["effects"][best]["property_shift"].items():
        block, prop = name.split(".")
        true = case.blocks[block][prop][0]
        shifts[name] = {**shift, "actual": true, "before_error": shift["before"] - true,
                        "after_error": shift["after"] - true,
                        "paper_error": PRINTED[block][prop][0] - true}  # fmt: skip
    slip = [n for n in body["probabilities"] if SLIP in n.split("+")]
    return {
        **{k: body[k] for k in ("verdict", "causes", "indistinguishable", "probabilities", "detection")},
        "slip_probability": sum(body["probabilities"][n] for n in slip),
        "slip_log_evidence": body["effects"].get(SLIP, {}).get("log_evidence"),
        "parameters": body["effects"][best]["parameters"], "properties": shifts,
        "shrinkage": body["shrinkage"], "warnings": list(found.warnings),
    }  # fmt: skip


def main() -> None:
    """Save the diagnosis with rigid pads, with and without the measured properties, and with nominal pads."""
    case = recorded()
    trials, measured = list(case.trials[:TRIALS]), case.blocks

    def seen(rig: Rig) -> AlignedTrials:
        return align(trials, case.task, rig)

    save("gap", {
        "trials": [t.name for t in trials],
        "rigid": entry(diagnose(seen(rigid(case.rig))), case),
        "rigid_with_actual": entry(diagnose(seen(rigid(case.rig)), measured), case),
        "rigid_sideways_too": entry(diagnose(seen(rigid(case.rig, shear=True))), case),
        "rigid_slip_forced": entry(diagnose(seen(rigid(case.rig)), forced=[SLIP]), case),
        "nominal": entry(diagnose(seen(case.rig)), case),
    })  # fmt: skip


if __name__ == "__main__":
    main()
