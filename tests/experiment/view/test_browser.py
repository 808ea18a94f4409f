"""The viewer and its file in a browser: controls work, and nothing is complained of."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from helpers.browser import browser

from mi_nerfattack import cli
from mi_nerfattack.io import files

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]

TESTS = Path(__file__).parents[2]
#: The frame, or what lies beside it, as it is shown: pixels, as text.
SHOWN = """(() => {{
  const image = document.querySelectorAll("img[src^=blob]")[{0}];
  if (!image || !image.complete) return "";
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
  canvas.getContext("2d").drawImage(image, 0, 0);
  return canvas.toDataURL();
}})()"""
FRAME = SHOWN.format(0)
SLIDER = "document.querySelector('[role=slider]')"
HEIGHT = "+[...document.querySelectorAll('input[type=text]')].at(-1).value"


@contextmanager
def view(folder, *more):
    """Run the command; gives where it listens. Ctrl-C ends it."""
    words = [sys.executable, "-m", "mi_nerfattack.cli", "view", str(folder), *more]
    with subprocess.Popen(
        [*words, "--port", "0"],
        env={**os.environ, "PYTHONPATH": str(TESTS)},  # of the run's policy
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        try:
            line = child.stdout.readline()
            found = re.search(r"at (http://127\.0\.0\.1:[0-9]+);", line)
            assert found, (line, child.stderr.read() if not line else "")
            yield found[1]
            child.send_signal(signal.SIGINT)
            told, complaints = child.communicate(timeout=60)
            assert (child.returncode, told) == (0, "Ended\n"), complaints
            assert "Traceback" not in complaints
        finally:
            child.kill()


def press(page, text):
    """Press a button by its text."""
    page.ask(f"""[...document.querySelectorAll("button")].find(
        (button) => button.innerText === "{text}").click()""")


def drag_up(page):
    """Drag the object, which the camera looks at, by the arrow that points up."""
    x, y = page.ask("[innerWidth / 2, innerHeight / 2]")
    y -= 0.07 * y
    page.mouse("mouseMoved", x, y)
    page.mouse("mousePressed", x, y, button="left", clickCount=1)
    for step in range(1, 9):
        page.mouse("mouseMoved", x, y - 10 * step, button="left", buttons=1)
    page.mouse("mouseReleased", x, y - 80, button="left", clickCount=1)


def draws(page, path):
    """Whether many colours are seen left of the controls, below what it warns of."""
    page.shot(path)
    image = files.read_image(path)[..., :3]
    height, width = image.shape[:2]
    part = image[height // 3 : -height // 8, : width // 2].reshape(-1, 3)
    return len(np.unique(part // 16, axis=0)) > 20


def test_a_reader_uses_the_viewer(found_run, tmp_path):
    with browser(tmp_path) as page, view(found_run) as address:
        page.go(address)
        first = page.wait(FRAME)
        page.ask(f"{SLIDER}.focus()")
        page.key("End", 35)
        page.wait(f"{FRAME} && {FRAME} !== {first!r}")
        page.ask(f"{SLIDER}.focus()")
        page.key("Home", 36)
        page.wait(f"{FRAME} === {first!r}")
        assert page.ask(SHOWN.format(1)) not in ("", first)
        stood = page.ask(HEIGHT)
        page.until(lambda: draws(page, tmp_path / "first.png"), "drawing")
        drag_up(page)
        page.wait(f"{HEIGHT} > {stood} + 0.2")
        page.wait(f"{FRAME} && {FRAME} !== {first!r}")
        assert "no policy saw this" in page.ask("document.body.innerText")
        assert draws(page, tmp_path / "moved.png")
        press(page, "Put back")
        page.wait(f"{FRAME} === {first!r}")
        press(page, "Play")
        page.wait(f"{SLIDER}.getAttribute('aria-valuenow') === '2'")
        press(page, "Pause")
        assert page.told == []
        known = (address, "data:", f"blob:{address}")
        assert [x for x in page.requests if not x.startswith(known)] == []


def test_a_file_opens_by_itself(found_run, tmp_path):
    path = tmp_path / "drive.html"
    words = ["view", str(found_run), "-o", str(path), "--drive", "deployment: attack"]
    assert cli.main(words) == 0
    with browser(tmp_path) as page:
        page.go(path.as_uri())
        page.wait(f"!!{SLIDER}")
        assert page.ask("document.title") == "kill: deployment, attack"
        page.until(lambda: draws(page, tmp_path / "file.png"), "drawing")
        told = f"{SLIDER}.getAttribute('aria-valuemax')"
        assert float(page.ask(told)) == pytest.approx(0.3)  # two periods and the end
        assert page.told == []
        known = (path.as_uri(), "data:", "blob:")
        assert [x for x in page.requests if not x.startswith(known)] == []
