"""--patch: the corrected rig.toml reads, and the model with it reproduces a recording better."""

import json
import tomllib

import numpy as np
import pytest
from refusals import refused
from simgap_scenes import HAND, STACK

from hmmseg.io.rig import parse_rig
from simgap.gap.simulated import performed, recorded
from simgap.patch import checked, files, replayed
from simgap.world.properties import PAPER_BLOCKS
from simgap.world.replay import replay

BLOCKS = dict(PAPER_BLOCKS)
RIG = """# Our hand, measured in May.
rate = 20.0
[fingers.1]
base = [0.05, 0.17]
links = [0.12, 0.12]
[fingers.2]
base = [0.21, 0.17]
links = [0.12, 0.12]
[fingertip]
normal_stiffness = 4000.0  # from the data sheet
shear_stiffness = 2500.0
[noise]
angle = 0.0002
velocity = 0.03
force = 0.012
"""
SOFT = {"normal_stiffness": (1500.0, "N/m"), "shear_stiffness": (900.0, "N/m")}
BIAS = {"fx1": (0.15, "N"), "fy1": (-0.1, "N"), "fx2": (0.05, "N"), "fy2": (0.2, "N")}
OFFSETS = {"q11": (0.01, "rad"), "q12": (0.0, "rad"), "q21": (-0.008, "rad"), "q22": (0.004, "rad")}


def found(effects: dict[str, dict[str, tuple[float, str]]]) -> dict:
    several = len(effects) > 1
    parameters = {
        f"{name}.{k}" if several else k: {
            "mean": v, "sd": abs(v) / 50, "interval_90": [v - abs(v) / 30, v + abs(v) / 30], "unit": unit
        }
        for name, values in effects.items() for k, (v, unit) in values.items()}  # fmt: skip
    shift = {"block1.width": {"before": 0.0155, "after": BLOCKS["block1"].width, "unit": "m"}}
    return {"causes": sorted(effects), "effects": {"+".join(sorted(effects)): {
        "parameters": parameters, "property_shift": shift}}}  # fmt: skip


def test_rigs_keep_their_text_and_links_are_corrected_in_place():
    written = files(RIG, found({"fingertip_compliance": SOFT, "force_bias": BIAS}))
    text = written["rig.toml"]
    assert text.startswith("# Our hand, measured in May.\nrate = 20.0\n[fingers.1]")
    changed = [a for a, b in zip(text.splitlines(), RIG.splitlines(), strict=False) if a != b]
    normal = "normal_stiffness = 1500.0 # was 4000; 90 % interval 1450 to 1550 N/m; from the data sheet"
    assert changed == [normal,
                       "shear_stiffness = 900.0 # was 2500; 90 % interval 870 to 930 N/m"]  # fmt: skip
    rig = parse_rig(tomllib.loads(text))
    assert rig.fingertip.normal_stiffness == 1500.0
    assert rig.effects == {"force_bias": {k: v for k, (v, _) in BIAS.items()}}
    ranges = json.loads(written["ranges.json"])["parameters"]
    assert ranges["effects.force_bias.fy2"] == {"unit": "N", "mean": 0.2, "sd": 0.004,
                                                "low": pytest.approx(0.1933, abs=1e-4),
                                                "high": pytest.approx(0.2067, abs=1e-4)}  # fmt: skip
    assert ranges["fingertip.normal_stiffness"]["mean"] == 1500.0
    assert tomllib.loads(written["actual.toml"])["block1"]["width"]["value"] == BLOCKS["block1"].width
    text = files(RIG, found({"link_length": {"scale": (0.02, "1")}}))["rig.toml"]
    assert parse_rig(tomllib.loads(text)).finger(1).links == pytest.approx((0.1224, 0.1224))
    each = {"link11": (0.02, "1"), "link12": (0.0, "1"), "link21": (0.0, "1"), "link22": (-0.01, "1")}
    rig = parse_rig(tomllib.loads(files(RIG, found({"link_length": each}))["rig.toml"]))
    assert rig.finger(1).links == pytest.approx((0.1224, 0.12)) and not rig.effects
    assert rig.finger(2).links == pytest.approx((0.12, 0.1188))
    assert files(RIG, {"causes": [], "effects": {}}) == {}
    refused(r"effects\.gravity_wave", checked, {"gravity_wave": {"size": 1.0}}, "rig.toml")


@pytest.mark.parametrize("effects", [
    {"fingertip_compliance": SOFT, "force_bias": BIAS},
    {"force_lag": {"delay": (0.15, "s")}, "joint_offset": OFFSETS}])  # fmt: skip
def test_a_corrected_model_reproduces_the_recording_better(effects):
    values = {name: {k: v for k, (v, _) in table.items()} for name, table in effects.items()}
    truth = performed(STACK, HAND, [BLOCKS], [5], values)[0]
    trial, boundaries = recorded(truth, STACK, HAND, values), truth.boundaries
    before = replay(trial, STACK, HAND, BLOCKS, boundaries=boundaries)
    rig = parse_rig(tomllib.loads(files(RIG, found(effects))["rig.toml"]))
    after = replayed(trial, STACK, rig, BLOCKS, boundaries)
    rms = [float(np.sqrt(np.nanmean(r.residual**2))) for r in (before, after)]
    assert rms[1] < 0.6 * rms[0]
