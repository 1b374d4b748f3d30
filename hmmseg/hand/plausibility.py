"""Whether a hand's recording can be what it says: refused, or warned of, with the remedy."""

from __future__ import annotations

from hmmseg.errors import InputError
from hmmseg.hand.signs import check_signs
from hmmseg.io.plausibility import check_angles, check_clock, check_lengths, check_velocities
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial


def check(trial: Trial, rig: Rig) -> tuple[str, ...]:
    """Warnings about a trial; InputError for what cannot be.

    Units come first: what moves 120 m has no sides.
    """
    warnings = []
    for look in (check_clock, check_lengths, check_angles, check_velocities, check_signs):
        for finding in look(trial, rig):
            where = f"{trial.file}: column {finding.channel}"
            if finding.certain:
                raise InputError(where, finding.problem, finding.remedy)
            warnings.append(f"{where} {finding.problem}; {finding.remedy}")
    return tuple(warnings)
