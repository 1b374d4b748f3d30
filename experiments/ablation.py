"""What each part of the model is worth: one left out at a time, on simulated trials.

    python -m experiments.ablation [--cases 24]

Cases of four trials, pooled, are estimated in full and with a part left out. Heavy tails are judged
on disturbed trials too: one force sample in fifty is off by up to 0.5 N, as a knock or a lost packet
leaves it. Writes experiments/results/ablation.json; experiments.write_tables puts it in docs/calibration.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from experiments.bank import simulated_cases
from experiments.estimates import estimate, summarise_estimates
from experiments.recordings import Case
from experiments.saving import save
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import FORCE_CHANNELS, Fingertip
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import TrialAlignment
from hmmseg.segmentation.fit import MeanShares

RESULTS = Path(__file__).parent / "results"
FIRST_SEED = 22_000
KNOCK, KNOCKED = 0.5, 0.02  # N; share of force samples


@dataclass(frozen=True)
class Variant:
    """A way to estimate: `without` takes a part out of the library, `change` alters the case."""

    name: str
    without: Callable[[], AbstractContextManager] = nullcontext
    change: Callable[[Case], Case] = lambda case: case


@contextmanager
def no_inertia() -> Iterator[None]:
    """Carried blocks weigh what they weigh, however they are accelerated (the paper's quasistatics)."""

    def still(t: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return np.zeros_like(velocity)

    with (
        patch("hmmseg.segmentation.features.acceleration", still),
        patch("estimation.observations.acceleration", still),
    ):
        yield


def rigid(case: Case) -> Case:
    """The same recording with a rig that knows nothing of its pads."""
    return replace(case, rig=case.rig.model_copy(update={"fingertip": Fingertip()}))


@contextmanager
def gaussian() -> Iterator[None]:
    """Student-t residuals with so many degrees of freedom that they are Gaussian."""
    modules = ("hmmseg.segmentation.emissions", "hmmseg.segmentation.fit", "estimation.observations")
    with patch(f"{modules[0]}.TAIL", 1e8), patch(f"{modules[1]}.TAIL", 1e8), patch(f"{modules[2]}.TAIL", 1e8):
        yield


@contextmanager
def flat_durations() -> Iterator[None]:
    """Every subtask is expected to last as long as any other."""

    def equal(self: MeanShares, responsibilities: Sequence[np.ndarray]) -> MeanShares:
        del responsibilities
        return replace(self, shares=np.full(self.shares.size, 1.0 / self.shares.size))

    with patch("hmmseg.segmentation.fit.MeanShares.updated", equal):
        yield


@contextmanager
def plugged_in() -> Iterator[None]:
    """The most probable alignment in place of draws from all."""

    def medians(trial: TrialAlignment, rng: np.random.Generator, num: int) -> np.ndarray:
        best = np.maximum.accumulate([b.quantile(0.5) for b in trial.boundaries])
        return np.tile(best, (num, 1))

    with patch("estimation.observations.draw_boundaries", medians):
        yield


@contextmanager
def unrefined() -> Iterator[None]:
    """Boundaries uniform between two samples (their medians the midpoints), contacts not solved for."""

    def unknown(*_: object) -> None:
        return None

    with patch("hmmseg.segmentation.crossings.Contacts.change", unknown):
        yield


def knocked(case: Case) -> Case:
    """The case with some force samples far off."""

    def disturbed(trial: Trial, k: int) -> Trial:
        rng, channels = np.random.default_rng([int(case.name.split("_")[1]), k, 7]), dict(trial.channels)
        for name in FORCE_CHANNELS:
            hit = rng.uniform(size=trial.t.size) < KNOCKED
            channels[name] = channels[name] + hit * rng.uniform(-KNOCK, KNOCK, trial.t.size)
        return replace(trial, channels=channels)

    trials = tuple(disturbed(trial, k) for k, trial in enumerate(case.trials))
    return replace(case, trials=trials, signals=tuple(task_space(trial, case.rig) for trial in trials))


VARIANTS = (
    Variant("full model"),
    Variant("inertia left out", no_inertia),
    Variant("pads taken as rigid", change=rigid),
    Variant("Gaussian residuals", gaussian),
    Variant("durations not learned", flat_durations),
    Variant("alignment plugged in", plugged_in),
    Variant("contacts not solved for", unrefined),
    Variant("full model, knocked", change=knocked),
    Variant("Gaussian residuals, knocked", gaussian, knocked),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=24)
    parser.add_argument("--output", type=Path, default=RESULTS / "ablation.json")
    options = parser.parse_args(arguments)
    cases = simulated_cases(options.cases, seed=FIRST_SEED)
    rows = []
    for variant in VARIANTS:
        with variant.without():
            found = summarise_estimates([[estimate(variant.change(case))] for case in cases])
        rows.append({"name": variant.name, **found})
        every = found["properties"]["all"]
        print(
            f"{variant.name}: rms {100 * every['rms']:.3f} %, 95 % cover {every['coverage_95']:.3f}",
            flush=True,
        )
    document = {"seed": FIRST_SEED, "cases": options.cases, "variants": rows}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    save(options.output, document)


if __name__ == "__main__":
    main()
