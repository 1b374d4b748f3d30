"""A simulator read from a user's file, and every line that says what is wrong with one."""

import sys

import numpy as np
import pytest
from refusals import refused

from simgap.robots.rows import estimate_noise
from simgap.simulators.protocol import Job, Simulator, run_all
from simgap.simulators.recording import Recording, read_recording
from simgap.simulators.user import load_simulator, restarts

GOOD = """
parameters = {"slope": {"nominal": 1.0, "sd": 0.1, "unit": "1/s", "low": 0.0}}
channels = {
    "u": {"unit": "rad", "kind": "command"},
    "y": {"unit": "rad", "kind": "position", "noise": 1e-3},
}

class Robot:
    parameters, channels = parameters, channels
    def simulate(self, parameters, recording, start=None):
        return {"y": parameters["slope"] * (recording.t - recording.t[0]) + (start or {"y": 0.0})["y"]}

def open_loop(parameters, recording):
    return {"y": parameters["slope"] * recording["u"]}
open_loop.parameters, open_loop.channels = parameters, channels
thing = Robot()
number = 3
"""
RUN = """
import sys, time
import numpy as np
parameters = {"slope": {"nominal": 1.0, "sd": 0.1}}
channels = {"y": {"unit": "rad", "kind": "position", "noise": 1e-3}}
def run(parameters, recording, start=None):
    %s
run.parameters, run.channels, run.timeout = parameters, channels, 0.5
"""
LOG = Recording("a.csv", np.arange(3.0), {"y": np.ones(3)})


@pytest.fixture
def file(tmp_path):
    def write(text: str = GOOD):
        path = tmp_path / "robot.py"
        path.write_text(text)
        return path

    return write


@pytest.mark.parametrize(("name", "restarted"), [("Robot", True), ("thing", True), ("open_loop", False)])
def test_classes_objects_and_functions_will_do(file, name, restarted):
    simulator = load_simulator(f"{file()}:{name}")
    assert isinstance(simulator, Simulator) and restarts(simulator) is restarted
    assert simulator.parameters["slope"].sd == 0.1 and simulator.channels["u"].kind == "command"


def test_runs_may_diverge_or_be_interrupted_and_what_is_alike_will_do(file):
    simulator = load_simulator(f"{file()}:open_loop")
    log = Recording("a.csv", np.arange(3.0), {"u": np.ones(3)})
    found = run_all(simulator, [Job({"slope": 2.0}, log, None), Job({"slope": np.inf}, log, None)])
    assert found[0] is not None and found[0]["y"].tolist() == [2.0, 2.0, 2.0] and found[1] is None
    with pytest.raises(KeyboardInterrupt):
        load_simulator(f"{file(RUN % 'raise KeyboardInterrupt')}:run").simulate({}, LOG)
    for good in ("[1, 2, True]", "recording.t.astype(np.float32)", "np.array([1, 2, 3], object)"):
        code = f"return {{'y': {good}, 'more': 'text'}}"
        found = load_simulator(f"{file(RUN % code)}:run").simulate({}, LOG)
        assert found["y"].dtype == float and list(found) == ["y"]


@pytest.mark.parametrize(("name", "text", "line"), [
    ("Robt", GOOD, r"has no Robt; expected one of .*did you mean Robot\?"),
    ("number", GOOD, "has no mapping 'parameters'; expected parameters, channels and simulate"),
    ("Robot", "x = 1\nraise KeyError('x')", r"robot\.py, line 2: KeyError: 'x'; expected a file"),
    ("Robot", "import sys\nsys.exit(0)", r"robot\.py, line 2: SystemExit: 0; expected a file that runs"),
    ("Robot", "def f(:\n", r"robot\.py, line 1: SyntaxError: "),
    ("Robot", GOOD.replace("1.0,", "10**400,"), "parameter slope: int too large"),
    ("Robot", GOOD.replace("class Robot:", "class Robot:\n    by_log = 5"), "AttributeError"),
    ("Robot", GOOD + "Robot.parameters = property(lambda self: 1 / 0)", r"line 18: ZeroDivisionError"),
    ("Robot", GOOD.replace('"sd": 0.1', '"sd": 0.0'), "slope: nominal 1.0 and sd 0.0: expected"),
    ("Robot", GOOD.replace('"low": 0.0', '"low": 2.0'), "parameter slope: nominal 1.0 lies outside of"),
    ("Robot", GOOD.replace('"sd": 0.1', '"std": 0.1'), r"slope: std: unknown key; .*did you mean sd\?"),
    ("Robot", GOOD.replace("position", "place"), "channel y: kind 'place': expected one of position,"),
    ("Robot", GOOD.replace("1e-3", "-1e-3"), "channel y: noise -0.001: expected above 0"),
    ("Robot", GOOD.replace("position", "command"), "no channel to compare"),
    ("Robot", GOOD.replace("class Robot:", "class Robot:\n    numerics = {'slop'}"), "no parameter slop"),
    ("Robot", GOOD.replace("class Robot:", "class Robot:\n    window = 0"), "window: 0; expected"),
    ("Robot", GOOD.replace("def simulate", "def run"), "cannot be run; expected a method simulate"),
])  # fmt: skip
def test_what_is_wrong_is_said_in_a_line(file, name, text, line):
    refused(line, load_simulator, f"{file(text)}:{name}")


@pytest.mark.parametrize(("code", "line"), [
    ("raise ValueError('no\\nsuch motor')", r"robot\.py, line 7: ValueError: no such motor$"),
    ("sys.exit(0)", r"robot\.py, line 7: SystemExit: 0"),
    ("return np.linalg.inv(np.zeros((2, 2)))", r"robot\.py, line 7: LinAlgError"),
    ("parameters['slop']", r"robot\.py, line 7: KeyError: 'slop'"),
    ("recording.t[0] = 7", r"robot\.py, line 7: ValueError: assignment destination is read-only"),
    ("return None", r"robot\.py, line 6: gave None; expected a dict of channels"),
    ("return {}", r"robot\.py, line 6: gave no channel 'y'; expected y"),
    ("return {'y': recording.t[1:]}", r"line 6: channel y: gave an array \(2,\) of float64; "),
    ("return {'y': 1.0}", r"channel y: gave float '1.0'; expected 3 numbers"),
    ("return {'y': None}", r"channel y: gave None; expected 3 numbers"),
    ("return {'y': ['a', 'b', 'c']}", r"channel y: gave list of 3; expected real numbers"),
    ("return {'y': [1, None, 10**400]}", r"channel y: gave list of 3; expected real numbers"),
    ("return {'y': recording.t * 1j}", r"of complex128; expected real numbers"),
    ("return {'y': [[1], [2, 3], 4]}", r"robot\.py.*: ValueError"),
    ("while True: time.sleep(0.01)", r"robot\.py, line 7: took more than 0.5 s; expected a run"),
])  # fmt: skip
def test_whatever_a_run_does_is_said_in_a_line_that_names_its_place(file, code, line):
    simulator = load_simulator(f"{file(RUN % code)}:run")
    refused(line, run_all, simulator, [Job({"slope": 2.0}, LOG, None)])
    assert LOG.t[0] == 0


@pytest.mark.parametrize(("name", "code", "line"), [
    ("simulate_many", "return []", "gave 0 runs; expected 1, one for each job"),
    ("simulate_many", "return [{'y': [1]}]", "channel y: gave list of 1; expected 3 numbers"),
    ("simulate_many", "return 3", "TypeError"),
    ("state_at", "return {'y': 1.0}", r"expected \{state: \(value, standard deviation\)\}"),
    ("state_at", "return {'y': (float('nan'), 1.0)}", "state y: nan with standard dev"),
    ("contacts", "return None", r"gave None; expected times \[s\] in one row"),
    ("contacts", "exit(3)", "line 10: SystemExit: 3")])  # fmt: skip
def test_what_else_a_simulator_offers_is_checked_alike(file, name, code, line):
    text = RUN % "return {'y': recording.t}" + f"def more(*args):\n    {code}\nrun.{name} = more\n"
    simulator = load_simulator(f"{file(text)}:run")
    given = {"simulate_many": ([Job({"slope": 2.0}, LOG, None)],), "state_at": (LOG, 0.0), "contacts": (LOG,)}
    refused(line, getattr(simulator, name), *given[name])


def test_a_file_is_read_by_its_own_name_whatever_it_is_called(tmp_path):
    import scipy

    (tmp_path / "scipy.py").write_text(GOOD)
    load_simulator(f"{tmp_path / 'scipy.py'}:Robot")
    assert sys.modules["scipy"] is scipy
    refused(r"names no object; expected FILE\.py:NAME", load_simulator, "robot.py")
    refused(r"no such file missing\.py", load_simulator, "missing.py:Robot")


def test_logs_may_have_their_own_name_for_time_and_columns_at_a_slower_rate(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("stamp,y\n" + "".join(f"{0.1 * i},{i}\n" for i in range(10)))
    log = read_recording(path, ["y"], "stamp")
    assert log.t[3] == pytest.approx(0.3) and log["y"][3] == 3 and log.name == "log.csv"
    for absent in ("time", "t"):  # a robot has no rig.toml
        told = rf'column {absent}: missing; expected times in s, or time = ".+" in map.toml, one of stamp, y'
        refused(told, read_recording, path, ["y"], absent)
    refused(r"log\.csv: column z: missing", read_recording, path, ["z"], "stamp")
    path.write_text("t,y\n" + "".join(f"{0.1 * (i if i != 5 else 3)},{i}\n" for i in range(10)))
    refused(r"row 7, column t: 0\.3 after 0\.4; expected strictly increasing", read_recording, path, ["y"])
    path, rng = tmp_path / "log.csv", np.random.default_rng(0)
    fast, slow = rng.standard_normal(200), rng.standard_normal(200)
    path.write_text("t,x,y\n" + "".join(f"{0.01 * i:.2f},{fast[i]:.6f},{'' if i % 2 else f'{slow[i]:.6f}'}\n"
                                        for i in range(200)))  # fmt: skip
    log = read_recording(path, ["x", "y"])
    assert np.isfinite(log["x"]).all() and np.flatnonzero(np.isfinite(log["y"])).tolist() == [
        *range(0, 200, 2)
    ]
    assert log["y"][::2] == pytest.approx(slow[::2], abs=1e-6)
    assert estimate_noise([log], "y") == pytest.approx(1.0, rel=0.3)  # filled in between, it was nothing


def test_a_column_t_next_to_another_that_counts_the_time_is_itself(tmp_path):
    path, t = tmp_path / "log.csv", 0.01 * np.arange(20)
    rows = np.column_stack([t, np.sin(9 * t), np.cos(9 * t)])
    np.savetxt(path, rows, "%.6f", ",", header="stamp,t,y", comments="")
    log = read_recording(path, ["t", "y"], "stamp")
    np.testing.assert_allclose([log.t, log["t"], log["y"]], rows.T, atol=1e-5)
    path.write_text(path.read_text().replace("stamp,t,y", "stamp,torque,y"))
    refused(r"column t: missing; expected .*torque", read_recording, path, ["t", "y"], "stamp")
