"""What a map.toml or a model cannot say (windows, times, keyframes, time steps) ends in one line."""

import pytest

from hmmseg.errors import InputError
from simgap.simulators.mjcf.load import load_mjcf

XML = """<mujoco><option timestep="{step}"/><worldbody><body name="arm"><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02"/></body></worldbody>
<actuator><motor name="m" joint="j"/></actuator></mujoco>"""
COLUMNS = '[columns]\nq = {joint = "j"}\nu = {actuator = "m"}\n'


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("window = 0", "window.*seconds above 0"), ("window = -1", "window.*seconds above 0"),
        ("window = 1e9", "window.*at most"), ('window = "long"', "window"), ("window = nan", "window"),
        ("time = 3", "time"), ("time = []", "time"), ('time = {column = "t", unit = "parsec"}', "unit"),
        ("keyframe = 3", "keyframe.*the name of a keyframe"), ('keyframe = "home"', "keyframe.*no home"),
        ("windw = 1", "windw"),
    ],
)  # fmt: skip
def test_a_map_that_says_what_cannot_be(line, wanted, tmp_path):
    (tmp_path / "robot.xml").write_text(XML.format(step="0.002"))
    (tmp_path / "map.toml").write_text(f"{line}\n{COLUMNS}")
    with pytest.raises(InputError, match=wanted):
        load_mjcf(tmp_path / "robot.xml", tmp_path / "map.toml")


@pytest.mark.parametrize("step", ["0", "-0.001", "1e-12", "nan", "5"])
def test_a_model_whose_time_step_is_none(step, tmp_path):
    (tmp_path / "robot.xml").write_text(XML.format(step=step))
    (tmp_path / "map.toml").write_text(COLUMNS)
    with pytest.raises(InputError, match=r"robot\.xml"):
        load_mjcf(tmp_path / "robot.xml", tmp_path / "map.toml")
