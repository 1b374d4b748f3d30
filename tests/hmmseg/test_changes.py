"""What contact changes show of where force and position disagree, and a block that a finger pushes."""

from dataclasses import replace

import numpy as np
import pytest

from hmmseg import Rig, Trial, align, example_folder
from hmmseg.hand.signals import task_space
from hmmseg.segmentation.changes import Change, Penetration, Prior, disagreements, moment
from hmmseg.segmentation.pads import Compliance, Sensing
from hmmseg.segmentation.posteriors import contacts

T = np.arange(12) * 0.02
SD_PRESSED, SD_PLACE = 3e-6, 2e-5


def release(seed: int, slip: float | None = None) -> Change:
    """A contact that ends between samples 5 and 6, relaxed; it slides where it is pressed by `slip` [m]."""
    rng = np.random.default_rng(seed)
    place = (5 - np.arange(12)) * 2e-4 + rng.uniform(0, 2e-4)
    pressed = np.where(np.arange(12) <= 5, np.maximum(place, 0), 0.0)
    c = Penetration(
        T, pressed + SD_PRESSED * rng.standard_normal(12), place + SD_PLACE * rng.standard_normal(12),
        np.full((2, 12), -1e-2), SD_PRESSED, SD_PRESSED, SD_PLACE, 1e-3, 0.0,
    )  # fmt: skip
    probability = np.zeros(11)
    probability[5] = 1.0
    slips = () if slip is None else (slip,)
    return Change((c,), Prior(T, probability, (0.0, 1.0)), False, "smooth", 0.0, slips)


@pytest.mark.parametrize("louder", [1.0, 20.0])
def test_how_loud_forces_are_after_a_change_is_learned(louder):
    rng, changes = np.random.default_rng(3), [release(k) for k in range(40)]
    for change in changes:
        c = change.contacts[0]
        c.pressed[6:] = louder * SD_PRESSED * rng.standard_normal(6)
    (found,) = disagreements(changes).values()
    assert found.louder == pytest.approx(louder, rel=0.2)


def test_a_grip_that_slides_before_it_ends_may_have_ended_then():
    (known,) = disagreements([release(k) for k in range(40)]).values()
    change = release(99, slip=3e-4)
    place = change.contacts[0].place
    slides = float(np.interp(-3e-4, -place, T))  # 1e-2 m/s: 30 ms before it is spent
    spent = float(np.interp(0.0, -place, T))
    found, plain = moment(change, known), moment(release(99), known)
    assert found.quantile(0.05) < slides + 2e-3 and found.quantile(0.95) > spent - 2e-3
    assert plain.quantile(0.05) > slides + 10e-3
    assert abs(found.quantile(0.5) - plain.quantile(0.5)) < 5e-3


def test_a_finger_that_pushes_the_block_moves_the_face_that_the_other_meets():
    folder = example_folder()
    rig = Rig.read(folder / "rig.toml")
    signals = task_space(Trial.read(folder / "trial_01.csv", rig), rig)
    aligned = align(folder / "trial_01.csv", folder / "task.toml", rig)
    parameters = aligned.fit.parameters
    stiff = Sensing(Compliance(2.5e-4, 1e-6, 0.0), Compliance(4e-4, 1e-6, 0.0), 0.0, 1e-3)
    n, step = signals.t.size, 1.5e-3
    still = np.full(n, 0.01)
    pushed = np.where(np.arange(n) < n // 2, 0.0, step)  # finger 2 has pushed the block to the left
    made = replace(
        signals, x1=-still - pushed, x2=still - pushed, vx1=0 * still, vx2=0 * still,
        fx1=0 * still, fx2=np.full(n, -1.0),
    )  # fmt: skip
    table = contacts(made, stiff, replace(parameters, bias=np.zeros(4)))
    held = np.zeros(n, bool)
    held[n // 4 : n // 2] = True
    moved, _ = table._pushed(1, held)
    np.testing.assert_allclose(moved[: n // 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved[n // 2 :], step, atol=1e-9)


def test_the_load_on_a_stiff_pad_is_not_moved_by_noise_of_its_finger():
    folder = example_folder()
    rig = Rig.read(folder / "rig.toml")
    signals = task_space(Trial.read(folder / "trial_01.csv", rig), rig)
    aligned = align(folder / "trial_01.csv", folder / "task.toml", rig)
    late = Sensing(Compliance(2.5e-4, 1e-6, 0.0), Compliance(1e-5, 1e-6, 0.0), 5e-3, 1e-3)
    n = signals.t.size
    shaking = 5e-3 * np.random.default_rng(0).standard_normal(n)
    still = replace(signals, vy1=shaking, vy2=shaking, fy1=np.zeros(n), fy2=np.zeros(n))
    table = contacts(still, late, replace(aligned.fit.parameters, bias=np.zeros(4)))
    load = table._load(aligned.subtasks[1], np.ones(n, bool), making=False)
    np.testing.assert_allclose(load.pressed, load.pressed[0], rtol=1e-9)
    assert load.hidden and load.pressed[0] > 0
