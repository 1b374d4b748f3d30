"""A scripted mouse in a real browser plays a session: picks a block up, stacks it, saves the trial.

    python -m experiments.play_session FOLDER [--gif docs/figures/play.gif]

Starts `hmmseg play` and a headless Chromium, and drives its mouse through the DevTools protocol. The saved
trial stands in FOLDER; the GIF shows the page as it was played.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
WIDTH, HEIGHT = 960, 720
PATIENCE = 120.0  # s


def find_browser() -> str | None:
    """A Chromium on this machine."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


class Page:
    """A browser's page and its mouse."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._number = socket, 0
        self.pictures: list[tuple[float, bytes]] = []
        self._pressed = False

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the DevTools protocol and its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            reply = json.loads(self._socket.recv(timeout=PATIENCE))
            if reply.get("id") == self._number:
                return reply.get("result", {})

    def value(self, expression: str) -> Any:
        """What a JavaScript expression is."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def until(self, expression: str) -> Any:
        """The value of an expression once it is true."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            found = self.value(expression)
            if found:
                return found
            time.sleep(0.05)
        said = self.value("$('said').textContent")
        raise TimeoutError(f"{expression} is not true after {PATIENCE} s; the page says {said}")

    def mouse(self, kind: str, x: float, y: float) -> None:
        """A mouse event at a place of the scene [m]."""
        left, top = self.value(f"toScreen({x}, {y})")
        self._pressed = {"mousePressed": True, "mouseReleased": False}.get(kind, self._pressed)
        moved = kind == "mouseMoved"
        button = "left" if self._pressed or not moved else "none"
        self.call("Input.dispatchMouseEvent", type=kind, x=left, y=top, button=button,
                  buttons=int(self._pressed), clickCount=int(not moved))  # fmt: skip

    def touch(self, kind: str, *places: tuple[float, float]) -> None:
        """Touches at places of the scene [m]: `touchStart`, `touchMove`, or `touchEnd` without any."""
        self.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        points = [self.value(f"toScreen({x}, {y})") for x, y in places]
        self.call("Input.dispatchTouchEvent", type=kind,
                  touchPoints=[{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)])  # fmt: skip

    def choose(self, element: str, option: str) -> None:
        """Choose an option of a list."""
        self.value(f"$('{element}').value = '{option}'; $('{element}').dispatchEvent(new Event('change'))")

    def click(self, element: str) -> None:
        """Click the middle of an element."""
        box = self.value(
            f"(b => [b.x + b.width / 2, b.y + b.height / 2])($('{element}').getBoundingClientRect())"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def wait(self, seconds: float, picture: bool) -> None:
        """Wait for `seconds` of played time, taking pictures on request."""
        end = self.value("frame.t") + seconds
        while self.value("frame.t") < end:
            if picture and (not self.pictures or self.value("frame.t") - self.pictures[-1][0] > 0.2):
                shot = self.call("Page.captureScreenshot", format="png")["data"]
                self.pictures.append((self.value("frame.t"), base64.b64decode(shot)))
            time.sleep(0.03)


@contextlib.contextmanager
def browser(address: str) -> Iterator[Page]:
    """A headless Chromium on this page."""
    path = find_browser()
    if path is None:
        raise FileNotFoundError(f"none of {', '.join(BROWSERS)} is installed")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--mute-audio",
                 "--no-first-run", "--remote-debugging-port=0", "--remote-allow-origins=*"]  # fmt: skip
        command = [path, *flags, f"--user-data-dir={profile}", f"--window-size={WIDTH},{HEIGHT}", address]
        with subprocess.Popen(
            command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
        ) as process:
            try:
                assert process.stderr is not None
                port = next(
                    m[1] for line in process.stderr if (m := re.search(r"ws://127.0.0.1:(\d+)/", line))
                )
                yield from _page(port, address)
            finally:
                process.terminate()
                process.stderr.close() if process.stderr else None


def _page(port: str, address: str) -> Iterator[Page]:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as listing:
            pages = [each for each in json.load(listing) if each["url"].startswith(address)]
        if pages:
            with connect(pages[0]["webSocketDebuggerUrl"], max_size=None) as socket:
                yield Page(socket)
            return
        time.sleep(0.1)
    raise TimeoutError("the browser opened no page")


@contextlib.contextmanager
def served(folder: Path, *arguments: str) -> Iterator[str]:
    """Run `hmmseg play` in another process; the page's address."""
    own = ["--output", str(folder), "--no-open"]
    command = [sys.executable, "-m", "hmmseg_cli.main", "play", *arguments, *own]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            said = []
            for line in process.stdout:
                said.append(line)
                if found := re.search(r"http://127.0.0.1:\d+/", line):
                    yield found[0]
                    break
            else:
                raise RuntimeError("".join(said))
        finally:
            process.terminate()


def stack(page: Page, moved: str, onto: str, pictures: bool = False) -> None:
    """Pick one block up and set it onto another."""
    page.until("scene && frame && frame.t > 0.3")
    sizes = page.value("scene.blocks")
    names = list(sizes)
    at = dict(zip(names, page.value("frame.worlds[0].blocks"), strict=True))
    high = page.value("scene.home")[1]
    x, y = at[moved]
    there, rest = at[onto][0], sizes[onto][1] + sizes[moved][1] / 2
    page.mouse("mouseMoved", x, high)
    page.wait(0.9, pictures)
    page.mouse("mouseMoved", x, y)
    page.wait(0.9, pictures)
    page.mouse("mousePressed", x, y)
    page.wait(0.9, pictures)
    way = ((x, high, 1.0), (there, high, 1.0), (there, rest + 0.004, 0.9), (there, rest - 0.003, 0.8))
    for *place, seconds in way:
        page.mouse("mouseMoved", *place)
        page.wait(seconds, pictures)
    page.mouse("mouseReleased", there, rest - 0.003)
    page.wait(0.7, pictures)
    page.mouse("mouseMoved", there, high)
    page.wait(0.9, pictures)


def save(page: Page) -> str:
    """Press the save button; the file that the page reports as saved."""
    page.click("save")
    return page.until("$('said').textContent.startsWith('saved ') && $('said').textContent.slice(6)")


def write_gif(pictures: list[tuple[float, bytes]], path: Path) -> None:
    """The page's pictures as an animation."""
    from PIL import Image

    frames = [
        Image.open(io.BytesIO(data)).convert("RGB").resize((WIDTH * 2 // 3, HEIGHT * 2 // 3))
        for _, data in pictures
    ]
    palettes = [frame.quantize(64, dither=Image.Dither.NONE) for frame in frames]
    path.parent.mkdir(parents=True, exist_ok=True)
    palettes[0].save(path, save_all=True, append_images=palettes[1:], duration=200, loop=0, optimize=True)


def main() -> None:
    """Play, save, and draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--gif", type=Path)
    parser.add_argument("--effect", help="that acts in a second world")
    given = parser.parse_args()
    arguments = ["--effect", given.effect] if given.effect else []
    with served(given.folder, *arguments) as address, browser(address) as page:
        stack(page, "block1", "block2", pictures=given.gif is not None)
        print(save(page))
        print(f"{page.value('rate'):.0f} frames a second in the page")
        if given.gif is not None:
            write_gif(page.pictures, given.gif)


if __name__ == "__main__":
    main()
