"""Effects that no catalogue of the contract lists; each is something that happens to real rigs."""

from __future__ import annotations

from experiments.blind_check import outside_hand as hand
from experiments.blind_check import outside_sensors as sensors
from experiments.blind_check.effects import Change, Made, _sign
from experiments.blind_check.outside_loads import OUTSIDE as LOADS
from experiments.blind_check.outside_snags import OUTSIDE as SNAGS
from experiments.blind_check.outside_worlds import OUTSIDE as WORLDS
from experiments.blind_check.signals import ENCODER, HAND, LINKS, MIX, READOUT, SCALE


def _made(name: str, draw, stage: int, build) -> Made:
    return Made(name, draw, lambda v: Change(stages=((stage, build(v)),)), scored=False)


OUTSIDE = {
    made.name: made
    for made in (
        _made("force_hysteresis", lambda r, s: {"width": 0.4 * s}, READOUT, sensors.lazy),
        _made("mains_hum", lambda r, s: {"amplitude": 0.12 * s, "frequency": 50 + r.uniform(-1, 1) * 7},
              READOUT, sensors.hum),
        _made("zero_jump", lambda r, s: {"height": 0.25 * s * _sign(r), "channel": float(r.integers(4))},
              READOUT, sensors.jump),
        _made("magnetic_table", lambda r, s: {"pull": 0.7 * s, "reach": r.uniform(0.006, 0.012)},
              HAND, hand.magnet),
        _made("kinked_gain", lambda r, s: {"change": 0.3 * s * _sign(r), "load": r.uniform(0.8, 1.6)},
              SCALE, sensors.kinked),
        _made("encoder_ripple", lambda r, s: {"amplitude": 0.006 * s, "periods": float(r.integers(9, 22))},
              ENCODER, hand.ripple),
        _made("dry_sleeve", lambda r, s: {"force": 0.16 * s}, HAND, hand.dry),
        _made("settling_gain", lambda r, s: {"change": 0.15 * s * _sign(r), "time": r.uniform(1.0, 3.0)},
              SCALE, sensors.settling),
        _made("sensor_creep", lambda r, s: {"share": 0.1 * s * _sign(r), "time": r.uniform(0.4, 2.0)},
              SCALE, sensors.creeping),
        _made("finger_leak", lambda r, s: {"share": 0.06 * s * _sign(r)}, SCALE, sensors.leaking),
        _made("zero_wander", lambda r, s: {"rms": 0.18 * s, "time": r.uniform(0.2, 0.6)},
              READOUT, sensors.wandering),
        _made("late_board", lambda r, s: {"age": 0.015 * s}, READOUT, sensors.behind),
        _made("tacky_pads", lambda r, s: {"pull": 0.8 * s, "reach": r.uniform(0.003, 0.006)},
              HAND, hand.tacky),
        _made("flickering_supply", lambda r, s: {"loss": 0.5 * s, "finger": float(r.integers(2)),
                                                 "apart": r.uniform(0.3, 0.6),
                                                 "lasting": r.uniform(0.06, 0.15)},
              SCALE, sensors.flickering),
        _made("missed_counts", lambda r, s: {"missed": 0.08 * s, "speed": r.uniform(0.25, 0.5)},
              ENCODER, hand.uncounted),
        _made("soft_guard", lambda r, s: {"stiffness": 45 * s, "place": r.uniform(0.138, 0.15),
                                          "friction": r.uniform(0.2, 0.5)},
              HAND, hand.curtained),
        _made("clinging_feet", lambda r, s: {"pull": 1.6 * s, "reach": r.uniform(0.003, 0.008),
                                             "build": r.uniform(0.1, 0.2)},
              HAND, hand.clinging),
        _made("tendon_coupling", lambda r, s: {"share1": 0.04 * s * _sign(r),
                                               "share2": 0.04 * s * _sign(r) * r.uniform(0.5, 1)},
              ENCODER, hand.tendons),
        _made("gear_cogging", lambda r, s: {"torque": 0.018 * s, "teeth": float(r.integers(20, 41))},
              MIX, sensors.cogging),
        _made("rectified_drives", lambda r, s: {"height": 0.45 * s * _sign(r), "share": r.uniform(-1, 1),
                                                "speed": r.uniform(0.3, 0.6)},
              READOUT, sensors.rectified),
        _made("skewed_bending", lambda r, s: {"give1": 2e-4 * s * _sign(r),
                                              "give2": 2e-4 * s * r.uniform(-1, 1)},
              LINKS, hand.bending),
        _made("jet_from_above", lambda r, s: {"push": 0.5 * s, "place": r.uniform(0.09, 0.15),
                                              "radius": r.uniform(0.012, 0.025),
                                              "slant": r.uniform(-0.6, 0.6)},
              HAND, hand.nozzle),
        _made("turning_tare", lambda r, s: {"weight1": 0.9 * s * r.uniform(0.6, 1),
                                            "weight2": 0.9 * s * r.uniform(0.6, 1)},
              MIX, sensors.tared),
        _made("rolling_tips", lambda r, s: {"radius": 0.004 * s, "x": r.uniform(0.1, 0.14),
                                            "y": r.uniform(0.01, 0.04)},
              LINKS, hand.rolling),
        _made("tied_wiring", lambda r, s: {"stiffness": 30 * s, "slack": r.uniform(0.022, 0.028)},
              HAND, hand.tied),
        _made("lost_frames", lambda r, s: {"lasting": 0.25 * s, "apart": r.uniform(0.4, 0.8),
                                           "finger": float(r.integers(2))},
              READOUT, sensors.frozen),
        _made("slipping_hub", lambda r, s: {"angle": 0.02 * s, "joint": float(r.integers(4))},
              ENCODER, hand.loosened),
        _made("near_field", lambda r, s: {"height": 0.8 * s, "share": r.uniform(0.2, 1),
                                          "lean1": r.uniform(-0.6, 0.6), "lean2": r.uniform(-0.6, 0.6)},
              READOUT, sensors.capacitive),
        _made("blunt_rates", lambda r, s: {"time": 0.12 * s}, ENCODER, hand.blunted),
        _made("stuck_bit", lambda r, s: {"bit": 0.35 * s, "value": float(r.integers(2)),
                                         "finger": float(r.integers(2)),
                                         "origin1": r.uniform(0, 2), "origin2": r.uniform(0, 2)},
              READOUT, sensors.stuck),
        _made("crumpling_blocks", lambda r, s: {"give": 3e-4 * s, "bears": r.uniform(0.3, 1.0)},
              LINKS, hand.crumpled),
        _made("knocked_bench", lambda r, s: {"amplitude": 0.6 * s, "knocks": float(r.integers(4, 8)),
                                             "frequency": r.uniform(2.5, 6), "decay": r.uniform(0.12, 0.3)},
              HAND, hand.knocked),
        _made("ground_loop", lambda r, s: {"height": 0.35 * s * _sign(r), "load": r.uniform(0.05, 0.3),
                                           "share1": r.uniform(-1, 1), "share2": r.uniform(-1, 1),
                                           "share3": r.uniform(-1, 1)},
              READOUT, sensors.grounded),
        _made("sagging_clamp", lambda r, s: {"angle": 0.02 * s, "x": r.uniform(-0.05, 0.03),
                                             "y": r.uniform(0.2, 0.3)},
              LINKS, hand.sagging),
    )
} | WORLDS | LOADS | SNAGS  # fmt: skip
