"""A task followed while it runs: the same physics as off line, nothing looked ahead, nothing lost."""

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from estimation.identification import identify_aligned
from experiments.wrist import ARM_RIG
from experiments.wrist_scene import BLOCKS, Setup, performances, wrist_recording, wrist_rig
from experiments.wrist_scene import TASK as RESTACK
from hmmseg.contact.decompose import ABOVE_GROUND, FREE, ON_GROUND, subtasks
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.formats import read_table
from hmmseg.io.rig import Rig
from hmmseg.io.task import Task, read_task
from hmmseg.io.trial import Trial, trial_of
from hmmseg.online import hypothesis as one
from hmmseg.online.hypotheses import Table, absorb
from hmmseg.online.hypothesis import HYPOTHESIS, RANGES, READING
from hmmseg.online.watcher import Watcher
from hmmseg.online.wrist import Opening
from hmmseg.segmentation.align import align, segment
from hmmseg.segmentation.emissions import STILL, Parameters, _log_halting, features, log_likelihoods
from hmmseg_cli.main import main

RECORDINGS = Path(__file__).parents[2] / "recordings"
CASE = RECORDINGS / "paper_blocks"
TASK, RIG = CASE / "task.toml", CASE / "rig.toml"
NONE = RECORDINGS / "none_1"
TRUTH = json.loads((CASE / "truth" / "trial_01.json").read_text())["boundaries"]
SETUP = Setup(rate=20.0, reaction=True, offset=(3.0, -2.0, 8.0))  # untared


def read(file=CASE / "trial_01.csv", rig=RIG):
    trial, watcher = Trial.read(file, rig), Watcher(file.parent / "task.toml", rig)
    table = np.stack([trial.channels[name] for name in watcher.channels], axis=1)
    return watcher, trial.t, table


def follow(watcher, t, table):
    return [json.loads(watcher.update(at, row).line()) for at, row in zip(t.tolist(), table, strict=True)]


@pytest.fixture(scope="module")
def watched():
    watcher, t, table = read()
    lines = follow(watcher, t, table)
    return watcher, lines, json.loads(watcher.finish().line())


def test_emissions_are_those_off_line():
    rig, task = Rig.read(RIG), Task.read(TASK)
    trial = Trial.read(CASE / "trial_01.csv", rig)
    f = features(task_space(trial, rig), rig)
    scale = {"force": 0.012, "carry": 0.02, "net_x": 0.05, "shear": 0.08, "velocity": 0.003, "level": 1e-4,
             "width": 1e-4}  # fmt: skip
    steps, bias = subtasks(task), np.array([0.01, -0.02, 0.005, 0.0])
    p = Parameters(bias, {"block1": 0.34, "block2": 0.44}, scale, {"block1": 0.016, "block2": 0.0254},
                   ({1: 0.05},))  # fmt: skip
    expected, halting = log_likelihoods(f, steps, p, 0, rung=0.0), _log_halting(f, p)
    rows = np.zeros(1, HYPOTHESIS)
    sure = 1e14  # precision of what is known
    rows["bias"][0] = np.stack([bias * sure, np.full(4, sure)], axis=1)
    rows["scale"][0] = np.stack([np.square([*scale.values()]), np.ones(7)], axis=1)
    rows["level"] = 0.05 * sure, sure
    h, known = rows[0], np.array([[v, 1] for v in (0.34, 0.016, 0.44, 0.0254)]) * sure
    span = np.array([tuple(f.span[name] for name in RANGES.names)], RANGES)[0]
    for n in range(0, f.t.size, 3):
        x = np.array([(f.t[n], f.force[n], f.vx[n], f.vy[n], f.ay[n], f.y[n], f.d[n], f.sd_y[n], f.sd_d[n],
                       f.sd_vx[n], f.sd_vy[n], f.y[n - 1] if n else np.nan, np.nan, np.nan,
                       f.force[n], 0.0, 0.0, 1.0)], READING)[0]  # fmt: skip
        for step in steps[:4]:
            if step.state == FREE:
                found, halt = one.free(h, x, span), one.STILL
            else:
                found, halt = one.held(h, known, 0, x, span, f.pads), 0.0
                if step.state == ON_GROUND:
                    found += one.supported(h, known, one.GROUND_KIND, 0, x, span, f.pads, step.index == 1)
                else:
                    assert step.state == ABOVE_GROUND
                    found += one.lifted(h, known, 0, x, span, f.gravity, 0.0)
                    halt = one.STILL * one.JUST_LIFTED
            aside, upward = one._halting(h, x, span)
            more = aside + upward
            np.testing.assert_allclose(more, halting[n], rtol=1e-6, atol=1e-6)
            if step.state in (FREE, ABOVE_GROUND):  # how often, and in what, a hand halts differs
                each = 1 - one.STILL + one.STILL * np.exp(aside), 1 - halt + halt * np.exp(upward)
                found -= np.log((1 - halt) * each[0] * each[1] + halt * np.exp(more))
                found += np.logaddexp(np.log1p(-STILL), np.log(STILL) + more)
            np.testing.assert_allclose(found, expected[n, step.index], rtol=1e-6, atol=1e-6)


def test_answers_of_a_watched_task_agree_with_those_off_line_and_tighten(watched):
    watcher, lines, final = watched
    assert len(lines) == 200
    wanted = {"t", "subtask", "object", "state", "probabilities", "next", "properties", "fits"}
    for line in lines:
        assert wanted <= set(line) and len(line["probabilities"]) == 9
        assert sum(line["probabilities"]) + line["departed"] == pytest.approx(1, abs=1e-5) and line["fits"]
    assert lines[0]["subtask"] == "pregrasp" and lines[0]["next"]["subtask"] == "pickup"
    assert lines[-1]["next"] is None and final["final"] is True and final["fits"]
    trial = Trial.read(CASE / "trial_01.csv", RIG)
    off_line = segment([trial], Task.read(TASK), Rig.read(RIG))[0].spans
    assert [c.step.name for c in watcher.crossings] == [s.subtask for s in off_line[1:]]
    for crossing, span, true in zip(watcher.crossings, off_line[1:], TRUTH, strict=True):
        assert abs(crossing.t - span.start) < 2 * np.hypot(crossing.sd, span.start_sd)
        assert abs(crossing.t - true) < 3 * crossing.sd
    blocks = final["properties"]
    assert blocks["block1"]["weight"]["mean"] == pytest.approx(0.343, abs=0.02)
    assert blocks["block2"]["width"]["mean"] == pytest.approx(0.0254, abs=2e-4)
    assert blocks["block1"]["height"]["mean"] == pytest.approx(0.016, abs=2e-4)
    sds = [line["properties"]["block1"]["weight"]["sd"] for line in lines
           if "weight" in line["properties"].get("block1", {}) and 2.5 < line["t"] < 3.7]  # fmt: skip
    assert sds[-1] < 0.7 * sds[0]


def test_nothing_is_looked_ahead_and_late_and_repeated_rows_lose_nothing(watched):
    _, lines, _ = watched
    watcher, t, table = read()
    table[120:] = table[:80]
    assert follow(watcher, t[:120], table[:120]) == lines[:120]
    straight, _, final = watched
    watcher, t, table = read()
    order = [*range(50), 52, 51, 50, 50, *range(53, 120), 122, 120, 121, *range(123, 200)]
    lines = follow(watcher, t[order], table[order])
    notes = [line["note"].split(":")[0] for line in lines if "note" in line]
    assert notes == ["late", "late", "repeated", "late", "late"]
    assert watcher.counts["late"] == 4 and watcher.counts["repeated"] == 1
    found = json.loads(watcher.finish().line())
    assert [c.step.name for c in watcher.crossings] == [c.step.name for c in straight.crossings]
    for a, b in zip(watcher.crossings, straight.crossings, strict=True):
        assert a.t == pytest.approx(b.t, abs=1e-6)
    assert_alike(found["properties"], final["properties"])


def test_what_cannot_be_watched_is_refused_and_a_smaller_lag_settles_sooner():
    settled = {}
    for lag in (0.1, 1.0):
        _, t, table = read()
        watcher = Watcher(TASK, RIG, lag)
        for at_, row in zip(t, table, strict=True):
            watcher.update(at_, row)
            if watcher.crossings:
                settled[lag] = at_
                break
    assert settled[0.1] < settled[1.0] <= TRUTH[0] + 1.0 + 0.15
    refused("plain ordered task", Watcher, {"sequence": ["a", "b"]}, RIG)
    refused("lag", Watcher, TASK, RIG, -1.0)
    refused("expected", Watcher(TASK, RIG).update, 0.0, [1.0], error=ValueError)


def test_a_block_let_go_in_mid_air_and_an_early_end_do_not_fit(watched):
    _, t, table = read()
    cut = int(np.searchsorted(t, 3.0))
    rest = int(np.searchsorted(t, 4.6))  # what free motion looks like
    table = np.vstack([table[:cut], table[rest : rest + 30]])
    lines = follow(Watcher(TASK, RIG), t[: len(table)], table)
    assert all(line["fits"] for line in lines[:cut]) and not lines[-1]["fits"]
    assert lines[-1]["failed"]["subtask"] == "place"
    watcher, t, table = read()
    for at_, row in zip(t[:100], table[:100], strict=True):
        answer = watcher.update(at_, row)
    assert answer.fits
    final = json.loads(watcher.finish().line())
    assert not final["fits"] and final["failed"]["index"] == 5


@pytest.mark.parametrize("again", [False, True])
def test_a_hand_that_waits_has_not_left_its_task(again):
    """Neither open, for longer than a departure is unlikely, nor with a known block that it rests to lift."""
    watcher, t, table = read()
    start, grip, end = np.searchsorted(t, [TRUTH[0] - 0.3, TRUTH[0] + 0.15, TRUTH[3] + 0.3])
    order, wait = np.arange(t.size), end
    if again:
        objects = {"block1": {"on": "block2"}, "block2": {"on": "ground"}}
        task = {"objects": objects, "moves": [{"object": "block1", "to": "ground"}] * 2}
        watcher, order, wait = Watcher(Task.read(task), RIG), np.r_[:end, start:end], end + grip - start
    noise = Rig.read(RIG).noise
    sd = np.tile(np.repeat([noise.angle, noise.velocity, noise.force], 2), 2)
    still = np.random.default_rng(1).normal(table[order[wait]], sd, (400, sd.size))  # 20 s
    still[:, [5, 11]] -= still[:, [5, 11]].mean(axis=0)  # nothing is lifted yet
    table = np.vstack([table[order[:wait]], still, table[order[wait:]]])
    lines = follow(watcher, (t[1] - t[0]) * np.arange(len(table)), table)
    assert max(line["departed"] for line in lines) < 0.5 and json.loads(watcher.finish().line())["fits"]


def assert_alike(one, other):
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_alike(one[key], other[key])
    elif isinstance(one, str) or one is None:
        assert one == other
    else:
        assert one == pytest.approx(other, rel=1e-5)


def test_gaps_rows_beyond_the_lag_and_missing_channels_are_told_and_pass():
    watcher, t, table = read()
    keep = (t < 1.0) | (t > 1.3)
    lines = follow(watcher, t[keep], table[keep])
    assert [line["note"] for line in lines if "note" in line] == ["gap: 0.4 s since the row before"]
    assert "too late" in watcher.update(0.5, table[10] + 1e-3).note
    watcher, t, table = read()
    table[10:14, 3] = np.nan
    table[60:63] = np.nan
    lines = follow(watcher, t, table)
    assert lines[-1]["fits"] and json.loads(watcher.finish().line())["fits"]


@pytest.mark.parametrize(("name", "measure"), [("fx1", "block_width"), ("fy2", "block_y")])
def test_a_missing_force_is_taken_to_be_the_other_fingers(name, measure):
    trial, rig = Trial.read(NONE / "trial_01.csv", NONE / "rig.toml"), Rig.read(NONE / "rig.toml")
    lost = replace(trial, channels=trial.channels | {name: np.full(trial.t.size, np.nan)})
    whole, without = (getattr(features(task_space(x, rig), rig), measure)(np.zeros(4)) for x in (trial, lost))
    assert np.median(np.abs(without - whole)) < 5e-5 < np.quantile(np.abs(trial.channels[name]), 0.9) / 2500


@pytest.mark.parametrize("names", [("fx1", "fy1"), ("fx1", "fy1", "fx2", "fy2")])
def test_a_block_is_not_dropped_where_forces_are_not_read(names):
    """A distance without the pads' give would be that of another block."""
    watcher, t, table = read(NONE / "trial_01.csv", NONE / "rig.toml")
    lifted, landed = json.loads((NONE / "truth" / "trial_01.json").read_text())["boundaries"][1:3]
    gone = (t > lifted + 0.3) & (t < lifted + 0.8 * (landed - lifted))
    columns = [watcher.channels.index(name) for name in names]
    table[np.ix_(gone, columns)] = np.nan
    lines = follow(watcher, t, table)
    assert all(line["fits"] for line in lines)


def test_hypotheses_do_not_grow_with_time_and_a_clock_that_leaps_leaves_few():
    watcher, t, table = read()
    sizes = []
    for again in range(5):  # ever further free motion after the end
        for at_, row in zip(t[:30], table[:30], strict=True):
            watcher.update(again * 2.0 + at_, row)
        sizes.append((len(watcher.filter.rows), watcher.filter._state.count))
    assert len({rows for rows, _ in sizes[1:]}) == 1 and max(count for _, count in sizes) < 100
    watcher, t, table = read()
    for at, row in zip([*t[:60], 3.9e7, 3.9e7 + 0.05, *t[60:80], 1e12], table[:83], strict=True):
        watcher.update(float(at), row)
        state = watcher.filter._state
        mine = {(h["state"], h["entered"][0]) for h in state.rows[: state.count]}
        assert len(mine) == state.count


def test_two_hypotheses_merge_to_the_moments_of_their_mixture_and_keep_a_common_time():
    rng = np.random.default_rng(0)
    share, mean, sd = np.array([0.3, 0.7]), np.array([1.0, 1.6]), np.array([0.05, 0.1])
    rows = np.zeros(2, HYPOTHESIS)
    rows["weight"] = np.log(share) - 2.0
    moments = [rows["entered"], rows["origin"], rows["ring"][:, 0]]
    for each in moments:
        each[:, 0], each[:, 1] = mean, sd**2
    table = Table(rows, np.ones((2, 8, 2)))
    absorb(table, 0, table, 1)
    drawn = np.where(rng.uniform(size=400_000) < share[0], *(m + s * rng.standard_normal(400_000)
                     for m, s in zip(mean, sd, strict=True)))  # fmt: skip
    assert rows["weight"][0] == pytest.approx(-2.0)
    for each in moments:
        assert each[0, 0] == pytest.approx(drawn.mean(), abs=2e-3)
        assert each[0, 1] == pytest.approx(drawn.var(), rel=0.01)
    for share in np.linspace(0.05, 0.95, 19):
        rows = np.zeros(2, HYPOTHESIS)
        rows["weight"], rows["entered"][:, 0] = np.log([share, 1 - share]), 1.7e12 / 3
        absorb(Table(rows, np.ones((2, 8, 2))), 0, Table(rows.copy(), np.ones((2, 8, 2))), 1)
        assert rows["entered"][0, 0] == rows["entered"][1, 0]


@pytest.fixture(scope="module")
def performed():
    simulated = performances(2)[1]
    return simulated, wrist_recording(simulated, SETUP, 1)


def follow_wrist(columns, rig, task=RESTACK, stop=None):
    watcher, lines = Watcher(task, rig), []
    for k, t in enumerate(columns["t"][:stop]):
        lines.append(json.loads(watcher.update(float(t), {n: columns[n][k]
                                                          for n in watcher.channels}).line()))  # fmt: skip
    return watcher, lines, json.loads(watcher.finish().line())


@pytest.fixture(scope="module")
def watched_wrist(performed):
    return follow_wrist(performed[1], wrist_rig(SETUP))


def test_the_last_answer_agrees_with_that_off_line(performed, watched_wrist):
    simulated, columns = performed
    watcher, _, final = watched_wrist
    rig = wrist_rig(SETUP)
    aligned = align([read_trial(columns, rig)], RESTACK, rig)
    spans, identified = aligned.segmentations[0].spans, identify_aligned(aligned)
    assert final["fits"] and [c.step.name for c in watcher.crossings] == [s.subtask for s in spans[1:]]
    for crossing, span, true in zip(watcher.crossings, spans[1:], simulated.boundaries, strict=True):
        assert abs(crossing.t - span.start) < 3 * np.hypot(crossing.sd, span.start_sd)
        assert abs(crossing.t - true) < 3 * crossing.sd
    for obj, block in BLOCKS.items():
        for prop in ("weight", "width", "height"):
            found, draws = final["properties"][obj][prop], identified.of(obj, prop)
            assert abs(found["mean"] - draws.mean()) < 3 * np.hypot(found["sd"], draws.std())
            assert abs(found["mean"] - getattr(block, prop)) < 3 * found["sd"]
        assert final["properties"][obj]["width"]["sd"] > 1e-4  # what the pads give is not measured


def test_a_block_carried_aside_at_one_height_is_not_put_down():
    simulated, setup = performances(1)[0], Setup()
    watcher, _, final = follow_wrist(wrist_recording(simulated, setup), wrist_rig(setup))
    assert final["fits"]
    for crossing, true in zip(watcher.crossings, simulated.boundaries, strict=True):
        assert abs(crossing.t - true) < 3 * crossing.sd


def test_nothing_is_known_before_the_first_grip_and_nothing_is_looked_ahead(performed, watched_wrist):
    _, columns = performed
    _, lines, _ = watched_wrist
    first = next(i for i, line in enumerate(lines) if line["properties"])
    assert lines[first]["t"] > 2.0  # it grips at 2.4 s
    assert all(line["subtask"] == "pregrasp" and line["probabilities"][0] == 1 for line in lines[:20])
    cut = 150
    ahead = columns | {name: np.r_[c[:cut], c[cut:][::-1]] for name, c in columns.items() if name != "t"}
    _, again, _ = follow_wrist(ahead, wrist_rig(SETUP), stop=cut)
    assert again == lines[:cut]


def test_pauses_on_the_way_to_a_grip_are_taken_back(performed):
    _, columns = performed
    early = columns | {"gap": columns["gap"].copy()}
    t, gap = early["t"], early["gap"]
    before = t < 1.9
    gap[before] = np.minimum(gap[before], 0.052 - 0.006 * np.clip((t[before] - 0.7) / 0.1, 0, 1))
    watcher, _, final = follow_wrist(early, wrist_rig(SETUP))
    assert final["fits"], final["failed"]
    assert watcher.crossings[0].t > 1.9
    simulated, columns = performed
    slow = columns | {"gap": columns["gap"].copy()}
    t, gap = slow["t"], slow["gap"]
    on_its_way = (t > 6.95) & (t < 9.3)
    left = 1 - sum(np.clip((t[on_its_way] - at) / 0.4, 0, 1) for at in (7.2, 7.7, 8.2)) / 3
    gap[on_its_way] += 0.03 * left * np.clip((t[on_its_way] - 6.95) / 0.2, 0, 1)
    watcher, _, final = follow_wrist(slow, wrist_rig(SETUP))
    assert final["fits"], final["failed"]
    assert watcher.crossings[4].t == pytest.approx(simulated.boundaries[4], abs=0.05)


def test_drifting_sensors_and_a_first_grip_without_free_motion_are_told(performed):
    simulated, _ = performed
    setup = Setup(rate=20.0, drift=0.02)
    _, _, final = follow_wrist(wrist_recording(simulated, setup, 1), wrist_rig(setup))
    for obj, block in BLOCKS.items():
        found = final["properties"][obj]["weight"]
        assert abs(found["mean"] - block.weight) < 3 * found["sd"]
    _, columns = performed
    late = {name: c[columns["t"] > 1.7] for name, c in columns.items()}
    refused("no free motion", follow_wrist, late, wrist_rig(SETUP))


def test_an_opening_is_read_as_it_comes():
    t = np.arange(0, 3, 0.01)
    way = 0.05 - 0.1 * np.clip(t - 0.5, 0, None)
    held = 0.029 + 0.001 * np.exp(-(t - 0.7) / 0.03)
    opening = np.where(way > 0.03, way, held) + np.where(t > 2, 0.1 * (t - 2), 0)
    closings, known = Opening(3000.0), []
    for at, value in zip(t, opening, strict=True):
        closings.follow(float(at), float(value))
        known.append(closings.known)
    assert closings.number == 1
    grip = closings.grips[-1]
    assert grip.grip.width == pytest.approx(0.03, abs=3 * grip.grip.width_sd)
    assert grip.start == pytest.approx(0.7, abs=0.03) and grip.stop == pytest.approx(2.0, abs=0.03)
    assert (np.diff(known) >= 0).all() and (t - known).max() < 0.3
    assert closings.free(np.array([0.3, 1.0]), np.array([0.05, 0.029])).tolist() == [True, False]


@pytest.mark.parametrize("give", [1e-3, 3e-3])
def test_a_grip_lasts_until_its_pads_let_go(give):
    """However far they have yielded: a gripper has turned long before."""
    t = np.arange(0, 3, 0.01)
    way = np.maximum(0.036 - 0.1 * np.clip(t - 0.5, 0, None), 0.03 - give)
    opening, closings = way + 0.1 * np.clip(t - 2, 0, None), Opening(3000.0)
    for at, value in zip(t, opening, strict=True):
        closings.follow(float(at), float(value))
    (grip,) = closings.grips
    before, after = opening[np.searchsorted(t, grip.stop) - np.array([1, 0])]
    assert before <= grip.grip.width < after


def test_a_load_that_vanishes_is_told_within_half_a_second(shared):
    """As when a block drops out of the grip in mid-air; what is smoothed errs alike, but not so much."""
    folder = shared / "panda" / "wrist_restack_1"
    raw = trial_of(read_table(folder / "wrist_01.csv", None), ARM_RIG, None)
    columns, gone = {"t": raw.t} | raw.channels, (raw.t > 4.36) & (raw.t < 5.78)
    columns["Fz"] = columns["Fz"] + 0.466 * gone
    _, lines, final = follow_wrist(columns, ARM_RIG, read_task(folder / "task.toml"))
    assert not final["fits"]
    first = next(line["t"] for line in lines if not line["fits"])
    assert 4.36 < first < 4.86


def test_the_command_follows_a_wrist(performed, monkeypatch, capsys, tmp_path):
    _, columns = performed
    (tmp_path / "task.toml").write_text(
        '[objects.a]\non = "b"\n[objects.b]\non = "ground"\n[[moves]]\nobject = "a"\nto = "ground"\n'
        '[[moves]]\nobject = "b"\nto = "a"\n'
    )
    (tmp_path / "rig.toml").write_text(
        '[gripper]\nposition = ["px", "py", "pz"]\nopening = "gap"\nwrench = ["Fx", "Fy", "Fz"]\n'
        "[fingertip]\nnormal_stiffness = 4000.0\nshear_stiffness = 2500.0\n"
    )
    rows = [",".join(columns),
            *(",".join(f"{v:.9g}" for v in row) for row in zip(*columns.values(), strict=True))]  # fmt: skip
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO("\n".join(rows).encode() + b"\n")))
    code = main(["watch", "--task", str(tmp_path / "task.toml"), "--rig", str(tmp_path / "rig.toml")])
    out, err = capsys.readouterr()
    assert code == 0 and err == ""
    lines = [json.loads(line) for line in out.splitlines()]
    assert len(lines) == len(rows) and lines[-1]["fits"]
