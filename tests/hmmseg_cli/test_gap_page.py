"""The page of a diagnosis, opened in a real browser (skipped where none is installed)."""

import shutil
import subprocess

import pytest

import hmmseg
from hmmseg_cli.main import main

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DATA = hmmseg.example_folder()
HEADLESS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--virtual-time-budget=5000",
)  # fmt: skip


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_the_page_opens_in_a_browser(tmp_path):
    trials = [str(DATA / f"trial_0{k}.csv") for k in (1, 2)]
    page = tmp_path / "gap.html"
    rig = tmp_path / "rig.toml"
    text = (DATA / "rig.toml").read_text(encoding="utf-8")
    rig.write_text(text.replace("normal_stiffness = 4000.0", "normal_stiffness = inf"), encoding="utf-8")
    args = ["--task", str(DATA / "task.toml"), "--rig", str(rig), "--report", str(page), "--quiet"]
    assert main(["diagnose", *trials, *args]) == 0
    assert BROWSER is not None
    command = [BROWSER, *HEADLESS, f"--user-data-dir={tmp_path / 'profile'}"]
    shown = subprocess.run(
        [*command, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=60, check=True
    )
    for id in ("verdict", "next", "heat", "where", "suspects", "parameters", "properties"):
        assert f'id="{id}"' in shown.stdout
    assert "Fingertips that yield" in shown.stdout.split('id="verdict"')[1].split("</p>")[0]
    picture = tmp_path / "page.png"
    subprocess.run(
        [*command, f"--screenshot={picture}", "--window-size=1000,2400", page.as_uri()],
        capture_output=True, timeout=60, check=True,
    )  # fmt: skip
    assert picture.stat().st_size > 50_000  # figures and all; a blank page has a tenth of it
