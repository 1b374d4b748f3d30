"""A played session: the hand on springs, worlds side by side, the server, and a browser that stacks."""

import asyncio
import base64
import hashlib
import json
import os
import signal
import socket as socketlib
import subprocess
import sys
import threading

import numpy as np
import pytest
from refusals import refused
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from estimation.identification import identify_aligned
from experiments.play_session import browser, find_browser, served
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg.segmentation.align import align
from hmmseg_cli.main import main
from hmmseg_cli.play import diagnosed
from simgap.play.server import PlayServer
from simgap.play.session import Session, default_rig, default_task
from simgap.play.world import effect_values, felt_effects, scene_with, sensed
from simgap.world.properties import PAPER_BLOCKS

NONSENSE = ("", "[]", "null", '{"kind": "aim"}', '{"kind": "aim", "x": "a", "y": 0, "closed": 1}', "[" * 3000,
            '{"kind": "effect", "name": ["x"]}', '{"kind": "touch", "tips": [[1]]}', b"\xff")  # fmt: skip


@pytest.fixture(scope="module")
def made() -> Session:
    return Session(default_task(list(PAPER_BLOCKS)), default_rig(), dict(PAPER_BLOCKS))


@pytest.fixture
def session(made):
    made.compare_with(None)
    return made


def perform(session):
    (x1, x2), top = (session.x[name] for name in ("block1", "block2")), session.top
    half, rest = PAPER_BLOCKS["block1"].height / 2, PAPER_BLOCKS["block2"].height
    for x, y, closed, ms in (
        (x1, top, False, 900), (x1, half, False, 900), (x1, half, True, 1000), (x1, top, True, 900),
        (x2, top, True, 900), (x2, rest + half + 0.004, True, 800), (x2, rest + half - 0.003, True, 800),
        (x2, rest + half - 0.003, False, 700), (x2, top, False, 900),
    ):  # fmt: skip
        session.aim(x, y, closed)
        session.advance(ms)


@pytest.mark.slow
def test_a_session_stacks_and_its_trial_identifies_the_blocks(session, tmp_path):
    perform(session)
    (x1, y1), (x2, _) = session.nominal.model.block_positions()
    assert y1 == pytest.approx(PAPER_BLOCKS["block2"].height + PAPER_BLOCKS["block1"].height / 2, abs=2e-4)
    assert abs(x1 - x2) < 2e-3
    session.save(tmp_path)
    rig, task = read_rig(tmp_path / "rig.toml"), read_task(tmp_path / "task.toml")
    aligned = align([read_trial(tmp_path / "trial_01.csv", rig)], task, rig)
    assert aligned.segmentations[0].failed is None
    found = identify_aligned(aligned)
    for obj, prop in (("block1", "weight"), ("block1", "width"), ("block2", "height")):
        low, high = np.percentile(found.of(obj, prop), [2.5, 97.5])
        assert low < getattr(PAPER_BLOCKS[obj], prop) < high
    assert [path.name for path in session.save(tmp_path)][-1] == "trial_02.csv"
    assert not list(tmp_path.glob(".*"))


def test_fingers_move_by_touches_through_springs_that_show_the_force_and_not_by_nonsense(session, tmp_path):
    before = session.target.copy()
    session.aim(float("nan"), 0.1, True)
    session.touch(np.array([[np.inf, 0.0], [0.0, 0.0]]))
    np.testing.assert_array_equal(session.target, before)
    assert session.fingers is None
    refused("less than a second", session.save, tmp_path, error=ValueError)
    session.touch(np.array([[0.17, 0.04], [0.12, 0.05]]))
    session.advance(2000)
    np.testing.assert_allclose(session.nominal.position, [[0.12, 0.05], [0.17, 0.04]], atol=1e-3)
    session.aim(session.x["block1"], 0.008, False)
    session.advance(1500)
    session.aim(session.x["block1"], 0.008, True, grip=2.0)
    session.advance(1200)
    assert session.nominal.force[0, 0] == pytest.approx(2.0, rel=0.05)
    stretch = session.command[0, 0] - session.nominal.position[0, 0]
    assert 450.0 * stretch == pytest.approx(2.0, rel=0.05)


def test_effects_beside_are_felt_and_a_diagnosis_names_them(session, tmp_path):
    session.compare_with(session.world_with({"force_gain": {"gain": 0.5}}))
    session.aim(session.x["block1"], 0.008, False)
    session.advance(1500)
    session.aim(session.x["block1"], 0.008, True)
    session.advance(1000)
    nominal, other = session.frame()["worlds"]
    assert other["force"][0][0] == pytest.approx(1.5 * nominal["force"][0][0], rel=1e-6)
    np.testing.assert_allclose(other["blocks"], nominal["blocks"], atol=1e-9)
    assert session.scene()["effects"] == {"force_gain": {"gain": 0.5}}
    path = tmp_path / "d.json"
    document = {"format": "hmmseg.diagnose/1", "verdict": "named", "causes": ["force_lowpass"],
                "effects": {"force_lowpass": {"parameters": {"time_constant": {"mean": 0.04}}}}}  # fmt: skip
    path.write_text(json.dumps(document))
    assert diagnosed(path) == {"force_lowpass": {"time_constant": 0.04}}
    path.write_text(json.dumps(document | {"causes": [], "verdict": "none"}))
    refused("a diagnosis that names a cause", diagnosed, path)
    path.write_text(json.dumps(document | {"causes": ["backlash"]}))
    refused("backlash cannot be felt", diagnosed, path)
    path.write_text(json.dumps({"format": "hmmseg.identify/1"}))
    assert diagnosed(path) == {}


def test_effects_change_the_scene_by_the_parameters_of_one_form_alone():
    effects = {"grip_slip": {"mu": 0.1}, "table_compliance": {"stiffness": 900.0},
               "fingertip_compliance": effect_values("fingertip_compliance")}  # fmt: skip
    rig, blocks, around = scene_with(effects, default_rig(), PAPER_BLOCKS)
    assert {block.friction for block in blocks.values()} == {0.1} and around.support_stiffness == 900.0
    assert rig.fingertip.normal_stiffness == 800.0
    gain = {key: value for key, value in effect_values("force_gain").items() if value}
    assert gain.keys() == {"gain"}
    one = {key: value for key, value in effect_values("force_gain", {"fx1": 0.1}).items() if value}
    assert one == {"fx1": 0.1}


@pytest.mark.parametrize("name", sorted(felt_effects()))
def test_every_offered_effect_can_be_felt(name):
    t = np.arange(400) * 1e-3
    force = np.ones((400, 2, 2)) * np.linspace(0, 2, 400)[:, None, None]
    place = np.zeros((400, 2, 2))
    out = sensed({name: effect_values(name)}, t, place, place, force, default_rig())
    assert out.shape == force.shape and np.isfinite(out).all()


@pytest.mark.parametrize(("arguments", "line"), [
    (["nowhere.json"], "nowhere.json: no such file"),
    (["--effect", "gravity"], "effect gravity: cannot be felt in a played world"),
    (["--rig", "nowhere.toml"], "nowhere.toml: no such file")])  # fmt: skip
def test_bad_input_is_told_in_one_line(arguments, line, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["play", *arguments, "--no-open"]) == 2 and line in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def server(session, tmp_path):
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    served_session = PlayServer(session, tmp_path / "out")
    address = asyncio.run_coroutine_threadsafe(served_session.start(), loop).result(30)
    yield address.removeprefix("http://"), tmp_path / "out"
    asyncio.run_coroutine_threadsafe(served_session.stop(), loop).result(30)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(30)
    loop.close()


def answers(socket, kind):
    while (told := json.loads(socket.recv(timeout=30)))["kind"] != kind:
        pass
    return told


def test_the_socket_plays_and_shrugs_at_nonsense(server):
    where, folder = server
    with connect(f"ws://{where}socket", origin=f"http://{where.rstrip('/')}") as socket:
        scene = answers(socket, "scene")
        assert set(scene["blocks"]) == set(PAPER_BLOCKS)
        for nonsense in NONSENSE:
            socket.send(nonsense)
            if "touch" not in str(nonsense):
                assert answers(socket, "said")["text"]
        socket.send(json.dumps({"kind": "aim", "x": 0.1, "y": 0.05, "closed": False}))
        start = answers(socket, "frame")["t"]
        while answers(socket, "frame")["t"] < start + 1.2:
            pass
        assert abs(np.mean(answers(socket, "frame")["worlds"][0]["tips"], axis=0)[0] - 0.1) < 0.01
        with (pytest.raises(ConnectionClosed, match="somebody plays already"),
              connect(f"ws://{where}socket", origin=f"http://{where.rstrip('/')}") as second):  # fmt: skip
            second.recv(timeout=30)
        socket.send(json.dumps({"kind": "save"}))
        assert answers(socket, "saved")["file"] == str(folder / "trial_01.csv")


def test_other_pages_and_odd_headers_are_refused_and_the_page_says_what_it_may_load(server):
    where, _ = server
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://{where}socket", origin="http://evil.example").close()
    with pytest.raises(InvalidStatus, match="403"):
        connect(f"ws://{where}socket", additional_headers={"Host": "evil.example"}).close()
    host, port = where.rstrip("/").split(":")

    def answer(*headers: str) -> str:
        with socketlib.create_connection((host, int(port)), timeout=30) as raw:
            raw.sendall("\r\n".join(["GET / HTTP/1.1", *headers, "", ""]).encode())
            return b"".join(iter(lambda: raw.recv(65536), b"")).decode()

    page = answer(f"Host: {host}:{port}")
    policy = next(line for line in page.splitlines() if line.startswith("Content-Security-Policy"))
    assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy
    script = page.partition("<script>")[2].partition("</script>")[0]
    assert base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() in policy
    for headers in ((f"Host: {host}:{port}", f"Host: {host}:{port}"), (), ("Host: evil.example:80",)):
        assert answer(*headers).startswith("HTTP/1.1 403")


def test_a_session_replaces_no_file(session, tmp_path):
    session.advance(1500)
    (tmp_path / "trial_02.csv").write_text("mine")
    assert [session.save(tmp_path)[-1].name for _ in range(2)] == ["trial_01.csv", "trial_03.csv"]
    assert (tmp_path / "trial_02.csv").read_text() == "mine"
    (tmp_path / "rig.toml").write_text("rate = 7")
    refused(r"rig\.toml: is there already, and not this session's", session.save, tmp_path)
    assert (tmp_path / "rig.toml").read_text() == "rate = 7" and len(list(tmp_path.iterdir())) == 6


@pytest.fixture
def page(tmp_path):
    if find_browser() is None:
        pytest.skip("no Chromium on this machine")
    with served(tmp_path) as address, browser(address) as page:
        yield page


@pytest.mark.slow
def test_two_touches_in_a_real_browser_lift_a_block(page):
    page.until("scene && frame && frame.t > 0.3")
    x, y = page.value("frame.worlds[0].blocks[0]")
    wide, half = page.value("scene.home")[1], page.value("Object.values(scene.blocks)[0][0]") / 2
    page.touch("touchStart", (x - half - 0.015, wide), (x + half + 0.015, wide))
    page.wait(0.8, False)
    left, right = page.value("frame.worlds[0].tips")
    assert right[0] - left[0] > 2 * half + 0.015
    for apart, height in ((0.015, y), (-0.008, y), (-0.008, y + 0.012)):
        page.touch("touchMove", (x - half - apart, height), (x + half + apart, height))
        page.wait(1.0, False)
    assert (page.value("frame.worlds[0].force[0][0]") > 1.0
            and page.value("frame.worlds[0].force[1][0]") < -1.0)  # fmt: skip
    assert page.value("frame.worlds[0].blocks[0][1]") - y > 0.005


@pytest.mark.slow
def test_a_second_world_in_a_real_browser_is_seen_and_felt(page):
    page.until("scene && frame && frame.t > 0.3")
    assert page.value("$('other').hidden") and page.value("frame.worlds.length") == 1
    page.choose("effect", "force_gain")
    page.until("Object.keys(scene.effects).length === 1 && frame.worlds.length === 2 && frame.t > 0.3")
    assert not page.value("$('other').hidden") and page.value("$('other').width") > 200
    x, y = page.value("frame.worlds[0].blocks[0]")
    for kind in ("mouseMoved", "mousePressed"):
        page.mouse(kind, x, y)
        page.wait(1.2, False)
    gain = page.value("scene.effects.force_gain.gain")
    one, other = (world["force"][0][0] for world in page.value("frame.worlds"))
    assert one > 1.0 and other / one == pytest.approx(1 + gain, rel=0.05)
    page.choose("effect", "")
    page.until("frame.worlds.length === 1 && $('other').hidden")


def test_the_command_ends_with_its_terminal(tmp_path):
    # A shell without job control has what it runs in the background ignore Ctrl-C.
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{heed}; from hmmseg_cli.main import main; main()"
    command = [sys.executable, "-c", program, "play", "--no-open", "--output", str(tmp_path / "o")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            next(line for line in process.stdout if "http://127.0.0.1:" in line)
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, err) == (0, "") and not (tmp_path / "o").exists()


@pytest.mark.parametrize("at", range(4))
def test_a_file_that_cannot_be_put_in_place_leaves_no_half_of_it(at, session, tmp_path, monkeypatch):
    session.reset()
    session.advance(1100)
    real, calls = os.replace, iter(range(10))

    def replace(old, new):
        if next(calls) == at:
            raise OSError(28, "No space left on device")
        real(old, new)

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", replace)
        refused("No space", session.save, tmp_path, error=OSError)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".") or path.suffix == ".csv"]
    assert session.save(tmp_path)[-1].name == "trial_01.csv"
