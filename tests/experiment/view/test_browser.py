"""A drive and a page of results in a browser: nothing complains, nothing is fetched."""

from __future__ import annotations

import numpy as np
import pytest
from support.files.runs import make_run, make_transfer
from support.pages.browser import browser

from mi_nerfattack import cli
from mi_nerfattack.io import files

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("variant")]

SLIDER = "document.querySelector('[role=slider]')"


def draws(page, path):
    """Whether many colours are seen left of the controls, below what it warns of."""
    page.shot(path)
    image = files.read_image(path)[..., :3]
    height, width = image.shape[:2]
    part = image[height // 3 : -height // 8, : width // 2].reshape(-1, 3)
    return len(np.unique(part // 16, axis=0)) > 20


def check_alone(page, *known):
    """Check that nothing was complained of, and nothing else was fetched."""
    assert page.messages == []
    assert [x for x in page.requests if not x.startswith(known)] == []


def test_a_file_opens_by_itself(found_run, tmp_path):
    path = tmp_path / "drive.html"
    words = ["view", str(found_run), "-o", str(path), "--drive", "mitsuba: attack"]
    assert cli.main(words) == 0
    with browser(tmp_path) as page:
        page.go(path.as_uri())
        page.wait(f"!!{SLIDER}")
        assert page.ask("document.title") == "kill: mitsuba, attack"
        page.until(lambda: draws(page, tmp_path / "file.png"), "drawing")
        script = f"{SLIDER}.getAttribute('aria-valuemax')"
        assert float(page.ask(script)) == pytest.approx(0.3)  # two periods and the end
        check_alone(page, path.as_uri(), "data:", "blob:")


#: Uses the page of results as a reader would, and says what came of it.
USE = """(() => {
const found = {}, box = document.querySelector(".scrubber");
const slider = box.querySelector("input"), button = box.querySelector("button");
const ground = () => getComputedStyle(document.body).backgroundColor;
const shut = () => document.querySelectorAll("details:not([open])").length;
const label = () => box.querySelector("[data-labels]").textContent;
found.first = label();
slider.value = 3;
slider.dispatchEvent(new Event("input"));
found.moved = label();
found.at = getComputedStyle(box.querySelector("img")).objectPosition;
slider.dispatchEvent(new KeyboardEvent("keydown", {key: " "}));
found.buttons = [button.textContent];
button.click();
found.buttons.push(button.textContent);
found.grounds = [ground()];
document.getElementById("theme").click();
found.grounds.push(ground());
found.wide = document.documentElement.scrollWidth - innerWidth;
dispatchEvent(new Event("beforeprint"));
found.shut = [shut()];
dispatchEvent(new Event("afterprint"));
found.shut.push(shut());
return found;
})()"""


@pytest.mark.parametrize("width", [1280, 500])
def test_a_reader_uses_the_page_of_results(tmp_path, width):
    for name in ("one", "two"):
        make_run(tmp_path / name)
        shares = {"gradient_share": {"ball": [0.1, 0.2, 0.6, 0.1]}}
        files.write_json(tmp_path / name / "attribution.json", shares)
    make_transfer(tmp_path / "moved")
    names = [str(tmp_path / name) for name in ("one", "two", "moved")]
    path = tmp_path / "page.html"
    assert cli.main(["report", *names, "-o", str(path)]) == 0
    with browser(tmp_path) as page:
        page.resize(width, 900)
        page.go(path.as_uri())
        page.wait("document.readyState === 'complete' && !!document.body.children[0]")
        answer = page.ask(USE)
        check_alone(page, path.as_uri(), "data:")
    # the slider begins where the gradient has its largest share: after two periods
    assert (answer["first"], answer["moved"]) == ("0.2 s, -0.30 m", "0.3 s, +0.20 m")
    assert answer["at"] == "0px 100%"
    assert answer["buttons"] == ["Pause", "Play"]
    assert answer["grounds"][0] != answer["grounds"][1]
    assert answer["wide"] <= 0
    assert answer["shut"][0] == 0 < answer["shut"][1]
