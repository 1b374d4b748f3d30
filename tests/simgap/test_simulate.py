import json

import numpy as np
import pytest
from simgap_scenes import HAND as RIG
from simgap_scenes import STACK

from experiments.worlds import random_properties
from hmmseg.contact.decompose import subtasks
from hmmseg.errors import InputError
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Finger, Noise, Rig
from hmmseg.io.task import GROUND, BlockTask, Move
from simgap.world.operator import OperatorSettings, minimum_jerk
from simgap.world.properties import PAPER_BLOCKS, Block, read_properties
from simgap.world.simulate import simulate_trials

TOWER = BlockTask({"a": "b", "b": "c", "c": GROUND}, (Move("a", GROUND), Move("b", "a"), Move("c", "b")))
SLIDE = BlockTask({"a": GROUND, "b": GROUND}, (Move("a", GROUND, slide=True), Move("b", "a")))


@pytest.fixture(scope="module")
def stacked():
    return simulate_trials(STACK, RIG, [PAPER_BLOCKS], [3])[0]


def test_a_trial_shows_its_task(stacked):
    """Truth against what the forces say: a grip exists exactly between touch and release."""
    assert stacked.boundaries.shape == (len(subtasks(STACK)) - 1,)
    assert (np.diff(stacked.boundaries) > 0.1).all()
    signals = task_space(stacked.trial, RIG)
    touch, leave, meet, part = stacked.boundaries[:4]
    t = signals.t
    gripped = signals.grip > 0.1
    held = (t > touch + 0.06) & (t < part - 0.06)
    assert gripped[held].all() and not gripped[t < touch - 0.01].any()
    carried = (t > leave + 0.1) & (t < meet - 0.1)
    assert np.mean(signals.fy[carried]) == pytest.approx(0.343, abs=0.01)
    assert np.mean(signals.fy[(t > meet + 0.1) & (t < part - 0.1)]) < 0


def test_the_width_and_the_heights_are_in_the_recording(stacked):
    """With rigid pads assumed a width comes out short by the pads' compression."""
    signals, b = task_space(stacked.trial, RIG), stacked.boundaries
    carried = (signals.t > b[1] + 0.1) & (signals.t < b[2] - 0.1)
    grip = np.mean(signals.grip[carried])
    assert np.mean(signals.distance[carried]) == pytest.approx(0.0159 - 2 * grip / 4000, abs=3e-5)
    final = stacked.motion.blocks[-1]
    assert final[0, 1] == pytest.approx(0.016 / 2, abs=5e-5)
    assert final[1, 1] == pytest.approx(0.016 + 0.0127 / 2, abs=5e-5)


def test_sensors_add_the_rig_s_noise(stacked):
    grid = np.searchsorted(stacked.t, stacked.trial.t)
    force = np.stack([stacked.trial.channels[f] for f in ("fx1", "fy1", "fx2", "fy2")], -1)
    noise = force - stacked.motion.force[grid].reshape(-1, 4)
    assert np.std(noise) == pytest.approx(0.012, rel=0.08)
    signals = task_space(stacked.trial, RIG)
    position = np.stack([signals.x1, signals.y1, signals.x2, signals.y2], -1)
    noise = position - stacked.motion.position[grid].reshape(-1, 4)
    assert np.std(noise) == pytest.approx(2e-4 * 0.12, rel=0.1)


def test_a_seed_gives_one_trial_and_another_seed_another(stacked):
    again = simulate_trials(STACK, RIG, [PAPER_BLOCKS], [3])[0]
    np.testing.assert_array_equal(again.trial.channels["fx1"], stacked.trial.channels["fx1"])
    together = simulate_trials(STACK, RIG, [PAPER_BLOCKS] * 3, [4, 3, 5])
    np.testing.assert_allclose(together[1].motion.force, stacked.motion.force, atol=1e-9)
    assert abs(together[0].boundaries - together[2].boundaries).max() > 0.05


@pytest.mark.parametrize("task", [TOWER, SLIDE])
def test_any_task_ends_as_described(task):
    blocks = random_properties(task, 1)
    done = simulate_trials(task, RIG, [blocks], [1])[0]
    assert np.isfinite(done.boundaries).all() and (np.diff(done.boundaries) > 0).all()
    support = dict(task.initial) | {move.object: move.to for move in task.performed}
    x, y = (dict(zip(task.objects, done.motion.blocks[-1, :, k], strict=True)) for k in (0, 1))
    for name, on in support.items():
        floor = 0.0 if on == GROUND else y[on] + blocks[on].height / 2
        assert y[name] - blocks[name].height / 2 == pytest.approx(floor, abs=3e-5)
        if on != GROUND:
            assert abs(x[name] - x[on]) < 3e-3


def test_a_slide_moves_the_block_along_the_ground_between_its_boundaries():
    done = simulate_trials(SLIDE, RIG, [random_properties(SLIDE, 2)], [2])[0]
    start, stop = done.boundaries[1:3]
    x, y = done.motion.blocks[:, 0, 0], done.motion.blocks[:, 0, 1]
    before, after = (x[np.searchsorted(done.t, time)] for time in (start, stop))
    assert abs(after - before) > 0.02 and abs(before - x[0]) < 1e-3
    assert np.ptp(y[: np.searchsorted(done.t, done.boundaries[3])]) < 1e-4


def test_a_grip_that_cannot_hold_is_no_silent_success():
    slippery = {name: Block(b.weight, b.width, b.height, friction=0.02) for name, b in PAPER_BLOCKS.items()}
    assert np.isnan(simulate_trials(STACK, RIG, [slippery], [0])[0].boundaries).any()


def test_a_cartesian_hand_records_positions():
    rig = Rig(rate=100.0, fingertip=RIG.fingertip, noise=Noise(position=1e-5, velocity=1e-3, force=0.01))
    done = simulate_trials(STACK, rig, [PAPER_BLOCKS], [0])[0]
    assert set(done.trial.channels) >= {"x1", "vy2", "fx1"} and done.trial.rate == pytest.approx(100.0)


def test_properties_come_from_the_json_of_identify(tmp_path):
    def entry(mean, **more):
        return {"unit": "m", "mean": mean, "sd": 1e-4} | more

    found = {name: {"weight": entry(0.4, unit="N"), "width": entry(0.02), "height": entry(0.015),
                    "friction": {"lower_bound": 1.4}} for name in STACK.objects}  # fmt: skip
    path = tmp_path / "identified.json"
    path.write_text(json.dumps({"properties": found}))
    assert read_properties(path, STACK)["block2"] == Block(0.4, 0.02, 0.015, 1.4)
    found["block2"]["height"] = None
    path.write_text(json.dumps({"properties": found}))
    with pytest.raises(InputError, match=r"block2\.height: found None; expected a positive number in m"):
        read_properties(path, STACK)


def test_what_cannot_be_performed_is_refused():
    with pytest.raises(InputError, match="'block2' is missing"):
        simulate_trials(STACK, RIG, [{"block1": PAPER_BLOCKS["block1"]}], [0])[0]
    with pytest.raises(ValueError, match=r"grip\n.*expected \(low, high\), low <= high"):
        OperatorSettings(grip=(3.0, 1.0))
    short = {i: Finger(base=f.base, links=(0.08, 0.08)) for i, f in (RIG.fingers or {}).items()}
    with pytest.raises(InputError, match="finger 1"):
        simulate_trials(STACK, RIG.model_copy(update={"fingers": short}), [PAPER_BLOCKS], [0])[0]


def test_minimum_jerk_is_flash_and_hogan_s():
    s = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(minimum_jerk(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0, 0, 0.5, 1, 1])
    assert np.gradient(minimum_jerk(s), s).max() == pytest.approx(1.875, abs=1e-4)
