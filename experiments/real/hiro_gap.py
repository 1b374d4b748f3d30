"""The sim-to-real gap of a snap assembly: where forces differ, what rings after the snap, what shrinks it.

    python -m experiments.real.hiro_gap FOLDER [--output FILE.json]

FOLDER is that of `experiments.real.hiro_snap`: real_guarded (7 trials) and sim (8, by the same lab's own
simulator). Trials are cut at the controller's own state starts. Simulated trials end 0.35 to 1.01 s after
the last of them, so all trials are cut off at a common tail: the shortest, and 0.95 s with the simulated
trials that have it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.stats import t as student

from experiments.real.hiro_snap import KINDS, WRENCH, read_kind
from experiments.real.on_folder import run_on_folder
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from simgap.generic.diagnose import GenericDiagnosis, diagnose
from simgap.generic.effects import Ring, fit_ring, from_swing
from simgap.generic.trials import DURATION, SLOW, transformed

RESULTS = Path(__file__).resolve().parents[1] / "results" / "hiro_gap.json"
REAL, SIM = "real_guarded", "sim"
LONG = 0.95  # s; half of the simulated trials last as long after the last start
RATE = 200.0  # Hz
RINGING = 3.0  # s of the real tail
BANDS = {"2.6 Hz": (1.5, 4.0), "7-8 Hz": (6.5, 8.5)}  # Hz, about the two oscillations
HIGH_PASS = 5.0  # Hz, to see the weaker one beside the stronger
LATER = (0.15, 1.15)  # s after the last start, where it is looked for

Labelled = list[tuple[Trial, np.ndarray]]


def tail_of(trial: Trial, starts: np.ndarray) -> float:
    """Time [s] from the last start to the end."""
    return float(trial.t[-1] - starts[-1])


def cut_off(trials: Labelled, tail: float, shown: float | None = None) -> Labelled:
    """Trials without what comes later than `tail` (or, if given, `shown`) after the last start; those shorter
    than `tail` are left out."""
    out = []
    for trial, starts in trials:
        if tail_of(trial, starts) < tail:
            continue
        keep = trial.t <= starts[-1] + (shown or tail)
        channels = {name: trial.channels[name][keep] for name in WRENCH}
        out.append((Trial(trial.file, trial.t[keep], channels), starts))
    return out


def compared(real: Labelled, sim: Labelled, tail: float, seed: int = 0) -> GenericDiagnosis:
    """The generic diagnosis of all trials up to one tail; real ones go on, which shows their ring."""
    first, second = cut_off(real, tail, RINGING), cut_off(sim, tail)
    boundaries = {t.file: np.append(starts, starts[-1] + tail) for t, starts in (*first, *second)}
    task = SequenceTask(KINDS[REAL].sequence, WRENCH)
    return diagnose([t for t, _ in first], [t for t, _ in second], task, boundaries=boundaries, seed=seed)


def table(found: GenericDiagnosis) -> dict:
    """By channel and subtask: mean real and simulated force and each kind's scatter; durations [s]."""
    lay, out = found.scene.layout, {}
    kinds = {"real": found.real, "sim": found.sim}
    for s, subtask in enumerate(lay.ensembles.subtasks):
        for c, name in enumerate(lay.ensembles.channels):
            each = {kind: rows[:, lay.where(SLOW, c, s)].mean(1) for kind, rows in kinds.items()}
            out.setdefault(name, {})[subtask] = {
                kind: {"mean": float(v.mean()), "sd_between_trials": float(v.std(ddof=1))}
                for kind, v in each.items()
            }
        (log,) = lay.where(DURATION, -1, s)
        durations = {kind: float(np.exp(rows[:, log].mean())) for kind, rows in kinds.items()}
        out.setdefault("duration", {})[subtask] = durations
    return out


def summary(found: GenericDiagnosis) -> dict:
    """Verdict, best explanation, its parameters and shrinkage."""
    body = found.body
    lay = found.scene.layout
    share: dict[str, float] = {}
    for row in body["where"]:
        key = f"{row['channel']}, {row['subtask']}, {row['band'][0]:.3g}-{row['band'][1]:.3g} Hz"
        share[key] = share.get(key, 0.0) + row["share"]
    return {
        "trials": {"real": len(lay.ensembles.real), "sim": len(lay.ensembles.sim)},
        **{k: body[k] for k in ("verdict", "causes", "probabilities", "detection", "attribution")},
        "remainder": body["remainder"]["share"],
        "largest_shares": dict(sorted(share.items(), key=lambda i: -i[1])[:12]),
        "best_explanation": list(found.leading), "shrinkage": body["shrinkage"],
        "parameters": {n: body["effects"][n]["parameters"] for n in found.leading},
        "by_subtask": by_subtask(found), "forces": table(found),
    }  # fmt: skip


def by_subtask(found: GenericDiagnosis) -> dict:
    """Share of the significant excess by subtask and by channel."""
    out: dict = {"subtask": {}, "channel": {}}
    for row in found.body["where"]:
        for key in out:
            out[key][row[key]] = out[key].get(row[key], 0.0) + row["share"]
    return out


def windows(
    trials: Labelled, channel: str, start: float, length: float, high_pass: bool = False
) -> np.ndarray:
    """Samples (trials, n) of a channel from `start` after the last label; trials too short left out."""
    rows, n = [], round(length * RATE)
    for trial, starts in trials:
        values = trial.channels[channel]
        if high_pass:
            values = sosfiltfilt(butter(4, HIGH_PASS, "high", fs=RATE, output="sos"), values)
        first = int(np.searchsorted(trial.t, starts[-1] + start))
        if first + n <= values.size:
            rows.append(values[first : first + n])
    return np.array(rows)


def ring_entry(found: Ring | None) -> dict | None:
    """Frequency, damping and amplitude with 90 % intervals; None where no light damping was resolved."""
    if found is None or not found.resolved:
        return None
    amplitude, n = found.amplitude, found.amplitude.size
    reach = float(student.isf(0.05, n - 1)) * amplitude.std(ddof=1) / np.sqrt(n)
    return {
        "frequency": found.frequency, "frequency_90": found.frequency_90, "damping": found.damping,
        "damping_90": found.damping_90, "amplitude": float(amplitude.mean()),
        "amplitude_90": [float(amplitude.mean() - reach), float(amplitude.mean() + reach)],
        "share_explained": found.share,
    }  # fmt: skip


def band_power(rows: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    """Log mean square (trials,) of windows within a band [Hz]."""
    spectrum = transformed(rows) ** 2
    f = np.arange(rows.shape[1]) * RATE / (2 * rows.shape[1])
    return np.log(spectrum[:, (f >= band[0]) & (f < band[1])].sum(1) / rows.shape[1])


def missing(
    real: Labelled, sim: Labelled, channel: str, band: tuple[float, float], ring: dict | None
) -> dict:
    """Whether a ring of the real trials is absent from the simulated tails of LONG, or could not be seen.

    The real ring is added to every simulated tail; it could be seen if that raised the band's log power
    by more than three times the scatter between simulated trials.
    """
    a, b = windows(real, channel, 0.0, LONG), windows(sim, channel, 0.0, LONG)
    one, other = band_power(a, band), band_power(b, band)
    out = {"sim_trials": len(b), "rms_real": float(np.exp(one.mean() / 2)),
           "rms_sim": float(np.exp(other.mean() / 2)),
           "log_power_sd_sim": float(other.std(ddof=1))}  # fmt: skip
    if ring is None:
        return out | {"could_be_seen": None, "missing": None}
    t = np.arange(b.shape[1]) / RATE
    omega = 2 * np.pi * ring["frequency"]
    wave = ring["amplitude"] * np.exp(-ring["damping"] * omega * t) * np.sin(omega * t)
    raised = band_power(b + wave, band).mean() - other.mean()
    visible = bool(raised > 3 * other.std(ddof=1))
    lower = one.mean() - other.mean() > 3 * float(np.hypot(one.std(ddof=1), other.std(ddof=1)))
    return out | {"raised_by": float(raised), "could_be_seen": visible, "missing": bool(visible and lower)}


def ringing(real: Labelled, sim: Labelled) -> dict:
    """Both oscillations after the snap in every channel."""
    out: dict = {}
    for channel in WRENCH:
        strong = ring_entry(fit_ring(from_swing(list(windows(real, channel, 0.0, RINGING))), RATE))
        first = ring_entry(fit_ring(from_swing(list(windows(real, channel, 0.0, LONG))), RATE))
        weak = ring_entry(
            fit_ring(windows(real, channel, LATER[0], LATER[1] - LATER[0], True), RATE, HIGH_PASS)
        )
        out[channel] = {
            "after_the_snap": strong, "first_0.95_s": first, "above_5_Hz": weak,
            "2.6 Hz": missing(real, sim, channel, BANDS["2.6 Hz"], strong),
            "7-8 Hz": missing(real, sim, channel, BANDS["7-8 Hz"], weak),
        }  # fmt: skip
    return out


def course(found: GenericDiagnosis, channels: Sequence[str] = ("fx", "fz", "my")) -> dict:
    """For the figure: mean courses of both kinds, and the simulated one with the best explanation in."""
    lay, out = found.scene.layout, {}
    for name in channels:
        c = lay.ensembles.channels.index(name)
        index = np.concatenate([lay.where(0, c, k) for k in range(len(lay.ensembles.subtasks))])
        out[name] = {
            "real": found.real[:, index].mean(0).tolist(),
            "real_sd": found.real[:, index].std(0, ddof=1).tolist(),
            "sim": found.sim[:, index].mean(0).tolist(),
            "sim_sd": found.sim[:, index].std(0, ddof=1).tolist(),
            "explained": (found.sim.mean(0) + found.shift)[index].tolist(),
            "subtask": lay.subtask[index].tolist(),
        }  # fmt: skip
    return out


def tails(real: Labelled, sim: Labelled) -> dict:
    """For the figure: mean and scatter of fz after the last start, as long as RINGING and LONG."""
    out: dict = {"step": 4 / RATE}
    for kind, trials, length in (("real", real, RINGING), ("sim", sim, LONG)):
        rows = windows(trials, "fz", 0.0, length)[:, ::4]
        out[kind] = rows.mean(0).round(3).tolist()
        out[f"{kind}_sd"] = rows.std(0, ddof=1).round(3).tolist()
    return out


def run(folder: Path) -> dict:
    """All results."""
    real, sim = read_kind(folder, REAL), read_kind(folder, SIM)
    shortest = min(tail_of(t, s) for t, s in sim)
    everything, longer = compared(real, sim, shortest), compared(real, sim, LONG)
    return {
        "format": "experiments.hiro_gap/1",
        "tails": {"real": [tail_of(t, s) for t, s in real], "sim": [tail_of(t, s) for t, s in sim],
                  "shortest": shortest},
        "all_simulated": summary(everything), "long_tails": summary(longer),
        "ringing": ringing(real, sim),
        "figure": {"course": course(longer), "tails": tails(real, sim)},
    }  # fmt: skip


def rounded(value):
    """Numbers to five significant digits, through dicts and lists."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v) for v in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def main() -> None:
    """Run on a folder and write the results."""
    run_on_folder(__doc__, lambda folder: rounded(run(folder)), RESULTS)


if __name__ == "__main__":
    main()
