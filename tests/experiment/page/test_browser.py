"""The page in a browser: its script runs, its controls work, it fits."""

from __future__ import annotations

import json
import os
import re
import subprocess

import pytest
from helpers.browser import chromium
from helpers.made_runs import make_run, make_transfer

from mi_nerfattack import cli
from mi_nerfattack.io import files

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]

#: Uses the page as a reader would, and tells what came of it.
USE = """<script>
const found = {}, box = document.querySelector(".scrubber");
const slider = box.querySelector("input"), button = box.querySelector("button");
const ground = () => getComputedStyle(document.body).backgroundColor;
const label = () => box.querySelector("[data-labels]").textContent;
found.first = label();
slider.value = 3;
slider.dispatchEvent(new Event("input"));
found.moved = label();
found.at = getComputedStyle(box.querySelector("img")).objectPosition;
slider.dispatchEvent(new KeyboardEvent("keydown", {key: " "}));
found.playing = button.textContent;
button.click();
found.paused = button.textContent;
found.before = ground();
document.getElementById("theme").click();
found.after = ground();
found.wide = document.documentElement.scrollWidth - innerWidth;
dispatchEvent(new Event("beforeprint"));
found.shut = document.querySelectorAll("details:not([open])").length;
dispatchEvent(new Event("afterprint"));
found.again = document.querySelectorAll("details:not([open])").length;
found.requests = performance.getEntriesByType("resource")
  .filter((entry) => !entry.name.startsWith("data:")).length;
document.body.dataset.found = JSON.stringify(found);
</script>"""


@pytest.mark.parametrize("width", [1280, 500])
def test_a_reader_uses_the_page(tmp_path, width):
    program = chromium()
    for name in ("one", "two"):
        make_run(tmp_path / name)
    make_transfer(tmp_path / "moved")
    names = [str(tmp_path / name) for name in ("one", "two", "moved")]
    path = tmp_path / "page.html"
    assert cli.main(["report", *names, "-o", str(path)]) == 0
    page = files.read_text(path)
    files.write_text(path, page.replace("</body>", USE + "</body>"))
    words = [
        *("--headless", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"),
        *([] if os.geteuid() else ["--no-sandbox"]),
        *(f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},900"),
    ]
    result = subprocess.run(
        [program, *words, path.as_uri()],
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
    )
    assert "CONSOLE" not in result.stderr, result.stderr
    [told] = re.findall(r'data-found="([^"]*)"', result.stdout)
    found = json.loads(told.replace("&quot;", '"'))
    # farthest out after 0.2 s, where it begins
    assert (found["first"], found["moved"]) == ("0.2 s, -0.30 m", "0.3 s, +0.20 m")
    assert found["at"] == "0px 100%"
    assert (found["playing"], found["paused"]) == ("Pause", "Play")
    assert found["before"] != found["after"]
    assert found["wide"] <= 0
    assert found["shut"] == 0 < found["again"]
    assert found["requests"] == 0
