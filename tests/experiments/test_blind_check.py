"""The blind check: its simulator obeys physics, its seal holds, its scorer counts rightly."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="the blind check's simulator needs the extra `check`")

from experiments.blind_check import cases as sets  # noqa: E402
from experiments.blind_check.effects import CATALOGUE  # noqa: E402
from experiments.blind_check.generate import NOMINAL, generate  # noqa: E402
from experiments.blind_check.hand import angles, load_rig, rates, tips  # noqa: E402
from experiments.blind_check.judge import judge_case  # noqa: E402
from experiments.blind_check.operator import Style, plan  # noqa: E402
from experiments.blind_check.perform import SETTLE, perform  # noqa: E402
from experiments.blind_check.scene import PIVOT, STEP, Block, Servo, World, mjcf  # noqa: E402
from experiments.blind_check.score import figures  # noqa: E402
from experiments.blind_check.sealing import BrokenSeal, unseal  # noqa: E402
from experiments.blind_check.signals import Sampling, sample, sense  # noqa: E402
from experiments.blind_check.statistics import calibration  # noqa: E402
from experiments.blind_check.tasks import TASKS  # noqa: E402
from experiments.blind_check.untidy_trials import rows as untidy_rows  # noqa: E402
from experiments.blind_check.worlds import draw_world, world_of  # noqa: E402
from hmmseg.io.rig import read_rig  # noqa: E402
from hmmseg.io.task import read_task  # noqa: E402
from simgap.effects import catalogue  # noqa: E402

RIG = load_rig(NOMINAL / "rig.toml")
BLOCKS = {"block1": Block(0.5, 0.017, 0.017, 0.6), "block2": Block(0.35, 0.026, 0.014, 0.6)}
HEALTHY = World(RIG.normal_stiffness, RIG.shear_stiffness)
TASK = TASKS["reversal"]
SERVO = Servo(0.12, 800.0, 19.0)


@pytest.fixture(scope="module")
def motion():
    """A healthy trial."""
    return perform(plan(TASK, BLOCKS, HEALTHY, Style(), np.random.default_rng(4)), BLOCKS, HEALTHY)


def run(world: World, centres: dict[str, tuple[float, float]], seconds: float, command=(0.0, 0.2, 0.3, 0.2)):
    """A block world left alone, its fingers far away: the model, its data and heights at every step."""
    model = mujoco.MjModel.from_xml_string(mjcf(BLOCKS, centres, command, world, (SERVO, SERVO)))
    data = mujoco.MjData(model)
    data.qpos[[model.joint(n).qposadr[0] for n in ("x1", "z1", "x2", "z2")]] = command
    data.ctrl[:4] = command
    heights = []
    for _ in range(round(seconds / STEP)):
        mujoco.mj_step(model, data)
        heights.append(data.joint("z_block1").qpos[0])
    return model, data, np.array(heights)


def test_a_block_falls_freely():
    _, _, z = run(HEALTHY, {"block1": (0.1, 0.15), "block2": (0.2, 0.007)}, 0.1)
    t = np.arange(1, len(z) + 1) * STEP
    # Semi-implicit Euler falls by g t (t + step) / 2.
    np.testing.assert_allclose(z, -RIG.gravity * t * (t + STEP) / 2, atol=1e-8)


def test_a_table_yields_by_the_load_and_tilts_about_its_pivot():
    rest = {"block1": (0.115, 0.014 + 0.0085), "block2": (0.115, 0.007)}
    _, _, z = run(replace(HEALTHY, table_stiffness=1000.0), rest, 0.8)
    assert z[-1] == pytest.approx(-(0.5 + 0.35) / 1000.0, rel=0.01)
    _, data, z = run(replace(HEALTHY, tilt=0.03), {"block1": (0.165, 0.0102), "block2": (0.115, 0.007)}, 0.5)
    # It comes to lie flat on the slope: friction holds one corner, about which it turns.
    x = data.joint("x_block1").qpos[0]
    assert data.joint("turn_block1").qpos[0] == pytest.approx(0.03, abs=2e-4)
    along = 0.165 + x - PIVOT
    assert 0.0102 + z[-1] == pytest.approx(0.03 * along + 0.0085, abs=3e-5)
    assert abs(x) < 5e-4


def test_fingers_carry_the_weight_and_nothing_in_free_motion(motion):
    touch, leave, meet, part = motion.boundaries[:4]
    air = (motion.t > leave + 0.05) & (motion.t < meet - 0.02)
    net = motion.force[air, 1] + motion.force[air, 3]
    a = np.gradient(np.gradient(motion.centres[:, 0, 1], motion.t), motion.t)[air]
    np.testing.assert_allclose(net, 0.5 * (1 + a / RIG.gravity), atol=0.01)
    free = (motion.t < touch - 0.02) | ((motion.t > part + 0.1) & (motion.t < motion.boundaries[4] - 0.02))
    assert np.abs(motion.force[free]).max() < 1e-4


def test_pads_are_linear_and_do_not_slip(motion):
    touch, _, _, part = motion.boundaries[:4]
    held = (motion.t > touch + 0.1) & (motion.t < part - 0.1)
    p, f = motion.position[held], motion.force[held]
    distance = p[:, 2] - p[:, 0] + (f[:, 0] - f[:, 2]) / RIG.normal_stiffness
    assert np.quantile(np.abs(distance - BLOCKS["block1"].width), 0.99) < 5e-6  # but for the shock of landing
    offset = p[:, 3] - p[:, 1] - (f[:, 3] - f[:, 1]) / RIG.shear_stiffness
    turned = offset - motion.turns[held, 0] * BLOCKS["block1"].width
    assert np.quantile(np.abs(turned - np.median(turned)), 0.99) < 8e-6


def test_pads_touch_no_block_but_the_one_that_is_moved(monkeypatch):
    """Low blocks on wide ones, pressed hard: what is beneath is as near to the pads as it can be."""
    touched: set[tuple[str, int]] = set()
    step = mujoco.mj_step

    def watched(model, data, count=1):
        step(model, data, count)
        for pair in data.contact.geom[: data.ncon].tolist():
            names = sorted(model.geom(i).name for i in pair)
            if names[1].startswith("tip"):
                touched.add((names[0], round(data.time / STEP)))

    monkeypatch.setattr("experiments.blind_check.perform.mujoco.mj_step", watched)
    low = {"block1": Block(0.5, 0.017, 0.013, 0.6), "block2": Block(0.35, 0.026, 0.013, 0.6)}
    style = Style(press=(1.7, 1.7), height=(-0.0012, -0.0012))
    done = perform(plan(TASK, low, HEALTHY, style, np.random.default_rng(4)), low, HEALTHY)
    amid = (done.boundaries[3] + done.boundaries[4]) / 2 + SETTLE
    assert {name for name, n in touched if n * STEP < amid} == {"box_block1"}
    assert {name for name, n in touched if n * STEP > amid} == {"box_block2"}


def test_angles_and_tips_are_inverse(motion):
    q = angles(RIG, motion.position)
    np.testing.assert_allclose(tips(RIG, q), motion.position, atol=1e-12)
    turned = np.gradient(q, motion.t, axis=0)[100:-100]
    np.testing.assert_allclose(rates(RIG, q, motion.velocity)[100:-100], turned, atol=0.04)
    longer = angles(RIG, motion.position, 0.02)
    assert np.abs(tips(RIG, longer) - motion.position).max() > 1e-3


def test_noise_has_the_rigs_size(motion):
    signals = sense(motion, RIG, [], np.random.default_rng(0))
    _, noisy = sample(signals, Sampling(), np.random.default_rng(1))
    _, quiet = sample(signals, Sampling(), np.random.default_rng(1), noisy=False)
    for name, sd in (("q11", RIG.angle_noise), ("dq22", RIG.velocity_noise), ("fy1", RIG.force_noise)):
        assert np.std(noisy[name] - quiet[name]) == pytest.approx(sd, rel=0.2)


def test_sensing_effects_are_what_the_contract_says(motion):
    def force(name: str, values: dict) -> np.ndarray:
        change = CATALOGUE[name].change(values)
        return sense(motion, RIG, change.stages, np.random.default_rng(0)).force

    f, t = motion.force, motion.t
    np.testing.assert_allclose(force("force_gain", {"gain": 0.1}), 1.1 * f)
    turned = force("sensor_rotation", {"angle1": 0.1, "angle2": -0.2})
    np.testing.assert_allclose(turned[:, 1], np.sin(0.1) * f[:, 0] + np.cos(0.1) * f[:, 1], atol=1e-12)
    late = force("force_lag", {"delay": 0.2})
    np.testing.assert_allclose(late[200:], f[:-200], atol=1e-6)
    slow = force("force_lowpass", {"time_constant": 0.1})[:, 0]
    residual = 0.1 * np.gradient(slow, t) + slow - f[:, 0]
    assert np.abs(residual).mean() < 0.02
    start = force("cable_force", {"stiffness": 2.0, "x0": 0.1, "y0": 0.0})[0]
    np.testing.assert_allclose(start - f[0], 2.0 * (motion.position[0] - [0.1, 0, 0.1, 0]), atol=1e-9)
    drift = force("force_drift", {"fx1": 0.02, "fy1": 0.0, "fx2": 0.0, "fy2": 0.0})[:, 0] - f[:, 0]
    assert drift[-1] == pytest.approx(0.02 * t[-1], rel=1e-6)


def test_an_off_centre_mass_makes_the_shear_unequal():
    rng = lambda: np.random.default_rng(4)  # noqa: E731
    tips_round = replace(HEALTHY, pad_turning=0.05)
    moved = replace(tips_round, mass_offset=0.003)
    a = perform(plan(TASK, BLOCKS, tips_round, Style(), rng()), BLOCKS, tips_round)
    b = perform(plan(TASK, BLOCKS, moved, Style(), rng()), BLOCKS, moved)
    leave, meet = a.boundaries[1:3]
    air = (a.t > leave + 0.2) & (a.t < meet - 0.1)
    n = min(len(a.t), len(b.t))
    more = (b.force[:n] - a.force[:n])[air[:n]].mean(0)
    couple = 0.5 * 0.003 / 0.017
    # The heavier side sinks and the grip then pushes askew; pads that resist turning take some of it.
    np.testing.assert_allclose(more[[1, 3]], [-couple, couple], rtol=0.35)


def test_every_contract_effect_is_there():
    known = {n for n, e in catalogue().items() if e.chosen}
    assert known <= set(CATALOGUE)
    for name, made in CATALOGUE.items():
        values = made.draw(np.random.default_rng(0), 0.5)
        assert values and all(np.isfinite(list(values.values()))), name


def test_a_world_is_what_its_rig_and_label_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sets, "TRIALS", 1)
    generate(3, 11, tmp_path)
    for label in unseal(tmp_path)["cases"]:
        folder, world = tmp_path / "cases" / label["case"], world_of(label)
        rig = read_rig(folder / "rig.toml")  # as the judged code reads it
        assert (rig.rate, rig.fingertip.normal_stiffness) == (world.rate, world.normal_stiffness)
        assert rig.noise.force == pytest.approx(RIG.force_noise * world.sensors, rel=0.01)
        task = read_task(folder / "task.toml")
        assert len(task.moves) * 4 + 1 == len(label["subtasks"])
        assert [len(b) for b in label["boundaries"]] == [4 * len(task.moves)]
        t = np.loadtxt(folder / "trial_01.csv", delimiter=",", skiprows=1, usecols=0)
        np.testing.assert_allclose(np.diff(t), 1 / world.rate, atol=1.1e-5)


def test_worlds_are_drawn_apart_and_noise_is_as_drawn(motion):
    drawn = [draw_world(np.random.default_rng(k)) for k in range(40)]
    assert {w.profile for w in drawn} == {"minimum_jerk", "trapezoid", "person"}
    assert len({w.task for w in drawn}) >= 4 and min(w.pace for w in drawn) < 0.6
    signals, rng = sense(motion, RIG, [], np.random.default_rng(0)), lambda: np.random.default_rng(1)
    odd = Sampling(noise=(1.0, 1.0, 1.3), colour=0.3, differences=True)
    _, noisy = sample(signals, odd, rng())
    _, quiet = sample(signals, odd, rng(), noisy=False)
    e = np.concatenate([noisy[c] - quiet[c] for c in ("fx1", "fy1", "fx2", "fy2")])
    assert np.std(e) == pytest.approx(1.3 * RIG.force_noise, rel=0.1)
    assert np.corrcoef(e[1:], e[:-1])[0, 1] == pytest.approx(0.3, abs=0.1)
    np.testing.assert_allclose(noisy["dq11"][1:], np.diff(noisy["q11"]) * RIG.rate)


def test_a_finger_may_close_first_and_the_truth_is_of_the_grip():
    together, apart = (
        perform(plan(TASK, BLOCKS, HEALTHY, Style(stagger=(s, s)), np.random.default_rng(4)), BLOCKS, HEALTHY)
        for s in (0.0, 0.08)
    )
    for motion in (together, apart):
        touch = np.searchsorted(motion.t, motion.boundaries[0])
        both = (motion.force[:, 0] > 2e-3) & (-motion.force[:, 2] > 2e-3)
        assert both[touch + 1] and not both[: touch - 1].any()
    pushed = lambda m: abs(m.centres[np.searchsorted(m.t, m.boundaries[0]), 0, 0] - m.centres[0, 0, 0])  # noqa: E731
    assert pushed(together) < 3e-4 < 8e-4 < pushed(apart)


def test_untidy_hands_do_what_their_row_says():
    rng = np.random.default_rng(2)
    found = {}
    for kind in ("tap", "still"):
        lab, style, world = untidy_rows()[kind]
        w = world(lab.world())
        found[kind] = perform(plan(TASK, BLOCKS, w, style(lab.style()), rng), BLOCKS, w)
    tapped = found["tap"]
    early = tapped.t < tapped.boundaries[0] - 0.05
    assert tapped.force[early, 0].max() > 0.1  # touched before the grip that counts
    assert found["still"].boundaries[2] - found["still"].boundaries[1] > 10.0


def test_sets_are_drawn_alike_and_keep_their_shares():
    assert sets.draw_cases(30, 3, RIG) == sets.draw_cases(30, 3, RIG)
    assert sets.draw_cases(30, 3, RIG) != sets.draw_cases(30, 4, RIG)
    drawn = [c.tier for c in sets.draw_cases(sum(sets.TIERS.values()), 3, RIG)]
    assert {t: drawn.count(t) for t in sets.TIERS} == sets.TIERS


def test_a_seal_is_kept_and_a_changed_label_is_caught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sets, "TRIALS", 1)
    found = generate(2, 7, tmp_path)
    again = generate(2, 7, tmp_path / "again")
    assert found != again  # salted anew
    a, b = unseal(tmp_path), unseal(tmp_path / "again")
    assert a == b
    first = tmp_path / "cases" / "case_0000"
    csv = (first / "trial_01.csv").read_text()
    assert csv == (tmp_path / "again" / "cases" / "case_0000" / "trial_01.csv").read_text()
    assert json.loads((tmp_path / "seal.json").read_text())["sha256"] == found
    allowed = {"rig.toml", "task.toml", "trial_01.csv", "actual.toml", "options.json"}
    assert {p.name for p in first.iterdir()} <= allowed
    file = tmp_path / "sealed" / "labels.json"
    labels = json.loads(file.read_text())
    labels["cases"][0]["tier"] = "other"
    file.write_text(json.dumps(labels))
    with pytest.raises(BrokenSeal, match=found):
        unseal(tmp_path)


def entry(case: str, tier: str, effects: dict, size: float = 0.5, measured: bool = True) -> dict:
    """A label made by hand: grip and fy shifted while block1 is carried."""
    row = {c: [0.0] * 9 for c in ("x", "y", "distance", "offset", "vx", "vy", "fx", "fy", "grip", "shear")}
    if effects:
        row = row | {"fy": [0.0, 0.0, 5.0, *[0.0] * 6], "grip": [0.0, 0.0, 4.0, *[0.0] * 6]}
    return {"case": case, "tier": tier, "effects": effects, "sizes": dict.fromkeys(effects, size),
            "measured": measured, "shift": [row, row], "spread": [row, row], "subtasks": TASK.subtasks,
            "world": {"rate": 20.0}, "brackets": {"rate": "20 Hz"}}  # fmt: skip


def said(verdict: str, causes: list[str], partners: list[str] = (), **more) -> dict:  # type: ignore[assignment]
    """A diagnosis made by hand."""
    name = "+".join(causes) or verdict
    effects = {c: {"parameters": more.pop("parameters", {})} for c in causes[:1]}
    body = {
        "verdict": verdict, "causes": causes, "indistinguishable": list(partners),
        "probabilities": {name: 0.95, "other": 0.05}, "effects": effects,
        "attribution": {c: {"probability": 0.95, "share": 0.9} for c in causes},
        "remainder": {"share": 0.1, "p_value": 0.5, "where": []},
        "where": [{"channel": "fy", "subtask": "carry block1"}, {"channel": "x", "subtask": "place block1"}],
        "shrinkage": None, "bic": "force_bias", "gains": {}, "seconds": 10.0,
    }  # fmt: skip
    return body | more


def test_the_scorer_counts_hand_made_results():
    interval = {"fy1": {"interval_90": [0.05, 0.15]}, "fx1": {"interval_90": [0.3, 0.4]}}
    bias = {"force_bias": {"fy1": 0.1, "fx1": 0.1}}
    lag, both = {"force_lag": {"delay": 0.1}}, {"force_bias": {}, "force_lag": {}}
    hum, dense = {"mains_hum": {"amplitude": 0.1}}, {"force_bias": {}, "force_lag": {}, "table_tilt": {}}
    rest = {"remainder": {"share": 0.5, "p_value": 0.0, "where": []}}
    wide = entry("m", "dense", dense, 0.05) | {
        "sizes": {"force_bias": 0.8, "force_lag": 0.1, "table_tilt": 0.05}
    }
    rows = [
        judge_case(entry("a", "healthy", {}), said("none", [], where=[])),
        judge_case(entry("b", "healthy", {}), said("named", ["force_lag"], where=[])),
        judge_case(entry("c", "single", bias), said("named", ["force_bias"], parameters=interval)),
        judge_case(entry("d", "single", bias), said("set", ["fingertip_mass"], ["force_bias"])),
        judge_case(entry("e", "single", bias, 0.1), said("none", [], gains={"force_bias": 2.0})),
        judge_case(entry("f", "single", lag), said("unknown", [], gains={"force_lag": 30.0})),
        judge_case(entry("g", "outside", hum), said("unknown", [])),
        judge_case(entry("h", "outside", hum), said("named", ["force_lag"], **rest)),
        judge_case(entry("i", "outside", hum), said("named", ["force_lag"])),
        judge_case(entry("j", "withheld", {"fingertip_mass": {"mass": 0.01}}), said("named", ["force_bias"])),
        judge_case(entry("k", "withheld", {"force_gain": {"gain": 0.1}}),  # measured: no partner
                   said("named", ["fingertip_compliance"])),
        judge_case(entry("l", "pair", both), said("named", ["force_bias", "force_lag"])),
        judge_case(wide, said("named", ["force_bias"])),
        judge_case(entry("n", "slight", bias), said("none", [])),
    ]  # fmt: skip
    found = figures(rows)
    table = found["table"]
    assert table["false_alarms"]["value"] == 0.5 and table["slight_none"]["value"] == 1.0
    assert table["named_right"]["count"] == 3  # e cannot be seen
    assert table["named_right"]["hits"] == 1 and table["set_right"]["hits"] == 2
    assert table["known_rejected"]["hits"] == 1
    assert (table["outside_right"]["hits"], table["outside_right"]["count"]) == (2, 3)
    assert table["withheld_right"]["value"] == 0.5
    assert table["pair_both"]["value"] == 1.0 and table["dense_dominant"]["value"] == 1.0
    assert table["coverage_90"]["value"] == 0.5
    assert table["small_none"]["value"] == 1.0
    assert table["inclusion_dense"]["value"] == pytest.approx(0.05)
    # Of each but the healthy ones: one hit, one false, one missed cell.
    assert table["location_f1"]["value"] == pytest.approx(0.5)
    assert table["bic_named"]["hits"] == 2
    assert found["brackets"]["rate"]["20 Hz"]["false_alarms"]["value"] == 0.5
    low, high = table["false_alarms"]["interval_95"]
    assert low == pytest.approx(0.0126, abs=1e-3) and high == pytest.approx(0.9874, abs=1e-3)


def test_a_recording_that_is_refused_counts_and_is_wrong():
    refused = {"error": "does not fit its task", "seconds": 1.0}
    one, two = {"force_bias": {"fy1": 0.1}}, {"force_bias": {}, "force_lag": {}}
    tiers = (
        ("healthy", {}),
        ("single", one),
        ("pair", two),
        ("outside", {"mains_hum": {}}),
        ("withheld", one),
    )
    table = figures([judge_case(entry(tier, tier, effects), refused) for tier, effects in tiers])["table"]
    assert table["false_alarms"]["value"] == 1.0 and table["errors"]["value"] == 1.0
    for name in ("named_right", "set_right", "outside_right", "withheld_right", "pair_both"):
        assert table[name]["count"] == 1 and table[name]["hits"] == 0


def test_calibration_is_right_where_probabilities_come_true():
    rng = np.random.default_rng(1)
    p = rng.random((200, 20))
    honest = calibration([[(v, rng.random() < v) for v in row] for row in p])
    vain = calibration([[(0.95, rng.random() < 0.6) for _ in row] for row in p])
    assert honest["value"] < 0.03 and vain["value"] == pytest.approx(0.35, abs=0.03)
    assert vain["interval_95"][0] < 0.35 < vain["interval_95"][1] + 0.02
